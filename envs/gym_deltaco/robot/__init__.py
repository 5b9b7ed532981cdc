"""The WidowX 250: links, meshes and kinematics."""
