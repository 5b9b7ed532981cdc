"""`deltaco_match` on a small synthetic pick-and-place dataset: two objects, of which one is moved."""

import copy
import dataclasses

import numpy as np
import pytest
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.utils.constants import OBS_IMAGE, OBS_STATE
from small_policies import (
    TABLE_LENGTH,
    TABLE_SIZE,
    TABLE_TASKS,
    batch_of,
    demos_of,
    draw_table,
    observation,
    random_moves,
    small_policy,
    state_at,
    use_short_fit,
    write_episodes,
    write_table,
)

from lerobot_deltaco.data.object_prompts import ObjectPrompt
from lerobot_deltaco.data.training_data import DatasetEpisodes, TrainingData
from lerobot_deltaco.errors import UserError
from lerobot_deltaco.policies.base.normalization import StateLimits
from lerobot_deltaco.policies.deltaco_match.configuration_deltaco_match import MatchingSettings
from lerobot_deltaco.policies.deltaco_match.localization import PickPlace
from lerobot_deltaco.policies.deltaco_match.modeling_deltaco_match import DeltacoMatchPolicy
from lerobot_deltaco.policies.scene.camera_motion import CameraMotion
from lerobot_deltaco.policies.scene.proposals import Background

pytestmark = pytest.mark.usefixtures("short_fit")

N_EPISODES, N_TRAINED = 48, 36
MOVES = random_moves(N_EPISODES)  # of `table`
REACHES = MatchingSettings().place_reaches  # of which the short fit tries one
RED, BLUE = TABLE_TASKS  # the tasks of the even and the odd episodes


@pytest.fixture
def make(table):
    """Makes a policy that has its training data, with the same weights each time."""

    def make(**options):
        torch.manual_seed(0)
        policy, _, _ = small_policy(table, "deltaco_match", **options)
        return policy

    return make


def first_frames(episodes):
    return [episode * TABLE_LENGTH for episode in episodes]


def found_in(policy, scenes, instructions, demonstrations):
    """Returns what a policy finds in the first images of episodes, by episodes that demonstrate."""
    policy.reset()
    bank = policy.training_data.demonstrations
    rows = [bank.episode_rows(torch.tensor(own)).tolist() for own in demonstrations]
    policy.set_tasks(instructions, [[bank[row] for row in own] for own in rows])
    policy.select_action(scenes)
    return policy.localization


@pytest.fixture(scope="module")
def trained(table):
    """A policy that has learned, on 36 of the 48 episodes, to find the locations."""
    with pytest.MonkeyPatch.context() as patch:
        use_short_fit(patch, 40, matching_batch=32, place_reaches=REACHES)
        patch.setattr("lerobot_deltaco.policies.deltaco_match.modeling_deltaco_match._PLACE_FRACTION", 1.0)
        patch.setattr("lerobot_deltaco.policies.deltaco_match.localization._SHIFT_PADDING", 1)
        torch.manual_seed(0)
        policy, before, _ = small_policy(table, "deltaco_match")
        optimizer = torch.optim.AdamW(policy.parameters(), lr=2e-3)
        rng = np.random.default_rng(0)
        for _ in range(50):
            batch = before(batch_of(table, first_frames(rng.choice(N_TRAINED, 16))))
            loss, _ = policy(batch)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    return policy.eval()


def test_training_learns_to_find_what_a_demonstration_moved_and_an_instruction_names(trained, table):
    held_out = range(N_TRAINED, N_EPISODES)
    scenes, tasks = batch_of(table, first_frames(held_out)), [MOVES[n][0] for n in held_out]
    shown = [[n - 2] for n in held_out]  # another episode of the same task
    true = torch.tensor(np.stack([MOVES[n][1::2] for n in held_out])).float()  # picks and places
    no_words, none_shown = [""] * len(tasks), [[]] * len(tasks)
    for instructions, demonstrations in ((tasks, shown), (no_words, shown), (tasks, none_shown)):
        found = found_in(trained, scenes, instructions, demonstrations)
        errors = (found.locations - true).abs() * TABLE_SIZE / 2  # px
        assert (errors[:, 0].amax(dim=1) < 3).float().mean() > 0.8
        # The tasks say on which side the object is placed; its y is that of the object.
        assert (errors[:, 1, 0] < 3).float().mean() > 0.8
        assert found.heights.isfinite().all()


