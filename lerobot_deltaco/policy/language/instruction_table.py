"""Loads frozen sentence encoders, and keeps the embeddings of instructions.

A new kind of encoder needs an entry of `LANGUAGE_ENCODERS` and, if sentence-transformers does not support it,
a branch of `load_language_encoder`.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor

from lerobot_deltaco.policy.language.encoder_names import CLIP, LANGUAGE_ENCODERS, MINILM_L3, MINILM_L6
from lerobot_deltaco.policy.language.packaged_encoders import LanguageEncoderError, packaged_l3, packaged_l6
from lerobot_deltaco.policy.task_file import TaskFile, read_task_file

BATCH_SIZE = 64
# Of the length of a vector that counts as a unit vector, and is left as it is.
UNIT_TOLERANCE = 1e-6

# From sentences to embeddings, (sentences, embedding), on the CPU.
LanguageEncoder = Callable[[Sequence[str]], Tensor]


def load_language_encoder(name: str) -> LanguageEncoder:
    """Loads a frozen encoder of sentences.

    The embedding of a sentence is the mean of its tokens' embeddings; with CLIP, it is CLIP's own embedding
    of the sentence. all-MiniLM-L6-v2 and all-distilroberta-v1 scale it to unit length, the others do not.

    Args:
        name: One of `LANGUAGE_ENCODERS`.

    Raises:
        LanguageEncoderError: A package is missing, or the model can be neither found nor downloaded.
    """
    encode = packaged_l3(BATCH_SIZE) if name == MINILM_L3 else None
    if encode is None:
        try:
            encode = _clip_encoder() if name == CLIP else _sentence_transformer(name)
        except OSError as error:
            raise LanguageEncoderError(
                f"The language encoder {name} cannot be loaded: {str(error).splitlines()[0]} Without a "
                f"network, install this project's extra `offline`, which brings {MINILM_L3} and {MINILM_L6}, "
                "and set `language_encoder` to one of them."
            ) from error

    def encode_outside_inference_mode(sentences: Sequence[str]) -> Tensor:
        return encode(sentences).float().clone()

    return encode_outside_inference_mode


def _sentence_transformer(name: str) -> LanguageEncoder:
    try:
        from sentence_transformers import SentenceTransformer
    except ImportError as error:
        raise LanguageEncoderError(
            "Instructions need the package sentence-transformers. Install this project again, as its README "
            "says."
        ) from error
    source = (packaged_l6() if name == MINILM_L6 else None) or LANGUAGE_ENCODERS[name].repo_id
    # A model without a pooling layer of its own, such as DistilBERT, gets mean pooling.
    model = SentenceTransformer(str(source), device="cpu")
    model.eval().requires_grad_(False)

    @torch.inference_mode()
    def encode(sentences: Sequence[str]) -> Tensor:
        return model.encode(
            list(sentences), batch_size=BATCH_SIZE, convert_to_tensor=True, show_progress_bar=False
        )

    return encode


def _clip_encoder() -> LanguageEncoder:
    from transformers import AutoTokenizer, CLIPModel

    source = LANGUAGE_ENCODERS[CLIP].repo_id
    model = CLIPModel.from_pretrained(source).eval().requires_grad_(False)
    del model.vision_model
    tokenizer = AutoTokenizer.from_pretrained(source)
    n_tokens = model.config.text_config.max_position_embeddings

    @torch.inference_mode()
    def encode(sentences: Sequence[str]) -> Tensor:
        found = []
        for start in range(0, len(sentences), BATCH_SIZE):
            tokens = tokenizer(
                list(sentences[start : start + BATCH_SIZE]),
                padding=True,
                truncation=True,
                max_length=n_tokens,
                return_tensors="pt",
            )
            features = model.get_text_features(
                input_ids=tokens["input_ids"], attention_mask=tokens["attention_mask"]
            )
            # Versions of transformers from 5 on return more than the features.
            found.append(features if isinstance(features, Tensor) else features.pooler_output)
        return torch.cat(found)

    return encode


# With `--env.max_parallel_tasks` above 1, threads share a policy. A table with a lock could not be copied.
_LOCK = threading.RLock()


class InstructionTable:
    """Embeddings of instructions, each computed once. Several threads may ask at the same time.

    Args:
        encoder_name: One of `LANGUAGE_ENCODERS`.

    Attributes:
        rows: Place of each known instruction among the embeddings.
        embeddings: Unit vectors of the known instructions, (instructions, embedding).
        lengths: Lengths of the embeddings as the encoder gives them, (instructions,).
        only_unit: Whether some lengths are unknown, since files of version 0.1 have only unit vectors. Then
            all embeddings are used with unit length.
    """

    def __init__(self, encoder_name: str) -> None:
        self.encoder_name = encoder_name
        self.rows: dict[str, int] = {}
        self.embeddings = torch.empty(0, LANGUAGE_ENCODERS[encoder_name].embedding_dim)
        self.lengths = torch.empty(0)
        self.only_unit = False
        self._encode: LanguageEncoder | None = None

    def add(self, instructions: Sequence[str]) -> None:
        """Embeds those that are not known yet, in batches.

        Raises:
            LanguageEncoderError: The encoder cannot be loaded.
        """
        with _LOCK:
            new = [text for text in dict.fromkeys(instructions) if text not in self.rows]
            if not new:
                return
            if self._encode is None:
                self._encode = load_language_encoder(self.encoder_name)
            self.put(new, self._encode(new))

    def put(self, instructions: Sequence[str], embeddings: Tensor, lengths: Tensor | None = None) -> None:
        """Adds instructions whose embeddings are known.

        Args:
            instructions: Instructions that are not in the table.
            embeddings: Embeddings of the instructions, (instructions, embedding).
            lengths: Lengths before scaling, (instructions,), if the embeddings are unit vectors.
        """
        if lengths is None:
            lengths = embeddings.norm(dim=1)
            is_unit = (lengths - 1).abs() < UNIT_TOLERANCE
            embeddings = torch.where(is_unit[:, None], embeddings, F.normalize(embeddings, dim=1))
        with _LOCK:
            n_known = len(self.embeddings)
            self.embeddings = torch.cat([self.embeddings, embeddings.to(self.embeddings)])
            self.lengths = torch.cat([self.lengths, lengths.to(self.lengths)])
            self.rows |= {text: n_known + i for i, text in enumerate(instructions)}

    def contents(self) -> TaskFile:
        """Contents for a task file, without demonstrations."""
        with _LOCK:
            lengths = None if self.only_unit else self.lengths.cpu()
            return TaskFile(self.encoder_name, list(self.rows), self.embeddings.cpu(), None, lengths)

    def read(self, path: Path) -> None:
        """Adds the embeddings of a file.

        Raises:
            TaskFileError: The file is missing, or its content is not valid.
            ValueError: Its embeddings are of another language encoder.
        """
        self.take(read_task_file(path), path)

    def take(self, contents: TaskFile, path: Path) -> None:
        """Adds the embeddings of a file that has been read.

        Raises:
            ValueError: The embeddings are of another language encoder.
        """
        if contents.language_encoder != self.encoder_name:
            raise ValueError(
                f"{path} was made with the language encoder {contents.language_encoder}. `language_encoder` "
                f"cannot be {self.encoder_name}."
            )
        lengths = contents.lengths
        if lengths is None:
            self.only_unit |= bool(contents.instructions)
            lengths = torch.ones(len(contents.instructions))
        new = [n for n, text in enumerate(contents.instructions) if text not in self.rows]
        self.put([contents.instructions[n] for n in new], contents.embeddings[new], lengths[new])

    def __call__(self, instructions: Sequence[str], device: torch.device | str, unit: bool = True) -> Tensor:
        """Embeddings of instructions.

        Args:
            instructions: Instructions, in any words.
            device: Device of the result.
            unit: Whether to return unit vectors, instead of embeddings as long as the encoder makes them.

        Returns:
            Embeddings, (instructions, embedding).
        """
        with _LOCK:
            self.add(instructions)
            if self.embeddings.device != torch.device(device):
                self.embeddings, self.lengths = self.embeddings.to(device), self.lengths.to(device)
            rows = [self.rows[text] for text in instructions]
            if unit or self.only_unit:
                return self.embeddings[rows]
            return self.embeddings[rows] * self.lengths[rows, None]
