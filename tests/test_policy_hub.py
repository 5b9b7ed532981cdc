"""A policy's card, and the policy's way to the Hub and back, with real clients and a fake Hub."""

import json
import re
import shlex
from pathlib import Path
from types import SimpleNamespace

import pytest
from fake_hub import USER, WITHOUT_CARD_CHECK, FakeHub
from fresh_python import run_python
from huggingface_hub import ModelCard
from lerobot.cameras.opencv import OpenCVCameraConfig  # noqa: F401  (`type: opencv` on the command line)
from lerobot.configs import FeatureType, PolicyFeature, parser
from lerobot.configs.default import DatasetConfig
from lerobot.configs.eval import EvalPipelineConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.robots import so_follower  # noqa: F401  (`--robot.type=so101_follower`)
from lerobot.rollout.configs import RolloutConfig
from small_policies import REPO_ID, TASKS, small_policy, write_dataset

from gym_deltaco import ENV_ID
from gym_deltaco.tasks import TASKS as BENCHMARK_TASKS
from lerobot_deltaco.collect import CollectionPlan
from lerobot_deltaco.configuration_deltaco import DeltacoConfig
from lerobot_deltaco.envs.configuration_env import DeltacoEnv
from lerobot_deltaco.policy.language.instruction_table import LANGUAGE_ENCODERS
from lerobot_deltaco.policy.options import METHODS
from lerobot_deltaco.policy_card import MAX_TASKS_LISTED, METHOD_TEXTS, policy_card

POLICY_ID = f"{USER}/policy"


pytestmark = pytest.mark.usefixtures("fake_language")


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    return write_dataset(tmp_path_factory.mktemp("data") / "demos", [*TASKS, "juggle"])


def foreign_card(dataset, train_config=None, **options):
    """The card of a small policy, as a push makes it, and the policy."""
    policy, _, _ = small_policy(dataset, repo_id=POLICY_ID, **options)
    config = policy.config
    return policy.generate_model_card(
        REPO_ID, config.type, config.license, config.tags, cfg=train_config, dataset_meta=dataset.meta
    ), policy


