"""A camera that has moved since the training is told, by how much, and one that has not is not."""

import camera_motion
import finding
import numpy as np
import pytest
import torch

from lerobot_deltaco.policies.deltaco_match.feature_matching import FeatureMatching
from lerobot_deltaco.policies.scene.camera_motion import CameraMotion, estimate_motion


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
            assert abs(motion.turn) == pytest.approx(degrees, abs=0.3)
            if name != "turned by 1 degree":  # which may be told
                assert motion.is_significant == (name != "not moved")


def test_another_scene_is_not_a_motion():
    reference, other = torch.rand(2, 3, 128, 128, generator=torch.Generator().manual_seed(0))
    for image in (other, torch.zeros(3, 128, 128)):
        assert not estimate_motion(reference, torch.ones(128, 128), image).is_significant


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


def test_motions_are_described():
    assert CameraMotion((-0.1, 0.02), -3.0, 0.1, 0.5, True).describe(200, 100) == (
        "20 px left, 2 px down and 3 degrees counterclockwise"
    )
    assert CameraMotion((0.1, 0.0), 0.0, 0.1, 0.5, True).describe(200, 100) == "20 px right"
