"""A task of LIBERO-PRO as a Gymnasium environment."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from lerobot_env_libero_pro.cameras import CAMERAS, Cameras
from lerobot_env_libero_pro.installation import versions
from lerobot_env_libero_pro.layouts import LAYOUTS, layout_rng, permuted_poses
from lerobot_env_libero_pro.scene import ACTION_NAMES, CONTROL_FPS, STATE_NAMES, Scene
from lerobot_env_libero_pro.suites import Task


class LiberoProEnv(gym.Env):
    """A task of LIBERO-PRO, by LIBERO's protocol.

    | observation | shape | |
    |---|---|---|
    | `pixels/image` | (size, size, 3), uint8 | agentview, mirrored as in LeRobot's datasets of LIBERO |
    | `pixels/image2` | (size, size, 3), uint8 | the wrist camera, likewise |
    | `agent_pos` | (8,), float32 | hand's position, m; axis times angle, rad; both fingers, m |

    An action, (7,) float32 within [-1, 1], is a displacement in units of 0.05 m, a rotation in units of 0.5
    rad, and the gripper, which closes at 1 and opens at -1; 20 a second.

    A reset puts the scene into one of the benchmark's 50 initial states, `seed` modulo 50, so that 50
    consecutive seeds meet each once, and lets it settle for ten steps. Resets with the same seed agree to the
    last bit.

    What a policy must not see is in `info`, after each reset and step, for an oracle or to count:

    | key | |
    |---|---|
    | `is_success` | whether the goal holds now |
    | `target`, `place` | names of the object and of where it goes; empty if there is none |
    | `target_position`, `place_position` | (3,), m, in the world; not a number if there is none |
    | `target_pixel`, `place_pixel` | (2,), column and row of these points in `image`, pixels |
    | `lifted` | name of the object that was lifted by 4 cm first; empty before |

    Args:
        task: The task, from `load_tasks`.
        image_size: Width and height of the images, pixels.
        layouts: `standard`: the initial states. `permuted`: the same objects at random places, kept apart, by
            the seed. No seed gives a layout of the training data.
        stop_at_success: Whether an episode ends at the first success, as in LeRobot. Otherwise it lasts until
            the horizon, so that success at the last step can be told from success at any.

    Attributes:
        draws: Whether steps draw new pictures. Otherwise, observations repeat the last ones, which saves most
            of the time where a policy no longer looks.

    Raises:
        ValueError: There are no such layouts.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": CONTROL_FPS}

    def __init__(
        self, task: Task, image_size: int = 256, layouts: str = "standard", stop_at_success: bool = True
    ) -> None:
        if layouts not in LAYOUTS:
            raise ValueError(f"There are no layouts {layouts!r}. Layouts: {', '.join(LAYOUTS)}.")
        self.render_mode = "rgb_array"
        self.task = task.name
        self.task_description = task.sentence
        self._max_episode_steps = task.horizon
        self._task = task
        self._image_size = image_size
        self._layouts = layouts
        self._stop_at_success = stop_at_success
        self.draws = True
        # The simulator is made on first use, in the process that uses it.
        self._scene: Scene | None = None
        self._cameras: Cameras | None = None
        picture = gym.spaces.Box(0, 255, (image_size, image_size, 3), np.uint8)
        state = gym.spaces.Box(-np.inf, np.inf, (len(STATE_NAMES),), np.float32)
        self.observation_space = gym.spaces.Dict(
            {"pixels": gym.spaces.Dict(dict.fromkeys(CAMERAS, picture)), "agent_pos": state}
        )
        self.action_space = gym.spaces.Box(-1, 1, (len(ACTION_NAMES),), np.float32)

    @property
    def versions(self) -> dict[str, str]:
        """Versions of MuJoCo and of the other packages that results depend on, for records."""
        return versions()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begins an episode. Without a seed, one is drawn."""
        super().reset(seed=seed)
        seed = int(self.np_random.integers(2**31)) if seed is None else seed
        if self._scene is None or self._cameras is None:
            self._scene = Scene(self._task)
            self._cameras = Cameras(self._scene.model, self._image_size)
            self._states = self._task.initial_states()
        state = self._states[seed % len(self._states)]
        self._scene.reset(seed, state)
        if self._layouts == "permuted":
            poses = permuted_poses(self._scene, layout_rng("evaluation", seed, self._task.id))
            self._scene.reset(seed, state, poses)
        self._cameras.restart()
        self._lifted, self._steps = "", 0
        self._pixels = self._draw()
        return self._observation(), self._info()

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Carries out an action. The reward is 1 while the goal holds."""
        scene = self.scene
        scene.step(np.clip(action, -1, 1))
        if self.draws:
            self._pixels = self._draw()
        self._steps += 1
        self._lifted = self._lifted or next(iter(scene.lifted()), "")
        info = self._info()
        is_success = info["is_success"]
        is_last = self._steps >= self._max_episode_steps
        return self._observation(), float(is_success), is_success and self._stop_at_success, is_last, info

    def render(self) -> np.ndarray:
        """Returns the picture of `image` as it was last observed."""
        assert self.scene
        return self._pixels["image"]

    def close(self) -> None:
        """Frees the simulator; the next reset makes it again."""
        if self._cameras is not None:
            self._cameras.close()
        if self._scene is not None:
            self._scene.close()
        self._scene = self._cameras = None

    @property
    def scene(self) -> Scene:
        """The scene of the episode, for a script.

        Raises:
            RuntimeError: There is no episode yet.
        """
        if self._scene is None:
            raise RuntimeError("The environment has no episode. Call `reset` first.")
        return self._scene

    def _draw(self) -> dict[str, np.ndarray]:
        assert self._cameras is not None
        return {name: self._cameras.draw(self.scene.data, name) for name in CAMERAS}

    def _observation(self) -> dict[str, Any]:
        return {"pixels": dict(self._pixels), "agent_pos": self.scene.robot_state()}

    def _info(self) -> dict[str, Any]:
        scene, cameras, task = self.scene, self._cameras, self._task
        assert cameras is not None
        info: dict[str, Any] = {"is_success": scene.is_success(), "lifted": self._lifted}
        for key, name in (("target", task.target), ("place", task.place)):
            position = np.full(3, np.nan) if name is None else scene.position(name)
            pixel = cameras.pixels(scene.data, "image", position[None])[0]
            info |= {key: name or "", f"{key}_position": position, f"{key}_pixel": pixel}
        return info
