"""The data: the scripted expert's episodes as a LeRobotDataset, its card, and its way to the Hub."""
