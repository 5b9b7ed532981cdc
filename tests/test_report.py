"""Reports: statistics against numbers worked by hand, rows by settings, and the committed results."""

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from example_records import make_record

from gym_deltaco.tasks import CONTAINER_WORDS, SCENARIOS, TASKS, get_task
from lerobot_deltaco import leaderboard
from lerobot_deltaco.paper_results import PAPER_RESULTS, in_order, label_of, paper_result
from lerobot_deltaco.records import read_records, scene_columns, write_records
from lerobot_deltaco.report import TABLES, escape, write_report
from lerobot_deltaco.report_tables import (
    ReportError,
    counterfactuals_table,
    curves_table,
    differences_table,
    kinds_table,
    make_series,
    outcomes_table,
    paper_table,
    paraphrases_table,
    success_table,
)
from lerobot_deltaco.statistics import (
    bootstrap,
    followed,
    novelties,
    paired_difference,
    paper_rate,
    success_interval,
    task_rates,
    wilson_interval,
)

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "results"


def never(task_id, trial):
    return False


def episodes_of(**outcomes):
    """Episodes of tasks 1, 2, ... with outcomes such as "110"."""
    rows = [(int(name[1:]), mark == "1") for name, marks in outcomes.items() for mark in marks]
    return pd.DataFrame(rows, columns=["task_id", "success"])


def task_named(row, word):
    return TASKS[50 * CONTAINER_WORDS.index(word) + row]


# Statistics


def test_tasks_count_alike():
    episodes = episodes_of(t1="1", t2="0000", t3="10")
    assert task_rates(episodes).to_dict() == {1: 1.0, 2: 0.0, 3: 0.5}
    rate, low, high = success_interval(episodes)
    assert rate == 0.5
    assert (low, high) == (0.0, 1.0)


def test_the_interval_is_that_of_resampled_tasks():
    values = np.random.default_rng(1).random(30)
    estimate = bootstrap(values)
    means = [
        values[np.random.default_rng([2, n]).integers(30, size=30)].mean() for n in range(4000)
    ]  # other draws
    np.testing.assert_allclose(estimate[1:], np.quantile(means, (0.025, 0.975)), atol=0.01)
    assert estimate == bootstrap(values)
    assert bootstrap([0.25] * 7) == (0.25, 0.25, 0.25)


def test_differences_are_paired_by_task():
    first, second = episodes_of(t1="11", t2="10", t3="00"), episodes_of(t2="00", t1="10", t9="11")
    assert paired_difference(first, second) == (0.5, 0.5, 0.5)
    assert paired_difference(first, episodes_of(t9="1")) is None


def test_wilson_interval():
    # Newcombe 1998, table I: 81 of 263 and 0 of 20.
    np.testing.assert_allclose(wilson_interval(81, 263), (0.2553, 0.3662), atol=5e-5)
    np.testing.assert_allclose(wilson_interval(0, 20), (0.0, 0.1611), atol=5e-5)
    assert wilson_interval(20, 20)[1] == 1.0


def test_the_papers_rate_is_that_of_the_ten_best_sets():
    rates = np.array([[0.1 * n, 0.1 * n + 0.02] for n in (0, 5, 1, 2, 3, 4, 6, 7, 8, 9, 0, 3)])
    found = paper_rate(rates)
    assert found.best == (1, 2, 3, 4, 5, 6, 7, 8, 9, 11)
    assert found.rate == pytest.approx(np.mean([5, 1, 2, 3, 4, 6, 7, 8, 9, 3]) / 10 + 0.01)
    assert found.sd == pytest.approx(0.01)
    # Of a tie, the earlier sets; of a single seed, no SD.
    tied = paper_rate([[0.5]] * 12)
    assert tied.best == tuple(range(10))
    assert np.isnan(tied.sd)


def test_novelty_is_by_what_training_asks_for():
    train = SCENARIOS["a"].train_tasks[:3]
    record = make_record(plan={"tasks": ",".join(map(str, train))})
    assert set(novelties(record)) == {"training_task"}
    # By name: of a test object, of object 29, and of a training object by its color.
    yellow_name, unnamed, brown = task_named(29, "green"), task_named(30, "green"), task_named(33, "green")
    assert yellow_name.targets == (29,)
    record = make_record(plan={"tasks": f"{yellow_name.index},{unnamed.index},{brown.index}", "trials": 4})
    found = novelties(record).groupby(record.episodes["task_id"]).agg(set)
    assert found[yellow_name.index] == {"unnamed_target"}
    assert found[unnamed.index] == {"never_target"}
    assert found[brown.index] <= {"training_task", "other_words", "never_target"}


