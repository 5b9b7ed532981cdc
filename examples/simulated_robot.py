"""A simulated arm with a scripted operator, for LeRobot's commands that need a robot: recording and rollouts.

    export PYTHONPATH=examples
    lerobot-record --robot.type=simulated_widowx --robot.discover_packages_path=simulated_robot \
        --robot.task_id=4 --teleop.type=scripted_operator --dataset.fps=30 --dataset.episode_time_s=8 \
        --dataset.reset_time_s=0 --dataset.num_episodes=4 --dataset.single_task="Put it in the green bin." ...
    lerobot-rollout --robot.type=simulated_widowx --robot.discover_packages_path=simulated_robot \
        --robot.task_id=4 --fps=30 --duration=8 ...

It is the benchmark's WidowX under joint control, in real time. Each recorded episode has a new scene.
"""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from lerobot.robots import Robot, RobotConfig
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig

from gym_deltaco.env import PickPlaceEnv
from gym_deltaco.expert import JointExpert
from gym_deltaco.scene_config import SceneConfig

logger = logging.getLogger(__name__)

__path__: list[str] = []  # LeRobot looks for modules in the packages that it discovers.
_MARGIN = 0.05  # s after the end of an episode, which LeRobot needs to store it
_ENDLESS = 100_000  # steps


@RobotConfig.register_subclass("simulated_widowx")
@dataclass(kw_only=True)
class SimulatedWidowxConfig(RobotConfig):
    """Options of the robot.

    Args:
        task_id: Task of the benchmark that scenes are drawn for, and that the operator performs.
        objects: Set of objects of the scenes.
        seed: Seed of the first scene; the next ones have the following seeds.
        image_size: Height and width of the images, px.
        episode_time_s: Duration of a recorded episode, as in `lerobot-record`, s; then the scene changes.
    """

    task_id: int = 4
    objects: str = "all"
    seed: int = 0
    image_size: int = 128
    episode_time_s: float = 8.0


class SimulatedWidowx(Robot):
    """The benchmark's arm. While the operator moves it, each episode has a new scene."""

    config_class = SimulatedWidowxConfig
    name = "simulated_widowx"
    connected: ClassVar[SimulatedWidowx | None] = None  # the one that the operator moves
    is_calibrated = True

    def __init__(self, config: SimulatedWidowxConfig) -> None:
        super().__init__(config)
        self.config = config
        scene = SceneConfig(
            control="joints",
            image_size=config.image_size,
            objects=config.objects,
            episode_length=_ENDLESS,
        )
        self.cameras = dict.fromkeys(scene.interface.cameras)
        self._names = scene.interface.state_names
        self._scene, self.env = scene, None
        self.n_scenes, self.is_operated = 0, False
        self._info: dict[str, Any] = {}

    @property
    def observation_features(self) -> dict[str, Any]:
        """Types of the joints' positions, and shapes of the images."""
        size = self.config.image_size
        return dict.fromkeys(self._names, float) | dict.fromkeys(self.cameras, (size, size, 3))

    @property
    def action_features(self) -> dict[str, Any]:
        """Types of the joints' targets."""
        return dict.fromkeys(self._names, float)

    @property
    def is_connected(self) -> bool:
        """Whether there is a scene."""
        return self.env is not None

    def connect(self, calibrate: bool = True) -> None:
        """Draws the first scene."""
        self.env = PickPlaceEnv(self.config.task_id, self._scene)
        self._draw_scene()
        SimulatedWidowx.connected = self

    def calibrate(self) -> None:
        """Does nothing."""

    def configure(self) -> None:
        """Does nothing."""

    def get_observation(self) -> dict[str, Any]:
        """Returns the joints' positions by name, and the images by camera."""
        if self.is_operated and time.perf_counter() - self._begin > self.config.episode_time_s + _MARGIN:
            self._draw_scene()
        self._begin = self._begin or time.perf_counter()
        positions = map(float, self._observation["agent_pos"])
        return dict(zip(self._names, positions, strict=True)) | self._observation["pixels"]

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Moves the joints for a thirtieth of a second."""
        assert self.env is not None
        targets = np.array([action[name] for name in self._names], np.float32)
        self._observation, _, _, _, self._info = self.env.step(targets)
        return action

    def disconnect(self) -> None:
        """Says whether the task was done in the last scene."""
        assert self.env is not None
        outcome = "done" if self._info.get("is_success") else "not done"
        logger.warning("%s It was %s.", self.env.task_description, outcome)
        self.env.close()
        self.env = SimulatedWidowx.connected = None

    def _draw_scene(self) -> None:
        assert self.env is not None
        seed = self.config.seed + self.n_scenes
        self._observation, self._info = self.env.reset(seed=seed, options={"task_id": self.config.task_id})
        self.n_scenes, self._begin = self.n_scenes + 1, 0.0


@TeleoperatorConfig.register_subclass("scripted_operator")
@dataclass(kw_only=True)
class ScriptedOperatorConfig(TeleoperatorConfig):
    """A configuration without options."""


class ScriptedOperator(Teleoperator):
    """The benchmark's scripted expert, who performs the task of the simulated robot once in each scene."""

    config_class = ScriptedOperatorConfig
    name = "scripted_operator"
    feedback_features: ClassVar[dict[str, Any]] = {}
    is_connected = False
    is_calibrated = True

    def __init__(self, config: ScriptedOperatorConfig) -> None:
        super().__init__(config)
        self._scene, self._last = 0, {}

    @property
    def action_features(self) -> dict[str, Any]:
        """Those of the robot."""
        return {} if SimulatedWidowx.connected is None else SimulatedWidowx.connected.action_features

    def connect(self, calibrate: bool = True) -> None:
        """Does nothing."""
        self.is_connected = True

    def disconnect(self) -> None:
        """Does nothing."""
        self.is_connected = False

    def calibrate(self) -> None:
        """Does nothing."""

    def configure(self) -> None:
        """Does nothing."""

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Does nothing."""

    def get_action(self) -> dict[str, Any]:
        """Returns the expert's targets, and after its success the last ones."""
        robot = SimulatedWidowx.connected
        assert robot is not None
        assert robot.env is not None
        if robot.n_scenes != self._scene:
            self._scene = robot.n_scenes
            self._expert = JointExpert(robot.env, np.random.default_rng((self._scene, 1)))
        robot.is_operated = True
        if not self._expert.is_done:
            targets = map(float, self._expert.act())
            self._last = dict(zip(robot.action_features, targets, strict=True))
        return self._last
