"""Settings of scenes: defaults, errors, and tasks that the objects allow."""

import dataclasses

import pytest

from gym_deltaco.scene_config import DEFAULT_SCENE, SceneConfig


def test_equal_settings_are_equal_and_immutable():
    assert SceneConfig(objects="random:100") == SceneConfig(objects="random:100") != DEFAULT_SCENE
    assert len({SceneConfig(), DEFAULT_SCENE, SceneConfig(episode_length=30)}) == 1
    assert [SceneConfig(control=control).n_steps for control in ("position", "joints")] == [30, 240]
    with pytest.raises(dataclasses.FrozenInstanceError):
        DEFAULT_SCENE.image_size = 96


def test_invalid_setting_is_an_error_that_says_what_is_valid():
    for name, values, message in [
        ("ambiguity", ["both", None], r"`ambiguity` must be one of container, object\. Got "),
        ("objects", ["some", "random:9", ["all"], None], r"`objects` must be .*random:N"),
        ("adversarial_probability", [1.1, -0.1, float("nan"), True * 2], "must be between 0 and 1"),
        ("adversarial_draw", ["both", None], r"must be one of each, scene\. Got "),
        ("control", ["torque", None], r"must be one of position, joints\. Got "),
        ("image_size", [7, 4097, 48.0, "48", True], r"must be an integer from 8 to 4096\. Got "),
        ("episode_length", [0, 10**6, 30.0], r"must be an integer from 1 to 100000\. Got "),
    ]:
        for value in values:
            with pytest.raises(ValueError, match=message):
                SceneConfig(**{name: value})


def test_tasks_must_fit_an_object():
    DEFAULT_SCENE.check_tasks(range(300))
    SceneConfig(objects="random:400").check_tasks([4, 1005])
    with pytest.raises(ValueError, match="Task 39 asks for a yellow colored object, of which the objects"):
        SceneConfig(objects="scenario_a_train").check_tasks([4, 39])
    with pytest.raises(ValueError, match=r"integer from 0 to 299.* Got 300"):
        DEFAULT_SCENE.check_tasks([300])
