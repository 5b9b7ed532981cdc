"""The scripted expert: picks the target object and places it in the target container (paper, algorithm 3)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gym_deltaco import EXPERT_NOISE
from gym_deltaco.env import ACTION_SCALE, Observation, PickPlaceEnv
from gym_deltaco.robot.arm import FINGER_OPEN, FINGER_THICKNESS, FINGERTIP_OFFSET, POSITION_HIGH, POSITION_LOW
from gym_deltaco.robot.kinematics import inverse
from gym_deltaco.scene import Scene
from gym_deltaco.scene_config import DEFAULT_SCENE, SceneConfig
from gym_deltaco.seeding import episode_seed
from gym_deltaco.sim.workspace import (
    CONTAINER_FLOOR,
    CONTAINER_HALF_EXTENTS,
    TRAY_CENTER,
    TRAY_FLOOR,
    TRAY_HALF_EXTENTS,
    TRAY_WALL_THICKNESS,
)


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


OPEN, CLOSED = 1.0, -1.0
_MAX_ATTEMPTS = 20  # at a demonstration

# Heights, distances and errors in m. Heights of the gripper are those of the end effector; the fingertips are
# 0.05 m lower.
_HOVER_Z = -0.215  # height of the gripper at which its fingertips pass above every object
_DESCEND_TOLERANCE = np.array([0.013, 0.012])  # largest error in x and y at which the descent begins
_STRADDLE_TOLERANCE = np.array([0.02, 0.03])  # largest error in x and y once the gripper is down
_GRASP_TOLERANCE = np.array([0.02, 0.014, 0.015])  # largest error in x, y and z at which it closes
_PAD_HEIGHT = 0.010  # center of the finger pads above the fingertips
_TIP_CLEARANCE = 0.004  # fingertips above the tray
_PALM_CLEARANCE = 0.012  # end effector above the object's top
_CARRY_CLEARANCE = 0.085  # lowest point of a carried object above the tray
_LIFTED_CLEARANCE = 0.06  # lowest point of an object above the tray from which on it is carried
_CARRY_SPEED = 0.8  # largest norm of the action while carrying; at full diagonal speed, the object would slip
_DROP_FRACTION = 0.3  # of the container's half extents, within which the drop point is drawn
_LOWER_TOLERANCE = np.array([0.035, 0.022])  # largest error in x and y at which the object is lowered
_RELEASE_CLEARANCE = 0.012  # lowest point of the object above the container's floor at the release
_RELEASE_TOLERANCE = 0.025  # largest error in z at the release
_RETREAT = 0.05  # motion of the gripper upwards after the release

# With joint control. The values of an episode are drawn from these ranges.
_SPEED = (0.16, 0.42)  # m/s, of the end effector
_ACCELERATION = (0.8, 1.6)  # m/s²
_GRIPPER_SPEED = (1.3, 2.5)  # openings/s
_SPEED_FACTORS = {Stage.DESCEND: 0.6, Stage.LOWER: 0.6, Stage.CARRY: 0.85}  # fraction of the speed
_FIRST_PAUSE, _LAST_PAUSE = (0, 12), (5, 20)  # steps before the first motion, and after the success
_N_PAUSES = 0.8  # mean number of other pauses
_PAUSE_START, _PAUSE = (12, 120), (8, 36)  # steps
_GRIPPER_WAIT = 2  # steps after the gripper's command has reached its end
# m, largest distance from the tray's middle in x at which the open fingers are between its walls
_MAX_X_OFFSET = TRAY_HALF_EXTENTS[0] - TRAY_WALL_THICKNESS - FINGER_OPEN - FINGER_THICKNESS - 0.002
_JOINT_NOISE = 0.04  # rad, for a noise of 1
_NOISE_DECAY = 0.9  # of the noise on the joints, in a step


class Step(NamedTuple):
    """One step of an episode."""

    observation: Observation  # before the action
    action: NDArray[np.float32]  # (4,), or (7,) with joint control
    reward: float
    info: dict[str, Any]  # after the action
    stage: Stage


def expert_episode(env: PickPlaceEnv, task_id: int, seed: int, noise: float = EXPERT_NOISE) -> Iterator[Step]:
    """Runs an episode of the expert, step by step.

    Args:
        env: The environment, without wrappers.
        task_id: Index of the task.
        seed: Seed of the scene, the drop point and the noise.
        noise: Standard deviation of the noise on the first three numbers of the actions; with joint control,
            that on joints in units of 0.04 rad.

    Yields:
        Each step of the episode. With joint control, it ends shortly after its success.
    """
    observation, _ = env.reset(seed=seed, options={"task_id": task_id})
    # The expert's draws must not repeat those of the scene.
    kind = JointExpert if env.scene_config.control == "joints" else Expert
    expert = kind(env, np.random.default_rng((seed, 1)), noise)
    for _ in range(env.scene_config.n_steps):
        if expert.is_done:
            break
        action = expert.act()
        next_observation, reward, _, _, info = env.step(action)
        yield Step(observation, action, reward, info, expert.stage)
        observation = next_observation


def record_demonstration(task_id: int, number: int = 0, scene: SceneConfig = DEFAULT_SCENE) -> list[Step]:
    """Returns a successful episode of the expert, in a scene that no evaluation has.

    Args:
        task_id: Index of the task, as in `gym_deltaco.tasks`.
        number: Number of the demonstration. 0 is the one that the protocol gives: the task's first episode
            for validation.
        scene: Settings of the scene.

    Raises:
        RuntimeError: The expert has failed too often.
    """
    env = PickPlaceEnv(task_id, scene)
    try:
        for attempt in range(_MAX_ATTEMPTS):
            steps = list(
                expert_episode(env, task_id, episode_seed(0, "validation", task_id, number, attempt))
            )
            if steps[-1].info["is_success"]:
                return steps
    finally:
        env.close()
    raise RuntimeError(f"The expert failed {_MAX_ATTEMPTS} times at: {env.task.instruction}")


def grasp_position(scene: Scene, index: int) -> NDArray[np.float64]:
    """Returns the position of the end effector at which the expert grasps an object, (3,), m."""
    xy, (bottom, top) = scene.object_pose(index).position[:2], scene.object_span(index)
    height = scene.layout.objects[index].model.grasp_height
    tip_z = max(
        bottom + min(height, top - bottom - _PAD_HEIGHT) - _PAD_HEIGHT,
        TRAY_FLOOR + _TIP_CLEARANCE,
    )
    return np.array([*xy, max(tip_z + FINGERTIP_OFFSET, top + _PALM_CLEARANCE)])


def target_positions(scene: Scene) -> NDArray[np.float64]:
    """Returns where the end effector grasps and releases the target of a scene, (2, 3), m.

    The release is above the middle of the target container.
    """
    layout = scene.layout
    grasp = grasp_position(scene, layout.target_object)
    bottom, _ = scene.object_span(layout.target_object)
    middle = layout.containers[layout.target_container].quadrant.container_center
    release_z = grasp[2] + CONTAINER_FLOOR + _RELEASE_CLEARANCE - bottom
    return np.array([grasp, [*middle, release_z]])


@dataclass(eq=False)
class Expert:
    """Policy for one episode that reads the privileged state of the scene.

    The stage is a function of the scene, so that the expert picks a slipped or misplaced object again. Make a
    new expert for each episode.

    Args:
        env: Environment, already reset.
        rng: Source of the drop point and of the noise.
        noise: Standard deviation of the Gaussian noise on the first three numbers of the actions; the binary
            command of the gripper has no noise.
        goals: Positions of the end effector at the grasp and at the release, (2, 3), m. With them, the expert
            grasps there, whatever stands there, and releases what it holds there; by default, it puts the
            target into its container.

    Attributes:
        stage: Stage of the last action.
        is_done: Whether the episode may end before its last step.
    """

    env: PickPlaceEnv
    rng: np.random.Generator
    noise: float = EXPERT_NOISE
    goals: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        self._scene = self.env.scene
        layout = self._scene.layout
        self._target, self._container = layout.target_object, layout.target_container
        middle = layout.containers[self._container].quadrant.container_center
        spread = _DROP_FRACTION * np.array(CONTAINER_HALF_EXTENTS)
        self._drop_xy = self.rng.uniform(middle - spread, middle + spread)
        if self.goals is not None:
            self._drop_xy = self.goals[1, :2]
        self._rest: NDArray[np.float64] | None = None
        self.stage = Stage.REACH
        self.is_done = False

    def act(self) -> NDArray[np.float32]:
        """Returns the next action, (4,) in [-1, 1], with noise."""
        gripper = self._scene.arm.position
        self.stage, goal, command = self._plan(gripper)
        motion = np.clip((goal - gripper) / ACTION_SCALE, -1, 1)
        if self.stage is Stage.CARRY:
            motion *= min(1.0, _CARRY_SPEED / np.linalg.norm(motion))
        motion += self.rng.normal(0, self.noise, 3)
        return np.clip([*motion, command], -1, 1).astype(np.float32)

    def _plan(self, gripper: NDArray[np.float64]) -> tuple[Stage, NDArray[np.float64], float]:
        """Returns the stage, the target of the end effector, (3,), m, and the gripper's command."""
        scene = self._scene
        if scene.arm.is_open and self._has_placed():
            if self._rest is None:
                self._rest = gripper + [0, 0, _RETREAT]
            return Stage.REST, self._rest, OPEN
        self._rest = None
        held = self._target if self.goals is None else scene.held_object
        if held >= 0 and scene.is_grasped(held):
            return self._plan_place(gripper, held)
        return self._plan_pick(gripper)

    def _has_placed(self) -> bool:
        if self.goals is not None:
            return self.stage in (Stage.RELEASE, Stage.REST)
        return self._scene.container_around(self._target) == self._container

    def _plan_pick(self, gripper: NDArray[np.float64]) -> tuple[Stage, NDArray[np.float64], float]:
        grasp = grasp_position(self._scene, self._target) if self.goals is None else self.goals[0]
        error = np.abs(grasp - gripper)
        if (error < _GRASP_TOLERANCE).all() and self._scene.arm.is_open:
            return Stage.GRASP, grasp, CLOSED
        is_low = gripper[2] < grasp[2] + _GRASP_TOLERANCE[2]
        if (error[:2] < (_STRADDLE_TOLERANCE if is_low else _DESCEND_TOLERANCE)).all():
            return Stage.DESCEND, grasp, OPEN
        return Stage.REACH, np.array([*grasp[:2], _HOVER_Z]), OPEN

    def _plan_place(
        self, gripper: NDArray[np.float64], held: int
    ) -> tuple[Stage, NDArray[np.float64], float]:
        bottom, _ = self._scene.object_span(held)
        carry_z = gripper[2] + TRAY_FLOOR + _CARRY_CLEARANCE - bottom
        release_z = gripper[2] + CONTAINER_FLOOR + _RELEASE_CLEARANCE - bottom
        if (np.abs(self._drop_xy - gripper[:2]) < _LOWER_TOLERANCE).all():
            if gripper[2] - release_z < _RELEASE_TOLERANCE:
                return Stage.RELEASE, gripper, OPEN
            return Stage.LOWER, np.array([*self._drop_xy, release_z]), CLOSED
        if bottom < TRAY_FLOOR + _LIFTED_CLEARANCE:
            return Stage.LIFT, np.array([*gripper[:2], carry_z]), CLOSED
        return Stage.CARRY, np.array([*self._drop_xy, carry_z]), CLOSED


