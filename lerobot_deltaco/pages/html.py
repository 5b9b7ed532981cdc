"""HTML from the templates beside this file, with its pictures and videos inside."""

from __future__ import annotations

import base64
import io
from pathlib import Path
from typing import Any

import jinja2
from PIL import Image


def render(template: str, **values: Any) -> str:
    """Returns a template with values filled in."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).with_name("templates")),
        undefined=jinja2.StrictUndefined,
        autoescape=True,
        trim_blocks=True,
    )
    return environment.get_template(template).render(**values)


def picture_uri(picture: Image.Image) -> str:
    """Returns a picture as a data URI."""
    buffer = io.BytesIO()
    picture.save(buffer, "JPEG", quality=90)
    return data_uri("image/jpeg", buffer.getvalue())


def data_uri(kind: str, content: bytes) -> str:
    """Returns a file of a media type, such as "video/mp4", as a data URI."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"