def counterfactual_record(counterfactual, follows):
    """A record in which demonstration and instruction ask for different things."""
    plan = {"counterfactual": counterfactual, "tasks": "24-31", "trials": 1}
    record = make_record(plan=plan, succeeds=never)
    scenes = scene_columns(record)
    rows = []
    for task_id, objects, target in zip(
        record.episodes["task_id"], scenes["objects"], scenes["target_object"], strict=True
    ):
        own = get_task(task_id)
        other_object = next(n for n in range(3) if n != target)
        word = "red" if own.container == "green" else "green"
        if objects[other_object] >= 32:
            pytest.skip("no task has the name of the other object")
        other = task_named(objects[other_object], word)
        chosen = {"scene": (target, own), "other": (other_object, other), "none": (-1, own)}[follows]
        filled = [-1, -1, -1]
        if chosen[0] >= 0:
            filled[chosen[0]] = int(chosen[1].container == "red")
        rows.append(
            {
                "demonstration_task": (other if counterfactual == "demonstration" else own).index,
                "instruction": other.instruction if counterfactual == "instruction" else None,
                "grasped_object": chosen[0],
                "object_containers": filled,
            }
        )
    columns = {name: [row[name] for row in rows] for name in rows[0]}
    return make_record(plan=plan, succeeds=never, columns=columns)


@pytest.mark.parametrize(
    ("counterfactual", "follows", "column"),
    [
        ("demonstration", "scene", "instruction"),
        ("demonstration", "other", "demonstration"),
        ("instruction", "scene", "demonstration"),
        ("instruction", "other", "instruction"),
        ("instruction", "none", "neither"),
    ],
)
def test_followed_counts_conflicts(counterfactual, follows, column):
    record = counterfactual_record(counterfactual, follows)
    table = followed([record, record]).set_index("aspect")
    assert list(table.columns) == ["demonstration", "instruction", "neither", "episodes"]
    assert (table["episodes"] == 2 * len(record.episodes)).all()
    assert (table[column] == table["episodes"]).all()


def test_inputs_that_agree_are_not_counted():
    record = make_record(plan={"counterfactual": "demonstration"})  # the demonstrations are the scene's
    assert followed([record])["episodes"].tolist() == [0, 0]


# Rows


def test_other_settings_have_rows_of_their_own():
    plans = [
        {},
        {"without": "instruction"},
        {"n_demonstrations": 5},
        {"seed": 7},
        {"tasks": "0-3", "trials": 4},
        {"instruction": "put it there"},
        {"counterfactual": "demonstration"},
    ]
    records = [make_record(seed=seed, plan=plan) for plan in plans for seed in (0, 1)]
    # Most of the group's are main settings.
    records += [make_record("scenario_a/mcil", step=step) for step in (1, 2)]
    series = make_series(records)
    assert [item.variant for item in series] == [
        "",
        "5 demonstrations",
        "another task's demonstration",
        "evaluation seed 7",
        "put it there",
        "without the instruction",
        "on 0-3",
        "",
    ]
    assert [len(item.runs) for item in series] == [2] * 7 + [1]
    assert len(counterfactuals_table(series)) == 2
    # A row for all seeds, and for each.
    table = success_table(series)
    assert table["training_seeds"].tolist() == ["0 1", "0", "1"] * 6 + ["0"]
    assert set(table["variant"]) == {item.variant for item in series} - {"another task's demonstration"}


def test_only_steps_of_all_seeds_count():
    steps = {0: (10, 20, 30), 1: (10, 20), 2: (20, 40)}
    records = [make_record(seed=seed, step=step) for seed, found in steps.items() for step in found]
    (series,) = make_series(records)
    assert series.steps == (20,)
    assert len(series.episodes) == 3 * len(records[0].episodes)
    assert make_series([make_record(seed=0, step=1), make_record(seed=1, step=2)]) == []
    assert curves_table([series]).empty


