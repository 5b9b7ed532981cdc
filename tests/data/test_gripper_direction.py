"""Whether low or high values close a gripper, by images."""

import numpy as np
import pytest
import torch
from test_grasps import grasp_frames, ramps

from lerobot_deltaco.data.demonstrations import RobotData
from lerobot_deltaco.data.gripper_direction import is_inverted, warn_if_inverted


def moved_while_closed(trajectory, n_episodes=6):
    """Episodes of a trajectory in which an object moves while the trajectory is low, after an opening."""
    length = len(trajectory)
    ((grasp, release),) = grasp_frames(torch.from_numpy(trajectory), [(0, length - 1)])
    images = torch.full((n_episodes, length, 3, 16, 16), 100, dtype=torch.uint8)
    images += torch.randint(0, 9, images.shape, dtype=torch.uint8)
    for n, own in enumerate(images):
        own[:grasp, :, 2 * n : 2 * n + 2, 1:3] = 255
        own[release:, :, 2 * n : 2 * n + 2, 12:14] = 255
    # The arm ends elsewhere.
    images[..., 6:9] = torch.linspace(0, 255, length).to(torch.uint8)[:, None, None, None]
    states = torch.zeros(n_episodes * length, 2)
    spans = [(n * length, (n + 1) * length - 1) for n in range(n_episodes)]
    return RobotData(states, torch.zeros(1), spans, lambda rows: images.flatten(0, 1)[rows])


# At rest at both ends, closed first or last, open at both ends.
@pytest.mark.parametrize("values", [(0, 1, 0, 1, 0), (0, 1, 0, 1), (1, 0, 1, 0), (1, 0, 1)])
def test_images_tell_which_values_close_a_gripper(values, caplog):
    trajectory = ramps(*values)
    data, gripper = moved_while_closed(trajectory), torch.from_numpy(np.tile(trajectory, 6))
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
    trajectory = torch.from_numpy(ramps(0, 1, 0))
    images = torch.full((len(trajectory), 3, 8, 8), 100, dtype=torch.uint8)
    images[:52, :, 1:3, 1:3] = 255  # the object is lifted after the gripper has closed
    data = RobotData(
        torch.zeros(len(trajectory), 2), torch.zeros(1), [(0, len(trajectory) - 1)], lambda rows: images[rows]
    )
    assert is_inverted(trajectory, data) is None
    warn_if_inverted(trajectory, data, "low")
    assert "Look at a recording: if high values mean closed, set --policy.gripper_closed=high" in caplog.text
