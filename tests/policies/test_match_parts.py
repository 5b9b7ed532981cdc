"""What `deltaco_match` consists of: keyframes, calibration, heights, places, feature matching."""

import numpy as np
import pytest
import torch
from small_policies import TABLE_SIZE, draw_table, random_moves, state_at

from lerobot_deltaco.data.demonstrations import RobotData
from lerobot_deltaco.data.grasps import (
    Keyframes,
    find_grasps,
    find_keyframes,
    follows_gripper,
    warn_of_missing,
)
from lerobot_deltaco.data.gripper_direction import is_inverted, warn_if_inverted
from lerobot_deltaco.policies.base.configuration import has_bfloat16
from lerobot_deltaco.policies.base.losses import location_loss
from lerobot_deltaco.policies.base.networks import gaussian_maps
from lerobot_deltaco.policies.deltaco_match import fit, proposals
from lerobot_deltaco.policies.deltaco_match.background import N_OBJECTS, Background
from lerobot_deltaco.policies.deltaco_match.calibration import StateToImage
from lerobot_deltaco.policies.deltaco_match.color_jitter import change_colors, random_color_changes
from lerobot_deltaco.policies.deltaco_match.crops import FEATURE_DIM, cut_crops, fit_perspective
from lerobot_deltaco.policies.deltaco_match.fit import fit_matching_head
from lerobot_deltaco.policies.deltaco_match.grasp_height import GraspHeightEstimator
from lerobot_deltaco.policies.deltaco_match.localization import Candidates, FeatureMatching
from lerobot_deltaco.policies.deltaco_match.place import TARGET_DIM, PlaceNetwork, peak_locations
from lerobot_deltaco.policies.deltaco_match.proposals import peaks
from lerobot_deltaco.policies.deltaco_match.settings import MatchingSettings
from lerobot_deltaco.policies.deltaco_match.states import RobotStates
from lerobot_deltaco.policies.deltaco_match.words import encode_words, understand, vocabulary_of

# Keyframes


def grasp_frames(gripper, spans):
    """Returns the frames of the grasp and of the release of each episode; None where there is no grasp."""
    return [
        None if isinstance(found, str) else (found.grasp, found.release)
        for found in find_grasps(gripper, spans)
    ]


def test_last_grasp_that_is_released_counts():
    states = torch.tensor([0, 1, 2, 3, 4, 5, 4.5, 4, 0, 0, 0, 0, 0, 0])[:, None]
    gripper = torch.tensor([1, -1, 1, 1, -1, -1, 1, 1, -1, 1.0, 1, 1, -1, -1])
    spans = [(0, 7), (8, 10), (11, 13)]
    keyframes = find_keyframes(states, gripper, spans)
    assert keyframes.has_grasp.tolist() == [True, False, False]
    # One step after the command to close, and the step of the command to open.
    assert keyframes.states[0, :, 0].tolist() == [5, 4.5]
    assert keyframes.approach[0, 0] == 2
    assert keyframes.carried.tolist() == [5, 8, 11]
    assert not keyframes.states[1:].any()
    assert keyframes.pick_states[:, 0].isnan().tolist() == [False, True, True]
    assert grasp_frames(gripper, spans) == [(4, 6), None, None]


def ramps(*values, frames=10):
    """Returns a course that goes from each value to the next in some frames, and rests there for as many."""
    parts = [np.linspace(a, b, frames) for a, b in zip(values[:1] + values, values, strict=False)]
    return np.concatenate([np.concatenate([part, np.full(frames, part[-1])]) for part in parts])


def test_each_course_of_a_gripper_has_its_own_grasp():
    for values, closes, opens in [
        ((1, 0, 1), 30, 50),
        ((0, 1, 0.3, 1, 0), 50, 70),  # at rest, it is closed; the object holds it open
        ((1, 0.4, 0.7), 30, 50),  # it opens less after the release
        ((1, 0, 1, 0, 1), 70, 90),  # it slips: the last grasp counts
        ((0, 0.2, 0.1, 0.2), 50, 70),  # of another episode's scale
        ((0, 1, 0, 0.3, 0), 50, 70),  # it opens little after the release
        ((0.1, 0.6, 0.5, 0.6, 0.1), 50, 70),  # the object is wide
        ((1, 0, 0.2, 0, 1), 30, 90),  # its hold on the object loosens
        ((0, 1, 0, 1, 0, 0.2, 0), 50, 70),  # it trembles at rest
    ]:
        noise = np.random.default_rng(0).normal(0, 0.01 * max(values), 20 * len(values))
        course = torch.from_numpy(ramps(*values) + noise)
        ((grasp, release),) = grasp_frames(course, [(0, len(course) - 1)])
        # Within the ramps, each of which takes 10 frames.
        assert closes - 10 <= grasp <= closes
        assert opens - 10 <= release <= opens


