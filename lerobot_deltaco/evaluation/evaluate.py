"""Runs an evaluation set: some episodes of each task, with LeRobot's rollout, and every outcome kept."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from importlib.metadata import version
from itertools import chain
from typing import Any, NamedTuple, Self
from unittest.mock import patch

import numpy as np
import torch
from lerobot.policies import PreTrainedPolicy
from lerobot.processor import PolicyProcessorPipeline
from lerobot.scripts.lerobot_eval import rollout
from lerobot.utils.random_utils import seeded_context
from numpy.typing import NDArray

from gym_deltaco import ENV_ID
from gym_deltaco.tasks import select_tasks
from lerobot_deltaco.envs.configuration_env import DeltacoEnv
from lerobot_deltaco.envs.policy_fit import NO_RENAMING, check_policy_fits
from lerobot_deltaco.evaluation.demonstration_checks import check_enough_demonstrations, policy_kind
from lerobot_deltaco.evaluation.episodes import Episode, draw_episodes, split_into_batches
from lerobot_deltaco.evaluation.plan import EvaluationPlan
from lerobot_deltaco.evaluation.record import BENCHMARK, EpisodeResult
from lerobot_deltaco.evaluation.recording_env import RecordingVectorEnv
from lerobot_deltaco.evaluation.simulators import Simulators
from lerobot_deltaco.modeling_deltaco import DeltacoPolicy
from lerobot_deltaco.policy.demonstrations import Demonstrated
from lerobot_deltaco.policy.goals.conditioning import FoundGoals
from lerobot_deltaco.policy.task_conditioning import DemonstrationTurn

PACKAGES = ("lerobot_policy_deltaco", "lerobot", "torch", "gymnasium", "numpy", "pybullet")


class EpisodeImages(NamedTuple):
    """Images of an episode.

    Attributes:
        scenes: The scene, rendered for people before the first step and after each, (H, W, 3) each.
        observed: First image that the policy received, (H, W, 3).
        demonstration: First and last image of the (first) demonstration, (2, H, W, 3); None without one.
        goals: Goals that the policy found, of this episode alone; None if it finds none.
    """

    scenes: list[NDArray[np.uint8]]
    observed: NDArray[np.uint8]
    demonstration: NDArray[np.uint8] | None
    goals: FoundGoals | None


class EpisodeOutcome(NamedTuple):
    """An episode, with what its record does not have.

    Attributes:
        result: Episode as it is recorded.
        sum_reward: Sum of the rewards.
        max_reward: Greatest of the rewards.
        images: Images of the episode; None unless they were asked for.
    """

    result: EpisodeResult
    sum_reward: float
    max_reward: float
    images: EpisodeImages | None = None


def evaluate(
    policy: PreTrainedPolicy,
    preprocessor: PolicyProcessorPipeline,
    postprocessor: PolicyProcessorPipeline,
    plan: EvaluationPlan,
    set_number: int,
) -> list[EpisodeResult]:
    """Runs an evaluation set in this process.

    Args:
        policy: In evaluation mode, on its device.
        preprocessor: Preprocessor of the policy.
        postprocessor: Postprocessor of the policy.
        plan: Episodes to run.
        set_number: Number of the evaluation set, usually the training step. Different sets share no scene,
            unless the plan names a `scene_set`.

    Returns:
        The episodes, task after task.

    Raises:
        ValueError: A task has no demonstration, or the policy is not one for this environment.
    """
    with Evaluation(policy, preprocessor, postprocessor, plan, set_number) as evaluation:
        outcomes = chain.from_iterable(map(evaluation.run, range(len(evaluation.batches))))
        return [outcome.result for outcome in evaluation.in_task_order(outcomes)]


class Evaluation:
    """An evaluation set, whose batches may be run in any order and in any process, with the same outcomes.

    Args:
        policy: In evaluation mode, on its device.
        preprocessor: Preprocessor of the policy.
        postprocessor: Postprocessor of the policy.
        plan: Episodes to run.
        set_number: Number of the evaluation set, usually the training step.
        render_size: Height and width of the images that are rendered, px; None renders none.

    Attributes:
        batches: Episodes of the set.

    Raises:
        ValueError: The policy is not one for this environment, or the plan not one for this policy.
    """

    def __init__(
        self,
        policy: PreTrainedPolicy,
        preprocessor: PolicyProcessorPipeline,
        postprocessor: PolicyProcessorPipeline,
        plan: EvaluationPlan,
        set_number: int,
        render_size: int | None = None,
    ) -> None:
        self.policy, self._preprocessor, self._postprocessor = policy, preprocessor, postprocessor
        self.plan, self.set_number = plan, set_number
        self._deltaco = policy if isinstance(policy, DeltacoPolicy) else None
        env_config = DeltacoEnv(
            task=plan.tasks,
            ambiguity=plan.ambiguity,
            image_size=plan.image_size,
            episode_length=plan.episode_length,
            objects=plan.objects,
            adversarial_probability=plan.adversarial_probability,
            adversarial_draw=plan.adversarial_draw,
        )
        check_policy_fits(policy.config, env_config, _rename_map(preprocessor))
        if plan.counterfactual == "demo" and not self._uses_demo:
            raise ValueError(
                f"This policy (`{policy_kind(policy)}`) takes no demonstrations, so that none can be another "
                "task's. Evaluate it with --counterfactual instruction or none."
            )
        demonstrated: Collection[str] | None = None
        if self._deltaco is not None:
            check_enough_demonstrations(self._deltaco, select_tasks(plan.tasks))
            if self._deltaco.eval_demonstrations is not None:
                demonstrated = self._deltaco.eval_demonstrations.rows
        self.batches = split_into_batches(draw_episodes(plan, set_number, demonstrated))
        env_kwargs = {**env_config.gym_kwargs, "render_mode": None if render_size is None else "rgb_array"}
        if render_size is not None:
            env_kwargs["render_size"] = render_size
        self._simulators = Simulators(env_kwargs)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Closes the environments of this process."""
        self._simulators.close()

    def run(self, number: int, rendered: Collection[Episode] = ()) -> list[EpisodeOutcome]:
        """Runs the episodes of a batch.

        Args:
            number: Number of the batch.
            rendered: Episodes of the batch of which images are rendered; needs `render_size`.

        Raises:
            ValueError: A task has no demonstration.
        """
        batch = self.batches[number]
        with _one_thread(self.policy.config.device), torch.no_grad(), ExitStack() as stack:
            noted: list[FoundGoals | None] = []
            if self._deltaco is not None:
                turns = [DemonstrationTurn(episode.demonstrated, episode.trial) for episode in batch]
                stack.enter_context(self._deltaco.with_turns(turns))
                if rendered:
                    noted = stack.enter_context(_noted_goals(self._deltaco))
            else:
                # Policies that draw, such as diffusion policies, draw for a whole batch, by its first seed.
                stack.enter_context(seeded_context(batch[0].seed % 2**32))
                stack.enter_context(_autocast(self.policy.config))
            return self._run_batch(batch, rendered, noted)

    def in_task_order(self, outcomes: Iterable[EpisodeOutcome]) -> list[EpisodeOutcome]:
        """Sorts episodes by task, in the plan's order, and by trial."""
        places = {task_id: place for place, task_id in enumerate(select_tasks(self.plan.tasks))}
        return sorted(outcomes, key=lambda outcome: (places[outcome.result.task_id], outcome.result.trial))

    def _run_batch(
        self, batch: Sequence[Episode], rendered: Collection[Episode], noted: Sequence[FoundGoals | None]
    ) -> list[EpisodeOutcome]:
        env = self._simulators.vector_env([episode.task_id for episode in batch])
        seeds = [episode.seed for episode in batch]
        recorded = RecordingVectorEnv(
            env,
            seeds,
            [episode.instruction for episode in batch],
            [number for number, episode in enumerate(batch) if episode in rendered],
        )
        identity: PolicyProcessorPipeline = PolicyProcessorPipeline(steps=[])
        data = rollout(
            recorded, self.policy, identity, identity, self._preprocessor, self._postprocessor, seeds
        )
        outcomes = []
        for index, episode in enumerate(batch):
            demonstrated = [] if self._deltaco is None else self._deltaco.demonstrated(index)
            images = None
            if index in recorded.scenes:
                ends = self._demonstration_ends(demonstrated)
                goals = None if not noted or noted[0] is None else noted[0].of_sample(index)
                images = EpisodeImages(recorded.scenes[index], recorded.observed[index], ends, goals)
            rewards = data["reward"][index]
            result = _result(episode, recorded.infos[index], self._uses_demo, demonstrated)
            outcomes.append(EpisodeOutcome(result, float(rewards.sum()), float(rewards.max()), images))
        return outcomes

    @property
    def _uses_demo(self) -> bool:
        if self._deltaco is None or self._deltaco.config.leave_out == "demo":
            return False
        return self._deltaco.config.uses_demo

    def _demonstration_ends(self, demonstrated: Sequence[Demonstrated]) -> NDArray[np.uint8] | None:
        """First and last image of the first of an episode's demonstrations, (2, H, W, 3)."""
        if not demonstrated or self._deltaco is None or self._deltaco.eval_demonstrations is None:
            return None
        known = self._deltaco.eval_demonstrations
        row = int(known.episode_rows(torch.tensor([demonstrated[0].episode], device=known.frames.device)))
        return known.frames[row][[0, -1]].permute(0, 2, 3, 1).cpu().numpy()


