"""Frames in memory: they equal what LeRobot reads from the disk."""

import io
import shutil
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.transforms import ImageTransforms, ImageTransformsConfig
from PIL import Image
from small_policies import batch_of, write_episodes

from lerobot_deltaco.data import frames as frames_module
from lerobot_deltaco.data import images as images_module
from lerobot_deltaco.data.demonstrations import RobotData
from lerobot_deltaco.data.frames import FramesInMemory
from lerobot_deltaco.data.pauses import paused_frames
from lerobot_deltaco.data.training_data import (
    DatasetEpisodes,
    DemonstrationFormat,
    TrainingData,
    read_demonstrations,
)

TASKS = ["stack the cups", "pour the tea", "wave"] * 2
LENGTH = 5
TOP, WRIST = "observation.images.top", "observation.images.wrist"


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """A dataset of random numbers with features of all kinds."""
    rng = np.random.default_rng(0)

    def frame(step):
        return {
            TOP: rng.integers(0, 255, (20, 28, 3), dtype=np.uint8),
            WRIST: rng.integers(0, 255, (24, 24, 3), dtype=np.uint8),
            "observation.state": rng.normal(size=2).astype(np.float32),
            "observation.pose": rng.normal(size=(2, 3)).astype(np.float32),
            "observation.flag": rng.integers(0, 2, 1).astype(bool),
            "action": np.array([*rng.uniform(-5, 5, 2), step % 2], np.float32),
            "force": rng.normal(size=2),
            "count": rng.integers(0, 99, 1).astype(np.int32),
            "levels": rng.integers(0, 255, 3, dtype=np.uint8),
            "note": f"note {rng.integers(99)}",
        }

    folder = tmp_path_factory.mktemp("data") / "small"
    write_episodes(folder, "test/small", [(task, [frame(n) for n in range(LENGTH)]) for task in TASKS])
    return folder


@pytest.fixture(scope="module")
def video_root(tmp_path_factory):
    """A dataset whose only camera is stored as a video, of shades that are 10 apart."""

    def frame(episode, step):
        image = np.full((64, 96, 3), 60 * episode + 10 * step, np.uint8)
        return {TOP: image, "action": np.array([episode, step], np.float32)}

    folder = tmp_path_factory.mktemp("data") / "video"
    episodes = [(TASKS[n], [frame(n, step) for step in range(LENGTH)]) for n in range(2)]
    write_episodes(folder, "test/small", episodes, video=True)
    return folder


def read(root, **options):
    return LeRobotDataset("test/small", root=root, return_uint8=True, **options)


def assert_batches_are_equal(dataset, indices):
    expected, found = batch_of(dataset, indices), FramesInMemory(dataset).batch(indices)
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        if name in dataset.meta.camera_keys and value.is_floating_point():
            found[name] = found[name].float() / 255  # LeRobot's loop does this to images of bytes
        if isinstance(value, torch.Tensor):
            torch.testing.assert_close(found[name], value, rtol=0, atol=0, msg=name)
        else:
            assert found[name] == value, name


@pytest.mark.parametrize("episodes", [None, [1, 3, 4]], ids=["all episodes", "some episodes"])
def test_batches_and_windows_equal_those_of_lerobot(root, episodes):
    assert_batches_are_equal(read(root, episodes=episodes), [0, 7, 14, 3, 7])
    windows = {TOP: [-0.1, 0.0], "action": [0.0, 0.1, 0.2, 0.3], "observation.state": [0.0]}
    dataset = read(root, episodes=episodes, delta_timestamps=windows)
    assert_batches_are_equal(dataset, list(range(3 * LENGTH)))


def test_frames_that_are_skipped_are_in_no_window(root):
    frames = FramesInMemory(read(root, delta_timestamps={"action": [0.0, 0.1, 0.2]}))
    plain = frames.batch(range(LENGTH))
    skipped = np.zeros(len(frames), dtype=bool)
    skipped[1:3] = True
    frames.skip(skipped)
    batch = frames.batch([0, 3, LENGTH - 1])
    assert torch.equal(batch["action"][0], plain["action"][[0, 3, 4], 0])
    assert torch.equal(batch["action"][1], plain["action"][3])
    assert batch["action_is_pad"].tolist() == [[False] * 3, [False, False, True], [False, True, True]]
    assert torch.equal(batch["observation.state"], plain["observation.state"][[0, 3, LENGTH - 1]])


