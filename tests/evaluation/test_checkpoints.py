"""Checkpoints: saved and loaded to the bit, checked when they are loaded, pushed to the Hub and described."""

import copy
import inspect
import json
import shutil

import pytest
import torch
from fake_hub import USER, FakeHub
from huggingface_hub import ModelCard
from lerobot.configs import PreTrainedConfig
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.policies import PreTrainedPolicy, make_policy, make_pre_post_processors
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from small_policies import (
    REPO_ID,
    TASKS,
    batch_of,
    demos_of,
    fake_encoder,
    observation,
    small_policy,
    use_fake_encoder,
    write_dataset,
)

from lerobot_deltaco.errors import UserError
from lerobot_deltaco.policies.base.configuration import SOURCES
from lerobot_deltaco.policies.base.language import LANGUAGE_ENCODERS
from lerobot_deltaco.policies.base.modeling import TrainingDivergedError
from lerobot_deltaco.policies.base.task_bank import TASK_BANK
from lerobot_deltaco.policies.deltaco.configuration_deltaco import METHODS
from lerobot_deltaco.policies.deltaco.modeling_deltaco import DeltacoPolicy

pytestmark = pytest.mark.usefixtures("fake_language")

POLICY_ID = f"{USER}/policy"
N_DEMONSTRATIONS = 2
WEIGHTS = {"config.json", "model.safetensors", TASK_BANK}


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """A checkpoint with two demonstrations, and the action of its policy for an observation."""
    with pytest.MonkeyPatch.context() as patch:
        use_fake_encoder(patch)
        folder = tmp_path_factory.mktemp("checkpoint")
        dataset = write_dataset(folder / "data", TASKS[:N_DEMONSTRATIONS])
        policy, before, after = small_policy(dataset, **demos_of(dataset))
        policy(before(batch_of(dataset, [0, 5])))
        policy.demonstrations.pick_states = torch.tensor([[0.0, 1.0], [torch.nan] * 2])
        policy.save_pretrained(folder / "policy")
        assert {path.name for path in (folder / "policy").iterdir()} == WEIGHTS
        assert policy.config.demo_root not in (folder / "policy" / "config.json").read_text()
        for processor in (before, after):
            processor.save_pretrained(folder / "policy")
        seen = before(observation(dataset, TASKS[:N_DEMONSTRATIONS]))
        return folder / "policy", seen, policy.eval().select_action(seen)


@pytest.fixture
def checkpoint(saved, tmp_path):
    """A copy of the checkpoint, to be damaged."""
    return shutil.copytree(saved[0], tmp_path / "copy")


def edit(path, change):
    """Edits the tensors and the metadata of a safetensors file; `change` gets both."""
    tensors = load_file(path)
    with safe_open(path, framework="pt") as file:
        known = dict(file.metadata() or {})
    change(tensors, known)
    save_file({name: tensor.contiguous() for name, tensor in tensors.items()}, path, metadata=known)


def test_checkpoint_is_complete_and_names_no_sources(saved):
    folder, seen, expected = saved
    loaded = DeltacoPolicy.from_pretrained(folder)
    assert not any(getattr(loaded.config, name, None) for name in SOURCES)
    assert torch.equal(loaded.select_action(seen), expected)
    assert int(loaded.step) == 1
    assert fake_encoder.calls == []
    assert loaded.demonstrations.tasks == TASKS[:N_DEMONSTRATIONS]


def test_configuration_keeps_its_sources_when_it_is_saved(make, dataset, tmp_path):
    policy, _, _ = make(**demos_of(dataset))
    config = copy.deepcopy(policy.config)
    policy.save_pretrained(tmp_path)
    assert policy.config == config
    loaded = PreTrainedConfig.from_pretrained(tmp_path, cli_overrides=["--demo_episode=2", "--seed=7"])
    assert (loaded.demo_episode, loaded.seed, loaded.demo_repo_id) == (2, 7, None)


def test_demonstrations_of_the_command_line_come_before_those_of_the_checkpoint(saved, dataset):
    config = PreTrainedConfig.from_pretrained(saved[0])
    config.demo_repo_id, config.demo_root = REPO_ID, str(dataset.root)
    loaded = DeltacoPolicy.from_pretrained(saved[0], config=config)
    assert set(loaded.demonstrations.tasks) == set(TASKS)


