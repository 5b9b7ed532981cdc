"""The example of a policy that takes demonstrations from the benchmark: `examples/`."""

import sys

import pytest
import torch
from gymnasium.utils.env_checker import check_env
from lerobot.datasets import LeRobotDataset
from lerobot.scripts import lerobot_eval
from lerobot_policy_example import ExamplePolicy
from small_policies import as_options, run_training

from gym_deltaco.scene_config import SceneConfig
from gym_deltaco.tasks import get_task
from lerobot_deltaco.collection.collect import CollectionPlan, collect
from lerobot_deltaco.data.images import as_uint8
from lerobot_deltaco.evaluation.checkpoints import find_checkpoints, load_policy
from lerobot_deltaco.evaluation.command import EvaluateArguments, evaluate_checkpoints
from lerobot_deltaco.evaluation.evaluate import evaluate
from lerobot_deltaco.evaluation.protocol_env import ProtocolEnv
from lerobot_deltaco.evaluation.records import EvaluationPlan, read_records

TASKS = "24,35"


@pytest.fixture(scope="module")
def checkpoint(benchmark, tmp_path_factory):
    """A checkpoint of the example after two steps of `lerobot-train`."""
    folder = tmp_path_factory.mktemp("example")
    options = {"policy.type": "example", "policy.push_to_hub": False}
    run_training(benchmark, folder / "run", options, in_memory=False, steps=2)
    return find_checkpoints(folder / "run")[-1].folder


@pytest.fixture
def received(spy):
    """What the network of the example receives: sentence, and ends of the demonstration."""
    found = set()

    def note(self, scenes, sentences, ends):
        pixels = (255 * ends).round().byte().contiguous().numpy()
        found.update((text, own.tobytes()) for text, own in zip(sentences, pixels, strict=True))

    spy(ExamplePolicy, "find", note)
    return found


def test_evaluations_give_the_demonstrations_of_the_protocol(checkpoint, received, tmp_path, monkeypatch):
    plan = EvaluationPlan(TASKS, trials=2, scene=SceneConfig(episode_length=2))
    evaluate_checkpoints(EvaluateArguments(checkpoint, plan, out=tmp_path, processes=1, device="cpu"))
    episodes = read_records(tmp_path)[0].episodes
    assert episodes["demonstration_task"].tolist() == [24, 24, 35, 35]
    for task_id, (shown,) in zip(episodes["task_id"], episodes["demonstrated_objects"], strict=True):
        assert shown in get_task(task_id).targets
    # The same as the task's first episode for validation.
    collect(tmp_path / "e102", CollectionPlan(TASKS, 1, split="validation"))
    dataset = LeRobotDataset("test/e102", root=tmp_path / "e102")
    for episode in dataset.meta.episodes:
        ends = [episode["dataset_from_index"], episode["dataset_to_index"] - 1]
        images = torch.stack([dataset[index]["observation.image"] for index in ends])
        assert (episode["tasks"][0], as_uint8(images).numpy().tobytes()) in received
    by_set_tasks = set(received)
    received.clear()
    options = {
        **{"policy.path": checkpoint, "policy.device": "cpu", "output_dir": tmp_path / "eval"},
        **{"env.type": "deltaco", "env.task": TASKS, "env.demonstrations": True, "env.render_size": 16},
        **{"env.scene.episode_length": 2, "eval.n_episodes": 1, "eval.batch_size": 1},
    }
    monkeypatch.setattr(sys, "argv", ["eval", *as_options(options)])
    lerobot_eval.main()
    assert received == by_set_tasks


def test_another_tasks_demonstration_can_be_given(checkpoint):
    plan = EvaluationPlan(TASKS, 1, scene=SceneConfig(episode_length=1), counterfactual="demonstration")
    episodes = evaluate(load_policy(checkpoint, ["--device=cpu"]), plan)
    assert episodes["demonstration_task"].tolist() == [35, 24]
    assert episodes["demonstrated_objects"][0][0] in get_task(35).targets


def test_an_observation_has_the_demonstration_on_request():
    assert set(ProtocolEnv(task_id=24).observation_space) == {"pixels", "agent_pos"}
    env = ProtocolEnv(task_id=24, demonstrations=True)
    check_env(env, skip_render_check=True)
    first, other = (env.reset(options={"task_id": task_id})[0] for task_id in (24, 35))
    assert (first["demonstration"] != other["demonstration"]).any()
    later = env.step(env.action_space.sample())[0]
    assert (later["demonstration"] == other["demonstration"]).all()
