"""The report on evaluations: statistics against numbers worked by hand, and what becomes of odd records."""

import csv
import json
import re
import subprocess
import sys
from collections import Counter
from dataclasses import asdict, replace

import numpy as np
import pytest
from PIL import Image

from gym_deltaco import ENV_ID
from gym_deltaco.tasks import COLOR_SHAPE_TASKS, CONTAINER_WORDS, TASKS
from lerobot_deltaco.commands import report as report_command
from lerobot_deltaco.configuration_deltaco import DeltacoConfig
from lerobot_deltaco.evaluation.record import (
    RECORD_FORMAT,
    EpisodeResult,
    EvaluationRecord,
    RecordError,
    read_record,
    record_path,
    write_record,
)
from lerobot_deltaco.reporting.curves import Curve, curves_figure
from lerobot_deltaco.reporting.novelty import novelty, scenario_of
from lerobot_deltaco.reporting.paper_results import (
    PAPER_OPTIONS,
    PAPER_RESULTS,
    TITLES,
    in_order,
    label_of,
    paper_result,
)
from lerobot_deltaco.reporting.report import FILES, write_report
from lerobot_deltaco.reporting.series import ReportError, counted, find_records, make_report
from lerobot_deltaco.reporting.statistics import (
    breakdown,
    followed,
    paper_rate,
    unknown_sentences,
    wilson_interval,
)
from lerobot_deltaco.reporting.task_bootstrap import mean_rate, paired_difference, task_rates

# Names, colors and shapes; a color word and position words.
TASK_IDS = (24, 32, 45, 124, 132, 145)
VERSIONS = {"benchmark": ENV_ID, "lerobot": "0.6.1"}


def task_named(row, word):
    return TASKS[50 * CONTAINER_WORDS.index(word) + row]


def episode(task_id, trial=0, success=False, **changes):
    """The target, number 0, goes where it shall, or nothing happens. Green is in front, on the right."""
    task = TASKS[task_id]
    container = int(task.container not in ("green", "front", "right"))
    result = EpisodeResult(
        task_id=task_id,
        trial=trial,
        seed=task_id,
        instruction=task.instruction,
        demonstration=task.instruction,
        demonstration_episodes=[task_id],
        demonstrated_objects=[task.targets[0]],
        success=success,
        objects=[task.targets[0], *[index for index in range(32) if index not in task.targets][:2]],
        object_containers=[container if success else -1, -1, -1],
        container_quadrants=[[0, 1], [1, 0]],
        target_object=0,
        target_container=container,
        grasped_object=0 if success else -1,
        right_object=success,
        right_container=success,
    )
    return replace(result, **changes)


def record(experiment="scenario_a/deltaco", seed=0, step=10_000, n_successes=3, trials=1, **changes):
    """Six tasks, of which the first ones succeed."""
    cells = [(task_id, trial) for trial in range(trials) for task_id in TASK_IDS]
    result = EvaluationRecord(
        experiment=experiment,
        method=experiment.rpartition("/")[2],
        run_seed=seed,
        step=step,
        evaluation_seed=0,
        counterfactual="none",
        ambiguity="container",
        objects="all",
        adversarial_probability=0.6,
        tasks=",".join(map(str, TASK_IDS)),
        trials=trials,
        episodes=[episode(*cell, success=number < n_successes) for number, cell in enumerate(cells)],
        policy={"language_encoder": "all-MiniLM-L6-v2", "backbone": "strided", "seed": seed},
        versions=VERSIONS,
        command=f"deltaco-evaluate --run {experiment}_{seed}",
        seconds=36.0,
    )
    return replace(result, **changes)


def write(root, *records):
    for item in records:
        folder = root / f"{item.experiment.replace('/', '_')}_{item.run_seed}"
        write_record(item, record_path(folder, item.step, item.counterfactual))
    return root


def run(root, experiment, seed, n_successes):
    """A run whose evaluation sets, from step 10,000 on, have so many successes of six."""
    write(root, *(record(experiment, seed, 10_000 * (n + 1), k) for n, k in enumerate(n_successes)))


@pytest.fixture
def runs(tmp_path):
    """Two experiments with two seeds each, and a counterfactual evaluation of one of them."""
    root = tmp_path / "runs"
    for seed in (0, 1):
        run(root, "scenario_a/deltaco", seed, [1, 2 + seed, 4])
        run(root, "scenario_a/one_hot", seed, [0, 1, 1])
        other = TASKS[47].instruction
        result = record("scenario_a/deltaco", seed, 30_000, 2, counterfactual="demo")
        episodes = [replace(item, demonstration=other) for item in result.episodes]
        write(root, replace(result, episodes=episodes))
    return root


