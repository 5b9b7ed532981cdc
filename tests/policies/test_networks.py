"""Networks, losses and image operations by their properties."""

import pytest
import torch
import torch.nn.functional as F  # noqa: N812
from torch import nn

from lerobot_deltaco.policies.base.augmentation import random_shift, random_shifts, shift_images
from lerobot_deltaco.policies.base.image_coordinates import features_at, gaussian_maps
from lerobot_deltaco.policies.base.losses import imitation_loss, join_action, location_loss, split_action
from lerobot_deltaco.policies.base.networks import (
    BACKBONES,
    INITIAL_LOG_STD,
    ActionDistribution,
    PolicyNetwork,
    fuse_batch_norms,
    initialize_as_authors,
    uniform_linear_layers,
)
from lerobot_deltaco.policies.deltaco.demo_encoders import (
    AttentionEncoder,
    FrameGridEncoder,
    frame_grid,
    shift_demonstrations,
)


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)


@pytest.mark.parametrize("gripper_index", [None, 1])
def test_steps_beyond_the_end_of_an_episode_do_not_count(gripper_index):
    dim = 3 - (gripper_index is not None)
    means, logits, log_std = torch.randn(2, 4, 5, dim), torch.randn(2, 4), torch.randn(4, 5, dim)
    gripper = None if gripper_index is None else torch.randn(2, 5)
    action, is_pad = torch.rand(2, 5, 3) * 2 - 1, torch.arange(5) > torch.tensor([[1], [4]])

    def loss(action, n_steps=5):
        predicted = ActionDistribution(means[:, :, :n_steps], logits)
        of_steps = None if gripper is None else gripper[:, :n_steps]
        options = (gripper_index, "cross_entropy")
        return imitation_loss(predicted, of_steps, log_std[:, :n_steps], action, is_pad, *options)

    losses, logged = loss(action)
    other, other_logged = loss(torch.where(is_pad[..., None], 0.5, action))
    torch.testing.assert_close(losses, other)
    torch.testing.assert_close(logged, other_logged)
    torch.testing.assert_close(losses[0], loss(action, 2)[0][0])


def test_mode_is_the_mean_of_the_likeliest_component():
    means = torch.tensor([[[[1.0]], [[2.0]]], [[[3.0]], [[4.0]]]])
    logits = torch.tensor([[0.0, 1.0], [1.0, 0.0]])
    assert ActionDistribution(means, logits).mode.tolist() == [[[2.0]], [[3.0]]]


def test_nearly_equal_components_are_cycled_through_as_often_as_they_are_likely():
    means = torch.arange(4.0)[None, :, None, None].repeat(2, 1, 1, 1)
    logits = torch.tensor([[0.3, 0.0, 0.5, 0.2], [0.1, 0.7, 0.0, 0.2]]).log()
    predicted = ActionDistribution(means, logits)
    means = torch.stack([predicted.likely_mean(index)[:, 0, 0] for index in range(400)])
    assert means[0].tolist() == [2.0, 1.0]
    assert set(means[:, 1].tolist()) == {1.0}
    assert set(means[:, 0].tolist()) == {0.0, 2.0}
    assert abs((means[:, 0] == 0).float().mean() - 0.3 / 0.8) < 0.02
    # None waits long.
    assert all(len(set(some.tolist())) == 2 for some in means[:, 0].split(5))


def test_join_action_reverts_split_action():
    action = torch.rand(5, 4) * 2 - 1
    for gripper_index in (None, 0, 1, 3):
        rest, gripper = split_action(action, gripper_index)
        assert rest.shape == (5, 4 - (gripper_index is not None))
        torch.testing.assert_close(join_action(rest, gripper, gripper_index), action)