def test_glitches_of_a_frame_or_two_are_no_openings():
    course = torch.from_numpy(ramps(0, 1, 0, 1, 0))
    (expected,) = grasp_frames(course, [(0, 99)])
    for frame in (5, 45, 55, 85):
        for glitch in (-50, 100, torch.nan):
            glitched = course.clone()
            glitched[frame : frame + 2] = glitch
            (found,) = find_grasps(glitched, [(0, 99)])
            if glitch is torch.nan:
                assert found == f"the gripper's command is not finite in frame {frame}"
            else:
                assert (found.grasp, found.release) == pytest.approx(expected, abs=2)


def test_approach_and_opening_scale_with_the_course():
    slow = torch.from_numpy(ramps(0, 1, 0, 1, 0, frames=30))
    states = torch.arange(len(slow)).float()[:, None]
    (found,) = find_grasps(slow, [(0, len(slow) - 1)])
    # It closes in the frames 120 to 150, and opens in 180 to 210.
    assert 130 <= found.closing <= 140 <= found.grasp <= 150
    assert 180 < found.release < 190 < 200 < found.opened <= 210
    # A 30th of the episode before the gripper begins to close.
    assert find_keyframes(states, slow, [(0, len(slow) - 1)]).approach[0, 0] == found.closing - 10


def test_keyframes_are_the_states_after_the_commands():
    frames = torch.arange(40)
    gripper = 1 - 2.0 * ((frames >= 5) & (frames < 30))
    keyframes = find_keyframes(frames[:, None], gripper, [(0, 39)])
    assert keyframes.states.flatten().tolist() == [6, 30]
    assert keyframes.carried.tolist() == [18]


def test_a_state_holds_while_the_command_is_to_stay():
    for close, stay, opened in ((0, 1, 2), (-1, 0, 1), (-2, -1, 0)):
        course = [stay, opened, stay, stay, close, stay, stay, stay, opened, stay, stay]
        courses = torch.tensor([*course, *course]).float()
        assert grasp_frames(courses, [(0, 10), (11, 21)]) == [(4, 8), (15, 19)]


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ((1, 0), "the gripper does not open again"),
        ((0, 1), "the gripper opens, but does not close before"),
        ((0, 1, 0), "the gripper opens and closes, but does not open again"),
        ((1, 1), "the gripper does not move"),
    ],
)
def test_a_gripper_at_rest_grasps_nothing(values, reason, caplog):
    course = torch.from_numpy(ramps(*values))
    spans = [(0, len(course) - 1)]
    assert find_grasps(course, spans) == [reason]
    keyframes = find_keyframes(torch.zeros(len(course), 1), course, spans)
    warn_of_missing(keyframes, [7], "are not trained on")
    refusal = f"1 of 1 episodes have no grasp, and are not trained on: in 1, such as episode 7, {reason}."
    assert refusal in caplog.text


def test_trembles_and_noise_are_no_grasps():
    courses = [ramps(1, 0, 1), ramps(1, 0, 1), 1 - 0.05 * ramps(1, 0, 1)]
    starts = np.cumsum([0, *map(len, courses)]).tolist()
    spans = [(start, end - 1) for start, end in zip(starts, starts[1:], strict=False)]
    assert find_grasps(torch.from_numpy(np.concatenate(courses)), spans)[2] == "the gripper only trembles"
    alone, span = torch.from_numpy(courses[2]), [(0, len(courses[2]) - 1)]
    assert find_grasps(alone, span, usual=1.0) == ["the gripper only trembles"]
    noise = torch.from_numpy(np.random.default_rng(0).normal(0, 0.01, 200))
    assert find_grasps(noise, [(0, 199)]) == ["the gripper only trembles"]


def moved_while_closed(course, n_episodes=6):
    """Episodes of a course in which an object moves while the course is low, after an opening."""
    length = len(course)
    ((grasp, release),) = grasp_frames(torch.from_numpy(course), [(0, length - 1)])
    images = torch.full((n_episodes, length, 3, 16, 16), 100, dtype=torch.uint8)
    images += torch.randint(0, 9, images.shape, dtype=torch.uint8)
    for n, own in enumerate(images):
        own[:grasp, :, 2 * n : 2 * n + 2, 1:3] = 255
        own[release:, :, 2 * n : 2 * n + 2, 12:14] = 255
    # The arm ends elsewhere.
    images[..., 6:9] = torch.linspace(0, 255, length).to(torch.uint8)[:, None, None, None]
    spans = [(n * length, (n + 1) * length - 1) for n in range(n_episodes)]
    return RobotData(torch.zeros(1), torch.zeros(1), spans, lambda rows: images.flatten(0, 1)[rows])