def error_of_locations(policy, moves):
    """Median distance of the locations of training episodes from where objects were moved, px."""
    known = policy.training_locations
    true = torch.tensor(np.stack([move[1::2] for move in moves])).float().clamp(-1, 1)
    assert known.has_grasp.all()
    return (known.locations - true).norm(dim=2).median() * TABLE_SIZE / 2


def test_locations_of_training_episodes_are_where_objects_were_moved(make):
    assert error_of_locations(make(), MOVES) < 1.5


def test_episode_without_a_grasp_teaches_nothing(make, table):
    policy = make()
    batch = batch_of(table, first_frames([0, 1]))

    def losses():
        policy.step.zero_()
        policy.zero_grad()
        loss, _ = policy(batch, reduction="none")
        loss[0].backward()
        return loss.tolist(), [
            weight.grad for weight in policy.policy_network.parameters() if weight.grad is not None
        ]

    known, gradients = losses()
    assert any(gradient.any() for gradient in gradients)
    policy.training_locations.has_grasp[0] = False
    unknown, gradients = losses()
    assert unknown == [0, known[1]]
    assert not any(gradient.any() for gradient in gradients)


@pytest.mark.parametrize("noise", [0.0, 0.02, 0.2])
def test_the_policy_network_learns_from_locations_with_the_noise_that_is_set(make, table, noise, monkeypatch):
    policy, given = make(location_noise=noise), []
    acting_loss = policy._acting_loss

    def seen(batch, images, located, *args):
        given.append(located.locations)
        return acting_loss(batch, images, located, *args)

    monkeypatch.setattr(policy, "_acting_loss", seen)
    policy(batch_of(table, first_frames(range(N_EPISODES))))
    spread = (given[0] - policy.training_locations.locations).std().item()
    assert spread == pytest.approx(noise, rel=0.3)


def test_a_batch_from_an_episode_that_the_policy_was_not_given_is_an_error(table):
    policy, _, _ = small_policy(table, "deltaco_match", training_episodes=list(range(24)))
    assert policy(batch_of(table, first_frames([0, 23])))[0] > 0
    remedy = r"`deltaco train`, or name the training episodes in --policy.training_episodes"
    with pytest.raises(ValueError, match=rf"Episode 24 is to be trained on, but was not .*{remedy}"):
        policy(batch_of(table, first_frames([0, 24])))
    assert policy.eval()(batch_of(table, first_frames([24])))[0].isfinite()
    # A policy that read all episodes itself does not know which ones are held out.
    policy, _, _ = small_policy(LeRobotDataset(table.repo_id, root=table.root), "deltaco_match")
    policy(batch_of(table, first_frames([0])))
    with pytest.raises(ValueError, match=rf"Episode 24 is held out, but was among .*{remedy}"):
        policy.eval()(batch_of(table, first_frames([24])))


def test_too_few_grasps_are_an_error_before_training(table):
    policy, _, _ = small_policy(table, "deltaco_match", training_episodes=list(range(8)))
    remedy = r"Collect more, or train --policy.type=deltaco with --policy.demo_encoder=attention"
    gripper = r"dimension 2 of the action, whose low values"
    with pytest.raises(ValueError, match=rf"at least 24 episodes .* Got 8\. {remedy}.* {gripper}"):
        policy(batch_of(table, [0]))


def test_greater_values_of_the_gripper_may_mean_closed(table, caplog):
    expected = small_policy(table, "deltaco_match")[0].training_locations.locations
    inverted = copy.copy(table)
    inverted.frames = copy.copy(table.frames)
    inverted.frames.columns = dict(table.frames.columns)
    inverted.frames.columns["action"] = table.frames.columns["action"] * torch.tensor([1, 1, -1])
    caplog.clear()
    policy, _, _ = small_policy(inverted, "deltaco_match", gripper_closed="high")
    assert torch.equal(policy.training_locations.locations, expected)
    assert "gripper_closed" not in caplog.text
    reverse = "If high values close it, 48 episodes have a grasp: set --policy.gripper_closed=high"
    with pytest.raises(ValueError, match=rf"at least 24 episodes .* Got 0\..*{reverse}"):
        small_policy(inverted, "deltaco_match")
    assert "Set --policy.gripper_closed=high." in caplog.text


