"""Images of the benchmark's objects, scenes and expert, and a page that shows them."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
from tqdm import tqdm

from gym_deltaco.atomic_files import write_text
from gym_deltaco.gallery.ambiguity import draw_ambiguity
from gym_deltaco.gallery.episodes import draw_episodes
from gym_deltaco.gallery.objects import draw_objects, draw_objects_by_name, draw_random_objects, object_cell
from gym_deltaco.gallery.scenes import POLICY_SIZE, Figure, draw_scenes
from gym_deltaco.objects import object_model
from gym_deltaco.simulation import Simulation
from gym_deltaco.tasks import COLORS, OBJECTS, SHAPES, ObjectLabel

N_EPISODES = 3


def draw_gallery(
    out: Path, seed: int, task_ids: Sequence[int], max_scenes: int, random_objects: Sequence[ObjectLabel] = ()
) -> None:
    """Draws all images, and the page `index.md`, which links to them, last.

    Args:
        out: Folder to write to.
        seed: Seed of the scenes.
        task_ids: Indices of the tasks to show: a scene of each, and an episode of the expert of some.
        max_scenes: Greatest number of tasks to show; a random choice of that size if there are more.
        random_objects: Random objects to draw as well.

    Raises:
        OSError: The folder cannot be made or written to.
    """
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=out):
        pass  # so that a folder that cannot be written to is an error before anything is drawn
    shown = _drawn(task_ids, max_scenes, seed)
    recorded = shown[:: max(1, len(shown) // N_EPISODES)][:N_EPISODES]
    n_updates = len(OBJECTS) + len(random_objects) + len(shown) + len(recorded) + 2
    progress = tqdm(total=n_updates, desc="gallery", unit="image")
    with progress, closing(Simulation()) as simulation:
        cells = []
        for index in range(len(OBJECTS)):
            cells.append(object_cell(simulation, object_model(index)))
            progress.update()
        figures = [
            draw_objects_by_name(out, cells),
            draw_objects(out, "shape", SHAPES, cells),
            draw_objects(out, "color", COLORS, cells),
            draw_scenes(out, seed, shown, progress.update),
            *draw_episodes(out, seed, recorded, progress.update),
            draw_ambiguity(out, seed, progress.update),
        ]
        if random_objects:
            figures.append(draw_random_objects(out, random_objects, simulation, progress.update))
    write_text(out / "index.md", page(figures))


def page(figures: Iterable[Figure]) -> str:
    """The Markdown page."""
    sections = [f"## {title}\n\n{text}\n\n![{title}]({file})" for file, title, text in figures]
    introduction = (
        "A WidowX 250 stands at a shallow tray with three objects and two bins, one green and one red. An "
        "instruction says which object to put into which bin; front is near the camera, back is near the "
        f"robot, and left and right are as in the image. A policy sees {POLICY_SIZE} x {POLICY_SIZE} pixels. "
        "`deltaco-gallery` draws all images, from code alone."
    )
    return "\n\n".join(["# The benchmark in images", introduction, *sections]) + "\n"


def _drawn(task_ids: Sequence[int], n_tasks: int, seed: int) -> list[int]:
    """At most so many of the tasks, in their order."""
    n_tasks = min(n_tasks, len(task_ids))
    positions = np.random.default_rng(seed).choice(len(task_ids), n_tasks, replace=False)
    return [task_ids[position] for position in sorted(positions)]
