"""Demonstrations by the scripted expert, for policies that do not bring their own."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np
import torch

from gym_deltaco.expert import record_demonstration
from gym_deltaco.scene_config import SceneConfig
from gym_deltaco.tasks import get_task
from lerobot_deltaco.data.demonstrations import Demonstration
from lerobot_deltaco.data.grasps import find_grasp_states


def expert_demonstration(
    task_id: int, number: int, scene: SceneConfig, camera: str = "front"
) -> Demonstration:
    """Returns a whole episode of the expert as a demonstration.

    Args:
        task_id: Index of the task.
        number: Number of the demonstration. 0 is the task's first episode for validation.
        scene: Settings of the scene; the episode has the default length.
        camera: Camera of the frames, if the control has several.
    """
    steps = record_demonstration(task_id, number, replace(scene, episode_length=None))
    pixels = [step.observation["pixels"] for step in steps]
    images = np.stack([each[camera] if isinstance(each, Mapping) else each for each in pixels])
    states = torch.from_numpy(np.stack([step.observation["agent_pos"] for step in steps]))
    actions = torch.from_numpy(np.stack([step.action for step in steps]))
    grasps = find_grasp_states(states, actions[:, -1], [(0, len(steps) - 1)])
    info = steps[-1].info
    return Demonstration(
        get_task(task_id).instruction,
        torch.from_numpy(images).permute(0, 3, 1, 2),
        grasps.pick_states[0],
        target_object=int(info["objects"][info["target_object"]]),
        states=states,
        actions=actions,
    )


class ExpertBank:
    """The expert's demonstration of each task, recorded when it is asked for.

    Args:
        task_ids: Indices of the tasks.
        scene: Settings of the scenes.

    Attributes:
        rows: Indices of the tasks with each task string.
    """

    def __init__(self, task_ids: Iterable[int], scene: SceneConfig) -> None:
        self._scene = scene
        self._recorded: dict[int, Demonstration] = {}
        self.rows: dict[str, list[int]] = {}
        for task_id in task_ids:
            self.rows.setdefault(get_task(task_id).instruction, []).append(task_id)

    def of_task(self, task: str, target_object: int | None = None) -> list[Demonstration]:
        """Returns the demonstrations of a task: one. See `DemonstrationBank.of_task`."""
        (task_id,) = (each for each in self.rows[task] if get_task(each).object.index == target_object)
        if task_id not in self._recorded:
            self._recorded[task_id] = expert_demonstration(task_id, 0, self._scene)
        return [self._recorded[task_id]]
