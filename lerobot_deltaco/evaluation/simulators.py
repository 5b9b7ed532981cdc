"""Simulators that the batches of an evaluation take turns to use, whatever their tasks."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import gymnasium as gym
from gymnasium.vector import SyncVectorEnv

from gym_deltaco import ENV_ID
from gym_deltaco.tasks import get_task
from lerobot_deltaco.envs.vector_env import make_single_env, make_sync_vector_env


class Simulators:
    """Environments for any tasks, as many as the largest batch has needed so far.

    Args:
        env_kwargs: Further arguments of `gymnasium.make`.
    """

    def __init__(self, env_kwargs: dict[str, Any]) -> None:
        self._env_kwargs = env_kwargs
        self._envs: list[gym.Env] = []
        self._vector_envs: dict[int, SyncVectorEnv] = {}  # by the number of their environments

    def vector_env(self, task_ids: Sequence[int]) -> SyncVectorEnv:
        """A vector environment whose next reset starts episodes of tasks.

        It shares its simulators with all others of this object: one of them is used at a time.

        Args:
            task_ids: Index of the task of each environment.
        """
        size = len(task_ids)
        while len(self._envs) < size:
            self._envs.append(make_single_env(ENV_ID, self._env_kwargs))
        if size not in self._vector_envs:
            self._vector_envs[size] = make_sync_vector_env([partial(_same, env) for env in self._envs[:size]])
        vector_env = self._vector_envs[size]
        # The options of a reset would be the same for all environments.
        vector_env.set_attr("task", [get_task(task_id) for task_id in task_ids])
        return vector_env

    def close(self) -> None:
        """Closes all environments."""
        for vector_env in self._vector_envs.values():
            vector_env.close()
        for env in self._envs:
            env.close()
        self._envs, self._vector_envs = [], {}


def _same(env: gym.Env) -> gym.Env:
    return env
