"""The policy on a small dataset unlike the benchmark's: two cameras, a gripper in the middle."""

import copy
import itertools
import sys
import threading

import pytest
import torch
from lerobot.configs import NormalizationMode
from small_policies import (
    LENGTH,
    TASKS,
    batch_of,
    fake_encoder,
    observation,
    write_dataset,
)

from lerobot_deltaco.commands import embed as embed_command
from lerobot_deltaco.configuration_deltaco import DeltacoConfig
from lerobot_deltaco.modeling_deltaco import DeltacoPolicy
from lerobot_deltaco.policy.actions import join_action
from lerobot_deltaco.policy.demonstrations import DemonstrationSet
from lerobot_deltaco.policy.options import ENCODERS_OF_OPTIONS
from lerobot_deltaco.policy.step_generator import step_generator
from lerobot_deltaco.policy.task_file import TaskFileError
from lerobot_deltaco.policy.training_episodes import training_episodes

pytestmark = pytest.mark.usefixtures("fake_language")


# What is not the paper's, together.
OURS = {"demo_encoder": "attention", "motion_modes": 3}


# Configuration


def test_the_defaults_are_the_papers():
    config = DeltacoConfig(device="cpu")
    assert config.conditioning == ("demo", "language", "contrastive")
    assert (config.language_encoder, config.embedding_dim) == ("paraphrase-MiniLM-L3-v2", 384)
    assert (config.demo_encoder, config.demo_rows, config.demo_columns) == ("cnn", 1, 2)
    assert (config.image_size, config.crop_padding, config.backbone) == (48, 4, "paper")
    assert config.motion_modes == 1
    assert (config.gripper_weight, config.encoder_loss_weight, config.temperature) == (30, 10, 0.1)
    optimizer = config.get_optimizer_preset()
    assert (optimizer.type, optimizer.lr, optimizer.weight_decay, optimizer.grad_clip_norm) == (
        "deltaco_fused_adamw",
        3e-4,
        0,
        0,
    )
    assert config.get_scheduler_preset() is None
    assert config.normalization_mapping == {
        "VISUAL": NormalizationMode.IDENTITY,
        "STATE": NormalizationMode.MEAN_STD,
        "ACTION": NormalizationMode.MIN_MAX,
    }
    assert (config.push_to_hub, config.dtype) == (False, "float32")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "best"}, "`method` must be one of deltaco, language_only"),
        ({"film": "demonstration"}, "`film` must be one of none, demo"),
        ({"encoder_loss": "triplet"}, "`encoder_loss` must be one of contrastive"),
        ({"language_encoder": "clip"}, "`language_encoder` must be one of paraphrase-MiniLM-L3-v2"),
        ({"backbone": "vit"}, "`backbone` must be one of paper, strided"),
        ({"dtype": "int8"}, "`dtype` must be one of float32, bfloat16"),
        ({"demo_columns": 1}, "at least 2. Got 1"),
        ({"motion_modes": 0}, "`motion_modes` must be at least 1"),
        ({"demos_per_task": 1}, "`demos_per_task` cannot be 1"),
        ({"temperature": 0.0}, "`temperature` must be at least 0.001"),
        ({"n_demonstrations": 5}, "it is for `demo_encoder=correspondence`"),
        ({"normalization_mapping": {"VISUAL": NormalizationMode.MEAN_STD}}, "must be IDENTITY for VISUAL"),
        ({"normalization_mapping": {"ACTION": NormalizationMode.MEAN_STD}}, "MIN_MAX or IDENTITY for ACTION"),
        ({"gripper": "left"}, "`gripper` must be 'auto', 'none' or an index"),
        ({"film": "none", "concat": "none"}, "would get no task"),
        ({"method": "language_only", "encoder_loss": "contrastive"}, "no demonstration is used"),
        ({"method": "mcil", "film": "demo"}, "`film` cannot be changed"),
    ],
)
def test_impossible_configurations_say_what_is_valid(options, message):
    with pytest.raises(ValueError, match=message):
        DeltacoConfig(device="cpu", **options)


