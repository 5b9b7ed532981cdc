"""Runs an evaluation set: some episodes of each task, with LeRobot's rollout, and every outcome kept."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from importlib.metadata import version
from typing import Any, NamedTuple, Self
from unittest.mock import patch

import numpy as np
import torch
from gymnasium.utils import seeding
from lerobot.policies import PreTrainedPolicy
from lerobot.processor import PolicyProcessorPipeline
from lerobot.scripts.lerobot_eval import rollout
from lerobot.utils.random_utils import seeded_context
from numpy.typing import NDArray

from gym_deltaco import ENV_ID
from gym_deltaco.layout import sample_layout
from gym_deltaco.object_sets import find_label, select_objects
from gym_deltaco.seeding import episode_seed
from gym_deltaco.tasks import CONTAINER_COLORS, Task, get_task, select_tasks
from gym_deltaco.workspace import Quadrant, container_matches
from lerobot_deltaco.envs.configuration_env import DeltacoEnv
from lerobot_deltaco.envs.policy_fit import NO_RENAMING, check_policy_fits
from lerobot_deltaco.envs.vector_env import make_task_vector_envs
from lerobot_deltaco.evaluation.plan import EvaluationPlan
from lerobot_deltaco.evaluation.record import BENCHMARK, Counterfactual, EpisodeResult
from lerobot_deltaco.evaluation.recording_env import RecordingVectorEnv
from lerobot_deltaco.modeling_deltaco import DeltacoPolicy
from lerobot_deltaco.policy.demonstrations import Demonstrated
from lerobot_deltaco.policy.goal_conditioning import FoundGoals

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
        set_number: Number of the evaluation set, usually the training step. Different sets share no scene.

    Returns:
        The episodes, task after task.

    Raises:
        ValueError: A task has no demonstration, or the policy is not one for this environment.
    """
    with Evaluation(policy, preprocessor, postprocessor, plan, set_number) as evaluation:
        return [outcome.result for task_id in evaluation.task_ids for outcome in evaluation.run(task_id)]


