"""The sentence encoders that come as packages, and what is said when one cannot be loaded."""

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from transformers import AutoTokenizer

from gym_deltaco.tasks import TASKS
from lerobot_deltaco.policy.language import instruction_table, packaged_encoders
from lerobot_deltaco.policy.language.encoder_names import LANGUAGE_ENCODERS, MINILM_L3, MINILM_L6
from lerobot_deltaco.policy.language.instruction_table import InstructionTable, load_language_encoder
from lerobot_deltaco.policy.language.packaged_encoders import LanguageEncoderError

INSTRUCTIONS = [task.instruction for task in TASKS]


def test_the_authors_encoder_computes_what_its_published_graph_does():
    session = onnxruntime.InferenceSession(str(packaged_encoders.l3_onnx_file()))
    tokenizer = AutoTokenizer.from_pretrained(packaged_encoders.packaged_l6())
    tokens = tokenizer(INSTRUCTIONS, padding=True, return_tensors="np")
    inputs = {name: tokens[name].astype(np.int64) for name in ("input_ids", "attention_mask")}
    (expected,) = (out for out in session.run(None, inputs) if out.shape == (300, 384))
    encode = packaged_encoders.packaged_l3(batch_size=64)
    np.testing.assert_allclose(encode(INSTRUCTIONS).numpy(), expected, atol=1e-5)
    assert len(np.unique(expected.round(4), axis=0)) == 300


def test_the_default_encoder_needs_no_network(monkeypatch):
    monkeypatch.setattr("socket.socket.connect", lambda *_: pytest.fail("asked the network"))
    encode = load_language_encoder(MINILM_L3)
    embeddings = encode(["Put blue object in front bin.", "put the blu thing in the fornt bin", "Sing."])
    assert embeddings.shape == (3, LANGUAGE_ENCODERS[MINILM_L3].embedding_dim)
    cosine = torch.nn.functional.cosine_similarity(embeddings[:1], embeddings[1:])
    assert cosine[0] > cosine[1]
    # Other sentences of the batch, and their lengths, do not matter.
    torch.testing.assert_close(encode(["Sing."])[0], embeddings[2], atol=1e-5, rtol=0)


def test_a_very_long_sentence_is_cut():
    assert load_language_encoder(MINILM_L3)(["put it in the bin " * 200]).isfinite().all()


def test_the_encoder_is_loaded_for_new_instructions_alone(monkeypatch):
    table = InstructionTable(MINILM_L3)
    table.put(["wave"], torch.ones(1, 384))
    monkeypatch.setattr(instruction_table, "load_language_encoder", lambda _: pytest.fail("loaded"))
    assert table(["wave", "wave"], "cpu").shape == (2, 384)


@pytest.mark.parametrize("name", [MINILM_L3, MINILM_L6])
def test_other_weights_are_refused(monkeypatch, tmp_path, name):
    for file in ("model.safetensors", "model.onnx"):
        (tmp_path / file).write_bytes(b"other weights")
    monkeypatch.setattr(packaged_encoders, "_l6_folder", lambda: tmp_path)
    monkeypatch.setattr(packaged_encoders, "l3_onnx_file", lambda: tmp_path / "model.onnx")
    with pytest.raises(LanguageEncoderError, match="not the published ones.*install the package again"):
        load_language_encoder(name)


def test_a_graph_of_another_model_is_refused():
    graph = onnx.helper.make_graph([], "empty", [], [])
    with pytest.raises(LanguageEncoderError, match="does not hold a BERT as expected"):
        packaged_encoders.read_bert(onnx.helper.make_model(graph).SerializeToString())


@pytest.mark.parametrize("name", LANGUAGE_ENCODERS)
def test_without_network_and_packages_the_way_out_is_named(monkeypatch, name):
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    monkeypatch.setattr(packaged_encoders, "_l6_folder", lambda: None)
    monkeypatch.setattr(packaged_encoders, "l3_onnx_file", lambda: None)
    with pytest.raises(LanguageEncoderError, match=f"{name} cannot be loaded.*extra `offline`"):
        load_language_encoder(name)