def test_of_two_grippers_the_one_that_moves_grasps(tmp_path, caplog):
    two = write_table(tmp_path / "two", MOVES[:24], grippers=("left_gripper", "right_gripper"))
    policy, before, after = small_policy(two, "deltaco_match")
    assert "moves most, dimension 3 of the action (right_gripper)" in caplog.text
    loss, _ = policy(before(batch_of(two, first_frames([0, 1]))))
    assert torch.isfinite(loss)
    assert error_of_locations(policy, MOVES[:24]) < 1.5  # px
    action = after(policy.eval().select_action(before(observation(two, [RED]))))
    assert action.shape == (1, 4)
    assert action.isfinite().all()


def test_validation_loss_of_held_out_episodes_is_that_at_their_recorded_locations(make, table, monkeypatch):
    policy = make().eval()
    batch = batch_of(table, [frame + 2 for frame in first_frames([0, 1, 1])])
    known, logged = policy(batch, reduction="none")
    held_out = torch.full((len(known),), -1)
    monkeypatch.setattr(policy.training_data.demonstrations, "episode_rows", lambda _: held_out)
    losses, _ = policy(batch, reduction="none")
    torch.testing.assert_close(losses, known)
    assert policy(batch)[0] == losses.mean()
    assert int(policy.step) == 0
    assert {"action_nll", "gripper_accuracy"} <= set(logged)


def test_fitted_feature_matching_is_not_fitted_again(make, table, tmp_path):
    policy = make()
    policy.save_pretrained(tmp_path)
    before = copy.deepcopy(policy.localizer.matching.state_dict())
    resumed = DeltacoMatchPolicy.from_pretrained(tmp_path, dataset_meta=table.meta).train()
    resumed.seed = 5
    resumed(batch_of(table, [0]))
    after = resumed.localizer.matching.state_dict()
    assert all(torch.equal(before[name], value) for name, value in after.items())
    assert resumed.config.known_words == ["blue", "left", "move", "object", "red", "right", "the"]


def test_the_seed_of_a_training_is_that_of_the_fit(table):
    for seed in (4, 5):
        torch.manual_seed(seed)
        assert small_policy(table, "deltaco_match", prepare=False)[0].config.seed == seed
    assert small_policy(table, "deltaco_match", prepare=False, seed=7)[0].config.seed == 7


def test_words_of_tasks_that_are_not_trained_on_are_unknown(table):
    policy, _, _ = small_policy(table, "deltaco_match", prepare=False)
    assert "blue" in policy.config.known_words
    of_red = [n for n, episode in enumerate(table.meta.episodes) if episode["tasks"] == [RED]]
    dataset = LeRobotDataset(table.repo_id, root=table.root, episodes=of_red)
    policy.fit(TrainingData.read(DatasetEpisodes(dataset, of_red), policy.config.demonstration_format))
    assert policy.config.known_words == ["", "left", "move", "object", "red", "", "the"]
    sentences = ["move the blue object left", "move the mauve object left"]
    blue, unheard = policy.localizer.matching.novelty(sentences)
    assert blue == unheard


def test_feature_matching_takes_images_of_any_size(table):
    policy, _, _ = small_policy(table, "deltaco_match", image_size=19)
    policy(batch_of(table, [0]))
    found = found_in(policy.eval(), batch_of(table, [0, 0]), [RED, ""], [[0], [2]])
    assert found.locations.isfinite().all()
    assert found.locations.abs().max() <= 1


def test_actions_that_cannot_be_carried_out_are_errors(make, table):
    policy, scene = make().eval(), batch_of(table, [0])
    assert found_in(policy, scene, [RED], [[0]]) is not None
    with torch.no_grad():
        for weights in policy.parameters():
            weights.mul_(1e30)
    with pytest.raises(FloatingPointError, match="the weights of the checkpoint are damaged"):
        found_in(policy, scene, [RED], [[0]])


@pytest.mark.parametrize("name", [OBS_STATE, OBS_IMAGE])
@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_an_observation_with_numbers_that_are_not_finite_is_an_error(make, table, name, value):
    policy, scene = make().eval(), batch_of(table, [0])
    found_in(policy, scene, [RED], [[0]])
    scene[name].view(-1)[1] = value
    with pytest.raises(FloatingPointError, match=f"`{name}` has numbers that are not finite"):
        policy.select_action(scene)


