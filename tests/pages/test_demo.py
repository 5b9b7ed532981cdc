import json
import re

import pandas as pd
import pytest
from example_records import make_record
from fake_steps import FakeSteps, fake_steps

from gym_deltaco.env import PickPlaceEnv
from gym_deltaco.tasks import get_task
from lerobot_deltaco.errors import UserError
from lerobot_deltaco.evaluation import records
from lerobot_deltaco.pages import demo
from lerobot_deltaco.pages.html import EpisodeView
from lerobot_deltaco.pages.player import SHOWCASE


class FakeDemoSteps(FakeSteps):
    """Also leaves the evaluations with the inputs of other tasks, in which every fourth episode succeeds."""

    def record(self, run, step, plan):
        record = make_record(step=step, succeeds=lambda _, trial: trial == 0, plan=vars(plan))
        records.write_records(run / "evaluations" / f"{plan.counterfactual}.parquet", [record])


@pytest.fixture
def steps(monkeypatch):
    """Fake steps and videos."""
    fake = fake_steps(monkeypatch, FakeDemoSteps())

    def record_showcase(checkpoint):
        picture, video = "data:image/jpeg", "data:video/mp4"
        return [
            EpisodeView(sentence, name, [picture] * 2, n == 0, "", ["It put ..."], picture, video)
            for name in ("the first", "the second")
            for n, sentence in enumerate(("green bin", "red bin"))
        ]

    monkeypatch.setattr(demo, "record_showcase", record_showcase)
    return fake


def test_the_page_shows_the_result(tmp_path, steps):
    page = demo.run_demo(8, tmp_path).read_text()
    assert page.count("<video src=") == 4
    assert page.count('src="data:image/jpeg') == 4 + 4
    assert re.findall("[✓✗]", page) == ["✓", "✗"] * 2
    for number in ("25.0", "25.8", "16.7"):
        assert f"{number} % (" in page
    for name in ("demonstration", "instruction"):
        assert page.count(f"<td>{name}</td>") == 2
    assert not re.search(r'(src|href)="(?!data:)', page)
    assert "evaluation on the test tasks" in page
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


def test_the_scene_of_the_videos_holds_what_the_demonstrations_show():
    for choice in SHOWCASE:
        env = PickPlaceEnv(choice.task_id)
        _, info = env.reset(seed=choice.scene_seed)
        env.close()
        assert len(set(info["objects"]) & set(get_task(choice.demo_task).targets)) == 1
