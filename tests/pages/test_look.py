"""Pictures, videos and the page of `deltaco look`."""

import io
import json
import re

import av
import numpy as np
import pytest
import torch
from small_policies import load_tiny_policy, save_tiny_policy, write_episodes

from gym_deltaco.env import ACTION_NAMES, PickPlaceEnv
from gym_deltaco.expert import expert_episode
from gym_deltaco.scene_config import SceneConfig
from gym_deltaco.tasks import OBJECTS, TASKS, get_task
from lerobot_deltaco.evaluation.video import (
    benchmark_env,
    find_demonstration,
    load_conditioned,
    record_episode,
)
from lerobot_deltaco.pages import crops
from lerobot_deltaco.pages import look as look_module
from lerobot_deltaco.pages.arguments import LookArguments, PromptOptions
from lerobot_deltaco.pages.crops import draw_crop
from lerobot_deltaco.pages.html import EpisodeView, render
from lerobot_deltaco.pages.look import look
from lerobot_deltaco.pages.verdict import TOLERANCE
from lerobot_deltaco.pages.videos import encode_video
from lerobot_deltaco.policies.deltaco_match.findings import (
    PICK_COLOR,
    PLACE_COLOR,
    draw_localization,
)
from lerobot_deltaco.policies.deltaco_match.localization import PickPlace


def found_at(pick, place, by_demonstration=(True, True), size=24):
    """PickPlace locations with maps that peak there, at (column, row) of size x size."""
    maps = torch.full((1, 2, size, size), -20.0)
    for n, (column, row) in enumerate((pick, place)):
        maps[0, n, row, column] = 20
    locations = (torch.tensor([[pick, place]]) + 0.5) / size * 2 - 1
    attention = maps.flatten(2).softmax(2).view_as(maps)
    sure = (torch.ones(1), torch.ones(1), torch.zeros(1, dtype=torch.bool))
    return PickPlace(locations, torch.zeros(1), maps, attention, by_demonstration, *sure, locations[:, 0])


def test_maps_are_drawn_at_the_scenes_own_resolution():
    scene, ends = np.full((480, 640, 3), 128, np.uint8), np.full((2, 48, 48, 3), 128, np.uint8)
    found = found_at((6, 18), (18, 6), (True, False))
    image = np.asarray(draw_localization(scene, None, found)).astype(int)
    assert image.shape == (480, 640, 3)
    for color, (x, y), (other_x, other_y) in (
        (PICK_COLOR, (173, 370), (600, 400)),
        (PLACE_COLOR, (493, 130), (40, 40)),
    ):
        distances = np.abs(image[[y, other_y], [x, other_x]] - color).mean(axis=1)
        assert distances[0] < distances[1] - 25
    assert (image[240, 320] == 128).all()
    # Attention is drawn where the demonstration tells the location.
    image = np.asarray(draw_localization(scene, ends, found))
    assert not (image[:200, :200] == 128).all()
    assert (image[-200:, :200] == 128).all()


def test_a_video_is_one_that_browsers_play_and_its_end_stays():
    frames = [np.full((65, 48, 3), 20 * n, np.uint8) for n in range(10)]
    with av.open(io.BytesIO(encode_video(frames, fps=8))) as video:
        stream = video.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        assert (stream.width, stream.height) == (48, 64)
        images = [frame.to_ndarray(format="rgb24") for frame in video.decode(stream)]
    assert len(images) == 10 + 8
    assert abs(int(images[-1].mean()) - 180) < 5


def test_an_episode_is_recorded(tmp_path):
    loaded = load_tiny_policy(tmp_path)
    env = PickPlaceEnv(4, SceneConfig(episode_length=4), "rgb_array", 64)
    demonstration = loaded.policy.demonstrations.of_task(TASKS[4].instruction)[0]
    recording = record_episode(loaded, env, 4, 7, "Put it in the red bin.", [demonstration])
    assert [frame.shape for frame in recording.frames] == [(64, 64, 3)] * 5
    assert recording.localization.locations.shape == (1, 2, 2)
    _, info = env.reset(seed=7)
    assert (recording.frames[0] == env.render()).all()
    assert (recording.positions[0] == [env.scene.object_pose(n).position for n in range(3)]).all()
    assert [item.label.index for item in recording.layout.objects] == info["objects"].tolist()


