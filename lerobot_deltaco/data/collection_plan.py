"""What a collection consists of: which episodes, in which order, and what they record."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gym_deltaco import CONTROL_FPS, ENV_ID, EPISODE_STEPS, EXPERT_NOISE, MIN_IMAGE_SIZE
from gym_deltaco.layout import AMBIGUITIES, Ambiguity
from gym_deltaco.object_sets import ADVERSARIAL_PROBABILITY, AdversarialDraw, check_scenes, default_objects
from gym_deltaco.seeding import Split, episode_seed
from gym_deltaco.tasks import SCENARIOS, TASK_SETS, TASKS, VALIDATION, select_tasks
from lerobot_deltaco.common.checks import check_choices
from lerobot_deltaco.common.typed_fields import check_field_types, check_ranges
from lerobot_deltaco.data.feature_names import ACTION_NAMES, DEFAULT_FEATURES, PRIVILEGED, STATE_NAMES

if TYPE_CHECKING:
    from gym_deltaco.env import PickPlaceEnv

FPS = CONTROL_FPS
ROBOT_TYPE = "widowx_250"
EPISODE_LENGTH = EPISODE_STEPS
EPISODES_PER_FILE = 1000
MAX_ATTEMPTS = 100
COLLECTED_SPLITS: tuple[Split, ...] = ("train", "validation")

_NOVEL_OBJECTS = tuple(task for task in SCENARIOS["a"].test_tasks if TASKS[task].kind == "name")
# Named data sets: which tasks, and what the episodes are for. All but T150 and V48 are the authors'.
DATA_SETS: dict[str, tuple[tuple[int, ...], Split]] = {
    "T198": (SCENARIOS["a"].train_tasks, "train"),
    "T48": (_NOVEL_OBJECTS, "train"),
    "T54": (SCENARIOS["b"].test_tasks, "train"),
    "E48": (_NOVEL_OBJECTS, "validation"),
    "E54": (SCENARIOS["b"].test_tasks, "validation"),
    "E102": (SCENARIOS["a"].test_tasks, "validation"),
    # For choosing settings: the training tasks that remain, and the demonstrations of those held out.
    "T150": (VALIDATION.train_tasks, "train"),
    "V48": (VALIDATION.test_tasks, "validation"),
}


class CollectionError(RuntimeError):
    """The collection cannot begin or go on; the message says what to do."""


@dataclass(frozen=True)
class CollectionPlan:
    """Arguments of a collection; equal plans give equal datasets.

    Args:
        tasks: A task set, a named data set (T198, T48, T54, E48, E54, E102 of the authors; T150 and V48 for
            choosing settings), or indices and ranges.
        episodes_per_task: Number of successful episodes of each task, at least 1.
        seed: Seed of the whole collection, at least 0.
        split: Purpose of the episodes: "train" or "validation", whose scenes never coincide. None is that
            of the data set, or "validation" for test and validation tasks and "train" for all else.
        ambiguity: "container" or "object", the paper's schemes i and ii.
        noise: Standard deviation of the noise on the expert's motions, at least 0.
        image_size: Height and width of the images, px.
        objects: Objects that scenes are made of, as the environment takes them; None is "all", but
            "scenario_a_train" for scenario_a_clean_train.
        adversarial_probability: Probability that a distractor is drawn from the objects that share the
            target's color or shape, 0..1.
        adversarial_draw: Scope of a draw with that probability: "each", one distractor; or "scene", both
            distractors of a scene, as in the authors' code.

    Raises:
        ValueError: An argument is not valid; the message says what is.
    """

    tasks: str
    episodes_per_task: int
    seed: int = 0
    split: Split | None = None
    ambiguity: Ambiguity = "container"
    noise: float = EXPERT_NOISE
    image_size: int = 48
    objects: str | None = None
    adversarial_probability: float = ADVERSARIAL_PROBABILITY
    adversarial_draw: AdversarialDraw = "each"

    def __post_init__(self) -> None:
        check_field_types(self)
        task_ids = self.task_ids
        check_ranges(
            self,
            {
                "episodes_per_task": (1, 1_000_000),
                "seed": (0, 2**63 - 1),
                "noise": (0, 1e6),
                "image_size": (MIN_IMAGE_SIZE, 4096),
            },
        )
        check_choices(self, ambiguity=AMBIGUITIES)
        objects = default_objects(self.tasks) if self.objects is None else self.objects
        object.__setattr__(self, "objects", objects)
        check_scenes(task_ids, objects, self.adversarial_probability, self.adversarial_draw)
        if self.split is None:
            object.__setattr__(self, "split", _default_split(self.tasks, task_ids))
        check_choices(self, split=COLLECTED_SPLITS)

    @property
    def task_ids(self) -> tuple[int, ...]:
        """Indices of the tasks, in the order of the dataset."""
        if self.tasks in DATA_SETS:
            return DATA_SETS[self.tasks][0]
        try:
            return select_tasks(self.tasks)
        except ValueError as error:
            raise ValueError(f"{error} Also valid are the data sets {', '.join(DATA_SETS)}.") from None

    @property
    def n_episodes(self) -> int:
        """Number of episodes of all tasks."""
        return len(self.task_ids) * self.episodes_per_task

    @property
    def env_settings(self) -> dict[str, Any]:
        """Arguments of the environment."""
        return {
            "ambiguity": self.ambiguity,
            "image_size": self.image_size,
            "objects": self.objects,
            "adversarial_probability": self.adversarial_probability,
            "adversarial_draw": self.adversarial_draw,
        }

    @property
    def _changed_settings(self) -> dict[str, Any]:
        """Settings of the scenes that are not the default. The others are left out, as they always were."""
        settings = {
            "objects": "all",
            "adversarial_probability": ADVERSARIAL_PROBABILITY,
            "adversarial_draw": "each",
        }
        return {name: getattr(self, name) for name, own in settings.items() if getattr(self, name) != own}

    @property
    def features(self) -> dict[str, dict[str, Any]]:
        """What a frame of the dataset has, as in LeRobot's info.json."""
        number = {"dtype": "int64", "shape": [1], "names": None}
        return {
            "observation.image": {
                "dtype": "image",
                "shape": [self.image_size, self.image_size, 3],
                "names": ["height", "width", "channels"],
                # Policies do not transfer from one renderer's images to another's.
                "info": {
                    "renderer": renderer(),
                    "benchmark": ENV_ID,
                    "ambiguity": self.ambiguity,
                    **self._changed_settings,
                },
            },
            "observation.state": {"dtype": "float32", "shape": [10], "names": STATE_NAMES},
            "action": {"dtype": "float32", "shape": [4], "names": ACTION_NAMES},
            "next.reward": {"dtype": "float32", "shape": [1], "names": None},
            "next.done": {"dtype": "bool", "shape": [1], "names": None},
            "next.success": {"dtype": "bool", "shape": [1], "names": None},
            **dict.fromkeys(PRIVILEGED, number),
            **DEFAULT_FEATURES,
        }


