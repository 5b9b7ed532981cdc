"""Public linters of datasets complain about what docs/datasets.md explains, and about nothing else."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from lerobot_deltaco.collection.collect import CollectionPlan, collect

PAGE = Path(__file__).parents[2] / "docs" / "datasets.md"

pytestmark = pytest.mark.slow


def run(*words):
    if shutil.which(words[0]) is None:
        pytest.skip(f"{words[0]} is not installed: pip install lerobot-doctor lerobot-lint")
    return subprocess.run(words, capture_output=True, text=True, check=False).stdout


def test_complaints_are_those_that_the_page_explains(tmp_path):
    collect(tmp_path / "data", CollectionPlan("4,14,55,90", 5))
    run("lelint", "check", str(tmp_path / "data"), "--json", str(tmp_path / "lint.json"))
    found = {item["check"] for item in json.loads((tmp_path / "lint.json").read_text())["findings"]}
    report = json.loads(run("lerobot-doctor", "check", str(tmp_path / "data"), "--json"))
    found |= {check["name"] for check in report["checks"] if check["severity"] != "PASS"}
    section = PAGE.read_text(encoding="utf-8").partition("## Linters")[2].partition("\n## ")[0]
    explained = re.findall(r"^\| (.+?) \|", section, re.MULTILINE)[1:]
    assert found == {name.strip("`") for cell in explained for name in cell.split(", ")}
