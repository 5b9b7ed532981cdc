"""Which episodes an evaluation set consists of."""

from __future__ import annotations

from dataclasses import dataclass

from gym_deltaco import EPISODE_STEPS
from gym_deltaco.layout import AMBIGUITIES, Ambiguity
from gym_deltaco.object_sets import ADVERSARIAL_PROBABILITY, check_scenes, default_objects
from gym_deltaco.tasks import select_tasks
from lerobot_deltaco.common.checks import check_choices
from lerobot_deltaco.common.env_ranges import ENV_RANGES
from lerobot_deltaco.common.typed_fields import check_field_types, check_ranges
from lerobot_deltaco.evaluation.record import COUNTERFACTUALS, Counterfactual


@dataclass(frozen=True)
class EvaluationPlan:
    """Arguments of an evaluation set; equal plans and set numbers give equal scenes.

    Args:
        tasks: Selection of tasks, as `--env.task` takes it.
        trials: Number of episodes of each task, at least 1.
        seed: Seed of the scenes, at least 0; the number of the set, the task and the trial also determine
            them.
        counterfactual: "none": demonstration and instruction are those of the scene's task. "demo" or
            "instruction": that one is another task's, which asks for another object of the scene and for the
            other container, if there is such a task.
        ambiguity: "container" or "object", the paper's schemes i and ii.
        image_size: Height and width of the policy's images in the environment, px.
        episode_length: Number of steps of an episode.
        objects: Objects that scenes are made of, as `--env.objects` takes them; None is the task set's own.
        adversarial_probability: Probability that a distractor is drawn from the objects that share the
            target's color or shape, 0..1.

    Raises:
        ValueError: An argument is invalid; the message says what is valid.
    """

    tasks: str = "scenario_a_test"
    trials: int = 2
    seed: int = 0
    counterfactual: Counterfactual = "none"
    ambiguity: Ambiguity = "container"
    image_size: int = 48
    episode_length: int = EPISODE_STEPS
    objects: str | None = None
    adversarial_probability: float = ADVERSARIAL_PROBABILITY

    def __post_init__(self) -> None:
        check_field_types(self)
        task_ids = select_tasks(self.tasks)
        ranges = {name: ENV_RANGES[name] for name in ("image_size", "episode_length")}
        check_ranges(self, {"trials": (1, 1_000_000), "seed": (0, 2**63 - 1), **ranges})
        objects = default_objects(self.tasks) if self.objects is None else self.objects
        object.__setattr__(self, "objects", objects)
        check_scenes(task_ids, objects, self.adversarial_probability)
        check_choices(self, counterfactual=COUNTERFACTUALS, ambiguity=AMBIGUITIES)
