"""What a policy's checkpoint says: weights that must be the policy's, and what it knows of tasks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from safetensors import safe_open
from torch import nn

from lerobot_deltaco.configuration_deltaco import DeltacoConfig
from lerobot_deltaco.policy.demonstrations import DemonstrationSet, kept_frame_indices
from lerobot_deltaco.policy.finite_loss import non_finite_weight
from lerobot_deltaco.policy.frozen_features import FrozenFeatures
from lerobot_deltaco.policy.language.instruction_table import InstructionTable
from lerobot_deltaco.policy.language.paraphrases import Paraphrases
from lerobot_deltaco.policy.options import FILE_OPTIONS
from lerobot_deltaco.policy.task_file import (
    StoredDemonstrations,
    TaskFile,
    check_demonstrations,
    check_features,
    check_grasp_states,
)

# Prefix that the names of the weights of `DeltacoPolicy.model` had in version 0.1.
OLD_MODEL_PREFIX = "policy."
# Prefix of the names of the weights of matching by pretrained features.
MATCHING_PREFIX = "goals.matching."
# What a checkpoint does not say: where its contents are from, and what is a choice of each evaluation.
_SOURCES = ("leave_out", *FILE_OPTIONS)


@contextmanager
def without_sources(config: DeltacoConfig) -> Iterator[None]:
    """Leaves out of a configuration what is not the checkpoint's, while the context is open.

    What was read from files is saved with the policy, whose next user has other files; and what is left out
    is chosen anew for each evaluation.

    Args:
        config: Configuration of the policy.
    """
    given = {name: getattr(config, name) for name in _SOURCES}
    try:
        for name in _SOURCES:
            setattr(config, name, None)
        yield
    finally:
        for name, value in given.items():
            setattr(config, name, value)


def check_weight_names(state_dict: Mapping[str, Any]) -> None:
    """Checks that weights were not saved by version 0.1.

    Args:
        state_dict: Weights by name.

    Raises:
        ValueError: They were saved by a version that named them otherwise.
    """
    if any(name.startswith(OLD_MODEL_PREFIX) for name in state_dict):
        raise ValueError(
            "An earlier version of lerobot_policy_deltaco saved these weights: those of the policy's "
            f"network are named `{OLD_MODEL_PREFIX}*`. Train the policy again, or rename them in "
            f"model.safetensors: replace the prefix `{OLD_MODEL_PREFIX}` by `model.`."
        )


def check_loaded_weights(policy: nn.Module, path: str) -> None:
    """Checks the weights that a policy was loaded with.

    Args:
        policy: The policy, with the weights of the file.
        path: The file.

    Raises:
        ValueError: The file has other weights than the policy, or numbers that are not finite.
    """
    with safe_open(path, framework="pt") as file:
        stored = set(file.keys())
    expected = set(policy.state_dict())
    if stored != expected:
        missing, unknown = sorted(expected - stored), sorted(stored - expected)
        if all(name.startswith(MATCHING_PREFIX) for name in missing + unknown):
            if not unknown:
                raise ValueError(
                    f"The policy of {path} was trained without `pretrained_matching`. `deltaco-match` "
                    "adds it."
                )
            if not missing:
                raise ValueError(
                    f"The policy of {path} has matching by pretrained features. Load it with "
                    "`pretrained_matching=true`."
                )
            raise ValueError(
                f"The matching by pretrained features of {path} was saved by another version. "
                "`deltaco-match` fits it anew to the training dataset; its training cannot be resumed."
            )
        raise ValueError(
            f"{path} does not have the weights of this policy: it lacks {missing[:3] or 'none'}, "
            f"and has the unknown {unknown[:3] or 'none'}. The config.json beside it belongs to other "
            "weights, or to another version."
        )
    name = non_finite_weight(policy)
    if name is not None:
        raise ValueError(f"{path} is damaged: the weight {name} has numbers that are not finite.")


def task_contents(
    instructions: InstructionTable,
    paraphrases: Paraphrases | None,
    demonstrations: DemonstrationSet | None,
    frozen: FrozenFeatures | None,
) -> TaskFile:
    """What a policy knows of tasks, for a checkpoint's task file.

    Args:
        instructions: Embeddings of instructions.
        paraphrases: Sentences that stand for task strings; None for none.
        demonstrations: Demonstrations for evaluation; None if the policy needs or has none.
        frozen: Pretrained image encoder; None without one.
    """
    contents = instructions.contents()
    if paraphrases is not None:
        contents = contents._replace(paraphrases=paraphrases.known)
    if demonstrations is not None:
        contents = contents._replace(demonstrations=demonstrations_to_store(demonstrations, frozen))
    return contents


def demonstrations_to_store(known: DemonstrationSet, frozen: FrozenFeatures | None) -> StoredDemonstrations:
    """Demonstrations for a checkpoint's task file.

    Args:
        known: Demonstrations for evaluation.
        frozen: Pretrained image encoder, whose features are stored, so that it is not needed for them; None
            without one.
    """
    features = None if frozen is None else frozen.plain(known)
    frames, episodes = known.frames.cpu(), known.episodes.cpu()
    return StoredDemonstrations(
        frames, episodes, known.tasks, known.target_objects, features, known.grasp_states
    )


def check_stored_frames(stored: StoredDemonstrations, path: Path, config: DeltacoConfig) -> None:
    """Checks that demonstrations of a checkpoint have the images of its policy.

    Args:
        stored: Demonstrations of the checkpoint's task file.
        path: The file.
        config: Configuration of the policy.

    Raises:
        TaskFileError: They have other numbers of frames or pixels.
    """
    n_kept = len(kept_frame_indices(0, 0, config.n_demo_frames))
    check_demonstrations(path, stored, config.demo_image_size, n_kept)


def stored_demonstrations(
    stored: StoredDemonstrations, path: Path, config: DeltacoConfig
) -> DemonstrationSet:
    """Demonstrations of a checkpoint, with the features and the states at grasps that its policy uses.

    Args:
        stored: Demonstrations of the checkpoint's task file.
        path: The file.
        config: Configuration of the policy.

    Returns:
        Demonstrations for evaluation, on the CPU.

    Raises:
        TaskFileError: They have other numbers of features or states than the policy.
    """
    frames, episodes, tasks, target_objects, features, grasp_states = stored
    known = DemonstrationSet(frames, tasks, episodes.tolist(), target_objects)
    if grasp_states is not None and config.robot_state_feature is not None:
        check_grasp_states(path, stored, config.robot_state_feature.shape[0])
        known.grasp_states = grasp_states
    if features is not None and config.uses_demo and config.demo_encoder == "pretrained":
        check_features(path, stored, config.demo_feature_dim)
        known.features = features[:, None].half()
    return known
