"""Cards of policies and benchmark datasets for the Hugging Face Hub, from templates in `datasets_cards/`."""

from __future__ import annotations

import html
import io
import json
import re
import shlex
import textwrap
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jinja2
import numpy as np
import pyarrow.parquet as pq
from PIL import Image

from gym_deltaco.atomic_files import read_json, write_text
from gym_deltaco.tasks import SCENARIOS, get_task
from lerobot_deltaco.collection.collect import read_description, read_plan
from lerobot_deltaco.collection.writer import INFO_FILE

if TYPE_CHECKING:
    from huggingface_hub import ModelCard
    from lerobot.configs.train import TrainPipelineConfig
    from lerobot.datasets import LeRobotDatasetMetadata

    from lerobot_deltaco.policies.base.configuration import TaskConditionedConfig

_TAGS = ("robotics", "lerobot", "deltaco", "imitation-learning")
_SUMMARIES = {
    "deltaco": "It performs a task from one demonstration and one instruction, as in the paper DeL-TaCo.",
    "language_only": "It performs a task from an instruction alone: a baseline of DeL-TaCo.",
    "demo_only": "It performs a task from one demonstration alone: a baseline of DeL-TaCo.",
    "one_hot": "It performs one of the tasks that it was trained on, given by its number.",
    "bc_z": "It performs a task from one demonstration: the baseline BC-Z of DeL-TaCo.",
    "mcil": "It performs a task from an instruction or a demonstration: the baseline MCIL of DeL-TaCo.",
    "deltaco_match": "It looks in the scene for what a demonstration moved or an instruction names, and "
    "places it where the instruction says or the demonstration shows.",
}
TASKS_IMAGE = "assets/tasks.png"
# Options of a policy that its card omits: LeRobot's own, and those shown elsewhere.
_HIDDEN = {
    "input_features",
    "output_features",
    "normalization_mapping",
    "known_words",
    "gripper_range",
    "one_hot_tasks",
    "type",
}


def render(template: str, **values: Any) -> str:
    """Fills in a template; a missing value is an error.

    Templates lie beside the package in a clone, and inside it in a wheel.
    """
    package = Path(__file__).parents[1]
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader([package / "datasets_cards", package.parent / "datasets_cards"]),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters["quote"] = lambda value: shlex.quote(str(value))
    return environment.get_template(template).render(**values)


