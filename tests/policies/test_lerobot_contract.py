"""What LeRobot's own tests ask of every policy, for each method of both policies."""

import inspect
from copy import deepcopy

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.envs import make_env, preprocess_observation
from lerobot.policies import get_policy_class, make_policy, make_policy_config, make_pre_post_processors
from lerobot.utils.feature_utils import dataset_to_policy_features
from small_policies import TASK_IDS, batch_of, demos_of, with_chunks

from lerobot_deltaco.evaluation.lerobot_env import DeltacoEnv
from lerobot_deltaco.policies.deltaco.configuration_deltaco import METHODS

NO_INPUTS = {"film": "none", "concat": "none", "encoder_loss": "none"}
POLICIES = [
    *(("deltaco", {"method": method}) for method in METHODS),
    ("deltaco", NO_INPUTS),
    ("deltaco_match", {}),
]
MOTORS = ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper"]

pytestmark = pytest.mark.usefixtures("fake_language", "short_fit")
over_policies = pytest.mark.parametrize(("policy_type", "options"), POLICIES)


def same(first, second):
    """Whether two batches have the same values."""
    return first.keys() == second.keys() and all(
        torch.equal(value, second[name]) if isinstance(value, torch.Tensor) else value == second[name]
        for name, value in first.items()
    )


@pytest.fixture(scope="module")
def features(tmp_path_factory):
    """The features of a robot with six joints and a camera, whose dataset has no episode."""
    joints = {"dtype": "float32", "shape": (6,), "names": MOTORS}
    camera = {"dtype": "video", "shape": (84, 84, 3), "names": ["height", "width", "channels"]}
    named = {"action": joints, "observation.state": joints, "observation.images.laptop": camera}
    metadata = LeRobotDatasetMetadata.create(
        "test/robot", 30, named, root=tmp_path_factory.mktemp("features") / "robot"
    )
    return dataset_to_policy_features(metadata.features)


@pytest.mark.parametrize("policy_type", ["deltaco", "deltaco_match"])
def test_class_names_its_type_and_configuration(policy_type):
    policy_class = get_policy_class(policy_type)
    assert policy_class.name == policy_type
    annotation = inspect.signature(policy_class.__init__).parameters["config"].annotation
    assert issubclass(type(make_policy_config(policy_type)), annotation)


@over_policies
def test_policies_are_made_from_features_alone_and_load_as_saved(features, tmp_path, policy_type, options):
    # What a dataset says beside its features.
    known = {"one_hot_tasks": ["wave"]} if options.get("method") == "one_hot" else {}
    config = make_policy_config(policy_type, device="cpu", **options, **known)
    config.output_features = {k: f for k, f in features.items() if f.type is FeatureType.ACTION}
    config.input_features = {k: f for k, f in features.items() if f.type is not FeatureType.ACTION}
    policy_class = get_policy_class(policy_type)
    policy = policy_class(config)
    policy.save_pretrained(tmp_path)
    loaded = policy_class.from_pretrained(tmp_path, config=config)
    torch.testing.assert_close(list(policy.parameters()), list(loaded.parameters()), rtol=0, atol=0)
    assert len(list(policy.parameters())) > 10


@over_policies
def test_policies_train_and_act_in_the_environment(benchmark, policy_type, options):
    dataset = LeRobotDataset("test/benchmark", root=benchmark)
    config = make_policy_config(policy_type, device="cpu", **demos_of(dataset), **options)
    policy = make_policy(config, ds_meta=dataset.meta)
    before, after = make_pre_post_processors(config, dataset_stats=dataset.meta.stats)
    batch = before(batch_of(with_chunks(dataset, config), [0, 70]))
    copied = deepcopy(batch)
    policy.train()
    loss, _ = policy(batch)
    loss.backward()
    assert same(batch, copied)

    policy.eval()
    policy.reset()
    env = make_env(DeltacoEnv(task=str(TASK_IDS[0])), n_envs=2)["name"][TASK_IDS[0]]
    observation, _ = env.reset(seed=1000)
    task = [env.envs[0].unwrapped.task_description] * 2
    seen = before({**preprocess_observation(observation), "task": task})
    copied = deepcopy(seen)
    with torch.inference_mode():
        action = policy.select_action(seen)
    assert same(seen, copied)
    env.step(np.asarray(after(action)))
    env.close()