def test_images_must_be_in_0_to_1_and_what_is_doubtful_is_told_once(make, table, caplog):
    policy, scene = make().eval(), batch_of(table, [0])
    with pytest.raises(UserError, match=r"`observation.image` must have numbers from 0 to 1. Got \d+ to 2"):
        found_in(policy, {**scene, OBS_IMAGE: 255 * scene[OBS_IMAGE]}, [RED], [[0]])
    assert "observation." not in caplog.text
    black, degrees = torch.zeros_like(scene[OBS_IMAGE]), scene[OBS_STATE] + 57.3
    for _ in range(2):
        found_in(policy, {**scene, OBS_IMAGE: black, OBS_STATE: degrees}, [RED], [[0]])
    assert caplog.text.count("The image `observation.image` is of a single color") == 1
    assert caplog.text.count("`observation.state` is not like that of the training: its dimension") == 1


def test_an_empty_sentence_and_too_many_demonstrations_are_errors(make, table):
    policy, scene = make(n_demonstrations=25).eval(), batch_of(table, [0])
    with pytest.raises(UserError, match="`task` is empty"):
        policy.select_action({**scene, "task": [" "]})
    with pytest.raises(UserError, match="`n_demonstrations` is 25, but the task .* has 24"):
        policy.select_action({**scene, "task": [RED]})


def test_a_joint_that_hardly_moves_does_not_decide_the_action(caplog):
    stats = {OBS_STATE: {"std": np.array([0.5, 0.2, 1e-5, 0.3])}}
    limits = StateLimits(4, stats)
    assert "In the training data, dimension 2 of the robot's state hardly moves" in caplog.text
    # Divided by 3 % of the median, 0.2, and clipped.
    limited = limits(torch.tensor([1.0, -9.0, 300.0, 0.0]))
    torch.testing.assert_close(limited, torch.tensor([1.0, -5.0, 0.5, 0.0]))
    noise = limits.add_noise(torch.zeros(5000, 4), 0.1, torch.Generator().manual_seed(0))
    assert (noise == 0).float().mean() == pytest.approx(0.5, abs=0.02)
    assert (noise / 0.5**0.5).std(dim=0).tolist() == pytest.approx([0.1, 0.1, 1.0, 0.1], rel=0.1)
    assert StateLimits(3, None)(torch.ones(3)).tolist() == [1, 1, 1]


def test_what_is_left_out_does_not_matter(make, table):
    policy = make().eval()
    policy.localizer.demonstrates_places.zero_()  # as after many episodes
    scene = batch_of(table, [0])

    def found(instruction, *episodes):
        return found_in(policy, scene, [instruction], [list(episodes)])

    both, by_demonstration, by_instruction = found(RED, 0), found("", 0), found(RED)
    assert both.by_demonstration == (True, False)
    assert by_demonstration.by_demonstration == (True, True)
    assert by_instruction.by_demonstration == (False, False)
    assert by_instruction.attention is None
    # With both, the demonstration alone says what to pick, and the instruction alone where to place it.
    torch.testing.assert_close(both.maps[:, 1], found(RED, 1).maps[:, 1])
    assert not torch.equal(both.maps[:, 0], found(RED, 1).maps[:, 0])
    assert not torch.equal(both.maps[:, 1], found(BLUE, 0).maps[:, 1])
    # But not everything can be left out, nor from some samples alone.
    with pytest.raises(ValueError, match="Neither a demonstration nor an instruction is given"):
        found("")
    with pytest.raises(ValueError, match=r"as many demonstrations each. Got \[0, 1\]"):
        found_in(policy, batch_of(table, [0, 0]), ["", ""], [[0], []])


def test_after_few_episodes_demonstrations_of_new_tasks_say_where_to_place(make, table, monkeypatch):
    use_short_fit(monkeypatch, place_reaches=REACHES)
    policy = make().eval()
    assert policy.localizer.demonstrates_places
    assert policy.config.trained_tasks == sorted(TABLE_TASKS)
    task = "bring the red one there"
    scene, bank = batch_of(table, [0]), policy.training_data.demonstrations

    def found_by(sentence, demonstrated, episodes):
        shown = [dataclasses.replace(bank[row], task=demonstrated) for row in episodes]
        policy.reset()
        policy.set_tasks([sentence], [shown])
        policy.select_action(scene)
        return policy.localization

    shown, another, unseen = (found_by(task, task, episodes) for episodes in ([0], [4], []))
    recorded = policy.training_locations.locations[0, 1]
    assert (shown.locations[0, 1] - recorded).norm() < 0.1  # in its own scene, where it was
    assert shown.is_same_place.all()
    assert another.is_same_place.all()
    assert not torch.equal(shown.maps[:, 1], another.maps[:, 1])
    assert not unseen.is_same_place.any()
    # The sentence of another task says where, as does that of a trained one.
    for sentence, demonstrated in ((BLUE, RED), (task, RED), (RED, RED)):
        other, alone = found_by(sentence, demonstrated, [0]), found_by(sentence, demonstrated, [])
        assert not other.is_same_place.any()
        torch.testing.assert_close(other.maps[:, 1], alone.maps[:, 1])


