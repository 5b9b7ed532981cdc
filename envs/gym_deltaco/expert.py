"""The scripted expert: picks the target object and places it in the target container (paper, algorithm 3)."""

from __future__ import annotations

from collections.abc import Iterator
from enum import Enum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gym_deltaco import EXPERT_NOISE
from gym_deltaco.arm import FINGERTIP_OFFSET
from gym_deltaco.env import ACTION_SCALE, Observation, PickPlaceEnv
from gym_deltaco.workspace import CONTAINER_FLOOR, CONTAINER_HALF_EXTENTS, TRAY_FLOOR

OPEN, CLOSED = 1.0, -1.0

# Heights and errors in m. The gripper's height is that of the end effector; the fingertips are 0.05 m below.
_HOVER_Z = -0.215  # where the fingertips pass above every object
_ALIGNED = np.array([0.013, 0.012])  # error in x and y within which the gripper comes down
_STRADDLING = np.array([0.02, 0.03])  # error in x and y that is allowed once the gripper is down
_AROUND = np.array([0.02, 0.014, 0.015])  # error in x, y and z within which it closes
_PAD_HEIGHT = 0.010  # of the middle of the pads above the fingertips
_TIP_CLEARANCE = 0.004  # of the fingertips above the tray
_PALM_CLEARANCE = 0.012  # of the object's top below the end effector
_CARRY_CLEARANCE = 0.085  # of a carried object's lowest point above the tray
_LIFTED_CLEARANCE = 0.06  # height of its lowest point above the tray from which an object may be carried
_CARRY_SPEED = 0.8  # length of the motion at the most; diagonally, a held object would slip at full speed
_DROP_SHARE = 0.3  # of the container, about its middle, where the drop point is drawn
_OVER_CONTAINER = np.array([0.035, 0.022])  # error in x and y within which the object is lowered and let go
_RELEASE_CLEARANCE = 0.012  # of the object's lowest point above the container's floor when it is let go
_RELEASE_TOLERANCE = 0.025  # error in z within which it is let go
_RETREAT = 0.05  # of the gripper, upwards, after it has let go


class Stage(Enum):
    """Stage of the expert's plan."""

    REACH = "move above the object"
    DESCEND = "come down around it"
    GRASP = "close the gripper"
    LIFT = "lift the object straight up"
    CARRY = "move above the container"
    LOWER = "lower the object into it"
    RELEASE = "open the gripper"
    REST = "hold still"


class Step(NamedTuple):
    """One step of an episode."""

    observation: Observation  # before the action
    action: NDArray[np.float32]  # (4,)
    reward: float
    info: dict[str, Any]  # after the action
    stage: Stage


def expert_episode(env: PickPlaceEnv, task_id: int, seed: int, noise: float = EXPERT_NOISE) -> Iterator[Step]:
    """Runs an episode of the expert, step by step.

    Args:
        env: The environment, without wrappers.
        task_id: 0..299, or 1000..1479 for those by color and shape.
        seed: Seed of the scene, the drop point and the noise.
        noise: Standard deviation of the noise on the motions.

    Yields:
        The 30 steps.
    """
    observation, _ = env.reset(seed=seed, options={"task_id": task_id})
    # A stream of its own: the expert's draws must not repeat those of the scene.
    expert = Expert(env, np.random.default_rng((seed, 1)), noise)
    for _ in range(env.scene_config.episode_length):
        action = expert.act()
        next_observation, reward, _, _, info = env.step(action)
        yield Step(observation, action, reward, info, expert.stage)
        observation = next_observation


