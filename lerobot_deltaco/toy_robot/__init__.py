"""A toy robot of the SO-101's kind, with which everyone can go through the tutorial."""

# LeRobot looks for a robot's class in the package of its configuration's module.
from lerobot_deltaco.toy_robot.robot import ToyRobot, ToyRobotConfig

__all__ = ["ToyRobot", "ToyRobotConfig"]
