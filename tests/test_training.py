"""`deltaco-train`: LeRobot's loop over frames in memory sees what it would read from the disk."""

import io
import json
import shutil
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from lerobot.configs.video import RGBEncoderConfig
from lerobot.datasets import LeRobotDataset
from lerobot.scripts import lerobot_train
from PIL import Image
from safetensors.torch import load_file
from small_policies import LENGTH, REPO_ID, TASKS, batch_of, small_policy, write_dataset
from torch import distributed
from torch.nn.parallel import DistributedDataParallel

from lerobot_deltaco.commands import train as train_command
from lerobot_deltaco.modeling import task_sources
from lerobot_deltaco.modeling_deltaco import DeltacoPolicy
from lerobot_deltaco.policy.demonstrations import load_demonstrations
from lerobot_deltaco.policy.finite_loss import TrainingDivergedError
from lerobot_deltaco.policy.vision import VisionEncoderError, load_efficientnet_lite0
from lerobot_deltaco.training import loop
from lerobot_deltaco.training.frames import FramesInMemory, decoded, needed_bytes
from lerobot_deltaco.training.loop import InMemoryTraining, TrainingSetupError

EPISODES = [task for task in TASKS for _ in range(4)]


pytestmark = pytest.mark.usefixtures("fake_language")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return write_dataset(tmp_path_factory.mktemp("data") / "foreign", EPISODES)


@pytest.fixture
def train(train_any):
    """Runs a training of our policy in this process, and returns the folder of its checkpoints."""
    ours = ["--policy.type=deltaco", "--policy.image_size=16", "--policy.backbone=strided"]

    def train(*arguments, **options):
        return train_any(*ours, *arguments, **options)

    return train


@pytest.fixture
def train_any(dataset, tmp_path, monkeypatch):
    """Runs a training in this process, and returns the folder of its checkpoints."""

    def train_any(*arguments, name="run", in_memory=True):
        folder = tmp_path / name
        defaults = {
            "policy.device": "cpu",
            "dataset.repo_id": REPO_ID,
            "dataset.root": str(dataset.root),
            "batch_size": "6",
            "steps": "4",
            "save_freq": "2",
            "log_freq": "1",
            "num_workers": "0",
            "output_dir": str(folder),
        }
        given = dict(argument.removeprefix("--").split("=", 1) for argument in arguments)
        if "resume" in given:
            options = {name: value for name, value in given.items() if not name.startswith("policy.")}
        else:
            options = {**defaults, **given}
        monkeypatch.setattr(sys, "argv", ["train", *(f"--{key}={value}" for key, value in options.items())])
        if in_memory:
            with InMemoryTraining().active():
                lerobot_train.main()
        else:
            lerobot_train.main()
        return folder / "checkpoints"

    return train_any


def weights(checkpoint):
    return load_file(checkpoint / "pretrained_model" / "model.safetensors")


def assert_same(one, other):
    assert one.keys() == other.keys()
    different = [name for name in one if not torch.equal(one[name], other[name])]
    assert different == []


@pytest.mark.parametrize("episodes", [None, [1, 4, 5, 11]], ids=["all episodes", "some"])
def test_frames_equal_those_that_lerobot_reads(dataset, episodes):
    chosen = LeRobotDataset(REPO_ID, root=dataset.root, episodes=episodes, return_uint8=True)
    places = [0, 7, 19, 3, 7]
    expected = batch_of(chosen, places)
    found = FramesInMemory(chosen).batch(torch.tensor(places))
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        if name in chosen.meta.camera_keys:
            # LeRobot's loop does the same to images of bytes.
            found[name] = found[name].to(torch.float32) / 255
        if isinstance(value, torch.Tensor):
            torch.testing.assert_close(found[name], value, rtol=0, atol=0, msg=name)
            assert found[name].dtype == value.dtype
        else:
            assert found[name] == value


