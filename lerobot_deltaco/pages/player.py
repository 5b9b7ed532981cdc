"""Runs a policy in scenes of the benchmark with any demonstration and any sentence, for the pages."""

from __future__ import annotations

import random
import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple
from urllib.parse import urlencode

import numpy as np
from numpy.typing import NDArray

from gym_deltaco.layout import Layout
from gym_deltaco.tasks import TASKS, get_task, select_tasks
from lerobot_deltaco.data.demonstrations import Demonstration
from lerobot_deltaco.data.object_prompts import ObjectPrompt
from lerobot_deltaco.errors import UserError
from lerobot_deltaco.evaluation.checkpoints import LoadedPolicy
from lerobot_deltaco.evaluation.records import EvaluationPlan
from lerobot_deltaco.evaluation.video import benchmark_env, find_demonstration, record_episode
from lerobot_deltaco.pages.html import EpisodeView, picture_uri
from lerobot_deltaco.pages.verdict import judge, object_name
from lerobot_deltaco.pages.videos import video_uri
from lerobot_deltaco.policies.deltaco_match.findings import (
    demonstration_ends,
    describe_words,
    draw_localization,
)

BOTH, DEMONSTRATION, INSTRUCTION = "Both", "Demonstration only", "Instruction only"
POINT = "Point and instruction"
MAX_SEED = 9999
_RENDER_SIZE = 384  # px
_POINT = re.compile(r"\d{1,4},\d{1,4}")


class Choice(NamedTuple):
    """A scene and the policy's inputs, as stored in the page's address.

    Attributes:
        task_id: Task that the scene is drawn for.
        seed: Seed of the scene: that of `lerobot-eval`, and 1000 plus the trial of `deltaco evaluate`.
        demo_task: Task of the demonstration.
        demo_number: Number of a demonstration that the expert records; 0 for the checkpoint's.
        instruction: Instruction.
        inputs: What the policy receives: `BOTH`, `DEMONSTRATION`, `INSTRUCTION` or `POINT`.
        point: Point on an object in the image of the scene, "X,Y" in thousandths of its sides; "" for none.
    """

    task_id: int
    seed: int
    demo_task: int
    demo_number: int
    instruction: str
    inputs: str = BOTH
    point: str = ""

    @property
    def prompt(self) -> ObjectPrompt | None:
        """The point, as a policy takes it."""
        if not _POINT.fullmatch(self.point):
            return None
        x, y = (min(int(number), 1000) / 1000 for number in self.point.split(","))
        return ObjectPrompt((x, y, x, y))

    @property
    def query(self) -> str:
        """The choice as the query of the page's address."""
        return f"?{urlencode(self._asdict())}"

    @property
    def scene_seed(self) -> int:
        """Seed of the environment's reset."""
        return EvaluationPlan(seed=self.seed).scene_seed(self.task_id, 0)


def cross_inputs(demonstrations: Sequence[Choice]) -> list[Choice]:
    """Returns each choice twice, with sentences that name only the green and only the red bin."""
    return [
        choice._replace(instruction=f"Put it in the {color} bin.", inputs=BOTH)
        for choice in demonstrations
        for color in ("green", "red")
    ]


# A scene with two novel objects, the gray half donut and the yellow lampshade
SHOWCASE = cross_inputs([Choice(25, 1002, task, 0, "") for task in (25, 29)])


