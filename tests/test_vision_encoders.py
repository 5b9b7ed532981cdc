"""Frozen image encoders: tiny models with random weights go through the real code that loads them."""

import functools

import pytest
import torch
import torchvision
from safetensors.torch import save_file
from small_policies import (
    EPISODES_PER_TASK,
    TASKS,
    batch_of,
    observation,
    small_policy,
    use_fake_encoder,
    write_dataset,
)
from transformers import (
    BitImageProcessor,
    CLIPConfig,
    CLIPImageProcessor,
    CLIPModel,
    Dinov2Config,
    Dinov2Model,
    ResNetConfig,
    ResNetModel,
    SiglipConfig,
    SiglipImageProcessor,
    SiglipModel,
)

from lerobot_deltaco.configuration_deltaco import DeltacoConfig
from lerobot_deltaco.modeling_deltaco import DeltacoPolicy
from lerobot_deltaco.policy import vision
from lerobot_deltaco.policy.demonstrations import DemonstrationSet
from lerobot_deltaco.policy.frozen_features import FrozenFeatures, Variants
from lerobot_deltaco.policy.heads import UnitHead
from lerobot_deltaco.policy.language import instruction_table
from lerobot_deltaco.policy.language.encoder_names import CLIP, LanguageEncoderSpec
from lerobot_deltaco.policy.precision import autocast
from lerobot_deltaco.policy.vision import VisionEncoderError, load_vision_encoder, r3m_weights, square

