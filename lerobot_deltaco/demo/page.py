"""The page that the demo leaves, for someone who has read nothing else, and its figures as JSON."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Any, NamedTuple

import av
import jinja2
import numpy as np
from lerobot.datasets import LeRobotDataset

from gym_deltaco.atomic_files import write_json, write_text
from gym_deltaco.sheets import across, enlarged, framed, grid, save_gif, save_png, to_image
from gym_deltaco.tasks import get_task
from lerobot_deltaco.common.run_folder import checkpoints
from lerobot_deltaco.demo import recipe
from lerobot_deltaco.demo.steps import DEMONSTRATIONS, Demo
from lerobot_deltaco.evaluation.record import Counterfactual, read_record, record_path
from lerobot_deltaco.reporting.statistics import followed

# Examples of each kind, and images of an episode.
N_EXAMPLES = 4
N_IMAGES = 7
IMAGE_SIZE = 96  # px
VIDEO_SIZE = 128  # px
FRAME_DURATION = 120  # ms
GREEN, RED = (20, 117, 44), (164, 22, 26)

STEP_NAMES = {
    "collect": "collecting the episodes to train on",
    "demonstrate": "collecting the demonstrations",
    "measure": "measuring this machine's speed",
    "train": "training",
    "evaluate": "evaluation in new scenes, on new combinations, and with another task's inputs",
}


class TaskResult(NamedTuple):
    """The evaluation of a task."""

    task_id: int
    is_new: bool
    successes: list[bool]
    videos: list[Path]


class Rate(NamedTuple):
    """Of the evaluation of several tasks."""

    rate: float
    episodes: int


def write_page(demo: Demo) -> Path:
    """Writes the page, its images and `summary.json` into the demo's folder.

    Args:
        demo: All of its steps are done.

    Returns:
        The page.
    """
    trained, new = (_results(demo, name) for name in ("trained", "new"))
    seconds = demo.seconds()
    steps = [
        {"name": text, "minutes": seconds[name] / 60} for name, text in STEP_NAMES.items() if name in seconds
    ]
    summary = {
        "success_rate": _rate(trained).rate,
        "success_rate_new_combinations": _rate(new).rate,
        "chance": recipe.CHANCE,
        "episodes": _rate(trained).episodes + _rate(new).episodes,
        "minutes": sum(seconds[name] / 60 for name in STEP_NAMES if name in seconds),
    }
    settings = demo.settings
    values = {
        "n_episodes": len(settings["tasks"]) * settings["episodes_per_task"],
        "n_steps": settings["steps"],
        "n_trained": len(trained),
        "n_new": len(new),
        "trained": _rate(trained),
        "new": _rate(new),
        "chance": recipe.CHANCE,
        "examples": _draw_examples(demo, [*trained[:N_EXAMPLES], *new[:N_EXAMPLES]]),
        "columns": list(recipe.CONTAINERS),
        "rows": _rows([*trained, *new]),
        "followed": _followed(demo),
        "steps": steps,
        "minutes": summary["minutes"],
        "policy": settings["policy"],
        "checkpoint": demo.checkpoint.resolve().relative_to(demo.folder.resolve()),
        "command": _command(demo),
    }
    template = Path(__file__).with_name("page.html").read_text(encoding="utf-8")
    environment = jinja2.Environment(undefined=jinja2.StrictUndefined, autoescape=True, trim_blocks=True)
    page = demo.folder / "index.html"
    write_text(page, environment.from_string(template).render(**values))
    write_json(demo.folder / "summary.json", summary, indent=2)
    return page


def _results(demo: Demo, name: str) -> list[TaskResult]:
    info = json.loads((demo.folder / "evaluation" / name / "eval_info.json").read_text())
    found = [
        TaskResult(
            task["task_id"],
            name == "new",
            task["metrics"]["successes"],
            [Path(path) for path in task["metrics"]["video_paths"]],
        )
        for task in info["per_task"]
    ]
    return sorted(found)


def _rate(results: list[TaskResult]) -> Rate:
    successes = [success for result in results for success in result.successes]
    return Rate(sum(successes) / len(successes), len(successes))


def _rows(results: list[TaskResult]) -> list[dict[str, Any]]:
    """A row for each color, with a cell for each container's word."""
    cells = {result.task_id: result for result in results}
    rows = sorted({get_task(result.task_id).row for result in results})
    return [
        {
            "name": get_task(row).object_phrase,
            "cells": [
                {
                    "is_new": cells[50 * column + row].is_new,
                    "successes": sum(cells[50 * column + row].successes),
                    "episodes": len(cells[50 * column + row].successes),
                }
                for column in recipe.CONTAINERS.values()
                if 50 * column + row in cells
            ],
        }
        for row in rows
    ]


