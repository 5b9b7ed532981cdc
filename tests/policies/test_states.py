"""The robot's states at locations, and the height offsets of grasps."""

from typing import NamedTuple

import numpy as np
import pytest
import torch

from gym_deltaco.robot.kinematics import forward, inverse
from lerobot_deltaco.data.grasps import GraspStates
from lerobot_deltaco.policies.geometry.states import StateRegressor


class ExactLocations(torch.nn.Module):
    """Inverts how `random_grasps` makes states from locations."""

    has_camera = False

    def fit(self, *_): ...

    def forward(self, states):
        x, y, z = states[..., 0] - 2, states[..., 1], states[..., 2]
        return torch.stack([x, (y - z * 0.2 / 3) / (5 - x * 0.2 / 3)], dim=-1)


def random_grasps(heights):
    """Grasps at states of a location, a height and the gripper's width; and the locations."""
    generator = torch.Generator().manual_seed(0)
    locations = torch.rand(200, 2, 2, generator=generator) * 1.6 - 0.8
    x, y = locations.unbind(dim=2)
    height = torch.stack([heights, torch.zeros(200)], dim=1)  # of grasps alone
    width = torch.rand(200, 2, generator=generator) * 40
    states = torch.stack([2 + x, 5 * y + 0.2 * height, 3 * height + x * y, width], dim=2)
    approach = states[:, 0] - torch.tensor([0, 0.2, 3, 0])
    has_grasp = torch.arange(200) % 10 > 0
    return GraspStates(
        states, approach, torch.zeros(200, dtype=torch.long), has_grasp, (None,) * 200
    ), locations


def fitted_states(grasps):
    regressor = StateRegressor(4)
    regressor.to_image = ExactLocations()
    images = torch.zeros(200, 3, 2, 2, dtype=torch.uint8)
    scale, shift = torch.tensor([0.5, 2, 0.1, 1]), torch.tensor([1.0, 0, -1, 0])
    is_arm = torch.tensor([True, True, True, False])
    return (
        regressor,
        regressor.fit(grasps, images, images, images, scale, shift, is_arm),
        (scale, shift),
    )


def test_how_far_the_gripper_is_open_says_nothing_about_locations():
    generator = torch.Generator().manual_seed(0)
    grasps, _ = random_grasps(torch.zeros(200))
    images = torch.randint(256, (3, 200, 3, 8, 8), generator=generator).to(torch.uint8)
    regressor = StateRegressor(4)
    regressor.fit(grasps, *images, torch.ones(4), torch.zeros(4), torch.arange(4) < 3)
    states = grasps.states[:, 0]
    other = states + torch.tensor([0.0, 0, 0, 5])
    assert torch.equal(regressor.to_image(other), regressor.to_image(states))


def test_heights_are_what_locations_do_not_tell_of_states():
    heights = torch.randn(200, generator=torch.Generator().manual_seed(1))
    grasps, locations = random_grasps(heights)
    regressor, known, (scale, shift) = fitted_states(grasps)
    found = grasps.has_grasp
    torch.testing.assert_close(known.locations[found, 0], locations[found, 0], atol=0.1, rtol=0)
    assert not known.locations[~found].any()
    assert torch.corrcoef(torch.stack([known.heights[found], heights[found]]))[0, 1] > 0.98
    assert known.heights[found].std() == pytest.approx(1, abs=0.05)
    # Locations and heights give the states; without the heights, that of the grasp is not known.
    true = grasps.states * scale + shift
    predicted = regressor(known.locations, known.heights)
    torch.testing.assert_close(predicted[found, 0, :3], true[found, 0, :3], atol=0.1, rtol=0)
    error = (regressor(known.locations, torch.zeros(200)) - predicted)[found, 0].abs().mean(dim=0)
    assert error[2] > 0.1
    assert error[0] < 0.02
    assert regressor.heights(torch.full((1, 4), torch.nan)).isnan().all()
    # All heights are zero if all grasps have the same.
    grasps, locations = random_grasps(torch.zeros(200))
    flat = grasps.states.clone()
    flat[..., 1], flat[..., 2], flat[..., 3] = 5 * locations[..., 1], 0, 1
    regressor, known, _ = fitted_states(grasps._replace(states=flat))
    assert not regressor.height_to_state.any()
    assert not known.heights.any()


