"""Evaluation sets of a training run's checkpoints, as records in its folder."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import draccus
from lerobot.configs import PreTrainedConfig
from lerobot.policies import PreTrainedPolicy
from lerobot.processor import PolicyProcessorPipeline

from lerobot_deltaco.configuration_deltaco import DeltacoConfig
from lerobot_deltaco.evaluation.evaluate import Evaluation, versions
from lerobot_deltaco.evaluation.lerobot_info import write_lerobot_info
from lerobot_deltaco.evaluation.plan import EvaluationPlan
from lerobot_deltaco.evaluation.processes import run_batches
from lerobot_deltaco.evaluation.record import EvaluationRecord, extras_folder, record_path, write_record


def run_set(
    folder: Path,
    step: int,
    policy: PreTrainedPolicy,
    preprocessor: PolicyProcessorPipeline,
    postprocessor: PolicyProcessorPipeline,
    plan: EvaluationPlan,
    *,
    experiment: str,
    run_seed: int,
    command: str,
    processes: int = 1,
    weights: str | None = None,
    demonstrations: str | None = None,
    demonstrations_digest: str | None = None,
) -> EvaluationRecord:
    """Runs an evaluation set, and writes its record, and beside it the results in LeRobot's form.

    Args:
        folder: Folder that contains `evaluations`, usually that of the training run.
        step: Training step of the policy, which is also the number of the set of scenes, unless the plan
            names one.
        policy: In evaluation mode, on its device.
        preprocessor: Preprocessor of the policy.
        postprocessor: Postprocessor of the policy.
        plan: Episodes to run.
        experiment: Name of what was trained, for the record; runs of one name differ in their seeds alone.
        run_seed: Seed of the training run, for the record.
        command: Command line, for the record.
        processes: Number of processes that share the episodes.
        weights: SHA-256 of the checkpoint's weights, for the record; None if there is no checkpoint.
        demonstrations: Name of the dataset of demonstrations, for the record; None for the checkpoint's own.
        demonstrations_digest: SHA-256 of its metadata, for the record.

    Returns:
        The record.

    Raises:
        ValueError: A task has no demonstration.
        EvaluationError: A process ended unexpectedly.
    """
    start = time.monotonic()
    with Evaluation(policy, preprocessor, postprocessor, plan, step) as evaluation:
        outcomes = run_batches(evaluation, processes)
    config = policy.config
    record = EvaluationRecord(
        experiment=experiment,
        method=config.method if isinstance(config, DeltacoConfig) else config.type,
        run_seed=run_seed,
        step=step,
        evaluation_seed=plan.seed,
        counterfactual=plan.counterfactual,
        ambiguity=plan.ambiguity,
        objects=plan.object_set,
        adversarial_probability=plan.adversarial_probability,
        adversarial_draw=plan.adversarial_draw,
        tasks=plan.tasks,
        trials=plan.trials,
        episodes=[outcome.result for outcome in outcomes],
        policy=_plain(config),
        versions=versions(policy),
        command=command,
        seconds=time.monotonic() - start,
        image_size=plan.image_size,
        episode_length=plan.episode_length,
        wording=plan.wording,
        scene_set=plan.scene_set,
        weights=weights,
        demonstrations=demonstrations,
        demonstrations_digest=demonstrations_digest,
    )
    write_lerobot_info(outcomes, record.seconds, extras_folder(folder, step, plan.counterfactual))
    write_record(record, record_path(folder, step, plan.counterfactual))
    return record


def _plain(config: PreTrainedConfig) -> dict[str, Any]:
    """The policy's configuration as JSON knows it, less what comes from the data, and where they were.

    That of another type than this project's has the key `type`.
    """
    left_out = {"input_features", "output_features"}
    if not isinstance(config, DeltacoConfig):
        # Encoded as its base class, so that the type is there.
        return _without(draccus.encode(config, PreTrainedConfig), left_out)
    left_out |= {"one_hot_tasks", "known_words", "demo_episodes"}
    left_out |= {"demo_repo_id", "demo_root", "instruction_embeddings", "instructions"}
    left_out |= {"vision_encoder_weights", "demo_features_dir", "demo_feature_dim"}
    return _without(draccus.encode(config), left_out)


def _without(options: dict[str, Any], left_out: set[str]) -> dict[str, Any]:
    return {name: value for name, value in options.items() if name not in left_out}
