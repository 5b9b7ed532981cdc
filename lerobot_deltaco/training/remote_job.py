"""Trainings on Hugging Face Jobs, by LeRobot's `--job.target`: what cannot work there is refused beforehand.

The job starts with an empty disk. It gets the configuration alone, and everything else from the Hub.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from lerobot.configs import JobConfig, parser
from lerobot.configs.train import TrainPipelineConfig

from lerobot_deltaco.configuration_deltaco import PATHS, DeltacoConfig
from lerobot_deltaco.envs.configuration_env import DeltacoEnv

DOCKERFILE = "examples/Dockerfile"


class RemoteJobError(ValueError):
    """The training cannot run on another machine; the message says why, and what to do."""


def check_remote_job(config: TrainPipelineConfig, is_on_hub: Callable[[str], bool]) -> None:
    """Checks that a job needs nothing that only this machine has.

    Args:
        config: Configuration of the training, as the command line gives it.
        is_on_hub: Whether a dataset of this name is on the Hub.

    Raises:
        RemoteJobError: It needs something else.
    """
    target = config.job.target
    if config.job.image == JobConfig().image:
        raise RemoteJobError(
            f"--job.image is LeRobot's own image {config.job.image}, in which lerobot_policy_deltaco is not "
            f"installed. Build one from {DOCKERFILE}, push it, and name it: --job.image=USER/lerobot-deltaco."
        )
    path = parser.get_path_arg("policy")
    if path is not None and Path(path).exists():
        raise RemoteJobError(
            f"--policy.path={path} is a folder of this machine, which a job on {target} does not see. Push "
            "the policy to the Hub, and give its name."
        )
    ours = config.policy if isinstance(config.policy, DeltacoConfig) else None
    if ours is not None and ours.demo_root is not None:
        raise RemoteJobError(
            f"--policy.demo_root={ours.demo_root} is a folder of this machine, which a job on {target} "
            f"does not see. Push the demonstrations (deltaco-push --root {ours.demo_root} --repo-id "
            "USER/NAME), and give --policy.demo_repo_id=USER/NAME alone."
        )
    files = {} if ours is None else {f"policy.{name}": getattr(ours, name) for name in PATHS}
    if isinstance(config.env, DeltacoEnv):
        files["env.instructions"] = config.env.instructions
    for option, value in files.items():
        if value is not None and Path(value).exists():
            raise RemoteJobError(
                f"--{option}={value} is a file of this machine, which a job on {target} does not see. Put it "
                f"into the image (see {DOCKERFILE}), and give its path there."
            )
    needed = {"dataset": (config.dataset.repo_id, config.dataset.root)}
    if ours is not None and ours.demo_repo_id is not None:
        needed["policy.demo"] = (ours.demo_repo_id, None)
    for option, (repo_id, root) in needed.items():
        # LeRobot itself pushes a dataset that is in its cache, but not one from another folder.
        if (option != "dataset" or root is not None) and not is_on_hub(repo_id):
            folder = "FOLDER" if root is None else root
            raise RemoteJobError(
                f"A job on {target} fetches the dataset {repo_id} from the Hub, where it is not, or cannot "
                f"be seen with your token. Push it first: deltaco-push --root {folder} --repo-id {repo_id}."
            )