class Player:
    """A policy, its demonstrations, and a simulator.

    Args:
        loaded: The policy and its processors.

    Attributes:
        inputs: What the policy may receive, of `BOTH`, `DEMONSTRATION`, `INSTRUCTION` and `POINT`.

    Raises:
        ValueError: The policy is not one for the benchmark.
    """

    def __init__(self, loaded: LoadedPolicy) -> None:
        self._loaded = loaded
        self._env = benchmark_env(loaded.policy.config, _RENDER_SIZE)
        self._demonstrations: dict[tuple[int, int], Demonstration] = {}
        self.inputs = _possible_inputs(loaded.policy.config)

    def default_choice(self, task_id: int, seed: int) -> Choice:
        """Returns a scene with a demonstration and an instruction that fit it."""
        return Choice(task_id, seed, task_id, 0, get_task(task_id).instruction, self.inputs[0])

    def parse_choice(self, query: Mapping[str, str]) -> Choice:
        """Returns the choice in the page's address; missing or invalid parts are filled in to fit."""

        def number(name: str, end: int, default: int) -> int:
            text = query.get(name, "")
            return int(text) if text.isdecimal() and int(text) < end else default

        task_id = number("task_id", len(TASKS), random.choice(select_tasks("scenario_a_test")))
        choice = self.default_choice(task_id, number("seed", MAX_SEED + 1, 1000))
        inputs = query.get("inputs", "")
        return choice._replace(
            demo_task=number("demo_task", len(TASKS), task_id),
            demo_number=number("demo_number", MAX_SEED + 1, 0),
            instruction=query.get("instruction", choice.instruction),
            inputs=inputs if inputs in self.inputs else choice.inputs,
            point=query.get("point", ""),
        )

    def show_scene(self, choice: Choice) -> tuple[NDArray[np.uint8], Layout]:
        """Returns an image of a scene, and its objects and containers."""
        self._env.reset(seed=choice.scene_seed, options={"task_id": choice.task_id})
        image = self._env.render()
        assert image is not None
        return image, self._env.scene.layout

    def demonstration(self, choice: Choice) -> Demonstration:
        """Returns the demonstration of a choice; one that the checkpoint lacks is recorded by the expert."""
        key = choice.demo_task, choice.demo_number
        if key not in self._demonstrations:
            self._demonstrations[key] = find_demonstration(
                self._loaded.policy, get_task(choice.demo_task), self._env.scene_config, choice.demo_number
            )
        return self._demonstrations[key]

    def run(self, choice: Choice) -> EpisodeView:
        """Runs an episode.

        Raises:
            ValueError: The instruction is needed and empty.
        """
        sentence = "" if choice.inputs == DEMONSTRATION else " ".join(choice.instruction.split())
        if not sentence and choice.inputs != DEMONSTRATION:
            raise UserError("Type an instruction first, or use the demonstration only.")
        demonstrations: list[Demonstration | ObjectPrompt] = []
        if choice.inputs == POINT:
            if choice.prompt is None:
                raise UserError("Click on an object in the scene first.")
            demonstrations = [choice.prompt]
        elif choice.inputs != INSTRUCTION:
            demonstrations = [self.demonstration(choice)]
        recording = record_episode(
            self._loaded, self._env, choice.task_id, choice.scene_seed, sentence, demonstrations
        )
        is_demonstrated = choice.inputs in (BOTH, DEMONSTRATION)
        ends = demonstration_ends(self.demonstration(choice)) if is_demonstrated else None
        picture, words = None, ""
        if recording.localization is not None:
            picture = picture_uri(draw_localization(recording.frames[0], ends, recording.localization))
            words = describe_words(self._loaded.policy.localizer.matching, sentence)
        shown = get_task(choice.demo_task) if is_demonstrated else None
        verdict = judge(recording, sentence, shown, words, choice.prompt if choice.inputs == POINT else None)
        return EpisodeView(
            instruction=sentence,
            demonstration=self._describe_demonstration(choice, recording.layout) if is_demonstrated else "",
            ends=[] if ends is None else [picture_uri(end) for end in ends],
            is_right=verdict.is_success,
            headline=verdict.headline,
            lines=verdict.lines,
            picture=picture,
            video=video_uri(recording.frames),
        )

    def comparison(self, choice: Choice) -> list[Choice]:
        """Returns demonstrations of two of the scene's objects times two sentences, for `run`.

        Raises:
            ValueError: The policy does not take both inputs.
        """
        if BOTH not in self.inputs:
            raise UserError("The comparison needs a policy that takes a demonstration and an instruction.")
        _, layout = self.show_scene(choice)
        labels = [item.label for item in layout.objects]
        fitting = [labels[n] for n in get_task(choice.demo_task).object.meant(labels)]
        first = choice
        if len(fitting) != 1:  # the chosen demonstration does not single out an object here
            fitting = [labels[layout.target_object]]
            first = choice._replace(demo_task=choice.task_id, demo_number=0)
        other = next(label.index for label in labels if label not in fitting)
        container = get_task(first.demo_task).container
        second = next(task for task in TASKS if task.targets == (other,) and task.container == container)
        return cross_inputs([first, choice._replace(demo_task=second.index, demo_number=0)])

    @staticmethod
    def _describe_demonstration(choice: Choice, layout: Layout) -> str:
        """Returns which object of the scene the demonstration shows, or its task."""
        task = get_task(choice.demo_task)
        labels = [item.label for item in layout.objects]
        names = {object_name(labels[n]) for n in task.object.meant(labels)}
        return f"The demonstration shows the {names.pop()}." if len(names) == 1 else task.instruction


def _possible_inputs(config: Any) -> tuple[str, ...]:
    """Returns what a policy can receive."""
    takes_sentence = can_drop = True
    if config.type == "deltaco":
        sources = config.conditioning[:2]
        takes_sentence = any("language" in source or source == "one_hot" for source in sources)
        can_drop = config.method == "mcil"
    if not (takes_sentence and config.uses_demonstrations):
        return (INSTRUCTION,) if takes_sentence else (DEMONSTRATION,)
    if config.type == "deltaco":
        return (BOTH, DEMONSTRATION, INSTRUCTION) if can_drop else (BOTH,)
    return (BOTH, DEMONSTRATION, INSTRUCTION, POINT)
