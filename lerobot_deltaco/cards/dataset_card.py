"""A dataset's card: README.md and its images, made from the dataset itself."""

from __future__ import annotations

import io
import shlex
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, fields
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
from huggingface_hub import DatasetCardData
from numpy.typing import NDArray
from PIL import Image

from gym_deltaco import EPISODE_STEPS
from gym_deltaco.atomic_files import write_text
from gym_deltaco.env import ACTION_SCALE, PickPlaceEnv
from gym_deltaco.sheets import (
    caption,
    down,
    enlarged,
    framed,
    grid,
    save_gif,
    save_png,
    to_image,
)
from gym_deltaco.tasks import SCENARIOS, Task, get_task
from lerobot_deltaco.cards.templates import env_options, render, scene_settings
from lerobot_deltaco.data import dataset_files as files
from lerobot_deltaco.data.collection_plan import CollectionPlan
from lerobot_deltaco.data.finished_dataset import HISTORY_FILE, read_history, read_info, tries_by_kind
from lerobot_deltaco.data.integrity import damaged

CARD_FILE = Path("README.md")
TASKS_IMAGE = Path("assets/tasks.png")
EPISODE_IMAGE = Path("assets/episode.gif")
CARD_FILES = (CARD_FILE, TASKS_IMAGE, EPISODE_IMAGE)
TAGS = (
    "LeRobot",
    *("deltaco", "gym_deltaco", "imitation-learning", "demonstrations", "language-conditioned"),
    *("manipulation", "simulation", "pybullet", "widowx"),
)
MAX_TASKS_SHOWN = 12

# What each feature is, and its unit. Names, types and shapes come from the dataset.
DESCRIPTIONS = {
    "observation.image": ("image of the front camera, before the action", "RGB, PNG of 8 bits"),
    "observation.state": (
        "angles of the arm's 6 joints, position of the end effector in the world, state of the gripper",
        "rad; m; 1 open, 0 closed",
    ),
    "action": (
        "change of the end effector's position, and the absolute command to the gripper",
        f"-1..1, times {ACTION_SCALE} m; above 0 open, else closed",
    ),
    "next.reward": ("1 once the task has succeeded, after the action", "0 or 1"),
    "next.done": ("whether the episode ends with this action", ""),
    "next.success": ("whether the task has succeeded in this episode, after the action", ""),
    "benchmark.task_id": ("index of the task", "0..299; 1000..1479 by color and shape"),
    "benchmark.target_object": ("index of the object to be picked", "0..31; from 32 on, random objects"),
    "benchmark.target_container": ("which container it is to be placed in", "0 green, 1 red"),
    "benchmark.seed": ("of the environment's `reset`, which draws the same scene again", ""),
    "timestamp": ("time in the episode, at the nominal frame rate", "s"),
    "frame_index": ("number of the frame in its episode", "from 0"),
    "episode_index": ("number of the episode in the dataset", "from 0"),
    "index": ("number of the frame in the dataset", "from 0"),
    "task_index": ("row of the instruction in `meta/tasks.parquet`; LeRobot gives it as `task`", "from 0"),
}

_TEMPLATE = "benchmark_dataset.md"
_VIEW_SIZE = 256  # px, of what people see
_STORED_SIZE = 96  # px, about, of a stored image beside it
_N_COLUMNS = 3
_FRAME_MS = 125  # three times slower than nominal
_LAST_FRAME_MS = 1500
_SIZE_CATEGORIES = ((10**3, "n<1K"), (10**4, "1K<n<10K"), (10**5, "10K<n<100K"), (10**6, "100K<n<1M"))
_LARGEST_CATEGORY = "1M<n<10M"


def write_card(root: Path, folder: Path | None = None, repo_id: str | None = None) -> None:
    """Writes a dataset's card.

    Args:
        root: The dataset's folder. The dataset is finished, and of the benchmark.
        folder: Folder to write to; None for the dataset's folder.
        repo_id: Name of the dataset on the Hub for the card's examples; None for its folder.

    Raises:
        DatasetError: A file of the dataset is damaged.
        OSError: A file cannot be written.
    """
    folder = folder or root
    (folder / TASKS_IMAGE).parent.mkdir(parents=True, exist_ok=True)
    info = read_info(root)
    episodes = list(_first_episodes(root, info))
    image_info = info["features"]["observation.image"]["info"]
    with closing(PickPlaceEnv(**scene_settings(image_info), image_size=episodes[0].images.shape[1])) as env:
        save_png(_tasks_image(episodes, env), folder / TASKS_IMAGE)
        _save_episode(episodes[0], env, folder / EPISODE_IMAGE)
    text = card_text(root, repo_id)
    write_text(folder / CARD_FILE, text)