def test_features_of_any_shape_are_held(tmp_path):
    features = {
        "observation.pose": {"dtype": "float32", "shape": (2, 3), "names": None},
        "observation.flag": {"dtype": "bool", "shape": (1,), "names": None},
        "action": {"dtype": "float64", "shape": (2,), "names": None},
        "count": {"dtype": "int32", "shape": (1,), "names": None},
        "levels": {"dtype": "uint8", "shape": (3,), "names": None},
        "force": {"dtype": "float16", "shape": (2,), "names": None},
        "note": {"dtype": "string", "shape": (1,), "names": None},
    }
    written = LeRobotDataset.create("test/shapes", 10, features, root=tmp_path / "shapes", use_videos=False)
    rng = np.random.default_rng(0)
    for number in range(6):
        pose, action = rng.normal(size=(2, 3)).astype(np.float32), rng.normal(size=2)
        flag, note = np.array([number % 2 == 0]), f"frame {number}"
        levels, count = rng.integers(0, 255, 3, dtype=np.uint8), np.array([number], np.int32)
        frame = {"observation.pose": pose, "observation.flag": flag, "action": action, "note": note}
        more = {"count": count, "levels": levels, "force": action.astype(np.float16), "task": "wave"}
        written.add_frame({**frame, **more})
        if number % 2:
            written.save_episode()
    written.finalize()
    read = LeRobotDataset("test/shapes", root=written.root, episodes=[0, 2])
    expected, found = batch_of(read, [3, 0, 2]), FramesInMemory(read).batch(torch.tensor([3, 0, 2]))
    assert found["note"] == expected["note"]
    for name in features.keys() - {"note"}:
        torch.testing.assert_close(found[name], expected[name], rtol=0, atol=0, msg=name)


@pytest.mark.parametrize("kind", ["PNG", "TIFF", "BMP"])
def test_images_of_any_format_are_decoded(kind):
    image = np.random.default_rng(0).integers(0, 255, (9, 7, 3), dtype=np.uint8)
    file = io.BytesIO()
    Image.fromarray(image).save(file, kind)
    assert torch.equal(decoded(file.getvalue()), torch.from_numpy(image).permute(2, 0, 1))


def test_demonstrations_equal_those_that_are_read(dataset):
    frames = FramesInMemory(LeRobotDataset(REPO_ID, root=dataset.root, return_uint8=True))
    found = frames.demonstrations("observation.images.wrist", 16, 4)
    expected = load_demonstrations(REPO_ID, dataset.root, None, "observation.images.wrist", 16, 4)
    assert found.tasks == expected.tasks
    assert torch.equal(found.episodes, expected.episodes)
    assert torch.equal(found.frames, expected.frames)


def test_training_equals_that_of_lerobots_own_loop(train):
    # The same seed: the same weights, the same samples, and the same demonstrations of them. (At this size,
    # images are kept as they are; smaller ones would be rounded once more.)
    stock = train("--policy.image_size=32", name="stock", in_memory=False)
    memory = train("--policy.image_size=32", name="memory")
    assert_same(weights(stock / "000004"), weights(memory / "000004"))


def without_later_checkpoints(checkpoints, folder, step):
    """Copies the checkpoints of a run up to a step: what is there if it was killed after that one."""
    for path in sorted(checkpoints.iterdir()):
        if path.name.isdecimal() and int(path.name) <= step:
            shutil.copytree(path, folder / "checkpoints" / path.name)
    return folder / "checkpoints" / f"{step:06d}" / "pretrained_model" / "train_config.json"


@pytest.mark.parametrize("tasks_per_batch", [pytest.param(0, marks=pytest.mark.slow), 2])
def test_a_resumed_run_equals_an_uninterrupted_one(train, tmp_path, tasks_per_batch):
    # An epoch has 60 frames, which are 6 batches.
    options = [f"--policy.tasks_per_batch={tasks_per_batch}", "--batch_size=10", "--steps=14"]
    whole = train(*options, "--save_freq=4", "--log_freq=20", name="whole")
    for step in (8, 12):  # in the second epoch, and at its end
        config = without_later_checkpoints(whole, tmp_path / f"part_{step}", step)
        part = config.parents[2]
        train(f"--config_path={config}", "--resume=true", f"--output_dir={part.parent}", "--save_freq=14")
        assert_same(weights(whole / "000014"), weights(part / "000014"))


def test_episodes_and_the_split_are_respected(train, monkeypatch):
    seen = []
    forward = DeltacoPolicy.forward

    def spy(self, batch, **options):
        seen.append((self.training, set(batch["episode_index"].tolist())))
        return forward(self, batch, **options)

    monkeypatch.setattr(DeltacoPolicy, "forward", spy)
    train("--dataset.episodes=[0,1,2,3,4,5,6]", "--dataset.eval_split=0.4", "--eval_steps=2", "--steps=4")
    trained = set().union(*(episodes for training, episodes in seen if training))
    held_back = set().union(*(episodes for training, episodes in seen if not training))
    assert trained == {0, 1, 4}
    assert held_back == {2, 3, 5, 6}


