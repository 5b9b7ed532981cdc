"""The card of a benchmark dataset, with an image of some tasks."""

from __future__ import annotations

import io
import textwrap
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from PIL import Image

from gym_deltaco.atomic_files import atomic_write, read_json, write_text
from gym_deltaco.tasks import SCENARIOS, get_task
from lerobot_deltaco.cards import render
from lerobot_deltaco.collect import read_description, read_plan
from lerobot_deltaco.dataset_writer import INFO_FILE

CARD_FILE = "README.md"
TASKS_IMAGE = "assets/tasks.png"
MAX_TASKS_SHOWN = 12


def dataset_card(root: Path, repo_id: str | None = None) -> str:
    """Returns the card of a finished dataset: YAML metadata, then Markdown.

    Args:
        root: Folder of the dataset.
        repo_id: Name of the dataset on the Hub; None if it is only in a folder.
    """
    plan = read_plan(root)
    files = [path for name in ("data", "meta") for path in (root / name).rglob("*") if path.is_file()]
    return render(
        "benchmark_dataset.md",
        info=read_json(root / INFO_FILE),
        origin=read_description(root),
        tasks=[get_task(task_id) for task_id in plan.task_ids],
        scenarios=list(SCENARIOS.values()),
        repo_id=repo_id,
        tasks_image=TASKS_IMAGE,
        megabytes=sum(path.stat().st_size for path in files) / 1e6,
    )


def write_dataset_card(root: Path, repo_id: str | None = None) -> None:
    """Writes the card of a finished dataset and its image into the dataset's folder."""
    _save_tasks_image(root)
    write_text(root / CARD_FILE, dataset_card(root, repo_id))


def _save_tasks_image(root: Path) -> None:
    """Draws the first image of an episode for each of several tasks, with the instructions."""
    from matplotlib.figure import Figure

    plan = read_plan(root)
    camera = plan.scene.interface.camera_keys[0]
    shown = np.unique(np.linspace(0, len(plan.task_ids) - 1, MAX_TASKS_SHOWN).round().astype(int))
    episodes = pq.read_table(
        root / "data",
        columns=[camera, "benchmark.task_id"],
        filters=[("frame_index", "==", 0), ("episode_index", "in", shown * plan.episodes_per_task)],
    ).to_pylist()
    n_columns = min(4, len(episodes))
    n_rows = -(-len(episodes) // n_columns)
    figure = Figure(figsize=(2.5 * n_columns, 3 * n_rows), layout="constrained")
    grid = figure.subplots(n_rows, n_columns, squeeze=False)
    for axes in grid.flat:
        axes.axis("off")
    for axes, episode in zip(grid.flat, episodes, strict=False):
        axes.imshow(Image.open(io.BytesIO(episode[camera]["bytes"])))
        instruction = get_task(episode["benchmark.task_id"]).instruction
        axes.set_title(textwrap.fill(instruction, 30), fontsize=8)
    with atomic_write(root / TASKS_IMAGE) as temporary:
        figure.savefig(temporary, format="png", dpi=120)
