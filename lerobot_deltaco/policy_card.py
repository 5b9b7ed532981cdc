"""The card of a policy on the Hub, as far as it is known at the push: without success rates."""

from __future__ import annotations

import json
import shlex
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import lerobot
from huggingface_hub import ModelCard, ModelCardData
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import LeRobotDatasetMetadata

from lerobot_deltaco.card_templates import env_options, render
from lerobot_deltaco.configuration_deltaco import DeltacoConfig
from lerobot_deltaco.policy.language.encoder_names import LANGUAGE_ENCODERS
from lerobot_deltaco.policy.options import Conditioning
from lerobot_deltaco.policy.training_episodes import kept_episodes
from lerobot_deltaco.policy.vision_encoders import VISION_ENCODERS

TAGS = ("robotics", "lerobot", "deltaco", "imitation-learning")
MAX_TASKS_LISTED = 10

# Name of each method, and the inputs that say which task to perform.
METHOD_TEXTS = {
    "deltaco": (
        "DeL-TaCo",
        "It performs a task from one demonstration and one instruction, even a task it was not trained on.",
    ),
    "language_only": ("language-only baseline", "It performs a task from an instruction alone."),
    "demo_only": ("demonstration-only baseline", "It performs a task from one demonstration alone."),
    "one_hot": (
        "one-hot baseline",
        "It performs one of the tasks that it was trained on, given as a one-hot vector.",
    ),
    "bc_z": (
        "BC-Z baseline",
        "It performs a task from one demonstration, whose embedding was trained to match the instruction's.",
    ),
    "mcil": (
        "MCIL baseline",
        "It performs a task from an instruction or a demonstration. In evaluation, the episodes of a task "
        "use them in turn.",
    ),
}

_TEMPLATE = "policy.md"
_INPUT_TEXTS = {
    "none": "nothing",
    "demo": "the embedding of the demonstration",
    "language": "the embedding of the instruction",
    "demo+language": "the embeddings of the demonstration and of the instruction",
    "one_hot": "a one-hot vector of the task",
    "language_or_demo": "the embedding of the instruction (projected) or of the demonstration",
}

# With goals: the inputs that determine where to grasp, and where to release.
_GOAL_TEXTS = {
    "deltaco": ("the object that the demonstration moved, found in the scene", "the instruction"),
    "demo_only": ("the object that the demonstration moved, found in the scene", "the demonstration"),
    "language_only": ("the instruction", "the instruction"),
    "one_hot": ("the one-hot vector of the task", "the one-hot vector of the task"),
}

_DEMO_ENCODER_TEXTS = {
    "cnn": "the paper's convolutional network, on the array of frames",
    "attention": "a convolutional network with attention, on the stacked frames (ours)",
    "correspondence": "none: the policy looks in the scene for the object that was moved (ours)",
    "pretrained": "the frozen image encoder {encoder}, on the array of frames",
}