def benchmark_card(train_config=None, plan=None, shown_tasks=(), **options):
    """The card of a policy that was trained on the benchmark."""
    plan = plan or CollectionPlan("4,50-59", 2)
    config = DeltacoConfig(
        device="cpu",
        repo_id=POLICY_ID,
        input_features={
            "observation.image": PolicyFeature(FeatureType.VISUAL, (3, plan.image_size, plan.image_size)),
            "observation.state": PolicyFeature(FeatureType.STATE, (10,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (4,))},
        **options,
    )
    config.resolve(plan.features)
    meta = SimpleNamespace(
        features=plan.features,
        total_episodes=plan.n_episodes,
        episodes={"tasks": [[BENCHMARK_TASKS[task].instruction] for task in plan.task_ids for _ in range(2)]},
        robot_type="widowx_250",
        fps=10,
    )
    return policy_card(config, shown_tasks, 0, f"{USER}/t11", train_config=train_config, meta=meta)


def words_of(card):
    """The card without line breaks, backquotes and asterisks."""
    return " ".join(re.sub("[`*]", "", card.text).split())


def commands(card):
    """The commands in a card, as lists of words."""
    blocks = re.findall(r"```bash\n(.*?)```", card.text, re.DOTALL)
    return [shlex.split(line) for line in "".join(blocks).replace("\\\n", " ").splitlines()]


@parser.wrap()
def parsed_eval(config: EvalPipelineConfig):
    return config


@parser.wrap()
def parsed_rollout(config: RolloutConfig):
    return config


def parsed(command, folder, monkeypatch):
    """What LeRobot makes of a command, with the policy in a folder."""
    filled = {POLICY_ID: str(folder), "ROBOT": "so101_follower", "PORT": "/dev/null", "TASKS": "4"}
    program, *words = [re.sub("|".join(filled), lambda match: filled[match[0]], word) for word in command]
    monkeypatch.setattr("sys.argv", [program, *words])
    return {"lerobot-eval": parsed_eval, "lerobot-rollout": parsed_rollout}[program]()


# The card


@pytest.mark.parametrize("method", METHODS)
def test_every_method_has_a_card(dataset, method):
    card, _ = foreign_card(dataset, method=method)
    assert set(METHOD_TEXTS) == set(METHODS)
    name, summary = METHOD_TEXTS[method]
    assert f"# {name}, trained on {REPO_ID}" in card.text
    assert summary in card.text
    assert "None" not in card.text
    assert "\n\n\n" not in card.text
    uses_demo = method not in ("language_only", "one_hot")
    assert ("--policy.demo_repo_id" in card.text) == uses_demo
    assert ("| demonstration | 1 x 2 frames" in card.text) == uses_demo
    uses_language = method != "one_hot"
    assert ("paraphrase-MiniLM-L3-v2" in card.text) == uses_language


def test_the_metadata_are_what_the_hub_searches(dataset):
    card, _ = foreign_card(dataset, license="mit", tags=["cups", "lerobot"])
    data = ModelCard(str(card)).data
    assert (data.library_name, data.pipeline_tag, data.license) == ("lerobot", "robotics", "mit")
    assert data.datasets == [REPO_ID]
    assert {"lerobot", "robotics", "deltaco", "cups"} <= set(data.tags)
    assert len(data.tags) == len(set(data.tags))
    assert data.model_name == "deltaco"
    assert data.eval_results is None
    assert foreign_card(dataset)[0].data.license == "apache-2.0"


def test_the_card_says_how_the_gripper_closes_and_that_things_are_matched(dataset):
    assert "is the gripper, which small values close" in foreign_card(dataset)[0].text
    options = {"demo_encoder": "correspondence", "pretrained_matching": True, "gripper_closed": "high"}
    card, _ = foreign_card(dataset, **options)
    assert "is the gripper, which large values close" in card.text
    assert "| matching | also by the features of EfficientNet-Lite0" in card.text


def test_the_card_says_what_was_trained_and_on_what(dataset):
    train_config = TrainPipelineConfig(
        DatasetConfig(REPO_ID, episodes=[0, 1, 2, 3]), steps=12_345, batch_size=24, seed=77
    )
    card, _ = foreign_card(dataset, train_config, seed=5, language_encoder="all-distilroberta-v1")
    text = words_of(card)
    assert f"Trained on: {REPO_ID}, 4 episodes of 2 tasks" in text
    rows = dict(re.findall(r"^\| ([^|]+) \| ([^|]+) \|$", card.text, re.MULTILINE))
    assert (rows["steps"], rows["batch size"], rows["seed"]) == ("12,345", "24", "77")
    assert (rows["optimizer"], rows["learning rate"]) == ("Adam", "0.0003, constant")
    assert (rows["gripper loss"], rows["random shifts of observations"]) == (
        "squared error, weight 30",
        "up to 4 pixels",
    )
    assert (rows["backbone"], rows["seed of demonstrations and crops"]) == ("strided", "5")
    assert rows["input through FiLM, in each residual block"] == "the embedding of the demonstration"
    assert "embedding of the instruction, and the robot's state" in text
    assert "contrastive, with the instructions of the batch; weight 10, temperature 0.1" in text
    encoder = LANGUAGE_ENCODERS["all-distilroberta-v1"].repo_id
    assert f"https://huggingface.co/{encoder}" in rows["language encoder"]
    assert "independent reimplementation" in text
    assert "arxiv.org/abs/2210.04476" in text
    assert "@inproceedings{yu2023deltaco" in card.text


def test_the_card_names_what_was_chosen_for_a_run():
    chosen = {
        "tasks_per_batch": 16,
        "upsampled_tasks": "green|red",
        "scheduler_name": "cosine",
        "scheduler_warmup_steps": 1000,
        "optimizer_weight_decay": 0.01,
        "gripper_loss": "cross_entropy",
    }
    text = benchmark_card(**chosen).text
    for row in (
        "| learning rate | 0.0003, cosine after 1,000 steps |",
        "| weight decay | 0.01 |",
        "| tasks in a batch | 16 |",
        "| tasks drawn more often | those with `green\\|red`, 50% of each batch |",
        "| gripper loss | cross entropy, weight 3 |",
    ):
        assert row in text


def test_an_ablation_is_named(dataset):
    card, _ = foreign_card(dataset, film="language", concat="demo", encoder_loss="cosine")
    changed = "film is language, concat is demo, encoder_loss is cosine."
    assert f"an ablation of that method: {changed}" in words_of(card)
    assert "ablation" not in foreign_card(dataset)[0].text


def test_what_is_beyond_the_paper_is_named(dataset):
    ours = words_of(foreign_card(dataset, demo_encoder="attention", motion_modes=5)[0])
    assert "| demonstration encoder | a convolutional network with attention" in ours
    assert "the mean of the likeliest of 5 Gaussians" in ours
    paper = words_of(foreign_card(dataset)[0])
    assert "| demonstration encoder | the paper's convolutional network" in paper
    assert "Gaussians" not in paper


def test_the_demonstrations_that_it_carries_are_listed(dataset, demos):
    text = words_of(foreign_card(dataset)[0])
    assert "has no demonstrations" in text
    card, _ = foreign_card(dataset, demo_repo_id=REPO_ID, demo_root=str(demos.root))
    assert "has demonstrations of 4 tasks" in words_of(card)
    assert all(f"\n- {task}\n" in card.text for task in [*TASKS, "juggle"])
    assert str(demos.root) not in card.text
    many = [f"task\n {number}" for number in range(MAX_TASKS_LISTED + 3)]
    text = benchmark_card(shown_tasks=many).text
    assert "\n- task 9\n" in text
    assert "\n- task 10\n" not in text
    assert "\n- and 3 more\n" in text


def test_a_policy_of_the_benchmark_names_its_version():
    card = benchmark_card()
    text = words_of(card)
    assert f'Benchmark version: {ENV_ID}, ambiguity scheme "container"' in text
    assert "Images by: PyBullet" in text
    assert "22 episodes of 11 tasks" in text
    evaluation = commands(card)[0]
    assert "--env.task=TASKS" in evaluation
    other = CollectionPlan("4", 2, image_size=64, ambiguity="object")
    train_config = TrainPipelineConfig(DatasetConfig(f"{USER}/t11"), env=DeltacoEnv(task="50-59"))
    evaluation = commands(benchmark_card(train_config, other))[0]
    assert {"--env.task=50-59", "--env.image_size=64", "--env.ambiguity=object"} <= set(evaluation)


def test_the_card_says_only_what_is_known():
    config = DeltacoConfig(
        device="cpu",
        input_features={"observation.image": PolicyFeature(FeatureType.VISUAL, (3, 48, 48))},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (2,))},
    )
    config.resolve(None)
    text = policy_card(config, [], 0, None).text
    for unknown in ("Trained on", "Benchmark version", "| steps |", "| seed |", "None"):
        assert unknown not in text
    assert "| learning rate | 0.0003, constant |" in text


