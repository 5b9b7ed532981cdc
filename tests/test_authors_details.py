"""Details of the authors' code that the paper leaves out, as options."""

import pytest
import torch
from einops import rearrange
from torch import nn

from lerobot_deltaco.configuration_deltaco import DeltacoConfig
from lerobot_deltaco.policy.demo_encoders import ArrayEncoder, crop_demonstrations, frame_array
from lerobot_deltaco.policy.demonstrations import DemonstrationSet
from lerobot_deltaco.policy.initial_weights import initialize_demo_encoder, initialize_policy
from lerobot_deltaco.policy.networks import ConditionedPolicy, random_crop


def test_the_array_is_shifted_as_a_whole():
    torch.manual_seed(0)
    frames = torch.rand(16, 2, 3, 8, 8)
    cropped = crop_demonstrations(frames, 3, 1, torch.Generator().manual_seed(0))
    assert cropped.shape == frames.shape
    expected = random_crop(frame_array(frames, 1), 3, torch.Generator().manual_seed(0))
    assert torch.equal(frame_array(cropped, 1), expected)
    # Where the array moves to the left, the first frame ends with the beginning of the second.
    padded = torch.nn.functional.pad(frame_array(frames, 1), [3] * 4)
    moved = padded[:, :, 3:11, 5:21]
    places = [n for n in range(16) if torch.equal(frame_array(cropped, 1)[n], moved[n])]
    apart = rearrange(moved, "b d h (c w) -> b c d h w", c=2)
    for n in places:
        assert torch.equal(cropped[n, 0, :, :, -2:], frames[n, 1, :, :, :2])
        assert torch.equal(cropped[n], apart[n])
    # A row of frames comes back in its order.
    assert torch.equal(crop_demonstrations(frames, 0, 2, torch.Generator()), frames)


def test_frames_between_are_drawn_from_equal_parts_of_the_time():
    frames = torch.arange(16, dtype=torch.uint8)[None, :, None, None, None].expand(1, 16, 3, 2, 2)
    demos = DemonstrationSet(frames, ["a"], [0])
    rows = torch.zeros(500, dtype=torch.int64)

    def drawn(spread):
        images = demos.sample_frames(rows, 4, torch.Generator().manual_seed(0), spread)
        return (images[:, :, 0, 0, 0] * 255).round().long()

    spread = drawn(True)
    assert (spread[:, 0] == 0).all()
    assert (spread[:, 3] == 15).all()
    assert spread[:, 1].unique().tolist() == list(range(1, 8))
    assert spread[:, 2].unique().tolist() == list(range(8, 15))
    independent = drawn(False)
    assert (independent[:, 1] == independent[:, 2]).any()
    assert (independent[:, 1] > 7).any()
    assert (demos.sample_frames(rows[:2], 2, torch.Generator(), True)[:, 1] * 255 == 15).all()


def test_the_authors_initial_weights():
    torch.manual_seed(0)
    policy = ConditionedPolicy(1, 8, 4, 3, True)
    film = policy.backbone.blocks[0].film.project.weight.clone()
    initialize_policy(policy)
    linear = [
        layer for part in (policy.motion, policy.gripper) for layer in part if isinstance(layer, nn.Linear)
    ]
    for layer in linear:
        for values in (layer.weight, layer.bias):
            assert values.abs().max() <= 1e-3
        assert layer.weight.abs().max() > 0.9e-3
    torch.testing.assert_close(policy.log_std.exp(), torch.full((3,), 0.05))
    convolution = policy.backbone.blocks[7].conv2
    fan_out = convolution.out_channels * 9
    torch.testing.assert_close(
        convolution.weight.std(), torch.tensor((2 / fan_out) ** 0.5), rtol=0.02, atol=0
    )
    assert torch.equal(policy.backbone.blocks[0].film.project.weight, film)
    encoder = ArrayEncoder(48, 48, 1, 2, 384)
    convolutions = encoder.convolutions[0].weight.clone()
    initialize_demo_encoder(encoder)
    assert all(
        values.abs().max() <= 1e-4
        for layer in encoder.layers
        if isinstance(layer, nn.Linear)
        for values in layer.parameters()
    )
    assert torch.equal(encoder.convolutions[0].weight, convolutions)
    # Small as they are, the embeddings have unit length, and a gradient.
    embedding = encoder(torch.rand(2, 2, 3, 48, 48))
    torch.testing.assert_close(embedding.norm(dim=1), torch.ones(2))
    embedding[:, 0].sum().backward()
    assert encoder.layers[-1].weight.grad.abs().max() > 0


def test_the_authors_weights_are_those_of_the_papers_backbone():
    assert DeltacoConfig(device="cpu").initial_weights == "authors"
    assert DeltacoConfig(device="cpu", backbone="strided").initial_weights == "torch"
    assert DeltacoConfig(device="cpu", initial_weights="torch").initial_weights == "torch"


def test_an_l2_penalty_is_adams():
    weight = nn.Parameter(torch.tensor([2.0]))
    config = DeltacoConfig(device="cpu", optimizer_l2=1e-2)
    optimizer = config.get_optimizer_preset().build([weight])
    assert type(optimizer) is torch.optim.Adam
    reference = nn.Parameter(torch.tensor([2.0]))
    plain = torch.optim.Adam([reference], lr=3e-4)
    for _ in range(3):
        for parameter, chosen, penalty in ((weight, optimizer, 0.0), (reference, plain, 1e-2)):
            chosen.zero_grad()
            (parameter.square().sum() + 0.5 * penalty * parameter.square().sum()).backward()
            chosen.step()
    torch.testing.assert_close(weight, reference)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"demo_crop": "image"}, "`demo_crop` must be one of array, frame"),
        ({"demo_frames_between": "first"}, "`demo_frames_between` must be one of spread, any"),
        ({"initial_weights": "zero"}, "`initial_weights` must be one of authors, torch"),
        ({"optimizer_l2": -1.0}, "`optimizer_l2` must be at least 0"),
        ({"optimizer_l2": 1e-4, "optimizer_weight_decay": 0.1}, "exclude each other"),
    ],
)
def test_impossible_choices_say_what_is_valid(options, message):
    with pytest.raises(ValueError, match=message):
        DeltacoConfig(device="cpu", **options)
