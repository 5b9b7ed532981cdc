"""Losses against examples by hand; networks by their properties."""

import math

import pytest
import torch
import torch.nn.functional as F  # noqa: N812

from lerobot_deltaco.policy.demo_encoders import ArrayEncoder, AttentionEncoder, frame_array
from lerobot_deltaco.policy.inference import folded
from lerobot_deltaco.policy.losses import (
    contrastive_logits,
    contrastive_loss,
    cosine_loss,
    gaussian_negative_log_likelihood,
    mixture_negative_log_likelihood,
)
from lerobot_deltaco.policy.networks import (
    INITIAL_LOG_STD,
    ConditionedPolicy,
    Film,
    FilmBlock,
    Motion,
    SpatialSoftmax,
    random_crop,
)
from lerobot_deltaco.policy.options import BACKBONES


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)


# Losses


def test_the_likelihood_is_that_of_torchs_normal_distribution():
    mean, target = torch.randn(5, 3), torch.randn(5, 3)
    log_std = torch.tensor([-1.0, -0.3, -4.0])
    expected = -torch.distributions.Normal(mean, log_std.exp()).log_prob(target).sum(dim=-1)
    torch.testing.assert_close(gaussian_negative_log_likelihood(mean, log_std, target), expected)


def test_the_likelihood_of_several_modes_is_that_of_torchs_mixture():
    means, logits, target = torch.randn(5, 4, 3), torch.randn(5, 4), torch.randn(5, 3)
    log_std = torch.randn(4, 3)
    modes = torch.distributions.Independent(torch.distributions.Normal(means, log_std.exp()), 1)
    mixture = torch.distributions.MixtureSameFamily(torch.distributions.Categorical(logits=logits), modes)
    loss = mixture_negative_log_likelihood(means, logits, log_std, target)
    torch.testing.assert_close(loss, -mixture.log_prob(target))


def test_a_single_mode_is_the_papers_gaussian():
    mean, log_std, target = torch.randn(5, 3), torch.randn(3), torch.randn(5, 3)
    loss = mixture_negative_log_likelihood(mean[:, None], torch.zeros(5, 1), log_std, target)
    torch.testing.assert_close(loss, gaussian_negative_log_likelihood(mean, log_std, target))


def test_the_likeliest_mode_acts():
    means = torch.tensor([[[1.0], [2.0]], [[3.0], [4.0]]])
    assert Motion(means, torch.tensor([[0.0, 1.0], [1.0, 0.0]])).mean.tolist() == [[2.0], [3.0]]


def test_the_contrastive_loss_of_repeated_tasks_by_hand():
    # Two tasks, three samples; the first two share a task.
    demo = torch.tensor([[1.0, 0.0], [0.0, 1.0], [0.0, 1.0]])
    language = torch.tensor([[1.0, 0.0], [0.0, 1.0]])
    logits = contrastive_logits(demo, language, temperature=0.5)
    torch.testing.assert_close(logits, torch.tensor([[2.0, 0.0], [0.0, 2.0], [0.0, 2.0]]))
    right, wrong = math.log(1 + math.exp(-2)), math.log(1 + math.exp(2))
    loss = contrastive_loss(logits, torch.tensor([0, 0, 1]))
    torch.testing.assert_close(loss, torch.tensor([right, wrong, right]))


def test_the_contrastive_loss_of_one_sample_per_task_is_the_papers_square_one():
    demo, language = (F.normalize(torch.randn(6, 8), dim=-1) for _ in range(2))
    loss = contrastive_loss(contrastive_logits(demo, language, 0.1), torch.arange(6))
    expected = -torch.diag((demo @ language.T / 0.1).log_softmax(dim=1))
    torch.testing.assert_close(loss, expected)


