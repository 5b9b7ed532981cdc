"""A vector environment that records how its episodes end, and whose instructions are given beforehand."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.vector import SyncVectorEnv
from lerobot.envs.utils import NEW_ROLLOUT_OPTION
from numpy.typing import NDArray


class RecordingVectorEnv:
    """Stands between LeRobot's rollout and a vector environment.

    Args:
        env: The vector environment.
        seeds: Seeds of the environments' resets, used as they are.
        instructions: Instructions that the policy receives, one for each environment.
        rendered: Indices of the environments whose scenes are rendered before the first step and after each.

    Attributes:
        infos: Info of each environment, after its last step.
        observed: First images that the policy received, (environments, H, W, 3); None unless rendered.
        scenes: Rendered images of each environment in `rendered`, (H, W, 3) each.
    """

    def __init__(
        self,
        env: SyncVectorEnv,
        seeds: Sequence[int],
        instructions: Sequence[str],
        rendered: Collection[int] = (),
    ) -> None:
        self._env = env
        self._seeds = list(seeds)
        self._instructions = tuple(instructions)
        self.infos: list[dict[str, Any]] = []
        self.observed: Any = None
        self.scenes: dict[int, list[NDArray[np.uint8]]] = {number: [] for number in rendered}

    def __getattr__(self, name: str) -> Any:
        return getattr(self._env, name)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Starts the episodes, of the seeds that were given before."""
        options = {**(options or {}), NEW_ROLLOUT_OPTION: True}
        observations, infos = self._env.reset(seed=list(self._seeds), options=options)
        self.infos = _of_each(infos, self._env.num_envs)
        if self.scenes:
            self.observed = observations["pixels"].copy()
        self._render()
        return observations, infos

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Does one action in each environment."""
        result = self._env.step(actions)
        self.infos = _of_each(result[-1], self._env.num_envs)
        self._render()
        return result

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Calls a method of each environment, or reads an attribute."""
        if name == "task_description":
            return self._instructions
        return self._env.call(name, *args, **kwargs)

    def _render(self) -> None:
        for number, images in self.scenes.items():
            image = self._env.envs[number].render()
            assert isinstance(image, np.ndarray)
            images.append(image)


def _of_each(infos: Mapping[str, Any], n_envs: int) -> list[dict[str, Any]]:
    """The infos of each environment; gymnasium gives arrays over all of them."""
    names = [name for name, values in infos.items() if isinstance(values, np.ndarray) and name[0] != "_"]
    return [{name: infos[name][index] for name in names} for index in range(n_envs)]