def rows(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


# The statistics


def test_the_papers_rate_by_hand():
    rates = np.array([[0.1, 0.3], [0.6, 0.2], [0.5, 0.5]])  # means .2 .4 .5, SDs .1 .2 0
    rate, sd, best = paper_rate(rates)
    assert rate == pytest.approx((0.2 + 0.4 + 0.5) / 3)
    assert sd == pytest.approx((0.1 + 0.2 + 0.0) / 3)
    assert best == (0, 1, 2)


def test_the_papers_rate_is_of_the_ten_best_sets():
    rates = np.array([[0.0, 0.0], *([[0.4, 0.6]] * 5), [0.1, 0.1], *([[0.3, 0.3]] * 6)])
    rate, sd, best = paper_rate(rates)
    assert best == (1, 2, 3, 4, 5, 7, 8, 9, 10, 11)  # of those with a mean of .3, the earlier ones
    assert rate == pytest.approx((5 * 0.5 + 5 * 0.3) / 10)
    assert sd == pytest.approx(5 * 0.1 / 10)


def test_ties_do_not_depend_on_the_order_of_the_seeds():
    rates = np.array([[0.3, 0.2, 0.1]] * 10 + [[0.1, 0.2, 0.3]])
    assert rates[0].mean() < rates[-1].mean()
    assert paper_rate(rates).best == tuple(range(10))


def test_one_seed_has_no_standard_deviation():
    rate, sd, best = paper_rate([[0.25], [0.75]])
    assert (rate, sd, best) == (0.5, None, (0, 1))


@pytest.mark.parametrize(
    ("count", "total", "low", "high"),
    [
        # Newcombe, Statistics in Medicine 17 (1998), table I, method 3.
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0000, 0.1611),
        (1, 29, 0.0061, 0.1718),
        # By symmetry.
        (20, 20, 0.8389, 1.0000),
    ],
)
def test_wilson_intervals_against_published_ones(count, total, low, high):
    assert wilson_interval(count, total) == pytest.approx((low, high), abs=5e-5)


def test_the_breakdown_counts_each_kind_and_word():
    green, front = task_named(0, "green").index, task_named(0, "front").index
    color, shape = task_named(33, "left").index, task_named(40, "red").index
    episodes = [
        episode(green, success=True),
        episode(green, 1, grasped_object=0, right_object=True),
        episode(front, grasped_object=2),
        episode(color, success=True),
        episode(shape, object_containers=[-1, 0, -1], grasped_object=1, right_container=True),
    ]
    found = {(row.kind, row.word): row.outcomes for row in breakdown(episodes)}
    assert len(found) == 4 * 3
    counts = {name: item.count for name, item in found["all", "all"].items()}
    assert counts == {
        "success": 2,
        "grasped_anything": 5,
        "right_object": 3,
        "right_container": 3,
        "right_object_and_container": 2,
    }
    totals = {group: outcomes["success"].total for group, outcomes in found.items()}
    assert totals["all", "all"] == 5
    assert [totals[kind, "all"] for kind in ("name", "color", "shape")] == [3, 1, 1]
    assert [totals["all", word] for word in ("color_word", "position_word")] == [3, 2]
    assert [totals["name", word] for word in ("color_word", "position_word")] == [2, 1]
    assert found["name", "color_word"]["right_object"].count == 2
    assert found["color", "color_word"]["success"].rate is None
    assert found["color", "color_word"]["success"].interval is None


# What behavior followed. Green stands in front on the right, red at the back on the left.

SCENE = {"objects": [24, 1, 4], "container_quadrants": [[0, 1], [1, 0]]}  # a bathtub, a vase, a chalice
GREEN_BATHTUB = task_named(24, "green")


def follow(counterfactual="demo", among="all", **changes):
    """What was followed, by aspect and cue: the counts (of how many)."""
    scene = episode(GREEN_BATHTUB.index, **{**SCENE, **changes})
    found = followed([scene], counterfactual)
    return {
        (item.aspect, item.cue): (item.proportion.count, item.proportion.total)
        for item in found
        if item.among == among
    }


def test_following_the_demonstration():
    other = task_named(40, "back").instruction  # a vase, into what is the red container here
    done = {"demonstration": other, "grasped_object": 1, "object_containers": [-1, 1, -1]}
    assert follow(**done) == {
        ("object", "scene"): (0, 1),
        ("object", "demonstration"): (1, 1),
        ("object", "instruction"): (0, 1),
        ("container", "scene"): (0, 1),
        ("container", "demonstration"): (1, 1),
        ("container", "instruction"): (0, 1),
    }
    assert follow(**done, among="conflicts") == {
        ("object", "demonstration"): (1, 1),
        ("object", "instruction"): (0, 1),
        ("object", "neither"): (0, 1),
        ("container", "demonstration"): (1, 1),
        ("container", "instruction"): (0, 1),
        ("container", "neither"): (0, 1),
    }


def test_following_the_instruction_in_one_and_the_demonstration_in_the_other():
    found = follow(
        demonstration=task_named(1, "red").instruction,
        grasped_object=0,
        object_containers=[1, -1, -1],
        among="conflicts",
    )
    assert found["object", "instruction"] == found["container", "demonstration"] == (1, 1)
    assert found["object", "demonstration"] == found["container", "instruction"] == (0, 1)


@pytest.mark.parametrize(
    "done",
    [
        {"grasped_object": -1, "object_containers": [-1, -1, -1]},
        {"grasped_object": 2, "object_containers": [0, 1, -1]},  # something in both containers
    ],
)
def test_following_neither(done):
    found = follow(demonstration=task_named(1, "red").instruction, among="conflicts", **done)
    for aspect in ("object", "container"):
        assert found[aspect, "neither"] == (1, 1)
        assert found[aspect, "demonstration"] == found[aspect, "instruction"] == (0, 1)