def test_the_expert_records_a_demonstration_of_any_task(tmp_path):
    policy = load_tiny_policy(tmp_path).policy
    scene = benchmark_env(policy.config, 64).scene_config
    for task_id in (0, 134, 299):
        one, same, other = (find_demonstration(policy, get_task(task_id), scene, n) for n in (0, 0, 1))
        assert one.task == TASKS[task_id].instruction
        assert TASKS[task_id].object.describes(OBJECTS[one.target_object])
        assert one.frames.shape == (2, 3, 48, 48)
        assert one.pick_state.isfinite().all()
        assert (one.frames == same.frames).all()
        assert (one.frames != other.frames).any()


def write_robot_dataset(root, task_ids, size=96):
    """Episodes of the expert in scenes of the benchmark, as a dataset of any robot."""
    env = PickPlaceEnv(0, SceneConfig(image_size=size))

    def frame(step):
        image, state = step.observation["pixels"], step.observation["agent_pos"]
        return {"observation.image": image, "observation.state": state, "action": step.action}

    episodes = [
        (TASKS[task_id].instruction, [frame(step) for step in expert_episode(env, task_id, seed)])
        for seed, task_id in enumerate(task_ids)
    ]
    write_episodes(root, "test/robot", episodes, action=ACTION_NAMES)


def test_the_page_of_a_dataset_counts_the_right_pick_locations(tmp_path, monkeypatch):
    write_robot_dataset(tmp_path / "data", [4, 4, 9])
    folder = save_tiny_policy(tmp_path / "policy")
    drawn = []
    monkeypatch.setattr(
        look_module, "draw_localization", lambda *args: drawn.append(args) or draw_localization(*args)
    )
    report = look(LookArguments(str(folder), str(tmp_path / "data"), 3, tmp_path / "out"))
    text = (tmp_path / "out/index.html").read_text()
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["index.html"]
    assert text.count("data:image/jpeg;base64") == 3 * 3
    # The first two demonstrate each other, the third itself; the scenes have the dataset's own size.
    assert [text.count(f"by {who}") for who in ("episode 1", "episode 0", "itself")] == [1, 1, 1]
    assert [args[0].shape for args in drawn] == [(96, 96, 3)] * 3
    assert [args[1].shape for args in drawn] == [(2, 96, 96, 3)] * 3
    right = torch.stack([(args[2].locations[0] - args[3]).norm(dim=1) < TOLERANCE for args in drawn])
    for what, number in zip(("pick", "place"), right.sum(dim=0).tolist(), strict=True):
        assert f"Episodes with the right {what} location: <b>{number} of 3</b>" in text
        assert f"Episodes with the right {what} location: {number} of 3\n" in report


def test_the_crops_on_the_page_are_those_that_were_compared(tmp_path, monkeypatch):
    write_robot_dataset(tmp_path / "data", [4, 4])
    loaded = load_tiny_policy(tmp_path)
    matching = loaded.policy.localizer.matching
    compared, chosen, drawn = [], [], []
    encoder, find = matching.encoder, matching.find
    # The gripper does not close at a crop's center.
    monkeypatch.setattr(matching, "grasps", lambda _, proposals, *__: -proposals)
    monkeypatch.setattr(look_module, "load_conditioned", lambda _: loaded)
    monkeypatch.setattr(matching, "encoder", lambda *crops: compared.append(crops) or encoder(*crops))
    monkeypatch.setattr(matching, "find", lambda *args: chosen.append(find(*args)) or chosen[-1])
    monkeypatch.setattr(crops, "draw_crop", lambda *crop: drawn.append(crop) or draw_crop(*crop))
    look(LookArguments("policy", str(tmp_path / "data"), 2, tmp_path / "out"))
    assert len(compared) == len(drawn) == 2 * len(chosen) == 4
    for shown, own in zip(compared[::2], drawn[::2], strict=True):
        assert all(map(torch.equal, shown, own))
    for (image, locations, sizes), candidates, own in zip(compared[1::2], chosen, drawn[1::2], strict=True):
        best = candidates.log_probabilities[0].argmax()
        assert all(map(torch.equal, (image, locations[:, best, None], sizes[:, best, None]), own))


