"""Conditioning by correspondence: keyframes, calibration, recoloring, the locator, and the policy."""

import copy

import numpy as np
import pytest
import torch
import torch.nn.functional as F  # noqa: N812
from lerobot.datasets import LeRobotDataset
from PIL import Image
from small_policies import batch_of, observation, small_policy

from lerobot_deltaco.configuration_deltaco import DeltacoConfig
from lerobot_deltaco.modeling_deltaco import DeltacoPolicy
from lerobot_deltaco.policy.demonstrations import load_demonstrations
from lerobot_deltaco.policy.goals.calibration import MIN_EPISODES, StateToImage
from lerobot_deltaco.policy.goals.correspondence import GoalLocator, goal_loss, peak_places
from lerobot_deltaco.policy.goals.grasp_depth import DepthEstimator
from lerobot_deltaco.policy.goals.keyframes import find_keyframes, follows_gripper, release_frames
from lerobot_deltaco.policy.goals.recoloring import random_recolorings, recolor
from lerobot_deltaco.policy.goals.states import GoalStates
from lerobot_deltaco.policy.goals.training_goals import TrainingGoals
from lerobot_deltaco.policy.networks import ConditionedPolicy, gaussian_maps
from lerobot_deltaco.training.frames import FramesInMemory

SIZE, LENGTH = 24, 7
GRIPPER = (-1, -1, 1, 1, 1, -1, -1)  # in the frames of an episode; 1 is closed
COLORS = {"move the red thing left": (230, 40, 30), "move the blue thing right": (30, 60, 220)}
CORRESPONDENCE = {"demo_encoder": "correspondence", "image_size": SIZE, "motion_modes": 2}


pytestmark = pytest.mark.usefixtures("fake_language")


def image_with(*things):
    """A gray image with squares of 4 x 4 px, each a color and its middle (x, y) in -1..1."""
    image = np.full((SIZE, SIZE, 3), 120, np.uint8)
    for color, (x, y) in things:
        column, row = (round((c + 1) * SIZE / 2) for c in (x, y))
        image[max(0, row - 2) : row + 2, max(0, column - 2) : column + 2] = color
    return image


def state_of(place):
    """The robot's state at a place in the image, in other units, with a number that never changes."""
    x, y = place
    return np.array([3 + 0.4 * x + 0.1 * y, -1 - 0.1 * x + 0.5 * y, 7.0], np.float32)


def random_moves(tasks):
    """Of each episode: the task, where its thing was and went, and where the other thing stood."""
    rng = np.random.default_rng(0)
    found = []
    while len(found) < 60:
        start, other = rng.uniform(-0.7, 0.7, (2, 2))
        if np.abs(start - other).max() > 0.5:
            task = tasks[len(found) % 2]
            found.append((task, start, other, np.array([-0.8 if "left" in task else 0.8, start[1]])))
    return found


@pytest.fixture(scope="module")
def episodes():
    return random_moves(list(COLORS))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory, episodes):
    """Two things on a table, of which one is moved: grasped in frame 2, released in frame 5."""

    return table_dataset(tmp_path_factory.mktemp("data") / "table", episodes, image=table_with)


def table_with(task, thing, other):
    """The table with a task's thing and the other one at these places."""
    other_color = next(color for name, color in COLORS.items() if name != task)
    return image_with((COLORS[task], thing), (other_color, other))


def table_dataset(root, episodes, closed=-1, n_joints=3, **cameras):
    """Episodes of a thing that is moved on a table. The gripper's command is `closed`, or its opposite.

    Each camera is a function that draws an image of a task and the places of its thing and the other one.
    """
    images = {f"observation.{camera}": draw for camera, draw in cameras.items()}
    features = {
        **{
            name: {
                "dtype": "image",
                "shape": draw(*episodes[0][:3]).shape,
                "names": ["height", "width", "channels"],
            }
            for name, draw in images.items()
        },
        "observation.state": {"dtype": "float32", "shape": (n_joints,), "names": list("abcde")[:n_joints]},
        "action": {"dtype": "float32", "shape": (3,), "names": ["a", "b", "gripper"]},
    }
    dataset = LeRobotDataset.create("test/table", 10, features, root=root, use_videos=False)
    home = np.zeros(2)
    for task, start, other, end in episodes:
        for step in range(LENGTH):
            place = (home, start, start, start, end, end, home)[step]
            thing = start if step < 4 else end
            dataset.add_frame(
                {
                    **{name: draw(task, thing, other) for name, draw in images.items()},
                    "observation.state": np.resize(state_of(place), n_joints),
                    "action": np.array(
                        [*(place - home), closed * (-1, -1, 1, 1, 1, -1, -1)[step]], np.float32
                    ),
                    "task": task,
                }
            )
        dataset.save_episode()
    dataset.finalize()
    return LeRobotDataset("test/table", root=root)


