"""Recipes of experiments: the rows of the paper's tables and the project's own.

A recipe in `experiments.yaml` is read into the plans and options of the steps of an experiment, so that
mistakes are found before anything is collected.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import draccus
import yaml

from lerobot_deltaco.atomic_files import read_json
from lerobot_deltaco.collection.collect import CollectionPlan
from lerobot_deltaco.errors import UserError
from lerobot_deltaco.evaluation.records import EvaluationPlan

if TYPE_CHECKING:
    from lerobot.configs import PreTrainedConfig

Scale = Literal["small", "paper"]

SCALES: tuple[Scale, ...] = ("small", "paper")
RECIPES = Path(__file__).with_name("experiments.yaml")
SHARED = "shared"  # settings of all rows of a family
SECTIONS = ("data", "demonstrations", "policy", "training", "evaluation")


@dataclass(frozen=True)
class TrainingOptions:
    """Options of LeRobot's training loop that recipes use.

    Args:
        batch_size: Number of samples of a training step.
        steps: Number of training steps.
        save_freq: Steps between two checkpoints, all of which are evaluated.
        log_freq: Steps between two lines of the log.

    Raises:
        UserError: A number is less than 1.
    """

    batch_size: int
    steps: int
    save_freq: int
    log_freq: int = 200

    def __post_init__(self) -> None:
        if min(asdict(self).values()) < 1:
            raise UserError(f"All numbers must be at least 1. Got {asdict(self)}.")


@dataclass(frozen=True)
class Recipe:
    """An experiment at a scale.

    Args:
        name: Name of the experiment, such as "scenario_a/deltaco".
        scale: Amount of data and training.
        data: Training data.
        demonstrations: Collection of demonstrations of the test tasks.
        policy: Type of the policy, and those of its options that are not defaults.
        training: Options of the training loop.
        evaluation: Evaluation of every checkpoint.
        start_from: Experiment whose best seed is fine-tuned; None to train from scratch.
    """

    name: str
    scale: Scale
    data: CollectionPlan
    demonstrations: CollectionPlan
    policy: Mapping[str, Any]
    training: TrainingOptions
    evaluation: EvaluationPlan
    start_from: str | None = None


def experiment_names(path: Path = RECIPES) -> list[str]:
    """Returns the names of all experiments, in the order of the file."""
    families = _read_file(path)["families"]
    return [f"{family}/{row}" for family, rows in families.items() for row in rows if row != SHARED]


def expand_families(names: Sequence[str]) -> list[str]:
    """Returns names of experiments, with those of its experiments in place of a family's."""
    every = experiment_names()
    expanded = ([each for each in every if each.startswith(f"{name}/")] or [name] for name in names)
    return list(dict.fromkeys(itertools.chain.from_iterable(expanded)))


def read_recipe(
    name: str, scale: Scale = "small", settings: Sequence[str] = (), path: Path = RECIPES
) -> Recipe:
    """Reads a recipe.

    Args:
        name: Name of an experiment, such as "scenario_a/deltaco".
        scale: Amount of data and training.
        settings: Settings that take precedence, such as "training.steps=2000" or
            "data.scene.objects=random:100".
        path: File with recipes.

    Raises:
        UserError: There is no such experiment, or the file or a setting is invalid.
    """
    content, names = _read_file(path), experiment_names(path)
    if name not in names:
        raise UserError(f"There is no experiment {name!r}. Valid are {', '.join(names)}.")
    family, row = name.split("/")
    rows = content["families"][family]
    layers = [rows.get(SHARED, {}), rows[row], *map(_read_setting, settings)]
    for layer in layers:
        _check_layer(layer, name)
    policy_type = _merged({}, *layers, scale=scale).get("policy", {}).get("type", "deltaco")
    scales = content["scales"].get(policy_type, {})
    if scale not in scales:
        valid = "; ".join(f"{kind}: {', '.join(there)}" for kind, there in content["scales"].items())
        raise UserError(
            f"{name} trains the policy {policy_type!r}, which has no scale {scale!r}. Valid are {valid}."
        )
    merged = _merged(scales[scale], {"policy": {"type": policy_type}}, *layers, scale=scale)
    start_from = merged.get("start_from")
    if start_from is not None and start_from not in names:
        raise UserError(f"{name} starts from {start_from!r}, which is not an experiment.")
    # Null stands for a default.
    sections = {
        section: {option: value for option, value in merged.get(section, {}).items() if value is not None}
        for section in SECTIONS
    }
    make_policy_config(sections["policy"], where=f"policy of {name}")  # or an error
    kinds = {
        "data": CollectionPlan,
        "demonstrations": CollectionPlan,
        "training": TrainingOptions,
        "evaluation": EvaluationPlan,
    }
    plans = {
        section: _decode(kind, sections[section], f"{section} of {name}") for section, kind in kinds.items()
    }
    return Recipe(name, scale, policy=sections["policy"], start_from=start_from, **plans)


