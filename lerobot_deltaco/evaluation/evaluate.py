"""Evaluates a policy on the benchmark: some episodes of each task, and a record of every outcome."""

from __future__ import annotations

import itertools
import math
import multiprocessing
import signal
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager
from typing import Any

import numpy as np
import pandas as pd
import torch
from lerobot.envs.utils import preprocess_observation
from lerobot.utils.random_utils import seeded_context
from numpy.typing import NDArray
from tqdm import tqdm

from gym_deltaco.env import N_JOINTS, PickPlaceEnv
from gym_deltaco.expert import Expert
from gym_deltaco.tasks import get_task
from lerobot_deltaco.data.demonstrations import Demonstration, DemonstrationBank
from lerobot_deltaco.data.object_prompts import ObjectPrompt
from lerobot_deltaco.errors import UserError
from lerobot_deltaco.evaluation.checkpoints import LoadedPolicy
from lerobot_deltaco.evaluation.episodes import EpisodeSpec, draw_episodes
from lerobot_deltaco.evaluation.expert_demonstrations import ExpertBank
from lerobot_deltaco.evaluation.failures import NO_FAILURE, EpisodeMonitor
from lerobot_deltaco.evaluation.lerobot_env import check_policy_fits
from lerobot_deltaco.evaluation.oracle import (
    check_oracle,
    give_locations,
    localized_positions,
    make_controllers,
)
from lerobot_deltaco.evaluation.photos import take_photo
from lerobot_deltaco.evaluation.records import EvaluationPlan, Oracle
from lerobot_deltaco.lerobot_versions import action_of
from lerobot_deltaco.policies.base.modeling import TaskConditionedPolicy
from lerobot_deltaco.processes import disable_malloc_trim, end_with_parent

# Most episodes that run at the same time. A policy's step costs little more for 8 than for 2, and each
# episode needs a simulator of 50 MB, in each process.
_MAX_BATCH = 8
# Processes share batches, so small evaluations need several, too.
_MIN_BATCHES = 4

# Called after the reset and after each step with the environments of a batch and their observations.
StepCallback = Callable[[Sequence[PickPlaceEnv], Sequence[Mapping[str, NDArray]]], None]


