"""`deltaco toy`: a dataset of the toy robot, as a person would record it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from lerobot.datasets import LeRobotDataset
from tqdm import tqdm

from lerobot_deltaco.toy_robot.world import (
    CAMERAS,
    FPS,
    HEIGHT,
    HOME,
    MOTORS,
    NEW_TASKS,
    REACH,
    TASKS,
    WIDTH,
    ToyWorld,
    Vector,
    joints_at,
)


def teleoperated(
    world: ToyWorld, name: str, color: str, rng: np.random.Generator
) -> Iterator[tuple[Vector, Vector]]:
    """Puts an object into a box as a person would, and yields the state and the action of each frame, (6,).

    People hesitate, open the gripper more or less, and tremble.
    """
    (x, y), (box_x, box_y) = world.objects[name][:2], world.boxes[color] + rng.uniform(-0.012, 0.012, 2)
    x, y = np.array([x, y]) + rng.uniform(-0.004, 0.004, 2)
    opening, roll, height = rng.uniform(60, 95), rng.uniform(-6, 6), rng.uniform(0.08, 0.1)
    closed = rng.uniform(5, 15)
    # Waypoints, the usual number of frames to each, and the longest pause there.
    course = [
        (joints_at(x, y, height, opening, roll), 18, 8),
        (joints_at(x, y, REACH, opening, roll), 9, 6),
        (joints_at(x, y, REACH, closed, roll), 6, 5),
        (joints_at(x, y, height, closed, roll), 7, 2),
        (joints_at(box_x, box_y, height, closed, roll), 16, 8),
        (joints_at(box_x, box_y, 0.06, closed, roll), 6, 3),
        (joints_at(box_x, box_y, 0.06, opening, roll), 6, 4),
        (joints_at(box_x, box_y, height, opening, roll), 5, 0),
        (HOME, 15, 3),
    ]
    pace, start = rng.uniform(0.75, 1.35), HOME
    tremble: Vector = np.zeros(len(MOTORS))
    for end, usual, longest_pause in course:
        n_frames = max(3, round(pace * usual * rng.uniform(0.85, 1.15)))
        t = np.arange(1, n_frames + 1) / n_frames
        path = start + (t**3 * (10 - 15 * t + 6 * t**2))[:, None] * (end - start)
        for target in (*path, *[end] * int(rng.integers(longest_pause + 1))):
            tremble = 0.9 * tremble + rng.normal(0, 0.06, len(MOTORS))
            action = target + tremble
            yield world.joints, action
            world.step(action)
        start = end


def write_toy_dataset(root: Path, episodes_per_task: int, new_object: bool, seed: int) -> int:
    """Writes a dataset of the toy robot, and returns the number of its frames.

    Args:
        root: Folder of the dataset, which must not exist.
        episodes_per_task: Number of episodes of each task.
        new_object: Whether the tasks are those with the new object.
        seed: Seed of the scenes and of the person.
    """
    motors = {"dtype": "float32", "shape": (len(MOTORS),), "names": list(MOTORS)}
    image = {"dtype": "image", "shape": (HEIGHT, WIDTH, 3), "names": ["height", "width", "channels"]}
    features = {f"observation.images.{camera}": image for camera in CAMERAS}
    features |= {"observation.state": motors, "action": motors}
    dataset = LeRobotDataset.create(
        f"toy/{root.name}", FPS, features, root=root, robot_type="toy_robot", use_videos=False
    )
    tasks = list((NEW_TASKS if new_object else TASKS).items())
    order = [task for task in tasks for _ in range(episodes_per_task)]
    for episode, (sentence, (name, color)) in enumerate(tqdm(order, desc="Recording", unit="episode")):
        rng = np.random.default_rng((seed, episode))
        while True:
            world = ToyWorld(int(rng.integers(2**31)), new_object)
            for state, action in teleoperated(world, name, color, rng):
                frame = {f"observation.images.{camera}": image for camera, image in world.images().items()}
                frame |= {"observation.state": state.astype(np.float32), "action": action.astype(np.float32)}
                dataset.add_frame({**frame, "task": sentence})
            if world.in_boxes().get(name) == color:
                break
            dataset.clear_episode_buffer()
        dataset.save_episode()
    dataset.finalize()
    return dataset.meta.total_frames