def policy_card(
    config: TaskConditionedConfig,
    demonstrated_tasks: Sequence[str],
    dataset_repo_id: str | None,
    license: str | None = None,
    tags: list[str] | None = None,
    train_config: TrainPipelineConfig | None = None,
    meta: LeRobotDatasetMetadata | None = None,
) -> ModelCard:
    """Returns the card of a policy as known when it is pushed, without success rates.

    Args:
        config: Configuration of the policy.
        demonstrated_tasks: Tasks that the checkpoint has demonstrations of.
        dataset_repo_id: Repository id of the training dataset.
        license: License of the weights, as named on the Hub; None for Apache 2.0.
        tags: Additional tags.
        train_config: Configuration of the training run.
        meta: Metadata of the training dataset.
    """
    import draccus
    from huggingface_hub import ModelCard, ModelCardData
    from lerobot.configs import PreTrainedConfig

    from lerobot_deltaco.policies.base.language import LANGUAGE_ENCODERS

    encoder = getattr(config, "language_encoder", None)
    kind = str(getattr(config, "method", config.type))
    training_tasks = [] if meta is None else list(meta.tasks.index)
    image = {} if meta is None else meta.features[config.cameras[0]].get("info") or {}
    lerobot_options = set(draccus.encode(PreTrainedConfig.get_choice_class("act")()))
    own = {name: value for name, value in draccus.encode(config).items() if name not in lerobot_options}
    options = {name: value for name, value in own.items() if value is not None and name not in _HIDDEN}
    if train_config is not None:
        options = {
            "steps": train_config.steps,
            "batch_size": train_config.batch_size,
            "seed of the training": train_config.seed,
            **options,
        }
    metadata = ModelCardData(
        license=license or "apache-2.0",
        library_name="lerobot",
        pipeline_tag="robotics",
        tags=list(dict.fromkeys([*_TAGS, config.type, *(tags or ())])),
        datasets=[dataset_repo_id] if dataset_repo_id else None,
        model_name=config.type,
    )
    title = config.type if dataset_repo_id is None else f"{config.type}, trained on {dataset_repo_id}"
    text = render(
        "policy.md",
        metadata=metadata.to_yaml().strip(),
        title=title,
        lerobot_version=version("lerobot"),
        version=version("lerobot_policy_deltaco"),
        summary=_SUMMARIES[kind],
        config=config,
        license=metadata.license,
        dataset=dataset_repo_id,
        training_tasks=training_tasks,
        benchmark=image if "benchmark" in image else None,
        robot_type=None if meta is None else meta.robot_type,
        demonstrated_tasks=[markdown(task) for task in demonstrated_tasks],
        language_repo_id=None if encoder is None else LANGUAGE_ENCODERS[encoder].repo_id,
        repo_id=config.repo_id or "USER/NAME",
        example_task=json.dumps(next(iter([*demonstrated_tasks, *training_tasks]), "the instruction"))[1:-1],
        inputs={name: tuple(feature.shape) for name, feature in config.input_features.items()},
        action_shape=tuple(config.action_feature.shape),
        options={name: markdown(str(value)) for name, value in options.items()},
        citation=render("citation.md"),
    )
    return ModelCard(text)


def markdown(text: str) -> str:
    """Escapes a string for Markdown and HTML, on one line."""
    line = html.escape(" ".join(text.split()), quote=False)
    return re.sub(r"([\\`*_\[\]|~])", r"\\\1", line)


def dataset_card(root: Path, repo_id: str | None = None) -> str:
    """Returns the card of a finished dataset: YAML metadata, then Markdown.

    Args:
        root: Folder of the dataset.
        repo_id: Name of the dataset on the Hub; None if it is only in a folder.
    """
    files = [path for name in ("data", "meta") for path in (root / name).rglob("*") if path.is_file()]
    return render(
        "benchmark_dataset.md",
        info=read_json(root / INFO_FILE),
        origin=read_description(root),
        tasks=[get_task(task_id) for task_id in read_plan(root).task_ids],
        scenarios=list(SCENARIOS.values()),
        repo_id=repo_id,
        tasks_image=TASKS_IMAGE,
        megabytes=sum(path.stat().st_size for path in files) / 1e6,
    )


def write_dataset_card(root: Path, repo_id: str) -> None:
    """Writes the card of a finished dataset, and a picture of up to twelve of its tasks, into its folder."""
    from matplotlib.figure import Figure

    plan = read_plan(root)
    camera = plan.scene.interface.camera_keys[0]
    shown = np.unique(np.linspace(0, len(plan.task_ids) - 1, 12).round().astype(int))
    episodes = pq.read_table(
        root / "data",
        columns=[camera, "benchmark.task_id"],
        filters=[("frame_index", "==", 0), ("episode_index", "in", shown * plan.episodes_per_task)],
    ).to_pylist()
    figure = Figure(figsize=(10, 9), layout="constrained")
    for axes, episode in zip(figure.subplots(3, 4).flat, episodes, strict=False):
        axes.imshow(Image.open(io.BytesIO(episode[camera]["bytes"])))
        axes.set_title(textwrap.fill(get_task(episode["benchmark.task_id"]).instruction, 30), fontsize=8)
    for axes in figure.axes:
        axes.axis("off")
    (root / TASKS_IMAGE).parent.mkdir(exist_ok=True)
    figure.savefig(root / TASKS_IMAGE, dpi=120)
    write_text(root / "README.md", dataset_card(root, repo_id))