def test_a_camera_that_has_moved_since_the_training_does_not_matter(make, table, monkeypatch):
    policy = make().eval()
    scene, right, down = batch_of(table, [0]), 3, -2
    expected = found_in(policy, scene, [RED], [[0]])
    homography = torch.tensor([[1.0, 0, 2 * right / TABLE_SIZE], [0, 1, 2 * down / TABLE_SIZE], [0, 0, 1]])
    moved = scene | {OBS_IMAGE: scene[OBS_IMAGE].roll((down, right), (-2, -1))}

    def motion(_, image):
        is_moved = torch.equal(image, moved[OBS_IMAGE][0])
        return CameraMotion(homography, 1.0, 0.5, is_significant=is_moved)

    monkeypatch.setattr(Background, "camera_motion", motion)
    found = found_in(policy, moved, [RED], [[0]])
    torch.testing.assert_close(found.locations, expected.locations, atol=0.02, rtol=0)
    torch.testing.assert_close(found.confidence, expected.confidence, atol=0.02, rtol=0)
    # What is pointed at is where the moved camera sees it.
    x, y = (expected.proposal[0] + 1) / 2 + torch.tensor([right, down]) / TABLE_SIZE
    prompt = ObjectPrompt((x.item(), y.item(), x.item(), y.item()))
    policy.reset()
    policy.set_tasks([RED], [[prompt]])
    policy.select_action(moved)
    torch.testing.assert_close(policy.localization.proposal, expected.proposal, atol=0.02, rtol=0)


def test_several_demonstrations_are_combined(make, table):
    policy = make(n_demonstrations=2).eval()
    policy.localizer.demonstrates_places.zero_()  # as after many episodes
    scene = batch_of(table, [0])
    one, other, both = (found_in(policy, scene, [RED], [episodes]) for episodes in ([0], [2], [0, 2]))
    for single in (one, other):
        assert not torch.equal(both.maps[:, 0], single.maps[:, 0])
        torch.testing.assert_close(both.maps[:, 1], single.maps[:, 1])
    # Without `set_tasks`, the bank gives as many.
    policy.reset()
    policy.select_action(scene | {"task": [RED]})
    torch.testing.assert_close(policy.localization.maps, both.maps)


def test_height_bias_is_added_when_acting(make, table):
    policies = [make(grasp_height_bias=bias).eval() for bias in (0.0, 0.5)]
    heights = [found_in(policy, batch_of(table, [0]), [RED], [[0]]).heights for policy in policies]
    torch.testing.assert_close(heights[1], heights[0] + 0.5)


def test_demonstrations_of_another_robot_and_a_missing_gripper_are_errors(table, dataset, tmp_path):
    other = write_table(tmp_path / "other", MOVES[:2], n_joints=5)
    with pytest.raises(ValueError, match="of another robot: their states and actions have 5 and 3 numbers"):
        small_policy(table, "deltaco_match", **demos_of(other))
    with pytest.raises(ValueError, match="has no camera 'observation.image', only observation.images.top"):
        small_policy(table, "deltaco_match", **demos_of(dataset))
    with pytest.raises(ValueError, match=r"needs the feature 'observation.state' and a gripper"):
        small_policy(table, "deltaco_match", gripper="none")


@pytest.mark.parametrize("tremble", [0, 0.1])
def test_a_demonstration_may_be_given_by_hand_while_the_arm_rests(tremble, table, tmp_path, caplog):
    task, start, other, end = MOVES[0]
    frames = [
        {
            "observation.image": draw_table(task, start if step < 6 else end, other),
            "observation.state": state_at(np.zeros(2)),
            "action": np.array([0, 0, 1 - tremble * (4 <= step < 8)], np.float32),
        }
        for step in range(12)
    ]
    named = {"observation.state": list("abc"), "action": ["a", "b", "gripper"]}
    demos = write_episodes(tmp_path / "demos", "test/hand", [(task, frames)], **named)
    policy, before, _ = small_policy(table, "deltaco_match", **demos_of(demos))
    policy.eval()
    assert policy.demonstrations.pick_states.isnan().all()
    assert "1 of 1 episodes have no grasp, and what they moved is found from their first" in caplog.text
    action = policy.select_action(before(observation(table, [task])))
    assert torch.isfinite(action).all()
    assert policy.localization.by_demonstration[0]


