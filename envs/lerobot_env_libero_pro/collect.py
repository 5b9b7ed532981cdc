"""Records demonstrations of the scripted expert as a LeRobotDataset.

    python -m lerobot_env_libero_pro.collect --suite libero_object --layouts permuted \
        --episodes-per-task 18 --root data/libero_object_b

Run it again to go on after an interruption.
"""

from __future__ import annotations

import itertools
import json
import signal
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro
from tqdm import tqdm

from lerobot_env_libero_pro.cameras import CAMERAS, Cameras
from lerobot_env_libero_pro.expert import pick_and_place
from lerobot_env_libero_pro.layouts import RECEPTACLE, layout_rng, permuted_poses
from lerobot_env_libero_pro.scene import ACTION_NAMES, CONTROL_FPS, NO_ACTION, STATE_NAMES, Scene
from lerobot_env_libero_pro.suites import Task, category, load_tasks

MAX_ATTEMPTS = 10  # at one episode
RESTING_STEPS = 6  # after the expert's last action, before success counts


@dataclass(frozen=True)
class Job:
    """An episode to record: an object to be placed in a task's scene."""

    task: Task
    target: str
    number: int

    @property
    def sentence(self) -> str:
        """The task's sentence, with the name of this object."""
        return self.task.sentence.replace(_words(self.task.target), _words(self.target))


def main(
    root: Path,
    suite: str = "libero_object",
    layouts: Literal["standard", "permuted"] = "standard",
    episodes_per_task: int = 20,
    task_ids: list[int] | None = None,
    exclude_objects: list[str] | None = None,
    only_objects: list[str] | None = None,
    image_size: int = 256,
    seed: int = 0,
) -> None:
    """Records successful episodes of the scripted expert, both cameras, and the robot's state.

    Args:
        root: Folder of the dataset, new, or that of an interrupted recording with the same arguments.
        suite: Name of the suite.
        layouts: Objects where the suite puts them at random, or anywhere, kept apart. Standard layouts are
            drawn anew: none is one of the 50 states of the evaluation. In permuted layouts with a basket,
            each object in turn is the target; in others, a task keeps its own, since pairings are held out.
        episodes_per_task: Number of episodes of each sentence.
        task_ids: Numbers of the suite's tasks; all by default.
        exclude_objects: Objects that are never a target, such as bbq_sauce. They still lie in scenes.
        only_objects: Objects that are targets; all by default.
        image_size: Width and height of the images, pixels.
        seed: Seed of the layouts. No value gives a layout of the evaluation.
    """
    jobs = plan(load_tasks(suite, task_ids), layouts, episodes_per_task)
    excluded, only = set(exclude_objects or ()), set(only_objects or ())
    _check_objects(excluded | only, {category(job.target) for job in jobs})
    jobs = [job for job in jobs if category(job.target) not in excluded]
    jobs = [job for job in jobs if not only or category(job.target) in only]
    recorded = _recorded(root)
    # `kill` interrupts like Ctrl+C: files of a dataset have to be closed.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with tqdm(total=len(jobs), initial=recorded, unit="episode") as bar:
        for task, group in itertools.groupby(jobs[recorded:], key=lambda job: job.task):
            scene = Scene(task)
            cameras = Cameras(scene.model, image_size)
            dataset = _open(root, image_size)
            episodes, attempts = Counter[str](), Counter[str]()
            try:
                for job in group:
                    bar.set_description(job.sentence)
                    attempts[job.sentence] += record(dataset, scene, cameras, job, layouts, seed)
                    episodes[job.sentence] += 1
                    bar.update()
            finally:  # the dataset can be read after each scene, and after an interruption
                dataset.finalize()
                for sentence, count in episodes.items():
                    bar.write(f"{task.suite} {task.id}, {sentence}: {count} of {attempts[sentence]} attempts")
                cameras.close()
                scene.close()


def plan(tasks: list[Task], layouts: str, episodes_per_task: int) -> list[Job]:
    """Returns the episodes to record, scene by scene.

    In permuted layouts with a basket, the episodes of an object are spread over the scenes in which it lies.
    """
    if layouts == "standard" or not all(RECEPTACLE in task.objects for task in tasks):
        return [Job(task, task.target, n) for task in tasks for n in range(episodes_per_task)]
    scenes = Counter(name for task in tasks for name in task.objects)
    jobs, met = [], Counter[str]()
    for task in tasks:
        for name in task.objects:
            if name != RECEPTACLE:
                first, last = (episodes_per_task * (met[name] + i) // scenes[name] for i in (0, 1))
                jobs += [Job(task, name, n) for n in range(first, last)]
                met[name] += 1
    return jobs


def record(dataset: Any, scene: Scene, cameras: Cameras, job: Job, layouts: str, seed: int) -> int:
    """Records one successful episode, and returns the number of attempts that it took.

    Raises:
        RuntimeError: The expert fails ten times.
    """
    goal = (job.task.goal[0][0], job.target, *job.task.goal[0][2:])
    for attempt in range(MAX_ATTEMPTS):
        object_number = job.task.objects.index(job.target)
        rng = layout_rng("training", seed, job.task.id, object_number, job.number, attempt)
        drawn = int(rng.integers(2**31))
        scene.reset(drawn)
        if layouts == "permuted":
            scene.reset(drawn, poses=permuted_poses(scene, rng))
        cameras.restart()
        for action in pick_and_place(scene, job.target, job.task.place or ""):
            images = {f"observation.images.{name}": cameras.draw(scene.data, name) for name in CAMERAS}
            frame = {"observation.state": scene.robot_state(), "action": action, "task": job.sentence}
            dataset.add_frame(images | frame)
            scene.step(action)
        for _ in range(RESTING_STEPS):
            scene.step(NO_ACTION)
        if scene.holds(goal):
            dataset.save_episode()
            return attempt + 1
        dataset.clear_episode_buffer()
    raise RuntimeError(
        f"The expert failed {MAX_ATTEMPTS} times at {job.sentence!r}. Leave the task out (`--task-ids`): "
        "README.md names those that the expert can do."
    )


def _recorded(root: Path) -> int:
    """Returns the number of episodes of a dataset, which need not exist yet."""
    file = root / "meta" / "info.json"
    return json.loads(file.read_text())["total_episodes"] if file.is_file() else 0


def _open(root: Path, image_size: int) -> Any:
    """Opens a dataset for recording, new or interrupted."""
    from lerobot.datasets import LeRobotDataset

    if _recorded(root):
        return LeRobotDataset.resume("local/libero_pro", root=root)
    image = {"dtype": "image", "shape": (image_size, image_size, 3), "names": ["height", "width", "channels"]}
    features = {
        **{f"observation.images.{name}": image for name in CAMERAS},
        "observation.state": {"dtype": "float32", "shape": (len(STATE_NAMES),), "names": list(STATE_NAMES)},
        "action": {"dtype": "float32", "shape": (len(ACTION_NAMES),), "names": list(ACTION_NAMES)},
    }
    return LeRobotDataset.create(
        "local/libero_pro",
        fps=CONTROL_FPS,
        root=root,
        features=features,
        robot_type="panda",
        use_videos=False,
    )


def _check_objects(names: set[str], known: set[str]) -> None:
    if unknown := names - known:
        raise ValueError(
            f"No object is called {', '.join(sorted(unknown))}. Objects: {', '.join(sorted(known))}."
        )


def _words(name: str) -> str:
    return category(name).replace("_", " ")


if __name__ == "__main__":
    tyro.cli(main)
