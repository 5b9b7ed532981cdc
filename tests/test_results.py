"""The committed reports are what the committed records give, and what they compare was measured alike."""

import shutil
from collections import defaultdict
from dataclasses import fields
from pathlib import Path

import pytest
import yaml

from lerobot_deltaco.configuration_deltaco import DeltacoConfig
from lerobot_deltaco.evaluation.record import read_record
from lerobot_deltaco.experiments.config import SHARED, experiment_names, read_experiment
from lerobot_deltaco.reporting.leaderboard import (
    AMBIGUITY,
    PAGE,
    ROWS_FILE,
    LeaderboardError,
    read_rows,
    table,
    updated,
)
from lerobot_deltaco.reporting.page_tables import PageTableError, replaced
from lerobot_deltaco.reporting.paper_results import PAPER_RESULTS, small_scale_experiment
from lerobot_deltaco.reporting.paper_table import NOT_RUN, PAPER_PAGE, paper_tables, updated_paper_page
from lerobot_deltaco.reporting.report import write_report
from lerobot_deltaco.reporting.series import find_records

ROOT = Path(__file__).parents[1]
EXPERIMENTS = ROOT / "experiments"
RECORDS = sorted(ROOT.glob("results/*/records"))
# What an experiment is about, besides the options that its own file sets. All else is the recipe, which those
# that are compared share.
SUBJECT = {"method", "film", "concat", "encoder_loss", "language_encoder", "demo_feature_dim", "seed"}
# Options whose default follows from another option.
FOLLOWING = {"gripper_loss": "gripper_weight", "backbone": "initial_weights"}


def test_there_are_results():
    assert RECORDS


@pytest.mark.parametrize("records", RECORDS, ids=lambda path: path.parent.name)
def test_the_committed_report_is_what_the_records_give(records, tmp_path):
    write_report([records], tmp_path)
    committed = records.parent
    for path in sorted(tmp_path.iterdir()):
        # Pixels differ from one version of Matplotlib to another.
        if path.suffix != ".png":
            assert (committed / path.name).read_text() == path.read_text(), path.name
        else:
            assert (committed / path.name).is_file()


def own_options(experiment):
    """The options that an experiment's own file sets: what it is about."""
    path = EXPERIMENTS / f"{experiment}.yaml"
    content = yaml.safe_load(path.read_text()) if path.is_file() else {}
    start = {"pretrained_path"} if "start_from" in content else set()
    own = set(content.get("policy", {}))
    return start | own | {FOLLOWING[name] for name in own & FOLLOWING.keys()}


def with_defaults(policy):
    """Options of a policy, with the defaults of those that are newer than its record."""
    config = DeltacoConfig(device="cpu", backbone=policy["backbone"])
    return {field.name: policy.get(field.name, getattr(config, field.name)) for field in fields(config)}


@pytest.mark.parametrize("records", RECORDS, ids=lambda path: path.parent.name)
def test_records_that_are_compared_are_of_one_recipe(records):
    recipes = defaultdict(list)
    for path in find_records([records]):
        record = read_record(path)
        # Policies of other types share no recipe.
        recipe = {} if "type" in record.policy else with_defaults(record.policy)
        if record.experiment in str(recipe.get("pretrained_path")):
            del recipe["pretrained_path"]  # a training that was resumed, from its own checkpoint
        about = SUBJECT | own_options(record.experiment)
        versions = {name: version for name, version in record.versions.items() if name != "language_encoder"}
        recipes[record.experiment.rpartition("/")[0]].append((recipe, about, versions))
    assert recipes
    for compared in recipes.values():
        reference, _, versions = compared[0]
        for recipe, about, others in compared:
            assert others == versions
            differing = {name for name in recipe.keys() & reference.keys() if recipe[name] != reference[name]}
            assert differing <= about | compared[0][1]


@pytest.mark.parametrize("name", experiment_names(EXPERIMENTS))
def test_an_experiment_that_departs_from_the_shared_recipe_says_why(name):
    path = EXPERIMENTS / f"{name}.yaml"
    text = path.read_text()
    own = yaml.safe_load(text)
    departures = {
        (section, key) for section, values in own.items() if isinstance(values, dict) for key in values
    }
    departures -= {("policy", key) for key in SUBJECT}
    if departures or "start_from" in own:
        assert text.startswith("# "), f"{name} has {departures} of its own, and no comment that says why"


def test_experiments_that_are_compared_are_evaluated_alike():
    evaluations = defaultdict(dict)
    for name in experiment_names(EXPERIMENTS):
        assert (EXPERIMENTS / name).with_name(SHARED).is_file()
        config = read_experiment(EXPERIMENTS, name)
        # Reports do not compare images of different sizes.
        demonstrations = {key: value for key, value in config.demonstrations.items() if key != "image_size"}
        evaluations[name.rpartition("/")[0]][name] = (config.evaluation, demonstrations)
    for folder, configs in evaluations.items():
        values = list(configs.values())
        assert all(value == values[0] for value in values), folder