def test_paper_networks_have_the_sizes_of_the_paper():
    network = PolicyNetwork(n_cameras=1, film_dim=384, concat_dim=394, action_dim=3, has_gripper=True)
    assert network.backbone(torch.rand(2, 3, 48, 48), torch.randn(2, 384)).shape == (2, 128, 24, 24)
    sizes = [layer.out_features for layer in network.action_head if isinstance(layer, nn.Linear)]
    assert sizes == [1024, 512, 256, 3]
    assert network.action_head[0].in_features == 256 + 394
    torch.testing.assert_close(network.log_std, torch.full((1, 1, 3), INITIAL_LOG_STD))
    assert FrameGridEncoder(48, 48, 1, 2, 384).layers[0].in_features == 4608
    backbone = BACKBONES["strided"]
    strided = PolicyNetwork(1, 8, 8, 3, True, backbone.channels, backbone.stem_stride)
    assert strided.backbone(torch.rand(1, 3, 48, 48), torch.rand(1, 8)).shape == (1, 64, 12, 12)
    assert FrameGridEncoder(48, 48, 1, 2, 384, backbone.demo_stride).layers[0].in_features == 4608 / 4


def test_outputs_are_not_rounded_under_mixed_precision():
    network = PolicyNetwork(1, 0, 0, 3, True, channels=(8,) * 2)
    hidden = []
    network.action_head[-1].register_forward_pre_hook(lambda layer, inputs: hidden.append(inputs[0]))
    with torch.autocast("cpu", torch.bfloat16):
        predicted, gripper = network(torch.rand(2, 1, 3, 24, 24), None, None)
    assert hidden[0].dtype == torch.bfloat16
    last = network.action_head[-1]
    exact = F.linear(hidden[0].float(), last.weight, last.bias)
    assert predicted.means.dtype == gripper.dtype == torch.float32
    torch.testing.assert_close(predicted.mode[:, 0], exact)
    assert (exact != exact.bfloat16()).any()


def test_locations_reach_the_action_through_the_first_camera_alone():
    network = PolicyNetwork(2, 0, 0, 3, True, (8, 8), 2, n_locations=2).eval()
    images, locations = torch.rand(1, 2, 3, 24, 24), torch.zeros(1, 2, 2)
    seen = []
    network.backbone.register_forward_pre_hook(lambda layer, inputs: seen.append(inputs[0]))
    action, gripper = network(images, None, None, locations)
    assert seen[0][0, 3:].amax(dim=(1, 2)).min() > 0.7
    assert not seen[0][1, 3:].any()
    other_action, other_gripper = network(images, None, None, locations + 0.5)
    assert not torch.equal(action.mode, other_action.mode)
    assert not torch.equal(gripper, other_gripper)
    assert not torch.equal(network(images.flip(1), None, None, locations)[0].mode, action.mode)


@pytest.mark.parametrize("film_dim", [0, 6])
def test_fusing_batch_norms_changes_no_output(film_dim):
    network = PolicyNetwork(2, film_dim, 3, 4, True, (8, 8, 16), stem_stride=2, num_components=3)
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.running_mean.uniform_(-1, 1)
            module.running_var.uniform_(0.5, 2)
            nn.init.uniform_(module.weight, 0.5, 2)
            nn.init.uniform_(module.bias, -1, 1)
    network.eval()
    fused = fuse_batch_norms(network)
    assert not any(isinstance(module, nn.BatchNorm2d) for module in fused.modules())
    film = torch.randn(5, film_dim) if film_dim else None
    inputs = torch.rand(5, 2, 3, 24, 24), film, torch.randn(5, 3)
    for expected, actual in zip(network(*inputs), fused(*inputs), strict=True):
        torch.testing.assert_close(actual, expected, atol=1e-5, rtol=1e-4)


