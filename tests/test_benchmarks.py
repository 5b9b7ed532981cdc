"""The benchmarks run, and print rates and ratios."""

import importlib.util
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "benchmarks" / "benchmark.py"


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [
        ["env", "--episodes", "2", "--seconds", "0.01"],
        ["train", "--batch-size", "16", "--steps", "3", "--options", "backbone=strided"],
        ["policy", "--batch-size", "16", "--seconds", "0.01"],
    ],
    ids=lambda words: words[0],
)
def test_a_benchmark_prints_a_table(words, monkeypatch, capsys):
    spec = importlib.util.spec_from_file_location("benchmark", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.syspath_prepend(SCRIPT.parent)
    monkeypatch.setattr(sys, "argv", ["benchmark.py", *words])
    module.main()
    lines = [line.rsplit(maxsplit=1) for line in capsys.readouterr().out.splitlines() if "  " in line]
    figures = {name.strip(): float(figure) for name, figure in lines if figure.replace(".", "").isdigit()}
    assert len(figures) > 3
    assert all(figure >= 0 for figure in figures.values())