SIZE = {"hidden_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2, "intermediate_size": 16}
TEXT = {**SIZE, "vocab_size": 40, "bos_token_id": 1, "eos_token_id": 2, "pad_token_id": 0}
VISION = {**SIZE, "image_size": 32, "patch_size": 16}


def tiny_clip():
    return CLIPModel(
        CLIPConfig(
            text_config={**TEXT, "projection_dim": 8},
            vision_config={**VISION, "projection_dim": 8},
            projection_dim=8,
        )
    )


MODELS = {
    "clip": (tiny_clip, functools.partial(CLIPImageProcessor, crop_size={"height": 32, "width": 32}), 8),
    "siglip": (
        lambda: SiglipModel(SiglipConfig(text_config={**SIZE, "vocab_size": 40}, vision_config=VISION)),
        functools.partial(SiglipImageProcessor, size={"height": 32, "width": 32}),
        16,
    ),
    "dinov2": (
        lambda: Dinov2Model(
            Dinov2Config(hidden_size=16, num_hidden_layers=1, num_attention_heads=2, image_size=28)
        ),
        functools.partial(BitImageProcessor, crop_size={"height": 28, "width": 28}),
        16,
    ),
    "resnet": (
        lambda: ResNetModel(
            ResNetConfig(embedding_size=8, hidden_sizes=[8, 12], depths=[1, 1], layer_type="basic")
        ),
        functools.partial(BitImageProcessor, crop_size={"height": 32, "width": 32}),
        12,
    ),
}


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """A folder for each tiny model of transformers."""
    torch.manual_seed(0)
    found = {}
    for name, (make_model, make_processor, _) in MODELS.items():
        found[name] = tmp_path_factory.mktemp(name)
        make_model().save_pretrained(found[name])
        make_processor().save_pretrained(found[name])
    return found


@pytest.mark.parametrize("name", MODELS)
def test_any_image_model_of_transformers_is_loaded(folders, name):
    encoder = load_vision_encoder(str(folders[name]))
    images = torch.rand(3, 3, 20, 40)
    features = encoder(images)
    assert features.shape == (3, MODELS[name][2])
    assert features.isfinite().all()
    assert not features.requires_grad
    torch.testing.assert_close(encoder(images[1:]), features[1:], atol=1e-5, rtol=1e-4)
    assert encoder.feature_dim == MODELS[name][2]
    assert load_vision_encoder(str(folders[name])).fingerprint() == encoder.fingerprint()
    resized = load_vision_encoder(str(folders[name]), image_size=encoder.input_format.size * 2)
    assert resized.fingerprint() != encoder.fingerprint()


def test_clips_features_are_those_of_its_own_pipeline(folders):
    image = torch.randint(0, 256, (3, 32, 32), dtype=torch.uint8)
    processor, model = CLIPImageProcessor.from_pretrained(folders["clip"], do_resize=False), None
    pixels = processor(image, return_tensors="pt")["pixel_values"]
    model = CLIPModel.from_pretrained(folders["clip"]).eval()
    with torch.no_grad():
        expected = model.visual_projection(model.vision_model(pixels).pooler_output)
    encoder = load_vision_encoder(str(folders["clip"]))
    torch.testing.assert_close(encoder(image[None] / 255), expected, atol=1e-5, rtol=1e-4)


def test_images_are_cut_to_the_middle_square_and_scaled():
    images = torch.zeros(1, 3, 4, 8)
    images[..., 2:6] = 1
    assert (square(images, None) == 1).all()
    assert square(images, 16).shape == (1, 3, 16, 16)
    torch.testing.assert_close(square(images, 16), torch.ones(1, 3, 16, 16))


@pytest.mark.parametrize("layers", [18, 34, 50])
@pytest.mark.parametrize("suffix", [".pt", ".safetensors"])
def test_r3m_is_read_from_its_file(tmp_path, layers, suffix):
    if layers != 18 and suffix == ".safetensors":
        pytest.skip("one size is enough")
    network = getattr(torchvision.models, f"resnet{layers}")(weights=None).eval()
    weights = {f"module.convnet.{name}": value for name, value in network.state_dict().items()}
    weights["module.lang_rew.pred.0.weight"] = torch.zeros(2)
    file = tmp_path / f"model{suffix}"
    if suffix == ".pt":
        torch.save({"r3m": weights, "global_step": 7}, file)
    else:
        save_file(weights, file)
    encoder = load_vision_encoder(f"r3m-resnet{layers}", str(file), image_size=32)
    network.fc = torch.nn.Identity()
    images = torch.rand(2, 3, 32, 32)
    mean, std = (
        torch.tensor(values)[:, None, None] for values in (vision.IMAGENET_MEAN, vision.IMAGENET_STD)
    )
    with torch.no_grad():
        torch.testing.assert_close(encoder(images), network((images - mean) / std))
        authors = load_vision_encoder(f"r3m-resnet{layers}", str(file), input_kind="authors")
        wide = torch.rand(1, 3, 40, 40)
        torch.testing.assert_close(authors(wide), network((wide / 255 - mean) / std), atol=1e-4, rtol=1e-3)


def test_files_that_hold_no_r3m_are_refused(tmp_path):
    torch.save({"r3m": {"module.convnet.conv1.weight": torch.zeros(1)}}, tmp_path / "other.pt")
    torch.save(functools.partial(print, "run me"), tmp_path / "program.pt")
    (tmp_path / "text.pt").write_text("no weights")
    for name, message in (
        ("other", "no weights of R3M's"),
        ("program", "cannot be read"),
        ("text", "cannot be"),
    ):
        with pytest.raises(VisionEncoderError, match=message):
            load_vision_encoder("r3m-resnet18", str(tmp_path / f"{name}.pt"))
    assert set(r3m_weights({"conv1.weight": torch.zeros(1), "fc.bias": torch.zeros(1)})) == {"conv1.weight"}


def test_efficientnet_lite0_comes_with_its_package_and_works_offline(monkeypatch):
    monkeypatch.setattr("socket.socket.connect", lambda *_: pytest.fail("asked the network"))
    encoder = load_vision_encoder("efficientnet-lite0", image_size=64)
    torch.manual_seed(0)
    features = encoder(torch.rand(2, 3, 64, 64))
    assert features.shape == (2, 1280)
    # The last convolution ends in ReLU6.
    assert 0 <= features.min() < features.max() <= 6
    assert not torch.allclose(features[0], features[1], atol=0.05)


def test_other_weights_of_efficientnet_are_refused(monkeypatch):
    monkeypatch.setattr(vision, "_LITE_SHA256", "0" * 64)
    with pytest.raises(VisionEncoderError, match="not the published ones.*Do not use them"):
        load_vision_encoder("efficientnet-lite0")


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        (("no/model/here",), VisionEncoderError, "Valid are clip-vit-base-patch32.*efficientnet-lite0"),
        (("clip-vit-base-patch32",), VisionEncoderError, "extra `offline` and choose efficientnet-lite0"),
        (("efficientnet-lite0", "file.pt"), ValueError, "brings its own weights"),
        (("efficientnet-lite0", None, None, "authors"), ValueError, "differs from 'published' for R3M alone"),
        (("r3m-resnet18", None, None, "raw"), ValueError, "must be one of published, authors"),
        (("r3m-resnet18", "missing.pt"), VisionEncoderError, "missing.pt cannot be read"),
    ],
)
def test_what_cannot_be_loaded_is_explained(monkeypatch, arguments, error, message):
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    with pytest.raises(error, match=message):
        load_vision_encoder(*arguments)