# At rest at both ends, closed first or last, open at both ends.
@pytest.mark.parametrize("values", [(0, 1, 0, 1, 0), (0, 1, 0, 1), (1, 0, 1, 0), (1, 0, 1)])
def test_images_tell_which_values_close_a_gripper(values, caplog):
    course = ramps(*values)
    data, gripper = moved_while_closed(course), torch.from_numpy(np.tile(course, 6))
    assert is_inverted(gripper, data) is False
    assert is_inverted(-gripper, data) is True
    warn_if_inverted(gripper, data, "low")
    assert not caplog.text
    warn_if_inverted(-gripper, data, "low")
    assert "Set --policy.gripper_closed=high." in caplog.text
    caplog.clear()
    # Without images, only the option is named.
    warn_if_inverted(-gripper, data._replace(images=None), "high")
    assert "Set" not in caplog.text


def test_a_gripper_that_only_picks_is_not_taken_for_an_inverted_one(caplog):
    course = torch.from_numpy(ramps(0, 1, 0))
    images = torch.full((len(course), 3, 8, 8), 100, dtype=torch.uint8)
    images[:52, :, 1:3, 1:3] = 255  # the object is lifted after the gripper has closed
    data = RobotData(torch.zeros(1), torch.zeros(1), [(0, len(course) - 1)], lambda rows: images[rows])
    assert is_inverted(course, data) is None
    warn_if_inverted(course, data, "low")
    assert "Look at a recording: if high values mean closed, set --policy.gripper_closed=high" in caplog.text


def test_states_of_the_gripper_are_those_that_follow_its_commands():
    generator = torch.Generator().manual_seed(0)
    gripper = torch.randn(60, generator=generator).sign()
    arm = torch.randn(60, generator=generator)
    opening = torch.cat([gripper.new_ones(1), 0.02 + 0.5 * gripper[:-1]])
    late = torch.cat([gripper.new_ones(3), gripper[:-3]])
    states = torch.stack([arm, opening, torch.full((60,), 7.0), -opening, late], dim=1)
    assert follows_gripper(states, gripper, [(0, 29), (30, 59)]).tolist() == [False, True, False, True, True]


def stacked_images(images):
    return torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2).contiguous()


def test_changes_alone_tell_where_states_are_in_the_image():
    moves = random_moves(60)
    first = stacked_images([draw_table(task, start, other) for task, start, other, _ in moves])
    last = stacked_images([draw_table(task, end, other) for task, _, other, end in moves])
    starts = np.stack([start for _, start, _, _ in moves])
    states = torch.from_numpy(np.stack([state_at(start) for start in starts])).float()
    # Velocities are large while the arm moves, but only noise at a grasp.
    velocities = 0.05 * torch.randn(len(states), 5, generator=torch.Generator().manual_seed(0))
    scale = torch.cat([1 / states.std(dim=0), torch.ones(5)])
    states = torch.cat([states, velocities], dim=1)
    to_image = StateToImage(states.shape[1])
    to_image.fit(first, last, last, states, scale)
    errors = (to_image(states) - torch.from_numpy(starts).float()).norm(dim=1) * TABLE_SIZE / 2  # px
    assert errors.median() < 1
    assert errors.max() < 2.5


@pytest.mark.parametrize("carried_elsewhere", [True, False])
def test_a_robot_that_ends_where_the_object_tells_is_not_taken_for_the_object(carried_elsewhere):
    """Without the images on the way, nothing tells the object's place from that of the robot at the end."""
    moves, rng = random_moves(120), np.random.default_rng(0)
    starts = np.stack([start for _, start, _, _ in moves])

    def with_robot(task, other, location):
        image = draw_table(task, location, other)
        column, row = ((location + 1) * TABLE_SIZE / 2).astype(int)
        image[max(0, row - 5) : row + 5, max(0, column - 5) : column + 5] = 255
        return image

    first = stacked_images([draw_table(task, start, other) for task, start, other, _ in moves])
    last = stacked_images([with_robot(task, other, -start) for task, start, other, _ in moves])
    on_the_way = [with_robot(task, other, rng.uniform(-0.9, 0.9, 2)) for task, _, other, _ in moves]
    states = torch.from_numpy(np.stack([state_at(start) for start in starts])).float()
    to_image = StateToImage(states.shape[1])
    carried = stacked_images(on_the_way) if carried_elsewhere else last
    to_image.fit(first, carried, last, states, 1 / states.std(dim=0).clamp_min(1e-3))
    errors = (to_image(states) - torch.from_numpy(starts).float()).norm(dim=1) * TABLE_SIZE / 2  # px
    assert (errors.median() < 1) == carried_elsewhere


def test_states_that_tell_nothing_of_the_image_are_warned_of(caplog):
    moves = random_moves(120)
    first = stacked_images([draw_table(task, start, other) for task, start, other, _ in moves])
    last = stacked_images([draw_table(task, end, other) for task, _, other, end in moves])
    states = torch.randn(len(moves), 3, generator=torch.Generator().manual_seed(0))
    StateToImage(3).fit(first, last, last, states, torch.ones(3))
    assert "the locations are probably wrong" in caplog.text


