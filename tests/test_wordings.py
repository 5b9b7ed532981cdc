"""The report on instructions in other words: what is compared with what, and what is rejected."""

import csv
from dataclasses import replace

import pytest
from PIL import Image
from test_report import TASK_IDS, record, write

from gym_deltaco.tasks import TASKS
from lerobot_deltaco.commands import report as report_command
from lerobot_deltaco.reporting.series import ReportError
from lerobot_deltaco.reporting.wordings import WORDINGS_FILES, wording_label, write_wordings_report

HELD_OUT = "people.csv (held_out), SHA-256 0123"
OTHER_TASKS = tuple(task.index for task in TASKS if task.index not in TASK_IDS)[: len(TASK_IDS)]


def on_other_tasks(item):
    episodes = [
        replace(episode, task_id=OTHER_TASKS[TASK_IDS.index(episode.task_id)]) for episode in item.episodes
    ]
    return replace(item, episodes=episodes, tasks=",".join(map(str, OTHER_TASKS)))


@pytest.fixture
def folders(tmp_path):
    """A policy on two task sets: on one with two wordings, on the other with a file's sentences alone."""
    sets = {
        "templates": record(n_successes=4),
        "held_out": record(n_successes=3, wording=HELD_OUT),
        "others": on_other_tasks(record(n_successes=1, wording=HELD_OUT)),
        "swapped": record(n_successes=0, counterfactual="demo"),
    }
    return [write(tmp_path / name, item) for name, item in sets.items()]


def test_rates_are_compared_with_those_of_the_same_policy_and_tasks(folders, tmp_path):
    results = write_wordings_report(folders, tmp_path / "out")
    found = {(result.tasks, wording_label(result.wording)): result for result in results}
    tasks, others = (",".join(map(str, ids)) for ids in (TASK_IDS, OTHER_TASKS))
    assert set(found) == {
        (tasks, "templates"),
        (tasks, "people.csv (held_out)"),
        (others, "people.csv (held_out)"),
    }
    templates, held_out = found[tasks, "templates"], found[tasks, "people.csv (held_out)"]
    assert templates.rate.value == pytest.approx(4 / 6)
    assert held_out.rate.value == pytest.approx(3 / 6)
    assert held_out.share == pytest.approx(3 / 4)
    assert held_out.difference.value == pytest.approx(-1 / 6)
    assert (templates.share, templates.difference) == (None, None)
    assert found[others, "people.csv (held_out)"].share is None


def test_the_files_have_what_was_measured(folders, tmp_path):
    out = tmp_path / "out"
    results = write_wordings_report(folders, out)
    assert {path.name for path in out.iterdir()} == set(WORDINGS_FILES)
    with (out / "wordings.csv").open(newline="") as file:
        rates = [float(row["rate"]) for row in csv.DictReader(file)]
    assert rates == pytest.approx([result.rate.value for result in results], abs=1e-6)
    text = (out / "wordings.md").read_text()
    assert "66.7 [" in text
    assert "(75 %)" in text
    with Image.open(out / "wordings.png") as image:
        assert image.width > 800


def test_a_success_rate_of_zero_has_no_share(tmp_path):
    folders = [
        write(tmp_path / "a", record(n_successes=0)),
        write(tmp_path / "b", record(n_successes=0, wording=HELD_OUT)),
    ]
    assert [result.share for result in write_wordings_report(folders, tmp_path / "out")] == [None, None]


def test_a_sentence_may_have_any_signs(tmp_path):
    sentence = "put it | for $5 into the $red one"
    folder = write(tmp_path / "a", record(wording=sentence))
    write_wordings_report([folder], tmp_path / "out")
    line = (tmp_path / "out/wordings.md").read_text().splitlines()[4]
    assert line == r"| policy | tasks | put it \| for $5 into the $red one |"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"evaluation_seed": 3}, "differ in their evaluation seed: 0 in .*, 3 in"),
        ({"adversarial_probability": 0.0}, "probability of adversarial distractors"),
        ({"adversarial_draw": "scene"}, "draw of adversarial distractors: 'each' in .*, 'scene' in"),
        ({"image_size": 96}, "image size"),
    ],
)
def test_other_scenes_are_rejected(folders, tmp_path, changes, message):
    folders.append(write(tmp_path / "more", record("scenario_a/demo_only", wording="go", **changes)))
    with pytest.raises(ReportError, match=message):
        write_wordings_report(folders, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_wordings_are_compared_in_the_same_set_of_scenes(tmp_path):
    templates = write(tmp_path / "a", record(step=10))
    other = write(tmp_path / "b", record(step=20, wording="go"))
    with pytest.raises(ReportError, match="different sets of scenes"):
        write_wordings_report([templates, other], tmp_path / "out")
    same = write(tmp_path / "c", record(step=20, wording="go", scene_set=10))
    assert len(write_wordings_report([templates, same], tmp_path / "out")) == 2


def test_the_command_prints_the_rates(folders, tmp_path, capsys):
    report_command.main([*map(str, folders), "--by-wording", "--out", str(tmp_path / "out")])
    output = capsys.readouterr().out
    assert "people.csv (held_out): 50.0 [" in output
    assert "templates: 66.7 [" in output
