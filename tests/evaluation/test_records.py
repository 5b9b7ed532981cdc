"""Records of evaluations: what is read is what was written, and contradictions are refused."""

import re
from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pandas as pd
import pytest
from example_records import make_record

from gym_deltaco import ENV_ID
from gym_deltaco.scene_config import SceneConfig
from lerobot_deltaco.evaluation import records
from lerobot_deltaco.evaluation.records import (
    EvaluationPlan,
    UserError,
    read_records,
    scene_columns,
    write_records,
)

ROOT = Path(__file__).parents[2]


def lists(episodes):
    """Episodes with lists instead of arrays, which can be compared."""
    return episodes.map(lambda value: list(value) if isinstance(value, np.ndarray | list) else value)


def test_read_is_the_inverse_of_write(tmp_path):
    scene = SceneConfig(ambiguity="object", adversarial_probability=0.25, image_size=64)
    plan = {
        "scene": scene,
        "scene_split": 3,
        "seed": 7,
        "counterfactual": "instruction",
        "n_demonstrations": 2,
    }
    written = [
        make_record(),
        make_record("a/b", 3, 5, plan=plan, columns={"instruction": "put it there"}, weights="0123"),
        make_record("a/b", 4, 5, plan={"without": "demonstration"}, columns={"demonstration_task": -1}),
    ]
    write_records(tmp_path / "new" / "some.parquet", written)
    found = read_records(tmp_path / "new" / "some.parquet")
    for before, after in zip(written, found, strict=True):
        assert replace(after, episodes=None) == replace(before, episodes=None)
        pd.testing.assert_frame_equal(lists(after.episodes), lists(before.episodes), check_dtype=False)
        assert after.success_rate == before.success_rate == 0.5
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["some.parquet"]


def test_a_folder_is_searched(tmp_path):
    folder = tmp_path / "data" / "runs"  # only what is below the given folder tells datasets
    write_records(folder / "run" / "evaluations" / "a.parquet", [make_record()])
    write_records(folder / "b.parquet", [make_record("b/c"), make_record("b/d")])
    for name in ("data", "meta"):
        (folder / "run" / name).mkdir()
        pd.DataFrame({"task_id": [1]}).to_parquet(folder / "run" / name / "file.parquet")
    names = sorted(record.experiment for record in read_records(folder))
    assert names == ["b/c", "b/d", "scenario_a/deltaco"]
    assert len(read_records(folder / "run", folder / "b.parquet")) == 3


CONTRADICTIONS = {
    "demonstrated tasks of the plan, or -1": {"demonstration_task": 777},
    "each task and trial of the plan once": {"trial": 0},
    "a grasped object where it is the right one": {"grasped_object": -1},
    "12 episodes": {},
}


@pytest.mark.parametrize("message", CONTRADICTIONS)
def test_contradictions_are_refused(tmp_path, monkeypatch, message):
    wrong = make_record(columns=CONTRADICTIONS[message], step=1)
    if message == "12 episodes":
        wrong = replace(wrong, episodes=wrong.episodes[:-1])
    found = [make_record(), wrong]
    with pytest.raises(UserError, match=f"must have {message}"):
        write_records(tmp_path / "some.parquet", found)
    assert not list(tmp_path.iterdir())
    # As if another program had written it.
    with monkeypatch.context() as patch:
        patch.setattr(records, "_check", lambda record, path: None)
        write_records(tmp_path / "some.parquet", found)
    with pytest.raises(UserError, match=f"must have {message}"):
        read_records(tmp_path / "some.parquet")


def test_what_is_no_file_of_records_is_named(tmp_path):
    pd.DataFrame({"task_id": [4]}).to_parquet(tmp_path / "other.parquet")
    (tmp_path / "text.parquet").write_text("{}")
    (tmp_path / "empty").mkdir()
    for name in ("other.parquet", "text.parquet", "missing.parquet"):
        with pytest.raises(UserError, match=f"{name}.*is not a file of evaluation records"):
            read_records(tmp_path / name)
    with pytest.raises(
        UserError, match="empty.*has no records of evaluations. `deltaco evaluate` writes them"
    ):
        read_records(tmp_path / "empty")


def test_invalid_plans_are_refused():
    for message, changes in {
        "`trials` must be at least 1. Got 0.": {"trials": 0},
        "must be one of none, demonstration, instruction. Got 'demo'": {"counterfactual": "demo"},
        "is not a paraphrase": {"without": "instruction", "instruction": "put it there"},
    }.items():
        with pytest.raises(ValueError, match=message):
            EvaluationPlan(**changes)


def test_trial_i_has_the_scene_of_the_seed_plus_i():
    plan = EvaluationPlan(seed=1000)
    assert plan.scene_seed(4, 3) == EvaluationPlan(seed=1003).scene_seed(4, 0)
    seeds = {plan.scene_seed(task_id, trial) for task_id in range(300) for trial in range(4)}
    assert len(seeds) == 1200
    sets = {replace(plan, scene_split=number).scene_seed(4, 0) for number in (0, 1, 8000)}
    assert len(sets) == 3


@pytest.mark.parametrize("scene", [SceneConfig(), SceneConfig(ambiguity="object")])
def test_scene_columns_are_those_of_the_environment(scene):
    record = make_record(plan={"scene": scene, "tasks": "24,132,145", "trials": 1})
    for row, scenes in zip(record.episodes.itertuples(), scene_columns(record).itertuples(), strict=True):
        env = gymnasium.make("gym_deltaco:" + ENV_ID, task_id=row.task_id, scene=scene)
        _, info = env.reset(seed=scenes.seed)
        for name in ("objects", "container_quadrants", "target_object", "target_container"):
            np.testing.assert_array_equal(getattr(scenes, name), info[name])
        assert scenes.template == env.unwrapped.task.instruction
        env.close()


def test_the_page_documents_the_schema(monkeypatch, capsys):
    page = (ROOT / "docs" / "records.md").read_text(encoding="utf-8")
    columns = re.findall(r"^    (\w+) +(\w+)  ", page, re.MULTILINE)
    assert columns == [(column.name, str(column.type).partition("<")[0]) for column in records.SCHEMA]
    example = page.split("```python\n")[1].split("```")[0]
    output = page.split("```text\n")[1].split("```")[0]
    monkeypatch.chdir(ROOT)
    exec(example, {})
    assert capsys.readouterr().out.split() == output.split()