# A camera that looks down at 45 degrees on objects of different heights. m, and rad for joints

EYE, DOWN = np.array([0.6, 0.9, 0.4]), np.sqrt(0.5)
FORWARD, RIGHT = np.array([0, -DOWN, -DOWN]), np.array([-1.0, 0, 0])


def project(points):
    """Projects points (..., 3) to the image of a pinhole camera, (..., 2) in -1..1."""
    away = points - EYE
    depth = away @ FORWARD
    return 2.4 * np.stack([away @ RIGHT, -away @ np.cross(RIGHT, FORWARD)], axis=-1) / depth[..., None]


class Recording(NamedTuple):
    """Episodes with objects of 10 heights: first, carried and last images, and the robot's states."""

    images: tuple[torch.Tensor, ...]
    grasps: GraspStates
    positions: np.ndarray  # at the grasps, (episodes, 3)


def record(n_episodes, seed, joints=False, accidents=0, levels=range(10)):
    rng = np.random.default_rng(seed)
    heights = np.linspace(0, 0.08, 10)[rng.choice(levels, size=n_episodes)]
    picks, places = rng.uniform([0.45, 0.12], [0.75, 0.34], (2, n_episodes, 2))
    tables, images = rng.uniform(-0.9, 0.9, (n_episodes, 2)), ([], [], [])
    for height, pick, place, arm in zip(heights, picks, places, tables, strict=True):
        size, color = 2 + 25 * height, rng.integers(0, 256, 3)
        before, after = (project(np.array([*spot, height / 2 - 0.34])) for spot in (pick, place))
        for image, center, robot in zip(images, (before, None, after), ((1, -1), arm, (-1, -1)), strict=True):
            pixels = np.full((64, 64, 3), 120, np.uint8)
            y, x = np.mgrid[:64, :64]
            for spot, side, shade in ((center, size, color), (robot, 4, (255, 255, 255))):
                if spot is not None:
                    column, row = (np.asarray(spot) + 1) * 32 - 0.5
                    pixels[(abs(x - column) < side) & (abs(y - row) < side)] = shade
            image.append(pixels)
    grasps = np.column_stack([picks, heights - 0.34]) + rng.normal(0, 0.002, (n_episodes, 3))
    releases = np.column_stack([places, heights - 0.3]) + rng.normal(0, 0.002, (n_episodes, 3))
    approach = grasps + [0, 0, 0.05] + rng.normal(0, 0.003, (n_episodes, 3))
    grasps[:accidents] += rng.normal(0, 0.05, (accidents, 3))
    width = rng.uniform(0.2, 0.8, n_episodes)

    def states(positions):
        if joints:
            angles = [inverse(position) + rng.normal(0, 0.003, 6) for position in positions]
            return np.column_stack([angles, width])
        turns = rng.normal(0, 0.4, (n_episodes, 3))  # the wrist's, as the object lies
        return np.column_stack([positions, turns, width])

    pick_states = states(grasps)
    both = torch.from_numpy(np.stack([pick_states, states(releases)], axis=1)).float()
    positions = np.stack([forward(state[:6])[0] for state in pick_states]) if joints else grasps
    grasps = GraspStates(
        both,
        torch.from_numpy(states(approach)).float(),
        torch.zeros(n_episodes, dtype=torch.long),
        torch.ones(n_episodes, dtype=torch.bool),
        (None,) * n_episodes,
    )
    stacks = (torch.from_numpy(np.stack(image)).permute(0, 3, 1, 2).contiguous() for image in images)
    return Recording(tuple(stacks), grasps, positions)


