"""Frozen encoders of sentences and images: the packaged ones, tiny models of transformers, and errors."""

import functools
import sys
from pathlib import Path
from unittest import mock

import pytest
import torch
import torchvision
from small_policies import TASKS, batch_of, demos_of, observation
from tokenizers import Tokenizer, models, pre_tokenizers
from transformers import CLIPConfig, CLIPImageProcessor, CLIPModel, CLIPProcessor, PreTrainedTokenizerFast

from lerobot_deltaco.data.demonstrations import DemonstrationBank
from lerobot_deltaco.policies.base import image_encoder, language
from lerobot_deltaco.policies.base.image_encoder import (
    IMAGENET_MEAN,
    IMAGENET_STD,
    EfficientNetLite0,
    PretrainedWeightsError,
)
from lerobot_deltaco.policies.base.instructions import InstructionEmbeddings
from lerobot_deltaco.policies.base.language import (
    LANGUAGE_ENCODERS,
    MINILM_L3,
    MINILM_L6,
    load_language_encoder,
)
from lerobot_deltaco.policies.deltaco import vision
from lerobot_deltaco.policies.deltaco.demo_encoders import encode_bank
from lerobot_deltaco.policies.deltaco.modeling_deltaco import DeltacoPolicy
from lerobot_deltaco.policies.deltaco.vision import VISION_ENCODERS, load_vision_encoder

SHIPPED = Path(__file__).parents[2] / "checkpoints" / "pick_place"

# Sentences


def test_packaged_l3_is_the_published_one():
    # By its authors' weights, read into transformers' BERT.
    embedding = load_language_encoder(MINILM_L3)(
        ["Put black and white colored, cup shaped conic cup in green bin."]
    )
    assert embedding[0, :4].tolist() == pytest.approx([0.3442, 0.3876, 0.2243, -0.1911], abs=1e-4)


@pytest.mark.parametrize("name", [MINILM_L3, MINILM_L6])
def test_packaged_encoders_need_no_network(monkeypatch, name):
    monkeypatch.setattr("socket.socket.connect", lambda *_: pytest.fail("asked the network"))
    encode = load_language_encoder(name)
    sentences = ["Put blue object in front bin.", "put the blu thing in the fornt bin", "Sing."]
    embeddings = encode([*sentences, "put it in the bin " * 200])  # a very long one is cut
    assert embeddings.shape == (4, LANGUAGE_ENCODERS[name].embedding_dim)
    assert embeddings.isfinite().all()
    cosine = torch.nn.functional.cosine_similarity(embeddings[:1], embeddings[1:3])
    assert cosine[0] > cosine[1]
    # Other sentences of the batch, and their lengths, do not matter.
    torch.testing.assert_close(encode(["Sing."])[0], embeddings[2], atol=1e-5, rtol=0)


def test_instructions_are_embedded_once_as_unit_vectors(monkeypatch):
    encode = mock.Mock(side_effect=lambda sentences: torch.full((len(sentences), 384), 3.0))
    monkeypatch.setattr(language, "load_language_encoder", lambda _: encode)
    instructions = InstructionEmbeddings(MINILM_L3)
    embeddings = instructions(["wave", "sing", "wave", ""], "cpu")
    torch.testing.assert_close(embeddings.norm(dim=1), torch.tensor([1.0, 1, 1, 0]))
    assert torch.equal(instructions(["", "wave"], "cpu"), embeddings[[3, 2]])
    encode.assert_called_once_with(["wave", "sing"])
    assert list(instructions.rows) == ["wave", "sing"]


@pytest.mark.parametrize("is_installed", [True, False])
@pytest.mark.parametrize("name", LANGUAGE_ENCODERS)
def test_error_without_network_or_packages_says_what_to_do(monkeypatch, name, is_installed):
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    monkeypatch.setattr(language, "_L6_MODULE", "no_such_package")
    if not is_installed:
        monkeypatch.setitem(sys.modules, "sentence_transformers", None)
    message = rf'{name} cannot be loaded: .*pip install "lerobot_policy_deltaco\[language\]"'
    with pytest.raises(language.LanguageEncoderError, match=message):
        load_language_encoder(name)


