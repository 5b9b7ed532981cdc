"""What the policy tells of what it has found: in the log, as boxes, and in pictures."""

import logging
import re

import numpy as np
import pytest
import torch
from PIL import Image
from small_policies import (
    TABLE_SIZE,
    TABLE_TASKS,
    batch_of,
    random_moves,
    small_policy,
)

from lerobot_deltaco.data.object_prompts import ObjectPrompt
from lerobot_deltaco.lerobot_versions import action_of
from lerobot_deltaco.policies.deltaco_match import modeling_deltaco_match

MOVES = random_moves(48)  # of `table`

pytestmark = pytest.mark.usefixtures("short_fit")


@pytest.fixture(scope="module")
def trained(table):
    """A policy, and the first image of an episode."""
    from small_policies import use_short_fit

    with pytest.MonkeyPatch.context() as patch:
        use_short_fit(patch)
        policy, before, _ = small_policy(table, "deltaco_match")
    batch = batch_of(table, [0])
    seen = {name: value for name, value in batch.items() if name.startswith("observation.")}
    return policy.eval(), before({**seen, "task": [TABLE_TASKS[0]]})


def act(policy, seen, shown):
    policy.reset()
    policy.set_tasks([TABLE_TASKS[0]], [[shown]])
    return policy.select_action(seen)


def test_the_log_says_what_was_found(trained, caplog):
    policy, seen = trained
    demonstration = policy.training_data.demonstrations[2]
    with caplog.at_level(logging.INFO):
        act(policy, seen, demonstration)
    text = caplog.text
    for part in (
        f"{TABLE_SIZE} x {TABLE_SIZE} px",
        r"object: at \(\d+, \d+\) px, \d+% sure, by the demonstration",
        r"place: at \(\d+, \d+\) px, \d+% sure, by the sentence",  # of a trained task
        "acting: replays the demonstration",
        r"camera: not compared with the training's",  # a plain table tells nothing
        r"states to image: off by \d+\.\d% of its side",
    ):
        assert re.search(part, text), part
    # The grasp of episode 2, by the map from states to the image
    x, y = re.search(r"demonstration: episode 2, which grasped at \((\d+), (\d+)\) px", text).groups()
    expected = (np.array(MOVES[2][1]) + 1) / 2 * TABLE_SIZE
    assert np.abs(np.array([int(x), int(y)]) - expected).max() < 3


def test_it_is_told_once_an_episode_and_not_for_batches(trained, caplog):
    policy, seen = trained
    demonstration = policy.training_data.demonstrations[2]
    with caplog.at_level(logging.INFO):
        act(policy, seen, demonstration)
        policy.select_action(seen)
        assert caplog.text.count("Found in the first image") == 1
        policy.reset()
        policy.set_tasks([TABLE_TASKS[0]] * 2, [[demonstration]] * 2)
        doubled = {name: torch.cat([value] * 2) for name, value in seen.items() if name.startswith("obs")}
        policy.select_action(doubled)
        assert caplog.text.count("Found in the first image") == 1


def test_a_picture_is_drawn_of_each_episode(trained, tmp_path, monkeypatch):
    policy, seen = trained
    monkeypatch.setattr(policy.config, "picture_folder", str(tmp_path / "pictures"))
    for shown in (policy.training_data.demonstrations[2], ObjectPrompt((0.5, 0.5, 0.5, 0.5))):
        act(policy, seen, shown)
    pictures = sorted((tmp_path / "pictures").iterdir())
    assert len(pictures) == 2
    for path in pictures:
        with Image.open(path) as picture:
            assert min(picture.size) >= 320


def test_boxes_are_around_pick_and_place(trained, monkeypatch):
    policy, seen = trained
    point = ObjectPrompt((*((MOVES[0][1] + 1) / 2).tolist(),) * 2)
    expected = act(policy, seen, point)
    assert action_of(expected) is expected  # LeRobot before 0.7
    monkeypatch.setattr(modeling_deltaco_match, "PREDICTION", "prediction")
    output = act(policy, seen, point)
    assert torch.equal(action_of(output), expected)
    ((camera, (found,)),) = output["prediction"]["boxes"].items()
    assert camera == policy.config.cameras[0]
    labels, boxes = zip(*(each.values() for each in found["detections"]), strict=True)
    assert labels[0] == "pick 100%"
    assert re.fullmatch(r"place \d+%", labels[1])
    for (left, top, right, bottom), location in zip(
        boxes, policy.localization.locations[0].tolist(), strict=True
    ):
        x, y = ((coordinate + 1) / 2 for coordinate in location)
        assert 0 <= left <= x <= right <= 1
        assert 0 <= top <= y <= bottom <= 1
        assert 0.02 < right - left < 0.5
