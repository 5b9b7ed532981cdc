"""The toy robot as a robot of LeRobot's, for `lerobot-rollout --robot.type=toy_robot`."""

# No `from __future__ import annotations`: LeRobot's parser reads the annotations.

import logging
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.robots import Robot, RobotConfig
from numpy.typing import NDArray

from lerobot_deltaco.pictures import write_video
from lerobot_deltaco.toy_robot.world import CAMERAS, FPS, HEIGHT, MOTORS, WIDTH, ToyWorld

logger = logging.getLogger(__name__)


@RobotConfig.register_subclass("toy_robot")
@dataclass(kw_only=True)
class ToyRobotConfig(RobotConfig):
    """Options of the toy robot.

    Args:
        seed: Seed of the scene.
        new_object: Whether one of the objects is in no training episode.
        video: File for a video of the front camera.
    """

    seed: int = 1000
    new_object: bool = False
    video: Path | None = None


class ToyRobot(Robot):
    """The arm as a robot of LeRobot's; each connection begins with the scene of its seed."""

    config_class = ToyRobotConfig
    name = "toy_robot"
    is_calibrated = True

    def __init__(self, config: ToyRobotConfig) -> None:
        super().__init__(config)
        self.config, self.cameras = config, dict.fromkeys(CAMERAS)
        self.world: ToyWorld | None = None
        self.frames: list[NDArray[np.uint8]] = []

    @cached_property
    def observation_features(self) -> dict[str, Any]:
        """Returns the motors and the sizes of the images."""
        return {**self.action_features, **dict.fromkeys(CAMERAS, (HEIGHT, WIDTH, 3))}

    @cached_property
    def action_features(self) -> dict[str, type]:
        """Returns the motors."""
        return dict.fromkeys(MOTORS, float)

    @property
    def is_connected(self) -> bool:
        """Whether there is a scene."""
        return self.world is not None

    def connect(self, calibrate: bool = True) -> None:
        """Sets the table."""
        self.world = ToyWorld(self.config.seed, self.config.new_object)

    def calibrate(self) -> None:
        """Does nothing."""

    def configure(self) -> None:
        """Does nothing."""

    def get_observation(self) -> dict[str, Any]:
        """Returns the joint positions and the images."""
        assert self.world is not None
        images = self.world.images()
        self.frames.append(images["front"])
        return {**dict(zip(MOTORS, self.world.joints.tolist(), strict=True)), **images}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Moves for a frame towards joint positions."""
        assert self.world is not None
        self.world.step(np.array([float(action[motor]) for motor in MOTORS]))
        return action

    def disconnect(self) -> None:
        """Logs what is in the boxes, and writes the video."""
        if self.world is None:
            return
        inside = [f"the {name} in the {color} box" for name, color in self.world.in_boxes().items()]
        logger.warning("In the boxes: %s.", ", ".join(inside) or "nothing")
        if self.config.video is not None and self.frames:
            self.config.video.parent.mkdir(parents=True, exist_ok=True)
            write_video(self.frames, self.config.video, FPS)
        self.world = None