def test_what_cannot_be_compared_is_refused():
    with pytest.raises(ReportError, match=r"step 10000 of 'scenario_a/deltaco' with the training seed 0"):
        make_series([make_record(), make_record(succeeds=never)])
    with pytest.raises(ReportError, match="several versions of the benchmark, a-v0, a-v1"):
        make_series([make_record("a/b", versions={"benchmark": f"a-v{n}"}) for n in range(2)])


def test_a_variant_is_compared_with_the_same_trainings():
    def succeeds(seed):
        return lambda task_id, trial: trial < seed

    main = [make_record(seed=seed, succeeds=succeeds(seed)) for seed in (0, 1, 2)]
    others = [
        make_record(seed=1, plan={"without": "instruction"}, succeeds=never),
        make_record(seed=1, plan={"without": "instruction", "n_demonstrations": 3}, succeeds=succeeds(2)),
        make_record("scenario_a/mcil", succeeds=succeeds(2)),
    ]
    table = differences_table(make_series([*main, *others]))
    rows = table[["experiment", "variant", "less", "less_variant", "difference"]].values.tolist()
    assert rows == [
        # Seed 1 alone succeeds in half of the episodes, as all three seeds do.
        ["scenario_a/deltaco", "without the instruction", "scenario_a/deltaco", "", -0.5],
        [
            "scenario_a/deltaco",
            "without the instruction, 3 demonstrations",
            "scenario_a/deltaco",
            "without the instruction",
            1.0,
        ],
        ["scenario_a/mcil", "", "scenario_a/deltaco", "", 0.5],
    ]


def test_paraphrases_stand_beside_templates():
    wording = {"wording": "people.csv (held_out), SHA-256 0123"}
    records = [
        make_record(),
        make_record(succeeds=lambda task_id, trial: task_id == 24, **wording),
        make_record("scenario_a/mcil", **wording),  # without templates
    ]
    (row,) = paraphrases_table(make_series(records)).to_dict("records")
    assert (row["experiment"], row["instructions"]) == ("scenario_a/deltaco", "people.csv (held_out)")
    assert (row["templates"], row["paraphrases"]) == pytest.approx((3 / 6, 1 / 6))
    assert row["difference"] == pytest.approx(-2 / 6)
    assert row["fraction"] == pytest.approx(1 / 3)


def test_outcomes_and_kinds():
    columns = {
        "grasped_object": [0, 1, 2, -1] * 3,
        "right_object": [True, False, False, False] * 3,
        "object_containers": [[1, -1, -1], [-1, 0, -1], [-1, -1, -1], [-1, -1, -1]] * 3,
        "right_container": [True, False, False, False] * 3,
        "success": [True, False, False, False] * 3,
    }
    series = make_series([make_record(columns=columns)])
    (row,) = outcomes_table(series).to_dict("records")
    assert (row["grasped_anything"], row["right_object"], row["right_container"]) == (0.75, 0.25, 0.25)
    assert row["right_object_of_grasped"] == pytest.approx(1 / 3)
    assert row["right_container_of_placed"] == 0.5
    # By name the tasks 24 and 124, by color 32 and 132, by shape 45 and 145; two trials of each.
    (row,) = kinds_table(series).to_dict("records")
    by_task = [0.5, 0.0] * 3  # 24, 32, 45, 124, 132, 145
    assert (row["name"], row["color"], row["shape"]) == (0.25, 0.25, 0.25)
    positions = [get_task(task_id).is_position_task for task_id in (24, 32, 45, 124, 132, 145)]
    expected = np.mean([rate for rate, is_position in zip(by_task, positions, strict=True) if is_position])
    assert row["position_word"] == pytest.approx(expected)


def test_the_papers_results_have_names_and_an_order():
    assert paper_result("small_a/cosine_loss") == PAPER_RESULTS["ablations/cosine_loss"]
    assert paper_result("mine/cosine_loss") is None
    assert label_of("mine/objects_24") == "24 training objects"
    assert label_of("mine/my_method") == "my method"
    names = ["z/a", "z/objects_100", "z/objects_24", "small_b/oracle", "small_b/deltaco", "small_a/one_hot"]
    order = ["small_a/one_hot", "small_b/deltaco", "small_b/oracle", "z/a", "z/objects_24", "z/objects_100"]
    assert sorted(names, key=in_order) == order
    (row,) = paper_table(make_series([make_record("small_a/deltaco")])).to_dict("records")
    assert (row["paper"], row["paper_sd"], row["last"]) == (0.258, 0.034, 0.5)


