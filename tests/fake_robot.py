"""A robot without hardware, and its teleoperator, for LeRobot's commands that want one.

LeRobot finds a class beside its configuration, by the name without "Config".
"""

from dataclasses import dataclass

import numpy as np
from lerobot.robots import Robot, RobotConfig
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig

MOTORS = ("shoulder.pos", "gripper.pos")
CAMERA = "front"
IMAGE_SHAPE = (24, 32, 3)


class _Device:
    """What a robot and a teleoperator have alike: nothing to calibrate, nothing to set up."""

    is_connected = False
    is_calibrated = True

    def connect(self, calibrate=True):
        self.is_connected = True

    def disconnect(self):
        self.is_connected = False

    def calibrate(self): ...

    def configure(self): ...


@RobotConfig.register_subclass("fake_arm")
@dataclass(kw_only=True)
class FakeArmConfig(RobotConfig):
    """Nothing to say."""


class FakeArm(_Device, Robot):
    """Is at once where it is sent; its camera's image is as bright as its shoulder is high."""

    config_class = FakeArmConfig
    name = "fake_arm"
    sent = []  # the actions that all such robots got

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

    def get_observation(self):
        shade = np.clip(100 + self.position["shoulder.pos"], 0, 255).astype(np.uint8)
        return {**self.position, CAMERA: np.full(IMAGE_SHAPE, shade)}

    def send_action(self, action):
        self.position = {name: float(action[name]) for name in MOTORS}
        FakeArm.sent.append(dict(self.position))
        return action


@TeleoperatorConfig.register_subclass("fake_leader")
@dataclass(kw_only=True)
class FakeLeaderConfig(TeleoperatorConfig):
    """Nothing to say."""


class FakeLeader(_Device, Teleoperator):
    """Raises the shoulder step by step, and opens and closes the gripper."""

    config_class = FakeLeaderConfig
    name = "fake_leader"
    feedback_features = {}

    def __init__(self, config):
        super().__init__(config)
        self.n_steps = 0

    @property
    def action_features(self):
        return dict.fromkeys(MOTORS, float)

    def get_action(self):
        self.n_steps += 1
        return {"shoulder.pos": 5.0 * (self.n_steps % 20), "gripper.pos": 40.0 * (self.n_steps % 2)}

    def send_feedback(self, feedback): ...
