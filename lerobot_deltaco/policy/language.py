"""Loads frozen sentence encoders, and keeps the embeddings of instructions.

A new kind of encoder (CLIP's, for example) needs an entry of `LANGUAGE_ENCODERS` and, if
sentence-transformers does not support it, a branch of `load_language_encoder`.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor

from lerobot_deltaco.policy.language_encoders import LANGUAGE_ENCODERS, MINILM_L3, MINILM_L6
from lerobot_deltaco.policy.packaged_encoders import LanguageEncoderError, packaged_l3, packaged_l6
from lerobot_deltaco.policy.task_file import TaskFile, read_task_file

BATCH_SIZE = 64

# From sentences to unit embeddings, (sentences, embedding), on the CPU.
LanguageEncoder = Callable[[Sequence[str]], Tensor]


def load_language_encoder(name: str) -> LanguageEncoder:
    """Loads a frozen encoder: the mean of the token embeddings, scaled to unit length.

    Args:
        name: One of `LANGUAGE_ENCODERS`.

    Raises:
        LanguageEncoderError: A package is missing, or the model can be neither found nor downloaded.
    """
    encode_packaged = packaged_l3(BATCH_SIZE) if name == MINILM_L3 else None
    if encode_packaged is not None:
        return lambda sentences: F.normalize(encode_packaged(sentences), dim=-1).clone()
    try:
        from sentence_transformers import SentenceTransformer
    except ImportError as error:
        raise LanguageEncoderError(
            "Instructions need the package sentence-transformers. Install this project again, as its README "
            "says."
        ) from error
    source = (packaged_l6() if name == MINILM_L6 else None) or LANGUAGE_ENCODERS[name].repo_id
    try:
        # A model without a pooling layer of its own, such as DistilBERT, gets mean pooling.
        model = SentenceTransformer(str(source), device="cpu")
    except OSError as error:
        raise LanguageEncoderError(
            f"The language encoder {name} cannot be loaded: {str(error).splitlines()[0]} Without a network, "
            f"install this project's extra `offline`, which brings {MINILM_L3} and {MINILM_L6}, and set "
            "`language_encoder` to one of them."
        ) from error
    model.eval().requires_grad_(False)

    def encode(sentences: Sequence[str]) -> Tensor:
        with torch.inference_mode():
            embeddings = model.encode(
                list(sentences), batch_size=BATCH_SIZE, convert_to_tensor=True, show_progress_bar=False
            )
        return F.normalize(embeddings.float(), dim=-1).clone()

    return encode


# With `--env.max_parallel_tasks` above 1, threads share a policy. A table with a lock could not be copied.
_LOCK = threading.RLock()


class InstructionTable:
    """Embeddings of instructions, each computed once. Several threads may ask at the same time.

    Args:
        encoder_name: One of `LANGUAGE_ENCODERS`.
    """

    def __init__(self, encoder_name: str) -> None:
        self.encoder_name = encoder_name
        self.rows: dict[str, int] = {}
        self.embeddings = torch.empty(0, LANGUAGE_ENCODERS[encoder_name].embedding_dim)
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

    def put(self, instructions: Sequence[str], embeddings: Tensor) -> None:
        """Adds instructions whose embeddings, (instructions, embedding), are known."""
        with _LOCK:
            n_known = len(self.embeddings)
            self.embeddings = torch.cat([self.embeddings, embeddings.to(self.embeddings)])
            self.rows |= {text: n_known + i for i, text in enumerate(instructions)}

    def contents(self) -> TaskFile:
        """What is known, as the contents of a file, without demonstrations."""
        with _LOCK:
            return TaskFile(self.encoder_name, list(self.rows), self.embeddings.cpu(), None)

    def read(self, path: Path) -> None:
        """Adds the embeddings of a file.

        Raises:
            TaskFileError: The file is missing, or has something in it that cannot be.
            ValueError: It is of another language encoder.
        """
        self.take(read_task_file(path), path)

    def take(self, contents: TaskFile, path: Path) -> None:
        """Adds the embeddings of a file that has been read.

        Raises:
            ValueError: They are of another language encoder.
        """
        if contents.language_encoder != self.encoder_name:
            raise ValueError(
                f"{path} was made with the language encoder {contents.language_encoder}. `language_encoder` "
                f"cannot be {self.encoder_name}."
            )
        new = [n for n, text in enumerate(contents.instructions) if text not in self.rows]
        self.put([contents.instructions[n] for n in new], contents.embeddings[new])

    def __call__(self, instructions: Sequence[str], device: torch.device | str) -> Tensor:
        """Embeddings of instructions, (instructions, embedding)."""
        with _LOCK:
            self.add(instructions)
            if self.embeddings.device != torch.device(device):
                self.embeddings = self.embeddings.to(device)
            return self.embeddings[[self.rows[text] for text in instructions]]
