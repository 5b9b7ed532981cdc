"""The scripts: benchmarks print rates and ratios, and the documentation's images are drawn."""

import sys
from pathlib import Path

import benchmark
import draw_docs
import finding
import pytest
import torch

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.slow


@pytest.mark.usefixtures("short_fit")
@pytest.mark.parametrize(
    "words",
    [
        ["env", "--episodes", "2", "--seconds", "0.01"],
        ["train", "--batch-size", "16", "--steps", "3"],
        ["policy", "--batch-size", "16", "--seconds", "0.01"],
        ["latency", "--checkpoint", str(ROOT / "checkpoints" / "pick_place"), "--seconds", "0.01"],
        ["video", "--episodes", "2", "--frames", "5", "--size", "64", "--repeats", "1"],
        ["contention", "--seconds", "0.01"],
    ],
    ids=lambda words: words[0],
)
def test_a_benchmark_prints_a_table(words, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["benchmark.py", *words])
    benchmark.main()
    lines = [line.rsplit(maxsplit=1) for line in capsys.readouterr().out.splitlines() if "  " in line]
    figures = {name.strip(): float(figure) for name, figure in lines if figure.replace(".", "").isdigit()}
    assert len(figures) > 1
    assert min(figures.values()) > 0


def test_the_images_of_the_documentation_are_drawn(tmp_path, monkeypatch):
    monkeypatch.chdir(ROOT)
    draw_docs.main(tmp_path)
    drawn = {path.name for path in tmp_path.iterdir()}
    assert len(drawn) == 7
    assert drawn <= {path.name for path in (ROOT / "docs/images").iterdir()}


def test_episodes_of_the_track_show_their_targets_move(monkeypatch):
    monkeypatch.setattr(finding, "N_TEST_SCENES", 4)
    data = finding.draw_data(finding.Case(4, 8, size=(160, 120)), seed=0)
    episodes = [*data.train, *(scene for pairs in data.tests.values() for scene, _ in pairs)]
    assert len(data.train) == 8
    for episode in episodes:
        assert episode.first.shape == (3, 120, 160)
        x, y = ((episode.locations[0] + 1) / 2 * torch.tensor([160, 120])).int().tolist()
        changed = (episode.first.int() - episode.last.int()).abs().amax(dim=0)
        assert changed[y - 2 : y + 3, x - 2 : x + 3].max() > 20
    assert {scene.task for scene, _ in data.tests["new"]}.isdisjoint(episode.task for episode in data.train)
