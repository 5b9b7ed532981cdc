"""Collects successful episodes of the scripted expert as a LeRobotDataset.

The dataset depends only on its plan. Worker processes write shards, whose episodes and indices are known
beforehand; the main process writes the dataset's metadata last. A shard is either complete or absent, so the
same command continues an interrupted collection with the missing shards.

A plan needs no simulator, and nothing here imports LeRobot or torch.
"""

from __future__ import annotations

import math
import multiprocessing
import signal
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow.parquet as pq
from numpy.typing import NDArray
from tqdm import tqdm

from gym_deltaco import ENV_ID, EXPERT_NOISE
from gym_deltaco.env import PickPlaceEnv
from gym_deltaco.expert import expert_episode
from gym_deltaco.scene_config import SceneConfig
from gym_deltaco.seeding import episode_seed
from gym_deltaco.sim.simulation import check_simulator
from gym_deltaco.tasks import HELD_OUT, get_task, select_tasks
from lerobot_deltaco.atomic_files import only_writer, read_json, write_json
from lerobot_deltaco.collection import writer as dataset_writer
from lerobot_deltaco.errors import UserError
from lerobot_deltaco.processes import end_with_parent

Split = Literal["train", "validation"]

ROBOT_TYPE = "widowx_250"
DESCRIPTION_FILE = "meta/deltaco.json"
MAX_ATTEMPTS = 100
# Outside `observation.`, so that no policy takes them as an input.
PRIVILEGED = ("benchmark.task_id", "benchmark.target_object", "benchmark.target_container", "benchmark.seed")


class CollectionError(UserError):
    """Raised when a collection cannot start or continue; the message says what to do."""