def fit_to(recording, tasks=None):
    """Fits a state regressor; returns it, and the scale and shift of states."""
    states = recording.grasps.states
    scale = 1 / states.flatten(0, 1).std(dim=0)
    shift = -states.flatten(0, 1).mean(dim=0) * scale
    regressor = StateRegressor(states.shape[2])
    is_arm = torch.arange(states.shape[2]) < states.shape[2] - 1
    regressor.fit(recording.grasps, *recording.images, scale, shift, is_arm, tasks)
    return regressor, scale, shift


def errors_at_the_pick(regressor, scale, shift, recording, joints=False):
    """Errors of the state at the pick, from the location and the height, (episodes, 3) in mm."""
    located = regressor.locate(recording.grasps)
    states = ((regressor(located.locations, located.heights) - shift) / scale)[:, 0].numpy()
    predicted = np.stack([forward(state[:6])[0] for state in states]) if joints else states[:, :3]
    return 1000 * np.abs(predicted - recording.positions)


@pytest.mark.parametrize(
    ("joints", "n_episodes", "accidents", "median", "p90"),  # mm
    [
        (False, 30, 0, 8, 25),
        (False, 60, 3, 4, 10),
        (False, 120, 6, 4, 10),
        (True, 60, 0, 4, 20),
        (True, 120, 6, 5, 15),
    ],
)
def test_location_and_height_give_the_state_at_the_pick(joints, n_episodes, accidents, median, p90):
    fitted = fit_to(record(n_episodes, 0, joints, accidents))
    errors = errors_at_the_pick(*fitted, record(100, 1, joints), joints)
    assert (np.median(errors, axis=0) < median).all()
    assert (np.quantile(errors, 0.9, axis=0) < p90).all()


def unfitted():
    """A recording, a regressor for it, the scale and shift of its states, and their dimensions."""
    recording = record(60, 0)
    states = recording.grasps.states
    scale = 1 / states.flatten(0, 1).std(dim=0)
    shift = -states.flatten(0, 1).mean(dim=0) * scale
    return recording, StateRegressor(states.shape[2]), (scale, shift), torch.arange(states.shape[2])


def test_a_novel_rotation_of_the_hand_moves_no_location_where_positions_are_known():
    recording, regressor, (scale, shift), dims = unfitted()
    states = recording.grasps.states
    regressor.fit(recording.grasps, *recording.images, scale, shift, dims < 6, position_dims=[0, 1, 2])
    turned = states[:, 0] + torch.where((dims >= 3) & (dims < 6), 2.0, 0.0)
    torch.testing.assert_close(regressor.pick_locations(turned), regressor.pick_locations(states[:, 0]))
    torch.testing.assert_close(regressor.heights(turned), regressor.heights(states[:, 0]))
    errors = errors_at_the_pick(regressor, scale, shift, record(100, 1))
    assert (np.median(errors, axis=0) < 4).all()


def test_an_object_may_be_higher_than_those_of_the_training_where_positions_are_known():
    training, higher = record(60, 0, levels=range(4)), record(100, 1, levels=range(7, 10))
    _, regressor, (scale, shift), dims = unfitted()
    regressor.fit(training.grasps, *training.images, scale, shift, dims < 6, position_dims=[0, 1, 2])
    assert (np.median(errors_at_the_pick(regressor, scale, shift, higher), axis=0) < 4).all()
    # Where the camera really sees the object, half as high as the grasp
    seen = project(higher.positions * [1, 1, 0.5] - [0, 0, 0.17])
    found = regressor.pick_locations(higher.grasps.states[:, 0]).numpy()
    assert np.median(np.abs(found - seen), axis=0).max() < 0.04


def test_a_hand_that_never_moves_along_x_is_no_camera():
    recording, regressor, (scale, shift), dims = unfitted()
    recording.grasps.states[..., 0] = 0.5
    regressor.fit(recording.grasps, *recording.images, scale, shift, dims < 6, position_dims=[0, 1, 2])
    assert not regressor.to_image.has_camera
    assert regressor(torch.zeros(1, 2, 2), torch.zeros(1)).isfinite().all()


