"""Experiments as YAML files. Each overrides what its folder shares, which overrides what all share.

A folder's shared file may extend that of another folder: `extends: small_a`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from lerobot_deltaco.common.shipped import shipped_folder

SHARED = "shared.yaml"
EXTENDS = "extends"
SAME_SEED, BEST_SEED = "same", "best"
_SECTIONS = ("data", "demonstrations", "policy", "training", "evaluation")


class ExperimentConfigError(ValueError):
    """An experiment does not exist or its file is invalid; the message says why."""


@dataclass(frozen=True)
class ExperimentConfig:
    """An experiment: one row of one of the paper's tables, or one of ours.

    Args:
        name: Name of the experiment, such as "scenario_a/deltaco".
        data: Arguments of the collection that is trained on, as `CollectionPlan` has them.
        demonstrations: The same of the collection of demonstrations of the test tasks.
        policy: Options of `--policy`.
        training: Further options of `deltaco-train`.
        evaluation: Arguments of the evaluation sets, as `EvaluationPlan` has them.
        start_from: Name of the experiment whose last checkpoint is fine-tuned; None to train from scratch.
        start_from_seed: Seed of that experiment: "same", the run's own, or "best", the one with the highest
            success rate at its last step, as in the paper.
    """

    name: str
    data: Mapping[str, Any]
    demonstrations: Mapping[str, Any]
    policy: Mapping[str, Any]
    training: Mapping[str, Any]
    evaluation: Mapping[str, Any]
    start_from: str | None = None
    start_from_seed: str = SAME_SEED


def default_folder() -> Path:
    """Folder of the project's experiments."""
    return shipped_folder("experiment_files", "experiments")


def experiment_names(folder: Path) -> list[str]:
    """Names of the experiments in a folder."""
    return sorted(
        path.relative_to(folder).with_suffix("").as_posix()
        for path in folder.glob("*/*.yaml")
        if path.name != SHARED
    )


def read_experiment(folder: Path, name: str, settings: Sequence[str] = ()) -> ExperimentConfig:
    """Reads an experiment.

    Args:
        folder: Folder of the experiments.
        name: Name of the experiment, such as "scenario_a/deltaco".
        settings: Settings that override the files: "training.steps=2000", "policy.device=cuda".

    Raises:
        ExperimentConfigError: The experiment does not exist, or a file or a setting is no YAML or has an
            unknown section.
    """
    file = folder / f"{name}.yaml"
    if name not in experiment_names(folder):
        raise ExperimentConfigError(
            f"There is no experiment {name!r} in {folder}. There are {', '.join(experiment_names(folder))}."
        )
    merged: dict[str, Any] = {}
    for path in (folder / SHARED, *_shared_files(folder, file.parent), file):
        if path.is_file():
            merged = _merged(merged, _read(path))
    for setting in settings:
        merged = _merged(merged, _parsed(setting))
    sections = {section: merged.get(section, {}) for section in _SECTIONS}
    for section in set(_SECTIONS) - {"policy"}:
        # A null takes back what a shared file has set. The policy's are left out later.
        sections[section] = {key: value for key, value in sections[section].items() if value is not None}
    start_from_seed = merged.get("start_from_seed", SAME_SEED)
    if start_from_seed not in (SAME_SEED, BEST_SEED):
        raise ExperimentConfigError(
            f"`start_from_seed` of {name} must be {SAME_SEED!r} or {BEST_SEED!r}. Got {start_from_seed!r}."
        )
    return ExperimentConfig(
        name, **sections, start_from=merged.get("start_from"), start_from_seed=start_from_seed
    )


def _shared_files(folder: Path, room: Path) -> list[Path]:
    """The shared files of a folder of experiments, after those that it extends.

    Raises:
        ExperimentConfigError: The folder that one extends has no shared file, or extends the first.
    """
    files: list[Path] = []
    path = room / SHARED
    while path.is_file():
        files.insert(0, path)
        name = _content(path).get(EXTENDS)
        if name is None:
            break
        path = folder / str(name) / SHARED
        if not path.is_file() or path in files:
            problem = "extends itself" if path in files else "does not exist"
            raise ExperimentConfigError(f"{files[0]} extends {name!r}: {path} {problem}.")
    return files


def _content(path: Path) -> dict[str, Any]:
    content = _loaded(path.read_text(encoding="utf-8"), str(path)) or {}
    if not isinstance(content, dict):
        raise ExperimentConfigError(f"{path} must be a mapping of sections. Got {content!r}.")
    # A section without options is a null.
    return {key: {} if value is None and key in _SECTIONS else value for key, value in content.items()}


def _loaded(text: str, where: str) -> Any:
    """What a text in YAML says."""
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ExperimentConfigError(f"{where} is no YAML: {error}") from None


def _read(path: Path) -> dict[str, Any]:
    content = _content(path)
    if path.name == SHARED:
        content.pop(EXTENDS, None)
    unknown = set(content) - {*_SECTIONS, "start_from", "start_from_seed"}
    if unknown:
        raise ExperimentConfigError(
            f"{path} has the unknown section {sorted(unknown)[0]!r}. Valid are {', '.join(_SECTIONS)} and "
            "start_from and start_from_seed."
        )
    for section in _SECTIONS:
        if not isinstance(content.get(section, {}), dict):
            raise ExperimentConfigError(
                f"The section {section!r} of {path} must be a mapping of options. Got {content[section]!r}."
            )
    return content


def _parsed(setting: str) -> dict[str, dict[str, Any]]:
    """A setting as a file would have it."""
    key, equals, value = setting.partition("=")
    section, _, name = key.partition(".")
    if section not in _SECTIONS or not name or not equals:
        raise ExperimentConfigError(
            f"A setting is SECTION.NAME=VALUE, such as training.steps=2000. The sections are "
            f"{', '.join(_SECTIONS)}. Got {setting!r}."
        )
    return {section: {name: _loaded(value, f"The setting {setting!r}")}}


def _merged(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """The values of both, those of `above` first."""
    merged = dict(below)
    for key, value in above.items():
        if isinstance(value, Mapping) and isinstance(merged.get(key), Mapping):
            merged[key] = _merged(merged[key], value)
        else:
            merged[key] = value
    return merged