# For each option that has an effect with some encoders alone: a value, and another encoder.
WITHOUT_EFFECT = {
    "vision_encoder": ("dinov2-small", "attention"),
    "vision_encoder_weights": ("r3m.pt", "cnn"),
    "vision_image_size": (64, "cnn"),
    "vision_input": ("authors", "cnn"),
    "demo_variants": (2, "cnn"),
    "demo_features_dir": ("features", "correspondence"),
    "demo_head": ([8], "cnn"),
    "demo_crop": ("frame", "attention"),
    "demo_frames_between": ("any", "correspondence"),
    "demos_per_task": (2, "correspondence"),
    "n_demonstrations": (2, "attention"),
    "goal_image_size": (96, "cnn"),
    "pretrained_matching": (True, "cnn"),
    "goal_noise": (0.1, "cnn"),
    "grasp_depth": (False, "cnn"),
    "depth_margin": (0.5, "cnn"),
    "depth_noise": (0.2, "cnn"),
    "locator_share": (0.5, "attention"),
    "recolor_share": (0.5, "cnn"),
    "color_blind_tasks": ("shaped", "cnn"),
}


@pytest.mark.parametrize("name", ENCODERS_OF_OPTIONS)
def test_an_option_without_effect_is_refused(name):
    value, encoder = WITHOUT_EFFECT[name]
    with pytest.raises(ValueError, match=f"`{name}` has no effect with `demo_encoder={encoder}`"):
        DeltacoConfig(device="cpu", demo_encoder=encoder, **{name: value})
    # A configuration file names every field, so that defaults are no mistake.
    DeltacoConfig(device="cpu", demo_encoder=encoder, **{name: getattr(DeltacoConfig, name)})


@pytest.mark.parametrize("mapping", [{"ACTION": NormalizationMode.IDENTITY}, {}], ids=["named", "left out"])
def test_actions_that_are_not_scaled_must_be_in_the_networks_range(make, mapping):
    with pytest.raises(ValueError, match=r"actions are in .*1\d\d.*, but the policy predicts them in -1..1"):
        make(normalization_mapping=mapping)


@pytest.mark.parametrize(
    ("gripper", "index"), [("auto", 1), ("2", 2), ("none", None)], ids=["by name", "by index", "none"]
)
def test_the_gripper_is_found_or_given(make, gripper, index):
    assert make(gripper=gripper)[0].config.gripper_index == index


def test_a_gripper_that_is_not_there_is_refused(make):
    with pytest.raises(ValueError, match="only the dimensions 0 to 2"):
        make(gripper="3")


# Training


def test_the_draws_of_a_step_are_a_function_of_seed_step_and_rank():
    numbers = list(itertools.product(range(3), repeat=3))
    first, again = (
        [tuple(torch.rand(4, generator=step_generator(*each)).tolist()) for each in numbers] for _ in range(2)
    )
    assert first == again
    assert len(set(first)) == len(numbers)


def test_the_loss_is_the_papers_sum(make, dataset):
    policy, before, _ = make()
    loss, logged = policy(before(batch_of(dataset, [0, 7, 20])))
    expected = logged["motion_nll"] + 30 * logged["gripper_loss"] + 10 * logged["encoder_loss"]
    assert loss.item() == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("options", [pytest.param({}, marks=pytest.mark.slow), OURS], ids=str)