class ExactLocations(torch.nn.Module):
    """Inverts how `grasps` makes states from locations."""

    def fit(self, *_): ...

    def forward(self, states):
        x, y, z = states[..., 0] - 2, states[..., 1], states[..., 2]
        return torch.stack([x, (y - z * 0.2 / 3) / (5 - x * 0.2 / 3)], dim=-1)


def grasps(heights):
    """Keyframes whose states are of a location, a height and the gripper's width; and the locations."""
    generator = torch.Generator().manual_seed(0)
    locations = torch.rand(200, 2, 2, generator=generator) * 1.6 - 0.8
    x, y = locations.unbind(dim=2)
    height = torch.stack([heights, torch.zeros(200)], dim=1)  # of grasps alone
    width = torch.rand(200, 2, generator=generator) * 40
    states = torch.stack([2 + x, 5 * y + 0.2 * height, 3 * height + x * y, width], dim=2)
    approach = states[:, 0] - torch.tensor([0, 0.2, 3, 0])
    has_grasp = torch.arange(200) % 10 > 0
    return Keyframes(
        states, approach, torch.zeros(200, dtype=torch.long), has_grasp, (None,) * 200
    ), locations


def fitted_states(keyframes):
    robot_states = RobotStates(4)
    robot_states.to_image = ExactLocations()
    images = torch.zeros(200, 3, 2, 2, dtype=torch.uint8)
    scale, shift = torch.tensor([0.5, 2, 0.1, 1]), torch.tensor([1.0, 0, -1, 0])
    is_arm = torch.tensor([True, True, True, False])
    return (
        robot_states,
        robot_states.fit(keyframes, images, images, images, scale, shift, is_arm),
        (scale, shift),
    )


def test_how_far_the_gripper_is_open_says_nothing_about_locations():
    generator = torch.Generator().manual_seed(0)
    keyframes, _ = grasps(torch.zeros(200))
    images = torch.randint(256, (3, 200, 3, 8, 8), generator=generator).to(torch.uint8)
    robot_states = RobotStates(4)
    robot_states.fit(keyframes, *images, torch.ones(4), torch.zeros(4), torch.arange(4) < 3)
    states = keyframes.states[:, 0]
    other = states + torch.tensor([0.0, 0, 0, 5])
    assert torch.equal(robot_states.to_image(other), robot_states.to_image(states))


def test_heights_are_what_locations_do_not_tell_of_states():
    heights = torch.randn(200, generator=torch.Generator().manual_seed(1))
    keyframes, locations = grasps(heights)
    robot_states, known, (scale, shift) = fitted_states(keyframes)
    found = keyframes.has_grasp
    torch.testing.assert_close(known.locations[found, 0], locations[found, 0], atol=0.1, rtol=0)
    assert not known.locations[~found].any()
    assert torch.corrcoef(torch.stack([known.heights[found], heights[found]]))[0, 1] > 0.98
    assert known.heights[found].std() == pytest.approx(1, abs=0.05)
    # Locations and heights give the states; without the heights, that of the grasp is not known.
    true = keyframes.states * scale + shift
    predicted = robot_states(known.locations, known.heights)
    torch.testing.assert_close(predicted[found, 0, :3], true[found, 0, :3], atol=0.1, rtol=0)
    error = (robot_states(known.locations, torch.zeros(200)) - predicted)[found, 0].abs().mean(dim=0)
    assert error[2] > 0.1
    assert error[0] < 0.02
    assert robot_states.heights(torch.full((1, 4), torch.nan)).isnan().all()
    # All heights are zero if all grasps have the same.
    keyframes, locations = grasps(torch.zeros(200))
    flat = keyframes.states.clone()
    flat[..., 1], flat[..., 2], flat[..., 3] = 5 * locations[..., 1], 0, 1
    robot_states, known, _ = fitted_states(keyframes._replace(states=flat))
    assert not robot_states.height_to_state.any()
    assert not known.heights.any()


def test_height_of_a_demonstration_counts_as_far_as_it_can_be_trusted():
    torch.manual_seed(0)
    n, dim = 256, 8
    estimator = GraspHeightEstimator(dim)
    optimizer = torch.optim.Adam(estimator.parameters(), lr=1e-2)

    def samples():
        is_same = torch.arange(n) % 2 == 0
        heights = torch.randn(n)
        demonstrated = torch.where(is_same, heights, torch.randn(n))
        return torch.randn(n, dim), torch.where(is_same, 0.9, 0.2), demonstrated, heights

    for _ in range(150):
        loss = estimator.losses(*samples()).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    features, similarity, demonstrated, heights = samples()
    found, is_same = estimator(features, similarity, demonstrated), similarity > 0.5
    assert (found - heights)[is_same].abs().mean() < 0.1
    # Another object's height counts little, and an unknown one not at all.
    by_appearance = estimator(features, similarity, demonstrated * torch.nan)
    assert by_appearance.isfinite().all()
    change = (found - by_appearance)[~is_same].abs().mean()
    assert change < 0.5 * (demonstrated - by_appearance)[~is_same].abs().mean()