class Expert:
    """Acts in one episode of an environment, from the scene's privileged state. Each episode needs a new one.

    The stage is a function of the scene, so a slipped or misplaced object is simply picked again.

    Args:
        env: The environment, already reset.
        rng: Source of the drop point and of the noise.
        noise: Standard deviation of the Gaussian noise on the three motions; the gripper's command, which is
            binary, has none.
        target_object: Number of the object to pick, as in the environment's info. None: as the task says.
        target_container: Number of the container to place it in. None: as the task says.
    """

    def __init__(
        self,
        env: PickPlaceEnv,
        rng: np.random.Generator,
        noise: float = EXPERT_NOISE,
        target_object: int | None = None,
        target_container: int | None = None,
    ) -> None:
        self._scene = env.scene
        self._rng = rng
        self._noise = noise
        layout = self._scene.layout
        self._target = layout.target_object if target_object is None else target_object
        self._container = layout.target_container if target_container is None else target_container
        self._grasp_height = layout.objects[self._target].model.grasp_height
        middle = layout.containers[self._container].quadrant.container_center
        spread = _DROP_SHARE * np.array(CONTAINER_HALF_EXTENTS)
        self._drop_xy = rng.uniform(middle - spread, middle + spread)
        self._rest: NDArray[np.float64] | None = None
        self.stage = Stage.REACH

    def act(self) -> NDArray[np.float32]:
        """The next action, (4,) in [-1, 1], noise included."""
        gripper = self._scene.arm.position
        self.stage, goal, command = self._plan(gripper)
        motion = np.clip((goal - gripper) / ACTION_SCALE, -1, 1)
        if self.stage is Stage.CARRY:
            motion *= min(1.0, _CARRY_SPEED / np.linalg.norm(motion))
        motion += self._rng.normal(0, self._noise, 3)
        return np.clip([*motion, command], -1, 1).astype(np.float32)

    def _plan(self, gripper: NDArray[np.float64]) -> tuple[Stage, NDArray[np.float64], float]:
        """The stage, where the end effector shall go, (3,), m, and the gripper's command."""
        scene = self._scene
        if scene.arm.is_open and scene.container_around(self._target) == self._container:
            if self._rest is None:
                self._rest = gripper + [0, 0, _RETREAT]
            return Stage.REST, self._rest, OPEN
        self._rest = None
        if scene.is_grasped(self._target):
            return self._plan_place(gripper)
        return self._plan_pick(gripper)

    def _plan_pick(self, gripper: NDArray[np.float64]) -> tuple[Stage, NDArray[np.float64], float]:
        item = self._scene.object_pose(self._target).position
        bottom, top = self._scene.object_span(self._target)
        tip_z = max(
            bottom + min(self._grasp_height, top - bottom - _PAD_HEIGHT) - _PAD_HEIGHT,
            TRAY_FLOOR + _TIP_CLEARANCE,
        )
        grasp = np.array([*item[:2], max(tip_z + FINGERTIP_OFFSET, top + _PALM_CLEARANCE)])
        error = np.abs(grasp - gripper)
        if (error < _AROUND).all() and self._scene.arm.is_open:
            return Stage.GRASP, grasp, CLOSED
        is_low = gripper[2] < grasp[2] + _AROUND[2]
        if (error[:2] < (_STRADDLING if is_low else _ALIGNED)).all():
            return Stage.DESCEND, grasp, OPEN
        return Stage.REACH, np.array([*item[:2], _HOVER_Z]), OPEN

    def _plan_place(self, gripper: NDArray[np.float64]) -> tuple[Stage, NDArray[np.float64], float]:
        bottom, _ = self._scene.object_span(self._target)
        carry_z = gripper[2] + TRAY_FLOOR + _CARRY_CLEARANCE - bottom
        release_z = gripper[2] + CONTAINER_FLOOR + _RELEASE_CLEARANCE - bottom
        if (np.abs(self._drop_xy - gripper[:2]) < _OVER_CONTAINER).all():
            if gripper[2] - release_z < _RELEASE_TOLERANCE:
                return Stage.RELEASE, gripper, OPEN
            return Stage.LOWER, np.array([*self._drop_xy, release_z]), CLOSED
        if bottom < TRAY_FLOOR + _LIFTED_CLEARANCE:
            return Stage.LIFT, np.array([*gripper[:2], carry_z]), CLOSED
        return Stage.CARRY, np.array([*self._drop_xy, carry_z]), CLOSED
