"""The gymnasium environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from gym_deltaco import CONTROL_FPS
from gym_deltaco.control import CONTROLS
from gym_deltaco.layout import sample_layout
from gym_deltaco.robot import kinematics as kin
from gym_deltaco.robot.arm import JOINT_HIGH, JOINT_LOW
from gym_deltaco.scene import Scene
from gym_deltaco.scene_config import DEFAULT_SCENE, MAX_IMAGE_SIZE, MIN_IMAGE_SIZE, SceneConfig
from gym_deltaco.sim.simulation import Simulation, check_simulator
from gym_deltaco.tasks import Task, get_task

ACTION_SCALE = 0.1  # m, motion of the end effector for an action of 1
STATE_NAMES = CONTROLS["position"].state_names
ACTION_NAMES = CONTROLS["position"].action_names
N_JOINTS = 6  # whose angles come first in the state

# Bounds of `agent_pos`. With control "position", joints are within half a turn of their rest position, and
# 0.001 allows for rounding; with "joints", motors overshoot a little.
_STATE_BOUNDS = {
    "position": (
        np.array([*(kin.REST_JOINTS - np.pi), *(kin.SHOULDER - kin.REACH), 0.0]) - 1e-3,
        np.array([*(kin.REST_JOINTS + np.pi), *(kin.SHOULDER + kin.REACH), 1.0]) + 1e-3,
    ),
    "joints": (np.array([*JOINT_LOW, 0.0]) - 0.1, np.array([*JOINT_HIGH, 1.0]) + 0.1),
}
_ACTION_BOUNDS = {
    "position": (np.full(len(ACTION_NAMES), -1.0), np.full(len(ACTION_NAMES), 1.0)),
    "joints": (np.array([*JOINT_LOW, 0.0]), np.array([*JOINT_HIGH, 1.0])),
}

Observation = dict[str, Any]


class PickPlaceEnv(gym.Env[Observation, NDArray[np.float32]]):
    """A WidowX 250 puts one of three objects into one of two containers, following an instruction.

    The tasks are those of `gym_deltaco.tasks`. Every reset draws a new scene.

    ## Observation

    | key         | shape     | dtype   | meaning                                                            |
    |-------------|-----------|---------|--------------------------------------------------------------------|
    | `pixels`    | (H, W, 3) | uint8   | RGB image of the front camera, H = W = `scene.image_size`          |
    | `agent_pos` | (10,)     | float32 | 6 joint angles (rad), end effector's x, y, z (m), gripper (1 open) |

    `STATE_NAMES` names the numbers of `agent_pos`.

    ## Action

    | number | range   | meaning                                                                          |
    |--------|---------|----------------------------------------------------------------------------------|
    | 0..2   | -1 .. 1 | change of the end effector's position in x, y, z, in units of 0.1 m              |
    | 3      | -1 .. 1 | gripper: open above 0, else closed                                               |

    `ACTION_NAMES` names them. The end effector stays within x 0.4..0.8, y -0.2..0.4 and z -0.34..-0.1 m, with
    the gripper pointing down.

    ## Time

    A step is 10 physics steps of 1/240 s, or 75 when the gripper opens or closes, so that the frame rate of
    24 Hz (`render_fps`, and the timestamps of datasets) is nominal. The arm is faster than a real one: the
    expert's joints turn at up to 16 rad/s, those of a WidowX 250 at about 3 rad/s. An episode is truncated
    after `scene.episode_length` steps; it never terminates.

    ## Joint control

    With `scene.control="joints"`, the arm is controlled as LeRobot's robots are:

    - `pixels` is a dictionary of two images: `front`, and `wrist` of a camera on the hand.
    - `agent_pos` (7,) are the measured angles of the joints (rad) and the measured opening of the gripper
      (0 closed, 1 open); an action (7,) are their targets, clipped to the joints' limits.
    - A step is 8 physics steps of 1/240 s (30 Hz, real time). Joints turn at 3 rad/s at most, and the gripper
      takes at least 0.4 s to open or close.
    - An episode has 240 steps (8 s) by default.
    - The gripper can point in any direction. Only the hand and the fingers collide.

    ## Reward and success

    The reward is 1 once the task has succeeded, else 0. The task succeeds at the first step after which the
    target object, released and at rest, lies in the target container: its center within the container's half
    extents in x and y, and low enough to stand on the container's floor.

    ## Info

    `reset` and `step` return the same keys. Objects and containers are numbered by their position in the
    scene; -1 means none.

    | key                   | meaning                                                                      |
    |-----------------------|------------------------------------------------------------------------------|
    | `is_success`          | whether the task has succeeded in this episode                               |
    | `task_id`             | index of the task                                                            |
    | `objects`             | (3,) int64: indices of the objects in the scene; 0..31 are the paper's       |
    | `object_containers`   | (3,) int64: container in which each object lies, 0 green, 1 red              |
    | `container_quadrants` | (2, 2) int64: i (0 right, 1 left) and j (0 back, 1 front) of both containers |
    | `target_object`       | number of the object that the task asks for                                  |
    | `target_container`    | number of the container that the task asks for                               |
    | `grasped_object`      | number of the object that the gripper held last                              |
    | `right_object`        | whether the grasped object is the target                                     |
    | `right_container`     | whether an object lies in the target container, and none in the other one    |

    Args:
        task_id: Index of the task. `reset(options={"task_id": ...})` changes it from then on.
        scene: Settings of the scenes: ambiguity scheme, objects, image size, episode length, ...
        render_mode: "rgb_array" or None.
        render_size: Height and width of the images that `render` returns, 8..4096 px.
        instructions: Sentences of each task. The `task_description` of an episode is then one of its task's
            sentences, drawn by the episode's seed; the scene stays the same. By default, it is the
            template.

    Raises:
        ValueError: An argument is invalid; the message says what is valid.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": CONTROL_FPS}

    def __init__(
        self,
        task_id: int = 0,
        scene: SceneConfig = DEFAULT_SCENE,
        render_mode: str | None = None,
        render_size: int = 256,
        instructions: Mapping[int, Sequence[str]] | None = None,
    ) -> None:
        check_simulator()  # fails here, not at the first reset, if it is missing
        scene.check_tasks([task_id])
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"`render_mode` must be 'rgb_array' or None. Got {render_mode!r}.")
        if type(render_size) is not int or not MIN_IMAGE_SIZE <= render_size <= MAX_IMAGE_SIZE:
            raise ValueError(
                f"`render_size` must be an integer from {MIN_IMAGE_SIZE} to {MAX_IMAGE_SIZE}. "
                f"Got {render_size!r}."
            )
        self.task: Task = get_task(task_id)
        self.scene_config = scene
        self.render_mode = render_mode
        self.render_size = render_size
        self.instructions = instructions
        self._instruction: str | None = None  # of the current episode; None is the task's template
        self.metadata = {**self.metadata, "render_fps": scene.interface.fps}
        image = spaces.Box(0, 255, (scene.image_size, scene.image_size, 3), np.uint8)
        cameras = scene.interface.cameras
        self.observation_space: gym.Space[Any] = spaces.Dict(
            {
                "pixels": spaces.Dict(dict.fromkeys(cameras, image)) if cameras else image,
                "agent_pos": _box(_STATE_BOUNDS[scene.control]),
            }
        )
        self.action_space = _box(_ACTION_BOUNDS[scene.control])
        # The simulator is connected at the first reset, so that each worker process has its own.
        self._simulation: Simulation | None = None
        self._scene: Scene | None = None
        self._is_success = False
        self._grasped_object = -1
        self._n_steps = 0

    @property
    def _max_episode_steps(self) -> int:
        """Number of steps of an episode, where LeRobot's rollout looks for it."""
        return self.scene_config.n_steps

    @property
    def task_description(self) -> str:
        """The instruction, such as "Put blue colored object in front bin."."""
        return self.task.instruction if self._instruction is None else self._instruction

    @property
    def scene(self) -> Scene:
        """The current scene, with its privileged state.

        Raises:
            gymnasium.error.ResetNeeded: The environment was not reset, or has been closed.
        """
        if self._scene is None:
            raise gym.error.ResetNeeded("Call `reset` before `step` or `render`.")
        return self._scene

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Draws and builds a new scene.

        Args:
            seed: Seed of `np_random`; None continues its stream.
            options: "task_id": index of the task of this and the following episodes. Other keys are ignored.

        Returns:
            The first observation and info.

        Raises:
            ValueError: The task does not exist, or no object or instruction fits it. The current scene is
                kept.
        """
        task = get_task((options or {}).get("task_id", self.task.index))
        self.scene_config.check_tasks([task.index])
        if self.instructions is not None and task.index not in self.instructions:
            raise ValueError(
                f"`instructions` has no sentence for task {task.index} ({task.instruction!r}). Add one, or "
                "choose another task."
            )
        super().reset(seed=seed)
        # An interrupted reset leaves no scene, rather than half of one.
        self.task, self._scene, self._instruction = task, None, None
        if self._simulation is None:
            self._simulation = Simulation()
        self._scene = Scene(self._simulation, sample_layout(task, self.scene_config, self.np_random))
        self._is_success = False
        self._grasped_object = -1
        self._n_steps = 0
        if self.instructions is not None:
            # A separate generator keeps scenes the same with and without instructions.
            (rng,) = self.np_random.spawn(1)
            sentences = self.instructions[task.index]
            self._instruction = sentences[int(rng.integers(len(sentences)))]
        return self._observation(), self._info()

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Moves the arm.

        Args:
            action: Real numbers, (4,), or (7,) with joint control; clipped to the action space.

        Returns:
            Observation, reward (1.0 once the task has succeeded), terminated (False), truncated (True from
            the last step of the episode on), info.

        Raises:
            ValueError: The action has the wrong shape, or numbers that are not real or not finite. The scene
                is unchanged.
            gymnasium.error.ResetNeeded: The environment was not reset, or has been closed.
        """
        scene = self.scene
        *motion, gripper = self._checked_action(action)
        if self.scene_config.control == "joints":
            scene.command_joints(np.array(motion), gripper)
        else:
            scene.command(scene.arm.position + ACTION_SCALE * np.array(motion), is_open=bool(gripper > 0))
        self._n_steps += 1
        if (held := scene.held_object) >= 0:
            self._grasped_object = held
        info = self._info()
        is_truncated = self._n_steps >= self.scene_config.n_steps
        return self._observation(), float(info["is_success"]), False, is_truncated, info

    def render(self) -> NDArray[np.uint8] | None:
        """Returns an image of the scene, (render_size, render_size, 3) uint8; None without a render mode."""
        return None if self.render_mode is None else self.scene.render(self.render_size)

    def close(self) -> None:
        """Disconnects the simulator; a later `reset` starts another one. Closing twice is harmless."""
        self._scene = None
        if self._simulation is not None:
            self._simulation.close()
            self._simulation = None

    def _observation(self) -> Observation:
        scene, arm, size = self.scene, self.scene.arm, self.scene_config.image_size
        if self.scene_config.control == "joints":
            state = np.array([*arm.joints, arm.opening])
            pixels: Any = {"front": scene.render(size), "wrist": scene.render_wrist(size)}
        else:
            # The waist, and the wrist with it, may turn around the base any number of times.
            joints = (arm.joints - kin.REST_JOINTS + np.pi) % (2 * np.pi) - np.pi + kin.REST_JOINTS
            state = np.concatenate([joints, arm.position, [arm.is_open]])
            pixels = scene.render(size)
        return {"pixels": pixels, "agent_pos": state.astype(np.float32)}

    def _checked_action(self, action: NDArray[np.float32]) -> NDArray[np.float64]:
        """Checks an action and clips it to the action space."""
        low, high = _ACTION_BOUNDS[self.scene_config.control]
        values = np.asarray(action)
        if values.shape != low.shape:
            names = "x, y, z and gripper" if len(low) == len(ACTION_NAMES) else "6 joints and gripper"
            raise ValueError(f"An action must have shape {low.shape}: {names}. Got {values.shape}.")
        if values.dtype.kind not in "fiu" or not np.isfinite(values).all():
            raise ValueError(f"An action must consist of real, finite numbers. Got {action!r}.")
        return np.clip(values.astype(np.float64), low, high)

    def _info(self) -> dict[str, Any]:
        scene, layout = self.scene, self.scene.layout
        containers = np.array(
            [scene.container_of(index) for index in range(len(scene.bodies))], dtype=np.int64
        )
        target_object, target_container = layout.target_object, layout.target_container
        self._is_success |= bool(containers[target_object] == target_container)
        return {
            "is_success": self._is_success,
            "task_id": self.task.index,
            "objects": np.array([item.label.index for item in layout.objects], dtype=np.int64),
            "object_containers": containers,
            "container_quadrants": np.array([item.quadrant for item in layout.containers], dtype=np.int64),
            "target_object": target_object,
            "target_container": target_container,
            "grasped_object": self._grasped_object,
            "right_object": self._grasped_object == target_object,
            "right_container": bool(
                (containers == target_container).any() and not (containers == 1 - target_container).any()
            ),
        }


def _box(bounds: tuple[NDArray[np.float64], NDArray[np.float64]]) -> Any:
    low, high = bounds
    return spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)
