"""Reads what specifies a policy's tasks: the demonstrations and sentences that its configuration names."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from pathlib import Path

from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.utils.constants import ACTION, OBS_STATE

from lerobot_deltaco.configuration_deltaco import DeltacoConfig
from lerobot_deltaco.data.paraphrases import read_paraphrases
from lerobot_deltaco.policy.dataset_folders import check_dataset_folder
from lerobot_deltaco.policy.demonstrations import (
    DemonstrationSet,
    RobotData,
    check_robot_features,
    load_demonstrations,
    load_robot_data,
)
from lerobot_deltaco.policy.goals.keyframes import find_keyframes
from lerobot_deltaco.policy.language.paraphrases import Paraphrases
from lerobot_deltaco.policy.training_episodes import training_episodes

logger = logging.getLogger(__name__)


def read_demonstrations(
    config: DeltacoConfig, repo_id: str, root: str | Path | None, episodes: Sequence[int] | None
) -> DemonstrationSet:
    """Demonstrations as a policy sees them.

    Args:
        config: Configuration of the policy.
        repo_id: Repository id of the dataset.
        root: Folder of the dataset; None for LeRobot's cache.
        episodes: Episodes to read; None for all.

    Raises:
        FileNotFoundError: There is no network, and no dataset in the folder.
        ValueError: The dataset has no such camera or episode, or its images are too small for finding goals.
    """
    camera = config.cameras[0]
    return load_demonstrations(
        repo_id,
        root,
        episodes,
        camera,
        config.demo_image_size,
        config.n_demo_frames,
        may_enlarge=config.goal_image_size is None,
    )


def warn_of_plain_batches(config: DeltacoConfig) -> None:
    """Warns of options that have no effect, since the training loop draws samples of any tasks.

    Args:
        config: Configuration of the policy.
    """
    options = ["`tasks_per_batch`"] if config.tasks_per_batch else []
    if config.frames_after_release is not None:
        options.append("`frames_after_release`")
    if options:
        logger.warning(
            "%s no effect: this training loop draws any frames of any tasks. Train with `deltaco-train`, "
            "which takes the same arguments.",
            f"{' and '.join(options)} {'has' if len(options) == 1 else 'have'}",
        )


def read_training_demonstrations(
    config: DeltacoConfig, meta: LeRobotDatasetMetadata | None
) -> tuple[DemonstrationSet, RobotData | None]:
    """The demonstrations for training, which are episodes of the training dataset.

    Args:
        config: Configuration of the policy.
        meta: Metadata of the training dataset.

    Returns:
        Demonstrations, and the robot's states and actions in them; None unless goals are located.

    Raises:
        ValueError: There are no metadata.
    """
    if meta is None:
        raise ValueError("A policy is trained with the metadata of its dataset. Pass them as `dataset_meta`.")
    chosen = config.demo_episodes or training_episodes(meta)
    demonstrations = read_demonstrations(config, meta.repo_id, meta.root, chosen)
    data = load_robot_data(meta.repo_id, meta.root, chosen) if config.locates_goals else None
    return demonstrations, data


def read_eval_demonstrations(
    config: DeltacoConfig, episodes: Sequence[int] | None = None
) -> DemonstrationSet | None:
    """The demonstrations for evaluation, with the robot's states at grasps if depths are estimated.

    Args:
        config: Configuration of the policy.
        episodes: Episodes of the dataset; None for all.

    Returns:
        Those episodes of the dataset `demo_repo_id`; None if none is named.

    Raises:
        FileNotFoundError: There is no network, and no dataset in the folder.
        ValueError: The dataset does not have the camera, or is of another robot.
    """
    repo_id, root = config.demo_repo_id, config.demo_root
    if repo_id is None:
        return None
    finds_grasps = config.locates_goals and config.grasp_depth and config.gripper_index is not None
    if finds_grasps:
        check_dataset_folder("--policy.demo_root", root)
        shapes = {OBS_STATE: config.robot_state_feature.shape, ACTION: config.action_feature.shape}
        check_robot_features(repo_id, LeRobotDatasetMetadata(repo_id, root=root).features, shapes)
    demonstrations = read_demonstrations(config, repo_id, root, episodes)
    if finds_grasps:
        data = load_robot_data(repo_id, root, demonstrations.episodes.tolist())
        keyframes = find_keyframes(data.states, config.gripper_opening(data.actions), data.spans)
        demonstrations.grasp_states = keyframes.grasp_states
    return demonstrations


def read_sentences(config: DeltacoConfig) -> Paraphrases | None:
    """Sentences that people wrote for task strings; None if `instructions` names none.

    Args:
        config: Configuration of the policy.
    """
    if config.instructions is None:
        return None
    known = read_paraphrases(config.instructions)
    drawn = read_paraphrases(config.instructions, config.instructions_split)
    return Paraphrases(known, drawn, config.instructions_templates)


def one_hot_vocabulary(meta: LeRobotDatasetMetadata | None, demonstrated: Iterable[str]) -> list[str]:
    """The tasks that a one-hot policy knows.

    Args:
        meta: Metadata of the training dataset.
        demonstrated: Task strings of the demonstrations for evaluation.

    Returns:
        Task strings of both, each once.

    Raises:
        ValueError: There are no metadata.
    """
    if meta is None:
        raise ValueError(
            "A one-hot policy knows the tasks of its dataset. Pass the metadata as `dataset_meta`."
        )
    return list(dict.fromkeys([*meta.tasks.index, *demonstrated]))
