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

# Heights, distances and errors in m. Heights of the gripper are those of the end effector; the fingertips are
# 0.05 m lower.
_HOVER_Z = -0.215  # height of the gripper at which its fingertips pass above every object
_ALIGNED = np.array([0.013, 0.012])  # largest error in x and y at which the gripper starts to descend
_STRADDLING = np.array([0.02, 0.03])  # largest error in x and y once the gripper is down
_AROUND = np.array([0.02, 0.014, 0.015])  # largest error in x, y and z at which it closes
_PAD_HEIGHT = 0.010  # center of the finger pads above the fingertips
_TIP_CLEARANCE = 0.004  # fingertips above the tray
_PALM_CLEARANCE = 0.012  # end effector above the object's top
_CARRY_CLEARANCE = 0.085  # lowest point of a carried object above the tray
_LIFTED_CLEARANCE = 0.06  # lowest point of an object above the tray from which on it is carried
_CARRY_SPEED = 0.8  # largest norm of the action while carrying; at full diagonal speed, the object would slip
_DROP_FRACTION = 0.3  # of the container's half extents, within which the drop point is drawn
_OVER_CONTAINER = np.array([0.035, 0.022])  # largest error in x and y at which the object is lowered
_RELEASE_CLEARANCE = 0.012  # lowest point of the object above the container's floor at the release
_RELEASE_TOLERANCE = 0.025  # largest error in z at the release
_RETREAT = 0.05  # motion of the gripper upwards after the release


class Stage(Enum):
    """Stage of the expert's plan."""

    REACH = "move above the object"
    DESCEND = "descend around it"
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
        task_id: Index of the task, 0..299, or 1000..1479 for tasks by color and shape.
        seed: Seed of the scene, the drop point and the noise.
        noise: Standard deviation of the noise on the first three numbers of the actions.

    Yields:
        Each step of the episode.
    """
    observation, _ = env.reset(seed=seed, options={"task_id": task_id})
    # The expert's draws must not repeat those of the scene.
    expert = Expert(env, np.random.default_rng((seed, 1)), noise)
    for _ in range(env.scene_config.episode_length):
        action = expert.act()
        next_observation, reward, _, _, info = env.step(action)
        yield Step(observation, action, reward, info, expert.stage)
        observation = next_observation


class Expert:
    """Policy for one episode that reads the privileged state of the scene.

    The stage is a function of the scene, so that the expert picks a slipped or misplaced object again. Make a
    new expert for each episode.

    Args:
        env: Environment, already reset.
        rng: Source of the drop point and of the noise.
        noise: Standard deviation of the Gaussian noise on the first three numbers of the actions; the binary
            command of the gripper has no noise.
        target_object: Number of the object to pick, as in the environment's info; None for the task's target.
        target_container: Number of the container to place it in; None for the task's target.
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
        spread = _DROP_FRACTION * np.array(CONTAINER_HALF_EXTENTS)
        self._drop_xy = rng.uniform(middle - spread, middle + spread)
        self._rest: NDArray[np.float64] | None = None
        self.stage = Stage.REACH

    def act(self) -> NDArray[np.float32]:
        """Returns the next action, (4,) in [-1, 1], with noise."""
        gripper = self._scene.arm.position
        self.stage, goal, command = self._plan(gripper)
        motion = np.clip((goal - gripper) / ACTION_SCALE, -1, 1)
        if self.stage is Stage.CARRY:
            motion *= min(1.0, _CARRY_SPEED / np.linalg.norm(motion))
        motion += self._rng.normal(0, self._noise, 3)
        return np.clip([*motion, command], -1, 1).astype(np.float32)

    def _plan(self, gripper: NDArray[np.float64]) -> tuple[Stage, NDArray[np.float64], float]:
        """Returns the stage, the target of the end effector, (3,), m, and the gripper's command."""
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
