"""The comparison of two evaluations: it says when a difference is decided, and refuses other scenes."""

import numpy as np
import pytest
from example_records import make_record

from lerobot_deltaco.errors import UserError
from lerobot_deltaco.evaluation.records import write_records
from lerobot_deltaco.reports.compare import compare_records
from lerobot_deltaco.reports.metrics import bootstrap, detectable_difference

TASKS = "0-99"


def draws(rate, seed):
    """Success in a fraction of the tasks, drawn with a seed."""
    drawn = np.random.default_rng(seed).random((100, 4)) < rate
    return lambda task_id, trial: bool(drawn[task_id, trial])


@pytest.fixture
def compare(tmp_path):
    def compare(first, second, *experiments):
        for name, records in (("first", first), ("second", second)):
            write_records(tmp_path / f"{name}.parquet", records)
        return compare_records(tmp_path / "first.parquet", tmp_path / "second.parquet", *experiments)

    return compare


def policy(rate, train_seed=0, name="a/b", **plan):
    plan = {"tasks": TASKS, "trials": 4} | plan
    return make_record(name, train_seed, succeeds=draws(rate, train_seed), plan=plan)


def test_a_difference_is_decided_if_its_interval_excludes_zero(compare):
    bad, good = [policy(0.4, seed) for seed in range(3)], [policy(0.6, seed) for seed in range(3, 6)]
    text = compare(bad, good)
    assert text.endswith("Decided: B is better.")
    assert "training seeds 0 1 2: 4" in text
    assert "over 100 tasks" in text
    assert compare(good, bad).endswith("Decided: A is better.")
    # One training of each is not enough to speak of methods.
    assert "Decided: B is better, of these trained policies." in compare(bad[:1], good)
    same = compare(bad, [policy(0.4, seed) for seed in range(6, 9)])
    assert "Not decided: the interval contains 0." in same
    assert "Not decided" in compare(bad, bad)
    few = [make_record(), make_record("c/d", succeeds=lambda task_id, trial: True)]
    assert "Not decided: 6 tasks are too few." in compare(few[:1], few[1:])


def test_what_else_differs_is_named(compare):
    text = compare([policy(0.4)], [policy(0.6, oracle="location")])
    assert "They also differ in oracle (none, location)." in text


def test_other_scenes_are_refused(compare):
    for changes, message in [
        ({"seed": 7}, r"seed \(1000, 7\)"),
        ({"tasks": "0-49"}, r"tasks \(0-99, 0-49\)"),
        ({"scene_split": 3}, r"scene split \(None, 3\)"),
    ]:
        with pytest.raises(UserError, match=message):
            compare([policy(0.4)], [policy(0.4, **changes)])


def test_one_of_several_experiments_is_chosen(compare):
    several = [policy(0.4, name="a/b"), policy(0.6, name="a/c")]
    with pytest.raises(UserError, match="several experiments. Choose with --experiments among: a/b; a/c"):
        compare(several, several)
    with pytest.raises(UserError, match="no experiment 'a/d'"):
        compare(several, several, ("a/b", "a/d"))
    assert "B: a/c, step 10000" in compare(several, several, ("a/b", "a/c"))


def test_a_detectable_difference_is_found_in_80_percent_of_comparisons():
    rng = np.random.default_rng(0)
    noise = rng.normal(0, 0.3, (40, 100))
    true = np.mean([detectable_difference(values) for values in noise])
    found = np.mean([bootstrap(values + true).low > 0 for values in noise])
    assert found == pytest.approx(0.8, abs=0.15)
