"""The benchmarks that start trainings finish, and measure what they name."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


def run(script: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(BENCHMARKS / script), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300)


@pytest.mark.slow
def test_the_times_of_exactly_the_steps_of_a_training_are_noted(tmp_path):
    """`--steps` of the benchmark must not swallow `--steps` of the training."""
    found = tmp_path / "found.json"
    result = run("processes.py", "--steps=3", "--rounds=1", "--encoders=attention", f"--json={found}")
    assert result.returncode == 0, result.stderr
    rates = json.loads(found.read_text())
    assert rates["attention: 1 process, samples/s"] > 0
    assert rates["attention: 2 processes, samples per processor second"] > 0


@pytest.mark.slow
def test_steps_are_timed_for_every_conditioning(tmp_path):
    found = tmp_path / "found.json"
    result = run("conditionings.py", "--steps=2", "--rounds=1", f"--json={found}")
    assert result.returncode == 0, result.stderr
    steps = json.loads(found.read_text())["steps"]
    assert {"attention", "correspondence", "language only"} <= set(steps)
    assert all(step["clock"] > 0 and step["processor"] > 0 for step in steps.values())
    for name in steps:
        assert name in result.stdout


@pytest.mark.slow
def test_where_a_minute_goes_is_measured(tmp_path):
    found = tmp_path / "found.json"
    result = run("minute.py", "--only", "training", "--encoder=attention", f"--json={found}")
    assert result.returncode == 0, result.stderr
    lines = {line["what"].strip(): line["clock"] for line in json.loads(found.read_text())["lines"]}
    assert lines["samples, 1 thread"] > 0
    assert all(figure > 0 for figure in lines.values())