class Evaluation:
    """An evaluation set, whose tasks may be run in any order and in any process, with the same outcomes.

    Args:
        policy: In evaluation mode, on its device.
        preprocessor: Preprocessor of the policy.
        postprocessor: Postprocessor of the policy.
        plan: Episodes to run.
        set_number: Number of the evaluation set, usually the training step.
        render_size: Height and width of the images that are rendered, px; None renders none.

    Attributes:
        task_ids: Indices of the tasks.

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
        self.task_ids = select_tasks(plan.tasks)
        self._deltaco = policy if isinstance(policy, DeltacoPolicy) else None
        self._sentences = plan.sentences
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
                f"This policy (`{_kind(policy)}`) takes no demonstrations, so that none can be another "
                "task's. Evaluate it with --counterfactual instruction or none."
            )
        if self._deltaco is not None:
            check_enough_demonstrations(self._deltaco, self.task_ids)
        # What another task's instruction or demonstration asks for depends on the scene, so that each episode
        # of a counterfactual evaluation has its own demonstration or instruction.
        self._n_envs = 1 if plan.counterfactual != "none" else plan.trials
        self._gym_kwargs = {
            **env_config.gym_kwargs,
            "render_mode": None if render_size is None else "rgb_array",
        }
        if render_size is not None:
            self._gym_kwargs["render_size"] = render_size
        made = make_task_vector_envs(ENV_ID, self._gym_kwargs, self.task_ids, self._n_envs)
        self._envs = {env.task_id: env for env in made}
        self._earlier = self._earlier_instructions()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Closes the environments."""
        for env in self._envs.values():
            env.close()

    def run(self, task_id: int, rendered: Collection[int] = ()) -> list[EpisodeOutcome]:
        """Runs the episodes of a task. Each task is run once.

        Args:
            task_id: Index of the task.
            rendered: Trials of which images are rendered; of the others, only those in the same batches are
                run. If there are none, all trials are run, without images.

        Returns:
            The episodes that were run.

        Raises:
            ValueError: The task has no demonstration.
        """
        env = self._envs[task_id]
        outcomes = []
        if self._deltaco is not None:
            self._deltaco.begin_evaluation()
            # Demonstrations of an instruction take turns over the whole set.
            self._deltaco._episode_tasks.count_trials(self._earlier[task_id])
        for trials in _chunks(range(self.plan.trials), self._n_envs):
            if rendered and not set(rendered) & set(trials):
                self._skip(task_id, trials)
                continue
            with _one_thread(self.policy.config.device), torch.no_grad():
                outcomes += self._run_batch(task_id, trials, set(rendered) & set(trials))
        env.close()
        return outcomes

    def _run_batch(self, task_id: int, trials: range, rendered: Collection[int]) -> list[EpisodeOutcome]:
        seeds = self._seeds(task_id, trials)
        sampler = self._sampler(task_id, trials)
        recorded = RecordingVectorEnv(
            self._envs[task_id], seeds, sampler.sample_instructions, is_rendered=bool(rendered)
        )
        identity: PolicyProcessorPipeline = PolicyProcessorPipeline(steps=[])
        found: list[FoundGoals | None] = []
        with ExitStack() as stack:
            if self._deltaco is not None:
                stack.enter_context(self._deltaco.demonstrated_as(sampler.demonstrated_as))
                if rendered:
                    found = stack.enter_context(_noted_goals(self._deltaco))
            else:
                # Policies that draw, such as diffusion policies, do so by the batch's first seed.
                stack.enter_context(seeded_context(seeds[0] % 2**32))
                stack.enter_context(_autocast(self.policy.config))
            data = rollout(
                recorded, self.policy, identity, identity, self._preprocessor, self._postprocessor, seeds
            )
        outcomes = []
        for index, (trial, seed) in enumerate(zip(trials, seeds, strict=True)):
            demonstrated = [] if self._deltaco is None else self._deltaco.demonstrated(index)
            images = None
            if trial in rendered:
                ends = self._demonstration_ends(demonstrated)
                goals = None if not found or found[0] is None else found[0].of_sample(index)
                images = EpisodeImages(recorded.scenes(index), recorded.observed[index], ends, goals)
            rewards = data["reward"][index]
            result = _result(recorded, index, trial, seed, sampler.demonstration, demonstrated)
            outcomes.append(EpisodeOutcome(result, float(rewards.sum()), float(rewards.max()), images))
        return outcomes

    def _seeds(self, task_id: int, trials: range) -> list[int]:
        return [episode_seed(self.plan.seed, "evaluation", task_id, self.set_number, t) for t in trials]

    def _sampler(self, task_id: int, trials: range) -> InstructionSampler:
        task = get_task(task_id)
        own = (task.instruction,) if self._sentences is None else self._sentences[task_id]
        demonstrated: Collection[str] | None = None
        if self._deltaco is not None and self._deltaco.eval_demonstrations is not None:
            demonstrated = self._deltaco.eval_demonstrations.rows
        return InstructionSampler(
            task,
            [own[trial % len(own)] for trial in trials],
            self.task_ids,
            self.plan.counterfactual,
            self._seeds(task_id, trials)[0],
            self._uses_demo,
            demonstrated,
        )

    @property
    def _uses_demo(self) -> bool:
        if self._deltaco is None or self._deltaco.config.leave_out == "demo":
            return False
        return self._deltaco.config.uses_demo

    def _earlier_instructions(self) -> dict[int, list[str]]:
        """For each task, the instructions of the episodes before its own, of those that it has itself.

        They are known before any episode is run: what another task's instruction depends on is drawn with
        the scene.
        """
        earlier: dict[int, list[str]] = {}
        seen: Counter[str] = Counter()
        for task_id in self.task_ids:
            own = [
                instruction
                for trials in _chunks(range(self.plan.trials), self._n_envs)
                for instruction in self._expected_instructions(task_id, trials)
            ]
            earlier[task_id] = [text for text in dict.fromkeys(own) for _ in range(seen[text])]
            seen.update(own)
        return earlier

    def _expected_instructions(self, task_id: int, trials: range) -> list[str]:
        sampler = self._sampler(task_id, trials)
        if self.plan.counterfactual != "instruction":
            return sampler.own
        (seed,) = self._seeds(task_id, trials)
        return sampler.sample_instructions([_scene_info(self.plan, task_id, seed)])

    def _skip(self, task_id: int, trials: range) -> None:
        """Counts the episodes of a batch that is not run."""
        if self._deltaco is not None:
            self._deltaco._episode_tasks.count_trials(self._expected_instructions(task_id, trials))

    def _demonstration_ends(self, demonstrated: Sequence[Demonstrated]) -> NDArray[np.uint8] | None:
        """First and last image of the first of an episode's demonstrations, (2, H, W, 3)."""
        if not demonstrated or self._deltaco is None or self._deltaco.eval_demonstrations is None:
            return None
        known = self._deltaco.eval_demonstrations
        row = int(known.episode_rows(torch.tensor([demonstrated[0].episode], device=known.frames.device)))
        return known.frames[row][[0, -1]].permute(0, 2, 3, 1).cpu().numpy()


