"""Options of the policies, read from the source of their configurations: importing LeRobot takes 10 s."""

from __future__ import annotations

import ast
import textwrap
from functools import cache
from pathlib import Path
from typing import NamedTuple

# Files of the options, by whose they are.
OPTIONS = {
    "deltaco_match": "policies/deltaco_match/configuration_deltaco_match.py",
    "deltaco": "policies/deltaco/configuration_deltaco.py",
    "both": "policies/base/configuration.py",
}


class Option(NamedTuple):
    """An option of a policy, as written in the source: its type, its default and its description."""

    type: str
    default: str
    description: str


@cache
def read_options(policy_type: str) -> dict[str, Option]:
    """Returns the options of one policy that the other one does not have, or those of "both"."""
    source = (Path(__file__).parent / OPTIONS[policy_type]).read_text(encoding="utf-8")
    config = next(
        node
        for node in ast.parse(source).body
        if isinstance(node, ast.ClassDef) and node.name.endswith("Config")
    )
    _, _, arguments = (ast.get_docstring(config) or "").partition("Args:\n")
    entries = textwrap.dedent(arguments).replace("\n    ", " ").splitlines()
    described = {name: text for name, _, text in (entry.partition(": ") for entry in entries)}
    return {
        name: Option(ast.unparse(item.annotation), ast.unparse(item.value), described.get(name, ""))
        for item in config.body
        if isinstance(item, ast.AnnAssign) and item.value is not None
        for name in [ast.unparse(item.target)]
    }
