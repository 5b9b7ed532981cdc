"""What relies on LeRobot's internals finds them here, and says so where another version lacks them."""

import inspect
import logging
from pathlib import Path

import pytest
from lerobot.scripts import lerobot_eval, lerobot_train
from lerobot.utils import import_utils

from lerobot_deltaco import lerobot_internals
from lerobot_deltaco.configuration_deltaco import DeltacoConfig
from lerobot_deltaco.lerobot_internals import (
    LOOP_FUNCTIONS,
    UnsupportedLeRobotError,
    dataset_option,
    replaced_in_training_loop,
    shorten_logs,
    step_of_videos,
    training_loop,
)
from lerobot_deltaco.modeling_deltaco import DeltacoPolicy


def test_the_installed_training_loop_is_supported():
    assert training_loop() is lerobot_train


def test_functions_are_replaced_while_the_context_is_open():
    before = {name: getattr(lerobot_train, name) for name in LOOP_FUNCTIONS}
    with replaced_in_training_loop({"cycle": list}):
        assert lerobot_train.cycle is list
        assert lerobot_train.make_policy is before["make_policy"]
    assert {name: getattr(lerobot_train, name) for name in LOOP_FUNCTIONS} == before


def test_a_loop_that_calls_other_functions_is_refused(monkeypatch):
    """As in LeRobot after 0.6.1, where another function makes the sampler and the batches."""

    def train(config):
        lerobot_train.make_train_eval_datasets(config), lerobot_train.make_policy(config)
        with lerobot_train._make_eval_envs(config) as envs:
            lerobot_train.eval_policy_all(envs)

    monkeypatch.setattr(lerobot_train, "train", train)
    message = r"supports lerobot>=0.6.1,<0.6.2.*not call EpisodeAwareSampler, cycle.*`lerobot-train`"
    with pytest.raises(UnsupportedLeRobotError, match=message):
        training_loop()
    with pytest.raises(UnsupportedLeRobotError, match=message), replaced_in_training_loop({"cycle": list}):
        pytest.fail("The loop was not checked.")


def test_the_supported_versions_are_those_that_are_required():
    pyproject = (Path(__file__).parents[1] / "pyproject.toml").read_text()
    assert f"lerobot[training,evaluation]{lerobot_internals.SUPPORTED_LEROBOT}" in pyproject


def test_the_step_of_an_evaluation_is_read_from_its_folder():
    assert step_of_videos(Path("run/eval/videos_step_002000")) == 2000
    with pytest.raises(UnsupportedLeRobotError, match="videos_step_STEP. Got 'final'"):
        step_of_videos(Path("run/eval/final"))


def test_the_annotation_of_the_configuration_is_a_class():
    """LeRobot's own tests of policies ask `issubclass` of it."""
    annotation = inspect.signature(DeltacoPolicy.__init__).parameters["config"].annotation
    assert annotation is DeltacoConfig


def test_logs_have_neither_pages_of_library_errors_nor_of_video_paths(monkeypatch, caplog):
    def not_found(name):
        raise OSError("\n".join(["libavutil.so.60: cannot open shared object file"] * 100))

    shorten_logs()
    monkeypatch.setattr(lerobot_internals._SHORT_MESSAGES, "_has_said_no_torchcodec", False)
    monkeypatch.setattr(import_utils.importlib, "import_module", not_found)
    monkeypatch.setattr(import_utils.importlib.util, "find_spec", lambda name: object())
    with caplog.at_level(logging.INFO):
        assert [import_utils.get_safe_default_video_backend() for _ in range(3)] == ["pyav"] * 3
        lerobot_eval.logger.info({"pc_success": 50.0, "video_paths": ["a.mp4"]})
        lerobot_eval.logger.info({"name": {"pc_success": 50.0, "predicted_video_paths": []}})
    decoder, *results = [record.getMessage() for record in caplog.records]
    assert decoder == "Videos are decoded by PyAV, since torchcodec finds no FFmpeg that it supports."
    assert results == ["{'pc_success': 50.0}", "{'name': {'pc_success': 50.0}}"]


@pytest.mark.parametrize(
    ("text", "value"), [(".1", 0.1), ("0.25", 0.25), ("[0,1,]", [0, 1]), ("[3]", [3]), ("null", None)]
)
def test_options_of_the_dataset_are_read_as_lerobot_does(monkeypatch, tmp_path, text, value):
    (tmp_path / "config.yaml").write_text(f"dataset:\n  option: {text}\n")
    (tmp_path / "train_config.json").write_text(f'{{"dataset": {{"option": {text.replace(",]", "]")}}}}}')
    for argument in (
        f"--dataset.option={text}",
        f"--config_path={tmp_path / 'config.yaml'}",
        f"--config_path={tmp_path}",
    ):
        monkeypatch.setattr("sys.argv", ["lerobot-train", argument])
        assert dataset_option("option") == value
        assert dataset_option("another") is None


def test_a_configuration_on_the_hub_says_that_it_cannot_be_read(monkeypatch, tmp_path):
    monkeypatch.setattr("sys.argv", ["lerobot-train", "--config_path=user/policy"])
    with pytest.raises(ValueError, match="--config_path is user/policy.*Download it"):
        dataset_option("episodes")