# The tables of the pages


def test_the_papers_tables_are_what_the_records_give():
    page = (ROOT / PAPER_PAGE).read_text()
    assert updated_paper_page(page, ROOT) == page, "Write it anew: python scripts/update_docs.py"


def test_the_papers_tables_have_each_row_once():
    tables = paper_tables(ROOT)
    for name, result in PAPER_RESULTS.items():
        row = f"| {result.label} | {100 * result.rate:.1f} ("
        labels = [other.label for other in PAPER_RESULTS.values()]
        assert tables.count(row) >= 1, name
        assert tables.count(f"\n| {result.label} |") == labels.count(result.label)


def test_what_was_measured_of_the_papers_rows_is_shown():
    measured = [
        name
        for name in PAPER_RESULTS
        if (ROOT / "results" / small_scale_experiment(name).replace("/", "/records/")).is_dir()
    ]
    assert len(measured) >= 10
    lines = [line for line in paper_tables(ROOT).splitlines() if line.count("|") > 2]
    assert sum(NOT_RUN in line for line in lines) == len(PAPER_RESULTS) - len(measured)


def test_a_page_without_a_place_for_the_table_is_rejected():
    with pytest.raises(PageTableError, match="needs the lines 'BEGIN' and 'END'"):
        replaced("no place", "BEGIN", "END", "| a |")


# The leaderboard


def test_the_leaderboard_is_what_the_records_give():
    page = (ROOT / PAGE).read_text()
    assert updated(page, ROOT) == page, "Write it anew: python scripts/update_docs.py"


def is_method(record):
    """Whether an experiment is a method of its own: no ablation, on the benchmark's sentences and objects."""
    comparison, _, name = record.experiment.rpartition("/")
    is_ablation = (EXPERIMENTS / "ablations" / f"{name}.yaml").is_file()
    return not (is_ablation or "_paraphrases" in name or comparison == "small_objects")


def test_the_leaderboard_has_all_methods_that_were_run():
    tasks, rows = read_rows(ROOT / ROWS_FILE)
    listed = {ROOT / "results" / row.records for row in rows if row.records is not None}
    experiments = [path for records in RECORDS for path in records.iterdir()]
    examples = {path: read_record(find_records([path])[0]) for path in experiments}
    run = {
        path
        for path, record in examples.items()
        if (record.tasks, record.ambiguity) == (tasks, AMBIGUITY) and is_method(record)
    }
    assert run
    assert run <= listed  # which may have further evaluations of them
    assert all(path.is_dir() for path in listed)


def test_what_was_not_run_says_so_and_comes_last():
    lines = table(ROOT).splitlines()[2:]
    not_run = ["| not run |" in line for line in lines]
    assert not_run == sorted(not_run)
    assert any("| ACT |" in line for line in lines)


ROW = "method: a\n    given: nothing\n    command: b"


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("method: a", "rows.*given"),
        (f"{ROW}\n    color: red", "color"),
        (f"{ROW}\n    records: 3", "`records` of 'a' must be a string or None. Got 3"),
        (f"{ROW}\n    records: small_a/records/oracle", "it also needs `training` and `commit`"),
    ],
)
def test_a_wrong_row_is_explained(tmp_path, rows, message):
    file = tmp_path / "rows.yaml"
    file.write_text(f"tasks: scenario_a_test\nrows:\n  - {rows}\n")
    with pytest.raises(LeaderboardError, match=message):
        read_rows(file)


def test_records_of_other_tasks_are_no_row(tmp_path):
    copy = tmp_path / "results" / "small_a"
    shutil.copytree(ROOT / "results/small_a/records/one_hot/seed_0", copy / "records/one_hot/seed_0")
    rest = "    training: t\n    commit: c\n    records: small_a/records/one_hot\n"
    (tmp_path / ROWS_FILE).write_text(f"tasks: all\nrows:\n  - {ROW}\n{rest}")
    with pytest.raises(
        LeaderboardError, match="are of the tasks 'scenario_a_test'. The leaderboard is of 'all'"
    ):
        table(tmp_path)
    (record,) = copy.rglob("0024000.json")
    record.write_text(record.read_text().replace('"ambiguity": "container"', '"ambiguity": "object"'))
    (tmp_path / ROWS_FILE).write_text(f"tasks: scenario_a_test\nrows:\n  - {ROW}\n{rest}")
    for other in set(copy.rglob("*.json")) - {record}:
        other.unlink()
    with pytest.raises(LeaderboardError, match="are of the ambiguity scheme 'object'"):
        table(tmp_path)
