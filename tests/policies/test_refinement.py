"""The second look at a picked object: drawn disks, which the gripper takes by their left edge."""

import contextlib

import pytest
import torch

from lerobot_deltaco.policies.deltaco_match.refinement import GraspRefiner, correlations, cut_templates

SIZE, RADIUS = 96, 7
N_EPISODES = 36


def disks(centers, generator):
    """Draws a disk at each center (n, 2), px, on a gray table."""
    y, x = torch.meshgrid(torch.arange(SIZE), torch.arange(SIZE), indexing="ij")
    away = torch.hypot(x + 0.5 - centers[:, :1, None], y + 0.5 - centers[:, 1:, None])
    colors = torch.randint(0, 256, (len(centers), 3, 1, 1), generator=generator)
    return torch.where((away < RADIUS)[:, None], colors, 120).to(torch.uint8)


@pytest.fixture(scope="module")
def refined():
    """A refiner that was fitted, and the episodes that it was fitted to."""
    generator = torch.Generator().manual_seed(0)
    centers = 20 + 56 * torch.rand(N_EPISODES, 2, generator=generator)
    images = disks(centers, generator)
    edges = centers - torch.tensor([RADIUS, 0])
    grasps, middles = (2 * each / SIZE - 1 for each in (edges, centers))
    sizes = torch.full((N_EPISODES,), 2 * RADIUS / SIZE)
    held_out = torch.arange(N_EPISODES) % 3 == 0
    torch.manual_seed(0)
    refiner = GraspRefiner()
    data = (images, grasps, middles, sizes, held_out)
    refiner.fit(*data, 60, generator, contextlib.nullcontext())
    return refiner, data


def test_the_grasp_is_found_beside_the_middle_of_the_object(refined):
    refiner, (images, grasps, middles, sizes, held_out) = refined
    found = refiner(images[held_out], middles[held_out], sizes[held_out])
    errors = (found - grasps[held_out]).norm(dim=1) * SIZE / 2  # px
    assert errors.median() < 1.5
    before, after = refiner.errors.tolist()
    assert before == pytest.approx(2 * RADIUS / SIZE, rel=1e-3)
    assert after < before / 3


def test_what_does_not_come_nearer_is_not_used(refined):
    _, (images, grasps, _, sizes, held_out) = refined
    torch.manual_seed(0)
    refiner = GraspRefiner()
    # The proposals are right already.
    refiner.fit(
        images, grasps, grasps, sizes, held_out, 1, torch.Generator().manual_seed(0), contextlib.nullcontext()
    )
    assert not refiner.is_used
    assert torch.equal(refiner(images, grasps, sizes), grasps)


def test_without_held_out_episodes_it_is_not_used(refined):
    _, (images, grasps, middles, sizes, held_out) = refined
    refiner = GraspRefiner()
    nothing = torch.zeros_like(held_out)
    refiner.fit(images, grasps, middles, sizes, nothing, 1, torch.Generator(), contextlib.nullcontext())
    assert torch.equal(refiner(images, middles, sizes), middles)
    # How far proposals are from grasps is known all the same.
    assert refiner.errors.tolist() == pytest.approx([2 * RADIUS / SIZE] * 2, rel=1e-3)


def test_a_demonstration_shows_where_another_kind_of_object_is_grasped(refined):
    refiner, (_, _, _, sizes, _) = refined
    # In training, disks are grasped at their left edge; this bar, at its upper end.
    generator = torch.Generator().manual_seed(1)
    tops = 20 + 50 * torch.rand(8, 2, generator=generator).round(decimals=1)
    y, x = torch.meshgrid(torch.arange(SIZE) + 0.5, torch.arange(SIZE) + 0.5, indexing="ij")
    away = (x - tops[:, :1, None]).abs() < 3, (y - tops[:, 1:, None] - 5).abs() < 8
    color = torch.tensor([200, 60, 30])[:, None, None]
    images = torch.where((away[0] & away[1])[:, None], color, 120).to(torch.uint8)
    grasps = 2 * tops / SIZE - 1
    middles = 2 * (tops + torch.tensor([0, 5])) / SIZE - 1
    sizes = sizes[:8]
    templates = cut_templates(images[:1], grasps[:1], sizes[:1]).expand(8, -1, -1, -1)[:, None]
    found = refiner(images, middles, sizes, templates)
    errors = (found - grasps).norm(dim=1) * SIZE / 2  # px
    assert errors.max() < 1.5
    # Without the network and without a template, nothing is known but the proposal.
    plain, nothing = GraspRefiner(), torch.full_like(templates, torch.nan)
    assert torch.equal(plain(images, middles, sizes, nothing), middles)
    # A demonstration whose grasp is not known changes nothing.
    unknown = cut_templates(images[:1], grasps[:1] * torch.nan, sizes[:1])
    assert unknown.isnan().all()
    both = torch.cat([templates, unknown.expand(8, -1, -1, -1)[:, None]], dim=1)
    torch.testing.assert_close(refiner(images, middles, sizes, both), found)


def test_a_template_correlates_fully_with_itself_and_with_nothing_on_an_empty_table():
    generator = torch.Generator().manual_seed(2)
    images = disks(torch.tensor([[40.3, 50.8]]), generator)
    at, sizes = 2 * torch.tensor([[42.0, 49.0]]) / SIZE - 1, torch.tensor([2 * RADIUS / SIZE])
    templates = cut_templates(images, at, sizes)[:, None]
    found = correlations(images, at, sizes, templates, 0.5)
    middle = found.shape[1] // 2
    assert float(found.max()) == pytest.approx(1, abs=0.01)
    assert int(found.argmax()) == middle * found.shape[2] + middle
    empty = correlations(images, torch.tensor([[-0.7, -0.7]]), sizes, templates, 0.1)
    assert empty.abs().max() < 0.1


@pytest.mark.parametrize("anywhere", [False, True])
def test_templates_count_where_they_tell_where_grasps_are(refined, anywhere):
    _, (images, grasps, middles, sizes, _) = refined
    if anywhere:  # on the object, and at its middle on the average
        generator = torch.Generator().manual_seed(1)
        grasps = middles + RADIUS / SIZE * torch.randn(middles.shape, generator=generator)
    refiner = GraspRefiner()
    # Of four episodes each, the disks look alike.
    others = torch.arange(N_EPISODES) // 4 * 4 + (torch.arange(N_EPISODES) + 1) % 4
    alike = images.clone()
    for first in range(0, N_EPISODES, 4):
        color = images[first][:, (images[first] != 120).any(dim=0)][:, 0]
        for image in alike[first : first + 4]:
            image[:, (image != 120).any(dim=0)] = color[:, None]
    refiner.measure_templates(alike, grasps, middles, sizes, others)
    assert bool(refiner.uses_templates) != anywhere
    refiner.measure_templates(alike, grasps, middles, sizes, torch.arange(N_EPISODES))
    assert not refiner.uses_templates  # no task has two episodes