@pytest.fixture(scope="module")
def clip_folder(tmp_path_factory):
    torch.manual_seed(0)
    size = {"hidden_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2, "intermediate_size": 16}
    size["projection_dim"] = 8
    text = {**size, "vocab_size": 40, "bos_token_id": 1, "eos_token_id": 2, "pad_token_id": 0}
    images = {**size, "image_size": 32, "patch_size": 16}
    config = CLIPConfig(text_config=text, vision_config=images, projection_dim=8)
    folder = tmp_path_factory.mktemp("clip")
    CLIPModel(config).save_pretrained(folder)
    words = {word: n for n, word in enumerate(["<pad>", "<s>", "</s>", "put", "it", "there", "<unk>"])}
    tokenizer = Tokenizer(models.WordLevel(words, unk_token="<unk>"))
    tokenizer.pre_tokenizer = pre_tokenizers.Whitespace()
    special = {"pad_token": "<pad>", "unk_token": "<unk>"}
    tokenizer = PreTrainedTokenizerFast(tokenizer_object=tokenizer, model_max_length=77, **special)
    CLIPProcessor(CLIPImageProcessor(), tokenizer).save_pretrained(folder)
    return folder


def test_clip_encodes_the_middle_square_of_images(clip_folder, monkeypatch):
    monkeypatch.setattr(vision, "_CLIP", str(clip_folder))
    encoder = load_vision_encoder("clip-vit-base-patch32", image_size=32)
    images = torch.rand(3, 3, 32, 48)
    features = encoder(images)
    model = CLIPModel.from_pretrained(clip_folder).eval()
    mean, std = (torch.tensor(values)[:, None, None] for values in (vision._CLIP_MEAN, vision._CLIP_STD))
    with torch.no_grad():
        pooled = model.vision_model((images[..., 8:40] - mean) / std).pooler_output
        expected = model.visual_projection(pooled)
    torch.testing.assert_close(features, expected, atol=1e-5, rtol=1e-4)
    assert not features.requires_grad


def test_clip_encodes_sentences(clip_folder, monkeypatch):
    specs = {"clip-vit-base-patch32": language.LanguageEncoderSpec(str(clip_folder), 8)}
    monkeypatch.setattr(language, "LANGUAGE_ENCODERS", specs)
    embeddings = load_language_encoder("clip-vit-base-patch32")(
        ["put it there", "it there put", "put " * 200]
    )
    model = CLIPModel.from_pretrained(clip_folder).eval()
    tokens = torch.tensor([[3, 4, 5], [4, 5, 3]])
    expected = model.get_text_features(input_ids=tokens, attention_mask=torch.ones_like(tokens)).pooler_output
    torch.testing.assert_close(embeddings[:2], expected.detach(), atol=1e-5, rtol=1e-4)
    assert embeddings[2].isfinite().all()


def test_r3m_is_read_from_its_file(monkeypatch):
    network = torchvision.models.resnet18(weights=None).eval()
    weights = {f"module.convnet.{name}": value for name, value in network.state_dict().items()}
    weights["module.lang_rew.pred.0.weight"] = torch.zeros(2)
    monkeypatch.setattr(torch.hub, "load_state_dict_from_url", lambda *_, **__: {"r3m": weights})
    network.fc = torch.nn.Identity()
    images = torch.rand(2, 3, 32, 32)
    mean, std = (torch.tensor(values)[:, None, None] for values in (IMAGENET_MEAN, IMAGENET_STD))
    with torch.no_grad():
        published = load_vision_encoder("r3m-resnet18", image_size=32)
        torch.testing.assert_close(published(images), network((images - mean) / std), atol=1e-4, rtol=1e-3)
        authors = load_vision_encoder("r3m-resnet18-authors")
        expected = network((images / 255 - mean) / std)
        torch.testing.assert_close(authors(images), expected, atol=1e-4, rtol=1e-3)


def ramp():
    """A normalized image of 64 x 96 px: red increases to the right, green downwards, blue with both."""
    y, x = torch.meshgrid(torch.linspace(0, 1, 64), torch.linspace(0, 1, 96), indexing="ij")
    mean, std = (torch.tensor(values)[:, None, None] for values in (IMAGENET_MEAN, IMAGENET_STD))
    return ((torch.stack([x, y, x * y]) - mean) / std)[None]


# Shape, mean, standard deviation and sum of absolute values: the last by the package
# efficientnet_lite_pytorch 0.1.0, all by a network that was written out by hand and agreed with it.
PUBLISHED_MAPS = [
    ((1, 112, 4, 6), -0.3009069, 7.42929, 15661.416),
    ((1, 320, 2, 3), 0.0754193, 1.998083, 3014.2593),
    ((1, 1280, 2, 3), 0.0896977, 0.4400109, 688.87854),
]


def test_maps_of_efficientnet_are_those_of_its_publishers():
    random_state = torch.get_rng_state()
    for maps, (shape, mean, std, total) in zip(EfficientNetLite0()(ramp()), PUBLISHED_MAPS, strict=True):
        assert maps.shape == shape
        assert maps.mean().item() == pytest.approx(mean, rel=1e-4)
        assert maps.std().item() == pytest.approx(std, rel=1e-5)
        assert maps.abs().sum().item() == pytest.approx(total, rel=1e-5)
    assert torch.equal(torch.get_rng_state(), random_state)


def test_encoders_that_cannot_be_loaded_are_explained(monkeypatch):
    monkeypatch.setattr(torch.hub, "load_state_dict_from_url", mock.Mock(side_effect=OSError("no network")))
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    monkeypatch.setattr(image_encoder, "_PACKAGE", "no_such_package")
    for name in VISION_ENCODERS:
        is_packaged = name == "efficientnet-lite0"
        message = "needs the package no-such-package" if is_packaged else "choose efficientnet-lite0"
        with pytest.raises(PretrainedWeightsError, match=message):
            load_vision_encoder(name)


def test_bank_is_encoded_without_a_shift_and_in_random_variants():
    torch.manual_seed(0)
    frames = torch.randint(0, 256, (5, 6, 3, 8, 8), dtype=torch.uint8)
    bank, shapes = DemonstrationBank(frames, ["a", "a", "b", "b", "b"], range(5)), []

    def encoder(images):
        shapes.append(tuple(images.shape))
        return images.mean(dim=(2, 3))

    features = encode_bank(bank, encoder, n_frames=4, rows=2, n_variants=3, padding=2, seed=0)
    assert features.shape == (5, 4, 3)
    assert set(shapes) == {(5, 3, 16, 16)}
    assert len(features[0].unique(dim=0)) == 4
    again = encode_bank(bank, encoder, n_frames=4, rows=2, n_variants=3, padding=2, seed=0)
    assert torch.equal(features, again)
    plain = encode_bank(bank, encoder, n_frames=2, rows=1, n_variants=0, padding=2, seed=0)
    expected = frames[:, [0, -1]].float().div(255).mean(dim=(1, 3, 4))
    torch.testing.assert_close(plain[:, 0].float(), expected, atol=1e-3, rtol=0)


@pytest.fixture
def pretrained(make, dataset, fake_language):
    options = {"demo_encoder": "pretrained", "vision_encoder": "efficientnet-lite0", "vision_image_size": 32}
    return functools.partial(make, **options, demo_variants=2, **demos_of(dataset))


@pytest.mark.parametrize(
    "options",
    [
        {"demo_rows": 2, "demo_head": [8], "precision": "bfloat16"},
        {"method": "demo_only", "encoder_loss": "none"},
        {"method": "mcil", "demo_head": [8]},
    ],
    ids=str,
)
def test_policies_with_a_pretrained_encoder_do_not_need_it_in_their_checkpoints(
    pretrained, dataset, options, monkeypatch, tmp_path
):
    policy, before, _ = pretrained(**options)
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    batch = before(batch_of(dataset, [0, 7, 12, 20, 29]))
    for _ in range(2):
        loss, _ = policy(batch)
        assert torch.isfinite(loss)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    policy.eval()
    assert torch.isfinite(policy(batch)[0])
    seen = before(observation(dataset, [TASKS[0], TASKS[2]]))
    expected = policy.select_action(seen)
    policy.save_pretrained(tmp_path / "policy")
    monkeypatch.setattr(
        "lerobot_deltaco.policies.deltaco.modeling_deltaco.load_vision_encoder",
        lambda *_: pytest.fail("loaded"),
    )
    loaded = DeltacoPolicy.from_pretrained(tmp_path / "policy")
    torch.testing.assert_close(loaded.select_action(seen), expected, atol=1e-3, rtol=1e-3)
