"""The templates of cards: where they are, and how they are filled in."""

import re
import shlex
from pathlib import Path
from typing import Any

import jinja2

from lerobot_deltaco.common.shipped import shipped_folder

TEMPLATES = "datasets_cards"
# Settings of the environment that a dataset records; those of the objects only if they are not the paper's.
SCENE_SETTINGS = ("ambiguity", "objects", "adversarial_probability", "adversarial_draw")


def template_folder() -> Path:
    """Folder of the templates."""
    return shipped_folder(TEMPLATES, TEMPLATES)


def render(template: str, **values: Any) -> str:
    """A template of that folder, filled in. It must use no value that is not given.

    Templates have the filters `text` and `code` for strings from outside, such as the tasks of a dataset.
    """
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(template_folder(), encoding="utf-8"),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {"text": markdown_text, "code": markdown_code}
    return environment.get_template(template).render(**values)


def markdown_text(text: str) -> str:
    """A string as Markdown that shows it as it is, in one line: without markup, HTML or the end of a cell."""
    line = " ".join(str(text).split())
    line = line.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    line = re.sub(r"([\\`*_\[\]|~])", r"\\\1", line)
    # At the start, these would begin a list or a heading.
    return re.sub(r"^(\d*)([-+#=.)])", r"\1\\\2", line)


def markdown_code(text: str) -> str:
    """A string as Markdown's code in a line, between as many backticks as it takes."""
    line = " ".join(str(text).split()).replace("|", "\\|") or " "
    longest = max(map(len, re.findall(r"`+", line)), default=0)
    fence, space = "`" * (longest + 1), " " if longest else ""
    return f"{fence}{space}{line}{space}{fence}"


def scene_settings(info: dict[str, Any]) -> dict[str, Any]:
    """Arguments of the environment that a dataset's scenes were drawn with.

    Args:
        info: Info of the dataset's feature "observation.image", as in LeRobot's info.json.
    """
    return {name: info[name] for name in SCENE_SETTINGS if name in info}


def env_options(image: dict[str, Any]) -> str:
    """Options of `--env.type=deltaco` which make it show what a dataset of the benchmark shows.

    Args:
        image: The dataset's feature "observation.image", as in LeRobot's info.json.
    """
    options = []
    if image["shape"][0] != 48:
        options.append(f" --env.image_size={image['shape'][0]}")
    defaults = {"ambiguity": "container"}
    for name, value in scene_settings(image["info"]).items():
        if value != defaults.get(name):
            options.append(f" --env.{name}={shlex.quote(str(value))}")
    return "".join(options)