def has_current_card(root: Path) -> bool:
    """Whether a dataset's folder has a card that is not older than the dataset."""
    written = [root / file for file in CARD_FILES]
    return all(path.exists() for path in written) and (
        min(path.stat().st_mtime for path in written) >= (root / files.INFO_FILE).stat().st_mtime
    )


# Text


def card_text(root: Path, repo_id: str | None = None) -> str:
    """The card: metadata as YAML, then Markdown.

    Args:
        root: The dataset's folder.
        repo_id: Name of the dataset on the Hub; None if it is only in a folder.
    """
    info = read_info(root)
    history = read_history(root) if (root / HISTORY_FILE).exists() else []
    plans = [CollectionPlan(**entry["plan"]) for entry in history]
    tasks = _tasks(root)
    name = ", ".join(dict.fromkeys(plan.tasks for plan in plans)) or f"{len(tasks)} tasks"
    title = f"DeL-TaCo benchmark: {name}"
    metadata = DatasetCardData(
        language=["en"],
        license="apache-2.0",
        pretty_name=title,
        task_categories=["robotics"],
        size_categories=[_size_category(info["total_frames"])],
        tags=list(TAGS),
        configs=[{"config_name": "default", "data_files": "data/*/*.parquet"}],
    )
    image = info["features"]["observation.image"]
    return render(
        _TEMPLATE,
        metadata=metadata.to_yaml().strip(),
        title=title,
        repo_id=repo_id,
        info=info,
        image=image,
        image_size=image["shape"][0],
        benchmark=image["info"],
        action_scale=ACTION_SCALE,
        episode_steps=EPISODE_STEPS,
        tasks_image=TASKS_IMAGE,
        episode_image=EPISODE_IMAGE,
        tasks=tasks,
        kinds=_kinds(tasks),
        scenarios=_scenarios(tasks),
        features=_features(info["features"]),
        has_seed="benchmark.seed" in info["features"],
        collections=list(_collections(history, plans)),
        expert=_expert(history),
        megabytes=_size(root) / 1e6,
        kilobytes_per_episode=_size(root) / 1e3 / info["total_episodes"],
        env_options=env_options(image),
    )


def collect_command(plan: CollectionPlan, append: bool = False) -> str:
    """The `deltaco-collect` command of a plan, with nothing left to defaults."""
    words = ["deltaco-collect", "--root", "DIR"]
    for field in fields(plan):
        words += [f"--{field.name.replace('_', '-')}", str(getattr(plan, field.name))]
    return shlex.join([*words, *(["--append"] if append else [])])


def _tasks(root: Path) -> list[Task]:
    """The dataset's tasks, ascending."""
    ids: set[int] = set()
    for path in sorted((root / "data").glob("*/*.parquet")):
        with _named(path):
            ids.update(pq.read_table(path, columns=["benchmark.task_id"])[0].unique().to_pylist())
    return [get_task(index) for index in sorted(ids)]


def _kinds(tasks: Sequence[Task]) -> list[dict[str, Any]]:
    """For each kind of task, how many there are, and an instruction."""
    counts = Counter(task.kind for task in tasks)
    example = {task.kind: task.instruction for task in reversed(tasks)}
    return [{"kind": kind, "n_tasks": n, "example": example[kind]} for kind, n in counts.items()]


def _scenarios(tasks: Sequence[Task]) -> list[dict[str, Any]]:
    """For each scenario, how many of the tasks are for training and for testing."""
    ids = {task.index for task in tasks}
    return [
        {
            "name": scenario.name,
            "n_train": len(ids & set(scenario.train_tasks)),
            "all_train": len(scenario.train_tasks),
            "n_test": len(ids & set(scenario.test_tasks)),
            "all_test": len(scenario.test_tasks),
        }
        for scenario in SCENARIOS.values()
    ]


def _features(features: files.Features) -> list[dict[str, str]]:
    rows = []
    for name, feature in features.items():
        what, unit = DESCRIPTIONS.get(name, ("", ""))
        shape = ", ".join(map(str, feature["shape"]))
        parts = ", ".join(f"`{part}`" for part in feature["names"] or [])
        rows.append(
            {
                "name": name,
                "dtype": feature["dtype"],
                "shape": f"({shape}{',' * (len(feature['shape']) == 1)})",
                "what": f"{what}: {parts}" if what and parts else what or parts,
                "unit": unit,
            }
        )
    return rows


def _collections(
    history: Sequence[Mapping[str, Any]], plans: Sequence[CollectionPlan]
) -> Iterator[dict[str, Any]]:
    """The collections of a dataset, in order: their episodes, commands and versions."""
    first = 0
    for entry, plan in zip(history, plans, strict=True):
        yield {
            "plan": plan,
            "n_tasks": len(plan.task_ids),
            "first": first,
            "last": first + plan.n_episodes - 1,
            "command": collect_command(plan, append=first > 0),
            "versions": ", ".join(f"{name} {version}" for name, version in entry["versions"].items()),
        }
        first += plan.n_episodes