def test_what_both_ask_for_is_no_conflict():
    other = task_named(24, "front").instruction  # the same object, and the same container here
    done = {"demonstration": other, "grasped_object": 0, "object_containers": [0, -1, -1]}
    assert set(follow(**done).values()) == {(1, 1)}
    assert {total for _, total in follow(**done, among="conflicts").values()} == {0}


def test_what_is_not_in_the_scene_cannot_be_followed():
    other = task_named(16, "left").instruction  # no canoe; red stands on the left
    found = follow(demonstration=other, grasped_object=2)
    assert found["object", "demonstration"] == (0, 0)
    assert found["container", "demonstration"] == (0, 1)
    assert follow(demonstration=other, among="conflicts")["object", "neither"] == (0, 0)


def test_a_word_that_describes_both_containers_leaves_no_choice():
    in_front = {"container_quadrants": [[0, 1], [1, 1]], "object_containers": [0, -1, -1]}
    for word in ("front", "back"):
        found = follow(demonstration=task_named(1, word).instruction, **in_front)
        assert found["container", "demonstration"] == (0, 0)
    found = follow(demonstration=task_named(1, "left").instruction, **in_front)
    assert found["container", "demonstration"] == (0, 1)


def test_a_color_of_another_task_may_be_that_of_several_objects():
    brown = task_named(33, "red").instruction
    for grasped, count in ((0, 0), (1, 1), (2, 1)):
        found = follow(demonstration=brown, objects=[24, 1, 3], grasped_object=grasped)
        assert found["object", "demonstration"] == (count, 1)


def test_of_identical_objects_the_demonstration_means_one_and_the_instruction_either():
    twins = {"objects": [24, 24, 1]}
    for grasped, scene in ((0, 1), (1, 0)):
        found = follow("instruction", grasped_object=grasped, **twins)
        assert found["object", "scene"] == found["object", "demonstration"] == (scene, 1)
        assert found["object", "instruction"] == (1, 1)
    found = follow("instruction", "conflicts", grasped_object=1, **twins)
    assert found["object", "neither"] == (0, 0)


def test_sentences_of_no_task():
    paraphrase = {"instruction": "drop the tub into the green thing", "grasped_object": 0}
    other = task_named(1, "red").instruction
    # Unless the instruction is what was changed, it is the scene's task in other words.
    assert follow("demo", demonstration=other, **paraphrase)["object", "instruction"] == (1, 1)
    assert follow("instruction", **paraphrase)["object", "instruction"] == (0, 0)
    scene = episode(GREEN_BATHTUB.index, **SCENE, **paraphrase)
    assert unknown_sentences([scene], "instruction") == 1
    assert unknown_sentences([scene], "demo") == unknown_sentences([scene], "none") == 0
    assert follow("demo", demonstration=None)["object", "demonstration"] == (0, 0)


def test_tasks_by_color_and_shape_are_tasks():
    own, other = COLOR_SHAPE_TASKS[0], COLOR_SHAPE_TASKS[100]
    (item,) = [replace(episode(0), task_id=own.index, demonstration=other.instruction)]
    assert unknown_sentences([item], "demo") == 0
    found = {(row.kind, row.word): row.outcomes["success"].total for row in breakdown([item, episode(0)])}
    assert (found["color_shape", "all"], found["name", "all"], found["all", "all"]) == (1, 1, 2)


def test_the_page_has_columns_of_the_kinds_of_task_that_were_evaluated(tmp_path):
    tasks = [task.index for task in COLOR_SHAPE_TASKS[:2]]
    episodes = [replace(episode(0), task_id=task_id) for task_id in tasks]
    changes = {"tasks": ",".join(map(str, tasks)), "episodes": episodes}
    write_report([write(tmp_path / "runs", record(**changes))], tmp_path / "out")
    assert "| color shape |" in (tmp_path / "out/report.md").read_text()
    write_report([write(tmp_path / "paper", record())], tmp_path / "out")
    assert "color shape" not in (tmp_path / "out/report.md").read_text()


# The authors' numbers


def test_experiments_stand_as_in_the_papers_tables():
    mine = ["z", "scenario_a/z", "mine/a"]
    published = list(PAPER_RESULTS)
    end_of_a = published.index("scenario_b/deltaco")
    expected = [*published[:end_of_a], "scenario_a/z", *published[end_of_a:], "z", "mine/a"]
    assert sorted([*mine, *reversed(published)], key=in_order) == expected


def test_numbers_in_names_sort_by_their_value():
    names = ["mine/objects_100", "mine/objects_24", "mine/objects_24_either", "mine/objects_4000"]
    assert sorted(names, key=in_order) == [names[1], names[2], names[0], names[3]]


def test_the_authors_numbers():
    assert PAPER_RESULTS["scenario_a/deltaco"][1:] == pytest.approx((0.258, 0.034))
    assert PAPER_RESULTS["scenario_b/oracle"][1:] == pytest.approx((0.617, 0.14))
    assert PAPER_RESULTS["ablations/clip_mlp_1"].rate < PAPER_RESULTS["ablations/clip_mlp_2"].rate
    groups = Counter(name.partition("/")[0] for name in PAPER_RESULTS)
    assert groups == {"scenario_a": 15, "scenario_b": 5, "ambiguity_object": 3, "ablations": 11}
    assert {*groups, "small_a", "small_b", "small_ambiguity"} == set(TITLES)
    assert all(0 < item.sd < item.rate < 1 for item in PAPER_RESULTS.values())
    assert label_of("mine/my_method") == "my method"


