"""One vector environment for each task, all of them served by as few simulators as are in use.

LeRobot asks for the vector environments of all tasks beforehand, runs one task after the other (or
`max_parallel_tasks` at a time, in threads) and closes a task's environment when the task is done. A
simulator costs 50 ms and about 50 MB, and one in a process of its own costs more. So a task owns none: it
borrows simulators at its first `reset` and hands them back when it is closed, for the next task to use.
"""

from __future__ import annotations

import multiprocessing
import sys
import threading
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import gymnasium as gym
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.vector.utils import batch_space
from lerobot.envs.utils import NEW_ROLLOUT_OPTION, FreezeAfterEpisodeEnd

import gym_deltaco  # noqa: F401  (registers the environment, in worker processes too)
from gym_deltaco.seeding import episode_seed

# Worker processes run the main module again, which is one of these commands: that takes each of them 10 s, or
# nothing if the process that they are forked from has imported it once.
_LEROBOT_COMMANDS = ("lerobot.scripts.lerobot_train", "lerobot.scripts.lerobot_eval")


class VectorEnvPool:
    """Vector environments that tasks take turns to use.

    It holds as many as were ever in use at the same time, and closes them when the last of its tasks is
    closed. It may be used from several threads.

    Args:
        make_env: Function that makes an environment for any task: `reset(options={"task_id": ...})`.
        n_envs: Number of environments in each vector environment.
        use_async_envs: Whether each environment runs in a process of its own, if there are several.
    """

    def __init__(self, make_env: Callable[[], gym.Env], n_envs: int, use_async_envs: bool = False):
        self.n_envs = n_envs
        self._make_env = make_env
        self._use_async_envs = use_async_envs and n_envs > 1
        self._idle: list[VectorEnv] = []
        self._n_tasks = 0
        # Reentrant, since the garbage collector may close a forgotten task in the middle of any statement.
        self._lock = threading.RLock()

    def add_task(self) -> None:
        """Counts one more task; each has to call `remove_task` once."""
        with self._lock:
            self._n_tasks += 1

    def acquire(self) -> VectorEnv:
        """A vector environment that no other task uses until `remove_task` returns it."""
        with self._lock:
            if self._idle:
                return self._idle.pop()
        return self._make()

    def remove_task(self, acquired: VectorEnv | None = None) -> None:
        """Removes one task, which returns what it acquired. The last one closes all vector environments."""
        with self._lock:
            if acquired is not None:
                self._idle.append(acquired)
            self._n_tasks -= 1
            unused, self._idle = (self._idle, []) if self._n_tasks == 0 else ([], self._idle)
        for env in unused:
            env.close()

    def _make(self) -> VectorEnv:
        env_fns = [self._make_env] * self.n_envs
        if not self._use_async_envs:
            return make_sync_vector_env(env_fns)
        # Has no effect, and needs none, once the process that workers are forked from is running.
        commands = [name for name in _LEROBOT_COMMANDS if name in sys.modules]
        multiprocessing.set_forkserver_preload([*commands, __name__])
        return AsyncVectorEnv(env_fns, autoreset_mode=AutoresetMode.NEXT_STEP, context="forkserver")


