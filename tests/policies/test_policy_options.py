"""Options of the policies: defaults, errors, optimizer and schedule."""

from types import SimpleNamespace

import draccus
import pytest
import torch
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature
from lerobot.scripts import lerobot_train

from lerobot_deltaco.policies.base import configuration as base_config
from lerobot_deltaco.policies.deltaco.configuration_deltaco import DeltacoConfig
from lerobot_deltaco.policies.deltaco_match.configuration_deltaco_match import DeltacoMatchConfig

MEAN_STD = NormalizationMode.MEAN_STD


def test_defaults_of_deltaco_are_those_of_the_paper():
    config = DeltacoConfig(device="cpu")
    assert config.conditioning == ("demo", "language", "contrastive")
    assert (config.language_encoder, config.embedding_dim) == ("paraphrase-MiniLM-L3-v2", 384)
    assert (config.demo_encoder, config.demo_rows, config.n_demo_frames) == ("cnn", 1, 2)
    assert (config.image_size, config.shift_padding, config.backbone) == (48, 4, "paper")
    assert (config.num_mixture_components, config.gripper_loss) == (1, "squared_error")
    optimizer = config.get_optimizer_preset()
    assert (optimizer.lr, optimizer.weight_decay, optimizer.grad_clip_norm) == (3e-4, 0, 0)
    assert config.get_scheduler_preset() is None
    assert (config.tasks_per_batch, config.push_to_hub, config.precision) == (16, False, "float32")
    modes = NormalizationMode.IDENTITY, MEAN_STD, NormalizationMode.MIN_MAX
    assert config.normalization_mapping == dict(zip(("VISUAL", "STATE", "ACTION"), modes, strict=True))


def test_invalid_options_say_what_is_valid():
    for options, message in [
        ({"method": "best"}, "`method` must be one of deltaco, language_only"),
        ({"language_encoder": "clip"}, "`language_encoder` must be one of paraphrase-MiniLM-L3-v2"),
        ({"num_mixture_components": 0}, "`num_mixture_components` must be from 1 to 1000. Got 0"),
        ({"optimizer_lr": float("nan")}, "`optimizer_lr` must be from"),
        ({"tasks_per_batch": -1}, "`tasks_per_batch` must be from 0"),
        ({"n_action_steps": 2}, "`n_action_steps` must be from 1 to 1"),
        ({"gripper": "left"}, "`gripper` must be 'auto', 'none' or an index"),
        ({"film": "none", "concat": "none"}, "no demonstration is used"),
        ({"method": "language_only", "encoder_loss": "contrastive"}, "no demonstration is used"),
        ({"method": "mcil", "film": "demo"}, "`film` cannot be changed"),
        ({"demo_encoder": "pretrained"}, "have 512 numbers, and the instructions' have 384"),
        ({"vision_encoder": "dino"}, "`vision_encoder` must be one of clip-vit-base-patch32, r3m-resnet18"),
        ({"normalization_mapping": {"VISUAL": MEAN_STD}}, "`normalization_mapping` must be IDENTITY for VIS"),
        ({"p_color_jitter": 1.5}, "`p_color_jitter` must be from 0 to 1"),
        ({"location_noise": -0.1}, "`location_noise` must be from 0 to 1"),
        ({"state_noise": -1}, "`state_noise` must be from 0 to 10"),
        ({"n_demonstrations": 0}, "`n_demonstrations` must be from 1"),
        ({"n_demonstrations": 5, "demo_episode": 0}, "names a single demonstration, but .* is 5"),
        ({"temporal_ensemble_coeff": float("nan"), "n_action_steps": 1}, "coeff` must be from -0.05 to 10"),
        ({"temporal_ensemble_coeff": float("inf"), "n_action_steps": 1}, "coeff` must be from -0.05 to 10"),
        ({"upsampled_fraction": float("nan")}, "`upsampled_fraction` must be from 0 to 1"),
        ({"grasp_height_bias": float("nan")}, "`grasp_height_bias` must be from -10 to 10"),
        ({"frames_after_release": -1}, "`frames_after_release` must be from 0"),
    ]:
        policy = (
            DeltacoConfig if all(hasattr(DeltacoConfig, name) for name in options) else DeltacoMatchConfig
        )
        with pytest.raises(ValueError, match=message):
            policy(device="cpu", **options)


