"""Settings for drawing and observing scenes, as one value."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

from gym_deltaco.control import CONTROLS, Control
from gym_deltaco.objects.object_sets import select_objects
from gym_deltaco.tasks import default_objects, get_task

AMBIGUITIES = ("container", "object")
ADVERSARIAL_DRAWS = ("each", "scene")
MIN_IMAGE_SIZE, MAX_IMAGE_SIZE = 8, 4096  # px
MAX_EPISODE_LENGTH = 100_000


@dataclass(frozen=True)
class SceneConfig:
    """Settings of the benchmark's scenes; the defaults are the benchmark's.

    Args:
        ambiguity: Scheme of the paper. "container" (i): the instruction is clear, but a demonstration alone
            does not tell which of the two containers is meant. "object" (ii): the target has an identical
            twin, and only a demonstration tells which of the two is meant.
        objects: Set of objects from which scenes are drawn: "all", the paper's 32; "scenario_a_train", the 24
            training objects of scenario A; "random:N", these 24 and N - 24 random objects; or
            "out_of_distribution", meshes that come with PyBullet. A task set that needs other objects than
            "all" brings them.
        adversarial_probability: Probability that a distractor shares the target's color or shape, 0..1. It is
            0.6 in the paper's data; with 0, distractors are uniform. Unused with ambiguity "object".
        adversarial_draw: Scope of a draw with that probability: "each" distractor; or the whole "scene", as
            in the authors' code.
        image_size: Height and width of the policy's image, 8..4096 px.
        episode_length: Number of steps of an episode, 1..100000; None for the control's default, 30 steps
            with "position" and 240 with "joints".
        control: Control of the arm: "position", the benchmark's, changes the end effector's position;
            "joints" takes positions of the joints at 30 Hz, as LeRobot's robots do.

    Raises:
        ValueError: A setting is invalid; the message says what is valid.
    """

    ambiguity: str = "container"
    objects: str = "all"
    adversarial_probability: float = 0.6
    adversarial_draw: str = "each"
    image_size: int = 48
    episode_length: int | None = None
    control: str = "position"

    def __post_init__(self) -> None:
        for name, valid in (
            ("ambiguity", AMBIGUITIES),
            ("adversarial_draw", ADVERSARIAL_DRAWS),
            ("control", CONTROLS),
        ):
            if getattr(self, name) not in valid:
                raise ValueError(f"`{name}` must be one of {', '.join(valid)}. Got {getattr(self, name)!r}.")
        select_objects(self.objects)
        if not 0 <= self.adversarial_probability <= 1:
            raise ValueError(
                f"`adversarial_probability` must be between 0 and 1. Got {self.adversarial_probability!r}."
            )
        image, length = (MIN_IMAGE_SIZE, MAX_IMAGE_SIZE), (1, MAX_EPISODE_LENGTH)
        ranges = {"image_size": (self.image_size, image), "episode_length": (self.n_steps, length)}
        for name, (number, (low, high)) in ranges.items():
            if type(number) is not int or not low <= number <= high:
                raise ValueError(f"`{name}` must be an integer from {low} to {high}. Got {number!r}.")
        if self.episode_length == self.interface.episode_length:
            object.__setattr__(self, "episode_length", None)  # equal settings are equal

    @property
    def interface(self) -> Control:
        """Names, cameras and rates under the control."""
        return CONTROLS[self.control]

    @property
    def n_steps(self) -> int:
        """Number of steps of an episode."""
        return self.interface.episode_length if self.episode_length is None else self.episode_length

    def for_tasks(self, tasks: str) -> SceneConfig:
        """Returns the settings with the default objects of a selection of tasks, unless others are set."""
        return replace(self, objects=default_objects(tasks)) if self.objects == "all" else self

    def check_tasks(self, task_ids: Iterable[int]) -> None:
        """Checks that the objects include one that fits each task.

        Args:
            task_ids: Indices of tasks.

        Raises:
            ValueError: A task does not exist, or no object fits it.
        """
        labels = select_objects(self.objects)
        for task in {task.object: task for task in map(get_task, task_ids)}.values():
            if not any(task.object.describes(label) for label in labels):
                raise ValueError(
                    f"Task {task.index} asks for a {task.object.phrase}, of which the objects "
                    f"{self.objects!r} have none. Choose other tasks, or other `objects`."
                )


DEFAULT_SCENE = SceneConfig()
