"""`--env.type=deltaco`: the benchmark as an environment of LeRobot.

Every command of LeRobot imports this module. It imports the benchmark's settings and tasks; the simulator is
imported where environments are made.
"""

# No `from __future__ import annotations`: LeRobot's parser reads the annotations.

import json
import logging
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from types import MappingProxyType
from typing import Any

from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.envs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_STATE

from gym_deltaco import ENV_ID
from gym_deltaco.control import control_of
from gym_deltaco.scene_config import SceneConfig
from gym_deltaco.tasks import get_task, select_tasks
from lerobot_deltaco.errors import UserError

logger = logging.getLogger(__name__)

NO_RENAMING: Mapping[str, str] = MappingProxyType({})


@EnvConfig.register_subclass("deltaco")
@dataclass
class DeltacoEnv(EnvConfig):
    """The 300 pick-and-place tasks of DeL-TaCo.

    LeRobot's evaluation reports a success rate for each kind of task: "name", "color" and "shape". Its seed s
    gives the scene of trial s - 1000 of `deltaco evaluate`, a different one for each task.

    Args:
        task: Tasks to run: a task set (scenario_a_test, scenario_a_train, scenario_a_validation,
            scenario_b_test, scenario_b_train, all, ...), or indices and ranges, such as 4,50-73.
        fps: Frames per second of the videos of episodes; 0 for that of the control, 24 or 30.
        scene: Settings of the scenes, such as --env.scene.ambiguity=object or --env.scene.control=joints.
        render_size: Height and width of videos, px. LeRobot records up to 10 episodes of every task, and a
            frame of 256 pixels takes several times as long to render as one of 96.
        paraphrases: CSV file with sentences for the tasks. The instruction of an episode is then one of its
            task's, drawn by the episode's seed. By default, it is the benchmark's template.
        paraphrases_split: Split of the file's sentences: all; held_out, the last one of each task; or train,
            those that are not held out for any task.
        instruction: A sentence that replaces the instruction of every task.
        demonstrations: Whether observations contain a demonstration of the task, as `ProtocolEnv` has it.
    """

    task: str = "scenario_a_test"
    fps: int = 0
    scene: SceneConfig = field(default_factory=SceneConfig)
    render_size: int = 96
    paraphrases: str | None = None
    paraphrases_split: str = "all"
    instruction: str | None = None
    demonstrations: bool = False

    def __post_init__(self) -> None:
        try:
            task_ids = select_tasks(self.task)
            if any(get_task(task_id).object.index is not None for task_id in task_ids):
                raise UserError(
                    "Only a demonstration shows which object these tasks ask for, and LeRobot's evaluation "
                    "looks for it by the sentence. Evaluate them with `deltaco evaluate`."
                )
            self.scene = self.scene.for_tasks(self.task)
            self.scene.check_tasks(task_ids)
            if self.max_parallel_tasks != 1:
                raise UserError(
                    "`max_parallel_tasks` must be 1: a policy holds the task of one episode. To use more "
                    f"cores, evaluate with `deltaco evaluate`. Got {self.max_parallel_tasks}."
                )
        except ValueError as error:
            # LeRobot's parser only says that the class cannot be instantiated.
            logger.error("%s", error)
            raise
        # The environment's names, and what LeRobot calls them in datasets and policies.
        control, size = self.scene.interface, self.scene.image_size
        self.fps = self.fps or control.fps
        images = [f"pixels/{name}" for name in control.cameras] or ["pixels"]
        self.features_map = {
            **dict(zip(images, control.camera_keys, strict=True)),
            "agent_pos": OBS_STATE,
            ACTION: ACTION,
        }
        self.features = {
            **dict.fromkeys(images, PolicyFeature(FeatureType.VISUAL, (size, size, 3))),
            "agent_pos": PolicyFeature(FeatureType.STATE, (len(control.state_names),)),
            ACTION: PolicyFeature(FeatureType.ACTION, (len(control.action_names),)),
        }

    @property
    def gym_id(self) -> str:
        """The environment's id, version included."""
        return ENV_ID

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments of the environment; the task is set later."""
        from gym_deltaco.paraphrases import choose_instructions

        return {
            "scene": self.scene,
            "render_mode": "rgb_array",
            "render_size": self.render_size,
            "instructions": choose_instructions(
                select_tasks(self.task), self.paraphrases, self.paraphrases_split, self.instruction
            ),
            "demonstrations": self.demonstrations,
        }

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, VectorEnv]]:
        """Makes a vector environment for each task. Its simulators start at the first reset.

        Args:
            n_envs: Number of environments for each task.
            use_async_envs: Ignored: the environments of a task run in this process, one after another.

        Returns:
            {kind of task: {index of the task: vector environment}}.
        """
        from lerobot_deltaco.evaluation.protocol_env import make_protocol_env

        arguments = self.gym_kwargs
        groups: dict[str, dict[int, VectorEnv]] = defaultdict(dict)
        for task_id in select_tasks(self.task):
            make = partial(make_protocol_env, task_id=task_id, **arguments)
            # With LeRobot's wrapper and this autoreset, its metric counts no step of a further episode.
            env = SyncVectorEnv([make] * n_envs, autoreset_mode=AutoresetMode.NEXT_STEP)
            env.metadata = {**env.metadata, "render_fps": self.fps}
            groups[get_task(task_id).kind][task_id] = env
        return dict(groups)


def check_policy_fits(
    policy: PreTrainedConfig, scene: SceneConfig, rename_map: Mapping[str, str] = NO_RENAMING
) -> None:
    """Checks that a policy was trained on the environment's images, state and action.

    Without this check, a policy could act on images of another size than it was trained on, since LeRobot and
    the policy scale them.

    Args:
        policy: Configuration of a policy of any type.
        scene: Settings of the environment's scenes.
        rename_map: Names under which the policy knows the environment's observations, by the environment's
            names, as LeRobot's `--rename_map` takes them.

    Raises:
        ValueError: The policy was trained on something else.
    """
    control, cameras = scene.interface, list(policy.image_features)
    trained_for = control_of(cameras)
    if trained_for not in (None, scene.control):
        raise UserError(
            f"The policy was trained with the control {trained_for!r}, but that of the environment is "
            f"{scene.control!r}. Set `scene.control` to {trained_for}."
        )
    available = [rename_map.get(name, name) for name in control.camera_keys]
    shared = [camera for camera in available if camera in cameras]
    # Vision-language-action models (which have this option) leave out cameras that are not there, and keep
    # the image size of the model that they were fine-tuned from, whatever the dataset's was.
    can_lack_cameras = hasattr(policy, "empty_cameras")
    if not shared or (len(shared) < len(cameras) and not can_lack_cameras):
        example = json.dumps({control.camera_keys[0]: cameras[0]}) if cameras else "{}"
        raise UserError(
            f"The policy was trained on images of {', '.join(cameras) or 'no camera'}, but the benchmark's "
            f"environment has {', '.join(available)} alone. Evaluate it where it was trained for, or, if it "
            f"is the same camera, rename it: --rename_map='{example}'."
        )
    trained_on = policy.image_features[shared[0]].shape[-1]
    if trained_on != scene.image_size and not can_lack_cameras:
        raise UserError(
            f"The policy was trained on images of {trained_on} pixels, but those of the environment have "
            f"{scene.image_size}. Set `scene.image_size` to {trained_on}."
        )
    # Models that pad the state accept any that is short enough.
    state = None if hasattr(policy, "max_state_dim") else policy.robot_state_feature
    sizes = (
        (OBS_STATE, state, len(control.state_names)),
        (ACTION, policy.action_feature, len(control.action_names)),
    )
    for name, feature, size in sizes:
        if feature is not None and tuple(feature.shape) != (size,):
            raise UserError(
                f"The policy was trained on `{name}` of the shape {tuple(feature.shape)}, but that of the "
                f"benchmark's environment is ({size},). Evaluate it where it was trained for."
            )
