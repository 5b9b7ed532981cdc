"""A checkpoint from a stranger is checked before it is believed."""

import functools
import json
import shutil

import httpx
import pytest
import torch
from huggingface_hub.errors import LocalEntryNotFoundError, RemoteEntryNotFoundError
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from small_policies import TASKS, batch_of, small_policy, use_fake_encoder, write_dataset

from lerobot_deltaco.evaluation.checkpoint_policy import load_policy
from lerobot_deltaco.modeling_deltaco import DeltacoPolicy
from lerobot_deltaco.policy.demonstrations import DemonstrationSet
from lerobot_deltaco.policy.processor_files import ProcessorFileError, check_processor_files
from lerobot_deltaco.policy.task_file import TASK_FILE, TaskFileError, read_task_file

N_DEMONSTRATIONS = 2


@pytest.fixture(autouse=True)
def _language(monkeypatch):
    use_fake_encoder(monkeypatch)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    """A policy with its processors and two demonstrations."""
    with pytest.MonkeyPatch.context() as patch:
        use_fake_encoder(patch)
        root = tmp_path_factory.mktemp("data") / "foreign"
        dataset = write_dataset(root, TASKS[:N_DEMONSTRATIONS])
        policy, before, after = small_policy(dataset, demo_repo_id="test/foreign", demo_root=str(root))
        policy(before(batch_of(dataset, [0, 5])))
    folder = tmp_path_factory.mktemp("checkpoint") / "policy"
    policy.save_pretrained(folder)
    before.save_pretrained(folder)
    after.save_pretrained(folder)
    return folder


@pytest.fixture
def copy(checkpoint, tmp_path):
    return shutil.copytree(checkpoint, tmp_path / "copy")


def test_a_checkpoint_that_is_whole_is_loaded(copy):
    loaded = load_policy(copy)
    assert loaded.policy.eval_demonstrations.tasks == TASKS[:N_DEMONSTRATIONS]
    check_processor_files(copy)


# Processors


def with_class(contents):
    contents["steps"][0] = {"class": "os.system", "config": {"command": "touch ran"}}


def with_both(contents):
    contents["steps"][0]["class"] = "os.system"


def with_unknown_name(contents):
    contents["steps"][0]["registry_name"] = "launch_missiles"


def without_name(contents):
    del contents["steps"][0]["registry_name"]


@pytest.mark.parametrize("file", ["policy_preprocessor.json", "policy_postprocessor.json"])
@pytest.mark.parametrize(
    ("tamper", "message"),
    [
        (with_class, "names the class 'os.system', which LeRobot would import and call"),
        (with_both, "names the class 'os.system'"),
        (with_unknown_name, "names the step 'launch_missiles', which is not registered"),
        (without_name, "names the step None"),
        (lambda contents: contents.clear(), "`steps` must be a list"),
        (lambda contents: contents.update(steps=["os.system"]), "`steps` must be a list of steps"),
    ],
)
def test_processors_are_only_what_is_registered(copy, monkeypatch, file, tamper, message):
    path = copy / file
    contents = json.loads(path.read_text())
    tamper(contents)
    path.write_text(json.dumps(contents))
    monkeypatch.chdir(copy)
    for load in (load_policy, DeltacoPolicy.from_pretrained):
        with pytest.raises(ProcessorFileError, match=message) as error:
            load(copy)
        assert str(path) in str(error.value)
    assert not (copy / "ran").exists()


@pytest.mark.parametrize("text", ["", "[]", "no JSON"])
def test_a_processors_file_that_is_none_is_named(copy, text):
    (copy / "policy_preprocessor.json").write_text(text)
    with pytest.raises(ProcessorFileError, match="is no file of a processor"):
        load_policy(copy)


def test_only_a_file_that_the_hub_does_not_have_is_passed_over(monkeypatch):
    """LeRobot may find the network again a second later, and load what was not checked."""

    def fetch(error):
        def download(*_, **__):
            raise error

        monkeypatch.setattr("lerobot_deltaco.policy.processor_files.hf_hub_download", download)

    offline = "lerobot_deltaco.policy.processor_files.is_offline_mode"
    monkeypatch.setattr(offline, lambda: False)
    fetch(RemoteEntryNotFoundError("none", response=httpx.Response(404, request=httpx.Request("GET", "x:"))))
    check_processor_files("user/policy")
    fetch(LocalEntryNotFoundError("no network"))
    with pytest.raises(LocalEntryNotFoundError, match="no network"):
        check_processor_files("user/policy")
    check_processor_files("user/policy", local_files_only=True)
    monkeypatch.setattr(offline, lambda: True)
    check_processor_files("user/policy")