def test_an_experiment_that_repeats_a_row_of_the_paper_has_its_name_place_and_rate():
    assert paper_result("small_a/cosine_loss") == PAPER_RESULTS["ablations/cosine_loss"]
    assert paper_result("small_b/deltaco") == PAPER_RESULTS["scenario_b/deltaco"]
    assert paper_result("small_a/minilm_l3") is None
    assert label_of("small_ambiguity/demo_only") == "demo only"
    names = ["small_a/cosine_loss", "small_a/minilm_l3", "small_a/bc_z", "small_a/deltaco", "small_b/oracle"]
    in_the_papers_order = [names[3], names[2], names[0], names[1], names[4]]
    assert sorted(names, key=in_order) == in_the_papers_order


# Records


def test_a_record_comes_back_as_it_was(tmp_path):
    original = record(trials=2)
    original = replace(original, episodes=[replace(original.episodes[0], demonstration=None)])
    path = record_path(tmp_path, 20_000, "demo")
    assert path.name == "0020000_demo.json"
    write_record(original, path)
    assert read_record(path) == original
    assert original.success_rate == 1
    assert list(path.parent.iterdir()) == [path]


def test_an_interrupted_write_leaves_the_record_as_it_was(tmp_path, monkeypatch):
    path = record_path(tmp_path, 1)
    write_record(record(), path)
    before = path.read_bytes()

    def full_disk(*_):
        raise OSError("disk full")

    monkeypatch.setattr("os.replace", full_disk)
    with pytest.raises(OSError, match="disk full"):
        write_record(record(n_successes=0), path)
    assert path.read_bytes() == before
    # What is left of it is no record.
    assert find_records([tmp_path]) == [path]


def without(name):
    def damage(content):
        del content[name]

    return damage


def with_value(name, value, in_episode=True):
    def damage(content):
        (content["episodes"][0] if in_episode else content)[name] = value

    return damage


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (without("format"), "in format 1 to 2: its format is None.*deltaco-evaluate"),
        (without("trials"), r"lacks \['trials'\]"),
        (without("image_size"), r"lacks \['image_size'\]"),
        (with_value("format", 3, False), "its format is 3"),
        (with_value("format", True, False), "its format is True"),
        (with_value("more", 1), r"EpisodeResult lacks nothing, and has the unknown \['more'\]"),
        (with_value("counterfactual", "both", False), "one of none, demo, instruction. Got 'both'"),
        (with_value("step", "10", False), "`step` must be an integer. Got '10'"),
        (with_value("episodes", [], False), "has no episodes"),
        (with_value("episodes", [3], False), "expected the fields of EpisodeResult, got 3"),
        (with_value("versions", {}, False), "which version of the benchmark"),
        (with_value("success", 1), "`success` must be true or false. Got 1"),
        (with_value("objects", [0, None, 1]), "`objects` must be a list whose items are each an integer"),
        (with_value("demonstration", 4), "`demonstration` must be a string or None. Got 4"),
        (with_value("task_id", 300), r"`task_id` must be an integer from 0 to 299. Got 300"),
        (with_value("grasped_object", 3), r"`grasped_object` must be in -1..2"),
        (with_value("container_quadrants", [[0, 1]]), r"the shape \(2, 2\)"),
        (with_value("container_quadrants", [[0, 1], [0, 2]]), "must be in 0..1"),
        (with_value("object_containers", [0]), "a number for each of `objects`"),
    ],
)
def test_a_damaged_record_is_refused(tmp_path, damage, message):
    content = {"format": RECORD_FORMAT, **asdict(record())}
    damage(content)
    path = tmp_path / "evaluations/0010000.json"
    path.parent.mkdir()
    path.write_text(json.dumps(content))
    with pytest.raises(RecordError, match=message) as caught:
        read_record(path)
    assert str(path) in str(caught.value)


def test_a_record_of_the_first_format_says_what_was_so_then(tmp_path):
    content = asdict(record())
    for name in ("image_size", "episode_length", "objects", "adversarial_probability", "adversarial_draw"):
        del content[name]
    for result in content["episodes"]:
        del result["demonstration_episodes"], result["demonstrated_objects"]
    path = tmp_path / "0010000.json"
    path.write_text(json.dumps({"format": 1, **content}))
    unknown = [
        replace(item, demonstration_episodes=None, demonstrated_objects=None) for item in record().episodes
    ]
    assert read_record(path) == record(episodes=unknown, objects="all", adversarial_probability=0.6)
    assert (record().image_size, record().episode_length) == (48, 30)
    path.write_text(json.dumps({"format": 1, **content, "image_size": "48"}))
    with pytest.raises(RecordError, match="`image_size` must be an integer"):
        read_record(path)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("wording", "templates"),
        ("adversarial_draw", "each"),
        ("scene_set", None),
        ("weights", None),
        ("demonstrations", None),
        ("demonstrations_digest", None),
    ],
)
def test_the_first_records_of_the_second_format_say_what_was_so_then(tmp_path, name, value):
    content = {"format": RECORD_FORMAT, **asdict(record())}
    assert content.pop(name) == value
    path = tmp_path / "0010000.json"
    path.write_text(json.dumps(content))
    assert read_record(path) == record()


