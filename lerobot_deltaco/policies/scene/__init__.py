"""What stands in a picture, whatever the task: proposals, crops, and how far the camera has moved."""
