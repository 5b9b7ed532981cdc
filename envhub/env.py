"""DeL-TaCo for LeRobot's EnvHub; `cfg` chooses the tasks, which are scenario A's test tasks by default."""

from lerobot_deltaco.lerobot_env import DeltacoEnv


def make_env(n_envs=1, use_async_envs=False, cfg=None):
    """Makes a vector environment for each task: {kind of task: {index of the task: vector environment}}.

    Args:
        n_envs: Number of environments for each task.
        use_async_envs: Ignored: the environments of a task run in this process.
        cfg: A `DeltacoEnv`, for other tasks or scenes.
    """
    config = cfg if isinstance(cfg, DeltacoEnv) else DeltacoEnv()
    return config.create_envs(n_envs, use_async_envs)
