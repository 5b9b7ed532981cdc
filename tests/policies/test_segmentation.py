"""Tests of splitting what stands out into objects."""

import pytest
import torch

from lerobot_deltaco.policies.scene.segmentation import segment

SIDE = 128
FLAT = torch.zeros(2)
GRAY = torch.full((3, SIDE, SIDE), 0.5)


def disks(*circles):
    """Returns a mask of disks, each given as x, y in -1..1 and a diameter as a fraction of the side."""
    centers = (torch.arange(SIDE) + 0.5) * 2 / SIDE - 1
    y, x = torch.meshgrid(centers, centers, indexing="ij")
    return sum(torch.hypot(x - cx, y - cy) < d for cx, cy, d in circles).clamp(max=1).float()


def assert_found(regions, *circles):
    """Asserts that each disk is among the regions, by its center."""
    for x, y, diameter in circles:
        distances = (regions - torch.tensor([x, y])).norm(dim=1)
        nearest = int(distances.argmin())
        assert distances[nearest] < 0.3 * diameter


@pytest.mark.parametrize("diameter", [0.04, 0.1, 0.3])
def test_separate_objects_are_found_once_each(diameter):
    circles = [(-0.6, -0.55, diameter), (0.5, -0.2, 0.8 * diameter), (-0.1, 0.6, diameter)]
    regions = segment(disks(*circles), GRAY, diameter, FLAT)
    assert len(regions) == 3
    assert_found(regions, *circles)


def test_objects_that_touch_are_proposed_one_by_one_and_together():
    circles = [(-0.1, 0.0, 0.1), (0.1, 0.05, 0.1)]
    regions = segment(disks(*circles), GRAY, 0.1, FLAT)
    assert len(regions) == 3
    assert_found(regions, *circles)
    assert float((regions[0] - torch.tensor([0.0, 0.025])).norm()) < 0.03  # the most prominent


def test_a_long_object_is_proposed_as_a_whole_and_a_small_one_only_so():
    mask = torch.zeros(SIDE, SIDE)
    mask[20:80, 50:64] = 1
    whole = torch.tensor([57.0, 50.0]) * 2 / SIDE - 1
    assert torch.allclose(segment(mask, GRAY, 0.12, FLAT)[0], whole)
    regions = segment(mask, GRAY, 0.25, FLAT)
    assert len(regions) == 1
    assert torch.allclose(regions[0], whole)


def test_an_object_in_front_of_another_is_told_by_its_color():
    mask, image = torch.zeros(SIDE, SIDE), GRAY.clone()
    mask[30:54, 40:52] = mask[54:70, 40:56] = 1  # no neck between them
    image[:, 30:54, 40:52] = torch.tensor([0.8, 0.2, 0.1])[:, None, None]
    image[:, 54:70, 40:56] = torch.tensor([0.1, 0.3, 0.7])[:, None, None]
    regions = segment(mask, image, 0.14, FLAT)
    for x, y in ((46, 42), (48, 62)):
        distances = (regions - (torch.tensor([x, y]) * 2 / SIDE - 1)).norm(dim=1)
        assert distances.min() < 0.03
    middle = torch.stack(mask.nonzero().float().mean(dim=0).flip(0).unbind()) + 0.5
    assert torch.allclose(regions[0], middle * 2 / SIDE - 1, atol=1e-2)  # the whole comes first


def test_specks_are_no_objects_and_gaps_do_not_split_one():
    mask = disks((0.2, 0.2, 0.15))
    mask[77, :] = 0  # a line through the object
    mask[5, 5] = mask[100, 20] = 1
    regions = segment(mask, GRAY, 0.15, FLAT)
    assert len(regions) == 1
    assert_found(regions, (0.2, 0.2, 0.15))


def test_sizes_follow_the_perspective():
    speck, object_ = (0.0, 0.8, 0.03), (0.0, -0.8, 0.03)
    perspective = torch.tensor([0.0, 1.5])  # lower in the image, objects are larger
    regions = segment(disks(speck, object_), GRAY, 0.1, perspective)
    assert len(regions) == 1
    assert_found(regions, object_)


def test_an_empty_mask_has_no_regions():
    regions = segment(torch.zeros(SIDE, SIDE), GRAY, 0.1, FLAT)
    assert regions.shape == (0, 2)
