"""The card of a policy for the Hugging Face Hub, from the template beside this file."""

from __future__ import annotations

import html
import json
import re
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

import draccus
import jinja2
from huggingface_hub import ModelCard, ModelCardData
from lerobot.configs import PreTrainedConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import LeRobotDatasetMetadata

from lerobot_deltaco.policies.base.configuration import TaskConditionedConfig
from lerobot_deltaco.policies.base.language import LANGUAGE_ENCODERS

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
# Options of a policy that its card omits: LeRobot's own, and those shown elsewhere.
_HIDDEN = {
    "input_features",
    "output_features",
    "normalization_mapping",
    "known_words",
    "trained_tasks",
    "held_out_episodes",
    "n_dataset_frames",
    "gripper_range",
    "one_hot_tasks",
    "type",
}


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
    encoder = getattr(config, "language_encoder", None)
    kind = str(getattr(config, "method", config.type))
    training_tasks = [] if meta is None else list(meta.tasks.index)
    image = {} if meta is None else meta.features[config.cameras[0]].get("info") or {}
    lerobot_options = set(draccus.encode(PreTrainedConfig.get_choice_class("act")()))
    options = {
        name: value
        for name, value in draccus.encode(config).items()
        if value is not None and name not in lerobot_options | _HIDDEN
    }
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
    extras = [name for name, is_used in (("sim", "benchmark" in image), ("language", encoder)) if is_used]
    title = config.type if dataset_repo_id is None else f"{config.type}, trained on {dataset_repo_id}"
    template = jinja2.Template(
        Path(__file__).with_suffix(".md").read_text(encoding="utf-8"),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    text = template.render(
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
        demonstrated_tasks=[_markdown(task) for task in demonstrated_tasks],
        language_repo_id=None if encoder is None else LANGUAGE_ENCODERS[encoder].repo_id,
        repo_id=config.repo_id or "USER/NAME",
        example_task=json.dumps(next(iter([*demonstrated_tasks, *training_tasks]), "the instruction"))[1:-1],
        inputs={name: tuple(feature.shape) for name, feature in config.input_features.items()},
        action_shape=tuple(config.action_feature.shape),
        options={name: _markdown(str(value)) for name, value in options.items()},
        extras=f"[{','.join(extras)}]" if extras else "",
    )
    return ModelCard(text)


def _markdown(text: str) -> str:
    """Escapes a string for Markdown and HTML, on one line."""
    line = html.escape(" ".join(text.split()), quote=False)
    return re.sub(r"([\\`*_\[\]|~])", r"\\\1", line)