def check_enough_demonstrations(policy: DeltacoPolicy, task_ids: Sequence[int]) -> None:
    """Checks that the tasks have as many demonstrations as the policy combines.

    Raises:
        ValueError: A task has fewer.
    """
    n_wanted, known = policy.config.n_demonstrations, policy.eval_demonstrations
    if n_wanted == 1 or known is None or not policy.config.uses_demo:
        return
    for task_id in task_ids:
        instruction = get_task(task_id).instruction
        n_known = len(known.rows.get(instruction, ()))
        if 0 < n_known < n_wanted:
            raise ValueError(
                f"`n_demonstrations` is {n_wanted}, but there is a smaller number of demonstrations of the "
                f"task {instruction!r}: {n_known}. Collect more with `deltaco-collect --episodes-per-task "
                f"{n_wanted}` and name them with --policy.demo_repo_id and --policy.demo_root, or set "
                f"--n-demonstrations to at most {n_known}."
            )


def check_combines(policy: PreTrainedPolicy) -> None:
    """Checks that a policy combines the demonstrations of a task.

    Raises:
        ValueError: It does not.
    """
    if isinstance(policy, DeltacoPolicy) and policy.config.uses_demo and policy.config.locates_goals:
        return
    raise ValueError(
        "--n-demonstrations is for policies with `demo_encoder=correspondence` that take demonstrations. "
        f"This one (`{_kind(policy)}`) does not combine any: leave it out."
    )


def versions(policy: PreTrainedPolicy) -> dict[str, str]:
    """What an evaluation depends on."""
    found = {BENCHMARK: ENV_ID, **{name: version(name) for name in PACKAGES}}
    if isinstance(policy, DeltacoPolicy):
        found["language_encoder"] = policy.config.language_encoder
    return found


class InstructionSampler:
    """Chooses the demonstration and the instruction of episodes: the task's own, or one of another task.

    Args:
        task: The scenes' task.
        own: The instructions of the task itself, one for each episode, in whatever words.
        task_ids: Tasks of which a counterfactual one is chosen.
        counterfactual: Cue that is another task's.
        seed: Seed of the choice.
        uses_demo: Whether the policy takes demonstrations.
        demonstrated: Task strings of which there are demonstrations; None if that is not known.
    """

    def __init__(
        self,
        task: Task,
        own: Sequence[str],
        task_ids: Sequence[int],
        counterfactual: Counterfactual,
        seed: int,
        uses_demo: bool,
        demonstrated: Collection[str] | None,
    ) -> None:
        self.demonstration = task.instruction if uses_demo else None
        # The task that demonstrates an instruction.
        self.demonstrated_as = dict.fromkeys(own, task.instruction)
        self._task = task
        self.own = list(own)
        self._counterfactual = counterfactual
        self._others = [get_task(index) for index in task_ids if index != task.index]
        if counterfactual == "demo" and demonstrated is not None:
            self._others = [other for other in self._others if other.instruction in demonstrated]
        self._random = random.Random(seed)

    def sample_instructions(self, infos: list[dict[str, Any]]) -> list[str]:
        """The instructions for scenes, once they are drawn."""
        if self._counterfactual == "none":
            return self.own
        (info,) = infos
        other = counterfactual_task(self._others, info, self._random).instruction
        if self._counterfactual == "instruction":
            self.demonstrated_as[other] = self._task.instruction
            return [other]
        self.demonstrated_as |= dict.fromkeys(self.own, other)
        if self.demonstration is not None:
            self.demonstration = other
        return self.own


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


def _scene_info(plan: EvaluationPlan, task_id: int, seed: int) -> dict[str, Any]:
    """What the environment will say of a scene, as far as it is drawn, without building the scene."""
    rng, _ = seeding.np_random(seed)
    labels = select_objects(plan.objects or "all")
    layout = sample_layout(
        get_task(task_id), plan.ambiguity, rng, labels, plan.adversarial_probability, plan.adversarial_draw
    )
    return {
        "objects": [item.label.index for item in layout.objects],
        "container_quadrants": [item.quadrant for item in layout.containers],
        "target_object": layout.target_object,
        "target_container": layout.target_container,
    }


def _rename_map(preprocessor: PolicyProcessorPipeline) -> Mapping[str, str]:
    """Names that a preprocessor gives to observations."""
    return next((step.rename_map for step in preprocessor.steps if hasattr(step, "rename_map")), NO_RENAMING)


def _kind(policy: PreTrainedPolicy) -> str:
    return f"method={policy.config.method}" if isinstance(policy, DeltacoPolicy) else policy.config.type


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
