"""Reports: statistics against numbers worked by hand, rows by settings, and the pages' tables."""

import re
from collections import defaultdict

import numpy as np
import pandas as pd
import pytest
import update_docs
from example_records import make_record

from gym_deltaco.tasks import TASKS, get_task
from lerobot_deltaco.errors import UserError
from lerobot_deltaco.evaluation.records import scene_columns, write_records
from lerobot_deltaco.experiments.recipes import experiment_names
from lerobot_deltaco.reports import metrics as statistics
from lerobot_deltaco.reports import report
from lerobot_deltaco.reports.leaderboard import PAPER, collect_results, paper_row
from lerobot_deltaco.reports.metrics import Estimate, bootstrap, paper_rate, task_rates
from lerobot_deltaco.reports.report import escape, make_table, write_report


def never(task_id, trial):
    return False


def episodes_of(**outcomes):
    """Episodes of tasks 1, 2, ... with outcomes such as "110"."""
    rows = [(int(name[1:]), mark == "1") for name, marks in outcomes.items() for mark in marks]
    return pd.DataFrame(rows, columns=["task_id", "success"])


def links(page):
    return set(re.findall(r"\]\(([^)]*)\)", page.read_text(encoding="utf-8")))


def test_the_interval_is_that_of_resampled_tasks_which_count_alike():
    episodes = episodes_of(t1="1", t2="0000", t3="10")
    assert task_rates(episodes).to_dict() == {1: 1.0, 2: 0.0, 3: 0.5}
    assert bootstrap(task_rates(episodes)) == (0.5, 0.0, 1.0)
    values = np.random.default_rng(1).random(30)
    means = [values[np.random.default_rng([2, n]).integers(30, size=30)].mean() for n in range(4000)]
    np.testing.assert_allclose(bootstrap(values)[1:], np.quantile(means, (0.025, 0.975)), atol=0.01)
    assert bootstrap([0.25] * 7) == bootstrap([0.25]) == (0.25, 0.25, 0.25)


def test_differences_are_paired_by_task():
    first, second = episodes_of(t1="11", t2="10", t3="00"), episodes_of(t2="00", t1="10", t9="11")
    assert statistics.paired_difference(first, second) == (0.5, 0.5, 0.5)
    assert statistics.paired_difference(first, episodes_of(t9="1")) is None


def test_the_interval_of_few_successes_is_wilsons():
    # Newcombe 1998, table I: 0 of 20.
    none = statistics.success_interval(episodes_of(t1="0" * 10, t2="0" * 10))
    np.testing.assert_allclose(none, (0, 0, 0.1611), atol=5e-5)
    assert statistics.success_interval(episodes_of(t1="111", t2="111")) == (1.0, 1.0, 1.0)


def test_the_papers_rate_is_that_of_the_ten_best_sets():
    order = (0, 5, 1, 2, 3, 4, 6, 7, 8, 9, 0, 3)
    rates = pd.DataFrame([[0.1 * n, 0.1 * n + 0.02] for n in order])
    assert paper_rate(rates) == pytest.approx((np.mean(sorted(order)[2:]) / 10 + 0.01, 0.01))
    assert paper_rate(rates[[0]]) == pytest.approx((np.mean(sorted(order)[2:]) / 10, np.nan), nan_ok=True)
    assert paper_rate(pd.DataFrame([[0.5, 0.5]] * 10 + [[0.4, 0.6]])) == (0.5, 0.0)  # the earlier of a tie


def counterfactual_record(counterfactual, follows):
    """A record in which one input asks for another object and container than the scene's task."""
    plan = {"counterfactual": counterfactual, "tasks": "24-31", "trials": 1}
    record = make_record(plan=plan)
    columns = defaultdict(list)
    for task_id, scene in zip(record.episodes["task_id"], scene_columns(record).itertuples(), strict=True):
        own, number = get_task(task_id), (scene.target_object + 1) % 3
        other = TASKS[50 + scene.objects[number]]  # red; the scene's task says green
        choices = {"scene": (scene.target_object, own), "other": (number, other), "none": (-1, own)}
        held, task = choices[follows]
        containers = [int(task.container == "red") if n == held else -1 for n in range(3)]
        columns["grasped_object"].append(held)
        columns["object_containers"].append(containers)
        columns["demonstration_task"].append((other if counterfactual == "demonstration" else own).index)
        columns["instruction"].append(other.instruction if counterfactual == "instruction" else None)
    return make_record(plan=plan, succeeds=never, columns=columns)