@pytest.mark.parametrize(("n_frames", "shown"), [(0, "0 2"), (None, "1"), (1, "0 1 2")])
def test_episodes_of_the_training_dataset_are_those_that_were_held_out(tmp_path, n_frames, shown):
    """`n_frames`: what the policy's dataset has more than this one; None for a choice by the user."""
    write_robot_dataset(tmp_path / "data", [4, 4, 9])
    folder = save_tiny_policy(tmp_path / "policy")
    total = json.loads((tmp_path / "data/meta/info.json").read_text())["total_frames"]
    config = json.loads((folder / "config.json").read_text())
    config |= {"held_out_episodes": [0, 2], "n_dataset_frames": total + (n_frames or 0)}
    (folder / "config.json").write_text(json.dumps(config))
    chosen = "[1]" if n_frames is None else None
    report = look(LookArguments(str(folder), str(tmp_path / "data"), 3, tmp_path / "out", chosen))
    text = (tmp_path / "out/index.html").read_text()
    found = re.findall(r"Episode (\d+),", text)
    assert found == shown.split()
    assert ("held out of the fit of what to pick" in report) == (n_frames == 0)


def test_a_point_takes_the_place_of_demonstrations(tmp_path):
    write_robot_dataset(tmp_path / "data", [4, 4])
    arguments = [str(save_tiny_policy(tmp_path / "policy")), str(tmp_path / "data"), 2, tmp_path / "out"]
    look(LookArguments(*arguments, policy=PromptOptions(demo_point="[10, 20]")))
    text = (tmp_path / "out/index.html").read_text()
    assert text.count("where a point shows the object") == 2
    assert text.count("data:image/jpeg;base64") == 2 * 2  # nothing is compared
    with pytest.raises(ValueError, match="picture, which has 48 x 48 px"):
        look(LookArguments(*arguments, policy=PromptOptions(demo_point="[480, 20]")))
    with pytest.raises(ValueError, match=r"lists of whole numbers, such as \[10,20\]. Got '4 5'"):
        PromptOptions(demo_point="4 5")
    with pytest.raises(ValueError, match="need the episodes of a --dataset"):
        LookArguments("policy", policy=PromptOptions(demo_photo="cup.png"))


def test_an_episode_is_marked_as_right_wrong_or_unknown():
    views = [EpisodeView("", "", [], is_right, "", [], "", None) for is_right in (True, False, None)]
    page = dict.fromkeys(("checkpoint", "source", "pick_color", "place_color"), "")
    text = render("look.html", views=views, rates=[], errors={}, tolerance=0.2, **page)
    assert re.findall('note (\\w*)"><p><b>(.?)', text) == [("good", "✓"), ("bad", "✗"), ("", " ")]


def test_without_a_dataset_episodes_of_the_benchmark_are_run(tmp_path):
    look(LookArguments(str(save_tiny_policy(tmp_path / "policy")), episodes=2, out=tmp_path / "out"))
    text = (tmp_path / "out/index.html").read_text()
    assert text.count("data:image/jpeg;base64") == text.count("data:video/mp4;base64") == 2
    assert text.count("Understood as: ") == 2
    assert "of 2</b>" in text


def test_what_does_not_fit_is_an_error_that_says_so(tmp_path):
    folder = save_tiny_policy(tmp_path / "policy")
    with pytest.raises(ValueError, match="has no checkpoints"):
        load_conditioned(tmp_path / "nothing")
    frame = {"observation.images.top": np.zeros((32, 32, 3), np.uint8), "action": np.zeros(4, np.float32)}
    write_episodes(tmp_path / "other", "test/other", [("wave", [frame])], action=ACTION_NAMES)
    with pytest.raises(ValueError, match=r"needs 'observation.image'.*observation.images.top"):
        look(LookArguments(str(folder), str(tmp_path / "other"), out=tmp_path / "out"))
    with pytest.raises(FileNotFoundError, match="There is no dataset in"):
        look(LookArguments(str(folder), str(tmp_path / "nothing"), out=tmp_path / "out"))