def make_policy_config(
    options: Mapping[str, Any], start: Path | None = None, where: str = "policy"
) -> PreTrainedConfig:
    """Returns the configuration of a policy.

    Args:
        options: Its type, and the options that are not defaults.
        start: Folder of the policy that training starts from, whose options are the defaults.
        where: Name of the options in errors.

    Raises:
        UserError: An option is invalid; the message says what is valid.
    """
    from lerobot.configs import PreTrainedConfig  # slow

    import lerobot_policy_deltaco  # noqa: F401  (registers the types of this project)

    if start is not None:
        options = {**read_json(start / "config.json"), **options}
    kind = PreTrainedConfig.get_choice_class(options["type"])
    config = _decode(kind, {name: value for name, value in options.items() if name != "type"}, where)
    config.pretrained_path = start
    return config


@cache
def _read_file(path: Path) -> dict[str, Any]:
    return yaml.safe_load(path.read_text(encoding="utf-8"))


def _read_setting(setting: str) -> dict[str, Any]:
    key, equals, value = setting.partition("=")
    if not equals:
        raise UserError(f"A setting is SECTION.NAME=VALUE, such as training.steps=2000. Got {setting!r}.")
    try:
        nested = yaml.safe_load(value)
    except yaml.YAMLError as error:
        raise UserError(f"Cannot read the value of {setting!r}: {error}") from None
    for name in reversed(key.split(".")):
        nested = {name: nested}
    return nested


def _check_layer(layer: Any, name: str) -> None:
    """Checks that the settings of a recipe are mappings of sections."""
    for section, value in layer.items() if isinstance(layer, dict) else [("", layer)]:
        is_valid = isinstance(value, dict) if section in SECTIONS else section == "start_from"
        if not is_valid:
            raise UserError(
                f"{name} must have the mappings {', '.join(SECTIONS)}, or `start_from`. Got "
                f"{section!r}: {value!r}."
            )


def _merged(*layers: dict[str, Any], scale: str) -> dict[str, Any]:
    """Merges nested settings, of which later ones take precedence."""
    merged: dict[str, Any] = {}
    for key, value in (item for layer in layers for item in layer.items()):
        if isinstance(value, dict) and value and set(value) <= set(SCALES):  # depends on the scale
            if scale not in value:
                continue
            value = value[scale]
        if isinstance(value, dict):
            below = merged.get(key)
            value = _merged(below if isinstance(below, dict) else {}, value, scale=scale)
        merged[key] = value
    return merged


def _decode(kind: Any, settings: Mapping[str, Any], where: str) -> Any:
    """Makes a dataclass of settings."""
    try:
        return draccus.decode(kind, dict(settings))
    except draccus.utils.ParsingError as error:
        reason: BaseException = error
        # An error of the dataclass itself, or of one within it
        while type(reason) is draccus.utils.ParsingError and reason.__cause__ is not None:
            reason = reason.__cause__
        is_of_names = isinstance(error, draccus.utils.DecodingError) and not error.key_path
        valid = f". Valid are {', '.join(field.name for field in fields(kind))}." if is_of_names else ""
        raise UserError(f"{where}: {reason}{valid}") from None
