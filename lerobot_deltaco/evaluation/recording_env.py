"""A task's vector environment that records how its episodes end, and may give other instructions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_deltaco.envs.vector_env import TaskVectorEnv

# From the infos of the scenes of the environments to the instructions that the policy receives there.
SampleInstructions = Callable[[list[dict[str, Any]]], list[str]]


class RecordingVectorEnv:
    """Stands between LeRobot's rollout and the vector environment of a task.

    Args:
        env: The vector environment.
        seeds: Seeds of the environments' resets, used as they are.
        sample_instructions: Returns the instructions for drawn scenes; None takes the environment's.
        is_rendered: Whether the scenes are rendered before the first step and after each.

    Attributes:
        infos: Info of each environment, after its last step.
        instructions: Instruction of each environment.
        observed: First images that the policy received, (environments, H, W, 3); None unless rendered.
    """

    def __init__(
        self,
        env: TaskVectorEnv,
        seeds: Sequence[int],
        sample_instructions: SampleInstructions | None = None,
        is_rendered: bool = False,
    ) -> None:
        self._env = env
        self._seeds = list(seeds)
        self._sample_instructions = sample_instructions
        self._is_rendered = is_rendered
        self._rendered: list[tuple[NDArray[np.uint8], ...]] = []
        self.infos: list[dict[str, Any]] = []
        self.instructions: list[str] = []
        self.observed: Any = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._env, name)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Starts the episodes, of the seeds that were given before."""
        observations, infos = self._env.reset_with_seeds(self._seeds, options)
        self.infos = _of_each(infos, self._env.num_envs)
        if self._sample_instructions is None:
            self.instructions = list(self._env.call("task_description"))
        else:
            self.instructions = self._sample_instructions(self.infos)
        if self._is_rendered:
            self.observed = observations["pixels"].copy()
            self._rendered = [self._env.render()]
        return observations, infos

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Does one action in each environment."""
        result = self._env.step(actions)
        self.infos = _of_each(result[-1], self._env.num_envs)
        if self._is_rendered:
            self._rendered.append(self._env.render())
        return result

    def scenes(self, index: int) -> list[NDArray[np.uint8]]:
        """The rendered images of an environment, (H, W, 3) each."""
        return [images[index] for images in self._rendered]

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Calls a method of each environment, or reads an attribute."""
        if name == "task_description":
            return tuple(self.instructions)
        return self._env.call(name, *args, **kwargs)


def _of_each(infos: Mapping[str, Any], n_envs: int) -> list[dict[str, Any]]:
    """The infos of each environment; gymnasium gives arrays over all of them."""
    names = [name for name, values in infos.items() if isinstance(values, np.ndarray) and name[0] != "_"]
    return [{name: infos[name][index] for name in names} for index in range(n_envs)]
