"""Adds matching by pretrained features to a trained policy, or fits that of a policy anew."""

from __future__ import annotations

import json
import logging
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

from draccus.utils import ParsingError
from lerobot.datasets import LeRobotDatasetMetadata
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from lerobot_deltaco.common.run_folder import TRAIN_CONFIG, WEIGHTS
from lerobot_deltaco.configuration_deltaco import DeltacoConfig
from lerobot_deltaco.lerobot_internals import reason_of
from lerobot_deltaco.modeling.checkpoint_files import MATCHING_PREFIX
from lerobot_deltaco.modeling.goal_learning import fit_pretrained_matching
from lerobot_deltaco.modeling.task_sources import read_eval_demonstrations
from lerobot_deltaco.modeling_deltaco import DeltacoPolicy
from lerobot_deltaco.policy.dataset_folders import check_dataset_folder
from lerobot_deltaco.policy.goals.pretrained_matching import PretrainedMatching
from lerobot_deltaco.policy.goals.words import vocabulary_of
from lerobot_deltaco.policy.training_episodes import kept_episodes
from lerobot_deltaco.policy.vision import load_efficientnet_lite0

logger = logging.getLogger(__name__)


def add_matching(checkpoint: Path, repo_id: str, root: Path | None, out: Path, seed: int) -> int:
    """Saves a policy with matching that is fitted to the episodes of a dataset, in place of any that it has.

    If it is the dataset that the policy was trained on, by its name or its folder, episodes that the training
    did not use are left out.

    Args:
        checkpoint: Folder of the policy.
        repo_id: Repository id of the dataset.
        root: Folder of the dataset; None for LeRobot's cache.
        out: Folder of the new checkpoint, which must not exist. It gets all files of the old one, except for
            its card and the configuration of its training, which describe the old policy.
        seed: Seed of the draws.

    Returns:
        Number of episodes.

    Raises:
        FileNotFoundError: There is no such checkpoint or dataset.
        ValueError: The policy finds no goals by demonstrations and depths, does not fit the dataset, or has
            an invalid configuration.
        VisionEncoderError: The weights of EfficientNet-Lite0 are missing.
    """
    if out.resolve().is_relative_to(checkpoint.resolve()):
        raise ValueError(f"{out} is in the folder of the checkpoint itself. Name a folder outside of it.")
    if not (checkpoint / "config.json").is_file():
        raise FileNotFoundError(f"{checkpoint} is no checkpoint: it has no config.json.")
    with tempfile.TemporaryDirectory() as folder:
        try:
            policy = DeltacoPolicy.from_pretrained(_without_matching(checkpoint, Path(folder)))
        except ParsingError as error:
            raise ValueError(f"The configuration of {checkpoint} is invalid: {reason_of(error)}") from error
    goals, config = policy.goals, policy.config
    if goals is None or not config.uses_demo or not config.grasp_depth:
        raise ValueError(
            "Matching by pretrained features is for policies with demo_encoder=correspondence and "
            "grasp_depth that get demonstrations."
        )
    check_dataset_folder("--dataset.root", root)
    load_efficientnet_lite0()  # for its errors, before minutes of decoding
    data = replace(config, demo_repo_id=repo_id, demo_root=None if root is None else str(root))
    episodes = read_eval_demonstrations(data, _episodes_of_training(checkpoint, config, repo_id, root))
    assert episodes is not None
    assert config.device is not None
    episodes = episodes.to(config.device)
    if episodes.grasp_states is None:
        raise ValueError(f"The policy of {checkpoint} knows no gripper, by which grasps are found.")
    known_words = vocabulary_of(episodes.tasks) if config.uses_language else []
    matching = PretrainedMatching(len(known_words), detail=config.goal_detail).to(config.device)
    places = goals.states.grasp_places(episodes.grasp_states)
    fit_pretrained_matching(matching, episodes, places, known_words, seed)
    goals.matching = matching
    config.pretrained_matching, config.known_words = True, known_words
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.name}.") as folder:
        new = Path(folder) / out.name
        shutil.copytree(checkpoint, new, ignore=shutil.ignore_patterns("README.md", "train_config.json"))
        policy.save_pretrained(new)
        new.rename(out)
    return len(episodes.tasks)


def _without_matching(checkpoint: Path, folder: Path) -> Path:
    """The checkpoint itself if it has no matching; else one without, whatever layout its matching has."""
    try:
        weights = load_file(checkpoint / WEIGHTS)
    except SafetensorError as error:
        raise ValueError(f"{checkpoint / WEIGHTS} is damaged ({error}). Fetch or train it again.") from error
    kept = {name: value for name, value in weights.items() if not name.startswith(MATCHING_PREFIX)}
    if len(kept) == len(weights):
        return checkpoint
    logger.warning("The policy of %s has matching by pretrained features, which is fitted anew.", checkpoint)
    if not (checkpoint / TRAIN_CONFIG).is_file():
        logger.warning(
            "%s does not say which episodes it was trained on. All episodes of the dataset are used.",
            checkpoint,
        )
    for file in checkpoint.iterdir():
        (folder / file.name).symlink_to(file.resolve())
    for name in ("config.json", WEIGHTS):
        (folder / name).unlink()
    config = json.loads((checkpoint / "config.json").read_text(encoding="utf-8"))
    config |= {"pretrained_matching": False, "known_words": []}
    (folder / "config.json").write_text(json.dumps(config), encoding="utf-8")
    save_file(kept, folder / WEIGHTS, metadata={"format": "pt"})
    return folder


def _episodes_of_training(
    checkpoint: Path, config: DeltacoConfig, repo_id: str, root: Path | None
) -> list[int] | None:
    """The episodes that a policy was trained on, if its checkpoint says so; None for all of the dataset.

    Raises:
        ValueError: The dataset does not have them.
    """
    path = checkpoint / TRAIN_CONFIG
    if not path.is_file():
        return None
    dataset = json.loads(path.read_text(encoding="utf-8")).get("dataset") or {}
    chosen, held_back = dataset.get("episodes"), dataset.get("eval_split") or 0.0
    chosen = config.demo_episodes or chosen
    if not (chosen or held_back):
        return None
    name, folder = dataset.get("repo_id"), dataset.get("root")
    is_folder = root is not None and folder is not None and root.resolve() == Path(folder).resolve()
    if name != repo_id and not is_folder:
        logger.warning(
            "The policy was trained on some of the episodes of %s (%s). The matching is fitted to all "
            "episodes of the dataset given here; if it is the same, name it --dataset.repo_id=%s.",
            name,
            folder or "LeRobot's cache",
            name,
        )
        return None
    meta = LeRobotDatasetMetadata(repo_id, root=root)
    if chosen and max(chosen) >= meta.total_episodes:
        raise ValueError(
            f"The policy was trained on episodes up to {max(chosen)} of {repo_id}, but the dataset has only "
            f"{meta.total_episodes}. Name the dataset that it was trained on, or give this one another name "
            "with --dataset.repo_id to fit the matching to all of its episodes."
        )
    return list(config.demo_episodes or kept_episodes(meta, chosen, held_back))