@pytest.mark.parametrize("has_demonstrations", [False, True])
def test_the_commands_of_the_card_are_lerobots(dataset, demos, tmp_path, monkeypatch, has_demonstrations):
    source = {"demo_repo_id": REPO_ID, "demo_root": str(demos.root)} if has_demonstrations else {}
    card, policy = foreign_card(dataset, **source)
    policy.save_pretrained(tmp_path)
    plain, with_demonstrations = commands(card)
    config = parsed(plain, tmp_path, monkeypatch)
    assert config.policy.demo_repo_id is None
    assert (config.task, config.fps) == (TASKS[0], dataset.meta.fps)
    assert set(config.robot.cameras) == {"top", "wrist"}
    assert (config.robot.cameras["top"].width, config.robot.cameras["top"].height) == (28, 20)
    config = parsed([*with_demonstrations, "--policy.demo_episode=0"], tmp_path, monkeypatch)
    assert (config.policy.demo_repo_id, config.policy.demo_episode) == ("USER/DEMOS", 0)

    card = benchmark_card(shown_tasks=TASKS if has_demonstrations else [])
    plain, with_demonstrations = commands(card)
    config = parsed(plain, tmp_path, monkeypatch)
    assert (config.env.type, config.env.task) == ("deltaco", "4")
    assert parsed(with_demonstrations, tmp_path, monkeypatch).policy.demo_repo_id == "USER/DEMOS"


