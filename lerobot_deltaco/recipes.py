"""Recipes of experiments: the rows of the paper's tables and the project's own.

A recipe in `experiments.yaml` is parsed into the plans and options of the steps of an experiment, so that
mistakes are found before anything is collected.
"""

from __future__ import annotations

import ast
import difflib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, is_dataclass, make_dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

import draccus
import yaml

from lerobot_deltaco.collect import CollectionPlan
from lerobot_deltaco.records import EvaluationPlan

Scale = Literal["small", "paper"]

SCALES: tuple[Scale, ...] = ("small", "paper")
PACKAGE = Path(__file__).parent
RECIPES = PACKAGE / "experiments.yaml"
SHARED = "shared"  # settings of all rows of a family
# Options of a policy that are LeRobot's. The others are those of its configuration class.
LEROBOT_POLICY_OPTIONS = {"type": "str", "device": "str"}


class ExperimentError(RuntimeError):
    """Raised when an experiment cannot start or continue; the message says why."""


@dataclass(frozen=True)
class TrainingOptions:
    """Options of LeRobot's training loop that recipes use.

    Args:
        batch_size: Number of samples of a training step.
        steps: Number of training steps.
        save_freq: Steps between two checkpoints, all of which are evaluated.
        log_freq: Steps between two lines of the log.
    """

    batch_size: int
    steps: int
    save_freq: int
    log_freq: int = 200

    def __post_init__(self) -> None:
        for name, number in asdict(self).items():
            if number < 1:
                raise ValueError(f"`{name}` must be at least 1. Got {number}.")


@dataclass(frozen=True)
class Recipe:
    """An experiment at a scale.

    Args:
        name: Name of the experiment, such as "scenario_a/deltaco".
        scale: Amount of data and training.
        data: Training data.
        demonstrations: Collection of demonstrations of the test tasks.
        policy: Options of `--policy`, with its type.
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


_SECTIONS = ("data", "demonstrations", "policy", "training", "evaluation")


def experiment_names(path: Path = RECIPES) -> list[str]:
    """Returns the names of all experiments, in the order of the file."""
    return _names(_read_file(path))


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
        ExperimentError: There is no such experiment, or the file or a setting is invalid.
    """
    content = _read_file(path)
    names = _names(content)
    if name not in names:
        raise ExperimentError(f"There is no experiment {name!r}. Valid are {', '.join(names)}.")
    family, row = name.split("/")
    rows = content["families"][family]
    own = _merge(rows.get(SHARED, {}), rows[row], *map(_read_setting, settings), scale=scale)
    policy_type = own["policy"].get("type", "deltaco")
    scales = content["scales"].get(policy_type, {})
    if scale not in scales:
        known = "; ".join(f"{kind}: {', '.join(there)}" for kind, there in content["scales"].items())
        raise ExperimentError(
            f"{name} trains the policy {policy_type!r}, which has no scale {scale!r}. Valid are {known}."
        )
    merged = _merge({"policy": {"type": policy_type}}, scales[scale], own, scale=scale)
    start_from = merged.get("start_from")
    if start_from is not None and start_from not in names:
        raise ExperimentError(f"{name} starts from {start_from!r}, which is not an experiment.")
    policy = _parse(policy_options(policy_type), merged["policy"], f"policy of {name}")
    evaluation = _parse(EvaluationPlan, merged["evaluation"], f"evaluation of {name}")
    try:
        _ = evaluation.task_ids
    except ValueError as error:
        raise ExperimentError(f"evaluation of {name}: {error}") from None
    return Recipe(
        name,
        scale,
        data=_parse(CollectionPlan, merged["data"], f"data of {name}"),
        demonstrations=_parse(CollectionPlan, merged["demonstrations"], f"demonstrations of {name}"),
        policy={name: value for name, value in asdict(policy).items() if value is not None},
        training=_parse(TrainingOptions, merged["training"], f"training of {name}"),
        evaluation=evaluation,
        start_from=start_from,
    )


