"""Where the templates of cards are."""

from pathlib import Path

TEMPLATES = "datasets_cards"


def template_folder() -> Path:
    """In the wheel, the templates are a folder of the package; in a clone, it lies beside the package."""
    package = Path(__file__).parent
    inside = package / TEMPLATES
    return inside if inside.is_dir() else package.parent / TEMPLATES
