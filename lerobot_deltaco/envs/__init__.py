"""The benchmark's environment as LeRobot's training and evaluation use it."""
