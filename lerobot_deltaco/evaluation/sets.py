"""Evaluation sets of a training run's checkpoints, as records in its folder."""

from __future__ import annotations

import time
from pathlib import Path

import draccus
from lerobot.processor import PolicyProcessorPipeline

from gym_deltaco.object_sets import default_objects
from lerobot_deltaco.configuration_deltaco import DeltacoConfig
from lerobot_deltaco.evaluation.evaluate import evaluate, versions
from lerobot_deltaco.evaluation.plan import EvaluationPlan
from lerobot_deltaco.evaluation.record import EvaluationRecord, record_path, write_record
from lerobot_deltaco.modeling_deltaco import DeltacoPolicy


def run_set(
    folder: Path,
    step: int,
    policy: DeltacoPolicy,
    preprocessor: PolicyProcessorPipeline,
    postprocessor: PolicyProcessorPipeline,
    plan: EvaluationPlan,
    *,
    experiment: str,
    run_seed: int,
    command: str,
) -> EvaluationRecord:
    """Runs an evaluation set, and writes its record.

    Args:
        folder: Folder that contains `evaluations`, usually that of the training run.
        step: Training step of the policy, which is also the number of the set.
        policy: In evaluation mode, on its device.
        preprocessor: Preprocessor of the policy.
        postprocessor: Postprocessor of the policy.
        plan: Episodes to run.
        experiment: What was trained, for the record; runs of one name differ in their seeds alone.
        run_seed: Seed of the training run, for the record.
        command: Command line, for the record.

    Returns:
        The record.

    Raises:
        ValueError: A task has no demonstration.
    """
    start = time.monotonic()
    episodes = evaluate(policy, preprocessor, postprocessor, plan, step)
    record = EvaluationRecord(
        experiment=experiment,
        method=policy.config.method,
        run_seed=run_seed,
        step=step,
        evaluation_seed=plan.seed,
        counterfactual=plan.counterfactual,
        ambiguity=plan.ambiguity,
        objects=plan.objects or default_objects(plan.tasks),
        adversarial_probability=plan.adversarial_probability,
        tasks=plan.tasks,
        trials=plan.trials,
        episodes=episodes,
        policy=_plain(policy.config),
        versions=versions(policy),
        command=command,
        seconds=time.monotonic() - start,
        image_size=plan.image_size,
        episode_length=plan.episode_length,
        wording=plan.wording,
    )
    write_record(record, record_path(folder, step, plan.counterfactual))
    return record


def _plain(config: DeltacoConfig) -> dict[str, object]:
    """The policy's configuration as JSON knows it, less what comes from the data, and where they were."""
    left_out = {"input_features", "output_features", "one_hot_tasks", "demo_episodes"}
    left_out |= {"demo_repo_id", "demo_root", "instruction_embeddings", "instructions"}
    left_out |= {"vision_encoder_weights", "demo_features_dir", "demo_feature_dim"}
    return {name: value for name, value in draccus.encode(config).items() if name not in left_out}