def test_followed_counts_conflicts():
    for counterfactual, follows, column in [
        ("demonstration", "scene", "instruction"),
        ("demonstration", "other", "demonstration"),
        ("instruction", "scene", "demonstration"),
        ("instruction", "other", "instruction"),
        ("instruction", "none", "neither"),
    ]:
        record = counterfactual_record(counterfactual, follows)
        table = statistics.followed([record, record]).set_index("aspect")
        assert list(table.columns) == ["demonstration", "instruction", "neither", "episodes"]
        assert (table["episodes"] == 2 * len(record.episodes)).all()
        assert (table[column] == table["episodes"]).all()
        agreeing = make_record(plan={"counterfactual": "demonstration"})  # the demonstrations are the scene's
        assert statistics.followed([agreeing])["episodes"].tolist() == [0, 0]


def test_other_settings_are_results_of_their_own():
    plans = {
        "": {},
        "counterfactual demonstration": {"counterfactual": "demonstration"},
        "joint noise 1.0": {"joint_noise": 1.0},
        "n demonstrations 5": {"n_demonstrations": 5},
        "without instruction": {"without": "instruction"},
        "wording put it there": {"instruction": "put it there"},
        "tasks 0-3, trials 4": {"tasks": "0-3", "trials": 4},
    }
    drawn = np.random.default_rng(0).permutation(list(plans))
    records = [make_record(seed=seed, plan=plans[name]) for name in drawn for seed in (0, 1)]
    # Most of the group's are main settings.
    records += [make_record("scenario_a/mcil", step=step) for step in (1, 2)]
    results = collect_results(records)
    assert [result.variant for result in results] == [*plans, ""]
    assert [list(result.last.index) for result in results] == [[0, 1]] * 7 + [[0]]
    assert len(make_table(results, report.counterfactual_rows)) == 2
    assert len(make_table(results, report.evaluation_rows)) == 7 * 2 + 2
    assert make_table(collect_results([make_record()]), report.evaluation_rows).empty


def test_only_steps_of_all_seeds_count():
    steps = {0: (10, 20, 30), 1: (10, 20), 2: (20, 40)}
    records = [make_record(seed=seed, step=step) for seed, found in steps.items() for step in found]
    (result,) = collect_results(records)
    assert list(result.rates.index) == [20]
    assert len(result.episodes) == 3 * len(records[0].episodes)


def test_what_cannot_be_compared_is_refused():
    for records, message in [
        (
            [make_record(), make_record(succeeds=never)],
            "step 10000 of 'scenario_a/deltaco' with the training",
        ),
        ([make_record(versions={"benchmark": f"a-v{n}"}) for n in range(2)], "of the benchmark, a-v0, a-v1"),
        ([make_record(seed=0, step=1), make_record(seed=1, step=2)], "at no common step"),
    ]:
        with pytest.raises(UserError, match=message):
            collect_results(records)


def test_results_are_in_the_papers_order_and_numbers_in_theirs():
    names = ["z/a", "z/objects_24", "z/objects_100", "small_b/oracle", "small_b/deltaco", "small_a/one_hot"]
    order = [result.experiment for result in collect_results(map(make_record, names))]
    assert order == ["small_a/one_hot", "small_b/deltaco", "small_b/oracle", *names[:3]]


def test_rows_of_the_paper_are_recipes():
    assert set(PAPER.index) <= set(experiment_names())
    for name in PAPER.index:
        assert paper_row(f"paper/{name}") == paper_row(f"small/{name}") == name
    assert paper_row("small_a/demo_only_finetuned_10") == "scenario_a_finetuned/episodes_10"
    results = collect_results(map(make_record, ["small/ambiguity_object/deltaco", "mine/cosine_loss"]))
    assert [result.paper.rate for result in results] == pytest.approx([np.nan, 0.305], nan_ok=True)


def test_a_variant_is_compared_with_the_same_trainings():
    def succeeds(seed):
        return lambda task_id, trial: trial < seed

    main = [make_record(seed=seed, succeeds=succeeds(seed)) for seed in (0, 1, 2)]
    others = [
        make_record(seed=1, plan={"without": "instruction"}, succeeds=never),
        make_record(seed=1, plan={"without": "instruction", "n_demonstrations": 3}, succeeds=succeeds(2)),
        make_record("scenario_a/mcil", succeeds=succeeds(2)),
    ]
    table = make_table(collect_results([*main, *others]), report.difference_rows)
    name = "scenario_a/deltaco"
    assert table["compared_with"].tolist() == [name, f"{name}, without instruction", name]
    # Seed 1 alone succeeds in half of the episodes, as all three seeds do.
    assert table["detectable"].tolist() == [0.0] * 3  # for all tasks are alike
    assert table["difference"].tolist() == [Estimate(*[difference] * 3) for difference in (-0.5, 1.0, 0.5)]


