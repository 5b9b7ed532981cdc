"""DeL-TaCo for LeRobot's EnvHub: scenario B's 54 test tasks, whose colors and shapes are novel."""

from lerobot_deltaco.envs.env_hub import make_env_of_tasks


def make_env(n_envs=1, use_async_envs=False, cfg=None):
    """Makes a vector environment for each task: {kind of task: {index of the task: vector environment}}.

    Args:
        n_envs: Number of environments for each task.
        use_async_envs: Whether each environment runs in a process of its own, if there are several.
        cfg: Configuration with which LeRobot loads the environment, if any; its `task` selects other tasks.
    """
    return make_env_of_tasks("scenario_b_test", n_envs, use_async_envs, cfg)
