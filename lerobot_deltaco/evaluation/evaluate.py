"""Runs an evaluation set: some episodes of each task, with LeRobot's rollout, and every outcome kept."""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from importlib.metadata import version
from typing import Any

import torch
from lerobot.processor import PolicyProcessorPipeline
from lerobot.scripts.lerobot_eval import rollout
from tqdm import tqdm

from gym_deltaco import ENV_ID
from gym_deltaco.object_sets import find_label
from gym_deltaco.seeding import episode_seed
from gym_deltaco.tasks import CONTAINER_COLORS, Task, get_task, select_tasks
from gym_deltaco.workspace import Quadrant, container_matches
from lerobot_deltaco.envs.configuration_env import DeltacoEnv
from lerobot_deltaco.envs.policy_fit import check_policy_fits
from lerobot_deltaco.envs.vector_env import make_task_vector_envs
from lerobot_deltaco.evaluation.plan import EvaluationPlan
from lerobot_deltaco.evaluation.record import BENCHMARK, Counterfactual, EpisodeResult
from lerobot_deltaco.evaluation.recording_env import RecordingVectorEnv
from lerobot_deltaco.modeling_deltaco import DeltacoPolicy
from lerobot_deltaco.policy.demonstrations import Demonstrated

PACKAGES = ("lerobot_policy_deltaco", "lerobot", "torch", "gymnasium", "numpy", "pybullet")


def evaluate(
    policy: DeltacoPolicy,
    preprocessor: PolicyProcessorPipeline,
    postprocessor: PolicyProcessorPipeline,
    plan: EvaluationPlan,
    set_number: int,
) -> list[EpisodeResult]:
    """Runs an evaluation set.

    Args:
        policy: In evaluation mode, on its device.
        preprocessor: Preprocessor of the policy.
        postprocessor: Postprocessor of the policy.
        plan: Episodes to run.
        set_number: Number of the evaluation set, usually the training step. Different sets share no scene.

    Returns:
        The episodes, task after task.

    Raises:
        ValueError: A task has no demonstration, or the policy is not one for this environment.
    """
    env_config = DeltacoEnv(
        task=plan.tasks,
        ambiguity=plan.ambiguity,
        image_size=plan.image_size,
        episode_length=plan.episode_length,
        objects=plan.objects,
        adversarial_probability=plan.adversarial_probability,
    )
    check_policy_fits(policy.config, env_config)
    task_ids = select_tasks(plan.tasks)
    sentences = plan.sentences
    # What another task's instruction or demonstration asks for depends on the scene, so that each episode of
    # a counterfactual evaluation has its own demonstration or instruction.
    n_envs = 1 if plan.counterfactual != "none" else plan.trials
    gym_kwargs = {**env_config.gym_kwargs, "render_mode": None}
    envs = make_task_vector_envs(ENV_ID, gym_kwargs, task_ids, n_envs)
    identity: PolicyProcessorPipeline = PolicyProcessorPipeline(steps=[])
    results = []
    policy.begin_evaluation()
    try:
        for env in tqdm(envs, desc=f"Evaluating step {set_number}", unit="task"):
            for trials in _chunks(range(plan.trials), n_envs):
                seeds = [episode_seed(plan.seed, "evaluation", env.task_id, set_number, t) for t in trials]
                task = get_task(env.task_id)
                own = (task.instruction,) if sentences is None else sentences[env.task_id]
                sampler = InstructionSampler(
                    policy,
                    task,
                    [own[trial % len(own)] for trial in trials],
                    task_ids,
                    plan.counterfactual,
                    seeds[0],
                )
                recorded = RecordingVectorEnv(env, seeds, sampler.sample_instructions)
                with torch.no_grad(), policy.demonstrated_as(sampler.demonstrated_as):
                    rollout(recorded, policy, identity, identity, preprocessor, postprocessor, seeds)
                results += [
                    _result(recorded, index, trial, seed, sampler.demonstration, policy.demonstrated(index))
                    for index, (trial, seed) in enumerate(zip(trials, seeds, strict=True))
                ]
            env.close()
    finally:
        for env in envs:
            env.close()
    return results