def test_the_network_acts_where_a_demonstration_cannot_be_replayed(make, table, caplog):
    policy = make(acting="replay").eval()
    shown, scene = policy.training_data.demonstrations[0], batch_of(table, [2 * TABLE_LENGTH])

    def act(*demonstrations):
        policy.set_tasks([RED] * len(demonstrations), demonstrations)
        return policy.select_action(batch_of(table, [2 * TABLE_LENGTH] * len(demonstrations)))

    replayed = act([shown])
    assert "replayed" not in caplog.text
    by_camera = dataclasses.replace(shown, states=None)
    still = dataclasses.replace(shown, actions=torch.ones_like(shown.actions))
    for demonstrations, message in (
        ([], "no demonstration is given"),
        ([by_camera], "the demonstration has no states and actions of the robot"),
        ([still], "the gripper"),
    ):
        with caplog.at_level("INFO"):
            act(demonstrations)
        assert policy._episode.replayed.all()
        assert f"The nearest training episode is replayed: {message}" in caplog.text
        # Without one, such as in an older checkpoint, the network acts.
        grasp_states, policy.replay.grasp_states = policy.replay.grasp_states, torch.zeros(0, 2, 3)
        action = act(demonstrations)
        policy.replay.grasp_states = grasp_states
        assert f"no demonstration can be replayed: {message}" in caplog.text
        policy.config.acting = "network"
        torch.testing.assert_close(act(demonstrations), action)
        policy.config.acting = "replay"
    # Each sample of a batch on its own
    both = act([by_camera], [shown])
    torch.testing.assert_close(both[1:], replayed)
    torch.testing.assert_close(both[:1], act([by_camera]), atol=1e-3, rtol=0)
    policy.replay.action_scale.zero_()
    policy.set_tasks([RED], [[shown]])
    with pytest.raises(ValueError, match="could not replay demonstrations. Train it again"):
        policy.select_action(scene)


def test_few_episodes_are_replayed(make, monkeypatch):
    assert make().config.acting == "replay"
    monkeypatch.setattr("lerobot_deltaco.policies.deltaco_match.modeling_deltaco_match._MAX_REPLAYED", 40)
    assert make().config.acting == "network"


def test_a_robot_that_cannot_be_replayed_acts_by_the_network(make, monkeypatch, caplog):
    monkeypatch.setattr("lerobot_deltaco.policies.geometry.replay._LEAST_EXPLAINED", 1.1)
    assert make().config.acting == "network"
    assert "No dimension of the robot's state follows its actions" in caplog.text
    with pytest.raises(UserError, match="--policy.acting=network"):
        make(acting="replay")


def test_replay_repeats_the_demonstration_in_its_own_scene(table):
    policy, before, _ = small_policy(table, "deltaco_match", acting="replay")
    policy.eval()
    located = policy.training_locations
    policy.localize = lambda *_: PickPlace(
        located.locations[:1],
        located.heights[:1],
        None,
        None,
        (True, False),
        torch.ones(1),
        torch.ones(1),
        torch.zeros(1, dtype=torch.bool),
        located.locations[:1, 0],
    )
    policy.set_tasks([RED], [[policy.training_data.demonstrations[0]]])
    steps = range(1, TABLE_LENGTH)
    actions = torch.cat([policy.select_action(before(batch_of(table, [step]))) for step in steps])
    recorded = before(batch_of(table, list(steps)))["action"]
    assert torch.equal(actions[:, -1] > 0, recorded[:, -1] > 0)
    torch.testing.assert_close(actions, recorded, atol=0.05, rtol=0)


def test_a_checkpoint_keeps_the_trajectories_of_its_demonstrations(make, table, tmp_path):
    policy, before, _ = small_policy(table, "deltaco_match", acting="replay", **demos_of(table))
    policy.eval().save_pretrained(tmp_path)
    loaded = DeltacoMatchPolicy.from_pretrained(tmp_path).eval()
    for row in range(2):
        for own, kept in zip(
            policy.demonstrations.trajectory(row), loaded.demonstrations.trajectory(row), strict=True
        ):
            assert torch.equal(own, kept)
    scene = before(observation(table, [RED]))
    torch.testing.assert_close(loaded.select_action(scene), policy.select_action(scene))
