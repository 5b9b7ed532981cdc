"""Scenes, demonstrations and episodes of the page, without the page."""

from __future__ import annotations

import logging
import os
import random
import traceback
from collections.abc import Generator, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from gym_deltaco.sheets import caption, down, to_image
from lerobot.envs.utils import preprocess_observation
from numpy.typing import NDArray
from torch import Tensor

from gym_deltaco import CONTROL_FPS, EPISODE_STEPS
from gym_deltaco.env import PickPlaceEnv
from gym_deltaco.expert import expert_episode
from gym_deltaco.seeding import episode_seed
from gym_deltaco.tasks import CONTAINER_COLORS, OBJECTS, TASKS, Task, get_task
from lerobot_deltaco.evaluation.checkpoint_policy import load_policy
from lerobot_deltaco.evaluation.episodes import counterfactual_task
from lerobot_deltaco.evaluation.explanation import draw_explanation
from lerobot_deltaco.modeling_deltaco import DeltacoPolicy
from lerobot_deltaco.play.demonstrations import (
    Demonstration,
    check_number,
    demonstration_of,
    stored_demonstration,
)
from lerobot_deltaco.play.errors import PlayError
from lerobot_deltaco.play.modalities import BOTH, DEMONSTRATION_ALONE, INSTRUCTION_ALONE, using
from lerobot_deltaco.policy.demonstrations import DemonstrationSet
from lerobot_deltaco.policy.goals.conditioning import FoundGoals
from lerobot_deltaco.policy.language.instruction_table import LanguageEncoderError

logger = logging.getLogger(__name__)

MAX_SEED = 2**32 - 1
MAX_SENTENCE = 200  # characters
RENDER_SIZE = 288  # px, of the images for people
_CAMERA = "observation.image"
_PROJECT = "lerobot_deltaco."  # its modules


class Scene(NamedTuple):
    """A scene of the benchmark: the seed draws it for the task."""

    task_id: int
    seed: int


@dataclass(frozen=True)
class SceneView:
    """A scene as it is before anything moves.

    Attributes:
        image: Image of the camera, (H, W, 3).
        objects: Names of the objects in the scene.
        info: The `info` of the environment's reset.
    """

    image: NDArray[np.uint8]
    objects: tuple[str, ...]
    info: dict[str, Any]


class Moment(NamedTuple):
    """An episode at one of its steps.

    Attributes:
        image: The scene, for people, (H, W, 3).
        view: The policy's view of the demonstration and the scene, (H, W, 3); None for the expert.
        text: Summary of the episode so far.
    """

    image: NDArray[np.uint8]
    view: NDArray[np.uint8] | None
    text: str


def checked_scene(task_id: int, seed: Any) -> Scene:
    """A scene of a task and a seed that a user entered.

    Raises:
        PlayError: The seed is no integer within its range.
    """
    try:
        number = int(seed)
        is_valid = number == float(seed) and 0 <= number <= MAX_SEED
    except (TypeError, ValueError, OverflowError):
        is_valid = False
    if not is_valid:
        raise PlayError(f"The seed must be an integer from 0 to {MAX_SEED}. Got {seed!r}.")
    return Scene(get_task(task_id).index, number)


def checked_sentence(text: Any) -> str:
    """An instruction that a user entered, without spaces around it.

    Raises:
        PlayError: It is empty, too long, or has characters that are not printed.
    """
    sentence = text.strip() if isinstance(text, str) else ""
    if not sentence:
        raise PlayError('The instruction is empty. Write what to do, such as "Put the jar in the red bin."')
    if len(sentence) > MAX_SENTENCE:
        raise PlayError(
            f"An instruction has at most {MAX_SENTENCE} characters. This one has {len(sentence)}."
        )
    if not sentence.isprintable():
        raise PlayError("The instruction has line breaks or characters that are not printed. Remove them.")
    return sentence