def test_equal_policies_are_equal_files(saved, tmp_path):
    DeltacoPolicy.from_pretrained(saved[0])._save_pretrained(tmp_path)
    if "state_dict" in inspect.signature(PreTrainedPolicy._save_pretrained).parameters:  # LeRobot 0.6.1
        DeltacoPolicy.from_pretrained(saved[0])._save_pretrained(tmp_path, state_dict=None)
    for name in WEIGHTS - {"config.json"}:
        assert (tmp_path / name).read_bytes() == (saved[0] / name).read_bytes()


def edit_bank(change):
    return lambda folder: edit(folder / TASK_BANK, change)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (edit_bank(lambda tensors, _: tensors.pop("episodes")), "episodes"),
        (edit_bank(lambda _, known: known.update(deltaco_tasks="[" * 100_000)), "maximum recursion depth"),
        (edit_bank(lambda _, known: known.clear()), "deltaco_tasks"),
        (lambda folder: (folder / TASK_BANK).unlink(), "No such file"),
        (lambda folder: (folder / TASK_BANK).write_bytes(b"no tensors at all"), "header"),
    ],
)
def test_a_damaged_task_bank_is_an_error(checkpoint, change, message):
    change(checkpoint)
    message = f"(?s){TASK_BANK} cannot be used: .*{message}.* all files of the checkpoint again"
    with pytest.raises(UserError, match=message):
        DeltacoPolicy.from_pretrained(checkpoint)


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("image_size=32", "`image_size` 16, and cannot be used with 32"),
        ("demo_rows=2", "`demo_rows` 1, and cannot be used with 2"),
        ("gripper=0", "`gripper` '1', and cannot be used with '0'"),
        ("gripper_closed=high", "`gripper_closed` 'low', and cannot be used with 'high'"),
        ("language_encoder=all-MiniLM-L6-v2", "`language_encoder` 'paraphrase-MiniLM-L3-v2', and cannot"),
    ],
)
def test_an_option_that_was_trained_cannot_be_changed(checkpoint, option, message):
    config = PreTrainedConfig.from_pretrained(checkpoint, cli_overrides=[f"--{option}"])
    with pytest.raises(UserError, match=message):
        DeltacoPolicy.from_pretrained(checkpoint, config=config)


def test_training_continues_on_other_data_than_that_of_its_checkpoint(checkpoint, tmp_path):
    """States are normalized by the new dataset's statistics, and so are those of the new checkpoint."""
    dataset = write_dataset(tmp_path / "data", [*TASKS, *TASKS])
    edit(checkpoint / "model.safetensors", lambda tensors, _: tensors["state_limits.scale"].fill_(0.5))
    config = PreTrainedConfig.from_pretrained(checkpoint)
    config.pretrained_path = checkpoint
    policy = make_policy(config, ds_meta=dataset.meta)
    assert policy.state_limits.scale.tolist() == [1.0, 1.0]
    policy.save_pretrained(tmp_path / "new")
    for processor in make_pre_post_processors(config, dataset_stats=dataset.meta.stats):
        processor.save_pretrained(tmp_path / "new")
    DeltacoPolicy.from_pretrained(tmp_path / "new")


def test_weights_that_do_not_fit_are_an_error(checkpoint):
    edit(checkpoint / "model.safetensors", lambda tensors, _: tensors.pop("policy_network.raw_log_std"))
    with pytest.raises(ValueError, match="not have the weights of this policy: .*raw_log_std.*config.js"):
        DeltacoPolicy.from_pretrained(checkpoint)


def test_weights_that_are_not_finite_are_neither_loaded_nor_saved(checkpoint, make, tmp_path):
    edit(
        checkpoint / "model.safetensors",
        lambda tensors, _: tensors["policy_network.raw_log_std"].fill_(torch.nan),
    )
    with pytest.raises(ValueError, match="is damaged: the weight policy_network.raw_log_std has numbers"):
        DeltacoPolicy.from_pretrained(checkpoint)
    policy, _, _ = make()
    with torch.no_grad():
        policy.policy_network.raw_log_std.fill_(torch.inf)
    with pytest.raises(
        TrainingDivergedError, match="weight policy_network.raw_log_std is not finite, and no"
    ):
        policy.save_pretrained(tmp_path / "new")
    assert not (tmp_path / "new" / "model.safetensors").exists()


