"""The robot's states at locations, and the height offsets of grasps."""

import pytest
import torch

from lerobot_deltaco.data.grasps import Keyframes
from lerobot_deltaco.policies.deltaco_match.states import RobotStates


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
