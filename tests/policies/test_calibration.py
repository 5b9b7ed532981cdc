"""Calibration of the camera: where robot states are in the image."""

import numpy as np
import pytest
import torch
from small_policies import TABLE_SIZE, draw_table, random_moves, state_at

from lerobot_deltaco.policies.geometry.calibration import ImageProjection


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
    to_image = ImageProjection(states.shape[1])
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
    to_image = ImageProjection(states.shape[1])
    carried = stacked_images(on_the_way) if carried_elsewhere else last
    to_image.fit(first, carried, last, states, 1 / states.std(dim=0).clamp_min(1e-3))
    errors = (to_image(states) - torch.from_numpy(starts).float()).norm(dim=1) * TABLE_SIZE / 2  # px
    assert (errors.median() < 1) == carried_elsewhere


def test_states_that_tell_nothing_of_the_image_are_warned_of(caplog):
    moves = random_moves(120)
    first = stacked_images([draw_table(task, start, other) for task, start, other, _ in moves])
    last = stacked_images([draw_table(task, end, other) for task, _, other, end in moves])
    states = torch.randn(len(moves), 3, generator=torch.Generator().manual_seed(0))
    ImageProjection(3).fit(first, last, last, states, torch.ones(3))
    assert "the locations are probably wrong" in caplog.text