def test_a_release_keeps_the_height_and_the_rotation_that_were_demonstrated():
    recording, regressor, (scale, shift), dims = unfitted()
    states = recording.grasps.states
    located = regressor.fit(
        recording.grasps, *recording.images, scale, shift, dims < 6, position_dims=[0, 1, 2]
    )
    # Turned by 2, and released 5 cm higher, as something tall
    shown = states[:1] + torch.where((dims >= 3) & (dims < 6), 2.0, 0.0)
    shown[:, 1, 2] += 0.05
    new_place, same_place = torch.zeros(9, dtype=torch.bool), torch.ones(9, dtype=torch.bool)
    given = (shown.expand(9, -1, -1), located.locations[1:10], located.heights[1:10])
    moved = regressor.displacements(*given, new_place)
    release = shown[:, 1] + moved[:, 1] / scale
    wanted = torch.where(dims < 2, states[1:10, 1], shown[:, 1])
    assert ((release - wanted)[:, :2].abs() < 0.03).all()
    assert ((release - wanted)[:, 2].abs() < 0.01).all()
    torch.testing.assert_close(release[:, 3:6], wanted[:, 3:6])
    # At a place that was found again, the camera sees the hand there, as high and as turned as it was.
    release = shown[:, 1] + regressor.displacements(*given, same_place)[:, 1] / scale
    torch.testing.assert_close(release[:, 2:6], shown[:, 1, 2:6].expand(9, -1))
    torch.testing.assert_close(regressor.to_image(release), located.locations[1:10, 1], rtol=0, atol=1e-3)
    # Without names, whatever a place does not tell is kept.
    regressor.fit(recording.grasps, *recording.images, scale, shift, dims < 6)
    assert (regressor.follows_place[:2] > 0.8).all()
    assert (regressor.follows_place[3:6] < 0.3).all()


def test_heights_are_larger_along_the_approach():
    recording = record(60, 0)
    regressor, scale, shift = fit_to(recording)
    heights = regressor.heights(recording.grasps.states[:, 0])
    assert np.corrcoef(heights, recording.positions[:, 2])[0, 1] < -0.85
    # An unknown height moves the object's middle, half as high as the grasp, along the camera's ray.
    located = regressor.locate(recording.grasps)
    moved = (regressor(located.locations, heights + 1) - regressor(located.locations, heights)) / scale
    middle = recording.positions * [1, 1, 0.5] - [0, 0, 0.17]
    ray = (middle - EYE) * [1, 1, 2]
    direction = moved[:, 0, :3].numpy()
    cosines = (direction * ray).sum(axis=1) / np.linalg.norm(direction, axis=1) / np.linalg.norm(ray, axis=1)
    assert np.median(cosines) > 0.99


def test_the_object_of_a_task_is_as_high_wherever_it_stands():
    def objects(recording):
        return np.round((recording.positions[:, 2] + 0.34) / 0.08 * 9).astype(int)

    def spread(regressor, recording):
        heights, known = regressor.heights(recording.grasps.states[:, 0]).numpy(), objects(recording)
        return np.mean([heights[known == n].std() for n in range(10)])

    # In the training, tall objects stand far away.
    every, new = record(240, 3), record(100, 4)
    rows = np.flatnonzero(np.abs((every.positions[:, 0] - 0.45) / 0.3 - objects(every) / 9) < 0.35)
    kept = [part if isinstance(part, tuple) else part[rows] for part in every.grasps]
    grasps = GraspStates(*kept)._replace(missing=(None,) * len(rows))
    training = Recording(tuple(i[rows] for i in every.images), grasps, every.positions[rows])
    alike, plain = fit_to(training, [str(n) for n in objects(training)]), fit_to(training)
    assert spread(alike[0], new) < 0.8 * spread(plain[0], new)
    assert (np.median(errors_at_the_pick(*alike, new), axis=0) < 4).all()
