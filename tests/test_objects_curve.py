"""The script that draws results/small_objects/objects.png."""

import importlib
from pathlib import Path
from types import SimpleNamespace

import pytest

SCRIPTS = Path(__file__).parents[1] / "scripts"


@pytest.mark.parametrize(
    ("experiments", "message"),
    [([], "has no records of evaluations"), (["small_a/deltaco"], "of the experiments objects_N")],
)
def test_without_records_nothing_is_drawn(tmp_path, monkeypatch, experiments, message):
    monkeypatch.syspath_prepend(SCRIPTS)
    script = importlib.import_module("objects_curve")
    if experiments:
        report = SimpleNamespace(regular=[SimpleNamespace(experiment=name) for name in experiments])
        monkeypatch.setattr(script, "find_records", lambda _: [])
        monkeypatch.setattr(script, "make_report", lambda _: report)
    monkeypatch.setattr(script, "RECORDS", tmp_path)
    monkeypatch.setattr(script, "IMAGE", tmp_path / "objects.png")
    with pytest.raises(SystemExit, match=message):
        script.main()
    assert not list(tmp_path.iterdir())