def test_hue_augmentation_changes_a_fraction_of_the_samples_and_leaves_gray_gray():
    changes = random_color_changes(400, 0.7, torch.Generator().manual_seed(0))
    same = (changes == torch.eye(3)).all(dim=(1, 2))
    assert 0.2 < same.float().mean() < 0.4
    gray = change_colors(torch.full((400, 3, 2, 2), 0.4), changes)
    torch.testing.assert_close(gray, gray[:, :1].expand_as(gray))
    images = torch.rand(400, 2, 3, 4, 4)
    changed = change_colors(images, changes)
    assert changed.shape == images.shape
    assert ((changed >= 0) & (changed <= 1)).all()
    torch.testing.assert_close(changed[same], images[same])
    # All images of a sample change alike.
    torch.testing.assert_close(change_colors(images[:, 0], changes), changed[:, 0])


def test_peak_of_a_map_is_its_location():
    locations = torch.rand(5, 2, 2, generator=torch.Generator().manual_seed(0)) * 1.6 - 0.8
    maps = gaussian_maps(locations, 24, 32, 0.1)
    torch.testing.assert_close(peak_locations(20 * maps), locations, atol=0.03, rtol=0)
    found, logits = torch.tensor([[[-0.5, 0.2], [0.6, -0.4]]]), torch.tensor([[0.2, 0.8]]).log()
    candidates = Candidates(found, logits, torch.zeros(1, 2))
    maps = candidates.map((24, 30))
    assert maps.shape == (1, 24, 30)
    torch.testing.assert_close(peak_locations(maps[:, None])[0, 0], candidates.best[0][0], atol=0.05, rtol=0)


def test_the_demonstration_or_the_instruction_says_where():
    torch.manual_seed(0)
    network = PlaceNetwork(5).eval()
    scenes, last = torch.rand(2, 3, 16, 16), torch.rand(2, 3, 16, 16)
    attention = torch.rand(2, 8, 8).flatten(1).softmax(dim=1).view(2, 8, 8)
    target, nothing = network.target(last, attention), torch.zeros(2, TARGET_DIM)
    assert target.shape == nothing.shape
    instruction = torch.randn(2, 5)
    inputs = [(words, to) for words in (instruction, 0 * instruction) for to in (target, nothing)]
    with torch.no_grad():
        maps = [network(scenes, *each) for each in inputs]
    assert maps[0].shape == (2, 8, 8)
    assert len({float(each.sum()) for each in maps}) == 4


# Feature matching

SIZE = 48
SHAPE_TASKS = ["move the ring left", "move the cross right"]


def draw_shapes(task, moved, other):
    """Draws a ring and a cross of 9 x 9 px and one color on a gray table, the task's first."""
    image = np.full((SIZE, SIZE, 3), 150, np.uint8)
    y, x = np.mgrid[-4:5, -4:5]
    ring, cross = (np.hypot(x, y) < 4.6) & (np.hypot(x, y) > 2.2), (abs(x) < 1.5) | (abs(y) < 1.5)
    masks = (ring, cross) if "ring" in task else (cross, ring)
    for mask, location in zip(masks, (moved, other), strict=True):
        column, row = (round((c + 1) * SIZE / 2) for c in location)
        image[row - 4 : row + 5, column - 4 : column + 5][mask] = (60, 90, 160)
    return image


@pytest.fixture(scope="module")
def shapes():
    """First images, locations of the grasps, and tasks of episodes."""
    moves = random_moves(36, SHAPE_TASKS)
    images = stacked_images([draw_shapes(*move[:3]) for move in moves])
    locations = torch.tensor(np.stack([move[1] for move in moves]), dtype=torch.float32)
    return images, locations, [move[0] for move in moves]


NEEDS_BFLOAT16 = pytest.mark.skipif(not has_bfloat16(), reason="emulated bfloat16 takes minutes")


@pytest.fixture(
    scope="module",
    params=[pytest.param(False, id="float32"), pytest.param(True, id="bfloat16", marks=NEEDS_BFLOAT16)],
)
def matching(shapes, request):
    """A feature matching that is fitted to 24 of the episodes."""
    images, locations, tasks = (part[:24] for part in shapes)
    short = MatchingSettings(
        proposal_steps=120,
        min_proposal_batch=16,
        max_proposal_batch=16,
        min_matching_steps=60,
        matching_batch=32,
    )
    matching = FeatureMatching(vocabulary_of(SHAPE_TASKS), 0.25, short)
    sentences, heights = {task: [task] for task in tasks}, torch.zeros(24)
    # As in the first step of a policy's training.
    with torch.autocast("cpu", torch.bfloat16), torch.autocast("cpu", enabled=False):
        matching.fit(
            *(images, images, images, locations, heights, tasks, sentences),
            seed=0,
            in_bfloat16=request.param,
        )
    assert matching.fitted
    return matching