def test_a_record_keeps_the_draw_of_distractors(tmp_path):
    drawn_together = record(adversarial_draw="scene")
    path = tmp_path / "0010000.json"
    write_record(drawn_together, path)
    assert read_record(path) == drawn_together
    path.write_text(json.dumps({"format": RECORD_FORMAT, **asdict(drawn_together), "adversarial_draw": "x"}))
    with pytest.raises(RecordError, match="`adversarial_draw` must be one of each, scene. Got 'x'"):
        read_record(path)


@pytest.mark.parametrize("draw", ["each", "scene"])
def test_the_page_says_if_one_draw_decides_for_both_distractors(tmp_path, draw):
    write_report([write(tmp_path / "runs", record(adversarial_draw=draw))], tmp_path / "out")
    text = (tmp_path / "out/report.md").read_text()
    assert "at a probability of 0.6" in text
    assert ("decided by one draw for both of a scene" in text) == (draw == "scene")


@pytest.mark.parametrize("text", ['{"format": 2, "epis', "[]", ""])
def test_a_cut_off_record_is_refused(tmp_path, text):
    path = tmp_path / "0010000.json"
    path.write_text(text)
    with pytest.raises(RecordError, match=re.escape(str(path))):
        read_record(path)


# Novelty and intervals


@pytest.mark.parametrize(
    ("row", "target", "tasks", "expected"),
    [
        (24, 24, "scenario_a_test", "never_target"),
        (29, 29, "scenario_a_test", "unnamed_target"),
        (29, 29, "scenario_a_clean_test", "never_target"),
        (29, 29, "scenario_b_test", "training_task"),
        (32, 0, "scenario_a_test", "other_words"),
        (45, 26, "scenario_a_test", "never_target"),
        (45, 26, "scenario_b_test", "other_words"),
        (49, 29, "scenario_a_test", "unnamed_target"),
        (4, 4, "scenario_a_test", "training_task"),
        (10, 10, "scenario_a_test", "training_task"),
        (10, 10, "scenario_a_validation", "never_target"),
        (36, 10, "scenario_a_validation", "never_target"),
        (36, 8, "scenario_a_validation", "other_words"),
    ],
)
def test_novelty_is_what_training_asked_for_of_the_target(row, target, tasks, expected):
    result = episode(row)
    result = replace(result, objects=[target, *[index for index in (1, 2, 3) if index != target][:2]])
    assert novelty(result, scenario_of(tasks)) == expected


def test_all_trials_and_seeds_of_a_task_are_one_draw_of_the_bootstrap():
    once = mean_rate({1: 1.0, 2: 0.0, 3: 0.5, 4: 0.0})
    episodes = [
        episode(task_id, trial, success=trial < k)
        for task_id, k in ((24, 2), (32, 0), (45, 1))
        for trial in (0, 1)
    ]
    assert task_rates(episodes) == {24: 1.0, 32: 0.0, 45: 0.5}
    assert once.value == 0.375
    assert once.low < 0.375 < once.high
    # With 400 tasks of these, the interval is a tenth as wide.
    many = mean_rate({index: (1.0, 0.0, 0.5, 0.0)[index % 4] for index in range(400)})
    assert (many.high - many.low) == pytest.approx((once.high - once.low) / 10, rel=0.25)


def test_a_bootstrap_of_many_tasks_is_the_normal_interval():
    rates = dict(enumerate(np.random.default_rng(0).random(300)))
    estimate = mean_rate(rates)
    half = 1.96 * np.std(list(rates.values())) / np.sqrt(300)
    assert estimate.low == pytest.approx(estimate.value - half, abs=0.002)
    assert estimate.high == pytest.approx(estimate.value + half, abs=0.002)


def test_a_paired_difference_is_less_uncertain_than_its_parts():
    rng = np.random.default_rng(1)
    first = dict(enumerate(rng.random(100)))
    second = {task_id: rate - 0.1 for task_id, rate in first.items()}
    assert paired_difference(first, second) == pytest.approx((0.1, 0.1, 0.1))
    other = dict.fromkeys(range(50, 200), 0.0)
    shared = np.mean([first[task_id] for task_id in range(50, 100)])
    assert paired_difference(first, other).value == pytest.approx(shared)


# Records that belong together, and those that do not


def test_records_are_found_at_any_depth_and_only_once(runs):
    folder = runs / "scenario_a_deltaco_0"
    assert len(find_records([folder])) == 4
    link = runs.with_name("link")
    link.symlink_to(runs)
    assert len(find_records([runs, folder, folder / "evaluations", link])) == 14


def test_seeds_of_an_experiment_are_taken_together(runs):
    report = make_report(find_records([runs]))
    deltaco, one_hot = report.regular
    assert (deltaco.experiment, one_hot.experiment) == ("scenario_a/deltaco", "scenario_a/one_hot")
    assert deltaco.seeds == (0, 1)
    assert deltaco.steps == (10_000, 20_000, 30_000)
    assert deltaco.rates == pytest.approx(np.array([[1, 1], [2, 3], [4, 4]]) / 6)
    assert (deltaco.last.count, deltaco.last.total) == (8, 12)
    assert len(deltaco.last_episodes) == 12
    (counterfactual,) = report.counterfactual
    assert (counterfactual.last.count, counterfactual.last.total) == (4, 12)
    assert report.notes == []