# What the policy knows of tasks


def edited(path, change):
    """Changes the tensors and the metadata of a safetensors file; `change` edits both in place."""
    tensors = load_file(path)
    with safe_open(path, framework="pt") as file:
        known = dict(file.metadata() or {})
    change(tensors, known)
    save_file({name: tensor.contiguous() for name, tensor in tensors.items()}, path, metadata=known)


def set_tensor(name, function):
    return lambda tensors, known: tensors.update({name: function(tensors[name])})


def add_tensor(name, tensor):
    return lambda tensors, known: tensors.update({name: tensor})


def set_known(name, value):
    return lambda tensors, known: known.update({name: value})


def drop_tensor(name):
    return lambda tensors, known: tensors.pop(name)


def drop_known(name):
    return lambda tensors, known: known.pop(name)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (drop_tensor("embeddings"), "the tensor `embeddings` is missing"),
        (drop_tensor("frames"), "need the tensor `frames`"),
        (drop_tensor("episodes"), "need the tensor `episodes`"),
        (drop_known("language_encoder"), "`language_encoder` must be one of"),
        (drop_known("instructions"), "`instructions` must be a list in JSON"),
        (drop_known("tasks"), "`tasks` must be a list in JSON"),
        (set_known("language_encoder", "mine"), "`language_encoder` must be one of"),
        (set_known("instructions", "not JSON"), "`instructions` must be a list in JSON"),
        (set_known("instructions", "{}"), "`instructions` must be a list of strings"),
        (set_known("instructions", "[1, 2]"), "`instructions` must be a list of strings"),
        (set_known("instructions", json.dumps(TASKS)), r"`embeddings` must be .* shape \(3, 384\)"),
        (set_known("instructions", json.dumps(TASKS[:1] * 2)), "an instruction twice"),
        (set_known("tasks", json.dumps(TASKS)), r"`episodes` must be .* shape \(3,\)"),
        (set_known("tasks", "null"), "`tasks` must be a list of strings"),
        (set_tensor("embeddings", lambda x: x.double()), "`embeddings` must be of the type float32"),
        (set_tensor("embeddings", lambda x: x[:, :7]), r"not float32 and \(2, 7\)"),
        (set_tensor("embeddings", lambda x: x * torch.nan), "unit vectors of finite numbers"),
        (set_tensor("embeddings", lambda x: 2 * x), "unit vectors of finite numbers"),
        (set_tensor("episodes", lambda x: x.float()), "`episodes` must be of the type int64"),
        (set_tensor("episodes", lambda x: x - 1), "different, and at least 0"),
        (set_tensor("episodes", lambda x: x * 0), "different, and at least 0"),
        (set_tensor("frames", lambda x: x.float()), "`frames` must be of the type uint8"),
        (set_tensor("frames", lambda x: x[:1]), r"`frames` must be .* shape \(2, 2, 3, 16, 16\)"),
        (set_tensor("frames", lambda x: x[:, :1]), r"shape \(n, 2 or more, 3, h, w\)"),
        (set_tensor("frames", lambda x: x[:, :, :1]), r"`frames` must be .* shape \(2, 2, 3, 16, 16\)"),
        (set_tensor("frames", lambda x: x[..., :8]), r"`frames` must be .* shape \(2, 2, 3, 16, 16\)"),
        (set_tensor("frames", lambda x: x.repeat(1, 2, 1, 1, 1)), r"`frames` must be .* \(2, 2, 3, 16, 16\)"),
        (add_tensor("grasp_states", torch.zeros(2)), r"`grasp_states` must have the shape \(n, state\)"),
        (add_tensor("grasp_states", torch.zeros(3, 4)), r"`grasp_states` must be .* shape \(2, 4\)"),
        (
            add_tensor("grasp_states", torch.zeros(2, 4).double()),
            "`grasp_states` must be of the type float32",
        ),
        (add_tensor("grasp_states", torch.full((2, 4), torch.inf)), "finite, or NaN where there is no grasp"),
        (add_tensor("grasp_states", torch.tensor([[torch.nan, 0]] * 2)), "finite, or NaN where there is"),
        (
            add_tensor("grasp_states", torch.zeros(2, 99)),
            r"`grasp_states` must be .* not float32 and \(2, 99\)",
        ),
    ],
)
def test_tasks_are_checked_whole_before_they_are_used(copy, change, message):
    path = copy / TASK_FILE
    edited(path, change)
    with pytest.raises(TaskFileError, match=message) as error:
        DeltacoPolicy.from_pretrained(copy)
    assert str(path) in str(error.value)