@pytest.mark.parametrize("fps", [5, 30])
def test_pauses_are_stretches_in_which_the_robot_stands_still(fps):
    # It moves in ten frames, stands still in 20, and so on; the second dimension only trembles.
    moving = (torch.arange(80) // 10 % 3 == 0).double()
    states = torch.stack([moving.cumsum(0) - moving, 0.001 * (torch.arange(80) % 2)], dim=1)
    data = RobotData(states, states, [(0, 49), (50, 79)])
    reach = n_kept = max(1, round(fps / 10))
    paused = np.flatnonzero(paused_frames(data, fps)).tolist()
    begin = reach + n_kept
    assert paused == [
        *range(10 + begin, 31 - reach),
        *range(40 + begin, 49),
        *range(50 + n_kept, 61 - reach),
        *range(70 + begin, 79),
    ]
    # A gripper that is told to close is no pause.
    actions = torch.stack([states[:, 0], (torch.arange(80) > 20).double()], dim=1)
    assert not paused_frames(data._replace(actions=actions), fps)[[20, 21]].any()


@pytest.mark.parametrize("seconds", [[-0.1, 0.0], [0.0], None], ids=["two frames", "one frame", "no window"])
def test_videos_equal_those_of_lerobot(video_root, seconds):
    windows = None if seconds is None else {TOP: seconds, "action": [0.0, 0.1]}
    dataset = read(video_root, delta_timestamps=windows, video_backend="pyav")
    assert_batches_are_equal(dataset, list(range(2 * LENGTH)))
    # The dataset still gives windows.
    assert dataset[3]["action"].shape == ((2,) if seconds is None else (2, 2))


@pytest.mark.parametrize("n_frames", [2, 3])
def test_demonstrations_and_robot_data_equal_those_that_are_read(root, n_frames):
    form = DemonstrationFormat(WRIST, 16, n_frames)
    from_memory = TrainingData.read(FramesInMemory(read(root, episodes=[0, 2, 5]), image_size=16), form)
    from_disk = TrainingData.read(DatasetEpisodes(read(root), [0, 2, 5]), form)
    found, expected = from_memory.demonstrations, from_disk.demonstrations
    assert found.tasks == expected.tasks
    assert torch.equal(found.episodes, expected.episodes)
    assert torch.equal(found.frames, expected.frames)
    assert torch.equal(found.first_images, expected.first_images)
    robot, expected_robot = from_memory.robot, from_disk.robot
    for (first, last), (a, b) in zip(robot.spans, expected_robot.spans, strict=True):
        assert torch.equal(robot.states[first : last + 1], expected_robot.states[a : b + 1])
        assert torch.equal(robot.actions[first : last + 1], expected_robot.actions[a : b + 1])
        assert torch.equal(robot.images([first, last]), expected_robot.images([a, b]))


def test_frames_of_videos_are_those_recorded_whatever_time_a_clock_gave_them(video_root, tmp_path):
    root = shutil.copytree(video_root, tmp_path / "clock")
    for path in root.glob("data/*/*.parquet"):
        frames = pd.read_parquet(path)
        frames["timestamp"] = np.float32(0.2)
        frames.to_parquet(path)
    expected = FramesInMemory(read(video_root)).columns[TOP]
    assert torch.equal(FramesInMemory(read(root)).columns[TOP], expected)


def test_demonstrations_are_read_from_videos(video_root):
    bank = read_demonstrations(DatasetEpisodes(read(video_root)), DemonstrationFormat(TOP, 16))
    shades = bank.frames.float().mean(dim=(2, 3, 4))
    torch.testing.assert_close(shades, torch.tensor([[0.0, 40], [60, 100]]), atol=6, rtol=0)


def test_images_are_scaled_on_request(root):
    batch = FramesInMemory(read(root), image_size=16).batch([0, 1])
    assert {batch[camera].shape for camera in (TOP, WRIST)} == {(2, 3, 16, 16)}


def test_any_image_format_is_decoded():
    image = np.random.default_rng(0).integers(0, 255, (9, 7, 3), dtype=np.uint8)
    for kind in ("PNG", "TIFF", "BMP"):
        file = io.BytesIO()
        Image.fromarray(image).save(file, kind)
        assert torch.equal(images_module._decoded(file.getvalue()), torch.from_numpy(image).permute(2, 0, 1))


def test_frames_that_do_not_fit_into_memory_are_refused(root, monkeypatch):
    # Images, and 8 bytes for each number.
    needed = 30 * (20 * 28 * 3 + 24 * 24 * 3 + 8 * (2 + 3 + 6 + 1 + 2 + 1 + 3 + 1 + 5))
    memory = SimpleNamespace(available=needed // 0.8 - 2)
    monkeypatch.setattr(frames_module.psutil, "virtual_memory", lambda: memory)
    with pytest.raises(MemoryError, match="The 30 frames take 0.0 GB of memory.*--dataset.episodes"):
        FramesInMemory(read(root))
    memory.available += 4
    FramesInMemory(read(root))


def test_random_transforms_are_refused(root):
    dataset = read(root, image_transforms=ImageTransforms(ImageTransformsConfig(enable=True)))
    with pytest.raises(ValueError, match=r"cannot be transformed at random.*--dataset.image_transforms"):
        FramesInMemory(dataset)
