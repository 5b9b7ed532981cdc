"""Tasks of training and evaluation episodes: demonstrations, instructions, and when an episode begins."""

import copy
from collections import Counter
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from small_policies import (
    EPISODES,
    LENGTH,
    TASKS,
    batch_of,
    demos_of,
    fake_encoder,
    observation,
    write_dataset,
)

from lerobot_deltaco.data.demonstrations import (
    DemonstrationBank,
    kept_frames,
    sample_frames,
)
from lerobot_deltaco.data.training_data import DatasetEpisodes, DemonstrationFormat, read_demonstrations
from lerobot_deltaco.policies.base.instructions import Paraphrases

pytestmark = pytest.mark.usefixtures("fake_language")

STACK, POUR, WAVE = TASKS


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    """A demonstration of each task, and of one that is not trained on."""
    return write_dataset(tmp_path_factory.mktemp("data") / "demos", [*TASKS, "juggle"])


@pytest.fixture
def acting(make, demos):
    """Makes a policy that acts with the demonstrations of `demos`, and its preprocessor."""

    def acting(**options):
        policy, before, _ = make(**demos_of(demos), **options)
        return policy.eval(), before

    return acting


@pytest.fixture(scope="module")
def bank(dataset):
    return read_demonstrations(DatasetEpisodes(dataset), DemonstrationFormat("observation.images.top", 16))


def test_demonstrations_are_the_first_and_the_last_frame(bank):
    shades = bank.frames[:, :, 0, 0, 0].tolist()
    assert shades == [[10 * episode, 10 * episode + LENGTH - 1] for episode in range(6)]
    assert bank.tasks == EPISODES
    demonstration = bank.of_task(POUR)[1]
    assert (demonstration.task, demonstration.episode) == (POUR, 4)
    assert torch.equal(demonstration.frames, bank.frames[4])
    assert demonstration.pick_state is None


def test_training_draws_another_episode_of_the_task(bank):
    generator = torch.Generator().manual_seed(0)
    drawn = {}
    for episode, task in enumerate(EPISODES):
        rows = bank.draw_other_episodes(torch.full((100,), episode), [task] * 100, generator)
        drawn[episode] = set(bank.episodes[rows].tolist())
    # Episodes 0 to 2 stack, 3 and 4 pour; the only one that waves demonstrates itself.
    assert drawn == {0: {1, 2}, 1: {0, 2}, 2: {0, 1}, 3: {4}, 4: {3}, 5: {5}}


def test_episode_that_is_held_back_is_demonstrated_by_any_of_its_task(make, dataset):
    policy, before, _ = make(training_episodes=[4, 0, 1])  # in any order
    loss, _ = policy.eval()(before(batch_of(dataset, [2 * LENGTH, 3 * LENGTH])))
    assert torch.isfinite(loss)
    bank, generator = policy.training_data.demonstrations, torch.Generator().manual_seed(0)
    assert bank.episode_rows(torch.arange(6)).tolist() == [1, 2, -1, -1, 0, -1]
    rows = bank.draw_other_episodes(torch.full((100,), 2), [STACK] * 100, generator)
    assert set(bank.episodes[rows].tolist()) == {0, 1}
    with pytest.raises(ValueError, match="'wave' has no episode among .*Hold back fewer"):
        policy(before(batch_of(dataset, [5 * LENGTH])))


def test_frames_between_the_ends_are_drawn_from_equal_parts_of_the_time():
    frames = torch.arange(16, dtype=torch.uint8)[None, :, None, None, None].expand(500, 16, 3, 2, 2)

    def drawn(n_frames):
        images = sample_frames(frames, n_frames, torch.Generator().manual_seed(0))
        return [set(column.tolist()) for column in (images[:, :, 0, 0, 0] * 255).round().int().T]

    assert drawn(2) == [{0}, {15}]
    assert drawn(4) == [{0}, set(range(1, 8)), set(range(8, 15)), {15}]
    assert kept_frames(100, 104, 2).tolist() == [100, 104]
    assert len(kept_frames(100, 104, 4)) == 16
    assert len(kept_frames(100, 104, 20)) == 20


def test_demonstrations_that_do_not_exist_are_errors(bank, dataset, tmp_path, make):
    with pytest.raises(ValueError, match="no demonstration of the task 'sing'.*of 3 tasks, such as 'stac"):
        bank.of_task("sing")
    with pytest.raises(ValueError, match="`demo_episode` is 9.*They are the episodes 0, 1, 2, 3, 4, 5"):
        bank.of_episode(9)
    for episodes in ([6], [-1], []):
        with pytest.raises(ValueError, match="has the episodes 0 to 5. Got "):
            DatasetEpisodes(dataset, episodes)
    with pytest.raises(ValueError, match="no camera 'observation.image', only observation.images.top, obs"):
        read_demonstrations(DatasetEpisodes(dataset), DemonstrationFormat("observation.image", 16))
    with pytest.raises(FileNotFoundError, match="--policy.demo_root is .*/nothing, but there is no dataset"):
        make(demo_repo_id="me/demos", demo_root=str(tmp_path / "nothing"))