class JointExpert(Expert):
    """The expert with joint control: smooth motion at a speed drawn for the episode, with pauses.

    The end effector accelerates and brakes evenly towards the goal of each stage, and stands still while the
    gripper closes or opens. The joints' targets have correlated noise, whose standard deviation is `noise` in
    units of 0.04 rad.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        rng = self.rng
        self._step_time = 1 / self.env.scene_config.interface.fps
        self._speed, self._acceleration, gripper_speed = (
            rng.uniform(*limits) for limits in (_SPEED, _ACCELERATION, _GRIPPER_SPEED)
        )
        self._gripper_step = gripper_speed * self._step_time
        starts = rng.integers(*_PAUSE_START, rng.poisson(_N_PAUSES))
        self._pauses = [(0, rng.integers(*_FIRST_PAUSE))]
        self._pauses += [(start, start + rng.integers(*_PAUSE)) for start in starts]
        self._steps_left = int(rng.integers(*_LAST_PAUSE))  # after the success
        self._n_steps = 0
        self._position = self._goal = self._scene.arm.position
        self._velocity = np.zeros(3)
        self._joints = self._scene.arm.joints
        self._joint_noise = np.zeros(len(self._joints))
        self._opening, self._command, self._wait = 1.0, OPEN, 0

    def act(self) -> NDArray[np.float32]:
        """Returns the next action, (7,): targets of the joints, rad, with noise, and of the gripper, 0..1."""
        is_paused = any(start <= self._n_steps < end for start, end in self._pauses)
        self._n_steps += 1
        if not is_paused:
            self._advance()
        if self._scene.container_of(self._target) == self._container:
            self._steps_left -= 1
            self.is_done = self._steps_left < 0
        # A pause brakes, too.
        self._move(self._position if is_paused or self._wait else self._goal)
        self._joints = inverse(self._position, near=self._joints)
        fresh = self.rng.normal(0, self.noise * _JOINT_NOISE, len(self._joints))
        self._joint_noise = _NOISE_DECAY * self._joint_noise + np.sqrt(1 - _NOISE_DECAY**2) * fresh
        return np.array([*(self._joints + self._joint_noise), self._opening], dtype=np.float32)

    def _advance(self) -> None:
        """Plans, or waits for the gripper."""
        end = float(self._command == OPEN)
        self._opening += float(np.clip(end - self._opening, -self._gripper_step, self._gripper_step))
        if self._wait:
            self._wait -= self._opening == end
            return
        self.stage, goal, command = self._plan(self._scene.arm.position)
        self._goal = np.clip(goal, POSITION_LOW, POSITION_HIGH)
        self._goal[0] = TRAY_CENTER[0] + np.clip(goal[0] - TRAY_CENTER[0], -_MAX_X_OFFSET, _MAX_X_OFFSET)
        if command != self._command:
            self._command, self._wait = command, _GRIPPER_WAIT

    def _move(self, goal: NDArray[np.float64]) -> None:
        """Moves the commanded position towards a goal for one step."""
        offset = goal - self._position
        distance = float(np.linalg.norm(offset))
        speed = min(
            self._speed * _SPEED_FACTORS.get(self.stage, 1.0),
            np.sqrt(2 * self._acceleration * distance),
            0.5 * distance / self._step_time,
        )
        change = offset * speed / max(distance, 1e-9) - self._velocity
        largest = self._acceleration * self._step_time
        self._velocity = self._velocity + change * min(
            1.0, largest / max(float(np.linalg.norm(change)), 1e-9)
        )
        self._position = self._position + self._velocity * self._step_time