def test_only_steps_that_all_seeds_have_count(tmp_path):
    run(tmp_path, "scenario_a/deltaco", 0, [1, 2, 3, 6])
    run(tmp_path, "scenario_a/deltaco", 1, [1, 4])
    run(tmp_path, "scenario_a/bc_z", 0, [1, 1, 1])
    report = make_report(find_records([tmp_path]))
    deltaco, bc_z = report.regular
    assert deltaco.steps == (10_000, 20_000)
    assert (deltaco.last.count, deltaco.last.total) == (6, 12)
    assert bc_z.steps == (10_000, 20_000, 30_000)
    missing, ends, scenes, uneven = report.notes
    assert "scenario_a/bc_z has no records of seed 1" in missing
    assert "scenario_a/deltaco 20,000, scenario_a/bc_z 30,000" in ends
    assert "different sets of scenes (numbers 20,000 and 30,000" in scenes
    assert "Left out of scenario_a/deltaco, seed 0: steps 30,000 and 40,000" in uneven


def test_checkpoints_of_different_steps_may_share_a_set_of_scenes(tmp_path):
    write(tmp_path, record(step=10), record("scenario_a/bc_z", step=20, scene_set=10))
    (ends,) = make_report(find_records([tmp_path])).notes
    assert "end at different steps" in ends


def test_an_experiment_without_a_common_step_is_left_out(tmp_path):
    write(tmp_path, record(seed=0, step=1), record(seed=1, step=2))
    with pytest.raises(ReportError, match="nothing to report"):
        make_report(find_records([tmp_path]))
    write(tmp_path, record("scenario_a/bc_z", step=1), record("scenario_a/bc_z", seed=1, step=1))
    report = make_report(find_records([tmp_path]))
    assert [series.experiment for series in report.regular] == ["scenario_a/bc_z"]
    assert any("scenario_a/deltaco is left out" in note for note in report.notes)


def test_configurations_that_differ_between_seeds_are_noted(tmp_path):
    policy = {**record().policy, "seed": 1, "backbone": "paper", "device": "cuda"}
    write(tmp_path, record(), record(seed=1, policy=policy))
    (note,) = make_report(find_records([tmp_path])).notes
    assert "differ in more than their seed: in backbone of" in note


def test_options_that_are_newer_than_a_record_were_as_they_are_by_default(tmp_path):
    newer = {**record().policy, "compile": False, "film": None, "demo_columns": 2}
    write(tmp_path, record(), record(seed=1, policy=newer))
    assert make_report(find_records([tmp_path])).notes == []
    write(tmp_path, record(seed=2, policy={**newer, "compile": True, "demo_episode": 0}))
    (note,) = make_report(find_records([tmp_path])).notes
    assert "differ in more than their seed: in compile, demo_episode of" in note


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"versions": {"benchmark": "gym_deltaco/PickPlace-v1"}}, "version of the benchmark: .*-v0.*-v1"),
        ({"evaluation_seed": 7}, "records of 'scenario_a' differ in their evaluation seed: 0 in .* 7 in"),
        ({"ambiguity": "object"}, "ambiguity scheme: 'container' .* 'object'"),
        ({"image_size": 64}, "image size: 48 .* 64"),
        ({"episode_length": 7}, "episode length: 30 .* 7"),
        ({"objects": "random:100"}, "objects: 'all' .* 'random:100'"),
        ({"adversarial_probability": 0.0}, "probability of adversarial distractors: 0.6 .* 0.0"),
        ({"adversarial_draw": "scene"}, "draw of adversarial distractors: 'each' .* 'scene'"),
        ({"trials": 2}, "trials: 1 in .* 2 in"),
        ({"tasks": "24", "episodes": [episode(24)]}, "tasks: '24,32,.*' in .* '24' in"),
    ],
)
def test_what_was_evaluated_differently_is_not_compared(tmp_path, changes, message):
    other = record("scenario_a/one_hot", trials=changes.get("trials", 1))
    write(tmp_path, record(), replace(other, **changes))
    with pytest.raises(ReportError, match=message) as caught:
        make_report(find_records([tmp_path]))
    assert "scenario_a_deltaco_0" in str(caught.value)
    assert "scenario_a_one_hot_0" in str(caught.value)


def test_other_comparisons_may_have_other_tasks_but_not_another_benchmark(tmp_path):
    write(tmp_path, record(), record("scenario_b/deltaco", trials=2, evaluation_seed=7))
    report = make_report(find_records([tmp_path]))
    assert list(report.comparisons) == ["scenario_a", "scenario_b"]
    write(tmp_path, record("ablations/r3m", versions={"benchmark": "another"}))
    with pytest.raises(ReportError, match="version of the benchmark"):
        make_report(find_records([tmp_path]))


def test_runs_of_an_experiment_have_one_method(tmp_path):
    write(tmp_path, record(), record(seed=1, method="bc_z"))
    with pytest.raises(ReportError, match="'scenario_a/deltaco' differ in their method: 'deltaco' .* 'bc_z'"):
        make_report(find_records([tmp_path]))


def test_two_runs_of_the_same_seed_are_refused(tmp_path):
    write(tmp_path / "first", record())
    write(tmp_path / "second", record())
    with pytest.raises(
        ReportError, match="with the seed 0: .*first.* and .*second.*Report on one of the two"
    ):
        make_report(find_records([tmp_path]))


