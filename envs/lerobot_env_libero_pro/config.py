"""`--env.type=libero_pro`."""

# No `from __future__ import annotations`: LeRobot's parser reads the annotations.

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gymnasium as gym
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import _LazyAsyncVectorEnv, freeze_after_episode_end
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE

from lerobot_env_libero_pro.cameras import CAMERAS
from lerobot_env_libero_pro.env import LiberoProEnv
from lerobot_env_libero_pro.scene import ACTION_NAMES, CONTROL_FPS, STATE_NAMES
from lerobot_env_libero_pro.suites import load_tasks


@EnvConfig.register_subclass("libero_pro")
@dataclass
class LiberoProConfig(EnvConfig):
    """`--env.type=libero_pro`: tasks of a suite of LIBERO or LIBERO-PRO.

    Args:
        suite: Name of the suite: libero_object, libero_spatial, libero_goal or libero_10; with _swap, _task,
            _object or _lan, what LIBERO-PRO makes of it; libero_object_temp_x0.1 to _y0.5.
        task_ids: Numbers of the tasks; all by default.
        image_size: Width and height of the images, pixels.
        layouts: `standard`, or `permuted`: see `LiberoProEnv`.
        stop_at_success: Whether an episode ends at the first success.
    """

    suite: str = "libero_object"
    task_ids: list[int] | None = None
    image_size: int = 256
    layouts: str = "standard"
    stop_at_success: bool = True
    fps: int = CONTROL_FPS
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        shape = (self.image_size, self.image_size, 3)
        self.features = {
            ACTION: PolicyFeature(FeatureType.ACTION, (len(ACTION_NAMES),)),
            "agent_pos": PolicyFeature(FeatureType.STATE, (len(STATE_NAMES),)),
            **{f"pixels/{name}": PolicyFeature(FeatureType.VISUAL, shape) for name in CAMERAS},
        }
        self.features_map = {
            ACTION: ACTION,
            "agent_pos": OBS_STATE,
            **{f"pixels/{name}": f"{OBS_IMAGES}.{name}" for name in CAMERAS},
        }

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Options of the environments."""
        return {
            "image_size": self.image_size,
            "layouts": self.layouts,
            "stop_at_success": self.stop_at_success,
        }

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """Returns the environments of each task. Their simulators are made when an episode begins."""
        envs = {}
        for task in load_tasks(self.suite, self.task_ids):
            make = partial(LiberoProEnv, task, **self.gym_kwargs)
            if use_async_envs and n_envs > 1:
                envs[task.id] = _LazyAsyncVectorEnv([make] * n_envs)
            else:
                envs[task.id] = gym.vector.SyncVectorEnv(
                    [freeze_after_episode_end(make)] * n_envs,
                    autoreset_mode=gym.vector.AutoresetMode.NEXT_STEP,
                )
        return {self.suite: envs}
