"""MERGE: delete this file. Stand-ins for `collect`, `records` and the configurations until they are there."""

import sys
import tempfile
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import ModuleType

import pandas as pd

from gym_deltaco.scene_config import SceneConfig
from gym_deltaco.seeding import episode_seed
from gym_deltaco.tasks import select_tasks

DATA_SETS = ("T198", "T54", "E54", "E102", "T150", "V48")

DELTACO = """
class DeltacoConfig(PreTrainedConfig):
    method: str = "deltaco"
    film: str | None = None
    concat: str | None = None
    encoder_loss: str | None = None
    language_encoder: str = ""
    language_head: list[int] | None = None
    paraphrases: str | None = None
    paraphrases_with_templates: bool = False
    demo_encoder: DemoEncoder = "cnn"
    vision_encoder: str | None = None
    vision_image_size: int | None = None
    vision_input: str = "published"
    demo_variants: int = 1
    demo_head: tuple[int, ...] | None = None
    demo_rows: int = 5
    backbone: Literal["paper", "strided"] = "paper"
    num_mixture_components: int = 1
    gripper_loss: str = ""
    shift_padding: int = 4
    demo_shift_padding: int = 4
    drop_n_last_frames: int = 0
    tasks_per_batch: int = 16
    upsampled_tasks: str | None = None
    upsampled_fraction: float = 0.0
    dtype: str = ""
    optimizer_lr: float = 3e-4
    optimizer_weight_decay: float = 0.0
    scheduler_name: str = ""
    scheduler_warmup_steps: int = 0
"""
DELTACO_MATCH = """
class DeltacoMatchConfig(PreTrainedConfig):
    optimizer_lr: float = 1e-3
    demo_episodes: list[int] | None = None
    inputs: str = "both"
    p_drop_demonstration: float = 0.25
    p_drop_instruction: float = 0.25
    feature_matching: bool = True
"""


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
    from lerobot_deltaco import recipes

    if not (package / "base_config.py").exists():
        recipes.PACKAGE = Path(tempfile.mkdtemp())
        for name, source in {"deltaco": DELTACO, "deltaco_match": DELTACO_MATCH}.items():
            path = recipes.PACKAGE / name / f"configuration_{name}.py"
            path.parent.mkdir()
            path.write_text(source)
        (recipes.PACKAGE / "base_config.py").write_text("")


_install()
