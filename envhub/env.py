"""DeL-TaCo for LeRobot's EnvHub: scenario A's 102 test tasks, whose objects, colors and shapes are novel."""

from lerobot_deltaco.lerobot_env import DeltacoEnv


def make_env(n_envs=1, use_async_envs=False, cfg=None):
    """Makes a vector environment for each task: {kind of task: {index of the task: vector environment}}.

    Args:
        n_envs: Number of environments for each task.
        use_async_envs: Ignored: the environments of a task run in one process.
        cfg: Configuration with which LeRobot loads the environment, if any; its `task` selects other tasks.
    """
    task = getattr(cfg, "task", None) or "scenario_a_test"
    return DeltacoEnv(task=task).create_envs(n_envs)