@pytest.fixture
def policy(dataset):
    policy, _, _ = small_policy(dataset, **CORRESPONDENCE)
    return policy


# Keyframes


def test_the_last_grasp_that_is_released_counts():
    states = torch.arange(14).float()[:, None]
    gripper = torch.tensor([1, -1, 1, 1, -1, -1, 1, 1, -1, 1.0, 1, 1, -1, -1])
    keyframes = find_keyframes(states, gripper, [(0, 7), (8, 10), (11, 13)])
    assert keyframes.found.tolist() == [True, True, False]
    # One step after the command to close, and the step of the command to open.
    assert keyframes.states[:2, :, 0].tolist() == [[5, 6], [9, 9]]
    assert keyframes.approach[:2, 0].tolist() == [2, 8]
    assert not keyframes.states[2].any()
    assert release_frames(gripper, [(0, 7), (8, 10), (11, 13)]) == [6, 9, None]


def test_the_grippers_states_are_those_that_follow_its_commands():
    generator = torch.Generator().manual_seed(0)
    gripper = torch.randn(60, generator=generator).sign()
    arm = torch.randn(60, generator=generator)
    opening = torch.cat([gripper.new_ones(1), 0.02 + 0.5 * gripper[:-1]])
    states = torch.stack([arm, opening, torch.full((60,), 7.0), -opening], dim=1)
    assert follows_gripper(states, gripper, [(0, 29), (30, 59)]).tolist() == [False, True, False, True]


# Calibration


def test_changes_alone_tell_where_states_are_in_the_image(episodes):
    first = [image_with((COLORS[task], start), ((0, 200, 0), other)) for task, start, other, _ in episodes]
    last = [image_with((COLORS[task], end), ((0, 200, 0), other)) for task, _, other, end in episodes]
    images = [torch.from_numpy(np.stack(side)).permute(0, 3, 1, 2) for side in (first, last)]
    states = torch.from_numpy(np.stack([state_of(start) for _, start, _, _ in episodes]))
    to_image = StateToImage(states.shape[1])
    to_image.fit(*images, states)
    places = torch.from_numpy(np.stack([start for _, start, _, _ in episodes])).float()
    errors = (to_image(states) - places).norm(dim=1) * SIZE / 2
    assert errors.median() < 1  # px
    assert errors.max() < 2.5


def test_too_few_episodes_for_a_calibration_are_an_error():
    n = MIN_EPISODES - 1
    images = torch.zeros(n, 3, SIZE, SIZE, dtype=torch.uint8)
    with pytest.raises(ValueError, match=f"at least {MIN_EPISODES} episodes .* Got {n}"):
        StateToImage(2).fit(images, images, torch.zeros(n, 2))


# Depths


@pytest.fixture
def grasps():
    """Goals whose states depend on the place and a depth, the depths, and how states are normalized."""
    generator = torch.Generator().manual_seed(0)
    places = torch.rand(200, 2, 2, generator=generator) * 1.6 - 0.8
    depths = torch.randn(200, generator=generator)
    x, y = places.unbind(dim=2)
    height = torch.stack([depths, torch.zeros(200)], dim=1)  # of grasps alone
    width = torch.rand(200, 2, generator=generator) * 40  # that the gripper closes to
    states = torch.stack([2 + x, 5 * y + 0.2 * height, 3 * height + x * y, width], dim=2)
    approach = states[:, 0] - torch.tensor([0, 0.2, 3, 0])
    goals = TrainingGoals(places, states, approach, torch.arange(200) % 10 > 0)
    return goals, depths, (torch.tensor([0.5, 2, 0.1, 1]), torch.tensor([1.0, 0, -1, 0]))


class ExactPlaces(torch.nn.Module):
    """The inverse of how `grasps` makes states from places."""

    def forward(self, states):
        x, y, z = states[:, 0] - 2, states[:, 1], states[:, 2]
        return torch.stack([x, (y - z * 0.2 / 3) / (5 - x * 0.2 / 3)], dim=1)


def test_depths_say_what_places_do_not(grasps):
    goals, depths, normalized = grasps
    states = GoalStates(4, 2, has_depth=True)
    states.fit(goals, *normalized, torch.tensor([True, True, True, False]))
    states.to_image = ExactPlaces()
    found = states.depths(goals.states[:, 0])
    correlation = torch.corrcoef(torch.stack([found, depths]))[0, 1]
    assert correlation > 0.98  # deeper is further along the approach
    assert found[goals.found].std() == pytest.approx(1, abs=0.05)
    scale, shift = normalized
    with_depths = states(goals.places, found)
    true = goals.states * scale + shift
    torch.testing.assert_close(with_depths[..., :3], true[..., :3], atol=0.1, rtol=0)
    # Without them, the grasp's height is not known.
    error = (states(goals.places, torch.zeros(200)) - with_depths)[:, 0].abs().mean(dim=0)
    assert error[2] > 0.1
    assert not error[0] > 0.02