# The way to the Hub and back

PUSH_AND_FETCH = """
import re, sys
from pathlib import Path

import torch
from huggingface_hub import ModelCard
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.policies import make_pre_post_processors
from small_policies import *

from lerobot_deltaco.modeling_deltaco import DeltacoPolicy

root, policy_id = Path(sys.argv[1]), sys.argv[2]
fake_encoder.calls = []
instruction_table.load_language_encoder = fake_encoder
dataset = write_dataset(root / "train", [*TASKS, *TASKS])
demos = write_dataset(root / "demos", [*TASKS, "juggle"])
policy, before, after = small_policy(
    dataset, repo_id=policy_id, push_to_hub=True, demo_repo_id=REPO_ID, demo_root=str(demos.root)
)
policy(before(batch_of(dataset, [0, 7])))
policy.eval()
seen = observation(dataset, ["juggle", "wave"])
expected = after(policy.select_action(before(seen)))

# As `lerobot-train` does at its end.
train_config = TrainPipelineConfig(DatasetConfig(REPO_ID, root=str(dataset.root)), policy=policy.config)
policy.push_model_to_hub(train_config, dataset_meta=dataset.meta)
before.push_to_hub(policy_id)
after.push_to_hub(policy_id)
policy.push_to_hub(policy_id + "-bare")

for name in (policy_id, policy_id + "-bare"):
    fake_encoder.calls = []
    fetched = DeltacoPolicy.from_pretrained(name)
    if name == policy_id:
        before, after = make_pre_post_processors(fetched.config, name)
    assert torch.equal(after(fetched.select_action(before(seen))), expected)
    assert fake_encoder.calls == []
    for (key, value), (other, twin) in zip(
        policy.state_dict().items(), fetched.state_dict().items(), strict=True
    ):
        assert key == other and torch.equal(value, twin), key
    assert fetched.eval_demonstrations.tasks == policy.eval_demonstrations.tasks
    assert torch.equal(fetched.eval_demonstrations.frames, policy.eval_demonstrations.frames)
    assert torch.equal(fetched.eval_demonstrations.episodes, policy.eval_demonstrations.episodes)
    assert fetched.instructions.rows == policy.instructions.rows
    assert torch.equal(fetched.instructions.embeddings, policy.instructions.embeddings)
    assert fetched.config.demo_repo_id is None

# The example in the card.
card = ModelCard.load(policy_id)
exec(re.search(r"```python\\n(.+?)```", card.text, re.DOTALL)[1])
assert action.shape == (1, 3)
"""


def test_a_pushed_policy_is_fetched_by_its_name(tmp_path):
    with FakeHub() as hub:
        result = run_python(
            *(WITHOUT_CARD_CHECK + PUSH_AND_FETCH, tmp_path, POLICY_ID),
            env={**hub.environment(tmp_path / "home"), "PYTHONPATH": str(Path(__file__).parent)},
        )
        assert result.returncode == 0, result.stderr[-3000:]
        files = hub.repos["model", POLICY_ID].files()
        weights = {"config.json", "model.safetensors", "tasks.safetensors"}
        processors = {"policy_preprocessor.json", "policy_postprocessor.json"}
        assert {*weights, *processors, "train_config.json", "README.md"} <= set(files)
        assert set(hub.repos["model", f"{POLICY_ID}-bare"].files()) == weights
        for name in ("README.md", "config.json"):
            assert str(tmp_path) not in files[name].decode()
        assert json.loads(files["config.json"])["demo_repo_id"] is None

        card = ModelCard(files["README.md"].decode())
        assert card.data.datasets == [REPO_ID]
        assert "has demonstrations of 4 tasks" in words_of(card)