def test_draws_are_a_function_of_the_seed_and_the_step(make, dataset):
    policy, before, _ = make(method="demo_only")
    batch = before(batch_of(dataset, list(range(15))))
    twin, other_seed = copy.deepcopy(policy), copy.deepcopy(policy)
    other_seed.seed = 1
    losses = [policy(batch)[0].item() for _ in range(3)]
    torch.manual_seed(99)
    assert [twin(batch)[0].item() for _ in range(3)] == losses
    assert len({*losses, other_seed(batch)[0].item()}) == 4
    assert int(policy.step) == 3
    policy.eval()
    assert policy(batch)[0].item() == policy(batch)[0].item()
    assert int(policy.step) == 3


@pytest.mark.parametrize("options", [{}, {"demo_encoder": "attention", "num_mixture_components": 3}], ids=str)
def test_one_batch_can_be_overfitted(make, dataset, options):
    policy, before, _ = make(shift_padding=0, **options)
    batch = before(batch_of(dataset, [1, 6, 11, 16, 21, 26]))
    optimizer = torch.optim.Adam(policy.get_optim_params(), lr=2e-3)
    first = policy(batch)[1]
    for _ in range(50):
        loss, logged = policy(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert logged["action_mse"] < 0.2 * first["action_mse"]
    assert logged["gripper_accuracy"] == 1


SENTENCES = {STACK: ["pile up the cups", "cups on cups"], POUR: ["fill the mugs"], WAVE: ["say hello"]}


def test_paraphrases_are_drawn_evenly():
    paraphrases = Paraphrases(SENTENCES)
    draws = [paraphrases.draw([STACK] * 500, torch.Generator().manual_seed(3)) for _ in range(2)]
    assert draws[0] == draws[1]
    counts = Counter(draws[0])
    assert set(counts) == set(SENTENCES[STACK])
    assert min(counts.values()) > 200
    counts = Counter(Paraphrases(SENTENCES, 0.4).draw([STACK] * 1000, torch.Generator()))
    assert set(counts) == {STACK, *SENTENCES[STACK]}
    assert counts[STACK] == pytest.approx(600, abs=60)
    assert paraphrases.draw(["sing"], torch.Generator()) == ["sing"]


def test_training_embeds_paraphrases_of_its_tasks_alone(make, dataset, tmp_path):
    file = tmp_path / "sentences.csv"
    file.write_text(f"task,instruction\n{STACK},first\n{STACK},second\n{STACK},first\nother,third\n")
    policy, before, _ = make(paraphrases=str(file))
    assert policy.paraphrases.sentences[STACK] == ("first", "second")
    policy.paraphrases = Paraphrases(SENTENCES)
    losses = []
    for _ in range(2):
        policy.step.zero_()
        losses.append(policy(before(batch_of(dataset, list(range(30)))))[0].item())
    assert losses[0] == losses[1]
    embedded = [text for call in fake_encoder.calls for text in call]
    assert len(embedded) == len(set(embedded))  # each once
    assert set(embedded) == {text for own in SENTENCES.values() for text in own}
    assert set(policy.instructions.rows) == set(embedded)
    policy.save_pretrained(tmp_path)  # keeps the templates alone
    assert type(policy).from_pretrained(tmp_path).instructions.rows.keys() <= SENTENCES.keys()
    for text, message in (
        ("task_id,instruction\n4,first\n", "must have the columns task and instruction"),
        (f"task,instruction\n{STACK}\n", "line 2: expected a task and a sentence"),
        ("task,instruction\nother,third\n", "none of the dataset's tasks, such as 'stack the cups'"),
    ):
        file.write_text(text)
        with pytest.raises(ValueError, match=message):
            make(paraphrases=str(file))
    with pytest.raises(ValueError, match=r"Cannot read the paraphrases missing\.csv"):
        make(paraphrases="missing.csv")


def test_novel_task_is_served_by_its_banked_demonstration(acting, dataset):
    policy, before = acting()
    action = policy.select_action(before(observation(dataset, ["juggle", WAVE])))
    assert action.shape == (2, 3)
    policy.reset()
    demonstrations = [policy.demonstrations.of_task(task) for task in ("juggle", WAVE)]
    policy.set_tasks(["juggle", WAVE], demonstrations)
    assert torch.equal(policy.select_action(before(observation(dataset, ["", ""]))), action)


def test_set_tasks_holds_until_reset_by_any_thread(acting, dataset):
    policy, before = acting(method="demo_only")
    waving = before(observation(dataset, [WAVE]))
    expected = {task: policy.select_action(before(observation(dataset, [task]))) for task in TASKS}
    assert len({action.sum().item() for action in expected.values()}) == 3
    for task in (STACK, POUR):
        # The next call begins a new episode, also without `reset`.
        policy.set_tasks(["in other words"], [policy.demonstrations.of_task(task)])
        for _ in range(2):
            assert torch.equal(policy.select_action(waving), expected[task])
    # As in LeRobot's policy server, whose requests come in threads of their own.
    with ThreadPoolExecutor(1) as pool:
        pool.submit(policy.reset).result()
    assert torch.equal(policy.select_action(waving), expected[WAVE])
    with ThreadPoolExecutor(1) as pool:
        assert torch.equal(pool.submit(policy.select_action, waving).result(), expected[WAVE])


def test_encoders_run_once_an_episode(acting, dataset, spy):
    (policy, before), calls = acting(), []
    spy(policy.demo_encoder, "forward", calls.append)
    for n_episodes in (1, 2):
        policy.reset()
        for _ in range(3):
            policy.select_action(before(observation(dataset, [STACK])))
        assert len(calls) == n_episodes
    # Another instruction in the middle begins a new episode.
    policy.select_action(before(observation(dataset, [POUR])))
    assert len(calls) == 3
    assert fake_encoder.calls == [[STACK], [POUR]]


def test_policy_acts_with_the_weights_that_were_trained_last(acting, dataset):
    policy, before = acting(optimizer_lr=0.01)
    batch, seen = before(batch_of(dataset, [0, 1, 7, 8])), before(observation(dataset, [STACK]))
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    for _ in range(2):
        policy.train()
        policy(batch)[0].backward()
        optimizer.step()
        policy.eval()
        policy.reset()
        acted = policy.select_action(seen)
        # A copy that is loaded anew acts the same, up to the order of sums.
        fresh = copy.deepcopy(policy)
        fresh.reset()
        torch.testing.assert_close(acted, fresh.select_action(seen))
    policy.reset()
    policy.train()  # acts without fused batch norms, by the statistics of the batch
    assert not torch.allclose(policy.select_action(seen), acted, atol=1e-4)


def test_samples_of_a_task_take_different_demonstrations(make, dataset):
    policy, before, _ = make(method="demo_only")
    policy(before(batch_of(dataset, [0])))
    taken = policy.banked_demonstrations([STACK, POUR, STACK, STACK, POUR])
    assert [[each.episode for each in own] for own in taken] == [[0], [3], [1], [2], [4]]
    taken = policy.banked_demonstrations([STACK, STACK], n_each=2)
    assert [[each.episode for each in own] for own in taken] == [[0, 1], [2, 0]]
    with pytest.raises(ValueError, match="`n_demonstrations` is 2, but the task 'wave' has 1"):
        policy.banked_demonstrations([STACK, WAVE], n_each=2)


def test_a_named_episode_demonstrates_any_instruction(acting, dataset):
    policy, before = acting(method="demo_only")
    expected = policy.select_action(before(observation(dataset, ["juggle"])))
    other, _ = acting(method="demo_only", demo_episode=3)
    other.load_state_dict(policy.state_dict())
    torch.testing.assert_close(other.select_action(before(observation(dataset, ["keep them up"]))), expected)


def test_mcil_takes_an_instruction_or_a_demonstration(acting, dataset):
    policy, before = acting(method="mcil")
    seen = before(observation(dataset, [POUR] * 3))
    both = policy.select_action(seen)  # the samples of a batch take them in turn
    assert not torch.allclose(both[0], both[1], atol=1e-6)
    torch.testing.assert_close(both[0], both[2])
    fake_encoder.calls = []
    shown = policy.demonstrations.of_task(POUR)
    for instruction, demonstrations, expected in (("", shown, both[1]), (POUR, [], both[0])):
        policy.set_tasks([instruction] * 3, [demonstrations] * 3)
        torch.testing.assert_close(policy.select_action(seen)[0], expected)
    assert fake_encoder.calls == []


def test_inputs_that_the_method_needs_cannot_be_left_out(acting, dataset):
    shown = DemonstrationBank(torch.zeros(1, 2, 3, 16, 16, dtype=torch.uint8), [POUR], [0])[0]
    for methods, instruction, demonstrations in (
        (("deltaco", "language_only"), "", [shown]),
        (("deltaco", "demo_only"), POUR, []),
        (("mcil",), "", []),
    ):
        for method in methods:
            policy, before = acting(method=method)
            policy.set_tasks([instruction], [demonstrations])
            with pytest.raises(ValueError, match=f"{method!r} is missing an input. Pass an instruction and"):
                policy.select_action(before(observation(dataset, [POUR])))


def test_missing_tasks_are_errors(acting, make, dataset):
    policy, before = acting()
    with pytest.raises(ValueError, match="no demonstration of the task 'sing'.*of 4 tasks.*demo_episode"):
        policy.select_action(before(observation(dataset, ["sing"])))
    seen = before(observation(dataset, [WAVE]))
    for task in (None, [], "wave", [None]):
        with pytest.raises(ValueError, match="`task` must be a list with an instruction for each sample"):
            policy.select_action({**seen, "task": task})
    with pytest.raises(ValueError, match="as many lists of demonstrations as instructions. Got 0 and 1"):
        policy.set_tasks([WAVE], [])
    without, _, _ = make()
    without.training_data = None
    with pytest.raises(ValueError, match="no demonstrations. Name a dataset of them with --policy.demo_re"):
        without.eval().select_action(seen)
    without._meta, batch = None, before(batch_of(dataset, [0]))
    with pytest.raises(ValueError, match="needs the episodes: call `prepare_training`"):
        without.train()(batch)