@dataclass(frozen=True)
class CollectionPlan:
    """Everything that a dataset depends on; equal plans give equal datasets.

    Args:
        tasks: Tasks: a task set, or indices and ranges, such as 4,50-73.
        episodes_per_task: Number of successful episodes of each task.
        seed: Seed of the whole dataset.
        split: Purpose of the episodes; scenes of different splits never coincide. By default, "validation"
            for the scenarios' test and validation tasks, and "train" otherwise.
        noise: Standard deviation of the Gaussian noise on the first three numbers of the expert's actions;
            with joint control, that on the joints in units of 0.04 rad.
        scene: Settings of the scenes.

    Raises:
        ValueError: An argument is invalid; the message says what is valid.
    """

    tasks: str
    episodes_per_task: int
    seed: int = 0
    split: Split | None = None
    noise: float = EXPERT_NOISE
    scene: SceneConfig = SceneConfig()

    def __post_init__(self) -> None:
        for name, lowest in (("episodes_per_task", 1), ("seed", 0), ("noise", 0)):
            number = getattr(self, name)
            if not lowest <= number < math.inf:
                raise UserError(f"`{name}` must be at least {lowest}. Got {number}.")
        object.__setattr__(self, "scene", self.scene.for_tasks(self.tasks))
        self.scene.check_tasks(self.task_ids)
        if self.split is None:
            object.__setattr__(self, "split", "validation" if self.tasks in HELD_OUT else "train")

    @property
    def task_ids(self) -> tuple[int, ...]:
        """Indices of the tasks, in the order of the dataset."""
        return select_tasks(self.tasks)

    @property
    def instructions(self) -> list[str]:
        """Instructions, in the order of their index in the dataset, each once."""
        return list(dict.fromkeys(get_task(task_id).instruction for task_id in self.task_ids))

    @property
    def n_episodes(self) -> int:
        """Number of episodes of all tasks."""
        return len(self.task_ids) * self.episodes_per_task

    @property
    def shards(self) -> list[range]:
        """Indices of the episodes of each shard.

        A shard has at most 100 episodes, about 5 MB. Small datasets have smaller shards, so that every worker
        gets some.
        """
        size = min(100, max(10, self.n_episodes // 32))
        return [range(first, min(first + size, self.n_episodes)) for first in range(0, self.n_episodes, size)]

    def episode(self, index: int) -> tuple[int, int]:
        """Returns the task of an episode, and its number among the episodes of that task."""
        position, number = divmod(index, self.episodes_per_task)
        return self.task_ids[position], number

    def seeds(self, task_id: int, number: int) -> Iterator[int]:
        """Yields the seed of each attempt at an episode."""
        assert self.split is not None
        for attempt in range(MAX_ATTEMPTS):
            yield episode_seed(self.seed, self.split, task_id, number, attempt)


def collect(root: Path, plan: CollectionPlan, workers: int = 1) -> str:
    """Collects a dataset, or continues an interrupted collection of the same plan.

    Args:
        root: Folder of the dataset: new, empty, or of the same plan.
        plan: Tasks, episodes and settings.
        workers: Number of processes; the dataset is the same with any number.

    Returns:
        A summary: the number of episodes, the speed, and how often the expert succeeded. If the dataset is
        finished, there is nothing to do.

    Raises:
        UserError: Another process writes to the folder.
        CollectionError: The folder holds something else, or cannot be written to; the expert cannot do a
            task; or a worker process was killed.
        ImportError: PyBullet is not installed.
    """
    check_simulator()  # fails here, before anything is written, if there is no simulator
    speed = "nothing to do"
    try:
        _check_folder(root, plan)
        if not is_finished(root):
            with only_writer(root):
                speed = f"{_collect_missing(root, plan, workers):.1f} episodes/s"
    except BrokenProcessPool:
        raise CollectionError(
            "A worker process was killed; the memory may be full. Finished shards are kept: run the same "
            "command again, with fewer workers."
        ) from None
    except OSError as error:
        raise CollectionError(
            f"Cannot write to {root}: {error.strerror or error}. Finished shards are kept: run the same "
            "command again when there is space and the folder can be written to."
        ) from None
    outcome = read_description(root)
    rates = [f"{kind} {n / outcome['attempts'][kind]:.1%}" for kind, n in outcome["episodes"].items()]
    return (
        f"{root}: {plan.n_episodes} episodes; {speed}.\nThe expert succeeded in {plan.n_episodes} of "
        f"{sum(outcome['attempts'].values())} attempts ({', '.join(rates)})."
    )


def collect_part(root: Path, plan: CollectionPlan, part: int, n_parts: int) -> None:
    """Collects a part of a dataset's shards, beside the other parts on other machines.

    `collect` then writes the rest: the metadata, and the shards of parts that failed.

    Args:
        root: Folder of the dataset, on a file system that all machines share.
        plan: Tasks, episodes and settings.
        part: Number of the part, 0..n_parts - 1.
        n_parts: Number of parts.

    Raises:
        CollectionError: The folder holds something else, or the expert cannot do a task.
        ImportError: PyBullet is not installed.
    """
    check_simulator()
    _check_folder(root, plan)
    if is_finished(root):
        return
    write_json(root / DESCRIPTION_FILE, _description(plan))
    for shard in range(part, len(plan.shards), n_parts):
        if not dataset_writer.is_written(root, shard):
            _collect_shard(root, plan, shard)


# The folder


def is_finished(root: Path) -> bool:
    """Returns whether a folder holds a dataset whose collection is complete."""
    return (root / DESCRIPTION_FILE).exists() and (root / dataset_writer.INFO_FILE).exists()


def read_description(root: Path) -> dict[str, Any]:
    """Reads the origin of a dataset.

    Returns:
        "plan", "benchmark" and "renderer"; of a finished dataset also "versions" of packages, and for each
        kind of task the number of "episodes" and of "attempts".
    """
    return read_json(root / DESCRIPTION_FILE)


def read_plan(root: Path) -> CollectionPlan:
    """Reads the plan of a dataset."""
    plan = read_description(root)["plan"]
    return CollectionPlan(**{**plan, "scene": SceneConfig(**plan["scene"])})


def renderer() -> str:
    """Returns the name of the renderer."""
    return f"PyBullet {version('pybullet')}, TinyRenderer"


def dataset_features(scene: SceneConfig) -> dict[str, dict[str, Any]]:
    """Returns the features of a dataset, as in LeRobot's info.json."""
    control = scene.interface
    number = {"dtype": "int64", "shape": [1], "names": None}
    image = {
        "dtype": "image",
        "shape": [scene.image_size, scene.image_size, 3],
        "names": ["height", "width", "channels"],
        # Policies do not transfer from one renderer's images to another's.
        "info": {"renderer": renderer(), "benchmark": ENV_ID, **asdict(scene)},
    }
    vectors = {"observation.state": control.state_names, "action": control.action_names}
    return {
        **dict.fromkeys(control.camera_keys, image),
        **{
            name: {"dtype": "float32", "shape": [len(names)], "names": names}
            for name, names in vectors.items()
        },
        "next.reward": {"dtype": "float32", "shape": [1], "names": None},
        "next.done": {"dtype": "bool", "shape": [1], "names": None},
        "next.success": {"dtype": "bool", "shape": [1], "names": None},
        **dict.fromkeys(PRIVILEGED, number),
        **dataset_writer.DEFAULT_FEATURES,
    }


def _description(plan: CollectionPlan) -> dict[str, Any]:
    return {"plan": asdict(plan), "benchmark": ENV_ID, "renderer": renderer()}


def _outcome(root: Path, plan: CollectionPlan) -> dict[str, Any]:
    """Counts the attempts behind the episodes; an episode's seed tells which attempt succeeded."""
    rows = pq.read_table(
        root / "data", columns=["episode_index", "benchmark.seed"], filters=[("frame_index", "==", 0)]
    )
    episodes: Counter[str] = Counter()
    attempts: Counter[str] = Counter()
    for index, seed in zip(*(column.to_pylist() for column in rows.columns), strict=True):
        task_id, number = plan.episode(index)
        kind = get_task(task_id).kind
        episodes[kind] += 1
        attempts[kind] += next(n for n, tried in enumerate(plan.seeds(task_id, number), 1) if tried == seed)
    versions = {name: version(name) for name in ("lerobot_policy_deltaco", "pybullet", "numpy")}
    return {"versions": versions, "episodes": episodes, "attempts": attempts}


def _check_folder(root: Path, plan: CollectionPlan) -> None:
    if not (root / DESCRIPTION_FILE).exists():
        found = next((path for path in root.rglob("*") if path.is_file()), None)
        if found is not None:
            raise CollectionError(f"{root} is not empty: it holds {found.name}. Name a new folder.")
        return
    begun, wanted = (
        {**each, **each["plan"], **each["plan"]["scene"]}
        for each in (read_description(root), _description(plan))
    )
    # A finished dataset remains valid when packages are updated.
    ignored = {"plan", "scene", *(("benchmark", "renderer") if is_finished(root) else ())}
    differences = [
        f"{name}: {begun.get(name)} there, {value} now"
        for name, value in wanted.items()
        if begun.get(name) != value and name not in ignored
    ]
    if differences:
        raise CollectionError(
            f"{root} holds a collection of another plan ({'; '.join(differences)}). Name a new folder, or "
            "delete this one."
        )


def _collect_missing(root: Path, plan: CollectionPlan, workers: int) -> float:
    """Writes what a dataset lacks. Returns the number of episodes per second."""
    write_json(root / DESCRIPTION_FILE, _description(plan))
    speed = _collect_shards(root, plan, workers)
    write_json(root / DESCRIPTION_FILE, {**_description(plan), **_outcome(root, plan)})
    dataset_writer.number_frames(root, len(plan.shards))
    dataset_writer.write_metadata(
        root, dataset_features(plan.scene), plan.scene.interface.fps, ROBOT_TYPE, plan.instructions
    )
    return speed


# Workers


def _collect_shards(root: Path, plan: CollectionPlan, workers: int) -> float:
    """Collects the missing shards. Returns the number of episodes per second."""
    missing = [shard for shard in range(len(plan.shards)) if not dataset_writer.is_written(root, shard)]
    n_missing = sum(len(plan.shards[shard]) for shard in missing)
    n_finished = plan.n_episodes - n_missing
    start = time.perf_counter()
    with tqdm(total=plan.n_episodes, initial=n_finished, desc="Collecting", unit="episode") as progress:
        for shard in _run(root, plan, missing, min(workers, len(missing))):
            progress.update(len(plan.shards[shard]))
    return n_missing / (time.perf_counter() - start)


def _run(root: Path, plan: CollectionPlan, shards: Sequence[int], workers: int) -> Iterator[int]:
    """Collects shards, in this process if one is enough, and yields each once it is written."""
    if workers <= 1:
        for shard in shards:
            yield _collect_shard(root, plan, shard)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, _start_worker) as executor:
        futures = [executor.submit(_collect_shard, root, plan, shard) for shard in shards]
        try:
            for future in as_completed(futures):
                yield future.result()
        except BaseException:
            executor.shutdown(cancel_futures=True)
            raise


def _start_worker() -> None:
    # An interrupt in the terminal reaches all processes, and ends this one immediately.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    end_with_parent()


def _collect_shard(root: Path, plan: CollectionPlan, shard: int) -> int:
    instructions, indices = plan.instructions, plan.shards[shard]

    def episodes(env: PickPlaceEnv) -> Iterator[dataset_writer.RecordedEpisode]:
        for task_id, number in map(plan.episode, indices):
            instruction = get_task(task_id).instruction
            frames = collect_episode(env, plan, task_id, number)
            yield dataset_writer.RecordedEpisode(frames, instruction, instructions.index(instruction))

    with closing(PickPlaceEnv(plan.task_ids[0], plan.scene)) as env:
        dataset_writer.write_shard(
            root,
            shard,
            episodes(env),
            dataset_features(plan.scene),
            plan.scene.interface.fps,
            first_episode=indices.start,
            first_frame=indices.start * plan.scene.n_steps,  # unless episodes end before that
        )
    return shard


def collect_episode(env: PickPlaceEnv, plan: CollectionPlan, task_id: int, number: int) -> dict[str, NDArray]:
    """Runs the expert until it succeeds.

    Args:
        env: Environment with the plan's scenes.
        plan: The collection.
        task_id: Task of the episode.
        number: Number of the episode among those of its task, from 0.

    Returns:
        Values of each recorded feature, (N, ...), for the N steps of the episode.

    Raises:
        CollectionError: The expert never succeeded.
    """
    for seed in plan.seeds(task_id, number):
        steps = list(expert_episode(env, task_id, seed, plan.noise))
        info = steps[-1].info
        if not info["is_success"]:
            continue
        n_steps, cameras = len(steps), plan.scene.interface.cameras
        observed = [step.observation for step in steps]
        images = [[each["pixels"][name] for each in observed] for name in cameras]
        images = images or [[each["pixels"] for each in observed]]
        privileged = (task_id, info["objects"][info["target_object"]], info["target_container"], seed)
        return {
            **dict(zip(plan.scene.interface.camera_keys, map(np.stack, images), strict=True)),
            "observation.state": np.stack([each["agent_pos"] for each in observed]),
            "action": np.stack([step.action for step in steps]),
            "next.reward": np.array([step.reward for step in steps], dtype=np.float32),
            "next.done": np.arange(n_steps) == n_steps - 1,
            "next.success": np.array([step.info["is_success"] for step in steps]),
            **{
                name: np.full(n_steps, value, dtype=np.int64)
                for name, value in zip(PRIVILEGED, privileged, strict=True)
            },
        }
    raise CollectionError(
        f"The expert failed {MAX_ATTEMPTS} times in a row at task {task_id}, episode {number}. A noise of "
        f"{plan.noise} may be too much for it; the default is {EXPERT_NOISE}."
    )