def test_without_any_depth_there_is_none(grasps):
    goals, _, normalized = grasps
    flat = goals.states.clone()
    flat[..., 2] = 1
    flat[..., 1] = 5 * goals.places[..., 1]
    flat[..., 3] = 1
    states = GoalStates(4, 2, has_depth=True)
    states.fit(goals._replace(states=flat), *normalized, torch.ones(4).bool())
    assert not states.depth_to_state.any()
    torch.testing.assert_close(states.depths(flat[:, 0]), torch.zeros(200))


def test_depths_come_from_the_demonstration_as_far_as_it_can_be_trusted():
    torch.manual_seed(0)
    n, dim = 256, 8
    estimator = DepthEstimator(dim, condition_dim=2, has_demonstration=True)
    optimizer = torch.optim.Adam(estimator.parameters(), lr=1e-2)
    generator = torch.Generator().manual_seed(0)

    def samples():
        features = torch.randn(n, dim, 6, 6, generator=generator)
        kind = torch.arange(n) % 2  # 0: the demonstration moved the same object
        depths = torch.randn(n, generator=generator)
        others = torch.where(kind == 0, depths, torch.randn(n, generator=generator))
        return features, torch.zeros(n, 2), depths, torch.randn(n, dim), others, F.one_hot(kind, 2).float()

    for _ in range(150):
        loss = estimator.losses(*samples(), generator).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    features, places, depths, descriptors, others, condition = samples()
    found = estimator(features, places, descriptors, others, condition, looks_std=0.7)
    same = condition[:, 0] == 1
    assert (found - depths)[same].abs().mean() < 0.1
    # In the mean, another object's depth counts little, and an unknown one not at all.
    by_looks = estimator(features, places, descriptors, others * torch.nan, condition, looks_std=0.7)
    assert by_looks.isfinite().all()
    assert (found - by_looks)[~same].abs().mean() < 0.5 * (others - by_looks)[~same].abs().mean()


def test_unknown_depths_leave_the_loss_finite():
    estimator = DepthEstimator(4, 0, has_demonstration=True)
    unknown = torch.full((3,), torch.nan)
    generator = torch.Generator()
    losses = estimator.losses(
        torch.rand(3, 4, 6, 6), torch.zeros(3, 2), torch.zeros(3), torch.rand(3, 4), unknown, None, generator
    )
    losses.sum().backward()
    assert losses.isfinite().all()
    assert all(p.grad is None or p.grad.isfinite().all() for p in estimator.parameters())


# Recoloring


def test_recoloring_changes_its_share_of_the_samples_and_leaves_gray_gray():
    recolorings = random_recolorings(400, 0.7, torch.Generator().manual_seed(0))
    same = (recolorings == torch.eye(3)).all(dim=(1, 2))
    assert 0.2 < same.float().mean() < 0.4
    gray = recolor(torch.full((400, 3, 2, 2), 0.4), recolorings)
    torch.testing.assert_close(gray, gray[:, :1].expand_as(gray))
    images = torch.rand(400, 2, 3, 4, 4)
    changed = recolor(images, recolorings)
    assert changed.shape == images.shape
    assert (changed >= 0).all()
    assert (changed <= 1).all()
    torch.testing.assert_close(changed[same], images[same])
    # Both images of a sample change alike.
    torch.testing.assert_close(recolor(images[:, :1], recolorings), changed[:, :1])


# Maps


def test_the_peak_of_a_map_is_its_place():
    places = torch.rand(5, 2, 2) * 1.6 - 0.8
    maps = gaussian_maps(places, 24, 32, 0.1)
    torch.testing.assert_close(peak_places(20 * maps), places, atol=0.03, rtol=0)


def test_the_goal_loss_is_least_where_the_goal_is():
    goals = torch.tensor([[[0.3, -0.4], [-0.5, 0.6]]])
    right = 5 * gaussian_maps(goals, 12, 12, 0.2)
    wrong = 5 * gaussian_maps(goals.flip(1), 12, 12, 0.2)
    assert (goal_loss(right, goals) < goal_loss(torch.zeros_like(right), goals)).all()
    assert (goal_loss(torch.zeros_like(right), goals) < goal_loss(wrong, goals)).all()


