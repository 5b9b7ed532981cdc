"""Lists the meshes of PyBullet that the scripted expert can pick and place, in `out_of_distribution.json`.

The expert has to succeed in three of three scenes, beside two other meshes.
"""

from __future__ import annotations

import json
import sys
from contextlib import closing

from gym_deltaco.env import PickPlaceEnv
from gym_deltaco.expert import expert_episode
from gym_deltaco.objects.labels import EXPERT_MESHES_FILE, FIRST_MESH_INDEX, MESHES
from gym_deltaco.scene_config import SceneConfig
from gym_deltaco.seeding import episode_seed
from gym_deltaco.tasks import MESH_TASKS
from lerobot_deltaco.atomic_files import write_text

CONTAINERS = ("green", "front", "left")


def main() -> None:
    """Writes the list."""
    solved = []
    scene = SceneConfig(objects="out_of_distribution_unchecked")
    with closing(PickPlaceEnv(MESH_TASKS[0].index, scene)) as env:
        for mesh in MESHES:
            tasks = [
                task.index
                for task in MESH_TASKS
                if task.object.index == FIRST_MESH_INDEX + mesh and task.container in CONTAINERS
            ]
            episodes = (expert_episode(env, task, episode_seed(0, "train", task, 0)) for task in tasks)
            if all(any(step.info["is_success"] for step in episode) for episode in episodes):
                solved.append(mesh)
    write_text(EXPERT_MESHES_FILE, json.dumps(solved) + "\n")
    sys.stdout.write(f"The expert succeeds with {len(solved)} of {len(MESHES)} meshes.\n")


if __name__ == "__main__":
    main()