def test_one_hot_policy_remembers_its_tasks(make, dataset, tmp_path):
    policy, before, _ = make(method="one_hot")
    policy.save_pretrained(tmp_path)
    loaded = DeltacoPolicy.from_pretrained(tmp_path)
    assert loaded.config.one_hot_tasks == TASKS
    with pytest.raises(ValueError, match="does not know the task 'juggle'. It knows the 3 tasks .*'stack"):
        loaded.select_action(before(observation(dataset, ["juggle"])))


def card_of(dataset, policy_type="deltaco", train_config=None, **options):
    policy, _, _ = small_policy(dataset, policy_type, prepare=False, repo_id=POLICY_ID, **options)
    described = policy.config.type, policy.config.license, policy.config.tags
    return policy.generate_model_card(REPO_ID, *described, train_config, dataset.meta)


@pytest.mark.parametrize(
    ("policy_type", "options"),
    [*(("deltaco", {"method": method}) for method in METHODS), ("deltaco_match", {})],
)
def test_every_kind_of_policy_has_a_card(dataset, policy_type, options):
    card = card_of(dataset, policy_type, **options)
    name = options.get("method", "both")
    assert f"# {policy_type}, trained on {REPO_ID}\n" in card.text
    assert "3 tasks" in card.text
    if policy_type == "deltaco":
        assert f"| method | {name} |".replace("_", r"\_") in card.text
    takes_demonstrations = name in ("deltaco", "demo_only", "bc_z", "mcil", "both")
    assert ("--policy.demo_repo_id" in card.text) == takes_demonstrations
    assert "number 1 is the gripper, which small values close" in card.text
    assert str(dataset.root) not in card.text
    assert "None" not in card.text


def test_card_names_options_demonstrations_and_training(dataset):
    train_config = TrainPipelineConfig(DatasetConfig(REPO_ID), steps=12_345, batch_size=24, seed=77)
    options = {"license": "mit", "tags": ["cups", "lerobot"], "shift_padding": 2, **demos_of(dataset)}
    card = card_of(dataset, train_config=train_config, **options)
    for row in ("| steps | 12345 |", "| batch\\_size | 24 |", "| shift\\_padding | 2 |"):
        assert row.replace("\\_", "_") in card.text.replace("\\_", "_")
    assert 'the checkpoint has some for 3 tasks, such as "stack the cups"' in card.text
    assert "| `observation.images.top` | (3, 20, 28) |" in card.text
    assert LANGUAGE_ENCODERS["paraphrase-MiniLM-L3-v2"].repo_id in card.text
    assert "@inproceedings{yu2023deltaco" in card.text
    data = ModelCard(str(card)).data
    assert (data.library_name, data.pipeline_tag, data.license) == ("lerobot", "robotics", "mit")
    assert (data.datasets, data.model_name) == ([REPO_ID], "deltaco")
    assert {"lerobot", "robotics", "deltaco", "cups"} <= set(data.tags)
    assert len(data.tags) == len(set(data.tags))


def test_pushed_policy_is_fetched_by_its_id(dataset, tmp_path, monkeypatch):
    demos = write_dataset(tmp_path / "demos", [*TASKS, "juggle"])
    policy, before, after = small_policy(dataset, repo_id=POLICY_ID, push_to_hub=True, **demos_of(demos))
    policy(before(batch_of(dataset, [0, 7])))
    seen = observation(dataset, ["juggle", "wave"])
    expected = after(policy.eval().select_action(before(seen)))
    with FakeHub() as hub:
        hub.connect(monkeypatch, tmp_path / "home")
        # As `lerobot-train` does at its end.
        config = TrainPipelineConfig(DatasetConfig(REPO_ID, root=str(dataset.root)), policy=policy.config)
        policy.push_model_to_hub(config, dataset_meta=dataset.meta)
        before.push_to_hub(POLICY_ID)
        after.push_to_hub(POLICY_ID)
        fake_encoder.calls = []
        fetched = type(policy).from_pretrained(POLICY_ID)
        before, after = make_pre_post_processors(fetched.config, POLICY_ID)
        files = hub.repos["model", POLICY_ID].files()
    assert torch.equal(after(fetched.select_action(before(seen))), expected)
    assert fake_encoder.calls == []
    assert fetched.demonstrations.tasks == policy.demonstrations.tasks
    processors = {"policy_preprocessor.json", "policy_postprocessor.json"}
    assert {*WEIGHTS, *processors, "train_config.json", "README.md"} <= set(files)
    for name in ("README.md", "config.json"):
        assert str(tmp_path) not in files[name].decode()
    assert fetched.config.demo_repo_id is json.loads(files["config.json"])["demo_root"] is None
