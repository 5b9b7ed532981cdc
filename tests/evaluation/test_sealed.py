"""Sealed scenes: closed without the file of their seed, and a function of it."""

import hashlib
from pathlib import Path

import pytest

from lerobot_deltaco.errors import UserError
from lerobot_deltaco.evaluation import sealed
from lerobot_deltaco.evaluation.command import EvaluateArguments, evaluate_checkpoints
from lerobot_deltaco.evaluation.records import EvaluationPlan

SEEDS = [f"{number:032x}\n" for number in (3, 2**127)]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The folder of the files of two releases' seeds, still empty."""
    monkeypatch.setattr(sealed, "FOLDER", tmp_path)
    monkeypatch.setattr(sealed, "DIGESTS", [hashlib.sha256(seed.encode()).hexdigest() for seed in SEEDS])
    return tmp_path


def test_sealed_scenes_are_refused_until_their_seed_is_there(folder):
    arguments = EvaluateArguments(Path("missing"), EvaluationPlan(scene_split="sealed"))
    name = sealed.sealed_splits()[-1]
    assert arguments.plan.scene_split == name
    with pytest.raises(UserError, match=f"closed until the release.*{name}.txt.*{sealed.DIGESTS[-1]}"):
        evaluate_checkpoints(arguments)
    (folder / f"{name}.txt").write_text(SEEDS[0])
    with pytest.raises(UserError, match="is not the file of the seed"):
        evaluate_checkpoints(arguments)
    (folder / f"{name}.txt").write_text(SEEDS[1])
    with pytest.raises(UserError, match="missing has no checkpoints"):
        evaluate_checkpoints(arguments)


def test_scenes_follow_from_the_seed(folder):
    for split, seed in zip(sealed.sealed_splits(), SEEDS, strict=True):
        (folder / f"{split}.txt").write_text(seed)
    plans = [EvaluationPlan(scene_split=split) for split in (*sealed.sealed_splits(), None, 3)]
    seeds = [{plan.scene_seed(task, trial) for task in range(20) for trial in range(4)} for plan in plans]
    assert [len(found) for found in seeds] == [80] * 4
    assert len(set.union(*seeds)) == 320
    # The split of an earlier release stays its own.
    assert (
        plans[0].scene_seed(4, 0)
        != plans[1].scene_seed(4, 0)
        == EvaluationPlan(scene_split="sealed").scene_seed(4, 0)
    )


def test_other_names_are_refused():
    with pytest.raises(UserError, match="must be a number or one of sealed, sealed-.*Got 'seeled'"):
        EvaluationPlan(scene_split="seeled")
