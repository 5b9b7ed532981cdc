"""Collects the scripted expert's episodes as LeRobotDatasets, and publishes them."""
