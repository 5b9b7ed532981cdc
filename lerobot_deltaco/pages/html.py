"""Self-contained HTML from the templates in this folder, with pictures and videos as data URIs."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lerobot_deltaco.atomic_files import write_text

TEMPLATES = Path(__file__).with_name("templates")


class EpisodeView(NamedTuple):
    """An episode, as pages show it.

    Attributes:
        instruction: Instruction that the policy received; empty for none.
        demonstration: The demonstration in words; empty for none.
        ends: First and last image of the demonstration, as data URIs.
        is_right: Whether the policy did what was asked; None if that is unknown.
        headline: The same in a few words.
        lines: What happened, and what the policy understood, as sentences.
        picture: Where the policy looked, as a data URI; None for policies that find no locations.
        video: The episode, as a data URI; None if it was not run.
        crops: What the policy compared, as data URIs: the demonstrated object, and what it chose.
    """

    instruction: str
    demonstration: str
    ends: Sequence[str]
    is_right: bool | None
    headline: str
    lines: Sequence[str]
    picture: str | None
    video: str | None
    crops: Sequence[str] = ()


def write_page(out: Path, template: str, **values: Any) -> Path:
    """Fills in a template, writes it to `out/index.html`, and returns that path."""
    write_text(out / "index.html", render(template, **values))
    return out / "index.html"


def render(template: str, **values: Any) -> str:
    """Returns a template with values filled in."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES),
        undefined=jinja2.StrictUndefined,
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(**values)


def picture_uri(picture: Image.Image | NDArray[np.uint8]) -> str:
    """Returns a picture, or an image (H, W, 3), as a data URI."""
    buffer = io.BytesIO()
    image = picture if isinstance(picture, Image.Image) else Image.fromarray(picture)
    image.save(buffer, "JPEG", quality=90)
    return data_uri("image/jpeg", buffer.getvalue())


def data_uri(kind: str, content: bytes) -> str:
    """Returns a file of a media type, such as "video/mp4", as a data URI."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"
