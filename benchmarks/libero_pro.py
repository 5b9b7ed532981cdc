"""Speed of LIBERO-PRO's scenes, and how far its pictures are from robosuite's.

    python benchmarks/libero_pro.py --suite libero_object --task-id 0

Times are of one machine: compare figures of one run, made while nothing else uses the processor.
"""

from __future__ import annotations

import sys
import time

import numpy as np
from benchmark import seconds_of


def main(suite: str = "libero_object", task_id: int = 0, image_size: int = 256, episodes: int = 3) -> None:
    """Measures the parts of an episode, and prints a table.

    Args:
        suite: Name of the suite.
        task_id: Number of the task.
        image_size: Width and height of the images, pixels.
        episodes: Number of episodes of the expert.
    """
    from lerobot_env_libero_pro import LiberoProEnv, load_tasks
    from lerobot_env_libero_pro.expert import pick_and_place
    from lerobot_env_libero_pro.scene import NO_ACTION

    (task,) = load_tasks(suite, [task_id])
    env = LiberoProEnv(task, image_size)
    results = {}
    start = time.perf_counter()
    env.reset(seed=0)
    results["first reset, which makes the scene, s"] = time.perf_counter() - start
    scene, cameras = env.scene, env._cameras
    assert cameras is not None
    results["reset, s"] = seconds_of(lambda: env.reset(seed=1))
    results["action, ms"] = 1e3 * seconds_of(lambda: scene.step(NO_ACTION))
    for name in ("image", "image2"):
        results[f"picture `{name}`, ms"] = 1e3 * seconds_of(lambda name=name: cameras.draw(scene.data, name))
        difference = np.abs(cameras.draw(scene.data, name) - robosuite_picture(scene, name, image_size))
        results[f"difference from robosuite's `{name}`, mean, of 255"] = float(difference.mean())
        results[f"difference from robosuite's `{name}`, above 8, %"] = 100 * float(
            (difference.max(2) > 8).mean()
        )
    start, n_successes = time.perf_counter(), 0
    for seed in range(episodes):
        env.reset(seed=seed)
        successes = [
            env.step(action)[4]["is_success"]
            for action in pick_and_place(scene, task.target, task.place or "")
        ]
        n_successes += any(successes)
    results["episode of the expert, s"] = (time.perf_counter() - start) / episodes
    results["expert, success, %"] = 100 * n_successes / episodes
    env.close()
    width = max(map(len, results))
    sys.stdout.writelines(f"{name:{width}}  {value:12.3f}\n" for name, value in results.items())


def robosuite_picture(scene, name: str, size: int) -> np.ndarray:
    """Returns the picture as robosuite draws it, turned as LeRobot does: (size, size, 3)."""
    import mujoco

    from lerobot_env_libero_pro.cameras import CAMERAS

    scene.model.vis.quality.offsamples = 4
    renderer = mujoco.Renderer(scene.model, size, size)
    options = mujoco.MjvOption()
    options.geomgroup[:2] = [0, 1]
    options.sitegroup[:] = 0
    renderer.update_scene(scene.data, camera=CAMERAS[name], scene_option=options)
    picture = renderer.render()[:, ::-1].astype(float)
    renderer.close()
    scene.model.vis.quality.offsamples = 0
    return picture


if __name__ == "__main__":
    import tyro

    tyro.cli(main)
