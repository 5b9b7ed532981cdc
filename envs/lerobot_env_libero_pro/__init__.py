"""LIBERO-PRO for LeRobot: `--env.type=libero_pro`. LeRobot imports the installed distribution itself."""

from lerobot_env_libero_pro.config import LiberoProConfig
from lerobot_env_libero_pro.env import LiberoProEnv
from lerobot_env_libero_pro.suites import SUITES, Task, load_tasks

__all__ = ["SUITES", "LiberoProConfig", "LiberoProEnv", "Task", "load_tasks"]
