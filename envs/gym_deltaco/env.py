"""The gymnasium environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, get_args

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from gym_deltaco import CONTROL_FPS, MIN_IMAGE_SIZE
from gym_deltaco import kinematics as kin
from gym_deltaco.instructions import check_instructions, check_tasks
from gym_deltaco.layout import AMBIGUITIES, Ambiguity, sample_layout
from gym_deltaco.object_sets import (
    ADVERSARIAL_PROBABILITY,
    AdversarialDraw,
    check_scenes,
    check_task,
    select_objects,
)
from gym_deltaco.scene import Scene
from gym_deltaco.simulation import Simulation
from gym_deltaco.tasks import Task, get_task

ACTION_SCALE = 0.1  # m of the end effector's motion for an action of 1

# Of `agent_pos`: joints are given within half a turn of the rest position; 0.001 is for rounding.
_STATE_LOW = np.array([*(kin.REST_JOINTS - np.pi), *(kin.SHOULDER - kin.REACH), 0.0]) - 1e-3
_STATE_HIGH = np.array([*(kin.REST_JOINTS + np.pi), *(kin.SHOULDER + kin.REACH), 1.0]) + 1e-3

Observation = dict[str, NDArray[Any]]


class PickPlaceEnv(gym.Env[Observation, NDArray[np.float32]]):
    """A WidowX 250 puts one of three objects into one of two containers, as an instruction says.

    The task is one of the 300 of `gym_deltaco.tasks`. Every reset draws a new scene.

    ## Observation

    | key         | shape     | dtype   | what                                                               |
    |-------------|-----------|---------|--------------------------------------------------------------------|
    | `pixels`    | (H, W, 3) | uint8   | RGB of the front camera, H = W = `image_size`                      |
    | `agent_pos` | (10,)     | float32 | 6 joints (rad), end effector's x, y, z (m), gripper (1 open)       |

    ## Action

    | number | range   | what                                                                             |
    |--------|---------|----------------------------------------------------------------------------------|
    | 0..2   | -1 .. 1 | change of the end effector's position in x, y, z, in units of 0.1 m              |
    | 3      | -1 .. 1 | the gripper: above 0 open, else closed                                           |

    A step is 10 physics steps of 1/240 s, or 75 when the gripper opens or closes. An episode has 30 steps
    and is then truncated; it never terminates. The end effector stays within x .4..0.8, y -.2..0.4 and
    z -.34..-.1 m.

    ## Reward and success

    The reward is 1 once the task has succeeded, else 0. It succeeds at a step at which the target object,
    released and at rest, lies in the target container: its middle within the container's half extents, low
    enough to stand on its floor.

    ## Info

    Of every reset and step; objects and containers are numbered as they are in the scene, -1 is none.

    | key                   | what                                                                         |
    |-----------------------|------------------------------------------------------------------------------|
    | `is_success`          | whether the task has succeeded in this episode                               |
    | `task_id`             | index of the task, 0..299, or 1000..1479 for those by color and shape        |
    | `objects`             | (3,) int64: indices of the objects in the scene; 0..31 are the paper's       |
    | `object_containers`   | (3,) int64: the container in which each of them lies: 0 green, 1 red         |
    | `container_quadrants` | (2, 2) int64: i (0 right, 1 left) and j (0 back, 1 front) of both            |
    | `target_object`       | number of the object that the task asks for                                  |
    | `target_container`    | number of the container that the task asks for                               |
    | `grasped_object`      | number of the object that the gripper has held last                          |
    | `right_object`        | whether that one is the target                                               |
    | `right_container`     | whether something lies in the target container, and nothing in the other one |

    Args:
        task_id: 0..299, or 1000..1479 for those by color and shape. `reset(options={"task_id": ...})`
            changes it from then on.
        ambiguity: "container", the paper's scheme (i), or "object", scheme (ii).
        image_size: Height and width of `pixels`, at least 8.
        render_mode: "rgb_array" or None.
        render_size: Height and width of what `render` returns, for people to look at.
        objects: Name of the set of objects that scenes are made of: "all", as in the paper;
            "scenario_a_train", without the 8 test objects; or "random:N" (`gym_deltaco.object_sets`).
        adversarial_probability: Probability that a distractor is drawn from the objects that share the
            target's color or shape, 0..1; 0.6 as in the paper's data, 0 for uniform draws.
        adversarial_draw: Scope of a draw with that probability: "each", one distractor; or "scene", both
            distractors of a scene, as in the authors' code.
        instructions: Sentences of each task, as `gym_deltaco.instructions.read_instructions` gives them. The
            `task_description` of an episode is then one of its task's, drawn by the episode's seed; the scene
            stays the same. By default, it is the benchmark's template.

    Raises:
        ValueError: An argument is out of its range; the message says what is valid.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": CONTROL_FPS}

    def __init__(
        self,
        task_id: int = 0,
        ambiguity: Ambiguity = "container",
        image_size: int = 48,
        render_mode: str | None = None,
        render_size: int = 256,
        objects: str = "all",
        adversarial_probability: float = ADVERSARIAL_PROBABILITY,
        adversarial_draw: AdversarialDraw = "each",
        instructions: Mapping[int, Sequence[str]] | None = None,
    ) -> None:
        check_scenes([task_id], objects, adversarial_probability, adversarial_draw)
        self.objects = objects
        self.task: Task = get_task(task_id)
        if ambiguity not in AMBIGUITIES:
            raise ValueError(
                f"`ambiguity` must be one of {', '.join(get_args(Ambiguity))}. Got {ambiguity!r}."
            )
        for name, size in (("image_size", image_size), ("render_size", render_size)):
            if not isinstance(size, (int, np.integer)):
                raise ValueError(f"`{name}` must be an integer. Got {size!r}.")
            if size < MIN_IMAGE_SIZE:
                raise ValueError(f"`{name}` must be at least {MIN_IMAGE_SIZE}. Got {size}.")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"`render_mode` must be 'rgb_array' or None. Got {render_mode!r}.")
        if instructions is not None:
            check_instructions(instructions)
        self.ambiguity: Ambiguity = ambiguity
        self.adversarial_probability = adversarial_probability
        self.adversarial_draw: AdversarialDraw = adversarial_draw
        self.image_size = image_size
        self.render_mode = render_mode
        self.render_size = render_size
        self.instructions = instructions
        self._instruction: str | None = None  # of the current episode; None is the task's template
        self.observation_space: gym.Space[Any] = spaces.Dict(
            {
                "pixels": spaces.Box(0, 255, (image_size, image_size, 3), np.uint8),
                "agent_pos": spaces.Box(
                    _STATE_LOW.astype(np.float32), _STATE_HIGH.astype(np.float32), dtype=np.float32
                ),
            }
        )
        self.action_space = spaces.Box(-1.0, 1.0, (4,), np.float32)
        # The simulator is connected at the first reset, so that a worker process has its own.
        self._simulation: Simulation | None = None
        self._scene: Scene | None = None
        self._is_closed = False
        self._is_success = False
        self._grasped_object = -1

    @property
    def task_description(self) -> str:
        """The instruction, such as "Put blue colored object in front bin."."""
        return self.task.instruction if self._instruction is None else self._instruction

    @property
    def scene(self) -> Scene:
        """The current scene, with its privileged state.

        Raises:
            gymnasium.error.ResetNeeded: There is none yet.
            gymnasium.error.ClosedEnvironmentError: The environment is closed.
        """
        self._check_open()
        if self._scene is None:
            raise gym.error.ResetNeeded("Call `reset` before `step` or `render`.")
        return self._scene

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Draws and builds a new scene.

        Args:
            seed: Seed of `np_random`; None continues its draws.
            options: "task_id": the task of this and the following episodes, 0..299, or 1000..1479 for those
                by color and shape. Others are for wrappers.

        Returns:
            The first observation and info.

        Raises:
            ValueError: There is no such task, the objects do not allow it, or `options` is no dictionary.
            InstructionsError: The environment has `instructions`, but none for the task.
            gymnasium.error.ClosedEnvironmentError: The environment is closed.
        """
        self._check_open()
        if options is not None and not isinstance(options, Mapping):
            raise ValueError(
                f'`options` must be a dictionary, such as {{"task_id": 4}}, or None. Got {options!r}.'
            )
        task = get_task((options or {}).get("task_id", self.task.index))
        check_task(task, self.objects)
        if self.instructions is not None:
            check_tasks(self.instructions, [task.index], "The environment")
        super().reset(seed=seed)
        # An interrupted reset leaves no scene, rather than half of one.
        self.task, self._scene, self._instruction = task, None, None
        if self._simulation is None:
            self._simulation = Simulation()
        labels = select_objects(self.objects)
        layout = sample_layout(
            self.task,
            self.ambiguity,
            self.np_random,
            labels,
            self.adversarial_probability,
            self.adversarial_draw,
        )
        self._scene = Scene(self._simulation, layout)
        self._is_success = False
        self._grasped_object = -1
        if self.instructions is not None:
            # A generator of its own, so that scenes are the same with and without.
            (rng,) = self.np_random.spawn(1)
            sentences = self.instructions[task.index]
            self._instruction = sentences[int(rng.integers(len(sentences)))]
        return self._observation(), self._info()

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Moves the arm.

        Args:
            action: (4,) in [-1, 1]; what lies beyond is clipped.

        Returns:
            Observation, reward (1.0 once the task has succeeded), terminated (False), truncated (False: the
            30 steps are counted by gymnasium's `TimeLimit`), info.

        Raises:
            ValueError: The action has another shape, or a number that is not finite. The scene is unchanged.
        """
        scene = self.scene
        motion, gripper = np.split(_validated(action), [3])
        scene.command(scene.arm.position + ACTION_SCALE * motion, is_open=bool(gripper[0] > 0))
        for index in range(len(scene.bodies)):
            if scene.is_grasped(index):
                self._grasped_object = index
        info = self._info()
        return self._observation(), float(info["is_success"]), False, False, info

    def render(self) -> NDArray[np.uint8] | None:
        """The scene for people, (render_size, render_size, 3), or None without a render mode."""
        return None if self.render_mode is None else self.scene.render(self.render_size)

    def close(self) -> None:
        """Frees the simulator. Closing twice is harmless."""
        self._is_closed = True
        self._scene = None
        if self._simulation is not None:
            self._simulation.close()
            self._simulation = None

    def _check_open(self) -> None:
        if self._is_closed:
            raise gym.error.ClosedEnvironmentError(
                "The environment is closed. Make a new one with `gymnasium.make`."
            )

    def _observation(self) -> Observation:
        arm = self.scene.arm
        # The waist may turn around the base again and again, and the wrist with it.
        joints = (arm.joints - kin.REST_JOINTS + np.pi) % (2 * np.pi) - np.pi + kin.REST_JOINTS
        state = np.concatenate([joints, arm.position, [arm.is_open]])
        return {"pixels": self.scene.render(self.image_size), "agent_pos": state.astype(np.float32)}

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


def _validated(action: NDArray[np.float32]) -> NDArray[np.float64]:
    values = np.asarray(action, dtype=np.float64)
    if values.shape != (4,):
        raise ValueError(f"An action must have shape (4,): x, y, z and the gripper. Got {values.shape}.")
    if not np.isfinite(values).all():
        raise ValueError(f"An action must be finite. Got {values}.")
    return np.clip(values, -1.0, 1.0)
