"""Pages of the API reference: one for each package. The site's build makes them anew."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).parents[1]
FOLDER = "api/generated"
PACKAGES = {
    "gym_deltaco": ROOT / "envs" / "gym_deltaco",
    "lerobot_deltaco": ROOT / "lerobot_deltaco",
}
# The command line and the demo are described by their own pages and `--help`.
WITHOUT_API = ("lerobot_deltaco.commands", "lerobot_deltaco.demo")


def write(docs: Path) -> list[Path]:
    """Writes the pages into the documentation's folder, and removes those of an earlier build.

    Args:
        docs: The folder of the documentation.

    Returns:
        The files.
    """
    folder = docs / FOLDER
    texts = {folder / f"{name}.md": text for name, text in api_pages().items()}
    folder.mkdir(parents=True, exist_ok=True)
    for path in folder.glob("*.md"):
        if path not in texts:
            path.unlink()
    for path, text in texts.items():
        # An unchanged file keeps its date, so that Sphinx does not read it again.
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
    return list(texts)


def api_pages() -> dict[str, str]:
    """A page for each package, with all of its public modules."""
    pages: dict[str, str] = {}
    for package, folder in PACKAGES.items():
        for init in sorted(folder.rglob("__init__.py")):
            name = ".".join([package, *init.parent.relative_to(folder).parts])
            if name.startswith(WITHOUT_API):
                continue
            files = [init, *sorted(path for path in init.parent.glob("*.py") if path.name[0] != "_")]
            modules = [name if path == init else f"{name}.{path.stem}" for path in files]
            pages[name] = _api_page(name, modules)
    return pages


def _api_page(package: str, modules: Sequence[str]) -> str:
    parts = [f"# `{package}`"]
    for module in modules:
        if module != package:
            parts.append(f"## `{module.removeprefix(package + '.')}`")
        parts.append(f"```{{eval-rst}}\n.. automodule:: {module}\n```")
    return "\n\n".join(parts) + "\n"