def test_what_a_descriptor_was_made_of_is_most_similar_to_it():
    torch.manual_seed(0)
    locator = GoalLocator("demo", "demo", condition_dim=0).eval()
    scene = torch.rand(1, 3, SIZE, SIZE)
    description = locator.describe(torch.stack([scene, scene], dim=1))
    features = locator.trunk(scene)
    row, column = 3, 8
    moved = features[:, :, row, column]
    logits = locator(scene, scene, description._replace(moved=moved), None).logits
    assert logits.shape == (1, 2, SIZE // 2, SIZE // 2)
    assert logits[0, 0].argmax() == row * (SIZE // 2) + column


def test_goals_reach_the_action_and_no_other_cameras_image():
    torch.manual_seed(0)
    network = ConditionedPolicy(2, 0, 0, 3, True, (8, 8), 2, n_goals=2).eval()
    images, goals = torch.rand(1, 2, 3, SIZE, SIZE), torch.zeros(1, 2, 2)
    with_goals = network._with_goals(images, goals)
    assert with_goals[0, 0, 3:].amax(dim=(1, 2)).min() > 0.7
    assert not with_goals[0, 1, 3:].any()
    motion, gripper = network(images, None, None, goals)
    other_motion, other_gripper = network(images, None, None, goals + 0.5)
    assert not torch.equal(motion.mean, other_motion.mean)
    assert not torch.equal(gripper, other_gripper)


# The policy


def test_goals_of_training_episodes_are_where_things_were_moved(policy, dataset, episodes):
    policy.forward({**batch_of(dataset, [0, LENGTH])})
    true = torch.from_numpy(np.stack([np.stack([start, end]) for _, start, _, end in episodes])).float()
    true = true[policy.train_demonstrations.episodes].clamp(-1, 1)
    errors = (policy.goal_trainer.goals.places - true).norm(dim=2) * SIZE / 2
    assert policy.goal_trainer.goals.found.all()
    assert errors.median() < 1.5  # px


def test_an_episode_without_a_grasp_teaches_nothing(policy, dataset):
    batch = batch_of(dataset, [1, LENGTH + 1])

    def losses():
        policy.step.zero_()
        policy.zero_grad()
        loss, _ = policy.forward(batch, reduction="none")
        loss[0].backward()
        return loss.tolist(), [weight.grad for weight in policy.model.parameters() if weight.grad is not None]

    known, gradients = losses()
    assert any(gradient.any() for gradient in gradients)
    # Nor does the locator learn to find its goals.
    row = policy.train_demonstrations.episode_rows(batch["episode_index"])[0]
    policy.goal_trainer.goals.found[row] = False
    unknown, gradients = losses()
    assert unknown == [0, known[1]]
    assert not any(gradient.any() for gradient in gradients)


def test_processes_do_not_send_each_other_what_belongs_to_demonstrations(dataset):
    demos = {"demo_repo_id": "test/table", "demo_root": str(dataset.root)}
    policy, _, _ = small_policy(dataset, **CORRESPONDENCE, **demos)
    policy.forward(batch_of(dataset, [0, LENGTH]))
    ignored = set(policy._ddp_params_and_buffers_to_ignore)
    assert {f"{kind}_demonstrations.grasp_states" for kind in ("train", "eval")} <= ignored
    sent = {name for name, _ in policy.named_buffers()} - ignored
    assert "step" in sent
    assert not any("demonstrations" in name for name in sent)


def test_validation_losses_note_no_demonstration(policy, dataset):
    policy.forward(batch_of(dataset, [0, LENGTH]))
    policy.eval()
    policy.goal_trainer.goals.found[:] = False  # as those that are held back
    batch = batch_of(dataset, [0, LENGTH])
    for _ in range(3):
        policy.forward(batch)
    assert policy.demonstrated(0) == []
    policy.select_action({name: batch[name] for name in ("observation.image", "observation.state", "task")})
    assert len(policy.demonstrated(0)) == 1


def test_demonstrations_of_another_robot_are_refused_before_the_training(dataset, episodes, tmp_path):
    written = table_dataset(tmp_path / "other", episodes[:2], image=table_with, n_joints=5)
    demos = {"demo_repo_id": "test/table", "demo_root": str(written.root)}
    with pytest.raises(ValueError, match=r"another robot.*'observation.state' of the shape \(3,\).*\(5,\)"):
        small_policy(dataset, **CORRESPONDENCE, **demos)


def test_frames_in_memory_give_the_same_goals(policy, dataset):
    policy.forward(batch_of(dataset, [0, LENGTH]))
    frames = FramesInMemory(dataset)
    in_memory, _, _ = small_policy(dataset, **CORRESPONDENCE)
    in_memory.set_train_demonstrations(
        frames.demonstrations("observation.image", SIZE, 2), frames.robot_data()
    )
    assert in_memory.train_demonstrations.episodes.tolist() == list(range(60))
    rows = in_memory.train_demonstrations.episode_rows(policy.train_demonstrations.episodes)
    torch.testing.assert_close(in_memory.goal_trainer.goals.states[rows], policy.goal_trainer.goals.states)
    torch.testing.assert_close(
        in_memory.goal_trainer.goals.places[rows], policy.goal_trainer.goals.places, atol=0.05, rtol=0
    )


def test_large_values_of_the_gripper_may_mean_closed(dataset, caplog):
    frames = FramesInMemory(dataset)
    demonstrations = frames.demonstrations("observation.image", SIZE, 2)
    robot = frames.robot_data()
    inverted = robot._replace(actions=robot.actions * torch.tensor([1, 1, -1]))

    def goals_of(data, **options):
        caplog.clear()
        policy, _, _ = small_policy(dataset, **CORRESPONDENCE, **options)
        policy.set_train_demonstrations(copy.deepcopy(demonstrations), data)
        return policy.goal_trainer.goals

    goals = goals_of(robot)
    assert "gripper_closed" not in caplog.text
    assert torch.equal(goals_of(inverted, gripper_closed="high").states, goals.states)
    assert "gripper_closed" not in caplog.text
    # In the wrong direction, the end of the approach looks like a release.
    assert not torch.equal(goals_of(inverted).states, goals.states)
    assert "closed at the beginning of 60 of 60 episodes" in caplog.text
    assert "--policy.gripper_closed" in caplog.text


def test_the_grasp_of_a_demonstration_follows_the_direction_of_the_gripper(dataset, episodes, tmp_path):
    inverted = table_dataset(tmp_path / "inverted", episodes[:6], closed=1, image=table_with)
    places = []
    for data, closed in ((dataset, "low"), (inverted, "high")):
        demos = {"demo_repo_id": "test/table", "demo_root": str(data.root), "gripper_closed": closed}
        policy, _, _ = small_policy(data, **CORRESPONDENCE, **demos)
        places.append(policy.eval_demonstrations.grasp_states[:6])
    assert torch.equal(*places)
    assert not places[0].isnan().any()


def test_frames_until_the_release_are_those_that_are_trained_on(dataset):
    frames = FramesInMemory(dataset)
    use = frames.until_release(frames.columns["action"][:, 2], 0).reshape(-1, LENGTH)
    assert (use == [True] * 6 + [False]).all()


LEARNS_TO_FIND = {
    **CORRESPONDENCE,
    "locator_share": 1.0,
    "demo_crop_padding": 1,
    "crop_padding": 0,
    "recolor_share": 0.5,
}


def trained_to_find(dataset, n_steps, **options):
    """A policy that has learned, on 40 of the 60 episodes, to find goals."""
    torch.manual_seed(0)
    policy, before, _ = small_policy(dataset, **LEARNS_TO_FIND, **options)
    optimizer = torch.optim.AdamW(policy.parameters(), lr=2e-3)
    rng = np.random.default_rng(0)
    first_frames = np.arange(40) * LENGTH
    for _ in range(n_steps):
        loss, _ = policy.forward(before(batch_of(dataset, rng.choice(first_frames, 16).tolist())))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    policy.eval()
    policy.eval_demonstrations = policy.train_demonstrations
    return policy


def share_found(policy, dataset, episodes):
    """Share of the grasps found within 3 px, and of the releases in x, in the other 20 episodes.

    The task and the demonstration say on which side the release is; its y is that of the scene's own thing.
    """
    held_out = range(40, 60)
    batch = batch_of(dataset, [episode * LENGTH for episode in held_out])
    conditioning = policy.encode_task(tuple(batch["task"]), policy.scenes(batch))
    true = torch.from_numpy(np.stack([np.stack(episodes[n][1::2]) for n in held_out])).float()
    errors = (conditioning.goals.places - true) * SIZE / 2
    found = torch.stack([errors[:, 0].norm(dim=1) < 3, errors[:, 1, 0].abs() < 3])
    return found.float().mean(dim=1).tolist()


def test_it_learns_to_find_what_a_demonstration_moved(dataset, episodes):
    policy = trained_to_find(dataset, 60)
    assert share_found(policy, dataset, episodes)[0] > 0.85  # the right one of two things


@pytest.fixture(scope="module")
def large_dataset(tmp_path_factory, episodes):
    """The same table in images of twice the size."""

    def draw(*scene):
        return table_with(*scene).repeat(2, axis=0).repeat(2, axis=1)

    return table_dataset(tmp_path_factory.mktemp("data") / "large", episodes, image=draw)


@pytest.mark.slow
def test_it_learns_to_find_goals_in_larger_images(large_dataset, episodes):
    policy = trained_to_find(large_dataset, 60, goal_image_size=2 * SIZE)
    assert share_found(policy, large_dataset, episodes)[0] > 0.85


def test_a_policy_that_finds_goals_in_larger_images_survives_saving(large_dataset, episodes, tmp_path):
    policy = trained_to_find(large_dataset, 2, goal_image_size=2 * SIZE)
    batch = batch_of(large_dataset, [0])
    assert policy.scenes(batch).shape == (1, 3, 2 * SIZE, 2 * SIZE)
    policy.save_pretrained(tmp_path)
    loaded = DeltacoPolicy.from_pretrained(tmp_path).eval()
    assert share_found(loaded, large_dataset, episodes) == share_found(policy, large_dataset, episodes)


@pytest.mark.slow
def test_it_learns_to_find_goals_in_one_of_two_cameras_of_256_px(tmp_path_factory, episodes):
    rng = np.random.default_rng(0)

    def front(*scene):
        return np.asarray(Image.fromarray(table_with(*scene)).resize((256, 256), Image.Resampling.NEAREST))

    def wrist(*_):
        return np.kron(rng.integers(0, 255, (8, 8, 3), np.uint8), np.ones((32, 32, 1), np.uint8))

    dataset = table_dataset(
        tmp_path_factory.mktemp("data") / "two_cameras",
        episodes,
        **{"images.wrist": wrist, "images.front": front},
    )
    options = {"demo_camera": "observation.images.front", "goal_image_size": 4 * SIZE}
    policy = trained_to_find(dataset, 60, **options)
    assert share_found(policy, dataset, episodes)[0] > 0.85
    assert policy.scenes(batch_of(dataset, [0])).shape == (1, 3, 4 * SIZE, 4 * SIZE)
    assert policy.select_action(observation(dataset, list(COLORS))).shape == (2, 3)


def test_frames_in_memory_give_larger_demonstrations_than_they_are_held_in(large_dataset):
    frames = FramesInMemory(large_dataset, image_size=SIZE)
    root = large_dataset.root
    held = frames.demonstrations("observation.image", 2 * SIZE, 2)
    read = load_demonstrations("test/table", root, None, "observation.image", 2 * SIZE, 2)
    assert torch.equal(held.frames, read.frames)
    assert held.tasks == read.tasks


def test_smaller_images_than_goals_are_found_in_are_refused(dataset, large_dataset):
    with pytest.raises(ValueError, match="`goal_image_size` is 48, but the images .* have 24 x 24 pixels"):
        small_policy(dataset, **CORRESPONDENCE, goal_image_size=2 * SIZE)
    demos = {"demo_repo_id": "test/table", "demo_root": str(dataset.root)}
    with pytest.raises(ValueError, match="have images of 24 pixels, but the policy finds goals in .* 48"):
        small_policy(large_dataset, **CORRESPONDENCE, **demos, goal_image_size=2 * SIZE)


def test_only_the_grasp_depends_on_the_detail_of_larger_images():
    locator = GoalLocator("demo", "condition", 5, 8, 8, detail=2).eval()
    rough = torch.rand(2, 2, 3, SIZE, SIZE).repeat_interleave(2, dim=-1).repeat_interleave(2, dim=-2)
    fine = rough + 0.1 * torch.tensor([[1.0, -1.0], [-1.0, 1.0]]).repeat(
        SIZE, SIZE
    )  # 0 on the mean of 2 x 2 px
    found = []
    for images in (rough, fine):
        description = locator.describe(images)
        found.append(locator(images[:, 0], images[:, 0], description, torch.ones(2, 5)))
        assert found[-1].logits.shape == (2, 2, SIZE // 2, SIZE // 2)
    assert not torch.allclose(found[0].logits[:, 0], found[1].logits[:, 0])
    torch.testing.assert_close(found[0].logits[:, 1], found[1].logits[:, 1])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"goal_image_size": 3 * SIZE}, "times 1, 2, 4, 8: one of .* Got 72"),
        ({"goal_image_size": SIZE // 2 + 8}, "times 1, 2, 4, 8"),
        ({"demo_encoder": "attention", "goal_image_size": SIZE}, "it is for `demo_encoder=correspondence`"),
    ],
)
def test_sizes_of_images_for_goals_are_checked(options, message):
    with pytest.raises(ValueError, match=message):
        DeltacoConfig(**{**CORRESPONDENCE, **options})


@pytest.mark.slow
def test_it_learns_to_do_without_a_demonstration_or_an_instruction(dataset, episodes):
    policy = trained_to_find(dataset, 150, demo_dropout=0.3, instruction_dropout=0.3)
    for leave_out in (None, "demo", "instruction"):
        policy.config.leave_out = leave_out
        assert min(share_found(policy, dataset, episodes)) > 0.85, leave_out


def test_what_is_left_out_does_not_matter(dataset):
    demos = {"demo_repo_id": "test/table", "demo_root": str(dataset.root)}
    torch.manual_seed(0)
    policy, _, _ = small_policy(dataset, **CORRESPONDENCE, **demos, demo_dropout=0.2, instruction_dropout=0.2)
    policy.forward(batch_of(dataset, [0, LENGTH]))
    policy.eval()
    images = batch_of(dataset, [0])["observation.image"]

    def goals(instruction, leave_out, episode):
        policy.config.leave_out, policy.config.demo_episode = leave_out, episode
        return policy.encode_task((instruction,), images).goals

    red, blue = COLORS  # the tasks of the episodes 0 and 1
    both = goals(red, None, 0)
    by_demo, by_instruction = goals(red, "instruction", 0), goals(red, "demo", 0)
    torch.testing.assert_close(by_demo.logits, goals(blue, "instruction", 0).logits)
    torch.testing.assert_close(by_instruction.logits, goals(red, "demo", 1).logits)
    assert by_instruction.attention is None
    assert by_demo.attention is not None
    sources = [goals.from_demonstration for goals in (both, by_demo, by_instruction)]
    assert sources == [(True, False), (True, True), (False, False)]
    # With both, the demonstration alone says what, and the instruction alone where.
    torch.testing.assert_close(both.logits[:, 1], goals(red, None, 1).logits[:, 1])
    assert not torch.equal(both.logits[:, 0], goals(red, None, 1).logits[:, 0])
    assert not torch.equal(both.logits[:, 1], goals(blue, None, 0).logits[:, 1])


def test_without_a_demonstration_none_is_needed(dataset, tmp_path):
    policy, before, _ = small_policy(dataset, **CORRESPONDENCE, demo_dropout=0.5)
    policy.forward(before(batch_of(dataset, [0, LENGTH])))
    policy.save_pretrained(tmp_path / "saved")
    loaded = DeltacoPolicy.from_pretrained(tmp_path / "saved").eval()
    batch = before(batch_of(dataset, [0]))
    observation = {name: batch[name] for name in ("observation.image", "observation.state", "task")}
    with pytest.raises(ValueError, match="demonstration"):
        loaded.select_action(observation)
    loaded.config.leave_out = "demo"
    loaded.reset()
    assert loaded.select_action(observation).shape == (1, 3)
    # What is left out is a choice of one evaluation, and not of the checkpoint.
    loaded.save_pretrained(tmp_path / "again")
    assert DeltacoPolicy.from_pretrained(tmp_path / "again").config.leave_out is None


def test_without_an_instruction_none_is_embedded(dataset):
    policy, before, _ = small_policy(
        dataset,
        **CORRESPONDENCE,
        instruction_dropout=0.5,
        demo_repo_id="test/table",
        demo_root=str(dataset.root),
    )
    policy.forward(before(batch_of(dataset, [0, LENGTH])))
    policy.eval()
    policy.config.leave_out, policy.config.demo_episode = "instruction", 0
    batch = before(batch_of(dataset, [0]))
    known = dict(policy.instructions.rows)
    policy.select_action({**batch, "task": ["a sentence that nobody knows"]})
    assert policy.instructions.rows == known


@pytest.mark.parametrize("method", ["deltaco", "demo_only", "language_only", "one_hot"])
def test_every_method_trains_acts_and_is_the_same_when_it_is_loaded(dataset, tmp_path, method):
    policy, before, _ = small_policy(
        dataset,
        **CORRESPONDENCE,
        method=method,
        demo_repo_id="test/table",
        demo_root=str(dataset.root),
        color_blind_tasks="blue",
        crop_padding=2,
    )
    batch = before(batch_of(dataset, [0, 2, LENGTH, LENGTH + 3]))
    loss, logged = policy.forward(batch)
    loss.backward()
    assert loss.isfinite()
    assert logged["grasp_loss"] > 0
    assert all(parameter.grad is not None for parameter in policy.parameters())
    policy.eval()
    each, _ = policy.forward(batch, reduction="none")
    assert each.shape == (4,)
    observation = {name: batch[name] for name in ("observation.image", "observation.state", "task")}
    policy.reset()
    action = policy.select_action(observation)
    assert action.shape == (4, 3)
    policy.save_pretrained(tmp_path / "saved")
    loaded = DeltacoPolicy.from_pretrained(tmp_path / "saved").eval()
    loaded.reset()
    torch.testing.assert_close(loaded.select_action(observation), action)
    if policy.config.uses_demo:
        saved = loaded.eval_demonstrations.grasp_states
        torch.testing.assert_close(saved, policy.eval_demonstrations.grasp_states)
        # Those of the same dataset, read for training.
        rows = policy.train_demonstrations.episode_rows(loaded.eval_demonstrations.episodes)
        torch.testing.assert_close(saved, policy.goal_trainer.goals.states[rows, 0])
    card = loaded.generate_model_card("test/table", "deltaco", None, None)
    assert "| goal: where to grasp |" in card.text


def test_the_loss_is_a_function_of_the_seed_and_the_step(policy, dataset):
    batch = batch_of(dataset, [0, LENGTH])
    losses = []
    for seed in (1, 2):
        torch.manual_seed(seed)  # of draws that a resumed training would not repeat
        policy.step.zero_()
        losses.append(policy.forward(batch)[0].item())
    assert losses[0] == losses[1]


def test_goals_are_found_in_the_first_image_of_an_episode(policy, dataset):
    policy.forward(batch_of(dataset, [0, LENGTH]))
    policy.eval()
    batch = batch_of(dataset, [0, LENGTH])
    observation = {name: batch[name] for name in ("observation.image", "observation.state", "task")}
    calls = []
    find = policy.goals.find
    policy.goals.find = lambda *arguments: calls.append(1) or find(*arguments)
    for _ in range(3):
        policy.select_action(observation)
    assert len(calls) == 1
    policy.reset()
    policy.select_action(observation)
    assert len(calls) == 2


def test_the_margin_is_added_to_depths(dataset):
    found = []
    for margin in (0.0, 0.5):
        torch.manual_seed(0)
        policy, _, _ = small_policy(dataset, **CORRESPONDENCE, depth_margin=margin)
        batch = batch_of(dataset, [0, LENGTH])
        policy.forward(batch)
        goals = policy.eval().encode_task(tuple(batch["task"]), batch["observation.image"]).goals
        found.append(goals.depths)
    torch.testing.assert_close(found[1], found[0] + 0.5)


def test_depths_can_be_left_out(dataset):
    policy, before, _ = small_policy(dataset, **CORRESPONDENCE, grasp_depth=False)
    batch = before(batch_of(dataset, [0, LENGTH]))
    loss, logged = policy.forward(batch)
    assert loss.isfinite()
    assert logged["depth_loss"] == 0
    goals = policy.eval().encode_task(tuple(batch["task"]), batch["observation.image"]).goals
    assert goals.depths is None
    assert policy.select_action(batch).shape == (2, 3)


def test_several_demonstrations_are_combined(dataset):
    demos = {"demo_repo_id": "test/table", "demo_root": str(dataset.root)}
    torch.manual_seed(0)
    one, _, _ = small_policy(dataset, **CORRESPONDENCE, **demos)
    three, _, _ = small_policy(dataset, **CORRESPONDENCE, **demos, n_demonstrations=3)
    three.load_state_dict(one.state_dict())
    images = batch_of(dataset, [0])["observation.image"]
    found = [policy.eval().encode_task((list(COLORS)[0],), images).goals for policy in (one, three)]
    assert not torch.equal(found[0].logits[:, 0], found[1].logits[:, 0])
    torch.testing.assert_close(found[0].logits[:, 1], found[1].logits[:, 1])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "mcil"}, "cannot be 'correspondence' in the method 'mcil'"),
        ({"film": "demo"}, "can be 'none' or 'language'"),
        ({"encoder_loss": "contrastive"}, "`encoder_loss` 'none'"),
        ({"recolor_share": 1.5}, "`recolor_share` must be at most 1"),
        ({"locator_share": 0.0}, "`locator_share` must be at least 1e-06"),
        ({"n_demonstrations": 0}, "`n_demonstrations` must be at least 1"),
        ({"n_demonstrations": 5, "demo_episode": 0}, "names a single demonstration, .* is 5"),
        ({"gripper_closed": "open"}, "`gripper_closed` must be one of low, high"),
        ({"color_blind_tasks": "("}, "`color_blind_tasks` must be a regular expression"),
        ({"depth_margin": float("nan")}, "`depth_margin` must be a finite number"),
        ({"frames_after_release": -1}, "`frames_after_release` must be at least 0"),
        ({"demo_dropout": 0.1, "method": "demo_only"}, "`demo_dropout` and .* need `method=deltaco`"),
        ({"demo_dropout": 0.5, "instruction_dropout": 0.5}, "must sum to less than 1"),
        ({"film": "language", "instruction_dropout": 0.5}, "`film` and `concat` must be 'none'"),
        ({"leave_out": "demo", "instruction_dropout": 0.5}, "`demo_dropout` is 0"),
        ({"leave_out": "language", "demo_dropout": 0.5}, "`leave_out` must be one of demo, instruction"),
    ],
)
def test_what_cannot_be_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        DeltacoConfig(device="cpu", **{"demo_encoder": "correspondence", **options})


def test_it_needs_a_gripper(dataset):
    with pytest.raises(ValueError, match=r"needs the feature 'observation.state' and a gripper"):
        small_policy(dataset, **CORRESPONDENCE, gripper="none")


def test_a_demonstration_camera_must_exist(dataset):
    with pytest.raises(ValueError, match=r"`demo_camera` must be one of .*observation.image"):
        small_policy(dataset, demo_camera="observation.images.wrist")