def view_scene(scene: Scene) -> SceneView:
    """Builds a scene and looks at it."""
    with closing(_environment(scene)) as env:
        _, info = env.reset(seed=_seed(scene))
        objects = tuple(OBJECTS[index].name for index in info["objects"])
        return SceneView(env.scene.render(RENDER_SIZE), objects, info)


def other_instruction(view: SceneView, current: str, rng: random.Random) -> str:
    """The instruction of another task that makes sense in a scene.

    Args:
        view: The scene.
        current: The present instruction, which is not drawn again.
        rng: Source of the draw.
    """
    task = _other_task(TASKS, view, current, rng)
    assert task is not None
    return task.instruction


def other_demonstration(
    counts: dict[str, int], view: SceneView, current: tuple[str, int] | None, rng: random.Random
) -> tuple[str, int]:
    """The task and number of another demonstration that makes sense in a scene.

    Args:
        counts: Number of demonstrations by task string.
        view: The scene.
        current: Task string and number of the present demonstration, whose task is not drawn again.
        rng: Source of the draw.

    Raises:
        PlayError: There is no other demonstration.
    """
    others = [task for task in TASKS if task.instruction in counts]
    task = _other_task(others, view, current[0] if current else None, rng)
    if task is None:
        raise PlayError("There is no demonstration of another task. Let the expert make one.")
    return task.instruction, rng.randint(1, counts[task.instruction])


def _other_task(
    candidates: Sequence[Task], view: SceneView, current: str | None, rng: random.Random
) -> Task | None:
    """Another task than the present one: the scene's own, if that is not it, or one of its other objects."""
    own = int(view.info["task_id"])
    if current not in (None, TASKS[own].instruction) and TASKS[own] in candidates:
        return TASKS[own]
    others = [task for task in candidates if task.index != own and task.instruction != current]
    return counterfactual_task(others, view.info, rng) if others else None


