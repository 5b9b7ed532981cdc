import json
import re

import gymnasium
import pandas as pd
import pytest
from example_records import make_record
from fake_steps import FakeSteps, fake_steps

from gym_deltaco.tasks import get_task
from lerobot_deltaco.errors import UserError
from lerobot_deltaco.evaluation import records
from lerobot_deltaco.pages import demo


class FakeDemoSteps(FakeSteps):
    """Also leaves the evaluations with the inputs of other tasks, in which every fourth episode succeeds."""

    def record(self, run, step, plan):
        record = make_record(step=step, succeeds=lambda _, trial: trial == 0, plan=vars(plan))
        records.write_records(run / "evaluations" / f"{plan.counterfactual}.parquet", [record])


@pytest.fixture
def steps(monkeypatch):
    """Fake steps and videos."""
    fake = fake_steps(monkeypatch, FakeDemoSteps())

    def record_scene(checkpoint, seed):
        files = {"video": "data:video/mp4", "maps": "data:image/jpeg"}
        sentences = enumerate(demo.SENTENCES)
        episodes = [{"sentence": sentence, "success": n == 0, **files} for n, sentence in sentences]
        shown = {"images": ["data:image/jpeg"] * 2, "episodes": episodes}
        return [{"name": name, **shown} for name in demo.DEMONSTRATION_TASKS]

    monkeypatch.setattr(demo, "record_scene", record_scene)
    return fake


def test_the_page_shows_the_result(tmp_path, steps):
    page = demo.run_demo(8, tmp_path).read_text()
    assert page.count("<video src=") == 4
    assert page.count('src="data:image/jpeg') == 4 + 4
    assert re.findall(r'class="(yes|no)">', page) == ["yes", "no", "yes", "no"]
    for number in (25.0, demo.PAPER, demo.CHANCE, demo.LONGER):
        assert f"{number:.1f} %" in page
    for name in ("demonstration", "instruction"):
        assert page.count(f"<td>{name}</td>") == 2
    assert not re.search(r'(src|href)="(?!data:)', page)
    assert "evaluation on the 102 novel tasks" in page
    (line,) = pd.read_csv(tmp_path / "records.csv").to_dict("records")
    assert line["success_rate"] == 25
    assert line["calibration_gflops"] > 0


def test_finished_steps_are_skipped(tmp_path, steps):
    steps.failing = "evaluate"
    with pytest.raises(UserError):
        demo.run_demo(8, tmp_path)
    times = tmp_path / "8_minutes" / "minutes.json"
    first = json.loads(times.read_text())["evaluate"]
    steps.failing = None
    for names in (["evaluate"] * 3, []):
        steps.names.clear()
        demo.run_demo(8, tmp_path)
        assert steps.names == names
    assert json.loads(times.read_text())["evaluate"] > first


def test_the_scene_holds_what_the_demonstrations_show():
    seed = records.EvaluationPlan().scene_seed(demo.SCENE_TASK, demo.SCENE_TRIAL)
    env = gymnasium.make("gym_deltaco:gym_deltaco/PickPlace-v0", task_id=demo.SCENE_TASK)
    _, info = env.reset(seed=seed)
    for task_id, index in demo.DEMONSTRATION_TASKS.values():
        assert info["objects"][index] in get_task(task_id).targets