def _followed(demo: Demo) -> list[dict[str, Any]]:
    step = checkpoints(demo.run)[-1].step
    kinds: tuple[Counterfactual, ...] = ("demo", "instruction")
    lines = []
    for changed in kinds:
        episodes = read_record(record_path(demo.run, step, changed)).episodes
        conflicts = [row for row in followed(episodes, changed) if row.among == "conflicts"]
        for aspect in ("object", "container"):
            counts = {row.cue: row.proportion for row in conflicts if row.aspect == aspect}
            lines.append(
                {
                    "changed": {"demo": "demonstration"}.get(changed, changed),
                    "aspect": aspect,
                    **{cue: proportion.count for cue, proportion in counts.items()},
                    "episodes": counts["neither"].total,
                }
            )
    return lines


def _draw_examples(demo: Demo, results: list[TaskResult]) -> list[dict[str, Any]]:
    """Draws a strip for each example, and all of them as one animation."""
    demonstrations = LeRobotDataset(DEMONSTRATIONS, root=demo.folder / "demonstrations")
    examples, videos = [], []
    for number, result in enumerate(results):
        instruction = get_task(result.task_id).instruction
        frames = read_video(result.videos[0])
        success = result.successes[0]
        color = GREEN if success else RED
        chosen = np.linspace(0, len(frames) - 1, N_IMAGES).round().astype(int)
        strip = across(
            [
                framed(
                    across([enlarged(pixels, 2) for pixels in _demonstration(demonstrations, instruction)])
                ),
                framed(across([to_image(frames[n], IMAGE_SIZE) for n in chosen]), color),
            ],
            gap=24,
            align="middle",
        )
        name = f"example_{number + 1}.png"
        save_png(strip, demo.folder / name)
        videos.append([framed(to_image(frame, VIDEO_SIZE), color) for frame in frames])
        examples.append(
            {
                "strip": name,
                "instruction": instruction,
                "is_new": result.is_new,
                "success": success,
                "video": result.videos[0].resolve().relative_to(demo.folder.resolve()).as_posix(),
            }
        )
    n_frames = min(map(len, videos))
    animation = [grid([video[n] for video in videos], N_EXAMPLES, gap=8) for n in range(n_frames)]
    durations = [*[FRAME_DURATION] * (n_frames - 1), 10 * FRAME_DURATION]
    save_gif(animation, durations, demo.folder / "videos.gif")
    return examples


def read_video(path: Path) -> list[np.ndarray]:
    """Frames of a video, (height, width, 3) uint8 each."""
    container = av.open(str(path))
    try:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    finally:
        container.close()


def _demonstration(demonstrations: LeRobotDataset, instruction: str) -> list[np.ndarray]:
    """The first and the last image of the demonstration of a task."""
    episode = next(row for row in demonstrations.meta.episodes if row["tasks"] == [instruction])
    ends = episode["dataset_from_index"], episode["dataset_to_index"] - 1
    images = [demonstrations[index]["observation.image"] for index in ends]
    return [(image.permute(1, 2, 0).numpy() * 255).round().astype(np.uint8) for image in images]


def _command(demo: Demo) -> str:
    options = [
        f"--policy.path={demo.checkpoint}",
        "--env.type=deltaco",
        f"--env.task={recipe.selection(recipe.NEW_COMBINATIONS)}",
        "--eval.n_episodes=10",
        "--eval.batch_size=10",
        "--eval.use_async_envs=false",
    ]
    return shlex.join(["lerobot-eval", *options])