def test_batches_hold_the_tasks_that_are_wanted(train, monkeypatch):
    seen = []
    forward = DeltacoPolicy.forward

    def spy(self, batch, **options):
        seen.append(batch["task"])
        return forward(self, batch, **options)

    monkeypatch.setattr(DeltacoPolicy, "forward", spy)
    train("--policy.tasks_per_batch=2", "--policy.upsampled_tasks=wave", "--policy.upsampled_share=0.5")
    for tasks in seen:
        assert tasks.count("wave") == 3
        assert len(set(tasks)) == 2


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--policy.tasks_per_batch=4", "--batch_size=8"], "4 different tasks, but the dataset has only 3"),
        (["--policy.tasks_per_batch=2", "--policy.upsampled_tasks=dance"], "is found in no task"),
        (["--dataset.image_transforms.enable=true"], "cannot be transformed at random"),
    ],
)
def test_what_cannot_be_is_refused_before_training(train, options, message):
    with pytest.raises(ValueError, match=message):
        train(*options)


ACT = ["--policy.type=act", "--policy.dim_model=16", "--policy.n_heads=2", "--policy.dim_feedforward=16"]
ACT += ["--policy.n_encoder_layers=1", "--policy.n_vae_encoder_layers=1", "--policy.chunk_size=5"]
ACT += ["--policy.n_action_steps=5", "--policy.pretrained_backbone_weights=null"]
ACT += ["--policy.push_to_hub=false"]


def test_any_policy_trains_as_with_lerobots_own_loop(train_any):
    stock = train_any(*ACT, name="stock", in_memory=False)
    memory = train_any(*ACT, name="memory")
    assert_same(weights(stock / "000004"), weights(memory / "000004"))


def test_windows_of_frames_equal_those_that_lerobot_reads(dataset):
    camera = "observation.images.wrist"
    seconds = {"action": [0.0, 0.1, 0.2, 0.5], "observation.state": [-0.1, 0.0], camera: [-0.2, 0.0]}
    chosen = LeRobotDataset(
        REPO_ID, root=dataset.root, episodes=[1, 4], delta_timestamps=seconds, return_uint8=True
    )
    places = list(range(len(chosen)))
    expected = batch_of(chosen, places)
    found = FramesInMemory(chosen).batch(torch.tensor(places))
    assert found.keys() == expected.keys()
    assert expected["action_is_pad"].any()
    for name in ("action", "action_is_pad", "observation.state", f"{camera}_is_pad"):
        assert torch.equal(found[name], expected[name]), name
    assert found[camera].shape[:2] == (len(places), 2)
    assert torch.equal(found[camera].to(torch.float32) / 255, expected[camera])


def write_videos(root, camera, episodes):
    """A dataset whose images, (H, W, 3) uint8 in each list of `episodes`, are videos."""
    features = {
        camera: {"dtype": "video", "shape": episodes[0][0].shape, "names": ["height", "width", "channels"]},
        "action": {"dtype": "float32", "shape": (2,), "names": None},
    }
    encoder = RGBEncoderConfig(vcodec="h264")
    written = LeRobotDataset.create("test/video", 10, features, root=root, rgb_encoder=encoder)
    for images in episodes:
        for step, image in enumerate(images):
            written.add_frame({camera: image, "action": np.full(2, step, np.float32), "task": "wave"})
        written.save_episode()
    written.finalize()
    return written


@pytest.mark.parametrize("seconds", [[-0.1, 0.0], [0.0]], ids=["two frames", "one frame"])
def test_windows_of_videos_equal_those_that_lerobot_reads(tmp_path, seconds):
    camera = "observation.images.top"
    images = [
        [np.full((32, 48, 3), 100 * episode + 20 * step, np.uint8) for step in range(4)]
        for episode in range(2)
    ]
    written = write_videos(tmp_path / "video", camera, images)
    windows = {camera: seconds, "action": [0.0, 0.1]}
    read = LeRobotDataset(
        "test/video",
        root=written.root,
        delta_timestamps=windows,
        return_uint8=True,
        video_backend="pyav",
    )
    expected = batch_of(read, list(range(8)))
    found = FramesInMemory(read).batch(torch.arange(8))
    assert found.keys() == expected.keys()
    for name in (camera, f"{camera}_is_pad", "action", "action_is_pad"):
        assert torch.equal(found[name], expected[name]), name
    # The dataset still gives windows.
    assert torch.equal(read[3][camera], expected[camera][3])


def test_larger_demonstrations_are_decoded_from_videos(tmp_path):
    camera = "observation.images.top"
    rng = np.random.default_rng(0)
    block = np.ones((8, 8, 1), np.uint8)
    images = [[np.kron(rng.integers(0, 255, (6, 6, 3), np.uint8), block) for _ in range(4)] for _ in range(3)]
    written = write_videos(tmp_path / "video", camera, images)
    options = {"root": written.root, "return_uint8": True, "video_backend": "pyav"}
    dataset = LeRobotDataset("test/video", episodes=[0, 2], **options)
    held = FramesInMemory(dataset, image_size=16).demonstrations(camera, 48, 2)
    for row, episode in enumerate((0, 2)):
        for frame, step in enumerate((0, 3)):
            expected = LeRobotDataset("test/video", **options)[4 * episode + step][camera]
            assert torch.equal(held.frames[row, frame], expected)