@pytest.mark.parametrize("change", [lambda episodes: episodes[:-1] + episodes[:1], lambda e: [e[0], *e]])
def test_a_record_with_trials_twice_is_refused(tmp_path, change):
    item = record(trials=2)
    write(tmp_path, replace(item, episodes=change(item.episodes)))
    with pytest.raises(ReportError, match="not 2 different trials of each of its 6 tasks"):
        make_report(find_records([tmp_path]))


def test_many_numbers_are_told_by_their_ends():
    assert counted("seed", [3]) == "seed 3"
    assert counted("step", [10, 20, 3000]) == "steps 10, 20 and 3,000"
    assert counted("step", range(0, 8000, 1000)) == "8 steps from 0 to 7,000"


# The files


def test_the_files(runs, tmp_path, capsys):
    out = tmp_path / "new/report"
    report_command.main([str(runs), "--out", str(out)])
    assert "scenario_a/deltaco: 41.7 (2.8); 66.7 [33.3, 100.0] at step 30,000" in capsys.readouterr().out
    assert {path.name for path in out.iterdir()} == set(FILES)

    deltaco, one_hot = rows(out / "rates.csv")
    # Means 1/6, 2.5/6 and 4/6; SDs 0, .5/6 and 0.
    assert float(deltaco["rate"]) == pytest.approx(7.5 / 18, abs=1e-6)
    assert float(deltaco["sd"]) == pytest.approx(0.5 / 18, abs=1e-6)
    assert (deltaco["seeds"], deltaco["best_sets"], deltaco["last_step"]) == ("0 1", "3", "30000")
    assert (deltaco["last_count"], deltaco["last_episodes"]) == ("8", "12")
    assert float(deltaco["authors_rate_in_another_simulation"]) == 0.258
    assert float(one_hot["last_rate"]) == pytest.approx(1 / 6, abs=1e-6)

    points = rows(out / "curves.csv")
    assert len(points) == 14
    assert {point["counted"] for point in points} == {"True"}

    groups = rows(out / "breakdown.csv")
    assert len(groups) == 3 * 12 * 5
    assert sum(
        int(group["count"])
        for group in groups
        if (group["experiment"], group["counterfactual"]) == ("scenario_a/deltaco", "none")
        and group["outcome"] == "success"
        and group["kind_of_task"] != "all"
        and group["kind_of_container_word"] != "all"
    ) == int(deltaco["last_count"])

    assert len(rows(out / "counterfactual.csv")) == 2 * 6
    with Image.open(out / "curves.png") as image:
        assert image.format == "PNG"
        assert 1000 < image.width < 3000
        assert 400 < image.height < 3000
        assert len(image.convert("RGB").getcolors(1 << 24)) > 10


@pytest.mark.parametrize("n_curves", [1, 40])
def test_curves_are_not_squeezed_by_their_legend(n_curves):
    curves = [
        Curve(f"some/method_{number}", [1000, 2000], np.full((2, 1), number / 100))
        for number in range(n_curves)
    ]
    figure = curves_figure([("many", curves), ("few", curves[:1])])
    figure.draw_without_rendering()
    for ax in figure.axes:
        assert ax.get_window_extent().height / figure.dpi > 3
        legend = ax.get_legend()
        assert legend.get_window_extent().y0 >= 0
        assert legend.get_window_extent().height <= ax.get_window_extent().height
    names = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert names[0].startswith(f"method {n_curves - 1} ")  # the best first


def test_the_text(runs, tmp_path):
    write(runs, record("scenario_b/deltaco"))
    write_report([runs], tmp_path)
    text = (tmp_path / "report.md").read_text()
    assert "| DeL-TaCo | 0, 1 | 41.7 (2.8) | 3 of 3 sets | 66.7 [33.3, 100.0] | 30,000 | 25.8 (3.4) |" in text
    assert "authors, another simulation" in text
    assert ENV_ID in text
    assert "`method=one_hot`, `language_encoder=all-MiniLM-L6-v2`" in text
    assert "- Seeds 0 and 1; 6 records; 4 min of evaluation." in text
    assert "- Seed 0; 1 record; 1 min of evaluation." in text
    assert "    deltaco-evaluate --run scenario_a/deltaco_1\n" in text
    assert "Nothing." in text
    # Every table is whole.
    for table in re.findall(r"(?:^\|.*\|\n)+", text, re.MULTILINE):
        assert len({line.count("|") for line in table.splitlines()}) == 1
    assert set(re.findall(r"!\[.+\]\((.+)\)", text)) == {"curves.png", "beside_paper.png"}


def test_the_text_says_what_differs_from_the_papers_architecture(tmp_path):
    paper = {"backbone": "paper", "demo_encoder": "cnn", "optimizer_lr": 3e-4, "seed": 0}
    write(tmp_path / "paper", record(policy=paper))
    write_report([tmp_path / "paper"], tmp_path / "out")
    assert "Not the paper's architecture" not in (tmp_path / "out/report.md").read_text()
    ours = {**paper, "demo_encoder": "attention", "motion_modes": 5}
    write(tmp_path / "ours", record("small_a/deltaco", policy=ours))
    write_report([tmp_path / "ours"], tmp_path / "out")
    text = (tmp_path / "out/report.md").read_text()
    assert "`demo_encoder=attention` (paper: `cnn`), `motion_modes=5` (paper: `1`)." in text
    assert "`backbone" not in text.split("## Learning curves")[0]


