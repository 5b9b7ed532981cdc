"""A robot without hardware, for LeRobot's commands, which find its class by the name of its configuration."""

from dataclasses import dataclass

import numpy as np
from lerobot.robots import Robot, RobotConfig

MOTORS = ("shoulder.pos", "gripper.pos")
CAMERA = "front"
IMAGE_SHAPE = (24, 32, 3)


@RobotConfig.register_subclass("fake_arm")
@dataclass(kw_only=True)
class FakeArmConfig(RobotConfig):
    """A configuration without options."""


class FakeArm(Robot):
    """An arm that is at once where it is sent; its camera's image is as bright as its shoulder is high."""

    config_class = FakeArmConfig
    name = "fake_arm"
    sent = []  # what all such robots got
    is_connected = False
    is_calibrated = True

    def __init__(self, config):
        super().__init__(config)
        self.cameras = {CAMERA: None}
        self.position = dict.fromkeys(MOTORS, 0.0)

    @property
    def observation_features(self):
        return {**dict.fromkeys(MOTORS, float), CAMERA: IMAGE_SHAPE}

    @property
    def action_features(self):
        return dict.fromkeys(MOTORS, float)

    def connect(self, calibrate=True):
        self.is_connected = True

    def disconnect(self):
        self.is_connected = False

    def calibrate(self): ...

    def configure(self): ...

    def get_observation(self):
        shade = np.clip(100 + self.position["shoulder.pos"], 0, 255).astype(np.uint8)
        return {**self.position, CAMERA: np.full(IMAGE_SHAPE, shade)}

    def send_action(self, action):
        self.position = {name: float(action[name]) for name in MOTORS}
        FakeArm.sent.append(dict(self.position))
        return action