def test_processes_do_not_send_each_other_demonstrations(dataset, tmp_path):
    frames = FramesInMemory(dataset)
    policy, _, _ = small_policy(dataset, demo_repo_id=REPO_ID, demo_root=str(dataset.root))
    policy.set_train_demonstrations(frames.demonstrations("observation.images.top", 16, 2))
    store = distributed.FileStore(str(tmp_path / "store"), 1)
    distributed.init_process_group("gloo", store=store, rank=0, world_size=1)
    try:
        sent = {buffer.data_ptr() for buffer in DistributedDataParallel(policy).modules_buffers}
    finally:
        distributed.destroy_process_group()
    assert policy.step.data_ptr() in sent
    for demonstrations in (policy.train_demonstrations, policy.eval_demonstrations):
        assert not sent & {buffer.data_ptr() for buffer in demonstrations.buffers()}


def test_reward_models_are_sent_to_lerobots_command():
    with pytest.raises(ValueError, match="Use `lerobot-train` for reward models"):
        InMemoryTraining().make_datasets(SimpleNamespace(policy=None))


def test_too_many_frames_are_refused_before_they_are_read(dataset, monkeypatch):
    needed = needed_bytes(dataset)
    assert needed == dataset.num_frames * (20 * 28 * 3 + 24 * 24 * 3 + 8 * (2 + 3 + 5))
    memory = type("Memory", (), {"available": needed})
    monkeypatch.setattr("lerobot_deltaco.training.frames.psutil.virtual_memory", lambda: memory)
    with pytest.raises(MemoryError, match="60 frames take 0.0 GB.*--dataset.episodes"):
        FramesInMemory(LeRobotDataset(REPO_ID, root=dataset.root, return_uint8=True))


@pytest.mark.parametrize("option", ["dataset.root", "policy.demo_root"])
def test_a_mistyped_folder_is_named_and_not_made(train, tmp_path, option):
    missing = tmp_path / "mistyped" / "data"
    with pytest.raises(
        TrainingSetupError, match=rf"--{option} is .*mistyped/data.* the folder does not exist"
    ):
        train("--policy.demo_repo_id=test/foreign", f"--{option}={missing}")
    assert not missing.parent.exists()


def test_frames_until_the_release_follow_the_direction_of_the_gripper(train, monkeypatch):
    used, checked = [], []
    sampler = loop.TaskBatchSampler
    monkeypatch.setattr(
        loop, "TaskBatchSampler", lambda *a, use, **k: used.append(use) or sampler(*a, use=use, **k)
    )
    monkeypatch.setattr(loop, "warn_if_inverted", lambda gripper, spans: checked.append(gripper[:2].tolist()))
    options = ["--policy.tasks_per_batch=2", "--policy.frames_after_release=0", "--steps=1"]
    for closed in ("low", "high"):
        train(*options, f"--policy.gripper_closed={closed}", name=closed)
    # The gripper's command is 0 in every other frame, the first included.
    assert checked == [[0, 1], [0, -1]]
    frames = np.arange(LENGTH)
    for use, last_opening in zip(used, (frames[1::2][-1], frames[2::2][-1]), strict=True):
        assert (use.reshape(-1, LENGTH) == (frames <= last_opening)).all()


def test_without_a_gripper_there_is_no_release(train):
    options = ["--policy.gripper=none", "--policy.tasks_per_batch=2", "--policy.frames_after_release=1"]
    with pytest.raises(ValueError, match="`frames_after_release` needs a gripper"):
        train(*options)


@pytest.mark.parametrize(
    ("options", "in_memory", "message"),
    [
        (["--policy.method=language_only"], False, "`tasks_per_batch` has no effect"),
        (
            ["--policy.frames_after_release=1", "--steps=2"],
            False,
            "`tasks_per_batch` and `frames_after_release` have no effect",
        ),
        (["--policy.demo_episodes=[0,1,2,3,4,5,6,7,8,9,10,11]"], True, None),
    ],
)
def test_options_of_batches_without_effect_are_named_once(train, monkeypatch, options, in_memory, message):
    said = []
    monkeypatch.setattr(task_sources.logger, "warning", lambda text, *values: said.append(text % values))
    train("--policy.tasks_per_batch=2", "--steps=1", *options, in_memory=in_memory)
    assert len(said) == (message is not None)
    assert message is None or said[0].startswith(message)


