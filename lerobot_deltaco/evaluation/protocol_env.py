"""The benchmark's environment with the scenes of the evaluation protocol, for LeRobot's evaluation."""

from __future__ import annotations

from functools import cache
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box, Dict
from lerobot.envs.utils import FreezeAfterEpisodeEnd
from numpy.typing import NDArray

from gym_deltaco.env import Observation, PickPlaceEnv
from gym_deltaco.scene_config import SceneConfig
from gym_deltaco.seeding import episode_seed
from lerobot_deltaco.evaluation.expert_demonstrations import expert_demonstration


class ProtocolEnv(PickPlaceEnv):
    """The environment with the scenes of the evaluation protocol.

    The seed of a reset is mapped to one that also depends on the task, and that no training scene has.

    Args:
        demonstrations: Whether every observation also has the key `demonstration`: the first and the last
            image of the protocol's demonstration of the task, (2, 3, H, W) uint8.
        arguments: Arguments of `PickPlaceEnv`.
    """

    def __init__(self, *, demonstrations: bool = False, **arguments: Any) -> None:
        super().__init__(**arguments)
        self._has_demonstrations = demonstrations
        if demonstrations:
            size = self.scene_config.image_size
            assert isinstance(self.observation_space, Dict)
            self.observation_space.spaces["demonstration"] = Box(0, 255, (2, 3, size, size), np.uint8)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Draws and builds a new scene. See `PickPlaceEnv.reset`."""
        if seed is not None:
            task_id = (options or {}).get("task_id", self.task.index)
            seed = episode_seed(0, "evaluation", task_id, 0, seed)
        return super().reset(seed=seed, options=options)

    def _observation(self) -> Observation:
        observation = super()._observation()
        if self._has_demonstrations:
            observation["demonstration"] = _demonstration_ends(self.task.index, self.scene_config).copy()
        return observation


@cache
def _demonstration_ends(task_id: int, scene: SceneConfig) -> NDArray[np.uint8]:
    return expert_demonstration(task_id, 0, scene).frames[[0, -1]].numpy()


class _FrozenAfterEpisodeEnd(FreezeAfterEpisodeEnd):
    """LeRobot's wrapper, but a reset with a seed also begins a new episode."""

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Draws a new scene, unless Gymnasium resets an episode that has ended."""
        if seed is not None:
            self._frozen = None
        return super().reset(seed=seed, options=options)


def make_protocol_env(**arguments: Any) -> gym.Env:
    """Makes the environment as LeRobot's evaluation needs it. The arguments are those of `ProtocolEnv`."""
    return _FrozenAfterEpisodeEnd(ProtocolEnv(**arguments))