def fraction_found(matching, shapes, by_demonstration=False, words=lambda task: "", grasp=None):
    """Fraction of the other 12 episodes in which the object is found, by other episodes or by words.

    With `grasp`, the gripper closes there, and only the attention tells where the object was.
    """
    images, locations, tasks = (part[24:] for part in shapes)
    scenes = images.float() / 255
    shown = [(n + 2) % 12 for n in range(12)]
    described = demonstrated = None
    if by_demonstration:
        attended = locations[shown]
        grasps = attended if grasp is None else torch.full_like(attended, grasp)
        described = matching.describe(scenes[shown], scenes[shown], grasps, attended)
        demonstrated = torch.zeros(12)
    candidates = matching.find(scenes, scenes, [*map(words, tasks)], described, demonstrated)
    assert candidates.locations.shape == (12, N_OBJECTS, 2)
    torch.testing.assert_close(candidates.log_probabilities.exp().sum(dim=1), torch.ones(12))
    return ((candidates.best[0] - locations).abs().amax(dim=1) < 0.2).float().mean()


def test_fit_finds_shapes_of_one_color_by_demonstrations_and_by_words(matching, shapes):
    assert fraction_found(matching, shapes, by_demonstration=True) >= 0.9
    assert fraction_found(matching, shapes, words=lambda task: task) >= 0.9
    assert fraction_found(matching, shapes, words=lambda task: "RING!" if "ring" in task else "cros") > 0.7
    # Unknown words leave the demonstration in charge, and known ones still count.
    assert fraction_found(matching, shapes, True, lambda task: "the gizmo") >= 0.9
    assert fraction_found(matching, shapes, words=lambda task: "a b c") < 0.8
    assert fraction_found(matching, shapes, True, lambda task: "?!") >= 0.9
    # An object that was pushed before its grasp is found where it was.
    for grasp in (2.0, torch.nan):
        assert fraction_found(matching, shapes, True, grasp=grasp) >= 0.9


def test_certainty_is_limited_by_the_number_of_held_out_episodes(matching, shapes):
    n_right, n_all = matching.held_out.tolist()
    assert n_all == 4
    assert matching.report == f"object found in {n_right} of 4 held-out episodes"
    scenes = shapes[0][24:].float() / 255
    candidates = matching.find(scenes, scenes, [*shapes[2][24:]], None, None)
    assert candidates.log_probabilities.exp().max() < 0.9


def test_words_that_describe_another_object_do_not_outweigh_a_clear_demonstration(matching, shapes):
    def other_shape(task):
        return SHAPE_TASKS[task == SHAPE_TASKS[0]]

    assert fraction_found(matching, shapes, words=other_shape) <= 0.2
    assert fraction_found(matching, shapes, True, other_shape) >= 0.8


def test_fit_is_a_function_of_its_seed_and_trains_nothing_but_itself(shapes, short_fit):
    images, locations, tasks = (part[:8] for part in shapes)
    state = torch.get_rng_state()
    fitted = []
    for seed in (0, 0, 1):
        matching = FeatureMatching(vocabulary_of(tasks), 0.25).train()
        torch.set_rng_state(state)
        sentences = {task: [task] for task in tasks}
        matching.fit(images, images, images, locations, torch.zeros(8), tasks, sentences, seed)
        assert torch.equal(torch.get_rng_state(), state)
        assert not any(weights.requires_grad for weights in matching.parameters())
        assert not any(module.training for module in matching.modules())
        fitted.append(dict(matching.state_dict()))
    assert all(torch.equal(fitted[0][name], fitted[1][name]) for name in fitted[0])
    assert not torch.equal(fitted[0]["compare.hidden.weight"], fitted[2]["compare.hidden.weight"])


@pytest.mark.parametrize(("n_images", "n_scenes"), [(3, 24), (20, 40), (100, 48)])
def test_a_step_of_the_proposals_fit_has_more_scenes_if_there_are_more(n_images, n_scenes, monkeypatch):
    seen = []

    def loss(maps, locations):
        seen.append(len(maps))
        return location_loss(maps, locations)

    monkeypatch.setattr(proposals, "location_loss", loss)
    images = torch.zeros(n_images, 3, 16, 16, dtype=torch.uint8)
    autocast = torch.autocast("cpu", enabled=False)
    proposals.ProposalNetwork().fit(
        images, torch.zeros(n_images, 2), torch.Generator(), autocast, MatchingSettings(proposal_steps=5)
    )
    assert seen == [n_scenes] * 5