def test_without_a_network_r3ms_file_is_asked_for(monkeypatch):
    def refuse(*_, **__):
        raise OSError("no network")

    monkeypatch.setattr(torch.hub, "load_state_dict_from_url", refuse)
    with pytest.raises(VisionEncoderError, match="name the file with `vision_encoder_weights`"):
        load_vision_encoder("r3m-resnet18")


def test_clips_language_transformer_is_a_language_encoder(folders, monkeypatch, tmp_path):
    from tokenizers import Tokenizer, models, pre_tokenizers
    from transformers import PreTrainedTokenizerFast

    words = {word: n for n, word in enumerate(["<pad>", "<s>", "</s>", "put", "it", "there", "<unk>"])}
    tokenizer = Tokenizer(models.WordLevel(words, unk_token="<unk>"))
    tokenizer.pre_tokenizer = pre_tokenizers.Whitespace()
    tiny_clip().save_pretrained(tmp_path)
    PreTrainedTokenizerFast(tokenizer_object=tokenizer, pad_token="<pad>", unk_token="<unk>").save_pretrained(
        tmp_path
    )
    table = {**instruction_table.LANGUAGE_ENCODERS, CLIP: LanguageEncoderSpec(str(tmp_path), 8)}
    monkeypatch.setattr(instruction_table, "LANGUAGE_ENCODERS", table)
    encode = instruction_table.load_language_encoder(CLIP)
    embeddings = encode(["put it there", "it there put", "put " * 200])
    assert embeddings.shape == (3, 8)
    assert embeddings.isfinite().all()
    assert not torch.allclose(embeddings[0], embeddings[1], atol=1e-5)


# Features of demonstrations


class CountingEncoder:
    """Features of an image: the means of its colors. Counts the images."""

    feature_dim = 3

    def __init__(self):
        self.n_images = 0

    def __call__(self, images):
        self.n_images += len(images)
        self.shape = images.shape[1:]
        return images.mean(dim=(2, 3))

    def fingerprint(self):
        return "means"


@pytest.fixture
def demonstrations():
    torch.manual_seed(0)
    frames = torch.randint(0, 256, (5, 6, 3, 8, 8), dtype=torch.uint8)
    return DemonstrationSet(frames, ["a", "a", "b", "b", "b"], [0, 1, 2, 3, 4])