@pytest.mark.parametrize("damage", [lambda path: path.unlink(), lambda path: path.write_bytes(b"0" * 50)])
def test_a_missing_or_broken_file_of_tasks_is_named(copy, damage):
    damage(copy / TASK_FILE)
    with pytest.raises(TaskFileError, match=TASK_FILE):
        DeltacoPolicy.from_pretrained(copy)


def test_a_huge_episode_index_costs_no_memory(copy):
    path = copy / TASK_FILE
    edited(path, set_tensor("episodes", lambda x: x + 2**60))
    policy = DeltacoPolicy.from_pretrained(copy)
    assert policy.eval_demonstrations.episodes.tolist() == [2**60, 2**60 + 1]
    held = sum(buffer.nbytes for buffer in policy.eval_demonstrations.buffers())
    assert held < 2 * policy.eval_demonstrations.frames.nbytes


@pytest.mark.parametrize("episodes", [[3, 0, 7, 5], [0, 1, 2, 3], [2**60, 4, 1, 2**50]])
def test_rows_of_episodes_are_found_in_any_order(episodes):
    frames = torch.zeros(len(episodes), 2, 3, 4, 4, dtype=torch.uint8)
    demonstrations = DemonstrationSet(frames, ["a"] * len(episodes), episodes)
    asked = torch.tensor([*reversed(episodes), 6, 2**61])
    assert demonstrations.episode_rows(asked).tolist() == [3, 2, 1, 0, -1, -1]


def test_demonstrations_of_the_file_are_those_that_were_saved(checkpoint):
    contents = read_task_file(checkpoint / TASK_FILE)
    assert contents.demonstrations.tasks == TASKS[:N_DEMONSTRATIONS]
    assert contents.demonstrations.frames.shape == (N_DEMONSTRATIONS, 2, 3, 16, 16)
    assert set(contents.instructions) == set(TASKS[:N_DEMONSTRATIONS])


# Weights


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (drop_tensor("model.raw_log_std"), r"lacks \['model.raw_log_std'\]"),
        (drop_tensor("step"), r"lacks \['step'\]"),
        (lambda tensors, known: tensors.update(extra=torch.zeros(1)), r"has the unknown \['extra'\]"),
        (
            set_tensor("model.raw_log_std", lambda x: x * torch.inf),
            "raw_log_std has numbers that are not finite",
        ),
    ],
)
def test_every_weight_must_be_there_and_finite(copy, change, message):
    edited(copy / "model.safetensors", change)
    with pytest.raises(ValueError, match=message):
        DeltacoPolicy.from_pretrained(copy)


# An instruction


@pytest.mark.parametrize("task", [None, [], "wave", [3], functools.reduce])
def test_an_action_needs_an_instruction(checkpoint, task):
    policy, before, _ = load_policy(checkpoint)
    batch = before(
        {
            "observation.images.top": torch.zeros(1, 3, 20, 28),
            "observation.images.wrist": torch.zeros(1, 3, 24, 24),
            "observation.state": torch.zeros(1, 2),
            "task": ["wave"],
        }
    )
    del batch["task"]
    if task is not None:
        batch["task"] = task
    with pytest.raises(ValueError, match=r"`task` must be a list.*`task_description`.*--task"):
        policy.select_action(batch)


def test_lerobot_finds_the_class_of_the_configuration():
    annotation = DeltacoPolicy.__init__.__annotations__["config"]
    assert annotation is DeltacoPolicy.config_class
