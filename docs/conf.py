"""Sphinx configuration of the documentation site: `make docs` builds it in docs/_build/html."""

from __future__ import annotations

import sys
import tomllib
from importlib.util import find_spec
from pathlib import Path

DOCS = Path(__file__).parent
ROOT = DOCS.parent
sys.path[:0] = [str(DOCS), str(ROOT), str(ROOT / "envs")]

import api_pages  # noqa: E402
import docstrings  # noqa: E402

project = "DeL-TaCo for LeRobot"
author = "The contributors of lerobot_policy_deltaco"
release = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
html_show_copyright = False
html_title = f"{project} {release}"

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
]
exclude_patterns = ["_build", "generated"]  # of which the second is an earlier version's
myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 3
# Names that several modules have are not linked.
suppress_warnings = ["ref.python"]

html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_theme_options = {"navigation_with_keys": True}
copybutton_exclude = ".linenos, .gp"

# The site also builds without the simulator.
autodoc_mock_imports = [name for name in ("pybullet",) if find_spec(name) is None]
autodoc_default_options = {"members": True, "show-inheritance": True, "member-order": "bysource"}
autodoc_typehints_format = "short"
napoleon_numpy_docstring = False
napoleon_use_ivar = True


def setup(app):
    """Writes the API reference before Sphinx looks for sources, and lets autodoc read Markdown docstrings."""
    api_pages.write(DOCS)
    app.connect("autodoc-process-docstring", docstrings.to_restructured_text, priority=100)
    app.connect("autodoc-skip-member", docstrings.skip_named_tuple_fields)
