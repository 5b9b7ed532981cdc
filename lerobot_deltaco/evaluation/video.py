"""Recordings of benchmark episodes by a policy, and demonstrations for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from gym_deltaco.control import control_of
from gym_deltaco.env import PickPlaceEnv
from gym_deltaco.layout import Layout
from gym_deltaco.scene_config import SceneConfig
from gym_deltaco.tasks import Task
from lerobot_deltaco.data.demonstrations import Demonstration, kept_frames
from lerobot_deltaco.data.images import resize_images
from lerobot_deltaco.data.object_prompts import ObjectPrompt
from lerobot_deltaco.errors import UserError
from lerobot_deltaco.evaluation.checkpoints import LoadedPolicy, find_checkpoints, load_policy
from lerobot_deltaco.evaluation.episodes import EpisodeSpec
from lerobot_deltaco.evaluation.evaluate import run_episodes
from lerobot_deltaco.evaluation.expert_demonstrations import expert_demonstration
from lerobot_deltaco.evaluation.lerobot_env import check_policy_fits
from lerobot_deltaco.policies.base.modeling import TaskConditionedPolicy
from lerobot_deltaco.policies.deltaco_match.localization import PickPlace


class Recording(NamedTuple):
    """A recorded episode of the benchmark.

    Attributes:
        frames: Rendered images before the first step and after each, (render_size, render_size, 3).
        localization: Locations in the first image, by the policy; None for policies that find none.
        layout: Objects and containers of the scene.
        positions: Centers of the objects before the first step and after the last, (2, objects, 3), m.
        placements: Pairs of an object and a container in which it came to rest.
        grasped_object: Number of the object that the gripper held last; -1 for none.
    """

    frames: list[NDArray[np.uint8]]
    localization: PickPlace | None
    layout: Layout
    positions: NDArray[np.float64]
    placements: frozenset[tuple[int, int]]
    grasped_object: int


def record_episode(
    loaded: LoadedPolicy,
    env: PickPlaceEnv,
    task_id: int,
    seed: int,
    instruction: str,
    demonstrations: Sequence[Demonstration | ObjectPrompt],
) -> Recording:
    """Runs an episode of the benchmark and records it.

    Args:
        loaded: The policy and its processors.
        env: The environment, as of `benchmark_env`.
        task_id: Index of the task that the scene is drawn for.
        seed: Seed of the environment's reset.
        instruction: Instruction that the policy receives; empty for none.
        demonstrations: Demonstrations that the policy receives; empty for none.
    """
    frames: list[NDArray[np.uint8]] = []
    positions: list[list[NDArray[np.float64]]] = []
    placements: set[tuple[int, int]] = set()

    def record(*_: Any) -> None:
        image, numbers = env.render(), range(len(env.scene.bodies))
        assert image is not None
        frames.append(image)
        positions.append([env.scene.object_pose(n).position for n in numbers])
        placements.update((n, env.scene.container_of(n)) for n in numbers)

    episode = EpisodeSpec(task_id, 0, seed, instruction, task_id if demonstrations else -1)
    with torch.inference_mode():
        (info,) = run_episodes(loaded, [env], [episode], [demonstrations], record)
    return Recording(
        frames,
        getattr(loaded.policy, "localization", None),
        env.scene.layout,
        np.array([positions[0], positions[-1]]),
        frozenset(pair for pair in placements if pair[1] >= 0),
        info["grasped_object"],
    )


def find_demonstration(
    policy: TaskConditionedPolicy, task: Task, scene: SceneConfig, number: int = 0
) -> Demonstration:
    """Returns a demonstration of a task: the checkpoint's own, or one that the scripted expert records.

    Args:
        policy: The policy that the demonstration is for.
        task: The task.
        scene: Settings of the scenes.
        number: Number of the expert's demonstration, which draws its scene; with 0, the checkpoint's comes
            first.

    Raises:
        RuntimeError: The expert has failed too often.
    """
    config, bank = policy.config, policy.demonstrations
    if number == 0 and bank is not None and task.instruction in bank.rows:
        return bank.of_task(task.instruction)[0]
    whole = expert_demonstration(task.index, number, scene, config.cameras[0].rpartition(".")[-1])
    kept = kept_frames(0, len(whole.frames) - 1, config.n_demo_frames)
    has_grasp = config.gripper_index is not None and config.state_dim > 0
    return replace(
        whole,
        frames=resize_images(whole.frames[kept], config.image_size),
        pick_state=whole.pick_state if has_grasp else None,
        first_image=whole.frames[0],
        states=None,
        actions=None,
    )


def benchmark_env(config: Any, render_size: int) -> PickPlaceEnv:
    """Makes an environment with the image size and the control that a policy was trained on.

    Args:
        config: Configuration of the policy.
        render_size: Height and width of the frames of recordings, px.

    Raises:
        UserError: The policy is not one for the benchmark.
    """
    sizes = [feature.shape[-1] for feature in config.image_features.values()]
    control = control_of(config.image_features) or SceneConfig.control
    scene = SceneConfig(image_size=sizes[0], control=control) if sizes else SceneConfig()
    check_policy_fits(config, scene)
    return PickPlaceEnv(scene=scene, render_mode="rgb_array", render_size=render_size)


def load_conditioned(checkpoint: str | Path) -> LoadedPolicy:
    """Loads a policy that takes a demonstration or an instruction.

    Args:
        checkpoint: Folder of a policy; folder of a training run, whose last checkpoint is loaded; or id of a
            repository on the Hugging Face Hub.

    Raises:
        UserError: There is no checkpoint, or its policy is of another kind.
    """
    folder = Path(checkpoint)
    if folder.exists() or len(folder.parts) != 2:
        folder = find_checkpoints(folder)[-1].folder
    loaded = load_policy(folder)
    if not isinstance(loaded.policy, TaskConditionedPolicy):
        raise UserError(
            f"{checkpoint} holds a policy of the type {loaded.policy.config.type!r}, which takes no "
            "demonstrations. Name one of the type deltaco or deltaco_match."
        )
    return loaded