def test_the_cosine_loss_by_hand():
    demo = torch.tensor([[1.0, 0.0], [0.6, 0.8], [0.0, -1.0]])
    language = torch.tensor([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    torch.testing.assert_close(cosine_loss(demo, language), torch.tensor([0.0, 0.4, 2.0]))


# Networks


def test_film_begins_close_to_the_identity_and_then_modulates():
    film, x = Film(32, 8), torch.randn(4, 8, 5, 5)
    embedding = F.normalize(torch.randn(4, 32), dim=-1)
    torch.testing.assert_close(film(x, embedding), x, atol=0.02, rtol=0)
    with torch.no_grad():
        film.project.weight.zero_()
        film.project.bias.copy_(torch.cat([torch.full((8,), 2.0), torch.full((8,), 0.5)]))
    torch.testing.assert_close(film(x, embedding), 3 * x + 0.5)


def test_film_comes_after_the_second_norm_and_before_the_sum():
    block, x = FilmBlock(4, 4, film_dim=3).eval(), torch.randn(2, 4, 6, 6)
    with torch.no_grad():
        # gamma = -1 and beta = 0 silence the branch: only the shortcut is left.
        block.film.project.weight.zero_()
        block.film.project.bias.copy_(torch.cat([torch.full((4,), -1.0), torch.zeros(4)]))
        torch.testing.assert_close(block(x, torch.randn(2, 3)), x.relu())


@pytest.mark.parametrize(
    ("row", "column", "x", "y"), [(0, 0, -1, -1), (0, 6, 1, -1), (4, 3, 0, 1), (2, 3, 0, 0)]
)
def test_the_spatial_softmax_finds_the_only_active_place(row, column, x, y):
    maps = torch.full((1, 2, 5, 7), -100.0)
    maps[0, 0, row, column] = maps[0, 1, 2, 3] = 100.0
    torch.testing.assert_close(SpatialSoftmax()(maps), torch.tensor([[x, 0.0, y, 0.0]]).float())


def test_the_spatial_softmax_of_an_even_map_is_its_middle():
    torch.testing.assert_close(SpatialSoftmax()(torch.ones(1, 1, 8, 6)), torch.zeros(1, 2), atol=1e-6, rtol=0)


def test_the_papers_networks_have_the_papers_shapes():
    policy = ConditionedPolicy(n_cameras=1, film_dim=384, concat_dim=394, motion_dim=3, has_gripper=True)
    maps = policy.backbone(torch.rand(2, 3, 48, 48), torch.randn(2, 384))
    assert maps.shape == (2, 128, 24, 24)
    assert [layer.out_features for layer in policy.motion if isinstance(layer, torch.nn.Linear)] == [
        1024,
        512,
        256,
        3,
    ]
    assert policy.motion[0].in_features == 256 + 394
    motion, gripper = policy(torch.rand(2, 1, 3, 48, 48), torch.randn(2, 384), torch.randn(2, 394))
    assert motion.mean.shape == (2, 3)
    assert gripper.shape == (2,)
    encoder = ArrayEncoder(48, 48, 1, 2, 384)
    assert encoder.layers[0].in_features == 4608
    embedding = encoder(torch.rand(5, 2, 3, 48, 48))
    torch.testing.assert_close(embedding.norm(dim=-1), torch.ones(5))


def test_the_log_standard_deviation_stays_within_its_limits():
    policy = ConditionedPolicy(1, 0, 0, 3, False)
    torch.testing.assert_close(policy.log_std, torch.full((3,), INITIAL_LOG_STD))
    with torch.no_grad():
        policy.raw_log_std.copy_(torch.tensor([-50.0, 0.0, 50.0]))
    torch.testing.assert_close(policy.log_std, torch.tensor([-6.0, -3.0, 0.0]))


def test_outputs_are_not_rounded_under_mixed_precision():
    policy = ConditionedPolicy(1, 0, 0, 3, True, channels=(8,) * 8)
    hidden = []
    policy.motion[-1].register_forward_pre_hook(lambda layer, inputs: hidden.append(inputs[0]))
    with torch.autocast("cpu", torch.bfloat16):
        motion, gripper = policy(torch.rand(2, 1, 3, 24, 24), None, None)
    assert hidden[0].dtype == torch.bfloat16  # what comes before is quick
    last = policy.motion[-1]
    exact = F.linear(hidden[0].float(), last.weight, last.bias)
    assert motion.means.dtype == gripper.dtype == torch.float32
    torch.testing.assert_close(motion.means[:, 0], exact)
    assert (exact != exact.bfloat16()).any()


def test_cameras_are_seen_apart():
    policy = ConditionedPolicy(2, 4, 0, 3, False, channels=(8,) * 8).eval()
    images, film = torch.rand(3, 2, 3, 24, 24), torch.randn(3, 4)
    first, second = (policy(views, film, None)[0].mean for views in (images, images.flip(1)))
    assert not torch.allclose(first, second)


def test_the_strided_backbone_has_maps_of_half_the_size():
    backbone = BACKBONES["strided"]
    strided = ConditionedPolicy(1, 8, 8, 3, True, backbone.channels, backbone.stem_stride)
    assert strided.backbone(torch.rand(1, 3, 48, 48), torch.rand(1, 8)).shape == (1, 64, 12, 12)
    assert ArrayEncoder(48, 48, 1, 2, 384, backbone.demo_stride).layers[0].in_features == 4608 / 4


@pytest.mark.parametrize(("height", "width"), [(48, 48), (25, 25), (26, 19)])
@pytest.mark.parametrize("stride", [1, 2])
@pytest.mark.parametrize(("rows", "columns"), [(1, 2), (2, 2)])
def test_demonstrations_of_any_size_are_encoded(height, width, stride, rows, columns):
    encoder = ArrayEncoder(height, width, rows, columns, 12, stride)
    assert encoder(torch.rand(2, rows * columns, 3, height, width)).shape == (2, 12)


@pytest.mark.parametrize(("n_frames", "height", "width"), [(2, 48, 48), (4, 25, 19)])
def test_attention_encodes_demonstrations_of_any_size_as_unit_vectors(n_frames, height, width):
    embedding = AttentionEncoder(n_frames, 12)(torch.rand(3, n_frames, 3, height, width))
    torch.testing.assert_close(embedding.norm(dim=-1), torch.ones(3))


def test_attention_takes_the_same_from_wherever_it_is():
    encoder = AttentionEncoder(2, 12).eval()
    frames = torch.zeros(1, 2, 3, 48, 48)
    frames[:, 0, 0, 16:20, 16:20] = 1  # an object that is gone in the second frame
    moved = frames.roll((8, 8), dims=(-2, -1))
    # The last fully connected layers see, beside what is there, only 16 numbers that say where.
    positions = torch.zeros(encoder.layers[0].in_features)
    positions[-16:] = 1
    with torch.no_grad():
        encoder.layers[0].weight.mul_(1 - positions)
        shift = (encoder(moved) - encoder(frames)).abs().max()
        other_color = (encoder(frames.flip(2)) - encoder(frames)).abs().max()
    assert shift < 1e-6
    assert other_color > 1e-4


@pytest.mark.parametrize("motion_modes", [1, 3])
@pytest.mark.parametrize("film_dim", [0, 6])
def test_folding_the_batch_norms_changes_nothing_but_their_number(film_dim, motion_modes):
    network = ConditionedPolicy(
        2, film_dim, 3, 4, True, channels=(8, 8, 16), stem_stride=2, motion_modes=motion_modes
    )
    for module in network.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            module.running_mean.uniform_(-1, 1)
            module.running_var.uniform_(0.5, 2)
            torch.nn.init.uniform_(module.weight, 0.5, 2)
            torch.nn.init.uniform_(module.bias, -1, 1)
    network.eval()
    quick = folded(network)
    assert not any(isinstance(module, torch.nn.BatchNorm2d) for module in quick.modules())
    film = torch.randn(5, film_dim) if film_dim else None
    inputs = torch.rand(5, 2, 3, 24, 24), film, torch.randn(5, 3)
    for expected, actual in zip(network(*inputs), quick(*inputs), strict=True):
        torch.testing.assert_close(actual, expected, atol=1e-5, rtol=1e-4)


# Images


def test_frames_are_laid_out_in_raster_order():
    frames = torch.arange(4.0)[None, :, None, None, None].expand(1, 4, 3, 2, 2)
    array = frame_array(frames, rows=2)
    assert array.shape == (1, 3, 4, 4)
    assert array[0, 0, ::2, ::2].tolist() == [[0, 1], [2, 3]]
    assert frame_array(frames[:, :2], rows=1)[0, 0, 0].tolist() == [0, 0, 1, 1]


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


def test_all_images_of_a_sample_are_shifted_alike_and_by_the_generator_alone():
    images = torch.rand(4, 1, 3, 8, 8).expand(4, 2, 3, 8, 8)
    first = random_crop(images, 3, torch.Generator().manual_seed(1))
    torch.testing.assert_close(first[:, 0], first[:, 1])
    torch.testing.assert_close(first, random_crop(images, 3, torch.Generator().manual_seed(1)))
    assert not torch.equal(first, random_crop(images, 3, torch.Generator().manual_seed(2)))
