"""Help of `deltaco train`: the options of this project's policies, beside LeRobot's own."""

from __future__ import annotations

import textwrap
from dataclasses import fields
from typing import Any

from docstring_parser import parse
from lerobot.configs import PreTrainedConfig

import lerobot_policy_deltaco  # noqa: F401  (registers the types of this project)

_POLICIES = ("deltaco_match", "deltaco")
_USAGE = """\
usage: deltaco train --policy.type=deltaco_match --dataset.repo_id=NAME [--dataset.root=DIR] ...

Takes the arguments of lerobot-train, such as --batch_size, --steps, --save_freq, --output_dir, --job_name and
--seed. To continue a run: deltaco train --resume=true
--config_path=RUN/checkpoints/last/pretrained_model/train_config.json

All options, with LeRobot's: deltaco train --policy.type=deltaco_match --help"""


def training_help() -> str:
    """Returns the usage, and the options of each policy with their defaults."""
    configs = [PreTrainedConfig.get_choice_class(name) for name in _POLICIES]
    (shared,) = {config.__base__ for config in configs}
    sections = {f"--policy.type={name}": config for name, config in zip(_POLICIES, configs, strict=True)}
    sections["Both policies"] = shared
    return "\n\n".join([_USAGE, *(f"{title}\n{_describe(config)}" for title, config in sections.items())])


def _describe(config: Any) -> str:
    """Returns the options that a configuration's docstring describes."""
    lines, defaults = [], {field.name: field.default for field in fields(config)}
    for option in parse(config.__doc__ or "").params:
        lines.append(f"  --policy.{option.arg_name} (default: {defaults[option.arg_name]})")
        text = " ".join((option.description or "").split())
        lines.append(textwrap.fill(text, 104, initial_indent=" " * 6, subsequent_indent=" " * 6))
    return "\n".join(lines)
