"""What is changed at random in training."""

import pytest
import torch
import torch.nn.functional as F  # noqa: N812

from lerobot_deltaco.policy.augmentation import (
    draw_color_orders,
    is_reordered,
    leave_out,
    random_crop,
    reorder_colors,
)


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


def test_other_orders_of_the_colors_are_as_likely_and_have_their_share():
    orders = draw_color_orders(6000, 0.5, generator())
    found, counts = orders.unique(dim=0, return_counts=True)
    assert found.tolist() == [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]]
    assert counts[0].item() == pytest.approx(3000, abs=150)
    assert counts[1:].tolist() == pytest.approx([600] * 5, abs=100)
    assert torch.equal(is_reordered(orders), (orders != torch.tensor([0, 1, 2])).any(dim=1))
    assert torch.equal(orders, draw_color_orders(6000, 0.5, generator()))
    assert not is_reordered(draw_color_orders(100, 0.0, generator())).any()


@pytest.mark.parametrize("pictures", [(), (1,), (2,), (2, 3)], ids=str)
def test_colors_are_exchanged_alike_in_all_pictures_of_a_sample(pictures):
    images = torch.rand(5, *pictures, 3, 4, 6)
    orders = torch.tensor([[0, 1, 2], [2, 1, 0], [1, 2, 0], [0, 1, 2], [0, 2, 1]])
    changed = reorder_colors(images, orders)
    for sample, order in enumerate(orders.tolist()):
        for channel, source in enumerate(order):
            assert torch.equal(changed[sample][..., channel, :, :], images[sample][..., source, :, :])


def test_colors_of_channels_last_pictures_are_exchanged_too():
    images = torch.rand(2, 3, 4, 6).contiguous(memory_format=torch.channels_last)
    orders = torch.tensor([[2, 1, 0], [1, 2, 0]])
    assert torch.equal(reorder_colors(images, orders), reorder_colors(images.contiguous(), orders))


def test_of_a_sample_one_embedding_at_most_is_left_out():
    demo, language = torch.rand(4000, 3) + 1, torch.rand(4000, 3) + 1
    left = leave_out(demo, language, 0.1, 0.3, generator())
    without_demo, without_language = ((part == 0).all(dim=1) for part in left)
    assert without_demo.float().mean() == pytest.approx(0.1, abs=0.02)
    assert without_language.float().mean() == pytest.approx(0.3, abs=0.03)
    assert not (without_demo & without_language).any()
    assert torch.equal(left[0][~without_demo], demo[~without_demo])
    assert torch.equal(left[1][~without_language], language[~without_language])
    always = leave_out(demo, language, 0.5, 0.5, generator())
    assert (((always[0] == 0).all(dim=1)) ^ ((always[1] == 0).all(dim=1))).all()