def versions(policy: PreTrainedPolicy) -> dict[str, str]:
    """What an evaluation depends on."""
    found = {BENCHMARK: ENV_ID, **{name: version(name) for name in PACKAGES}}
    if isinstance(policy, DeltacoPolicy):
        found["language_encoder"] = policy.config.language_encoder
    return found


def _rename_map(preprocessor: PolicyProcessorPipeline) -> Mapping[str, str]:
    """Names that a preprocessor gives to observations."""
    return next((step.rename_map for step in preprocessor.steps if hasattr(step, "rename_map")), NO_RENAMING)


@contextmanager
def _one_thread(device: str) -> Iterator[None]:
    """Computes with one thread on a CPU: batches are small, and the number of threads changes no sum."""
    n_threads = torch.get_num_threads()
    if device == "cpu":
        torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(n_threads)


def _autocast(config: Any) -> AbstractContextManager:
    return torch.autocast(torch.device(config.device).type) if config.use_amp else nullcontext()


@contextmanager
def _noted_goals(policy: DeltacoPolicy) -> Iterator[list[FoundGoals | None]]:
    """Notes the goals that a policy finds at the start of episodes, while the context is open."""
    found: list[FoundGoals | None] = []
    encode = policy.encode_task

    def noted(*arguments: Any) -> Any:
        conditioning = encode(*arguments)
        found.append(conditioning.goals)
        return conditioning

    with patch.object(policy, "encode_task", noted):
        yield found


def _result(
    episode: Episode, info: Mapping[str, Any], uses_demo: bool, demonstrated: Sequence[Demonstrated]
) -> EpisodeResult:
    return EpisodeResult(
        task_id=episode.task_id,
        trial=episode.trial,
        seed=episode.seed,
        instruction=episode.instruction,
        demonstration=episode.demonstrated if uses_demo else None,
        demonstration_episodes=[each.episode for each in demonstrated],
        demonstrated_objects=[each.target_object for each in demonstrated if each.target_object is not None],
        success=bool(info["is_success"]),
        objects=info["objects"].tolist(),
        object_containers=info["object_containers"].tolist(),
        container_quadrants=info["container_quadrants"].tolist(),
        target_object=int(info["target_object"]),
        target_container=int(info["target_container"]),
        grasped_object=int(info["grasped_object"]),
        right_object=bool(info["right_object"]),
        right_container=bool(info["right_container"]),
    )
