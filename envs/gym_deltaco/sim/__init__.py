"""PyBullet: the simulation, the camera and the workspace."""
