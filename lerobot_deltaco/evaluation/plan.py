"""Which episodes an evaluation set consists of."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

from gym_deltaco import EPISODE_STEPS
from gym_deltaco.instructions import choose_instructions
from gym_deltaco.layout import AMBIGUITIES, Ambiguity
from gym_deltaco.object_sets import ADVERSARIAL_PROBABILITY, AdversarialDraw, check_scenes, default_objects
from gym_deltaco.tasks import select_tasks
from lerobot_deltaco.common.checks import check_choices
from lerobot_deltaco.common.env_ranges import ENV_RANGES
from lerobot_deltaco.common.typed_fields import check_field_types, check_ranges
from lerobot_deltaco.evaluation.record import COUNTERFACTUALS, TEMPLATES, Counterfactual


@dataclass(frozen=True)
class EvaluationPlan:
    """Arguments of an evaluation set; equal plans and set numbers give equal scenes.

    Args:
        tasks: Selection of tasks, as `--env.task` takes it.
        trials: Number of episodes of each task, at least 1.
        seed: Seed of the scenes, at least 0; the number of the set, the task and the trial also determine
            them.
        scene_set: Number of the set of scenes, at least 0. None is the training step of what is evaluated, so
            that each evaluation set of a training run has scenes of its own; with a number, checkpoints of
            different steps can be compared in the same scenes.
        counterfactual: "none": demonstration and instruction are those of the scene's task. "demo" or
            "instruction": that one is another task's, which asks for another object of the scene and for the
            other container, if there is such a task.
        ambiguity: "container" or "object", the paper's schemes i and ii.
        image_size: Height and width of the policy's images in the environment, px.
        episode_length: Number of steps of an episode.
        objects: Objects that scenes are made of, as `--env.objects` takes them; None is the task set's own.
        adversarial_probability: Probability that a distractor is drawn from the objects that share the
            target's color or shape, 0..1.
        adversarial_draw: Scope of a draw with that probability: "each", one distractor; or "scene", both
            distractors of a scene, as in the authors' code.
        instructions: CSV file with sentences for the tasks, as `deltaco-instructions` downloads or checks it;
            the trials of a task use its sentences in turn. By default, the benchmark's templates.
        instructions_split: Split of that file: "all"; "held_out", the last sentence of each task; or "train",
            the sentences that are held out for no task.
        instruction: Sentence, in any words, that replaces the instruction of every task.

    Raises:
        ValueError: An argument is invalid; the message says what is valid.
    """

    tasks: str = "scenario_a_test"
    trials: int = 2
    seed: int = 0
    scene_set: int | None = None
    counterfactual: Counterfactual = "none"
    ambiguity: Ambiguity = "container"
    image_size: int = 48
    episode_length: int = EPISODE_STEPS
    objects: str | None = None
    adversarial_probability: float = ADVERSARIAL_PROBABILITY
    adversarial_draw: AdversarialDraw = "each"
    instructions: str | None = None
    instructions_split: str = "all"
    instruction: str | None = None

    def __post_init__(self) -> None:
        if isinstance(self.instructions, Path):
            object.__setattr__(self, "instructions", str(self.instructions))
        check_field_types(self)
        task_ids = select_tasks(self.tasks)
        ranges = {name: ENV_RANGES[name] for name in ("image_size", "episode_length")}
        if self.scene_set is not None:
            ranges["scene_set"] = (0, 2**63 - 1)
        check_ranges(self, {"trials": (1, 1_000_000), "seed": (0, 2**63 - 1), **ranges})
        if self.objects is None:
            object.__setattr__(self, "objects", default_objects(self.tasks))
        check_scenes(task_ids, self.object_set, self.adversarial_probability, self.adversarial_draw)
        check_choices(self, counterfactual=COUNTERFACTUALS, ambiguity=AMBIGUITIES)
        if self.sentences is not None and self.counterfactual == "instruction":
            raise ValueError(
                "A counterfactual instruction is another task's template: leave out `instructions` and "
                "`instruction`, or set `counterfactual` to 'none' or 'demo'."
            )

    @property
    def object_set(self) -> str:
        """Name of the set of objects that scenes are made of."""
        assert self.objects is not None
        return self.objects

    @property
    def sentences(self) -> dict[int, tuple[str, ...]] | None:
        """The sentences of each task, which its trials use in turn; None for the benchmark's templates."""
        return choose_instructions(
            select_tasks(self.tasks), self.instructions, self.instructions_split, self.instruction
        )

    @property
    def wording(self) -> str:
        """Source of the instructions, for the record: the sentence itself, or a file with its SHA-256."""
        if self.instruction is not None:
            return self.instruction
        if self.instructions is None:
            return TEMPLATES
        digest = hashlib.sha256(Path(self.instructions).read_bytes()).hexdigest()
        return f"{Path(self.instructions).name} ({self.instructions_split}), SHA-256 {digest}"
