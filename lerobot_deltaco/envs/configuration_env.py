"""`--env.type=deltaco`: the benchmark as LeRobot's training and evaluation see it."""

from collections import defaultdict
from dataclasses import dataclass
from typing import Any

from gymnasium.vector import VectorEnv
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_IMAGE, OBS_STATE

from gym_deltaco import CONTROL_FPS, ENV_ID, EPISODE_STEPS
from gym_deltaco.instructions import check_wording, choose_instructions
from gym_deltaco.layout import AMBIGUITIES
from gym_deltaco.object_sets import ADVERSARIAL_PROBABILITY, check_scenes, default_objects
from gym_deltaco.tasks import get_task, select_tasks
from lerobot_deltaco.common.checks import check_choices
from lerobot_deltaco.common.env_ranges import ENV_RANGES
from lerobot_deltaco.common.typed_fields import check_field_types, check_ranges
from lerobot_deltaco.envs.vector_env import make_task_vector_envs
from lerobot_deltaco.lerobot_internals import log_refusals


@EnvConfig.register_subclass("deltaco")
@dataclass
class DeltacoEnv(EnvConfig):
    """The 300 pick-and-place tasks of DeL-TaCo.

    LeRobot's evaluation reports a success rate for each kind of task: "name", "color" and "shape".

    Args:
        task: Tasks to run: a task set (scenario_a_test, scenario_a_train, scenario_a_validation,
            scenario_b_test, scenario_b_train, all, ...), or indices and ranges, such as 4,50-73. The paper's
            tasks are 0 to 299, those by color and shape 1000 to 1479.
        fps: Frames per second of the videos of episodes. The simulation has no frame rate of its own.
        episode_length: Number of steps after which an episode ends. The benchmark's is 30.
        ambiguity: "container" (the paper's scheme i: the instruction is clear, a demonstration leaves open
            which container is meant) or "object" (scheme ii: there are two of the object that the instruction
            asks for, and only a demonstration tells which is meant).
        image_size: Height and width of the policy's image, in pixels. The benchmark's is 48.
        render_size: Height and width of videos, in pixels. LeRobot records up to 10 episodes of every task,
            and a frame of 256 pixels takes several times as long to render as one of 96.
        objects: Objects that scenes are made of: "all", as in the paper; "scenario_a_train", without the 8
            test objects; "random:N", the 24 training objects and N - 24 random ones. None: "all", but
            "scenario_a_train" for the tasks scenario_a_clean_train.
        adversarial_probability: Probability that a distractor is drawn from the objects that share the
            target's color or shape: 0.6 in the paper's data, 0 in the authors' evaluation in training.
        adversarial_draw: Scope of a draw with that probability: "each", one distractor; or "scene", both
            distractors of a scene, as in the authors' code.
        instructions: CSV file with sentences for the tasks, as `deltaco-instructions` fetches or checks it.
            The instruction of an episode is then one of its task's, drawn by the episode's seed. By default,
            it is the benchmark's template.
        instructions_split: Split of the file's sentences: all; held_out, the last one of each task; or train,
            those that are held out for no task.
        instruction: A sentence of your own, in whatever words, that replaces the instruction of every task.
    """

    task: str = "scenario_a_test"
    fps: int = CONTROL_FPS
    episode_length: int = EPISODE_STEPS
    ambiguity: str = "container"
    image_size: int = 48
    render_size: int = 96
    objects: str | None = None
    adversarial_probability: float = ADVERSARIAL_PROBABILITY
    adversarial_draw: str = "each"
    instructions: str | None = None
    instructions_split: str = "all"
    instruction: str | None = None

    @log_refusals
    def __post_init__(self) -> None:
        check_field_types(self)
        task_ids = select_tasks(self.task)
        if self.objects is None:
            self.objects = default_objects(self.task)
        check_scenes(task_ids, self.objects, self.adversarial_probability, self.adversarial_draw)
        check_ranges(self, ENV_RANGES)
        check_choices(self, ambiguity=AMBIGUITIES)
        # The file is read when environments are made.
        check_wording(self.instructions, self.instructions_split, self.instruction)
        # The environment's names, and what LeRobot calls them in datasets and policies.
        self.features_map = {"pixels": OBS_IMAGE, "agent_pos": OBS_STATE, ACTION: ACTION}
        self.features = {
            "pixels": PolicyFeature(FeatureType.VISUAL, (self.image_size, self.image_size, 3)),
            "agent_pos": PolicyFeature(FeatureType.STATE, (10,)),
            ACTION: PolicyFeature(FeatureType.ACTION, (4,)),
        }

    @property
    def gym_id(self) -> str:
        """The environment's id, version included."""
        return ENV_ID

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments of `gymnasium.make`; the task is chosen later."""
        return {
            "ambiguity": self.ambiguity,
            "image_size": self.image_size,
            "render_mode": "rgb_array",
            "render_size": self.render_size,
            "max_episode_steps": self.episode_length,
            "objects": self.objects,
            "adversarial_probability": self.adversarial_probability,
            "adversarial_draw": self.adversarial_draw,
            "instructions": self._sentences(),
        }

    def _sentences(self) -> dict[int, tuple[str, ...]] | None:
        """The sentences of the tasks; None for the benchmark's templates."""
        return choose_instructions(
            select_tasks(self.task), self.instructions, self.instructions_split, self.instruction
        )

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, VectorEnv]]:
        """Makes a vector environment for each task. None has a simulator until it is first reset.

        Args:
            n_envs: Number of environments for each task.
            use_async_envs: Whether each environment runs in a process of its own, if there are several.

        Returns:
            {kind of task: {index of the task: vector environment}}.
        """
        task_ids = select_tasks(self.task)
        envs = make_task_vector_envs(
            self.gym_id, self.gym_kwargs, task_ids, n_envs, use_async_envs, fps=self.fps
        )
        groups: dict[str, dict[int, VectorEnv]] = defaultdict(dict)
        for task_id, env in zip(task_ids, envs, strict=True):
            groups[get_task(task_id).kind][task_id] = env
        return dict(groups)
