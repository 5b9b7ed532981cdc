"""Features of demonstrations from a frozen image encoder: computed once, and kept.

A frozen encoder gives the same features for the same image, so that no training step has to run it. Where
the paper draws the crop and the frames between the ends anew for each sample, here a fixed number of such
variants of each demonstration is drawn beforehand, and each sample gets one of them.
"""

from __future__ import annotations

import hashlib
import logging
import os
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor
from tqdm import tqdm

from lerobot_deltaco.policy.demo_encoders import crop_demonstrations, frame_array
from lerobot_deltaco.policy.demonstrations import DemonstrationSet
from lerobot_deltaco.policy.vision import BATCH_SIZE, VisionEncoder

logger = logging.getLogger(__name__)


class Variants(NamedTuple):
    """How a demonstration becomes images."""

    n_frames: int  # in an image
    n_rows: int  # of the array that they are laid out in
    n_drawn: int  # random variants for training, 0 for none
    crop_padding: int  # px by which a variant is shifted at most
    crops_array: bool  # whether the array is shifted, or each frame
    spreads_frames: bool  # whether frames between the ends are of equal parts of the time
    seed: int

    @property
    def are_random(self) -> bool:
        """Whether variants of a demonstration differ."""
        return self.n_drawn > 0 and (self.crop_padding > 0 or self.n_frames > 2)


class FrozenFeatures:
    """A frozen encoder, and the features of the demonstrations that it has been asked for.

    It is no module, so that the encoder is neither trained nor saved. The encoder is loaded when it is first
    needed: never, where the features are already known.

    Args:
        load: Loads the encoder.
        variants: Rules by which a demonstration becomes images.
        folder: Folder that keeps the features for further trainings; None for none.
    """

    def __init__(
        self, load: Callable[[], VisionEncoder], variants: Variants, folder: Path | None = None
    ) -> None:
        self.variants = variants
        self._load = load
        self._folder = folder
        self._encoder: VisionEncoder | None = None

    @property
    def encoder(self) -> VisionEncoder:
        """The encoder."""
        if self._encoder is None:
            self._encoder = self._load()
        return self._encoder

    def drawn(self, demonstrations: DemonstrationSet, rows: Tensor, generator: torch.Generator) -> Tensor:
        """Features of random variants of demonstrations, for training.

        Args:
            demonstrations: The set.
            rows: Rows of the demonstrations in the set, (batch,).
            generator: Source of the draws, on the CPU.

        Returns:
            (batch, features) float32.
        """
        if not self.variants.are_random:
            return self.plain(demonstrations, rows)
        n_known = 1 + self.variants.n_drawn
        if demonstrations.features is None or demonstrations.features.shape[1] != n_known:
            demonstrations.features = self._computed(demonstrations, self.variants.n_drawn)
        which = torch.randint(1, n_known, (len(rows),), generator=generator).to(rows.device)
        return demonstrations.features[rows, which].float()

    def plain(self, demonstrations: DemonstrationSet, rows: Tensor | None = None) -> Tensor:
        """Features of demonstrations without a crop, with the same frames between the ends every time.

        Args:
            demonstrations: The set.
            rows: Rows of the demonstrations in the set, (batch,); None for all.

        Returns:
            (batch, features) float32.
        """
        if demonstrations.features is None:
            demonstrations.features = self._computed(demonstrations, 0)
        plain = demonstrations.features[:, 0]
        return (plain if rows is None else plain[rows]).float()

    def _computed(self, demonstrations: DemonstrationSet, n_drawn: int) -> Tensor:
        """Features, (episodes, 1 + n_drawn, features) float16: without a crop, and of variants."""
        device = demonstrations.frames.device
        path = self._path(demonstrations, n_drawn)
        if path is not None and path.exists():
            logger.info("The features of the demonstrations are read from %s.", path)
            return load_file(path)["features"].to(device)
        # Under the autocast of a training in bfloat16, features in float16 cannot be joined.
        with torch.autocast(device.type, enabled=False):
            features = self._encoded(demonstrations, n_drawn)
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            # Several trainings may compute the same features at the same time.
            temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
            try:
                save_file({"features": features.cpu()}, temporary)
                os.replace(temporary, path)
            finally:
                temporary.unlink(missing_ok=True)
        return features

    def _encoded(self, demonstrations: DemonstrationSet, n_drawn: int) -> Tensor:
        """What `_computed` returns, by the encoder."""
        device = demonstrations.frames.device
        generator = torch.Generator().manual_seed(self.variants.seed)
        n_episodes = len(demonstrations.tasks)
        columns = []
        with tqdm(
            total=n_episodes * (1 + n_drawn), desc="Encoding demonstrations", unit="image", leave=False
        ) as bar:
            for variant in range(1 + n_drawn):
                parts = []
                for rows in torch.arange(n_episodes, device=device).split(BATCH_SIZE):
                    frames = demonstrations.sample_frames(
                        rows, self.variants.n_frames, generator, self.variants.spreads_frames
                    )
                    if variant > 0:
                        array_rows = self.variants.n_rows if self.variants.crops_array else None
                        frames = crop_demonstrations(
                            frames, self.variants.crop_padding, array_rows, generator
                        )
                    parts.append(self.encoder(frame_array(frames, self.variants.n_rows)).half())
                    bar.update(len(rows))
                columns.append(torch.cat(parts))
        return torch.stack(columns, dim=1)

    def _path(self, demonstrations: DemonstrationSet, n_drawn: int) -> Path | None:
        """File that keeps the features of a set; its name is a hash of all that they depend on."""
        if self._folder is None:
            return None
        digest = hashlib.sha256(self.encoder.fingerprint().encode())
        digest.update(repr(self.variants._replace(n_drawn=n_drawn)).encode())
        digest.update(demonstrations.frames.cpu().contiguous().view(-1).numpy())
        return self._folder / f"{digest.hexdigest()[:32]}.safetensors"