class _Loader(yaml.SafeLoader):
    """YAML without aliases and duplicate keys."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            mark = self.peek_event().start_mark
            raise yaml.MarkedYAMLError(problem="aliases are not supported", problem_mark=mark)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = [key.value for key, _ in node.value]
        if twice := [key for key in keys if keys.count(key) > 1]:
            raise yaml.MarkedYAMLError(problem=f"{twice[0]!r} is there twice", problem_mark=node.start_mark)
        return super().construct_mapping(node, deep)


def _read_yaml(text: str, source: str) -> Any:
    try:
        return yaml.load(text, _Loader)
    except (yaml.YAMLError, RecursionError) as error:
        reason = "it is nested too deeply" if isinstance(error, RecursionError) else error
        raise ExperimentError(f"Cannot read {source}: {reason}") from None


@cache
def _read_file(path: Path) -> dict[str, Any]:
    try:
        content = _read_yaml(path.read_text(encoding="utf-8"), str(path))
    except (OSError, UnicodeDecodeError) as error:
        raise ExperimentError(f"Cannot read {path}: {error}") from None
    for part in ("scales", "families"):
        groups = content.get(part) if isinstance(content, dict) else None
        if not isinstance(groups, dict) or not all(isinstance(group, dict) for group in groups.values()):
            raise ExperimentError(f"{path} must have a mapping of mappings named {part!r}.")
    return content


def _names(content: dict[str, Any]) -> list[str]:
    return [
        f"{family}/{row}" for family, rows in content["families"].items() for row in rows if row != SHARED
    ]


def _read_setting(setting: str) -> dict[str, Any]:
    key, equals, value = setting.partition("=")
    names = key.split(".")
    if names[0] not in _SECTIONS or len(names) < 2 or not equals:
        raise ExperimentError(
            "A setting is SECTION.NAME=VALUE, such as training.steps=2000. The sections are "
            f"{', '.join(_SECTIONS)}. Got {setting!r}."
        )
    nested = _read_yaml(value, f"the value of {setting!r}")
    for name in reversed(names):
        nested = {name: nested}
    return nested


def _merge(*layers: Any, scale: str) -> dict[str, Any]:
    """Merges the layers of a recipe, later ones taking precedence."""
    merged: dict[str, Any] = {section: {} for section in _SECTIONS}
    for layer in layers:
        if not isinstance(layer, dict):
            raise ExperimentError(f"A recipe must be a mapping of {', '.join(_SECTIONS)}. Got {layer!r}.")
        for section, settings in layer.items():
            if section not in (*_SECTIONS, "start_from"):
                raise ExperimentError(
                    f"A recipe has no {section!r}. Valid are {', '.join(_SECTIONS)}, start_from."
                )
            if section in _SECTIONS and not isinstance(settings, dict):
                raise ExperimentError(f"`{section}` of a recipe must be a mapping. Got {settings!r}.")
            merged = _updated(merged, {section: settings}, scale)
    return merged


def _updated(below: dict[str, Any], above: dict[str, Any], scale: str) -> dict[str, Any]:
    merged = dict(below)
    for key, value in above.items():
        if isinstance(value, dict) and value and set(value) <= set(SCALES):  # depends on the scale
            if scale not in value:
                continue
            value = value[scale]
        if isinstance(value, dict):
            inner = merged.get(key)
            value = _updated(inner if isinstance(inner, dict) else {}, value, scale)
        merged[key] = value
    return merged


def _parse(kind: Any, settings: dict[str, Any], where: str) -> Any:
    """Makes a dataclass of settings; null stands for a default."""
    settings = {name: value for name, value in settings.items() if value is not None}
    _check_names(kind, settings, where)
    try:
        parsed = draccus.decode(kind, settings)
    except draccus.utils.DecodingError as error:
        raise ExperimentError(f"{where}: {error}") from None
    except draccus.utils.ParsingError as error:  # an error of the dataclass itself, or of one within it
        reason: BaseException = error
        while isinstance(reason, draccus.utils.ParsingError) and reason.__cause__ is not None:
            reason = reason.__cause__
        raise ExperimentError(f"{where}: {reason}") from None
    for name, value in settings.items():
        # draccus takes true for 1, and anything for a text.
        found = getattr(parsed, name)
        if (
            isinstance(found, str | int)
            and isinstance(value, bool | list | dict | float)
            and found is not value
        ):
            raise ExperimentError(f"{where}: `{name}` must be {type(found).__name__}. Got {value!r}.")
    return parsed


def _check_names(kind: Any, settings: Any, where: str) -> None:
    if not isinstance(settings, dict):
        raise ExperimentError(f"{where} must be a mapping. Got {settings!r}.")
    defaults = {field.name: field.default for field in fields(kind)}
    for name, value in settings.items():
        if name not in defaults:
            similar = difflib.get_close_matches(str(name), defaults, n=1)
            hint = f" Did you mean {similar[0]}?" if similar else ""
            raise ExperimentError(f"{where} has no {name!r}.{hint} Valid are {', '.join(sorted(defaults))}.")
        if is_dataclass(defaults[name]):
            _check_names(type(defaults[name]), value, f"{name} in {where}")


@cache
def policy_options(policy_type: str) -> Any:
    """Reads the options of a policy and their types from the source of its configuration class.

    Importing the class would import LeRobot, which takes seconds.

    Returns:
        A dataclass of the options, all of which default to None.
    """
    path = PACKAGE / policy_type / f"configuration_{policy_type}.py"
    if not path.is_file():
        raise ExperimentError(f"There is no policy {policy_type!r}. Valid are deltaco and deltaco_match.")
    options = dict(LEROBOT_POLICY_OPTIONS)
    for source in (PACKAGE / "base_config.py", path):
        for node in ast.parse(source.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef) and node.name.endswith("Config"):
                items = [item for item in node.body if isinstance(item, ast.AnnAssign)]
                options |= {ast.unparse(item.target): ast.unparse(item.annotation) for item in items}
    return make_dataclass(policy_type, [(name, _resolve(kind), None) for name, kind in options.items()])


def _resolve(annotation: str) -> Any:
    """Returns the type that an annotation names; Any where it needs an import."""
    try:
        return eval(f"{annotation} | None", {})
    except (NameError, TypeError):
        return Any
