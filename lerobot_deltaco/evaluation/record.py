"""The record of an evaluation set: what happened in every episode, and what it takes to repeat it.

An evaluation set is a few episodes of each of several tasks, run with one checkpoint. Its record is one JSON
file in the folder `evaluations` of the training run.
"""

from __future__ import annotations

import json
from dataclasses import MISSING, asdict, dataclass, fields
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, get_args

from gym_deltaco import EPISODE_STEPS
from gym_deltaco.atomic_files import write_json
from gym_deltaco.object_sets import ADVERSARIAL_PROBABILITY, N_INDICES, AdversarialDraw
from gym_deltaco.tasks import get_task
from lerobot_deltaco.common.typed_fields import in_words, is_a, type_hints

# Format 2 has more fields than format 1. Those have defaults, which say what was so in all records before.
RECORD_FORMAT = 2
READABLE_FORMATS = (1, RECORD_FORMAT)
RECORDS_FOLDER = "evaluations"

Counterfactual = Literal["none", "demo", "instruction"]
COUNTERFACTUALS: tuple[Counterfactual, ...] = get_args(Counterfactual)
# The key of an evaluation's `versions` under which the environment's id is, the benchmark's version.
BENCHMARK = "benchmark"
# The `wording` of an evaluation with the benchmark's own instructions.
TEMPLATES = "templates"
# Fields that the first records of format 2 do not have, and what was so in all of them.
_ADDED_TO_FORMAT_2 = MappingProxyType(
    {
        "wording": TEMPLATES,
        "adversarial_draw": "each",
        "scene_set": None,
        "weights": None,
        "demonstrations": None,
        "demonstrations_digest": None,
    }
)


class RecordError(ValueError):
    """A file is not the record of an evaluation; the message says what is wrong with it."""


@dataclass(frozen=True)
class EpisodeResult:
    """One episode. Objects and containers are numbered as they are in the scene; -1 is none.

    Args:
        task_id: The scene's task, which decides success.
        trial: Number of the episode among those of its task in this evaluation set, from 0.
        seed: Seed of the environment's reset.
        instruction: Instruction that the policy received.
        demonstration: Task string of the demonstration that the policy received; None without one.
        success: Whether the scene's task succeeded, at any step.
        objects: Indices of the objects that stand in the scene, three of them.
        object_containers: Container of each of them at the end: 0 green, 1 red.
        container_quadrants: Places of the green and the red container, (2, 2): i, 0 right and 1 left, and
            j, 0 back and 1 front. It decides what a position word of another task would mean in this scene.
        target_object: The object that the scene's task asks for.
        target_container: The container that the scene's task asks for.
        grasped_object: The object that the gripper held last.
        right_object: Whether that is the target.
        right_container: Whether something lies in the target container, and nothing in the other one.
        demonstration_episodes: Indices of the demonstrations' episodes in their dataset; None in records of
            format 1, which do not tell.
        demonstrated_objects: Indices of the objects that the demonstrations move to a container; none if the
            dataset does not tell, and None in records of format 1.
    """

    task_id: int
    trial: int
    seed: int
    instruction: str
    demonstration: str | None
    success: bool
    objects: list[int]
    object_containers: list[int]
    container_quadrants: list[list[int]]
    target_object: int
    target_container: int
    grasped_object: int
    right_object: bool
    right_container: bool
    demonstration_episodes: list[int] | None = None
    demonstrated_objects: list[int] | None = None


@dataclass(frozen=True)
class EvaluationRecord:
    """An evaluation set of one checkpoint.

    Args:
        experiment: Name of what was trained, such as "scenario_a/deltaco"; runs that differ only in their
            seeds share it.
        method: Method of the policy: deltaco, language_only, ...
        run_seed: Seed of the training run.
        step: Training step of the checkpoint.
        evaluation_seed: Seed of the scenes, together with the number of their set.
        counterfactual: "none"; "demo" or "instruction": that was another task's.
        ambiguity: Ambiguity of the scenes: "container", the paper's scheme (i), or "object", scheme (ii).
        tasks: The selection of tasks, such as "scenario_a_test".
        trials: Episodes of each task.
        episodes: Result of each episode.
        policy: The policy's configuration.
        versions: Versions of the benchmark ("benchmark": the environment's id) and of the relevant packages.
        command: Command line of the evaluation.
        seconds: Duration of the episodes, s.
        image_size: Height and width of the policy's images in the environment, px.
        episode_length: Number of steps of an episode.
        objects: Name of the set of objects that the scenes are made of.
        adversarial_probability: Probability that a distractor is drawn from the objects that share the
            target's color or shape, 0..1.
        adversarial_draw: Scope of a draw with that probability: "each", one distractor; or "scene", both
            distractors of a scene, as in the authors' code.
        wording: In whose words the instructions were: "templates", the benchmark's own; a file of sentences
            with its split and SHA-256; or the one sentence that all tasks had.
        scene_set: Number of the set of scenes; None is the step.
        weights: SHA-256 of the checkpoint's weights; None in evaluations during training, and in records of
            earlier versions.
        demonstrations: Name of the dataset of demonstrations that was given for the evaluation; None if they
            were the checkpoint's own, or if `weights` is None.
        demonstrations_digest: SHA-256 of that dataset's metadata; None if there was none, or if it is not
            known.
    """

    experiment: str
    method: str
    run_seed: int
    step: int
    evaluation_seed: int
    counterfactual: Counterfactual
    ambiguity: Literal["container", "object"]
    tasks: str
    trials: int
    episodes: list[EpisodeResult]
    policy: dict[str, Any]
    versions: dict[str, str]
    command: str
    seconds: float
    image_size: int = 48
    episode_length: int = EPISODE_STEPS
    objects: str = "all"
    adversarial_probability: float = ADVERSARIAL_PROBABILITY
    adversarial_draw: AdversarialDraw = "each"
    wording: str = TEMPLATES
    scene_set: int | None = None
    weights: str | None = None
    demonstrations: str | None = None
    demonstrations_digest: str | None = None

    @property
    def success_rate(self) -> float:
        """Share of the episodes that succeeded, 0..1."""
        return sum(episode.success for episode in self.episodes) / len(self.episodes)