class Player:
    """A checkpoint that acts in scenes. One thread may use it at a time.

    Args:
        folder: Folder of the checkpoint.

    Attributes:
        policy: The policy.

    Raises:
        PlayError: It cannot be loaded, or was not trained on the benchmark's observations and actions.
    """

    def __init__(self, folder: Path) -> None:
        try:
            # `demo_episode` would take precedence over the demonstration that the user chose.
            loaded = load_policy(folder, ["--device=cpu", "--demo_episode=null", "--compile=false"])
        # Whatever is wrong with files that come from anywhere: the page says so and goes on.
        except Exception as error:
            # The details, which name files of this machine, are for the terminal.
            logger.warning("The checkpoint %s cannot be loaded.", folder, exc_info=error)
            reason = _own_message(error, folder) or "its files are damaged or of another version."
            raise PlayError(f"The checkpoint cannot be loaded: {reason}") from error
        self.policy, self._preprocessor, self._postprocessor = loaded
        config = self.policy.config
        cameras = config.image_features
        state, action = config.robot_state_feature, config.action_feature
        if list(cameras) != [_CAMERA] or (state and state.shape != (10,)) or action.shape != (4,):
            raise PlayError(
                "The checkpoint was not trained on this benchmark, which has the camera "
                f"{_CAMERA!r}, 10 numbers of state and 4 of action. It has {list(cameras)}, "
                f"{state.shape if state else None} and {action.shape}."
            )
        self._camera_size = cameras[_CAMERA].shape[-1]

    @property
    def demonstrated_tasks(self) -> dict[str, int]:
        """Task strings of the checkpoint's demonstrations, with how many each has; empty if it has none."""
        demonstrations = self.policy.eval_demonstrations
        return (
            {} if demonstrations is None else {task: len(rows) for task, rows in demonstrations.rows.items()}
        )

    def demonstration(self, task: str, number: int) -> Demonstration:
        """A demonstration that comes with the checkpoint.

        Args:
            task: Task string.
            number: Number of the demonstration among those of the task, from 1.

        Raises:
            PlayError: There is none.
        """
        check_number(self.demonstrated_tasks, task, number, "checkpoint")
        demonstrations = self.policy.eval_demonstrations
        assert demonstrations is not None
        return stored_demonstration(demonstrations, task, number)

    def run(
        self, scene: Scene, demonstration: Demonstration | None, sentence: str, use: str = BOTH
    ) -> Generator[Moment]:
        """Runs an episode of the policy.

        Args:
            scene: The scene.
            demonstration: The demonstration; None if the policy takes none.
            sentence: The instruction.
            use: What of them the policy gets, one of `LEFT_OUT`.

        Yields:
            The episode before the first step, and after each.

        Raises:
            PlayError: The policy takes demonstrations and there is none, or it cannot read the sentence.
        """
        if use == INSTRUCTION_ALONE:
            demonstration = None
        elif self.policy.config.uses_demo and demonstration is None:
            raise PlayError("This policy needs a demonstration. Choose one, or let the expert make one.")
        if use == DEMONSTRATION_ALONE:
            sentence = ""
        with closing(_environment(scene, self._camera_size)) as env:
            observation, info = env.reset(seed=_seed(scene))
            with using(self.policy.config, use), _demonstrated_by(self.policy, demonstration, sentence):
                goals = self._find_goals(observation, sentence)
                view = self._explain(observation, demonstration, goals, use)
                self.policy.reset()
                action = self._act(observation, sentence)
            yield Moment(env.scene.render(RENDER_SIZE), view, f"0 of {EPISODE_STEPS} steps")
            reached = -1
            for step in range(1, EPISODE_STEPS + 1):
                if reached < 0 and action[3] <= 0:
                    reached = _nearest_object(env)
                observation, _, _, _, info = env.step(action)
                text = f"{step} of {EPISODE_STEPS} steps"
                if step == EPISODE_STEPS:
                    text = outcome(info, reached)
                yield Moment(env.scene.render(RENDER_SIZE), view, text)
                if step < EPISODE_STEPS:
                    action = self._act(observation, sentence)

    def expert_demonstration(self, scene: Scene) -> Generator[Moment | Demonstration]:
        """Runs an episode of the scripted expert.

        Args:
            scene: The scene.

        Yields:
            The episode after each step, and before the last of these the demonstration that it makes, so that
            the demonstration can be used once the end is seen.
        """
        task = get_task(scene.task_id)
        with closing(_environment(scene, self._camera_size)) as env:
            frames, states, gripper, video_images = [], [], [], []
            for number, step in enumerate(expert_episode(env, task.index, _seed(scene)), start=1):
                frames.append(step.observation["pixels"])
                states.append(step.observation["agent_pos"])
                gripper.append(float(step.action[-1]))
                video_images.append(env.scene.render(RENDER_SIZE))
                if number < EPISODE_STEPS:
                    text = f"Expert, {number} of {EPISODE_STEPS} steps: {step.stage.value}"
                    yield Moment(video_images[-1], None, text)
        images = torch.from_numpy(np.stack(frames)).permute(0, 3, 1, 2)
        robot = torch.from_numpy(np.stack(states)), torch.tensor(gripper)
        failed = "" if step.info["is_success"] else "; it failed"
        title = f"{task.instruction} (by the expert, seed {scene.seed}{failed})"
        yield demonstration_of(title, images, robot, self.policy.config, video_images, CONTROL_FPS)
        yield Moment(video_images[-1], None, f"Expert. {outcome(step.info, -1)}")

    def _batch(self, observation: dict[str, NDArray[Any]], sentence: str) -> dict[str, Any]:
        batch = preprocess_observation({name: value[None] for name, value in observation.items()})
        return self._preprocessor({**batch, "task": [sentence]})

    def _act(self, observation: dict[str, NDArray[Any]], sentence: str) -> NDArray[np.float32]:
        action: Tensor = self._postprocessor(self.policy.select_action(self._batch(observation, sentence)))
        return action[0].cpu().numpy()

    def _explain(
        self,
        observation: dict[str, NDArray[Any]],
        demonstration: Demonstration | None,
        goals: FoundGoals | None,
        use: str,
    ) -> NDArray[np.uint8]:
        """Draws what the policy receives and, if it has goals, what led to them."""
        ends = None
        if demonstration is not None and self.policy.config.uses_demo:
            ends = demonstration.ends
        image = draw_explanation(observation["pixels"], ends, goals)
        if use == BOTH:
            return image
        return np.asarray(down([caption(f"Used: {use}", image.shape[1]), to_image(image)]))

    @torch.no_grad()
    def _find_goals(self, observation: dict[str, NDArray[Any]], sentence: str) -> FoundGoals | None:
        """The goals that the policy will have in the episode; None if it finds none."""
        scenes = self.policy.scenes(self._batch(observation, sentence))
        self.policy.begin_evaluation()
        try:
            goals = self.policy.encode_task((sentence,), scenes).goals
        except (ValueError, LanguageEncoderError) as error:
            raise PlayError(str(error)) from error
        self.policy.begin_evaluation()
        return goals


