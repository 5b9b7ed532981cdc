"""`--policy.type=deltaco_match`: describes what a demonstration moved, finds it in the scene, and acts."""