def record_path(run_folder: Path, step: int, counterfactual: Counterfactual = "none") -> Path:
    """Where a run keeps the record of the evaluation set of a step."""
    suffix = "" if counterfactual == "none" else f"_{counterfactual}"
    return run_folder / RECORDS_FOLDER / f"{step:07d}{suffix}.json"


def extras_folder(run_folder: Path, step: int, counterfactual: Counterfactual = "none") -> Path:
    """Where a run keeps what belongs to the record of a step: images, videos, results in LeRobot's form."""
    return record_path(run_folder, step, counterfactual).with_suffix("")


def write_record(record: EvaluationRecord, path: Path) -> None:
    """Writes a record, wholly or not at all."""
    write_json(path, {"format": RECORD_FORMAT, **asdict(record)}, indent=1)


def read_record(path: Path) -> EvaluationRecord:
    """Reads a record.

    Raises:
        RecordError: The file is not one, or is one of another version's.
        OSError: It cannot be read.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise RecordError(f"{path} is not a record of an evaluation: it is no JSON ({error}).") from None
    found = content.get("format") if isinstance(content, dict) else None
    if type(found) is not int or found not in READABLE_FORMATS:
        raise RecordError(
            f"{path} is not a record of an evaluation in format 1 to {RECORD_FORMAT}: its format is "
            f"{found!r}. Evaluate the checkpoint again with `deltaco-evaluate`."
        )
    del content["format"]
    is_older = found < RECORD_FORMAT
    content = {**_ADDED_TO_FORMAT_2, **content}
    content = _check_fields(path, content, EvaluationRecord, but="episodes", is_older=is_older)
    if BENCHMARK not in content["versions"]:
        raise RecordError(f"{path} does not say of which version of the benchmark it is (`versions`).")
    if not isinstance(content["episodes"], list) or not content["episodes"]:
        raise RecordError(f"{path} has no episodes.")
    episodes = [
        EpisodeResult(**_check_fields(path, episode, EpisodeResult, is_older=is_older))
        for episode in content["episodes"]
    ]
    for episode in episodes:
        _check_numbers(path, episode)
    return EvaluationRecord(**{**content, "episodes": episodes})


def _check_fields(
    path: Path, content: Any, kind: type[Any], but: str | None = None, is_older: bool = False
) -> dict[str, Any]:
    """Checks that a record or an episode has its fields, of their types (those of one field excepted).

    Returns:
        The content; one of an older format has the defaults of the fields that came later.
    """
    if not isinstance(content, dict):
        raise RecordError(f"{path} is damaged: expected the fields of {kind.__name__}, got {content!r}.")
    if is_older:
        defaults = {field.name: field.default for field in fields(kind) if field.default is not MISSING}
        content = {**defaults, **content}
    expected = type_hints(kind).keys()
    if content.keys() != expected:
        missing, unknown = sorted(expected - set(content)), sorted(set(content) - expected)
        raise RecordError(
            f"{path} is damaged or of another version: {kind.__name__} lacks {missing or 'nothing'}, and has "
            f"the unknown {unknown or 'nothing'}."
        )
    for name, value_kind in type_hints(kind).items():
        if name != but and not is_a(content[name], value_kind):
            raise RecordError(
                f"{path} is damaged: `{name}` must be {in_words(value_kind)}. Got {content[name]!r}."
            )
    return content


def _check_numbers(path: Path, episode: EpisodeResult) -> None:
    """Checks that the numbers of an episode name something that there is."""
    try:
        get_task(episode.task_id)
    except ValueError as error:
        raise RecordError(f"{path} is damaged: {error}") from None
    n_objects = len(episode.objects)
    in_range = (
        ("objects", episode.objects, range(N_INDICES)),
        ("object_containers", episode.object_containers, range(-1, 2)),
        ("container_quadrants", sum(episode.container_quadrants, []), range(2)),
        ("target_object", [episode.target_object], range(n_objects)),
        ("target_container", [episode.target_container], range(2)),
        ("grasped_object", [episode.grasped_object], range(-1, n_objects)),
    )
    for name, values, valid in in_range:
        if any(value not in valid for value in values):
            raise RecordError(
                f"{path} is damaged: `{name}` must be in {valid.start}..{valid.stop - 1}. Got {values}."
            )
    shape = [len(ij) for ij in episode.container_quadrants]
    if len(episode.object_containers) != n_objects or shape != [2, 2]:
        raise RecordError(
            f"{path} is damaged: `object_containers` must have a number for each of `objects`, and "
            f"`container_quadrants` the shape (2, 2). Got {episode.object_containers} and "
            f"{episode.container_quadrants}."
        )
