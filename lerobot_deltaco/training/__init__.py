"""`deltaco train`: LeRobot's training loop over frames in memory and batches of tasks."""
