"""The committed reports are what the committed records give, and what they compare was measured alike."""

import json
from collections import defaultdict
from pathlib import Path

import pytest
import yaml

from lerobot_deltaco.evaluation.record import read_record
from lerobot_deltaco.experiments.config import SHARED, experiment_names, read_experiment
from lerobot_deltaco.reporting.report import write_report
from lerobot_deltaco.reporting.series import find_records

ROOT = Path(__file__).parents[1]
EXPERIMENTS = ROOT / "experiments"
RECORDS = sorted(ROOT.glob("results/*/records"))
# What an experiment is about. All else is the recipe, which those that are compared share.
SUBJECT = {"method", "film", "concat", "encoder_loss", "language_encoder", "seed"}


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


@pytest.mark.parametrize("records", RECORDS, ids=lambda path: path.parent.name)
def test_records_that_are_compared_are_of_one_recipe(records):
    recipes = defaultdict(set)
    for path in find_records([records]):
        record = read_record(path)
        recipe = {name: value for name, value in record.policy.items() if name not in SUBJECT}
        shared = json.dumps([recipe, record.versions], sort_keys=True)
        recipes[record.experiment.rpartition("/")[0]].add(shared)
    assert recipes
    assert all(len(different) == 1 for different in recipes.values())


@pytest.mark.parametrize("name", experiment_names(EXPERIMENTS))
def test_an_experiment_that_departs_from_the_shared_recipe_says_why(name):
    path = EXPERIMENTS / f"{name}.yaml"
    text = path.read_text()
    own = yaml.safe_load(text)
    departures = {
        (section, key) for section, values in own.items() if section != "start_from" for key in values
    }
    departures -= {("policy", key) for key in SUBJECT}
    if departures or "start_from" in own:
        assert text.startswith("# "), f"{name} has {departures} of its own, and no comment that says why"


def test_experiments_that_are_compared_are_evaluated_alike():
    evaluations = defaultdict(dict)
    for name in experiment_names(EXPERIMENTS):
        assert (EXPERIMENTS / name).with_name(SHARED).is_file()
        config = read_experiment(EXPERIMENTS, name)
        evaluations[name.rpartition("/")[0]][name] = (config.evaluation, config.demonstrations)
    for folder, configs in evaluations.items():
        values = list(configs.values())
        assert all(value == values[0] for value in values), folder
