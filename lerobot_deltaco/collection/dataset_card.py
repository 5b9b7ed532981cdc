"""The card of a benchmark dataset for the Hugging Face Hub, from the template beside this file."""

from __future__ import annotations

import io
import shlex
import textwrap
from pathlib import Path

import jinja2
import numpy as np
import pyarrow.parquet as pq
from PIL import Image

from gym_deltaco.tasks import SCENARIOS, get_task
from lerobot_deltaco.atomic_files import read_json, write_text
from lerobot_deltaco.collection.collect import read_description, read_plan
from lerobot_deltaco.collection.writer import INFO_FILE

TASKS_IMAGE = "assets/tasks.png"


def dataset_card(root: Path, repo_id: str | None = None) -> str:
    """Returns the card of a finished dataset: YAML metadata, then Markdown.

    Args:
        root: Folder of the dataset.
        repo_id: Name of the dataset on the Hub; None if it is only in a folder.
    """
    files = [path for name in ("data", "meta") for path in (root / name).rglob("*") if path.is_file()]
    template = jinja2.Template(
        Path(__file__).with_suffix(".md").read_text(encoding="utf-8"),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    return template.render(
        quote=lambda value: shlex.quote(str(value)),
        info=read_json(root / INFO_FILE),
        origin=read_description(root),
        tasks=[get_task(task_id) for task_id in read_plan(root).task_ids],
        scenarios=list(SCENARIOS.values()),
        repo_id=repo_id,
        tasks_image=TASKS_IMAGE,
        megabytes=sum(path.stat().st_size for path in files) / 1e6,
    )


def write_dataset_card(root: Path, repo_id: str) -> None:
    """Writes the card of a finished dataset, and a picture of up to twelve of its tasks, into its folder."""
    from matplotlib.figure import Figure

    plan = read_plan(root)
    camera = plan.scene.interface.camera_keys[0]
    shown = np.unique(np.linspace(0, len(plan.task_ids) - 1, 12).round().astype(int))
    episodes = pq.read_table(
        root / "data",
        columns=[camera, "benchmark.task_id"],
        filters=[("frame_index", "==", 0), ("episode_index", "in", shown * plan.episodes_per_task)],
    ).to_pylist()
    figure = Figure(figsize=(10, 9), layout="constrained")
    for axes, episode in zip(figure.subplots(3, 4).flat, episodes, strict=False):
        axes.imshow(Image.open(io.BytesIO(episode[camera]["bytes"])))
        axes.set_title(textwrap.fill(get_task(episode["benchmark.task_id"]).instruction, 30), fontsize=8)
    for axes in figure.axes:
        axes.axis("off")
    (root / TASKS_IMAGE).parent.mkdir(exist_ok=True)
    figure.savefig(root / TASKS_IMAGE, dpi=120)
    write_text(root / "README.md", dataset_card(root, repo_id))
