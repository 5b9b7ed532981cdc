"""`deltaco check`: its report agrees with the training."""

import base64
import io
import re
import shutil
import sys
from itertools import islice
from pathlib import Path

import pandas as pd
import pytest
import torch
from PIL import Image
from small_policies import (
    COLORS,
    EPISODES,
    TABLE_TASKS,
    batch_of,
    random_moves,
    small_policy,
    write_dataset,
    write_table,
)

from gym_deltaco.env import PickPlaceEnv
from gym_deltaco.expert import expert_episode
from gym_deltaco.scene_config import SceneConfig
from lerobot_deltaco import cli
from lerobot_deltaco.pages.arguments import CheckArguments, PolicyOptions
from lerobot_deltaco.pages.check import _staying_edges, check


def checked(root, out, **options):
    """The report, and the page; a report of a refusal is that of the error."""
    try:
        policy = PolicyOptions(**{"image_size": 24, **options})
        report = check(CheckArguments(str(root), policy, batch_size=4, steps=100, out=out))
    except ValueError as error:
        report = str(error)
    return report, (out / "index.html").read_text()


def test_a_good_dataset_is_reported_as_it_is_trained_on(table, tmp_path, short_fit):
    report, page = checked(table.root, tmp_path)
    assert "Training would refuse" not in report
    assert "demo camera:    observation.image stands still" in report
    assert "dimension 2 of the action (gripper); low values close it" in report
    assert "its state:      nothing in the state, since none is named like the gripper" in report
    assert "in 48 of 48 episodes" in report
    assert all(f"24 episodes, 24 with a grasp: {task}" in report for task in TABLE_TASKS)
    assert "for 100 steps of 4" in report
    assert re.search(
        r"finding: +object found in \d of 6 held-out episodes \(\d+ to \d+ %\): .*enough", report
    )
    # The training's own warning, of a joint that never moves.
    assert report.count("warning:") == report.count("of the robot's state hardly move") == 1
    pictures = [
        Image.open(io.BytesIO(base64.b64decode(content)))
        for content in re.findall('data:image/jpeg;base64,([^"]*)', page)
    ]
    assert len(pictures) == 5 * 48
    assert "would refuse" not in page
    # The crop, the last one of each episode, has the task's object in its middle.
    middle = [picture.getpixel((picture.width // 2, picture.height // 2)) for picture in pictures[4::5]]
    assert all((red > blue) == (n % 2 == 0) for n, (red, _, blue) in enumerate(middle))


def test_the_direction_of_the_gripper_is_the_one_given(table, tmp_path):
    root = Path(shutil.copytree(table.root, tmp_path / "data"))
    info = root / "meta" / "info.json"
    info.write_text(info.read_text().replace('"b"', '"gripper_b"', 1))
    report, _ = checked(root, tmp_path, gripper_closed="high")
    assert "high values close it" in report
    assert "dimension 1 (gripper_b) of the state, by name; the rest is the arm's" in report
    assert "`gripper_b` is named like the gripper, but does not follow its commands" in report
    assert "in 0 of 48 episodes" in report
    assert report.count("left out:       episode") == 48
    assert "Set --policy.gripper_closed=low" in report


@pytest.mark.parametrize("n_episodes", [3, 24])
def test_a_refusal_is_the_error_of_the_training(n_episodes, tmp_path, monkeypatch, short_fit):
    # The second dataset has enough episodes, but each is of another task.
    tasks = [f"move the red object {'x' * n}left" for n in range(n_episodes)]
    for task in tasks:
        monkeypatch.setitem(COLORS, task, COLORS[TABLE_TASKS[0]])
    moves = [(task, *move[1:]) for task, move in zip(tasks, random_moves(n_episodes), strict=True)]
    dataset = write_table(tmp_path / "data", moves)
    report, page = checked(dataset.root, tmp_path / "out")
    policy, before, _ = small_policy(dataset, "deltaco_match")
    with pytest.raises(ValueError, match="episodes") as error:
        policy(before(batch_of(dataset, [0])))
    assert report.startswith(f"Training would refuse this dataset. {error.value}\n")
    assert "would refuse" in page


def test_an_undecodable_image_is_named_and_the_episode_can_be_left_out(table, tmp_path, short_fit):
    root = Path(shutil.copytree(table.root, tmp_path / "data"))
    (path,) = root.glob("data/*/*.parquet")
    frames = pd.read_parquet(path)
    (row,) = frames.index[(frames["episode_index"] == 3) & (frames["frame_index"] == 2)]
    images = list(frames["observation.image"])
    images[row] = {**images[row], "bytes": images[row]["bytes"][:40]}
    frames.assign(**{"observation.image": images}).to_parquet(path)
    # Training decodes all frames, so it would meet the one in the middle of the episode.
    report, page = checked(root, tmp_path / "out")
    assert re.match("Training would refuse this dataset. The image .* in frame 2 of episode 3 ", report)
    assert page.count("data:image/jpeg;base64") >= 4 * 47
    rest = [n for n in range(48) if n != 3]
    report = check(
        CheckArguments(
            str(root), PolicyOptions(image_size=24), out=tmp_path / "out", dataset_episodes=str(rest)
        )
    )
    assert "in 47 of 47 episodes" in report
    with pytest.raises(ValueError, match=r"lists of whole numbers, such as \[10,20\]. Got '3 4'"):
        CheckArguments(str(root), dataset_episodes="3 4")


def test_what_does_not_fit_is_shown_without_a_policy(tmp_path):
    dataset = write_dataset(tmp_path / "data")
    report, page = checked(dataset.root, tmp_path / "out", gripper="none")
    assert report.startswith("Training would refuse this dataset. `deltaco_match` learns where")
    assert "observation.images.wrist moves" in report
    assert "1 episodes, 0 with a grasp: wave" in report
    assert "have a single episode" in report
    assert page.count("data:image/jpeg;base64") == 4 * len(EPISODES)


def test_the_command_ends_with_1_and_the_reason(tmp_path, monkeypatch, capsys):
    dataset = write_dataset(tmp_path / "data")
    options = ["--out", str(tmp_path / "out"), "--policy.demo_camera=observation.images.wrist"]
    monkeypatch.setattr(sys, "argv", ["deltaco", "check", str(dataset.root), *options])
    with pytest.raises(SystemExit, match="deltaco check: Training would refuse this dataset") as end:
        cli.main()
    assert "demo camera:    observation.images.wrist" in str(end.value.code)


def test_a_moving_camera_is_told_from_one_that_stands_still():
    env = PickPlaceEnv(4, SceneConfig(control="joints"))
    steps = list(islice(expert_episode(env, 4, seed=0), 0, 91, 30))
    env.close()
    front, wrist = (
        torch.stack([torch.from_numpy(step.observation["pixels"][name]) for step in steps])
        for name in ("front", "wrist")
    )
    front, wrist = (_staying_edges(images.permute(0, 3, 1, 2)) for images in (front, wrist))
    assert front > 0.5
    assert wrist < 0.2
