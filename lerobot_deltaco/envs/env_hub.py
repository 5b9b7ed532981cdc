"""`make_env` of the files in `envhub/`, which LeRobot loads from a repository on the Hugging Face Hub."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from gymnasium.vector import VectorEnv
from lerobot.envs import EnvConfig

from lerobot_deltaco.envs.configuration_env import DeltacoEnv

# Options of `DeltacoEnv` that the config of another type may have too, with the same meaning.
_SHARED_OPTIONS = ("task",)


def make_env_of_tasks(
    tasks: str, n_envs: int = 1, use_async_envs: bool = False, cfg: EnvConfig | None = None
) -> dict[str, dict[int, VectorEnv]]:
    """Makes the vector environments of tasks, as LeRobot's EnvHub expects them.

    Args:
        tasks: Selection of tasks, as `--env.task` takes it; `cfg.task` takes precedence if it is set.
        n_envs: Number of environments for each task.
        use_async_envs: Whether each environment runs in a process of its own, if there are several.
        cfg: Configuration with which LeRobot loads the environment, if any. Of a `DeltacoEnv`, all options
            are used; of another type, `task` alone.

    Returns:
        {kind of task: {index of the task: vector environment}}.

    Raises:
        ValueError: `n_envs` is less than 1, or an option is not valid; the message says what is.
    """
    if n_envs < 1:
        raise ValueError(f"`n_envs` must be at least 1. Got {n_envs}.")
    if isinstance(cfg, DeltacoEnv):
        names: tuple[str, ...] = tuple(field.name for field in fields(DeltacoEnv) if field.init)
    else:
        names = _SHARED_OPTIONS
    options: dict[str, Any] = {name: getattr(cfg, name, None) for name in names}
    options = {name: value for name, value in options.items() if value is not None}
    return DeltacoEnv(**{"task": tasks, **options}).create_envs(n_envs, use_async_envs)
