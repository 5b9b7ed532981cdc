"""Speed of LIBERO-PRO's scenes, and how far its pictures are from robosuite's.

    python benchmarks/libero_pro.py --suite libero_object --task-id 0

Times are those of the processor, over all threads, and so depend little on other work.
"""

from __future__ import annotations

import sys
import time
from collections import defaultdict

import numpy as np

COMPARED = 10  # actions between two pictures that are compared with robosuite's


def main(suite: str = "libero_object", task_id: int = 0, image_size: int = 256, episodes: int = 3) -> None:
    """Measures the parts of an episode of the expert, and prints a table of averages.

    Args:
        suite: Name of the suite.
        task_id: Number of the task.
        image_size: Width and height of the images, pixels.
        episodes: Number of episodes.
    """
    from lerobot_env_libero_pro import LiberoProEnv, load_tasks
    from lerobot_env_libero_pro.cameras import CAMERAS
    from lerobot_env_libero_pro.expert import pick_and_place

    (task,) = load_tasks(suite, [task_id])
    env = LiberoProEnv(task, image_size)
    values: dict[str, list[float]] = defaultdict(list)

    def timed(name, function, *arguments, scale=1):
        start = time.process_time()
        result = function(*arguments)
        values[name].append(scale * (time.process_time() - start))
        return result

    timed("first reset, which makes the scene, s", lambda: env.reset(seed=0))
    env.draws = False
    for seed in range(1, episodes + 1):
        timed("reset, s", lambda seed=seed: env.reset(seed=seed))
        scene, cameras = env.scene, env._cameras
        assert cameras is not None
        start, compared, successes = time.process_time(), 0.0, []
        for n, action in enumerate(pick_and_place(scene, task.target, task.place or "")):
            successes.append(timed("action, ms", env.step, action, scale=1e3)[4]["is_success"])
            for name in CAMERAS:
                picture = timed(f"picture `{name}`, ms", cameras.draw, scene.data, name, scale=1e3)
                if n % COMPARED:
                    continue
                began = time.process_time()
                difference = np.abs(picture - robosuite_picture(scene, name, image_size))
                values[f"difference from robosuite's `{name}`, mean, of 255"].append(difference.mean())
                changed = 100 * (difference.max(2) > 8).mean()
                values[f"difference from robosuite's `{name}`, above 8, % of pixels"].append(changed)
                compared += time.process_time() - began
        values["episode, s"].append(time.process_time() - start - compared)
        values["actions of an episode"].append(len(successes))
        values["success, %"].append(100 * any(successes))
    env.close()
    width = max(map(len, values))
    sys.stdout.writelines(f"{name:{width}}  {np.mean(each):12.3f}\n" for name, each in values.items())


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