def test_one_batch_can_be_overfitted(make, dataset, options):
    policy, before, _ = make(crop_padding=0, **options)
    batch = before(batch_of(dataset, [1, 6, 11, 16, 21, 26]))
    optimizer = torch.optim.Adam(policy.get_optim_params(), lr=1e-3)
    first = policy(batch)[1]
    for _ in range(150):
        loss, logged = policy(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert logged["motion_mse"] < 0.1 * first["motion_mse"]
    assert logged["gripper_accuracy"] == 1


def test_a_demonstration_is_another_episode_of_the_task(make, dataset):
    policy, before, _ = make()
    policy(before(batch_of(dataset, [0])))
    demonstrations, generator = policy.train_demonstrations, torch.Generator().manual_seed(0)
    drawn = {}
    for episode in range(6):
        rows = demonstrations.sample_other_episodes(torch.full((200,), episode), generator)
        drawn[episode] = set(demonstrations.episodes[rows].tolist())
    # Episodes 0 to 2 stack, 3 and 4 pour; the only one that waves demonstrates itself.
    assert drawn == {0: {1, 2}, 1: {0, 2}, 2: {0, 1}, 3: {4}, 4: {3}, 5: {5}}


def test_samples_of_a_task_can_share_demonstrations():
    tasks = ["a"] * 5 + ["b"] * 2 + ["c"] + ["d"] * 3
    demonstrations = DemonstrationSet(torch.zeros(11, 2, 3, 4, 4, dtype=torch.uint8), tasks, range(100, 111))
    episodes = torch.tensor([107, 100, 104, 101, 105, 106, 101, 102, 103, 105])
    column = torch.tensor([2, 0, 0, 0, 1, 1, 0, 0, 0, 1])
    generator = torch.Generator().manual_seed(0)
    used = set()
    for _ in range(50):
        rows, which = demonstrations.sample_shared_episodes(episodes, column, 3, 2, generator)
        assert [tasks[row] for row in rows] == ["a", "a", "b", "b", "c", "c"]
        assert rows[0] != rows[1]
        assert rows[2] != rows[3]
        demonstration = 100 + rows[which]
        own = demonstration == episodes
        assert own.tolist() == [True] + 9 * [False]  # the only episode of c demonstrates itself
        assert [tasks[row] for row in rows[which]] == [tasks[episode - 100] for episode in episodes]
        used.update(zip(episodes.tolist(), demonstration.tolist(), strict=True))
    assert {demonstration for own, demonstration in used if own == 102} == {100, 101, 103, 104}
    for _ in range(20):  # more than some tasks have
        rows, which = demonstrations.sample_shared_episodes(episodes, column, 3, 3, generator)
        assert (100 + rows[which] == episodes).tolist() == [True] + 9 * [False]
    with pytest.raises(ValueError, match="Episode 500 is trained on"):
        demonstrations.sample_shared_episodes(torch.tensor([500]), torch.tensor([0]), 1, 2, generator)


def test_shared_demonstrations_are_encoded_once(make, dataset, monkeypatch):
    policy, before, _ = make(demos_per_task=2)
    encoded = []
    monkeypatch.setattr(
        policy._embedder,
        "embed_demonstrations",
        lambda demonstrations, rows, *_: encoded.append(rows) or torch.zeros(len(rows), 384),
    )
    policy(before(batch_of(dataset, [0, 1, 2, 3, 5, 6, 7, 15, 16, 20])))
    assert len(encoded[0]) == 4
    policy.eval()
    policy(before(batch_of(dataset, [0, 1, 2])))
    assert len(encoded[1]) == 3


def test_demonstrations_are_the_first_and_the_last_frame(make, dataset):
    policy, before, _ = make()
    policy(before(batch_of(dataset, [0])))
    frames = policy.train_demonstrations.sample_frames(torch.arange(6), 2, torch.Generator())
    shades = (frames[:, :, 0, 0, 0] * 255).round().int().tolist()
    assert shades == [[10 * episode, 10 * episode + LENGTH - 1] for episode in range(6)]


def test_draws_are_a_function_of_the_seed_and_the_step(make, dataset):
    policy, before, _ = make(method="demo_only")
    batch = before(batch_of(dataset, list(range(15))))
    twin = copy.deepcopy(policy)
    losses = [policy(batch)[0].item() for _ in range(3)]
    torch.manual_seed(99)
    twin.load_state_dict(twin.state_dict())
    assert [twin(batch)[0].item() for _ in range(3)] == losses
    assert len(set(losses)) == 3
    assert int(policy.step) == 3


def test_evaluation_losses_do_not_advance_the_draws(make, dataset):
    policy, before, _ = make()
    batch = before(batch_of(dataset, [0, 7]))
    policy(batch)
    policy.eval()
    assert policy(batch)[0].item() == policy(batch)[0].item()
    assert int(policy.step) == 1


def test_only_the_episodes_that_are_trained_on_demonstrate(dataset, monkeypatch):
    monkeypatch.setattr("sys.argv", ["lerobot-train"])
    assert training_episodes(dataset.meta) == [0, 1, 2, 3, 4, 5]
    monkeypatch.setattr(
        "sys.argv", ["lerobot-train", "--dataset.episodes=[0,1,2,3]", "--dataset.eval_split=0.3"]
    )
    assert training_episodes(dataset.meta) == [0, 1]


def test_instructions_are_embedded_once(make, dataset):
    policy, before, _ = make()
    for _ in range(2):
        policy(before(batch_of(dataset, [0, 3, 7, 20])))
    assert fake_encoder.calls == [["stack the cups", "pour the tea"]]
    assert not any("instruction" in name for name, _ in policy.named_parameters())


def test_instructions_can_be_embedded_elsewhere(make, dataset, tmp_path):
    (tmp_path / "sentences.txt").write_text("\n".join([*TASKS, "", TASKS[0]]))
    file = tmp_path / "new" / "embeddings.safetensors"
    options = ["--tasks", "4,14", "--instructions", str(tmp_path / "sentences.txt"), "--out", str(file)]
    embed_command.main(options)
    fake_encoder.calls = []
    policy, before, _ = make(instruction_embeddings=str(file))
    policy(before(batch_of(dataset, [0, 15, 25])))
    assert fake_encoder.calls == []
    assert len(policy.instructions.rows) == 2 + len(TASKS)
    computed, _, _ = make()
    for policies in (policy, computed):
        policies.instructions.add(TASKS)
    assert torch.equal(policy.instructions(TASKS, "cpu"), computed.instructions(TASKS, "cpu"))
    policy.save_pretrained(tmp_path / "policy")
    assert str(tmp_path) not in (tmp_path / "policy" / "config.json").read_text()

    with pytest.raises(ValueError, match="made with the language encoder paraphrase-MiniLM-L3-v2"):
        make(instruction_embeddings=str(file), language_encoder="all-MiniLM-L6-v2")
    for wrong in (tmp_path / "missing", tmp_path / "sentences.txt", tmp_path / "policy/model.safetensors"):
        with pytest.raises(
            TaskFileError, match="cannot be used: .*It must be a checkpoint's tasks.safetensors"
        ):
            make(instruction_embeddings=str(wrong))


@pytest.mark.parametrize("options", [{}, OURS], ids=str)
def test_bfloat16_trains(make, dataset, options):
    policy, before, _ = make(dtype="bfloat16", **options)
    batch = before(batch_of(dataset, [0, 7]))
    with torch.autocast("cpu", torch.bfloat16):
        policy(batch)[0].backward()
    assert policy.eval().select_action(batch).dtype == torch.float32


# Evaluation


@pytest.fixture
def demos(tmp_path):
    """One demonstration of each task, and of one that is not trained on."""
    return write_dataset(tmp_path / "demos", [*TASKS, "juggle"])


def test_a_novel_task_is_served_by_its_demonstration(make, dataset, demos):
    policy, before, after = make(demo_repo_id="test/foreign", demo_root=str(demos.root))
    policy.eval()
    action = after(policy.select_action(before(observation(dataset, ["juggle", "wave"]))))
    assert action.shape == (2, 3)
    low, high = (torch.as_tensor(dataset.meta.stats["action"][name]) for name in ("min", "max"))
    assert (action[:, 1] >= low[1]).all()
    assert (action[:, 1] <= high[1]).all()


def test_a_task_without_a_demonstration_is_named(make, dataset, demos):
    policy, before, _ = make(demo_repo_id="test/foreign", demo_root=str(demos.root))
    policy.eval()
    with pytest.raises(ValueError, match="no demonstration of the task 'sing'.*of 4 tasks.*demo_episode"):
        policy.select_action(before(observation(dataset, ["sing"])))


def test_a_named_episode_serves_any_words(make, dataset, demos):
    options = {"demo_repo_id": "test/foreign", "demo_root": str(demos.root), "method": "demo_only"}
    policy, before, _ = make(**options)
    policy.eval()
    expected = policy.select_action(before(observation(dataset, ["juggle"])))
    policy.config.demo_episode = 3
    policy.reset()
    torch.testing.assert_close(policy.select_action(before(observation(dataset, ["keep them up"]))), expected)


def test_both_encoders_run_once_an_episode(make, dataset, monkeypatch):
    policy, before, _ = make()
    batch = before(batch_of(dataset, [0, 20]))
    policy(batch)
    policy.eval()
    calls = []
    forward = policy.demo_encoder.forward
    monkeypatch.setattr(policy.demo_encoder, "forward", lambda x: calls.append(1) or forward(x))
    for n_episodes in (1, 2):
        policy.reset()
        for _ in range(4):
            policy.select_action(batch)
        assert len(calls) == n_episodes


@pytest.mark.parametrize("options", [{}, OURS], ids=str)
def test_what_acts_is_what_was_trained_last(make, dataset, options):
    policy, before, _ = make(optimizer_lr=0.01, **options)
    batch, seen = before(batch_of(dataset, [0, 1, 7, 8])), before(observation(dataset, [TASKS[0]]))
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    acted = []
    for _ in range(3):
        policy.train()
        policy(batch)[0].backward()
        optimizer.step()
        policy.eval()
        policy.begin_evaluation()
        policy.reset()
        acted.append(policy.select_action(seen))
        conditioning = policy._episode_tasks._conditioning[threading.get_ident()]
        concatenated = policy._concatenated(seen, conditioning.concat)
        motion, gripper = policy.model(policy._images(seen), conditioning.film, concatenated)
        expected = join_action(motion.mean, gripper.sigmoid(), policy.config.gripper_index)
        torch.testing.assert_close(acted[-1], expected, atol=1e-5, rtol=1e-4)
    assert not torch.allclose(acted[1], acted[2], atol=1e-4)


@pytest.fixture
def eager_threads():
    """Threads that take turns as often as they can."""
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(interval)


def test_threads_share_the_steps_of_a_processor_but_not_what_they_process(make, dataset):
    _, before, _ = make()
    processed = before.to_transition(before(observation(dataset, [TASKS[0]])))
    keeps_it = [step for step in before.steps if step._current_transition is not None]
    assert keeps_it
    other = threading.Thread(target=before, args=(observation(dataset, [TASKS[1]]),))
    other.start()
    other.join()
    for step in keeps_it:
        assert step.transition["complementary_data"]["task"] == processed["complementary_data"]["task"]


@pytest.mark.usefixtures("eager_threads")
def test_threads_do_not_mix_their_tasks_up(make, dataset):
    policy, before, _ = make()
    policy(before(batch_of(dataset, [0])))
    policy.eval()
    expected, observed = {}, {}
    for task in TASKS[:2]:
        policy.reset()
        expected[task] = policy.select_action(before(observation(dataset, [task])))
    barrier = threading.Barrier(2)

    def act(task):
        policy.reset()
        for _ in range(5):
            barrier.wait()
            observed.setdefault(task, []).append(policy.select_action(before(observation(dataset, [task]))))

    threads = [threading.Thread(target=act, args=(task,)) for task in TASKS[:2]]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert set(observed) == set(expected)
    # The tasks' demonstrations take turns; the one of the first episode is among them.
    for actions in observed.values():
        assert all(torch.equal(action, actions[0]) for action in actions)
    assert not torch.equal(observed[TASKS[0]][0], observed[TASKS[1]][0])


def test_mcils_trials_use_language_and_demonstration_in_turn(make, dataset):
    policy, before, _ = make(method="mcil")
    policy(before(batch_of(dataset, [20])))
    policy.eval()
    actions = policy.select_action(before(observation(dataset, ["pour the tea"] * 4)))
    assert not torch.allclose(actions[0], actions[1], atol=1e-6)
    torch.testing.assert_close(actions[0], actions[2])


# Checkpoints


@pytest.mark.parametrize("options", [{}, OURS], ids=str)
def test_a_checkpoint_is_complete_and_equal_to_the_bit(make, dataset, demos, tmp_path, options):
    policy, before, _ = make(demo_repo_id="test/foreign", demo_root=str(demos.root), **options)
    policy(before(batch_of(dataset, [0, 7])))
    policy.eval()
    batch = before(observation(dataset, ["juggle", "wave"]))
    expected = policy.select_action(batch)
    policy.save_pretrained(tmp_path / "policy")
    assert {path.suffix for path in (tmp_path / "policy").iterdir()} == {".json", ".safetensors"}
    assert str(demos.root) not in (tmp_path / "policy" / "config.json").read_text()

    fake_encoder.calls = []
    loaded = DeltacoPolicy.from_pretrained(tmp_path / "policy")
    assert torch.equal(loaded.select_action(batch), expected)
    assert fake_encoder.calls == []
    assert int(loaded.step) == 1
    for (name, value), (other, twin) in zip(
        policy.state_dict().items(), loaded.state_dict().items(), strict=True
    ):
        assert name == other
        assert torch.equal(value, twin)


@pytest.mark.parametrize("other", ["all-MiniLM-L6-v2", "all-distilroberta-v1"], ids=["as large", "larger"])
def test_another_language_encoder_is_refused_at_evaluation(make, tmp_path, other):
    policy, _, _ = make()
    policy.save_pretrained(tmp_path)
    config = copy.deepcopy(policy.config)
    config.language_encoder = other
    with pytest.raises(ValueError, match="made with the language encoder paraphrase-MiniLM-L3-v2"):
        DeltacoPolicy.from_pretrained(tmp_path, config=config)


def test_a_one_hot_policy_remembers_its_vocabulary(make, dataset, tmp_path):
    policy, before, _ = make(method="one_hot")
    policy.save_pretrained(tmp_path)
    loaded = DeltacoPolicy.from_pretrained(tmp_path)
    assert loaded.config.one_hot_tasks == sorted(TASKS, key=TASKS.index)
    with pytest.raises(ValueError, match="does not know the task 'juggle'. It knows the 3 tasks"):
        loaded.select_action(before(observation(dataset, ["juggle"])))