class Evaluation:
    """An evaluation, whose batches may be run in any order and in any process, with the same outcomes.

    Args:
        loaded: The policy and its processors.
        plan: Episodes to run.

    Attributes:
        batches: The episodes, in batches that run at the same time.

    Raises:
        UserError: The policy is not one for the benchmark, or the plan is not one for this policy.
    """

    def __init__(self, loaded: LoadedPolicy, plan: EvaluationPlan) -> None:
        self.loaded, self.plan = loaded, plan
        policy = loaded.policy
        check_policy_fits(policy.config, plan.scene, loaded.rename_map)
        check_oracle(policy, plan.oracle)
        self._bank = _bank_for(policy, plan)
        episodes = draw_episodes(plan, self._bank)
        if getattr(policy.config, "method", None) == "mcil":
            # The trials of a task use the instruction and the demonstration in turn.
            episodes = [
                each._replace(demonstration_task=-1) if each.trial % 2 == 0 else each._replace(instruction="")
                for each in episodes
            ]
        size = min(_MAX_BATCH, math.ceil(len(episodes) / _MIN_BATCHES))
        self.batches = [list(batch) for batch in itertools.batched(episodes, size)]
        # Their simulators start at the first reset, in the process that runs a batch.
        self._envs = [PickPlaceEnv(plan.task_ids[0], plan.scene) for _ in range(size)]

    def run(self, number: int) -> list[dict[str, Any]]:
        """Runs the episodes of a batch, and returns the row of each in the record."""
        batch = self.batches[number]
        demonstrations = [
            [self._photo(episode)] if self.plan.photo else self._demonstrations(episode) for episode in batch
        ]
        monitors: list[EpisodeMonitor] = []

        def monitor(envs: Sequence[PickPlaceEnv], _: Any) -> None:
            for each in monitors:
                each.step()
            if not monitors:  # after the reset
                monitors.extend(map(EpisodeMonitor, envs))

        policy, plan = self.loaded.policy, self.plan
        with self._inference(batch):
            infos = run_episodes(
                self.loaded, self._envs, batch, demonstrations, monitor, plan.joint_noise, plan.oracle
            )
            localized = localized_positions(policy, plan.scene.control)
        confidence = policy.pick_confidence if isinstance(policy, TaskConditionedPolicy) else None
        confidences = [math.nan] * len(batch) if confidence is None else confidence.tolist()
        positions = [None] * len(batch) if localized is None else list(localized)
        rows = []
        for episode, info, given, pick_confidence, observed, position in zip(
            batch, infos, demonstrations, confidences, monitors, positions, strict=True
        ):
            pick_error, place_error = observed.errors(position)
            shown = [each for each in given if isinstance(each, Demonstration)]
            template = get_task(episode.task_id).instruction
            rows.append(
                {
                    "task_id": episode.task_id,
                    "trial": episode.trial,
                    "success": bool(info["is_success"]),
                    "instruction": None if episode.instruction == template else episode.instruction,
                    "demonstration_task": episode.demonstration_task,
                    "demonstration_episodes": [each.episode for each in shown if each.episode is not None],
                    "demonstrated_objects": [
                        each.target_object for each in shown if each.target_object is not None
                    ],
                    "grasped_object": int(info["grasped_object"]),
                    "object_containers": info["object_containers"].tolist(),
                    "right_object": bool(info["right_object"]),
                    "right_container": bool(info["right_container"]),
                    "pick_confidence": pick_confidence,
                    "pick_error": pick_error,
                    "place_error": place_error,
                    "failure": NO_FAILURE if info["is_success"] else observed.failure(position),
                }
            )
        return rows

    def close(self) -> None:
        """Closes the environments."""
        for env in self._envs:
            env.close()

    def _demonstrations(self, episode: EpisodeSpec) -> list[Demonstration]:
        """Returns the demonstrations of an episode; the trials of a task use its demonstrations in turn."""
        if self._bank is None or episode.demonstration_task < 0:
            return []
        config = self.loaded.policy.config
        if isinstance(self._bank, DemonstrationBank) and config.demo_episode is not None:
            return [self._bank.of_episode(config.demo_episode)]
        task = get_task(episode.demonstration_task)
        available = self._bank.of_task(task.instruction, task.object.index)
        count = self.plan.n_demonstrations
        if len(available) < count:
            raise UserError(
                f"`n_demonstrations` is {count}, but the task {task.instruction!r} has {len(available)}. "
                "Collect more and name them with --demo-repo-id and --demo-root."
            )
        return [available[(episode.trial * count + n) % len(available)] for n in range(count)]

    def _photo(self, episode: EpisodeSpec) -> ObjectPrompt:
        """Returns a photo of what an episode's task moves, in another scene."""
        camera = self.loaded.policy.config.cameras[0].rpartition(".")[-1]
        return take_photo(self._envs[0], episode.task_id, episode.trial, camera)

    @contextmanager
    def _inference(self, batch: Sequence[EpisodeSpec]) -> Iterator[None]:
        config = self.loaded.policy.config
        n_threads = torch.get_num_threads()
        with ExitStack() as stack:
            if config.device == "cpu":
                # Batches are small, and the number of threads changes no sum.
                torch.set_num_threads(1)
                stack.callback(torch.set_num_threads, n_threads)
            if not isinstance(self.loaded.policy, TaskConditionedPolicy):
                # Policies that sample, such as diffusion policies, do so for a whole batch, seeded by its
                # first episode.
                stack.enter_context(seeded_context(batch[0].seed % 2**32))
                if config.use_amp:
                    stack.enter_context(torch.autocast(torch.device(config.device).type))
            stack.enter_context(torch.inference_mode())
            yield


def run_episodes(
    loaded: LoadedPolicy,
    envs: Sequence[PickPlaceEnv],
    episodes: Sequence[EpisodeSpec],
    demonstrations: Sequence[Sequence[Demonstration | ObjectPrompt]],
    callback: StepCallback | None = None,
    joint_noise: float = 0.0,
    oracle: Oracle = "none",
) -> list[dict[str, Any]]:
    """Runs episodes at the same time.

    Args:
        loaded: The policy and its processors.
        envs: At least as many environments, whatever their tasks.
        episodes: The episodes.
        demonstrations: Demonstrations of each.
        callback: Called after the reset and after each step.
        joint_noise: Standard deviation of the noise on each joint angle that the policy observes, degrees.
        oracle: What the benchmark does in place of the policy, as in `EvaluationPlan`.

    Returns:
        Info of each environment after its last step.
    """
    policy, instructions = loaded.policy, [episode.instruction for episode in episodes]
    envs = envs[: len(episodes)]
    resets = [
        env.reset(seed=episode.seed, options={"task_id": episode.task_id})
        for env, episode in zip(envs, episodes, strict=True)
    ]
    observations, infos = [list(parts) for parts in zip(*resets, strict=True)]
    policy.reset()
    if hasattr(policy, "set_tasks"):
        policy.set_tasks(instructions, demonstrations)
    if oracle == "location":
        give_locations(policy, envs)
    controllers: list[Expert] = []
    generators = [np.random.default_rng(episode.seed) for episode in episodes]
    for _ in range(envs[0].scene_config.n_steps):
        if callback is not None:
            callback(envs, observations)
        if not controllers:
            stacked = _stack(observations)
            if joint_noise:
                offsets = np.stack([rng.normal(0, np.radians(joint_noise), N_JOINTS) for rng in generators])
                stacked["agent_pos"][:, :N_JOINTS] += offsets.astype(np.float32)
            batch = {**preprocess_observation(stacked), "task": instructions}
            output = policy.select_action(loaded.preprocessor(batch))
            actions = loaded.postprocessor(action_of(output)).cpu().numpy()
            if oracle == "controller":  # The policy's first action has localized.
                controllers = make_controllers(policy, envs)
        if controllers:
            actions = np.stack([controller.act() for controller in controllers])
        steps = [env.step(action) for env, action in zip(envs, actions, strict=True)]
        observations, infos = [step[0] for step in steps], [step[-1] for step in steps]
    if callback is not None:
        callback(envs, observations)
    return infos