def versions(policy: DeltacoPolicy) -> dict[str, str]:
    """What an evaluation depends on."""
    packages = {name: version(name) for name in PACKAGES}
    return {BENCHMARK: ENV_ID, **packages, "language_encoder": policy.config.language_encoder}


class InstructionSampler:
    """Chooses the demonstration and the instruction of episodes: the task's own, or one of another task.

    Args:
        policy: The policy.
        task: The scenes' task.
        own: The instructions of the task itself, one for each episode, in whatever words.
        task_ids: Tasks of which a counterfactual one is chosen.
        counterfactual: Which of both is another task's.
        seed: Of the choice.
    """

    def __init__(
        self,
        policy: DeltacoPolicy,
        task: Task,
        own: Sequence[str],
        task_ids: Sequence[int],
        counterfactual: Counterfactual,
        seed: int,
    ) -> None:
        self.demonstration = task.instruction if policy.config.uses_demo else None
        # The task that demonstrates an instruction.
        self.demonstrated_as = dict.fromkeys(own, task.instruction)
        self._task = task
        self._own = list(own)
        self._counterfactual = counterfactual
        self._others = [get_task(index) for index in task_ids if index != task.index]
        if counterfactual == "demo" and policy.eval_demonstrations is not None:
            self._others = [
                other for other in self._others if other.instruction in policy.eval_demonstrations.rows
            ]
        self._random = random.Random(seed)

    def sample_instructions(self, infos: list[dict[str, Any]]) -> list[str]:
        """The instructions for scenes, once they are drawn."""
        if self._counterfactual == "none":
            return self._own
        (info,) = infos
        other = counterfactual_task(self._others, info, self._random).instruction
        if self._counterfactual == "instruction":
            self.demonstrated_as[other] = self._task.instruction
            return [other]
        self.demonstrated_as |= dict.fromkeys(self._own, other)
        if self.demonstration is not None:
            self.demonstration = other
        return self._own


def counterfactual_task(others: Sequence[Task], info: dict[str, Any], rng: random.Random) -> Task:
    """Another task whose demonstration or instruction fits a scene.

    If there is one, it asks for another object that stands there, and for the other container; else, at least
    for the other container.

    Args:
        others: Tasks to choose from.
        info: Info of the scene.
        rng: Source of the choice.

    Raises:
        ValueError: There is no other task.
    """
    if not others:
        raise ValueError(
            "A counterfactual evaluation needs at least two tasks that the policy can perform. Evaluate more "
            "tasks, and give demonstrations of them."
        )
    labels = [find_label(int(index)) for index in info["objects"]]

    def wants(task: Task) -> tuple[bool, bool]:
        objects = [n for n, label in enumerate(labels) if task.describes(label)]
        containers = [
            n
            for n, color in enumerate(CONTAINER_COLORS)
            if container_matches(task.container, color, Quadrant(*info["container_quadrants"][n]))
        ]
        is_other_container = containers == [1 - info["target_container"]]
        is_other_object = len(objects) == 1 and objects != [info["target_object"]]
        return is_other_container, is_other_object

    ranked = [(wants(task), task) for task in others]
    best = max(rank for rank, _ in ranked)
    return rng.choice([task for rank, task in ranked if rank == best])


def _result(
    recorded: RecordingVectorEnv,
    index: int,
    trial: int,
    seed: int,
    demonstration: str | None,
    demonstrated: list[Demonstrated],
) -> EpisodeResult:
    info = recorded.infos[index]
    return EpisodeResult(
        task_id=int(info["task_id"]),
        trial=trial,
        seed=seed,
        instruction=recorded.instructions[index],
        demonstration=demonstration,
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


def _chunks(numbers: range, size: int) -> Iterator[range]:
    for start in range(0, len(numbers), size):
        yield numbers[start : start + size]
