"""Fast training: LeRobot's own loop, over frames in memory and batches of tasks."""