def test_the_papers_architecture_is_that_of_the_policy_by_default():
    """What the paper does not say is not among these options, such as the precision."""
    policy = DeltacoConfig()
    assert {name: getattr(policy, name) for name in PAPER_OPTIONS} == dict(PAPER_OPTIONS)


def test_success_is_reported_by_novelty_and_object_and_as_differences(runs, tmp_path):
    write_report([runs], tmp_path)
    deltaco = [row for row in rows(tmp_path / "novelty.csv") if row["experiment"] == "scenario_a/deltaco"]
    # The targets are the objects 24, 0 (black and white) and 0 (a cup), in two containers each.
    assert [(row["novelty"], row["count"], row["episodes"]) for row in deltaco] == [
        ("other_words", "4", "8"),
        ("never_target", "4", "4"),
    ]
    objects = {
        row["object"]: (row["name"], row["count"], row["episodes"])
        for row in rows(tmp_path / "objects.csv")
        if (row["experiment"], row["outcome"]) == ("scenario_a/deltaco", "success")
    }
    assert objects == {"0": ("conic cup", "4", "8"), "24": ("bathtub", "4", "4")}
    (difference,) = rows(tmp_path / "differences.csv")
    assert (difference["experiment"], difference["less"]) == ("scenario_a/one_hot", "scenario_a/deltaco")
    # One task of six succeeds in one less four of six.
    assert float(difference["difference"]) == pytest.approx(-0.5, abs=1e-6)
    assert float(difference["bootstrap_low"]) == pytest.approx(-5 / 6, abs=1e-6)
    assert float(difference["bootstrap_high"]) == pytest.approx(-1 / 6, abs=1e-6)


def test_one_seed_and_one_step(tmp_path):
    write(tmp_path / "runs", record())
    write_report([tmp_path / "runs"], tmp_path / "out")
    assert "| DeL-TaCo | 0 | 50.0 (–) | 1 of 1 sets |" in (tmp_path / "out/report.md").read_text()
    (row,) = rows(tmp_path / "out/rates.csv")
    assert (row["rate"], row["sd"]) == ("0.5", "")


def test_a_new_report_replaces_the_old_one(runs, tmp_path):
    write_report([runs], tmp_path / "out")
    (tmp_path / "out/mine.txt").touch()
    write_report([runs / "scenario_a_one_hot_0"], tmp_path / "out", authors_levels=True)
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {*FILES, "mine.txt"} - {"counterfactual.csv", "differences.csv"}
    for path in runs.rglob("evaluations/00?0000.json"):
        path.unlink()
    write_report([runs / "scenario_a_deltaco_0"], tmp_path / "out")
    names = {path.name for path in (tmp_path / "out").iterdir()}
    regular = {"rates.csv", "curves.png", "beside_paper.png", "differences.csv", "novelty.csv", "objects.csv"}
    assert names == {*FILES, "mine.txt"} - regular


def test_a_report_is_written_wholly_or_not_at_all(runs, tmp_path, monkeypatch):
    out = tmp_path / "out"
    write_report([runs], out)
    before = {path: path.read_bytes() for path in out.iterdir()}
    write(runs, record("scenario_a/mcil"))

    def fails(*_):
        raise OSError("disk full")

    monkeypatch.setattr("pathlib.Path.write_bytes", fails)
    with pytest.raises(OSError, match="disk full"):
        write_report([runs], out)
    assert {path: path.read_bytes() for path in out.iterdir()} == before


def test_a_large_report_keeps_no_episodes(runs):
    for item in make_report(find_records([runs])).regular[0].sets:
        assert item.record.episodes == []
        assert item.task_ids == TASK_IDS


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("empty", r"empty has no records of evaluations \(evaluations/\*\.json.*deltaco-evaluate"),
        ("missing", "missing is no folder"),
    ],
)
def test_the_command_says_what_is_wrong(tmp_path, name, message, capsys):
    (tmp_path / "empty").mkdir()
    with pytest.raises(SystemExit, match="1"):
        report_command.main([str(tmp_path / name), "--out", str(tmp_path / "out")])
    errors = capsys.readouterr().err
    assert re.search(message, errors)
    assert errors.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_the_reports_folder_may_not_be_a_file(runs, tmp_path, capsys):
    (tmp_path / "out").touch()
    with pytest.raises(SystemExit, match="2"):
        report_command.main([str(runs), "--out", str(tmp_path / "out")])
    assert re.search("--out must be a folder. .*/out is a file", capsys.readouterr().err)


def test_the_command_refuses_a_damaged_record(runs, tmp_path, capsys):
    path = next(runs.rglob("*.json"))
    path.write_text(path.read_text()[:-100])
    with pytest.raises(SystemExit, match="1"):
        report_command.main([str(runs), "--out", str(tmp_path / "out")])
    assert f"deltaco-report: {path} is not a record" in capsys.readouterr().err


def test_the_command_starts_without_heavy_imports():
    program = f"import sys; import {report_command.__name__}; print([*sys.modules])"
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    heavy = {"torch", "lerobot", "matplotlib", "pybullet", "pandas"}
    assert heavy.isdisjoint(re.findall(r"'(\w+)'", result.stdout))
