"""LeRobotDatasets as the policies see them: demonstrations, grasps and frames in memory."""
