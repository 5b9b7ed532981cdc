"""Records of evaluations in Parquet: the plan, and the outcome of every episode.

One file holds any number of evaluations. A row is an episode; docs/records.md describes the columns. Values
that follow from the plan are not stored: `scene_columns` computes them. The schema's metadata contain the
fields that describe the whole evaluation, as JSON under the key `deltaco`: those of `EvaluationRecord`.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields
from functools import cache
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from gymnasium.utils import seeding

from gym_deltaco.layout import sample_layout
from gym_deltaco.paraphrases import GRAMMAR
from gym_deltaco.scene_config import SceneConfig
from gym_deltaco.seeding import episode_seed
from gym_deltaco.tasks import get_task, select_tasks
from lerobot_deltaco.atomic_files import atomic_write
from lerobot_deltaco.errors import UserError
from lerobot_deltaco.evaluation.sealed import SEALED, sealed_seed, sealed_splits

SCHEMA = pa.schema(
    {
        "evaluation": pa.int32(),
        "task_id": pa.int32(),
        "trial": pa.int32(),
        "success": pa.bool_(),
        "instruction": pa.string(),
        "demonstration_task": pa.int32(),
        "demonstration_episodes": pa.list_(pa.int32()),
        "demonstrated_objects": pa.list_(pa.int32()),
        "grasped_object": pa.int8(),
        "object_containers": pa.list_(pa.int8()),
        "right_object": pa.bool_(),
        "right_container": pa.bool_(),
        "pick_confidence": pa.float32(),
        "pick_error": pa.float32(),
        "place_error": pa.float32(),
        "failure": pa.string(),
    }
)
TEMPLATES = "templates"
_KEY = b"deltaco"

Counterfactual = Literal["none", "demonstration", "instruction"]
Oracle = Literal["none", "location", "controller"]


@dataclass(frozen=True)
class EvaluationPlan:
    """The episodes of an evaluation; equal plans give equal scenes, whatever the policy.

    Args:
        tasks: Tasks: a task set, or indices and ranges, such as 4,50-73.
        trials: Number of episodes of each task.
        seed: Seed of the scenes: trial i has the scene that `lerobot-eval` shows for its seed `seed` + i.
        scene_split: "sealed" for the scenes that a release opens. Or number of a split of scenes, for records
            that are older than the protocol: the scenes then derive from the seed, this number, the task and
            the trial.
        scene: Settings of the scenes.
        counterfactual: Input that is replaced by another task's: none, demonstration or instruction. That
            task asks for another object of the scene and for the other container, if there is such a task.
        without: Input that is left out: none, demonstration or instruction.
        photo: Whether a photo takes the place of the demonstration: of the task's object in another scene,
            with a point on it.
        n_demonstrations: Number of demonstrations of each task that the policy combines.
        paraphrases: CSV file with sentences for the tasks, which the trials of a task use in turn. By
            default, the instructions are the benchmark's templates.
        paraphrases_split: Split of that file: all; held_out, the last sentence of each task; or train, the
            sentences that are not held out for any task.
        instruction: A sentence that replaces the instruction of every task.
        joint_noise: Standard deviation of the noise on each joint angle that the policy observes, degrees.
        oracle: What the benchmark does in place of the policy: none; location, it says where to pick and
            place; or controller, its scripted expert moves the arm to where the policy would pick and place.

    Raises:
        UserError: An argument is invalid; the message says what is valid.
    """

    tasks: str = "scenario_a_test"
    trials: int = 4
    seed: int = 1000
    scene_split: int | str | None = None
    scene: SceneConfig = field(default_factory=SceneConfig)
    counterfactual: Counterfactual = "none"
    without: Counterfactual = "none"
    photo: bool = False
    n_demonstrations: int = 1
    paraphrases: str | None = None
    paraphrases_split: str = "all"
    instruction: str | None = None
    joint_noise: float = 0.0
    oracle: Oracle = "none"

    def __post_init__(self) -> None:
        object.__setattr__(self, "scene", self.scene.for_tasks(self.tasks))
        self.scene.check_tasks(self.task_ids)
        leasts = {"trials": 1, "seed": 0, "scene_split": 0, "n_demonstrations": 1, "joint_noise": 0}
        for name, least in leasts.items():
            number = getattr(self, name)
            if isinstance(number, int | float) and number < least:
                raise UserError(f"`{name}` must be at least {least}. Got {number}.")
        if self.scene_split == SEALED:
            object.__setattr__(self, "scene_split", sealed_splits()[-1])
        if isinstance(self.scene_split, str) and self.scene_split not in sealed_splits():
            valid_splits = ", ".join([SEALED, *sealed_splits()])
            raise UserError(
                f"`scene_split` must be a number or one of {valid_splits}. Got {self.scene_split!r}."
            )
        kinds = {"counterfactual": Counterfactual, "without": Counterfactual, "oracle": Oracle}
        for name, valid in ((name, get_args(kind)) for name, kind in kinds.items()):
            if getattr(self, name) not in valid:
                raise UserError(f"`{name}` must be one of {', '.join(valid)}. Got {getattr(self, name)!r}.")
        if self.photo and (self.counterfactual, self.without, self.n_demonstrations) != ("none", "none", 1):
            raise UserError(
                "A photo takes the place of one demonstration, and needs the instruction: leave out "
                "`counterfactual`, `without` and `n_demonstrations`."
            )
        if self.wording != TEMPLATES and "instruction" in (self.counterfactual, self.without):
            raise UserError(
                "An instruction that is replaced or left out is not a paraphrase: leave out `paraphrases` "
                "and `instruction`."
            )

    @property
    def task_ids(self) -> tuple[int, ...]:
        """Indices of the tasks."""
        return select_tasks(self.tasks)

    def scene_seed(self, task_id: int, trial: int) -> int:
        """Returns the seed of an episode's reset.

        Raises:
            UserError: The scenes are sealed.
        """
        if isinstance(self.scene_split, str):
            return episode_seed(sealed_seed(self.scene_split), "evaluation", task_id, self.seed, trial)
        if self.scene_split is None:
            return episode_seed(0, "evaluation", task_id, 0, self.seed + trial)
        return episode_seed(self.seed, "evaluation", task_id, self.scene_split, trial)

    @property
    def wording(self) -> str:
        """Source of the instructions: "templates", the sentence itself, or a file with its SHA-256."""
        if self.instruction is not None:
            return self.instruction
        if self.paraphrases is None:
            return TEMPLATES
        if self.paraphrases == GRAMMAR:
            return f"{GRAMMAR} ({self.paraphrases_split})"
        path = Path(self.paraphrases)
        digest = hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else "unknown"
        return f"{path.name} ({self.paraphrases_split}), SHA-256 {digest}"


@dataclass(frozen=True)
class EvaluationRecord:
    """An evaluation of one checkpoint.

    Args:
        experiment: Name of the experiment; runs of the same name differ only in their seeds.
        policy_type: Type of the policy, such as "deltaco_match".
        train_seed: Seed of the training.
        step: Training step of the checkpoint.
        plan: Episodes that were run.
        wording: Source of the instructions, as `EvaluationPlan.wording` has it.
        policy: The policy's configuration.
        versions: Version of the benchmark ("benchmark": the environment's id) and of the relevant packages.
        command: Command line of the evaluation.
        seconds: Duration, s.
        weights: SHA-256 of the checkpoint's weights; None if it was not recorded.
        demonstrations: Name of the dataset of demonstrations; None for those of the checkpoint.
        demonstrations_digest: SHA-256 of that dataset's metadata.
        episodes: A row for each episode, with the columns of `SCHEMA` but `evaluation`.
    """

    experiment: str
    policy_type: str
    train_seed: int
    step: int
    plan: EvaluationPlan
    wording: str
    policy: dict[str, Any]
    versions: dict[str, str]
    command: str
    seconds: float
    weights: str | None
    demonstrations: str | None
    demonstrations_digest: str | None
    episodes: pd.DataFrame

    @property
    def success_rate(self) -> float:
        """Fraction of the episodes that succeeded, 0..1."""
        return float(self.episodes["success"].mean())


def write_records(path: Path, records: Sequence[EvaluationRecord]) -> None:
    """Writes evaluations into one file, whole or not at all.

    Raises:
        UserError: The rows of an evaluation contradict each other.
    """
    for record in records:
        _check(record, path)
    names = [item.name for item in fields(EvaluationRecord) if item.name != "episodes"]
    headers = [
        {name: getattr(record, name) for name in names} | {"plan": asdict(record.plan)} for record in records
    ]
    rows = pd.concat([record.episodes.assign(evaluation=n) for n, record in enumerate(records)])
    table = pa.Table.from_pandas(rows, SCHEMA, preserve_index=False)
    table = table.replace_schema_metadata({_KEY: json.dumps(headers).encode()})
    with atomic_write(path) as temporary:
        pq.write_table(table, temporary, compression="zstd", compression_level=9)


def read_records(*paths: Path) -> list[EvaluationRecord]:
    """Reads evaluations.

    Args:
        paths: Files, or folders that are searched for files.

    Raises:
        UserError: A path has no records, or a file is not one of records.
    """
    records = []
    for path in paths:
        files = sorted(path.rglob("*.parquet")) if path.is_dir() else [path]
        # Datasets are Parquet, too, in folders with these names.
        found = [
            record
            for file in files
            if not {"data", "meta"} & set(file.relative_to(path).parts)
            for record in _read(file)
        ]
        if not found:
            raise UserError(f"{path} has no records of evaluations. `deltaco evaluate` writes them.")
        records += found
    return records


def _read(path: Path) -> list[EvaluationRecord]:
    try:
        table = pq.read_table(path)
        headers = json.loads((table.schema.metadata or {})[_KEY])
        rows = table.select(SCHEMA.names).to_pandas()
        records = []
        for n, header in enumerate(headers):
            plan = header.pop("plan")
            plan["scene"] = SceneConfig(**plan["scene"])
            episodes = rows[rows["evaluation"] == n].drop(columns="evaluation").reset_index(drop=True)
            records.append(EvaluationRecord(plan=EvaluationPlan(**plan), episodes=episodes, **header))
    except (OSError, KeyError, TypeError, ValueError, RecursionError, pa.ArrowException) as error:
        raise UserError(f"{path} is not a file of evaluation records: {error}") from error
    for record in records:
        _check(record, path)
    return records


def _check(record: EvaluationRecord, path: Path) -> None:
    """Checks that the rows of an evaluation contradict neither each other nor its plan.

    Raises:
        UserError: They contradict each other.
    """
    rows, task_ids, trials = record.episodes, record.plan.task_ids, record.plan.trials
    conditions = {
        f"{len(task_ids) * trials} episodes": len(rows) == len(task_ids) * trials,
        "each task and trial of the plan once": (
            rows["task_id"].isin(task_ids)
            & rows["trial"].between(0, trials - 1)
            & ~rows.duplicated(["task_id", "trial"])
        ),
        "demonstrated tasks of the plan, or -1": rows["demonstration_task"].isin([-1, *task_ids]),
        "a grasped object where it is the right one": ~rows["right_object"] | (rows["grasped_object"] >= 0),
    }
    for name, holds in conditions.items():
        if not np.all(holds):
            raise UserError(f"{path} contradicts itself: {record.experiment!r} must have {name}.")


def scene_columns(record: EvaluationRecord) -> pd.DataFrame:
    """Computes values that follow from the task, trial and plan of each episode, without a simulator.

    Returns:
        A row for each episode: `seed`; `template`, the task's instruction; `objects`, indices of the three
        objects; `container_quadrants`, (i, j) of the green and the red container; `target_object` and
        `target_container`, their numbers in the scene; and `success_at_end`, whether the target lies in its
        container, released, after the last step.
    """
    tasks_and_trials = record.episodes[["task_id", "trial"]].itertuples(index=False)
    seeds = [(task_id, record.plan.scene_seed(task_id, trial)) for task_id, trial in tasks_and_trials]
    rows = [_scene(task_id, seed, record.plan.scene) for task_id, seed in seeds]
    scenes = pd.DataFrame(rows, index=record.episodes.index)
    placed = zip(record.episodes["object_containers"], scenes["target_object"], strict=True)
    ends = np.array([containers[target] for containers, target in placed])
    return scenes.assign(success_at_end=ends == scenes["target_container"])


@cache  # Many evaluations have the same scenes, of which each takes a millisecond.
def _scene(task_id: int, seed: int, scene: SceneConfig) -> dict[str, Any]:
    task = get_task(task_id)
    layout = sample_layout(task, scene, seeding.np_random(seed)[0])
    return {
        "seed": seed,
        "template": task.instruction,
        "objects": [item.label.index for item in layout.objects],
        "container_quadrants": [list(item.quadrant) for item in layout.containers],
        "target_object": layout.target_object,
        "target_container": layout.target_container,
    }