def policy_card(
    config: DeltacoConfig,
    shown_tasks: Sequence[str],
    n_instructions: int,
    dataset_repo_id: str | None,
    license: str | None = None,
    tags: Sequence[str] | None = None,
    train_config: TrainPipelineConfig | None = None,
    meta: LeRobotDatasetMetadata | None = None,
) -> ModelCard:
    """A policy's card. What is not known is left out.

    Args:
        config: Configuration of the policy.
        shown_tasks: Tasks that the policy carries demonstrations of, each once.
        n_instructions: Number of instructions whose embeddings the policy carries.
        dataset_repo_id: Repository id of the training dataset.
        license: License of the weights, by its name on the Hub; None for LeRobot's default.
        tags: Additional tags.
        train_config: Configuration of the training.
        meta: Metadata of the training dataset.
    """
    name, summary = METHOD_TEXTS[config.method]
    film, concat, _ = config.conditioning
    inputs = {key: tuple(feature.shape) for key, feature in (config.input_features or {}).items()}
    cameras = {key: inputs[key] for key in config.image_features}
    trained = _training_tasks(train_config, meta)
    benchmark_image = _benchmark_image(meta)
    program, where = _example(config, list(shown_tasks) or list(trained), benchmark_image, train_config, meta)
    metadata = ModelCardData(
        license=license or "apache-2.0",
        library_name="lerobot",
        pipeline_tag="robotics",
        tags=list(dict.fromkeys([*TAGS, config.method, *(tags or ())])),
        datasets=[dataset_repo_id] if dataset_repo_id else None,
        model_name=config.type,
    )
    text = render(
        _TEMPLATE,
        metadata=metadata.to_yaml().strip(),
        title=f"{name}, trained on {dataset_repo_id}" if dataset_repo_id else name,
        lerobot_version=lerobot.__version__,
        version=version("lerobot_policy_deltaco"),
        summary=summary,
        changed={
            part: getattr(config, part) for part in Conditioning._fields if getattr(config, part) is not None
        },
        license=metadata.license,
        dataset=dataset_repo_id,
        n_episodes=sum(trained.values()),
        training_tasks=list(trained),
        benchmark=benchmark_image and benchmark_image["info"],
        robot_type=meta and meta.robot_type,
        film=_INPUT_TEXTS[film],
        concat=_concat_text(config),
        encoder_loss=_encoder_loss_text(config),
        uses_language=config.uses_language,
        uses_language_input="language" in film
        or "language" in concat
        or (config.locates_goals and config.uses_language),
        goals=_GOAL_TEXTS[config.method] if config.locates_goals else None,
        uses_demo=config.uses_demo,
        config=config,
        language_repo_id=LANGUAGE_ENCODERS[config.language_encoder].repo_id,
        demo_frames="the first and the last" + (", and random ones between" * (config.n_demo_frames > 2)),
        demo_encoder=_DEMO_ENCODER_TEXTS[config.demo_encoder].format(encoder=_encoder_name(config)),
        shown_tasks=[_one_line(task) for task in shown_tasks],
        max_listed=MAX_TASKS_LISTED,
        n_instructions=n_instructions,
        cameras=cameras,
        other_inputs={key: shape for key, shape in inputs.items() if key not in cameras},
        action_shape=tuple(config.action_feature.shape),
        training=_training(config, train_config),
        repo_id=config.repo_id or "USER/NAME",
        program=program,
        where=where,
        needs_source=config.uses_demo and not shown_tasks,
        example_task=json.dumps(_example_task(config, [*shown_tasks, *trained]), ensure_ascii=False),
    )
    return ModelCard(text)


def _training_tasks(
    train_config: TrainPipelineConfig | None, meta: LeRobotDatasetMetadata | None
) -> dict[str, int]:
    """For each task that was trained on, the number of its episodes."""
    if meta is None:
        return {}
    dataset = train_config.dataset if train_config is not None else None
    tasks = meta.episodes["tasks"][:]
    counts: dict[str, int] = {}
    for episode in kept_episodes(meta, dataset and dataset.episodes, dataset.eval_split if dataset else 0.0):
        counts[tasks[episode][0]] = counts.get(tasks[episode][0], 0) + 1
    return counts


def _benchmark_image(meta: LeRobotDatasetMetadata | None) -> dict[str, Any] | None:
    """The feature of the images, if the dataset is of the benchmark."""
    image = meta.features.get("observation.image", {}) if meta is not None else {}
    return image if "benchmark" in (image.get("info") or {}) else None


def _concat_text(config: DeltacoConfig) -> str:
    parts = [] if config.conditioning.concat == "none" else [_INPUT_TEXTS[config.conditioning.concat]]
    if config.robot_state_feature:
        parts.append("the robot's state")
    return ", and ".join(parts) or "nothing"


def _encoder_loss_text(config: DeltacoConfig) -> str:
    weight = f"weight {config.encoder_loss_weight:g}"
    return {
        "contrastive": f"contrastive, with the instructions of the batch; {weight}, temperature "
        f"{config.temperature:g}",
        "cosine": f"1 - cosine of the demonstration's and the instruction's embedding; {weight}",
        "none": "none",
    }[config.conditioning.encoder_loss]


