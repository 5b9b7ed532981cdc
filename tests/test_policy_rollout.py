"""On a robot: a demonstration is recorded, and a policy performs its task, by LeRobot's commands."""

import json
import os
import re
import shlex
from pathlib import Path

import pytest
from fresh_python import run_python
from lerobot.configs import parser
from lerobot.rollout.configs import RolloutConfig
from lerobot.scripts.lerobot_record import RecordConfig

import lerobot_policy_deltaco  # noqa: F401  (registers the policy)

TASK = "lift the arm"
NEW_TASK = "drop it"
SENTENCE = "please raise it a little"
POLICY = "train/checkpoints/last/pretrained_model"

# One process for all of it, since importing LeRobot takes 10 s. Each command leaves the robot's actions in a
# file. At the end, the policy is used without a command.
SESSION = """
import json, sys
from pathlib import Path

import numpy as np
import torch
from fake_robot import FakeArm, FakeArmConfig
from lerobot.configs import PreTrainedConfig
from lerobot.policies import make_pre_post_processors
from lerobot.policies.utils import prepare_observation_for_inference
from lerobot.scripts import lerobot_record, lerobot_rollout, lerobot_train
from small_policies import fake_encoder, instruction_table

from lerobot_deltaco.modeling_deltaco import DeltacoPolicy

commands, folder, task = json.loads(sys.argv[1]), sys.argv[2], sys.argv[3]
fake_encoder.calls = []
instruction_table.load_language_encoder = fake_encoder
for name, *words in commands:
    module = {"record": lerobot_record, "train": lerobot_train}.get(name, lerobot_rollout)
    FakeArm.sent.clear()
    sys.argv = [f"lerobot-{name.partition('_')[0]}", *words]
    module.main()
    Path(f"{name}.json").write_text(json.dumps(FakeArm.sent))

FakeArm.sent.clear()
config = PreTrainedConfig.from_pretrained(folder)
config.demo_repo_id, config.demo_root, config.demo_episode = "me/demos", "demos", 0
policy = DeltacoPolicy.from_pretrained(folder, config=config)
before, after = make_pre_post_processors(config, folder)
robot = FakeArm(FakeArmConfig())
for _ in range(3):
    seen = robot.get_observation()
    frame = {
        "observation.images.front": seen["front"],
        "observation.state": np.array([seen["shoulder.pos"], seen["gripper.pos"]], np.float32),
    }
    batch = prepare_observation_for_inference(frame, torch.device("cpu"), task)
    with torch.inference_mode():
        action = after(policy.select_action(before(batch)))
    robot.send_action(dict(zip(robot.action_features, action[0].tolist())))
Path("loop.json").write_text(json.dumps(FakeArm.sent))
"""


def record(repo_id, root, task, n_episodes):
    """The README's command."""
    return [
        *("record", "--robot.type=fake_arm", "--teleop.type=fake_leader", "--play_sounds=false"),
        *(f"--dataset.repo_id={repo_id}", "--dataset.no_stamp=true", f"--dataset.root={root}"),
        *(f"--dataset.single_task={task}", f"--dataset.num_episodes={n_episodes}", "--dataset.fps=20"),
        *("--dataset.episode_time_s=0.5", "--dataset.reset_time_s=0", "--dataset.push_to_hub=false"),
        "--dataset.rgb_encoder.vcodec=h264",
    ]


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """The folder of a session: a task and a demonstration are recorded, a policy is trained and used."""
    folder = tmp_path_factory.mktemp("session")
    policy = folder / POLICY
    rollout = [
        *(f"--policy.path={policy}", "--robot.type=fake_arm"),
        *("--policy.demo_repo_id=me/demos", f"--policy.demo_root={folder / 'demos'}"),
        *("--fps=20", "--duration=1", "--return_to_initial_position=false"),
    ]
    commands = [
        record("me/tasks", folder / "tasks", TASK, 3),
        record("me/demos", folder / "demos", NEW_TASK, 1),
        [
            *("train", "--policy.type=deltaco", "--policy.device=cpu", "--policy.image_size=16"),
            *(
                "--policy.backbone=strided",
                "--dataset.repo_id=me/tasks",
                f"--dataset.root={folder / 'tasks'}",
            ),
            *("--dataset.video_backend=pyav", "--steps=2", "--batch_size=4", "--num_workers=0"),
            f"--output_dir={folder / 'train'}",
        ],
        [
            *("rollout_same_words", f"--task={NEW_TASK}"),
            *rollout,
        ],
        ["rollout", f"--task={SENTENCE}", "--policy.demo_episode=0", *rollout],
    ]
    result = run_python(
        *(SESSION, json.dumps(commands), policy, SENTENCE),
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parent), "HF_HOME": str(folder / "cache")},
    )
    assert result.returncode == 0, result.stderr[-3000:]
    return folder


@pytest.mark.parametrize("rollout", ["rollout_same_words", "rollout"])
def test_a_rollout_moves_the_robot_within_what_it_has_learned(session, rollout):
    recorded, sent = (json.loads((session / f"{name}.json").read_text()) for name in ("record", rollout))
    assert len(recorded) >= 5
    assert 5 <= len(sent) <= 20
    for action in sent:
        assert set(action) == {"shoulder.pos", "gripper.pos"}
        assert 0 <= action["gripper.pos"] <= 40


def test_a_plain_loop_does_the_same(session):
    sent, looped = (json.loads((session / f"{name}.json").read_text()) for name in ("rollout", "loop"))
    for action, other in zip(sent[:3], looped, strict=True):
        assert other == pytest.approx(action, rel=1e-5, abs=1e-5)


def test_the_demonstrations_are_the_recorded_ones(session):
    """What `lerobot-record` wrote is a video of one episode of one task."""
    info = json.loads((session / "demos/meta/info.json").read_text())
    assert (info["total_episodes"], info["total_tasks"]) == (1, 1)
    assert info["features"]["observation.images.front"]["dtype"] == "video"


@parser.wrap()
def parsed_record(config: RecordConfig):
    return config


@parser.wrap()
def parsed_rollout(config: RolloutConfig):
    return config


def test_the_commands_of_the_robots_page_are_lerobots(session, monkeypatch):
    def words(name):
        return shlex.split(re.search(rf"^(lerobot-{name} .+)$", page, re.MULTILINE)[1])

    page = (Path(__file__).parents[1] / "docs" / "robot.md").read_text().replace("\\\n", " ")
    monkeypatch.setattr("sys.argv", words("record"))
    recorded = parsed_record()
    ours = {"--policy.path": f"--policy.path={session / POLICY}"}
    monkeypatch.setattr("sys.argv", [ours.get(word.split("=")[0], word) for word in words("rollout")])
    rollout = parsed_rollout()
    dataset, policy = recorded.dataset, rollout.policy
    assert (dataset.num_episodes, dataset.no_stamp) == (1, True)
    assert (policy.demo_repo_id, policy.demo_root) == (dataset.repo_id, str(dataset.root))
    assert policy.demo_episode is None
    assert recorded.robot == rollout.robot
    assert rollout.fps == dataset.fps
    assert rollout.task == dataset.single_task