def frozen(encoder, n_frames=4, crop_padding=2, folder=None):
    return FrozenFeatures(
        lambda: encoder, Variants(n_frames, n_frames // 2, 3, crop_padding, True, False, 0), folder
    )


def test_each_demonstration_is_encoded_once(demonstrations):
    encoder = CountingEncoder()
    features = frozen(encoder)
    rows = torch.tensor([0, 3, 3])
    generator = torch.Generator().manual_seed(0)
    drawn = [features.drawn(demonstrations, rows, generator) for _ in range(20)]
    assert encoder.n_images == 5 * (1 + 3)
    assert encoder.shape == (3, 16, 16)
    # Three variants of a demonstration, none of which is the plain one.
    assert len({tuple(batch[0].tolist()) for batch in drawn}) == 3
    plain = features.plain(demonstrations, rows)
    assert tuple(plain[0].tolist()) not in {tuple(batch[0].tolist()) for batch in drawn}
    assert encoder.n_images == 20
    assert features.plain(demonstrations).shape == (5, 3)


def test_without_random_choices_there_is_one_variant(demonstrations):
    encoder = CountingEncoder()
    features = frozen(encoder, n_frames=2, crop_padding=0)
    drawn = features.drawn(demonstrations, torch.arange(5), torch.Generator())
    assert encoder.n_images == 5
    expected = demonstrations.frames[:, [0, -1]].float().div(255).mean(dim=(1, 3, 4))
    torch.testing.assert_close(drawn, expected, atol=1e-3, rtol=0)


def test_features_do_not_depend_on_the_precision_of_the_training(demonstrations):
    means, layer = CountingEncoder(), torch.nn.Linear(3, 3).requires_grad_(False)
    found = []
    for dtype in ("float32", "bfloat16"):
        demonstrations.features = None
        features = frozen(lambda images: layer(means(images)))
        with autocast(dtype, torch.device("cpu")):
            found.append(features.drawn(demonstrations, torch.arange(5), torch.Generator().manual_seed(0)))
    assert torch.equal(*found)


def test_features_are_kept_for_further_trainings(demonstrations, tmp_path):
    encoders = [CountingEncoder(), CountingEncoder(), CountingEncoder()]
    found = []
    for encoder in encoders[:2]:
        demonstrations.features = None
        features = frozen(encoder, folder=tmp_path / "kept")
        found.append(features.drawn(demonstrations, torch.arange(5), torch.Generator().manual_seed(0)))
    assert [encoder.n_images for encoder in encoders] == [20, 0, 0]
    assert torch.equal(*found)
    # Other images are other features.
    other = DemonstrationSet(255 - demonstrations.frames, demonstrations.tasks, demonstrations.episodes)
    frozen(encoders[2], folder=tmp_path / "kept").plain(other)
    assert encoders[2].n_images == 5


def test_heads_end_in_unit_vectors():
    features = torch.randn(4, 6)
    torch.testing.assert_close(UnitHead(6, None, 6)(features), torch.nn.functional.normalize(features))
    head = UnitHead(6, [5], 3)
    assert [tuple(parameter.shape) for parameter in head.parameters()] == [(5, 6), (5,), (3, 5), (3,)]
    torch.testing.assert_close(head(features).norm(dim=1), torch.ones(4))
    with pytest.raises(ValueError, match="has the size of the features, 6. Got 3"):
        UnitHead(6, None, 3)


# Policies


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    episodes = [task for task in TASKS for _ in range(EPISODES_PER_TASK[task])]
    return write_dataset(tmp_path_factory.mktemp("data") / "foreign", episodes)


@pytest.fixture
def make(dataset, folders, monkeypatch):
    use_fake_encoder(monkeypatch)
    return functools.partial(
        small_policy,
        dataset,
        demo_encoder="pretrained",
        vision_encoder=str(folders["resnet"]),
        demo_repo_id="test/foreign",
        demo_root=str(dataset.root),
        demo_variants=2,
    )


@pytest.mark.parametrize(
    "options",
    [
        {"demo_rows": 2, "demo_head": [8]},
        {"demo_head": [], "dtype": "bfloat16"},
        {"method": "demo_only", "encoder_loss": "none"},
        {"film": "language", "concat": "demo", "encoder_loss": "none", "language_head": [8]},
        {"film": "demo+language", "concat": "none", "encoder_loss": "none"},
        {"method": "mcil", "demo_head": [8]},
        {"method": "bc_z", "demo_head": [8], "demos_per_task": 2},
    ],
    ids=str,
)
def test_policies_train_and_act_and_their_checkpoints_need_no_encoder(
    make, dataset, options, monkeypatch, tmp_path
):
    policy, before, _ = make(**options)
    weights = [parameter.detach().clone() for parameter in policy._frozen.encoder.network.parameters()]
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    batch = before(batch_of(dataset, [0, 7, 12, 20, 29]))
    losses = []
    for _ in range(3):
        loss, _ = policy(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert all(torch.isfinite(torch.tensor(losses)))
    for weight, kept in zip(policy._frozen.encoder.network.parameters(), weights, strict=True):
        assert torch.equal(weight, kept)
    assert not any("frozen" in name for name in policy.state_dict())
    policy.eval()
    observed = before(observation(dataset, [TASKS[0], TASKS[2]]))
    expected = policy.select_action(observed)
    policy.save_pretrained(tmp_path / "policy")
    monkeypatch.setattr(
        "lerobot_deltaco.modeling.network_factory.load_vision_encoder", lambda *_: pytest.fail("loaded")
    )
    loaded = DeltacoPolicy.from_pretrained(tmp_path / "policy")
    torch.testing.assert_close(loaded.select_action(observed), expected, atol=1e-3, rtol=1e-3)


def test_embeddings_of_other_sizes_are_not_compared(make):
    with pytest.raises(ValueError, match="have 12 numbers, and the instructions' have 384.*`demo_head`"):
        make()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"demo_head": [8]}, "`demo_head` has no effect with `demo_encoder=cnn`"),
        ({"demo_encoder": "pretrained"}, "have 512 numbers, and the instructions' have 384"),
        ({"demo_encoder": "pretrained", "vision_input": "raw"}, "`vision_input` must be one of published"),
        ({"demo_encoder": "pretrained", "demo_variants": 0}, "`demo_variants` must be at least 1"),
    ],
)
def test_impossible_configurations_say_what_is_valid(options, message):
    with pytest.raises(ValueError, match=message):
        DeltacoConfig(device="cpu", **options)