class TaskVectorEnv(VectorEnv):
    """The vector environment of one task; it has simulators from its first `reset` until it is closed.

    LeRobot resets every task with the same seeds. Here, seed `s` becomes
    `episode_seed(s, "evaluation", task_id, 0)`, so that the scenes differ between tasks and never coincide
    with those of training data. (Trial i of a task still has LeRobot's seed + i: two evaluations share scenes
    if their seeds are fewer apart than their trials.)

    Args:
        task_id: Index of the task, 0..299, or 1000..1479 for those by color and shape.
        pool: Pool of the vector environments that run the task.
        example: Environment like those of the pool. Only its spaces and metadata are read.
        fps: Frames per second at which LeRobot's videos of episodes play.
    """

    def __init__(self, task_id: int, pool: VectorEnvPool, example: gym.Env, fps: int):
        self.task_id = task_id
        self.num_envs = pool.n_envs
        self.metadata = {
            **example.metadata,
            "render_fps": fps,
            "autoreset_mode": AutoresetMode.NEXT_STEP,
        }
        self.render_mode = example.render_mode
        self.single_observation_space = example.observation_space
        self.single_action_space = example.action_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._running: VectorEnv | None = None
        self._pool = pool
        pool.add_task()

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Starts an episode of the task in every environment.

        Args:
            seed: The seed of the first environment (each next one has the next seed), or all of them.
            options: Passed on to the environments.
        """
        if self._running is None and not self.closed:
            self._running = self._pool.acquire()
        options = {**(options or {}), NEW_ROLLOUT_OPTION: True, "task_id": self.task_id}
        return self._call_running("reset", seed=self._episode_seeds(seed), options=options)

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Does one action, of shape (4,), in each environment."""
        return self._call_running("step", actions)

    def render(self) -> tuple[Any, ...]:
        """One image of each environment."""
        return self._call_running("call", "render")

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Calls a method of each environment, or reads an attribute."""
        return self._call_running("call", name, *args, **kwargs)

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Reads an attribute of each environment."""
        return self._call_running("get_attr", name)

    def close_extras(self) -> None:
        """Hands the simulators back. `close` calls this once."""
        running, self._running = self._running, None
        self._pool.remove_task(running)

    def _call_running(self, method: str, *args: Any, **kwargs: Any) -> Any:
        if self.closed:
            raise gym.error.ClosedEnvironmentError(
                f"The environment of task {self.task_id} is closed. Make a new one with `create_envs`."
            )
        if self._running is None:
            raise gym.error.ResetNeeded(
                f"The environment of task {self.task_id} is not running. Call `reset()` first."
            )
        try:
            return getattr(self._running, method)(*args, **kwargs)
        except Exception:
            if isinstance(self._running, AsyncVectorEnv):
                # Its process ended with the error. The next reset starts afresh.
                self._running.close()
                self._running = None
            raise

    def _episode_seeds(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        if seed is None:
            return [None] * self.num_envs
        seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, int) else seed
        return [None if s is None else episode_seed(int(s), "evaluation", self.task_id, 0) for s in seeds]


def make_task_vector_envs(
    env_id: str,
    env_kwargs: dict[str, Any],
    task_ids: Sequence[int],
    n_envs: int,
    use_async_envs: bool,
    fps: int,
) -> list[TaskVectorEnv]:
    """Makes the vector environments of tasks, which share their simulators. No simulator is started yet.

    Args:
        env_id: Id of the environment, for `gymnasium.make`.
        env_kwargs: Further arguments of `gymnasium.make`.
        task_ids: Indices of the tasks.
        n_envs: Number of environments for each task.
        use_async_envs: Whether each environment runs in a process of its own, if there are several.
        fps: Frames per second at which LeRobot's videos of episodes play.
    """
    make_env = partial(make_single_env, env_id, env_kwargs)
    pool = VectorEnvPool(make_env, n_envs, use_async_envs)
    example = make_env()
    try:
        return [TaskVectorEnv(task_id, pool, example, fps) for task_id in task_ids]
    finally:
        example.close()


def make_single_env(env_id: str, env_kwargs: dict[str, Any]) -> gym.Env:
    """Makes an environment that stays in its last step once the episode has ended, for LeRobot's metric.

    The mask of that metric includes the step after an episode's end. With LeRobot's wrapper and the next-step
    autoreset, no other episode is counted there.

    Args:
        env_id: Id of the environment, for `gymnasium.make`.
        env_kwargs: Further arguments of `gymnasium.make`.
    """
    env = gym.make(env_id, disable_env_checker=True, **env_kwargs)
    return FreezeAfterEpisodeEnd(env)


def make_sync_vector_env(env_fns: Sequence[Callable[[], gym.Env]]) -> SyncVectorEnv:
    """Makes a vector environment in this process, with the autoreset that `make_single_env` needs."""
    return SyncVectorEnv(env_fns, autoreset_mode=AutoresetMode.NEXT_STEP)
