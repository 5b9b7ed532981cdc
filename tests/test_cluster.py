"""`examples/cluster.py` on this machine: the same dataset and records as without it."""

import importlib

import pytest

from lerobot_deltaco.collection.collect import CollectionPlan, collect, collect_part
from lerobot_deltaco.errors import UserError
from lerobot_deltaco.evaluation.records import read_records

PLAN = CollectionPlan("4,55", 11)  # three shards


def files_of(root):
    return {path.relative_to(root): path.read_bytes() for path in root.rglob("*") if path.is_file()}


@pytest.fixture
def cluster(monkeypatch, tmp_path):
    pytest.importorskip("datatrove")
    monkeypatch.chdir(tmp_path)  # for the logs
    return importlib.import_module("cluster")


def test_parts_make_the_same_dataset_even_if_one_is_missing(tmp_path):
    collect(tmp_path / "whole", PLAN)
    assert len(PLAN.shards) == 3
    for part in (1, 0):
        collect_part(tmp_path / "parts", PLAN, part, 3)
    assert not (tmp_path / "parts" / "meta" / "info.json").exists()
    with pytest.raises(UserError, match="another plan"):
        collect_part(tmp_path / "parts", CollectionPlan("4,55", 12), 0, 3)
    collect(tmp_path / "parts", PLAN)
    assert files_of(tmp_path / "parts") == files_of(tmp_path / "whole")
    collect_part(tmp_path / "parts", PLAN, 2, 3)  # nothing is left to do
    assert files_of(tmp_path / "parts") == files_of(tmp_path / "whole")


@pytest.mark.slow
def test_a_dataset_is_collected_and_a_policy_evaluated_by_several_jobs(cluster, tmp_path):
    from lerobot_deltaco.pages.play import shipped_checkpoint

    cluster.collect(tmp_path / "jobs", PLAN.tasks, PLAN.episodes_per_task, jobs=2)
    collect(tmp_path / "whole", PLAN)
    assert files_of(tmp_path / "jobs") == files_of(tmp_path / "whole")
    cluster.evaluate(shipped_checkpoint(), tmp_path / "records", seeds=(1, 2), trials=1)
    records = read_records(tmp_path / "records")
    assert sorted(record.plan.seed for record in records) == [1, 2]
