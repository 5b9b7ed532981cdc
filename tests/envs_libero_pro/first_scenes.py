"""What the first scenes of LIBERO's tasks are like, to notice when a version of a package changes them.

    python tests/envs_libero_pro/first_scenes.py

Positions and averages over parts of a picture are compared with a tolerance. A hash of pictures would depend
on the driver that draws, and one of the simulator's state on the processor.
"""

import json
from pathlib import Path

import numpy as np

from lerobot_env_libero_pro import LiberoProEnv, load_tasks
from lerobot_env_libero_pro.suites import HORIZONS

FILE = Path(__file__).with_suffix(".json")
PARTS = 4  # of a picture along each axis
SIZE = 64  # px


def describe(env):
    """Returns objects' positions, mm, and mean gray values of parts of the pictures, in the first scene."""
    observation, _ = env.reset(seed=0)
    scene, parts = env.scene, (PARTS, SIZE // PARTS, PARTS, SIZE // PARTS, 3)
    return {
        "positions": {name: np.round(1000 * scene.position(name)).tolist() for name in scene.task.objects},
        "pictures": {
            name: picture.reshape(parts).mean((1, 3, 4)).round().tolist()
            for name, picture in observation["pixels"].items()
        },
    }


def main():
    lines = []
    for suite in HORIZONS:
        for task in load_tasks(suite):
            env = LiberoProEnv(task, SIZE)
            lines.append(f"{json.dumps(f'{suite}/{task.id}')}: {json.dumps(describe(env))}")
            env.close()
    FILE.write_text("{\n" + ",\n".join(lines) + "\n}\n")


if __name__ == "__main__":
    main()
