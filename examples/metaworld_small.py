"""Tasks of Meta-World with small pictures, for `lerobot-eval`, and a recorder of their scripted policies.

    python examples/metaworld_small.py --root data/metaworld --episodes-per-task 25

docs/other_environments.md trains and evaluates with it.
"""

# No `from __future__ import annotations`: LeRobot's parser reads the annotations.

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import tyro
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.datasets import LeRobotDataset
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_IMAGE, OBS_STATE

# Tasks in which the gripper holds something.
TASKS = (
    "assembly-v3",
    "basketball-v3",
    "bin-picking-v3",
    "box-close-v3",
    "disassemble-v3",
    "hammer-v3",
    "peg-insert-side-v3",
    "pick-place-v3",
    "shelf-place-v3",
    "stick-push-v3",
)
RENDERED_SIZE = 192
CUT = (slice(32, 160), slice(64, 192))  # rows and columns in which objects and the gripper can be
IMAGE_SIZE = 128
REPEATS = 2  # steps of Meta-World, at 80 Hz, that an action lasts
EPISODE_LENGTH = 150  # actions
RELEASE_LENGTH = 6  # actions at the end of a recorded episode that open the gripper
FORCE = 0.7  # of the gripper: with 1, the ball slips, and with 0.6, the hammer
# LeRobot's parser loads modules for `--env.discover_packages_path` as packages.
__path__: list[str] = []


def make_metaworld(task: str) -> gym.Env:
    """Returns LeRobot's environment of a task, with small pictures and repeated actions."""
    import mujoco
    from lerobot.envs.metaworld import MetaworldEnv

    class Scene(gym.Wrapper):
        def __init__(self, env: gym.Env, camera: str) -> None:
            super().__init__(env)
            self.camera = camera
            self.numbers = np.zeros(0)  # what the scripted policies see
            # Without a GPU, these take nine tenths of the time of a picture.
            env.unwrapped.model.vis.quality.offsamples = 0
            self.renderer = mujoco.Renderer(env.unwrapped.model, RENDERED_SIZE, RENDERED_SIZE)
            self.renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
            self.renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False

        def seed(self, seed: int) -> None:
            self.unwrapped.seed(seed)

        def reset(self, **options: Any) -> tuple[np.ndarray, dict[str, Any]]:
            self.numbers, info = self.env.reset(**options)
            return self.numbers, info

        def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
            for _ in range(REPEATS):
                self.numbers, reward, terminated, truncated, info = self.env.step(action)
                if info["success"]:
                    break
            return self.numbers, reward, terminated, truncated, info

        def render(self) -> np.ndarray:
            self.renderer.update_scene(self.unwrapped.data, camera=self.camera)
            return self.renderer.render()

    class SmallMetaworld(MetaworldEnv):
        metadata = MetaworldEnv.metadata | {"render_fps": MetaworldEnv.metadata["render_fps"] // REPEATS}

        def __init__(self) -> None:
            sides = {"observation_width": IMAGE_SIZE, "observation_height": IMAGE_SIZE}
            super().__init__(task, obs_type="pixels_agent_pos", **sides)
            self._max_episode_steps = EPISODE_LENGTH

        def _ensure_env(self) -> None:
            if self._env is None:
                super()._ensure_env()
                self._env = Scene(self._env, self.camera_name)

        def _format_raw_obs(self, raw_obs: np.ndarray) -> dict[str, Any]:
            self.observation = super()._format_raw_obs(raw_obs)
            self.observation["pixels"] = self.observation["pixels"][CUT]
            return self.observation

        def render(self) -> np.ndarray:
            return self.observation["pixels"]

    return SmallMetaworld()


@EnvConfig.register_subclass("metaworld_small")
@dataclass
class MetaworldSmallConfig(EnvConfig):
    """`--env.type=metaworld_small`: tasks of Meta-World, separated by commas."""

    task: str | None = ",".join(TASKS)
    fps: int = 80 // REPEATS
    episode_length: int = EPISODE_LENGTH
    features: dict[str, PolicyFeature] = field(
        default_factory=lambda: {
            ACTION: PolicyFeature(FeatureType.ACTION, (4,)),
            "agent_pos": PolicyFeature(FeatureType.STATE, (4,)),
            "pixels": PolicyFeature(FeatureType.VISUAL, (IMAGE_SIZE, IMAGE_SIZE, 3)),
        }
    )
    features_map: dict[str, str] = field(
        default_factory=lambda: {ACTION: ACTION, "agent_pos": OBS_STATE, "pixels": OBS_IMAGE}
    )

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """No options."""
        return {}

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """Returns the environments of each task."""
        is_async = use_async_envs and n_envs > 1
        vector = gym.vector.AsyncVectorEnv if is_async else gym.vector.SyncVectorEnv
        assert self.task is not None
        return {task: {0: vector([partial(make_metaworld, task)] * n_envs)} for task in self.task.split(",")}


def scripted_episode(env: Any, seed: int) -> Iterator[tuple[dict[str, Any], np.ndarray, bool]]:
    """Yields each observation, the scripted policy's action, and whether the task is done.

    The gripper opens at the end, since `deltaco_match` learns from where it does.
    """
    observation, _ = env.reset(seed=seed)
    scene, opened, is_success = env._env, None, False
    for _ in range(EPISODE_LENGTH):
        action = np.clip(env.expert_policy.get_action(scene.numbers), -1, 1).astype(np.float32)
        # Each policy has forces of its own to open and to close.
        opened = action[3] if opened is None else opened
        action[3] = FORCE if action[3] > opened else -1
        numbers, _, _, _, info = scene.step(action)
        is_success = bool(info["success"])
        yield observation, action, is_success
        if is_success:
            break
        observation = env._format_raw_obs(numbers)
    for _ in range(RELEASE_LENGTH if is_success else 0):
        action = np.array([0, 0, 0, -1], np.float32)
        observation = env._format_raw_obs(scene.numbers)
        scene.step(action)
        yield observation, action, True


def main(root: Path, episodes_per_task: int = 25) -> None:
    """Records successful episodes of the scripted policies.

    Args:
        root: Folder of the dataset.
        episodes_per_task: Number of episodes of each task.
    """
    config = MetaworldSmallConfig()
    dataset = LeRobotDataset.create(
        "local/metaworld",
        fps=config.fps,
        root=root,
        features={
            OBS_IMAGE: {
                "dtype": "image",
                "shape": (IMAGE_SIZE, IMAGE_SIZE, 3),
                "names": ["height", "width", "channels"],
            },
            OBS_STATE: {"dtype": "float32", "shape": (4,), "names": ["x", "y", "z", "opening"]},
            ACTION: {"dtype": "float32", "shape": (4,), "names": ["dx", "dy", "dz", "gripper"]},
        },
    )
    for task in TASKS:
        env: Any = make_metaworld(task)
        recorded = seed = 0
        while recorded < episodes_per_task:
            succeeded = False
            for observation, action, is_success in scripted_episode(env, seed):
                succeeded |= is_success
                frame = {OBS_IMAGE: observation["pixels"], ACTION: action, "task": env.task_description}
                dataset.add_frame(frame | {OBS_STATE: observation["agent_pos"].astype(np.float32)})
            if succeeded:
                dataset.save_episode()
            else:
                dataset.clear_episode_buffer()
            recorded, seed = recorded + succeeded, seed + 1
        print(f"{task}: {recorded} of {seed} episodes")  # noqa: T201
        env.close()
    dataset.finalize()


if __name__ == "__main__":
    tyro.cli(main)
