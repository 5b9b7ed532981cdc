"""Words by which instructions describe the two containers: their colors and positions."""

from __future__ import annotations

from typing import Literal

ContainerColor = Literal["green", "red"]
ContainerWord = Literal["green", "red", "front", "back", "left", "right"]

CONTAINER_COLORS: tuple[ContainerColor, ...] = ("green", "red")
CONTAINER_WORDS: tuple[ContainerWord, ...] = ("green", "red", "front", "back", "left", "right")