def outcome(info: dict[str, Any], reached: int) -> str:
    """Summary of an episode, in a sentence or two.

    Args:
        info: The environment's, after the last step.
        reached: Number of the object beside which the gripper closed first; -1 if it never closed.
    """

    def name(index: int) -> str:
        return OBJECTS[info["objects"][index]].name

    parts = ["Success." if info["is_success"] else "No success."]
    if info["grasped_object"] >= 0:
        parts.append(f"It grasped the {name(info['grasped_object'])}.")
    elif reached >= 0:
        parts.append(f"It went for the {name(reached)} and did not get hold of it.")
    else:
        parts.append("It grasped nothing.")
    for number, container in enumerate(info["object_containers"]):
        if container >= 0:
            parts.append(f"The {name(number)} lies in the {CONTAINER_COLORS[container]} bin.")
    target = f"{name(info['target_object'])} in the {CONTAINER_COLORS[info['target_container']]} bin"
    parts.append(f"The scene's own task is the {target}.")
    return " ".join(parts)


def _own_message(error: Exception, folder: Path) -> str | None:
    """Message of a check of this project's, without the path of the checkpoint; None for any other error."""
    *_, (frame, _) = traceback.walk_tb(error.__traceback__)
    is_raised_here = frame.f_globals.get("__name__", "").startswith(_PROJECT)
    if not type(error).__module__.startswith(_PROJECT) and not (type(error) is ValueError and is_raised_here):
        return None
    message = " ".join(str(error).replace(f"{folder}{os.sep}", "").removeprefix(f"{folder}: ").split())
    return message.replace(str(folder), "the checkpoint")[:300]


@contextmanager
def _demonstrated_by(
    policy: DeltacoPolicy, demonstration: Demonstration | None, sentence: str
) -> Iterator[None]:
    """Gives a policy one demonstration alone, of the task that a sentence names."""
    own = policy.eval_demonstrations
    if demonstration is not None:
        frames = torch.from_numpy(demonstration.frames).permute(0, 3, 1, 2)[None]
        policy.eval_demonstrations = DemonstrationSet(frames, [sentence], [0])
        if demonstration.grasp_state is not None:
            policy.eval_demonstrations.grasp_states = torch.from_numpy(demonstration.grasp_state)[None]
    try:
        yield
    finally:
        policy.eval_demonstrations = own


def _environment(scene: Scene, image_size: int = 48) -> PickPlaceEnv:
    return PickPlaceEnv(scene.task_id, image_size=image_size)


def _seed(scene: Scene) -> int:
    return episode_seed(scene.seed, "evaluation", scene.task_id, 0)


def _nearest_object(env: PickPlaceEnv) -> int:
    """Number of the object that is nearest to the gripper, seen from above."""
    scene = env.scene
    positions = np.array([scene.object_pose(index).position[:2] for index in range(len(scene.bodies))])
    return int(np.linalg.norm(positions - scene.arm.position[:2], axis=1).argmin())