def _expert(history: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """For each kind of task, how often the expert was tried, and succeeded."""
    return [
        {"kind": kind, "attempts": attempts, "episodes": successes, "rate": successes / attempts}
        for kind, (attempts, successes) in tries_by_kind(history).items()
    ]


def _size(root: Path) -> int:
    """Of the dataset without its card, in bytes."""
    return sum(p.stat().st_size for name in ("data", "meta") for p in (root / name).rglob("*") if p.is_file())


def _size_category(n_rows: int) -> str:
    return next((name for limit, name in _SIZE_CATEGORIES if n_rows < limit), _LARGEST_CATEGORY)


# Images


@dataclass(frozen=True)
class _Episode:
    """A stored episode."""

    task: Task
    seed: int | None  # None if it was removed from the dataset
    images: NDArray[np.uint8]  # (N, H, W, 3)
    actions: NDArray[np.float32]  # (N, 4)


def _first_episodes(root: Path, info: Mapping[str, Any]) -> Iterator[_Episode]:
    """The first episode of each of some tasks, which are spread evenly over the dataset's."""
    columns = ["episode_index", "tasks", "data/chunk_index", "data/file_index"]
    parts = []
    for path in sorted((root / "meta/episodes").glob("*/*.parquet")):
        with _named(path):
            parts.append(pd.read_parquet(path, columns=columns))
    table = pd.concat(parts)
    table["task"] = table["tasks"].str[0]
    firsts = table.drop_duplicates("task")
    shown = np.unique(np.linspace(0, len(firsts) - 1, MAX_TASKS_SHOWN).round().astype(int))
    for row in firsts.iloc[shown].to_dict("records"):
        path = root / info["data_path"].format(
            chunk_index=row["data/chunk_index"], file_index=row["data/file_index"]
        )
        with _named(path):
            frames = pq.read_table(path, filters=[("episode_index", "==", row["episode_index"])])
            frames = frames.sort_by("frame_index").to_pandas()
            episode = _Episode(
                task=get_task(int(frames["benchmark.task_id"].iloc[0])),
                seed=int(frames["benchmark.seed"].iloc[0]) if "benchmark.seed" in frames else None,
                images=np.stack([_decoded(cell) for cell in frames["observation.image"]]),
                actions=np.stack(list(frames["action"])),
            )
        yield episode


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Names the file of the dataset that cannot be read."""
    try:
        yield
    # PyArrow's errors are among the first three, and Pillow's among the others.
    except (OSError, ValueError, KeyError, IndexError, SyntaxError) as error:
        raise damaged(path, error, "Check the dataset with `deltaco-collect --verify --root DIR`.") from None


def _tasks_image(episodes: Sequence[_Episode], env: PickPlaceEnv) -> Image.Image:
    """The start of each episode, for people where it can be drawn again, and as it is stored."""
    cells = []
    for episode in episodes:
        stored = episode.images[0]
        (view,) = list(islice(_replayed(episode, env), 1)) or [_enlarged(stored, _VIEW_SIZE)]
        # In this corner, there is nothing to hide at the start.
        view.paste(framed(_enlarged(stored, _STORED_SIZE), thickness=2), (0, 0))
        cells.append(down([view, caption(episode.task.instruction, view.width, n_lines=3)], gap=4))
    return framed(grid(cells, _N_COLUMNS), thickness=8)


def _save_episode(episode: _Episode, env: PickPlaceEnv, path: Path) -> None:
    """An animation of an episode: replayed for people, or else as it is stored."""
    views = list(_replayed(episode, env))
    if len(views) < len(episode.images):
        views = [_enlarged(stored, _VIEW_SIZE) for stored in episode.images]
    heading = caption(episode.task.instruction, views[0].width, size=14, n_lines=3)
    frames = [framed(down([heading, view], gap=2)) for view in views]
    save_gif(frames, [_FRAME_MS] * (len(frames) - 1) + [_LAST_FRAME_MS], path)


def _replayed(episode: _Episode, env: PickPlaceEnv) -> Iterator[Image.Image]:
    """Views of an episode, drawn again from its seed and actions, for as long as they are what is stored."""
    if episode.seed is None:
        return
    observation, _ = env.reset(seed=episode.seed, options={"task_id": episode.task.index})
    for stored, action in zip(episode.images, episode.actions, strict=True):
        if not np.array_equal(observation["pixels"], stored):
            return
        yield to_image(env.scene.render(_VIEW_SIZE))
        observation, *_ = env.step(action)


def _decoded(cell: Mapping[str, Any]) -> NDArray[np.uint8]:
    return np.asarray(Image.open(io.BytesIO(cell["bytes"])))


def _enlarged(stored: NDArray[np.uint8], size: int) -> Image.Image:
    return enlarged(stored, max(1, size // len(stored)))