def _training(config: DeltacoConfig, train_config: TrainPipelineConfig | None) -> dict[str, Any]:
    """The most important options, by name."""
    options: dict[str, Any] = {}
    if train_config is not None:
        options |= {"steps": f"{train_config.steps:,}", "batch size": train_config.batch_size}
    preset = config.get_optimizer_preset()
    optimizer = getattr(train_config, "optimizer", None) or preset
    # Fused or not, AdamW without weight decay is Adam.
    is_adam = isinstance(optimizer, type(preset)) and not optimizer.weight_decay
    course = config.scheduler_name
    if course != "constant" and config.scheduler_warmup_steps:
        course += f" after {config.scheduler_warmup_steps:,} steps"
    options |= {
        "optimizer": "Adam" if is_adam else optimizer.type,
        "learning rate": f"{optimizer.lr:g}, {course}",
    }
    if optimizer.weight_decay:
        options["weight decay"] = f"{optimizer.weight_decay:g}"
    if config.tasks_per_batch:
        options["tasks in a batch"] = config.tasks_per_batch
    if config.tasks_per_batch and config.upsampled_tasks is not None:
        share = f"{config.upsampled_share:.0%} of each batch"
        options["tasks drawn more often"] = f"those with `{config.upsampled_tasks}`, {share}"
    if train_config is not None:
        options["seed"] = train_config.seed
    options |= {
        "seed of demonstrations and crops": config.seed,
        "backbone": config.backbone,
        "image size": f"{config.image_size} x {config.image_size}",
        "random shifts of observations": f"up to {config.crop_padding} pixels",
        "precision": config.dtype,
    }
    if config.pretrained_matching:
        options["matching"] = "also by the features of EfficientNet-Lite0, trained on ImageNet"
    if config.goal_image_size is not None:
        options["image size for finding goals"] = f"{config.goal_image_size} x {config.goal_image_size}"
    if config.gripper_index is not None:
        kind = config.gripper_loss.replace("_", " ")
        options["gripper loss"] = f"{kind}, weight {config.gripper_weight:g}"
    return options


def _example(
    config: DeltacoConfig,
    tasks: Sequence[str],
    benchmark_image: dict[str, Any] | None,
    train_config: TrainPipelineConfig | None,
    meta: LeRobotDatasetMetadata | None,
) -> tuple[str, str]:
    """The command that runs the policy where it was trained to act, and its options for that."""
    env = train_config.env if train_config is not None else None
    episodes = "--eval.n_episodes=2 --eval.batch_size=2"
    if benchmark_image is not None:
        env_tasks = env.task if env is not None and env.type == "deltaco" else "TASKS"
        return "lerobot-eval", (
            f"--env.type=deltaco --env.task={shlex.quote(env_tasks)}{env_options(benchmark_image)} {episodes}"
        )
    if env is not None:
        env_task = getattr(env, "task", None)
        words = [f"--env.type={env.type}", *([f"--env.task={env_task}"] if env_task else [])]
        return "lerobot-eval", f"{shlex.join(words)} {episodes}"
    fps = meta.fps if meta is not None else 30  # LeRobot's default
    cameras = ", ".join(
        f"{key.split('.')[-1]}: {{type: opencv, index_or_path: {n}, width: {feature.shape[2]}, "
        f"height: {feature.shape[1]}, fps: {fps}}}"
        for n, (key, feature) in enumerate(config.image_features.items())
    )
    robot = (meta.robot_type if meta is not None else None) or "ROBOT"
    return "lerobot-rollout", (
        f"--robot.type={robot} --robot.port=PORT \\\n    --robot.cameras={shlex.quote(f'{{{cameras}}}')} \\\n"
        f"    --task={shlex.quote(_example_task(config, tasks))} --fps={fps} --duration=60"
    )


def _example_task(config: DeltacoConfig, tasks: Sequence[str]) -> str:
    return _one_line(next(iter([*tasks, *config.one_hot_tasks]), "the instruction"))


def _one_line(text: str) -> str:
    return " ".join(text.split())


def _encoder_name(config: DeltacoConfig) -> str:
    """The frozen image encoder; of a folder, no more than its own name."""
    known = config.vision_encoder in VISION_ENCODERS or not Path(config.vision_encoder).exists()
    return config.vision_encoder if known else Path(config.vision_encoder).name