@pytest.mark.parametrize("error", [ValueError("wrong"), FileNotFoundError("wrong"), MemoryError("wrong")])
@pytest.mark.parametrize("method", ["_make_datasets", "_make_policy"])
def test_a_training_that_cannot_begin_ends_the_command_in_one_line(train, monkeypatch, method, error):
    initialize = InMemoryTraining.__init__

    def fail(*_, **__):
        raise error

    def failing(self):
        initialize(self)
        setattr(self, method, fail)

    monkeypatch.setattr(InMemoryTraining, "__init__", failing)
    monkeypatch.setattr(train_command, "train", train)
    with pytest.raises(SystemExit, match="^deltaco-train: wrong$"):
        train_command.main()


def test_an_interrupt_ends_the_command_in_one_line(monkeypatch, capsys):
    def interrupted():
        raise KeyboardInterrupt

    monkeypatch.setattr(train_command, "train", interrupted)
    with pytest.raises(SystemExit) as end:
        train_command.main()
    assert end.value.code == 130
    assert capsys.readouterr().err.strip().startswith("deltaco-train: Interrupted. Go on from a saved")


def test_missing_weights_end_the_command_in_one_line(train, monkeypatch):
    monkeypatch.setattr("lerobot_deltaco.policy.vision._LITE_PACKAGES", ("no_such_package",))
    monkeypatch.setattr(train_command, "train", load_efficientnet_lite0)
    with pytest.raises(SystemExit, match="deltaco-train: .*Install this project's extra `offline`"):
        train_command.main()


def test_missing_weights_for_matching_are_noticed_before_the_frames_are_read(train, monkeypatch):
    monkeypatch.setattr("lerobot_deltaco.policy.vision._LITE_PACKAGES", ("no_such_package",))
    monkeypatch.setattr(
        "lerobot_deltaco.training.loop.FramesInMemory", lambda *_, **__: pytest.fail("read frames")
    )
    with pytest.raises(VisionEncoderError, match="no-such-package. Install this project's extra `offline`"):
        train("--policy.demo_encoder=correspondence", "--policy.pretrained_matching=true")


@pytest.mark.parametrize(
    ("damage", "cause"),
    [
        (lambda batch: batch["action"].fill_(np.inf), "`action` or `observation.state` had numbers"),
        (lambda batch: None, "lower --policy.optimizer_lr, or limit the gradient"),
    ],
)
def test_a_training_that_diverges_stops_and_leaves_the_last_good_checkpoint(
    train, tmp_path, monkeypatch, damage, cause
):
    imitation_loss = DeltacoPolicy._imitation_loss

    def diverging(self, batch, *arguments):
        loss, logged = imitation_loss(self, batch, *arguments)
        if int(self.step) == 2:
            damage(batch)
            loss = loss * torch.inf
        return loss, logged

    monkeypatch.setattr(DeltacoPolicy, "_imitation_loss", diverging)
    with pytest.raises(TrainingDivergedError, match="loss of training step 3 is not finite") as error:
        train("--save_freq=2", "--steps=8")
    assert cause in str(error.value)
    assert "--resume=true" in str(error.value)
    saved = tmp_path.rglob("model.safetensors")
    assert [path.parent.parent.name for path in saved] == ["000002"]


def test_a_checkpoint_of_weights_that_are_not_finite_is_not_saved(train, monkeypatch):
    forward = DeltacoPolicy.forward

    def overflowing(self, batch, **options):
        result = forward(self, batch, **options)
        if int(self.step) == 2:
            with torch.no_grad():
                self.model.raw_log_std.fill_(torch.nan)
        return result

    monkeypatch.setattr(DeltacoPolicy, "forward", overflowing)
    with pytest.raises(TrainingDivergedError, match="After training step 2, the weight model.raw_log_std"):
        train("--save_freq=2", "--steps=8")


def test_what_was_in_lerobots_loop_is_there_again_afterwards(train):
    before = {name: getattr(lerobot_train, name) for name in ("cycle", "make_policy", "EpisodeAwareSampler")}
    train("--steps=1")
    assert {name: getattr(lerobot_train, name) for name in before} == before


def test_the_log_has_the_parts_of_the_loss(train, capfd):
    folder = train("--steps=1")
    assert (
        json.loads((folder / "000001" / "pretrained_model" / "config.json").read_text())["type"] == "deltaco"
    )
    printed = "".join(capfd.readouterr())
    for name in ("motion_nll", "gripper_accuracy", "demo_accuracy", "grdn"):
        assert name in printed