def test_outcomes():
    columns = {
        "grasped_object": [0, 1, 2, -1] * 3,
        "right_object": [True, False, False, False] * 3,
        "object_containers": [[1, -1, -1], [-1, 0, -1], [-1, -1, -1], [-1, -1, -1]] * 3,
        "right_container": [True, False, False, False] * 3,
        "success": [True, False, False, False] * 3,
    }
    (row,) = make_table(collect_results([make_record(columns=columns)]), report.outcome_rows).to_dict(
        "records"
    )
    # By name the tasks 24 and 124, by color 32 and 132, by shape 45 and 145; two trials of each.
    assert (row["name"], row["color"], row["shape"]) == (0.25, 0.25, 0.25)
    assert row["grasped_anything"] == 0.75
    assert row["right_object_of_grasped"] == pytest.approx(1 / 3)
    assert row["right_container_of_placed"] == 0.5


def test_the_ladder_counts_failures_if_they_were_recorded():
    failures = ["none", "none", "not found", "missed"]
    columns = {
        "failure": failures * 3,
        "success": [True, True, False, False] * 3,
        "pick_error": [1.0, 2.0, 3.0, 4.0] * 3,
        "object_containers": [[0, 0, 0], [1, 1, 1], [-1, -1, -1], [-1, -1, -1]] * 3,
    }
    records = [make_record(columns=columns), make_record(plan={"oracle": "location"})]
    (row,) = make_table(collect_results(records), report.ladder_rows).to_dict("records")
    assert (row["oracle"], row["success"], row["not_found"], row["missed"]) == ("none", 0.5, 0.25, 0.25)
    # Of two episodes in which all objects lie in one container, the target is there.
    scenes = scene_columns(records[0])
    assert row["success_at_end"] == scenes["success_at_end"].mean()
    assert 0 < row["success_at_end"] < 0.5
    assert row["pick_error_mm"] == "2.5, 4.0"
    assert "place_error_mm" not in row


def test_calibration_counts_grasps_by_the_policys_probability():
    columns = {"pick_confidence": [0.6] * 4 + [0.99] * 8, "grasped_object": [0] * 11 + [-1]}
    record = make_record(succeeds=lambda task_id, trial: trial == 0, columns=columns)
    table = make_table(collect_results([record]), report.calibration_rows)
    assert table["sure"].tolist() == ["50 to 70 %", "97 to 100 %"]
    assert table["grasps"].tolist() == [4, 7]
    assert table["right_object"].tolist() == [0.5, 4 / 7]


def test_success_stands_beside_the_papers():
    records = [make_record("small_a/deltaco", seed, step) for seed in (0, 1) for step in (1000, 2000)]
    (row,) = make_table(collect_results(records), report.success_rows).to_dict("records")
    assert (row["paper"], row["paper_sd"], row["best_sets"], row["best_sets_sd"]) == (0.258, 0.034, 0.5, 0.0)
    assert (row["training_seeds"], row["step"], row["each_seed"]) == ("0 1", 2000, "50.0, 50.0")
    assert (row["episodes"], row["scenes"]) == (24, "1000")


def test_a_report_has_the_tables_of_its_records(tmp_path):
    name = r"=mine/a|b_*c*_$x$"
    runs = [(seed, step) for seed in (0, 1) for step in (1000, 2000)]
    records = [make_record(name, *run, policy={"seed": run[0], "lr": run[0] / 10}) for run in runs]
    records.append(make_record(name, plan={"counterfactual": "instruction"}))
    write_records(tmp_path / "records.parquet", records)
    page = write_report([tmp_path], tmp_path / "out")
    text = page.read_text(encoding="utf-8")
    assert r"| =mine/a\|b\_\*c\*\_$x$ |" in text
    assert "differ in `lr`." in text
    tables = {"success", "outcomes", "differences", "counterfactuals", "evaluations"}
    assert links(page) == {"success.png", *(f"{table}.csv" for table in tables)}
    assert links(page) == {path.name for path in page.parent.iterdir()} - {"report.md"}
    row = pd.read_csv(page.parent / "success.csv").iloc[0]
    assert row["experiment"] == name
    assert row["success_low"] < row["success"] == 0.5 < row["success_high"]
    assert escape("a_b|*c*\n[d](e) `f` <g> &lt;") == r"a\_b\|\*c\* \[d\](e) \`f\` \<g\> \&lt;"
    # A later report leaves no tables of the earlier one.
    write_records(tmp_path / "records.parquet", records[:1])
    write_report([tmp_path / "records.parquet"], tmp_path / "out")
    assert links(page) == {"success.png", "success.csv", "outcomes.csv"}
    assert links(page) == {path.name for path in page.parent.iterdir()} - {"report.md"}


@pytest.mark.parametrize("page", update_docs.PAGES, ids=lambda page: page.name)
def test_pages_are_what_the_records_give(page):
    text, tables = page.read_text(encoding="utf-8"), update_docs.PAGES[page]()
    assert text.count("<!-- table ") == text.count("<!-- end -->") == len(tables)
    assert update_docs.fill_tables(text, tables) == text