# Reports


def test_a_report_has_the_tables_of_its_records(tmp_path):
    name = r"=mine/a|b_*c*_$x$"
    records = [make_record(name, seed, step) for seed in (0, 1) for step in (1000, 2000)]
    write_records(tmp_path / "records.parquet", records)
    page = write_report([tmp_path], tmp_path / "out")
    text = page.read_text(encoding="utf-8")
    assert r"| a\|b \*c\* $x$ |" in text
    links = set(re.findall(r"\]\(([^)]*)\)", text))
    assert links == {path.name for path in page.parent.iterdir()} - {"report.md"}
    assert {"success.png", "curves.png", "success.csv", "curves.csv"} <= links
    assert "50.0 [" in text
    table = pd.read_csv(page.parent / "success.csv")
    assert table.loc[0, "training_seeds"] == "0 1"
    assert table.loc[0, "experiment"] == f"'{name}"  # no formula in a spreadsheet
    assert table.loc[0, "success"] == 0.5
    # A later report leaves no tables of the earlier one.
    write_records(tmp_path / "records.parquet", records[:1])
    text = write_report([tmp_path / "records.parquet"], tmp_path / "out").read_text(encoding="utf-8")
    links = set(re.findall(r"\]\(([^)]*)\)", text))
    assert links == {path.name for path in page.parent.iterdir()} - {"report.md"}
    assert "curves.png" not in links


def test_names_are_escaped():
    assert escape("a_b|*c*\n[d](e) `f` <g> &lt;") == r"a\_b\|\*c\* \[d\](e) \`f\` \<g\> \&lt;"


def test_counterfactuals_alone_make_a_report(tmp_path):
    write_records(tmp_path / "a.parquet", [counterfactual_record("instruction", "scene")])
    page = write_report([tmp_path], tmp_path / "out")
    assert {path.name for path in page.parent.iterdir()} == {"report.md", "counterfactuals.csv"}


@pytest.mark.parametrize(
    "name", ["lerobot_policies", "small_a_correspondence", "small_a_wordings", "small_b"]
)
def test_committed_reports_are_what_the_records_give(tmp_path, name):
    write_report([RESULTS / name], tmp_path)
    files = {path.name for path in (RESULTS / name).iterdir() if path.suffix in (".md", ".csv", ".png")}
    assert files == {path.name for path in tmp_path.iterdir()}
    for file in files:
        if not file.endswith(".png"):
            assert (tmp_path / file).read_bytes() == (RESULTS / name / file).read_bytes(), file


def test_committed_numbers():
    """Statistics give the same numbers to the last digit, whatever happens to their code."""
    row = pd.read_csv(RESULTS / "small_a" / "success.csv").iloc[0]
    assert (row["experiment"], row["training_seeds"]) == ("small_a/deltaco", "0 1 2")
    assert (row["success"], row["success_low"], row["success_high"]) == (0.392974, 0.340686, 0.447712)
    table = pd.read_csv(RESULTS / "small_a_correspondence" / "counterfactuals.csv")
    assert table["n_episodes"].tolist() == [328, 408, 328, 408]
    np.testing.assert_allclose(table["demonstration"] * table["n_episodes"], [180, 6, 211, 3], atol=0.01)


def test_all_records_are_reported():
    """Every set of runs has a report, and its records fit together."""
    for folder in sorted(path for path in RESULTS.iterdir() if path.is_dir()):
        assert make_series(read_records(folder))
        tables = {path.stem for path in folder.glob("*.csv")}
        assert {"success", "kinds", "outcomes", "novelty"} <= tables <= set(TABLES)


@pytest.mark.parametrize(
    ("page", "make"),
    [
        (leaderboard.LEADERBOARD_PAGE, leaderboard.leaderboard),
        (leaderboard.PAPER_PAGE, leaderboard.paper_tables),
    ],
)
def test_pages_are_what_the_records_give(page, make):
    text = (ROOT / page).read_text(encoding="utf-8")
    made = leaderboard.replace_section(text, leaderboard.BEGIN, leaderboard.END, make(ROOT))
    assert made == text
    with pytest.raises(ValueError, match="The page needs the lines"):
        leaderboard.replace_section("text", leaderboard.BEGIN, leaderboard.END, "")