def _stack(observations: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Returns a batch of observations, of which each may contain dictionaries."""
    columns = {name: [each[name] for each in observations] for name in observations[0]}
    return {
        name: _stack(values) if isinstance(values[0], Mapping) else np.stack(values)
        for name, values in columns.items()
    }


def evaluate(loaded: LoadedPolicy, plan: EvaluationPlan, processes: int = 1) -> pd.DataFrame:
    """Evaluates a policy.

    Args:
        loaded: The policy and its processors.
        plan: Episodes to run.
        processes: Number of processes that share the episodes; with 1, everything runs in this one.

    Returns:
        A row for each episode, with the columns of a record, by task in the plan's order, and trial. They do
        not depend on the number of processes.

    Raises:
        UserError: A task has no demonstration, the policy is not one for the benchmark, or a process ended
            unexpectedly.
    """
    disable_malloc_trim()
    evaluation = Evaluation(loaded, plan)
    rows: list[dict[str, Any]] = []
    with tqdm(total=sum(map(len, evaluation.batches)), desc="Evaluating", unit="episode") as progress:
        for batch_rows in _run_batches(evaluation, min(processes, len(evaluation.batches))):
            rows += batch_rows
            progress.update(len(batch_rows))
    evaluation.close()
    order = {task_id: n for n, task_id in enumerate(plan.task_ids)}
    return pd.DataFrame(sorted(rows, key=lambda row: (order[row["task_id"]], row["trial"])))


def _run_batches(evaluation: Evaluation, processes: int) -> Iterator[list[dict[str, Any]]]:
    """Yields the rows of the batches, in the order in which these are completed."""
    numbers = range(len(evaluation.batches))
    if processes == 1:
        yield from map(evaluation.run, numbers)
        return
    # Processes are forked, which shares the policy and takes no time: importing LeRobot takes 10 s.
    executor = ProcessPoolExecutor(
        processes, multiprocessing.get_context("fork"), initializer=_start_process, initargs=(evaluation,)
    )
    try:
        with warnings.catch_warnings():
            # About threads that hold locks: all others are idle, and each process computes with one thread.
            warnings.filterwarnings("ignore", category=DeprecationWarning, message=".*fork")
            running = [executor.submit(_run_batch, number) for number in numbers]
        for future in as_completed(running):
            yield future.result()
    except BrokenProcessPool:
        raise UserError(
            "A process of the evaluation ended unexpectedly; the memory may be full. Run the command again "
            "with fewer --processes."
        ) from None
    finally:
        executor.shutdown(wait=True, cancel_futures=True)


_evaluation: Evaluation | None = None  # of this process, if it was forked for one


def _start_process(evaluation: Evaluation) -> None:
    global _evaluation
    # Interrupts are left to the main process, which lets the running batches finish.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()
    _evaluation = evaluation


def _run_batch(number: int) -> list[dict[str, Any]]:
    assert _evaluation is not None
    return _evaluation.run(number)


def _bank_for(policy: Any, plan: EvaluationPlan) -> DemonstrationBank | ExpertBank | None:
    """Returns the demonstrations that a policy receives: its own, or the expert's; None if it takes none.

    Raises:
        UserError: The plan asks for demonstrations that the policy does not take or have.
    """
    if plan.photo:
        if not getattr(policy, "takes_prompts", False):
            raise UserError(
                f"A policy of the type {policy.config.type!r} takes no photo in place of a demonstration. "
                "Use deltaco_match."
            )
        return None
    if not hasattr(policy, "set_tasks") or not getattr(policy.config, "uses_demonstrations", True):
        if plan.counterfactual == "demonstration" or plan.without == "demonstration":
            raise UserError("This policy takes no demonstrations: none can be replaced or left out.")
        return None
    is_ours = isinstance(policy, TaskConditionedPolicy)
    bank = policy.demonstrations if is_ours else ExpertBank(plan.task_ids, plan.scene)
    if bank is None:
        if plan.without == "demonstration":
            return None
        raise UserError(
            "The policy has no demonstrations. Name a dataset of them with --demo-repo-id and --demo-root."
        )
    if plan.n_demonstrations > 1 and not hasattr(policy.config, "n_demonstrations"):
        raise UserError(
            f"`n_demonstrations` is {plan.n_demonstrations}, but this policy does not combine any."
        )
    return bank