def test_initial_weights_of_the_authors():
    network = PolicyNetwork(1, 8, 4, 3, True)
    film = network.backbone.blocks[0].film.project.weight.clone()
    initialize_as_authors(network)
    for head in (network.action_head, network.gripper_head):
        for layer in head:
            if isinstance(layer, nn.Linear):
                assert 0.9e-3 < layer.weight.abs().max() <= 1e-3
                assert layer.bias.abs().max() <= 1e-3
    torch.testing.assert_close(network.log_std.exp(), torch.full((1, 1, 3), 0.05))
    convolution = network.backbone.blocks[7].conv2
    expected = torch.tensor((2 / (convolution.out_channels * 9)) ** 0.5)
    torch.testing.assert_close(convolution.weight.std(), expected, rtol=0.02, atol=0)
    assert torch.equal(network.backbone.blocks[0].film.project.weight, film)
    encoder = FrameGridEncoder(24, 24, 1, 2, 384)
    uniform_linear_layers(encoder, 1e-4)
    # Small as they are, the embeddings have unit length, and a gradient.
    embedding = encoder(torch.rand(2, 2, 3, 24, 24))
    torch.testing.assert_close(embedding.norm(dim=1), torch.ones(2))
    embedding[:, 0].sum().backward()
    assert encoder.layers[-1].weight.grad.abs().max() > 0


@pytest.mark.parametrize(("height", "width", "rows", "stride"), [(25, 25, 1, 1), (26, 19, 2, 2)])
def test_demonstrations_of_any_size_become_unit_vectors(height, width, rows, stride):
    frames = torch.rand(2, rows * 2, 3, height, width)
    for encoder in (FrameGridEncoder(height, width, rows, 2, 12, stride), AttentionEncoder(rows * 2, 12)):
        torch.testing.assert_close(encoder(frames).norm(dim=-1), torch.ones(2))


def test_random_shifts_move_images_right_and_down_and_leave_black_edges():
    images = torch.rand(64, 2, 3, 9, 9)
    shifts = random_shifts(64, 4, torch.Generator().manual_seed(0))
    shifted = shift_images(images, shifts, 4)
    assert torch.equal(shifted, random_shift(images, 4, torch.Generator().manual_seed(0)))
    assert {tuple(shift) for shift in shifts.tolist()} != {(0, 0)}
    assert set(shifts.flatten().tolist()) == set(range(-4, 5))
    for image, moved, (right, down) in zip(images, shifted, shifts.tolist(), strict=True):
        expected = torch.zeros_like(image)
        to = (slice(max(0, down), 9 + min(0, down)), slice(max(0, right), 9 + min(0, right)))
        source = (slice(max(0, -down), 9 + min(0, -down)), slice(max(0, -right), 9 + min(0, -right)))
        expected[(..., *to)] = image[(..., *source)]
        assert torch.equal(moved, expected)


def test_frame_grid_is_shifted_as_a_whole():
    frames = torch.rand(16, 2, 3, 8, 8)
    shifted = shift_demonstrations(frames, 3, 1, torch.Generator().manual_seed(0))
    expected = random_shift(frame_grid(frames, 1), 3, torch.Generator().manual_seed(0))
    assert torch.equal(frame_grid(shifted, 1), expected)
    assert torch.equal(shift_demonstrations(frames, 0, 2, torch.Generator()), frames)
    apart = shift_demonstrations(frames, 3, None, torch.Generator().manual_seed(0))
    assert torch.equal(apart, random_shift(frames, 3, torch.Generator().manual_seed(0)))


def test_features_at_a_location_are_those_around_it():
    locations = torch.tensor([[[-0.5, 0.25]]])
    maps = torch.zeros(1, 2, 16, 16)
    maps[0, 0, 9, 3] = maps[0, 0, 10, 4] = 1.0
    maps[0, 1] = 1.0
    found = features_at(maps, locations)[0, 0]
    assert found[0] > 0.05
    torch.testing.assert_close(found[1], torch.tensor(1.0))
    assert features_at(maps, -locations)[0, 0, 0] < 1e-3


def test_location_loss_is_least_at_the_right_locations():
    locations = torch.tensor([[[0.3, -0.4], [-0.5, 0.6]]])
    right = 5 * gaussian_maps(locations, 12, 12, 0.2)
    wrong, flat = right.flip(1), torch.zeros_like(right)
    assert (location_loss(right, locations) < location_loss(flat, locations)).all()
    assert (location_loss(flat, locations) < location_loss(wrong, locations)).all()
