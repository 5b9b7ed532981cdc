"""`deltaco-train --job.target`: what is submitted to Hugging Face Jobs, and what is refused. No network."""

import json
import re
import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace

import pytest
from lerobot.configs import JobConfig
from lerobot.jobs import hf

from lerobot_deltaco.commands.train import main
from lerobot_deltaco.configuration_deltaco import DeltacoConfig
from lerobot_deltaco.envs.configuration_env import DeltacoEnv
from lerobot_deltaco.training import loop
from lerobot_deltaco.training.remote_job import RemoteJobError, check_remote_job

ROOT = Path(__file__).parents[1]
IMAGE = "--job.image=me/lerobot-deltaco"
ON_HUB = {"me/train", "me/demos"}


@pytest.fixture
def submit(monkeypatch, tmp_path):
    """Runs the command, and returns what LeRobot would have submitted, and the configuration for it."""
    monkeypatch.chdir(tmp_path)

    class Api:
        def __init__(self, **_):
            pass

        def whoami(self, **_):
            return {"name": "me"}

        def repo_exists(self, repo_id, repo_type):
            return repo_type == "dataset" and repo_id in ON_HUB

    def stage(config, repo_id, token, tags=None):
        hf.build_remote_config_file(config, repo_id, tmp_path / "train_config.json", tags=tags)
        return repo_id

    jobs = []

    def run_job(**arguments):
        jobs.append(arguments)
        return SimpleNamespace(id="7")

    monkeypatch.setattr(hf, "get_token", lambda: "token")
    monkeypatch.setattr(hf, "HfApi", Api)
    monkeypatch.setattr(loop, "HfApi", Api)
    monkeypatch.setattr(hf, "_stage_config_on_hub", stage)
    monkeypatch.setattr(hf, "run_job", run_job)

    def submit(*more):
        arguments = {
            "policy.type": "deltaco",
            "policy.tasks_per_batch": "4",
            "policy.demo_repo_id": "me/demos",
            "dataset.repo_id": "me/train",
            "batch_size": "8",
            "output_dir": str(tmp_path / "run"),
            "job.target": "a10g-small",
            "job.detach": "true",
        }
        arguments |= dict(word.removeprefix("--").split("=", 1) for word in more)
        words = [f"--{name}={value}" for name, value in arguments.items() if value]
        monkeypatch.setattr(sys, "argv", ["deltaco-train", *words])
        main()
        (job,) = jobs
        return job, json.loads((tmp_path / "train_config.json").read_text())

    return submit


def test_a_job_runs_this_command_in_the_image_that_is_named(submit):
    job, config = submit(IMAGE)
    assert job["command"] == ["deltaco-train", f"--config_path={config['policy']['repo_id']}"]
    assert (job["image"], job["flavor"]) == ("me/lerobot-deltaco", "a10g-small")
    assert config["policy"]["tasks_per_batch"] == 4
    assert config["policy"]["demo_repo_id"] == "me/demos"
    assert config["policy"]["push_to_hub"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"image": JobConfig().image},
            "lerobot_policy_deltaco is not installed. Build one from examples",
        ),
        ({"demo_root": "no/such"}, "no/such is a folder of this machine.*deltaco-push --root no/such"),
        ({"demo_repo_id": "me/other"}, "dataset me/other from the Hub, where it is not"),
        ({"repo_id": "me/own", "root": "here"}, "deltaco-push --root here --repo-id me/own"),
        ({"instructions": "HERE"}, "--policy.instructions=.* Put it into the image"),
        ({"env_instructions": "HERE"}, "--env.instructions=.* is a file of this machine"),
        ({"path": "HERE"}, "--policy.path=.* is a folder of this machine"),
    ],
)
def test_what_a_job_cannot_see_is_refused(options, message, tmp_path, monkeypatch):
    options = {name: value.replace("HERE", str(tmp_path)) for name, value in options.items()}
    path = options.pop("path", None)
    monkeypatch.setattr(sys, "argv", ["deltaco-train", *([f"--policy.path={path}"] if path else [])])
    image, root = options.pop("image", "me/lerobot-deltaco"), options.pop("root", None)
    dataset = SimpleNamespace(repo_id=options.pop("repo_id", "me/train"), root=root)
    env = DeltacoEnv(instructions=options.pop("env_instructions", None))
    job = SimpleNamespace(image=image, target="a10g-small")
    policy = None if path else DeltacoConfig(device="cpu", **{"demo_repo_id": "me/demos", **options})
    config = SimpleNamespace(policy=policy, job=job, dataset=dataset, env=env)
    with pytest.raises(RemoteJobError, match=message):
        check_remote_job(config, ON_HUB.__contains__)


def test_a_refusal_ends_the_command(submit):
    with pytest.raises(SystemExit, match="deltaco-train: --policy.demo_root=demos is a folder"):
        submit(IMAGE, "--policy.demo_root=demos")


def test_the_dockerfile_installs_extras_that_exist():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    text = (ROOT / "examples/Dockerfile").read_text()
    (extras,) = re.findall(r"'\.\[(.+)\]'", text)
    assert set(extras.split(",")) <= set(project["optional-dependencies"])
    assert f"LEROBOT_IMAGE={JobConfig().image}" in text