def test_bfloat16_needs_instructions_of_the_processor(monkeypatch, caplog):
    for supported, precision in ((True, "bfloat16"), (False, "float32")):
        monkeypatch.setattr(base_config, "has_bfloat16", lambda: supported)  # noqa: B023
        assert DeltacoMatchConfig(device="cpu").precision == precision
        assert ("no bfloat16 instructions" in caplog.text) == (not supported)


def test_command_line_of_lerobot_logs_what_is_wrong(monkeypatch, caplog):
    """LeRobot's parser says no more than which class it cannot make."""
    options = ["--dataset.repo_id=user/data", "--policy.type=deltaco_match", "--policy.location_noise=2"]
    monkeypatch.setattr("sys.argv", ["lerobot-train", *options])
    with pytest.raises((SystemExit, draccus.utils.ParsingError)):
        lerobot_train.train()
    assert "`location_noise` must be from 0" in caplog.text


def features_config(action=(3,), **options):
    return DeltacoConfig(
        device="cpu",
        input_features={
            "observation.image": PolicyFeature(FeatureType.VISUAL, (3, 48, 48)),
            "observation.state": PolicyFeature(FeatureType.STATE, (2,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, action)},
        **options,
    )


@pytest.mark.parametrize(
    ("names", "gripper", "index"),
    [
        (["left", "left_gripper.pos", "right"], "auto", 1),
        ({"motors": ["a", "Gripper", "gripper.2"]}, "auto", 1),  # the one that moves most
        (["a", "b", "c"], "auto", None),
        (None, "auto", None),
        (["a", "b", "gripper"], "0", 0),
        (["a", "b", "gripper"], "none", None),
    ],
)
def test_gripper_is_found_by_name_or_given(names, gripper, index, caplog):
    config = features_config(gripper=gripper)
    config.set_dataset_feature_metadata({"action": {"names": names}}, {"action": {"std": [3, 2, 1]}})
    config.validate_features()
    assert config.gripper_index == index
    assert ("moves most, dimension 1 of the action (Gripper)" in caplog.text) == isinstance(names, dict)
    assert config.normalization_mapping["ACTION"] is NormalizationMode.MIN_MAX


def test_features_that_do_not_fit_are_errors():
    for config, message in [
        (features_config(gripper="3"), "only the dimensions 0 to 2"),
        (features_config(demo_camera="observation.wrist"), "one of the dataset's cameras, observation.image"),
        (DeltacoConfig(device="cpu"), "needs at least one camera"),
    ]:
        with pytest.raises(ValueError, match=message):
            config.validate_features()


def test_cosine_schedule_warms_up_and_ends_at_zero():
    config = DeltacoMatchConfig(device="cpu", scheduler_warmup_steps=4)
    optimizer = config.get_optimizer_preset().build([torch.nn.Parameter(torch.zeros(1))])
    schedule = config.get_scheduler_preset().build(optimizer, 20)
    rates = [schedule.get_last_lr()[0]]
    for _ in range(20):
        optimizer.step()
        schedule.step()
        rates.append(schedule.get_last_lr()[0])
    assert rates[2] == pytest.approx(0.5e-3)
    assert max(rates) == rates[4]
    assert rates[12] == pytest.approx(0.5e-3)
    assert rates[20] == pytest.approx(0)


def test_a_chunk_lasts_two_thirds_of_a_second_where_steps_are_small():
    cases = [(30, 24, 1), (150, 30, 20), (400, 50, 33), (90, 1, 1), (57, 10, 7), (900, 200, 50)]
    for n_frames, fps, expected in cases:
        meta = SimpleNamespace(total_frames=7 * n_frames, total_episodes=7, fps=fps)
        config = DeltacoMatchConfig(device="cpu")
        config.set_dataset_length(meta)
        assert config.chunk_size == expected
        assert config.action_delta_indices == (None if expected == 1 else list(range(expected)))
    fixed = DeltacoMatchConfig(device="cpu", chunk_size=3)
    fixed.set_dataset_length(meta)
    assert fixed.chunk_size == 3
