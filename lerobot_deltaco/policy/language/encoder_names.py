"""The frozen sentence encoders that a policy can use. `policy/language/instruction_table.py` loads them."""

from types import MappingProxyType
from typing import NamedTuple

MINILM_L6 = "all-MiniLM-L6-v2"
MINILM_L3 = "paraphrase-MiniLM-L3-v2"
DEFAULT_LANGUAGE_ENCODER = MINILM_L3  # the authors'
CLIP = "clip-vit-base-patch32"


class LanguageEncoderSpec(NamedTuple):
    """A sentence encoder."""

    repo_id: str  # on the Hugging Face Hub
    embedding_dim: int


LANGUAGE_ENCODERS = MappingProxyType(
    {
        # The authors' "miniLM", "DistilRoBERTa" and "DistilBERT". The first, and ours at the end, also
        # come as Python packages, with the extra `offline`.
        MINILM_L3: LanguageEncoderSpec("sentence-transformers/paraphrase-MiniLM-L3-v2", 384),
        "all-distilroberta-v1": LanguageEncoderSpec("sentence-transformers/all-distilroberta-v1", 768),
        "distilbert-base-uncased": LanguageEncoderSpec("distilbert/distilbert-base-uncased", 768),
        # The authors' "CLIP": its language transformer.
        CLIP: LanguageEncoderSpec("openai/clip-vit-base-patch32", 512),
        MINILM_L6: LanguageEncoderSpec("sentence-transformers/all-MiniLM-L6-v2", 384),
    }
)
