"""MERGE: delete this file. Stand-ins for `collect` and `records` until they are there."""

import sys
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import ModuleType

import pandas as pd

from gym_deltaco.scene_config import SceneConfig
from gym_deltaco.seeding import episode_seed
from gym_deltaco.tasks import select_tasks

DATA_SETS = ("T198", "T54", "E54", "E102", "T150", "V48")


@dataclass(frozen=True)
class CollectionPlan:
    tasks: str
    episodes_per_task: int
    seed: int = 0
    split: str | None = None
    noise: float = 0.1
    scene: SceneConfig = SceneConfig()

    def __post_init__(self):
        if self.tasks not in DATA_SETS:
            select_tasks(self.tasks)


def is_finished(root):
    return (root / "meta" / "info.json").is_file()


@dataclass(frozen=True)
class EvaluationPlan:
    tasks: str = "scenario_a_test"
    trials: int = 4
    seed: int = 1000
    scene_set: int | None = None
    scene: SceneConfig = SceneConfig()
    counterfactual: str = "none"
    without: str = "none"
    n_demonstrations: int = 1
    paraphrases: str | None = None
    paraphrases_split: str = "all"
    instruction: str | None = None

    @property
    def task_ids(self):
        return select_tasks(self.tasks)

    def scene_seed(self, task_id, trial):
        return episode_seed(0, "evaluation", task_id, 0, self.seed + trial)


@dataclass(frozen=True)
class EvaluationRecord:
    experiment: str
    policy_type: str
    train_seed: int
    step: int
    plan: EvaluationPlan
    wording: str = "templates"
    policy: dict = field(default_factory=dict)
    versions: dict = field(default_factory=dict)
    command: str = ""
    seconds: float = 0.0
    weights: str | None = None
    demonstrations: str | None = None
    demonstrations_digest: str | None = None
    episodes: pd.DataFrame = field(default_factory=pd.DataFrame)

    @property
    def success_rate(self):
        return float(self.episodes["success"].mean())


def write_records(path, records):
    path.parent.mkdir(parents=True, exist_ok=True)
    pd.to_pickle([(asdict(record.plan), record) for record in records], path)


def read_records(*paths):
    files = [file for path in paths for file in (sorted(path.glob("*.parquet")) if path.is_dir() else [path])]
    return [record for file in files for _, record in pd.read_pickle(file)]


def _install():
    import lerobot_deltaco

    package = Path(lerobot_deltaco.__file__).parent
    modules = {
        "collect": (CollectionPlan, is_finished),
        "records": (EvaluationPlan, EvaluationRecord, write_records, read_records),
    }
    for name, items in modules.items():
        if not (package / f"{name}.py").exists():
            module = sys.modules[f"lerobot_deltaco.{name}"] = ModuleType(f"lerobot_deltaco.{name}")
            for item in items:
                setattr(module, item.__name__, item)


_install()