def _default_split(tasks: str, task_ids: tuple[int, ...]) -> Split:
    """What episodes of a selection are for unless the plan says so."""
    if tasks in DATA_SETS:
        return DATA_SETS[tasks][1]
    for suffix, held_out in (("_test", "scenario_a_test"), ("_validation", "scenario_a_validation")):
        if tasks.endswith(suffix) and set(task_ids) <= set(TASK_SETS[held_out]):
            return "validation"
    return "train"


def renderer() -> str:
    """What made the images."""
    return f"PyBullet {version('pybullet')}, TinyRenderer"


class CollectedEpisode(NamedTuple):
    """A successful episode."""

    frames: dict[str, NDArray]  # of each recorded feature, (30, ...)
    attempts: int  # how many episodes were run to have it, at least 1


def collect_episode(env: PickPlaceEnv, plan: CollectionPlan, task_id: int, number: int) -> CollectedEpisode:
    """Runs the expert until it succeeds.

    Args:
        env: Environment to run the expert in.
        plan: The collection.
        task_id: Task of the episode.
        number: Number of the episode among those of its task, from 0.

    Raises:
        CollectionError: It never succeeded.
    """
    # Only here: a plan needs no simulator.
    from gym_deltaco.expert import expert_episode

    for attempt in range(MAX_ATTEMPTS):
        assert plan.split is not None
        seed = episode_seed(plan.seed, plan.split, task_id, number, attempt)
        steps = list(expert_episode(env, task_id, seed, plan.noise))
        if not steps[-1].info["is_success"]:
            continue
        n_steps = len(steps)
        info = steps[-1].info
        privileged = (task_id, info["objects"][info["target_object"]], info["target_container"], seed)
        frames = {
            "observation.image": np.stack([step.observation["pixels"] for step in steps]),
            "observation.state": np.stack([step.observation["agent_pos"] for step in steps]),
            "action": np.stack([step.action for step in steps]),
            "next.reward": np.array([step.reward for step in steps], dtype=np.float32),
            "next.done": np.arange(n_steps) == n_steps - 1,
            "next.success": np.array([step.info["is_success"] for step in steps]),
            **{
                name: np.full(n_steps, value, dtype=np.int64)
                for name, value in zip(PRIVILEGED, privileged, strict=True)
            },
        }
        return CollectedEpisode(frames, attempts=attempt + 1)
    raise CollectionError(
        f"The expert failed {MAX_ATTEMPTS} times in a row at task {task_id}, episode {number}. "
        f"A noise of {plan.noise} may be too much for it."
    )


def first_numbers(plan: CollectionPlan, earlier: list[CollectionPlan]) -> Counter[int]:
    """For each task, how many of its episodes are taken by earlier collections with the same seeds."""
    taken: Counter[int] = Counter()
    for other in earlier:
        if (other.seed, other.split) == (plan.seed, plan.split):
            taken.update(dict.fromkeys(other.task_ids, other.episodes_per_task))
    return taken
