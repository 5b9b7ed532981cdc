"""A camera that has moved since the training is told, by how much, and one that has not is not."""

import camera_motion
import finding
import numpy as np
import pytest
import torch

from lerobot_deltaco.policies.base.image_coordinates import gaussian_maps
from lerobot_deltaco.policies.deltaco_match.feature_matching import FeatureMatching
from lerobot_deltaco.policies.scene.camera_motion import (
    CameraMotion,
    estimate_motion,
    static_reference,
    undo_motion,
    weighted_reference,
)


@pytest.mark.parametrize("case", ["toy", "gym-24-100"])
def test_motions_of_the_camera_are_told_and_measured(case, monkeypatch):
    monkeypatch.setattr(camera_motion, "N_REMEMBERED", 12)
    found = camera_motion.measure(finding.CASES[case], 4, seed=0)
    width, height = finding.CASES[case].size
    for name, motions in found.items():
        pixels, degrees = camera_motion.MOTIONS[name]
        for motion in motions:
            right, down = motion.shift
            assert 256 * np.hypot(right, down * height / width) == pytest.approx(pixels, abs=1.0)
            assert abs(motion.turn) == pytest.approx(degrees, abs=0.6)
            if name != "turned by 1 degree":  # which may be told
                assert motion.is_significant == (name != "not moved")


def test_another_scene_is_not_a_motion():
    reference, other = torch.rand(2, 3, 128, 128, generator=torch.Generator().manual_seed(0))
    for image in (other, torch.zeros(3, 128, 128)):
        assert not estimate_motion(weighted_reference(reference, torch.ones(128, 128)), image).is_significant


def test_the_warning_says_how_far_in_the_pictures_own_pixels(caplog):
    generator = torch.Generator().manual_seed(0)
    table = torch.nn.functional.interpolate(torch.rand(1, 3, 24, 24, generator=generator), (240, 240))[0]
    scenes = (255 * table.expand(12, -1, -1, -1)).to(torch.uint8)
    matching = FeatureMatching([])
    assert matching.camera_motion(table) is None  # nothing is known of the training
    matching.background.fit(scenes, torch.zeros(12, 2))
    assert not matching.camera_motion(table).is_significant
    assert not caplog.text
    assert matching.camera_motion(table.roll((-12, 0, 24), (1, 0, 2))).is_significant
    assert (
        "The camera seems to have moved since the training: the picture is off by 24 px right and 12 px up"
        in (caplog.text)
    )


def motion_of(right=0.0, down=0.0, degrees=0.0, aspect=1.0, tilt=0.0):
    """Returns a motion by a shift, in widths and heights, a turn, and a tilt of the camera."""
    angle = np.radians(degrees)
    rows = [
        [np.cos(angle), -np.sin(angle), 2 * aspect * right],
        [np.sin(angle), np.cos(angle), 2 * down],
        [tilt, tilt, 1],
    ]
    return CameraMotion(torch.tensor(rows, dtype=torch.float32), aspect, 0.5, True)


def test_motions_are_described():
    moved = motion_of(-0.1, 0.02, -3.0, aspect=2.0)
    assert moved.describe(200, 100) == "20 px left, 2 px down and 3 degrees counterclockwise"
    assert motion_of(0.1, aspect=2.0).describe(200, 100) == "20 px right"


@pytest.mark.parametrize("shape", [(48, 48), (60, 90)])
def test_a_motion_is_undone_in_pictures_and_locations(shape):
    height, width = shape
    motion = motion_of(0.1, -0.05, 4.0, aspect=width / height, tilt=0.03)
    locations = torch.rand(20, 2, generator=torch.Generator().manual_seed(0)) - 0.5
    there = motion.to_picture(locations)
    assert (there - locations).abs().max() > 0.1
    torch.testing.assert_close(motion.from_picture(there), locations)
    # What the moved camera sees at a location, the corrected picture has where the training's camera saw it.
    reference = weighted_reference(torch.zeros(3, 24, 24), torch.ones(24, 24))
    for location in locations:
        seen = motion.to_picture(location)
        image = gaussian_maps(seen[None, None], height, width, torch.tensor([0.1, 0.1])).expand(1, 3, -1, -1)
        corrected = undo_motion(image, motion, reference)[0, 0]
        expected = gaussian_maps(location[None, None], height, width, torch.tensor([0.1, 0.1]))[0, 0]
        assert (corrected / corrected.sum() - expected / expected.sum()).abs().sum() < 0.2


def test_what_the_moved_camera_does_not_see_is_filled_with_what_was_static():
    reference = weighted_reference(torch.full((3, 24, 24), 0.25), torch.ones(24, 24))
    corrected = undo_motion(torch.ones(1, 3, 40, 40), motion_of(right=-0.25), reference)
    expected = torch.ones(1, 3, 40, 40)
    expected[..., :10] = 0.25
    torch.testing.assert_close(corrected, expected)


def test_objects_on_a_plain_table_are_not_a_motion():
    table = torch.full((12, 3, 128, 128), 0.5)
    reference = static_reference(table)
    table[0, :, 60:80, 100:120] = 1.0
    assert estimate_motion(reference, table[0]) is None
