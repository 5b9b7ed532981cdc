"""The frozen sentence encoders that a policy can use. `policy/language.py` loads them."""

from types import MappingProxyType
from typing import NamedTuple

MINILM_L6, MINILM_L3 = "all-MiniLM-L6-v2", "paraphrase-MiniLM-L3-v2"
DEFAULT_LANGUAGE_ENCODER = MINILM_L3  # the authors'


class LanguageEncoderSpec(NamedTuple):
    """A sentence encoder."""

    repo_id: str  # on the Hugging Face Hub
    embedding_dim: int


LANGUAGE_ENCODERS = MappingProxyType(
    {
        # The authors' "miniLM", "DistilRoBERTa" and "DistilBERT". The first, and ours below, also come as
        # Python packages, with the extra `offline`.
        MINILM_L3: LanguageEncoderSpec("sentence-transformers/paraphrase-MiniLM-L3-v2", 384),
        "all-distilroberta-v1": LanguageEncoderSpec("sentence-transformers/all-distilroberta-v1", 768),
        "distilbert-base-uncased": LanguageEncoderSpec("distilbert/distilbert-base-uncased", 768),
        MINILM_L6: LanguageEncoderSpec("sentence-transformers/all-MiniLM-L6-v2", 384),
    }
)
