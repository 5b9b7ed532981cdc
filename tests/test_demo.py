import csv
import json
import re
from pathlib import Path

import pytest
from test_experiments import FakeCommands, make_record

from lerobot_deltaco import demo, experiments, records
from lerobot_deltaco.recipes import ExperimentError


class FakeDemoCommands(FakeCommands):
    """Also leaves the evaluations with the inputs of other tasks."""

    def _evaluate(self, arguments, fails):
        if fails:
            return
        run = Path(arguments[1])
        options = dict(zip(arguments[2::2], arguments[3::2], strict=True))
        plan = records.EvaluationPlan(
            trials=int(options.get("--trials", 4)), counterfactual=options.get("--counterfactual", "none")
        )
        step = experiments.last_step(run)
        # Trials 0 of all tasks succeed.
        record = make_record(demo.EXPERIMENT, 1, step, plan)
        records.write_records(run / "evaluations" / f"{plan.counterfactual}.parquet", [record])


@pytest.fixture
def commands(monkeypatch):
    """Fake commands, videos and statistics."""
    fake = FakeDemoCommands()
    monkeypatch.setattr(experiments, "call", fake)

    def record_scene(checkpoint, seed):
        def episode(sentence, success):
            return {
                "sentence": sentence,
                "video": "data:video/mp4",
                "maps": "data:image/jpeg",
                "success": success,
            }

        successes = {"the gray ring": (False, True), "the yellow lampshade": (True, False)}
        return [
            {
                "name": name,
                "images": ["data:image/jpeg"] * 2,
                "episodes": list(map(episode, demo.SENTENCES, each)),
            }
            for name, each in successes.items()
        ]

    def followed(record):
        counts = {"demonstration": 31, "instruction": 7, "neither": 2, "episodes": 40}
        return [{"aspect": aspect} | counts for aspect in ("object", "container")]

    monkeypatch.setattr(demo, "record_scene", record_scene)
    monkeypatch.setattr(demo, "_followed", followed)
    return fake


def test_the_page_shows_the_result(tmp_path, commands):
    page = demo.run_demo(8, tmp_path).read_text()
    assert page.count("<video src=") == 4
    assert page.count('src="data:image/jpeg') == 4 + 4
    assert re.findall(r'class="(yes|no)">', page) == ["no", "yes", "yes", "no"]
    assert "25.0 %" in page
    for number in (demo.PAPER, demo.CHANCE, demo.LONGER):
        assert f"{number:.1f} %" in page
    assert page.count('<td class="number">31</td>') == 4
    assert not re.search(r'(src|href)="(?!data:)', page)


def test_finished_steps_are_skipped(tmp_path, commands):
    commands.failing = ("evaluate",)
    with pytest.raises(ExperimentError):
        demo.run_demo(8, tmp_path)
    commands.failing = ()
    commands.called.clear()
    demo.run_demo(8, tmp_path)
    assert commands.names == ["evaluate"] * 3
    commands.called.clear()
    demo.run_demo(8, tmp_path)
    assert commands.names == []


def test_each_run_is_recorded_once(tmp_path, commands):
    for minutes in (8, 8, 25):
        demo.run_demo(minutes, tmp_path)
    with (tmp_path / "records.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    assert [line["budget_min"] for line in lines] == ["8", "25"]
    assert all(float(line["low"]) <= 25.0 <= float(line["high"]) for line in lines)
    assert float(lines[0]["calibration_gflops"]) > 0


def test_longer_demos_have_more_of_everything():
    assert all(longer > shorter for shorter, longer in zip(demo.BUDGETS[8], demo.BUDGETS[25], strict=True))


def test_the_scene_holds_what_the_demonstrations_show():
    import gymnasium

    from gym_deltaco.tasks import get_task

    seed = records.EvaluationPlan().scene_seed(demo.SCENE_TASK, demo.SCENE_TRIAL)
    env = gymnasium.make("gym_deltaco:gym_deltaco/PickPlace-v0", task_id=demo.SCENE_TASK)
    _, info = env.reset(seed=seed)
    env.close()
    for task_id, index in demo.DEMONSTRATION_TASKS.values():
        assert info["objects"][index] in get_task(task_id).targets


def test_interrupted_attempts_count(tmp_path):
    clock = demo.Clock(tmp_path / "minutes.json")
    with pytest.raises(RuntimeError), clock.step("train"):
        raise RuntimeError
    first = json.loads(clock.path.read_text())["train"][0]
    again = demo.Clock(clock.path)
    with again.step("train"):
        pass
    assert again.times["train"][0] >= first
    assert again.total[0] == again.times["train"][0]