@pytest.mark.parametrize(("n_scenes", "steps"), [(8, 2), (24, 6), (80, 9)])
def test_steps_of_the_fit_follow_the_number_of_scenes(n_scenes, steps, monkeypatch, short_fit):
    draws, draw = [], fit.EpisodePairs.draw
    monkeypatch.setattr(fit.EpisodePairs, "draw", lambda *own: draws.append(1) or draw(*own))
    settings = MatchingSettings(
        proposal_steps=1, grasp_radius=9.0, min_matching_steps=2, max_matching_steps=9
    )
    matching = FeatureMatching(["task"], 0.25, settings)
    images = torch.zeros(n_scenes, 3, 16, 16, dtype=torch.uint8)
    tasks, sentences = ["task"] * n_scenes, {"task": ["task"]}
    matching.fit(*[images] * 3, torch.zeros(n_scenes, 2), torch.zeros(n_scenes), tasks, sentences, 0)
    assert len(draws) == 1 + steps  # the first, for the scales


def test_words_that_describe_the_container_do_not_count():
    """The color of an object and that of its container vary independently. A proposal is background."""
    tasks = [f"put the {color} cube in the {bin} bin" for color in ("red", "blue") for bin in ("red", "blue")]
    generator = torch.Generator().manual_seed(0)
    matching = FeatureMatching(vocabulary_of(tasks), 0.25, MatchingSettings(matching_batch=32))
    # Crops in which only the color can be seen, of two objects, and of the background.
    n_scenes = 256
    task = torch.arange(n_scenes) % 4
    target = torch.randint(2, (n_scenes,), generator=generator)
    color = torch.where(torch.arange(2) == target[:, None], task[:, None] // 2, 1 - task[:, None] // 2)
    features = torch.randn(n_scenes, 3, FEATURE_DIM, generator=generator)
    features[:, :2, :100] += 4.0 * color[..., None]
    features[:, 2, 100:200] += 4.0
    matching.requires_grad_(True)
    sentences = {text: [text] for text in tasks}
    drawn = [tasks[n] for n in task]
    autocast = torch.autocast("cpu", enabled=False)
    fit_matching_head(
        *(matching, features[None], target, torch.zeros(n_scenes)),
        *(drawn, sentences, generator, 150, autocast),
    )
    sentence = "Putt the red cubee in the red bin"
    weights = matching.word_weights(encode_words([sentence], matching.vocabulary))[0]
    assert weights[2] > 0.7
    assert weights[[0, 1, 4, 5, 6, 7]].max() < 0.3, weights
    assert ("red", "red") in matching.understood(sentence)
    assert len(matching.understood(sentence)) < 4
    assert matching.understood("") == []


def test_fit_needs_a_task_with_two_grasps(shapes):
    images, locations, tasks = (part[:6] for part in shapes)
    locations = torch.where(torch.arange(6)[:, None] < 2, locations, torch.nan)
    with pytest.raises(ValueError, match="at least two episodes .* 2 such episodes are of 2 different tasks"):
        FeatureMatching([], 0.25).fit(images, images, images, locations, torch.zeros(6), tasks, {}, 0)


def draw_objects(side, locations, shape=(96, 96), seed=0):
    """Draws squares of a side, px, and at locations (n, 2) on a noisy table with a rim."""
    rng = np.random.default_rng((seed, side))
    height, width = shape
    image = np.full((height, width, 3), 140.0)
    image[:4] = image[-4:] = 60
    for (x, y), color in zip(locations, [(200, 60, 50), (90, 90, 90), (60, 80, 190)], strict=False):
        column, row = round((x + 1) * width / 2 - side / 2), round((y + 1) * height / 2 - side / 2)
        image[row : row + side, column : column + side] = color
    return np.clip(image + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8)


def random_places(rng, n=3, distance=0.65):
    """Returns locations in -0.65..0.65 that are apart, (n, 2)."""
    while True:
        places = rng.uniform(-0.65, 0.65, (n, 2))
        if min(np.hypot(*(places[a] - places[b])) for a in range(n) for b in range(a)) > distance:
            return places


@pytest.mark.parametrize("side", [4, 8, 16, 24])
def test_objects_of_any_size_stand_out_whether_they_were_grasped_or_not(side):
    """Only the first object is ever grasped, and the last is new."""
    rng = np.random.default_rng(side)
    places = np.stack([random_places(rng, distance=0.7 if side > 20 else 0.5) for _ in range(44)])
    drawn = [draw_objects(side, own[: 2 if n < 24 else 3], seed=n) for n, own in enumerate(places)]
    images = torch.tensor(np.stack(drawn)).permute(0, 3, 1, 2)
    background, locations = Background(), torch.tensor(places, dtype=torch.float32)
    remembered = background.fit(images[:24], locations[:24, 0], torch.Generator())
    assert float(background.object_size) == pytest.approx(side / 96, rel=0.35, abs=0.015)
    proposed = background(images[24:])
    distances = (proposed[:, :, None] - locations[24:, None]).norm(dim=3).amin(dim=1)  # (scenes, objects)
    assert (distances < 0.6 * side / 96).float().mean() > 0.9
    # A training scene is not compared with itself.
    distances = (background(images[:24], remembered)[:, :, None] - locations[:24, None, :2]).norm(dim=3)
    assert (distances.amin(dim=1) < 0.6 * side / 96).float().mean() > 0.85


def test_a_checkpoint_of_an_earlier_fit_keeps_its_proposals_and_crops():
    matching = FeatureMatching(["cup"], 0.2)
    matching.perspective.copy_(torch.tensor([0.0, 0.5]))
    earlier = {
        name: value
        for name, value in matching.state_dict().items()
        if not name.startswith(("background.", "compare.feature_weight", "compare.objectness"))
        and name not in ("uses_background", "sharpness", "error_rate", "held_out")
    }
    loaded = FeatureMatching(["cup"], 0.2)
    loaded.load_state_dict(earlier)
    assert not loaded.uses_background
    sizes = loaded.crop_sizes(torch.tensor([[0.0, 0.0], [0.0, 1.0]]))
    torch.testing.assert_close(sizes, 0.2 * torch.tensor([0.0, 0.5]).exp())
    del earlier["compare.hidden.weight"]
    with pytest.raises(RuntimeError, match=r"compare\.hidden\.weight"):
        FeatureMatching(["cup"], 0.2).load_state_dict(earlier)


def test_crops_are_centered_and_see_the_native_resolution():
    images = torch.zeros(1, 3, 90, 120, dtype=torch.uint8)
    images[0, :, 60:64, 30:34] = 255
    locations = torch.tensor([[[-0.4667, 0.3778], [0.9, -0.9]]])
    crops = cut_crops(images, locations, torch.full((1, 2), 0.2), resolution=24)
    assert crops.shape == (1, 2, 3, 24, 24)
    assert (crops[0, 0, 0] > 0.5).nonzero().float().mean(dim=0).tolist() == pytest.approx([11.5] * 2, abs=0.6)
    assert not crops[0, 1].any()


def test_the_perspective_is_that_of_what_disappears():
    """Squares that are larger further down are gone at the end of an episode."""
    generator = torch.Generator().manual_seed(0)
    first = torch.full((60, 3, 96, 96), 100, dtype=torch.uint8)
    last, locations = first.clone(), torch.rand(60, 2, generator=generator) * 1.4 - 0.7
    for image, (x, y) in zip(first, locations.tolist(), strict=True):
        half = 6 * np.exp(0.6 * y)
        rows, columns = (slice(round(48 * (1 + c) - half), round(48 * (1 + c) + half)) for c in (y, x))
        image[:, rows, columns] = 200
    across, down = fit_perspective(first, last, locations)
    assert across == pytest.approx(0, abs=0.1)
    assert down == pytest.approx(0.6, abs=0.15)
    assert not fit_perspective(first, first, locations).any()


def test_peaks_are_apart_and_ordered():
    maps = torch.full((1, 20, 30), -9.0)
    for row, column, value in ((4, 5, 3.0), (4, 6, 2.9), (15, 20, 2.0), (8, 27, 1.0)):
        maps[0, row, column] = value
    x, y = peaks(maps, 3)[0].T
    assert x.tolist() == pytest.approx([-0.6, 20.5 / 15 - 1, 27.5 / 15 - 1], abs=0.04)
    assert y.tolist() == pytest.approx([-0.55, 0.55, -0.15], abs=0.03)


def test_words_are_understood():
    vocabulary = vocabulary_of(["Put the red cup in.", "Put 2 yellow bowls in."])
    assert vocabulary == ["2", "bowls", "cup", "in", "put", "red", "the", "yellow"]
    understood = understand("put RED yelow bowls, inn the jar 2!", vocabulary)
    assert understood == ["put", "red", "yellow", "bowls", None, "the", None, "2"]
    assert encode_words(["the cup", "", "x"], vocabulary).tolist() == [[8, 4], [0, 0], [1, 0]]
    assert encode_words(["", "?!"], vocabulary).tolist() == [[0], [0]]
    # Equal text has equal words, and marks stay with their letters.
    assert vocabulary_of(["Cafe\u0301 हिन्दी"]) == vocabulary_of(["café हिन्दी"]) == ["café", "हिन्दी"]
    # Languages without spaces have a word for each character.
    vocabulary = vocabulary_of(["把红色的杯子放进左边的盒子", "赤いカップを左の箱に"])
    assert understand("红色的箱 cup", vocabulary) == ["红", "色", "的", "箱", None]
