"""What training draws at random."""

import pytest
import torch
import torch.nn.functional as F  # noqa: N812

from lerobot_deltaco.policy.randomness import random_crop, seeded


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def test_crops_are_shifts_by_at_most_the_padding():
    images = torch.rand(64, 3, 9, 9)
    cropped = random_crop(images, 4, torch.Generator().manual_seed(0))
    padded = F.pad(images, [4] * 4)
    found = []
    for image, big in zip(cropped, padded, strict=True):
        shifts = [
            (i, j) for i in range(9) for j in range(9) if torch.equal(image, big[:, i : i + 9, j : j + 9])
        ]
        assert len(shifts) == 1
        found += shifts
    assert {i for i, _ in found} == {j for _, j in found} == set(range(9))


def test_all_pictures_of_a_sample_are_shifted_alike_and_by_the_generator_alone():
    images = torch.rand(4, 1, 3, 8, 8).expand(4, 2, 3, 8, 8)
    first = random_crop(images, 3, torch.Generator().manual_seed(1))
    torch.testing.assert_close(first[:, 0], first[:, 1])
    torch.testing.assert_close(first, random_crop(images, 3, torch.Generator().manual_seed(1)))
    assert not torch.equal(first, random_crop(images, 3, torch.Generator().manual_seed(2)))


def test_what_pytorch_draws_meanwhile_is_the_generators_and_nothing_else_is():
    cpu = torch.device("cpu")
    torch.manual_seed(1)
    with seeded(generator(), cpu):
        first = torch.rand(3)
    after = torch.rand(3)
    torch.manual_seed(1)
    assert torch.equal(after, torch.rand(3))
    with seeded(generator(), cpu):
        assert torch.equal(first, torch.rand(3))
    with seeded(generator(1), cpu):
        assert not torch.equal(first, torch.rand(3))
