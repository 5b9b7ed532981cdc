"""The templates of cards: where they are, and how they are filled in."""

from pathlib import Path
from typing import Any

import jinja2

TEMPLATES = "datasets_cards"


def template_folder() -> Path:
    """In the wheel, the templates are a folder of the package; in a clone, it lies beside the package."""
    package = Path(__file__).parents[1]
    inside = package / TEMPLATES
    return inside if inside.is_dir() else package.parent / TEMPLATES


def render(template: str, **values: Any) -> str:
    """A template of that folder, filled in. It must use no value that is not given."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(template_folder(), encoding="utf-8"),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    return environment.get_template(template).render(**values)


def env_options(image: dict[str, Any]) -> str:
    """Options of `--env.type=deltaco` which make it show what a dataset of the benchmark shows.

    Args:
        image: The dataset's feature "observation.image", as in LeRobot's info.json.
    """
    options = []
    if image["shape"][0] != 48:
        options.append(f" --env.image_size={image['shape'][0]}")
    if image["info"]["ambiguity"] != "container":
        options.append(f" --env.ambiguity={image['info']['ambiguity']}")
    return "".join(options)
