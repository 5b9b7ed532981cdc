"""Scenes are the same on every machine, and episodes repeat to the last bit."""

import functools
import hashlib
import json
import multiprocessing
import re
from contextlib import closing
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from gym_deltaco import ENV_ID
from gym_deltaco.env import PickPlaceEnv
from gym_deltaco.expert import expert_episode
from gym_deltaco.layout import sample_layout
from gym_deltaco.scene_config import AMBIGUITIES, SceneConfig
from gym_deltaco.tasks import get_task
from lerobot_deltaco.evaluation.records import EvaluationPlan

# Task, seed and settings of scenes
SCENES = [
    (4, 0, {}),
    (24, 1, {}),
    (39, 2, {}),
    (61, 3, {}),
    (146, 1000, {}),
    (249, 1001, {}),
    (295, 1099511627776, {}),
    (4, 0, {"ambiguity": "object"}),
    (123, 5, {"ambiguity": "object"}),
    (39, 2, {"adversarial_probability": 0.0}),
    (24, 1, {"adversarial_draw": "scene"}),
    (188, 6, {"objects": "scenario_a_train"}),
    (1005, 7, {"objects": "random:400", "image_size": 96}),
]
# SHA-256 of their layouts, and of their first images
LAYOUTS = [
    "d5fdb0aa61bcf3ae4ed80afaba5455b9859346c19e2ff5d68966e42222304e4a",
    "c939a2a6b66afe42ad1baab65d419156a78f54f26fa51a8b010944a129af9081",
    "74415bdfc9b3c3f035e9724de131d5b3eb26b48239825c1b6b9b57cef798e943",
    "1fa2d8bb2d24972511c212d610db52b768aa081bc3179472be6db9a08a36547d",
    "4494efebfe1829d46a029c0ca5cab1e2d6888a067eed426af531cc4628d467aa",
    "65954acabfc7a8b5e26a2634efdb0b8e84b9c93f738da7c3d87e8beafca36016",
    "8615915156de52cd1040470efba6a79e96d0f67c912ca06241bcc2beb17a233c",
    "455fa41328fa49f917cc252a351ac1ccb4fdd9900afce0e72f01de92780f93e0",
    "df4eb55f73ab8de47f19bd2c329fb333e3e4b56ca7b705d0f8d4d1d61f37e911",
    "6cc16b88144f79cf2e03159fe5f0d417f78c91e521227feeceec1471196a8b72",
    "17a232feb5b71f47130b0bde6c0f68a210341dcb8850c93961f2533048c822ae",
    "d495b25c5f233058cc7aa05c9aea3b4720e2088d429824c612da72fab5097628",
    "4bc6006f38d1ebf35939fb0437cb69055d2946ef5c82d5b1738bb5e2225c54f0",
]
IMAGES = [
    "3d82a3ec80b647326e35955de17af48f5bb1b5cd550b70e4d561cfe4872aa7c4",
    "09f5f4b0686e80ecf6c1d03058411743de2339f30b12b6a67711da1f2f212221",
    "595be3d994b07422b52c61eb886a05d460afea3a79372223fd92ad0e965a0dc3",
    "468ccd0510d5d383d4d5d25cbc4ead8a6c42d1eb025db2fc873bdb328b578510",
    "1470b09602cf4f772568451842799aeaf43f41fea901e704fa42944628e6cad7",
    "65fe37b1972a7f52176a4f2bdcd59916f258af02b0477a6ea61ac4bc7c6822fe",
    "ab2672d0655f39567edc3a503c0e917a65ef50bb7e09c2f12fc7e0390db4b27e",
    "8f1d11e8c1a68ee10701c22addcbc90b5fea3d81ee4029216f2972075e085999",
    "f5f6329852d39bc387d99be18eb54d639b3f3f844ae41f2b396e90a1e9dc4ed9",
    "16877546c2501d9a595764d25829ea510955a2ebfff198595aeeb7d9e295d029",
    "28e56af1495fa4630ed70d5030c36c729b332f23de710b48c8fddde873566609",
    "1016d95c3a01aa58b7259ed53da37dda484863a0e3164bff06895ad4b489bdce",
    "03dec84f9d210327abdf6fff09ebcbb99c713188d5091b4fece196bf13439e60",
]


def layout_digest(layout):
    numbers = [
        [[item.label.index, *item.xy.tolist(), item.yaw] for item in layout.objects],
        [[container.color, *container.quadrant] for container in layout.containers],
        [layout.target_object, layout.target_container],
    ]
    return hashlib.sha256(json.dumps(numbers).encode()).hexdigest()


@pytest.mark.parametrize("number", range(len(SCENES)))
def test_scene_has_its_fixed_layout_and_image(number):
    task_id, seed, settings = SCENES[number]
    scene = SceneConfig(**settings)
    layout = sample_layout(get_task(task_id), scene, np.random.default_rng(seed))
    assert layout_digest(layout) == LAYOUTS[number]
    with closing(PickPlaceEnv(task_id, scene)) as env:
        observation, _ = env.reset(seed=seed)
        assert layout_digest(env.scene.layout) == LAYOUTS[number]
        assert hashlib.sha256(observation["pixels"].tobytes()).hexdigest() == IMAGES[number]


def test_scenes_of_the_protocol_are_those_on_its_page():
    page = (Path(__file__).parents[2] / "docs/benchmark.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\d+) \| `(\w{16})` \| `(\w{16})` \|$", page, re.MULTILINE)
    assert len(rows) == 12
    protocol, unseen = EvaluationPlan(), EvaluationPlan("out_of_distribution", seed=9300)
    for number, layout, image in rows:
        plan = protocol if int(number) in protocol.task_ids else unseen
        with closing(PickPlaceEnv(int(number), plan.scene)) as env:
            observation, _ = env.reset(seed=plan.scene_seed(int(number), 0))
            assert layout_digest(env.scene.layout).startswith(layout)
            assert hashlib.sha256(observation["pixels"].tobytes()).hexdigest().startswith(image)


def absorb(digest, *values):
    """Adds numbers, arrays and dictionaries of them to a hash, to the last bit."""
    for value in values:
        if isinstance(value, dict):
            for key in sorted(value):
                digest.update(key.encode())
                absorb(digest, value[key])
        else:
            array = np.asarray(value)
            digest.update(f"{array.dtype}{array.shape}".encode())
            digest.update(array.tobytes())


def expert_digests(env, task_id, seed):
    """Yields a hash of an expert episode after each step."""
    digest = hashlib.sha256()
    for step in expert_episode(env, task_id, seed):
        absorb(digest, step.observation, step.action, step.reward, step.info)
        yield digest.hexdigest()


def actions_digest(env, seed, actions):
    """Returns a hash of an episode with given actions."""
    digest = hashlib.sha256()
    absorb(digest, *env.reset(seed=seed))
    for action in actions:
        absorb(digest, *env.step(action))
    return digest.hexdigest()


def fresh_digest(ambiguity, task_id, seed):
    """Returns a hash of an expert episode in a new environment."""
    with closing(PickPlaceEnv(scene=SceneConfig(ambiguity=ambiguity))) as env:
        *_, digest = expert_digests(env, task_id, seed)
    return digest


EPISODES = [(own, task_id, seed) for own in AMBIGUITIES for seed, task_id in enumerate((4, 82, 146, 295))]


@pytest.fixture(scope="module")
def digests():
    return {episode: fresh_digest(*episode) for episode in EPISODES}


def test_episodes_repeat_to_the_last_bit(digests):
    assert len(set(digests.values())) == len(digests)
    envs = {ambiguity: PickPlaceEnv(scene=SceneConfig(ambiguity=ambiguity)) for ambiguity in AMBIGUITIES}
    for ambiguity, task_id, seed in EPISODES[::-1]:
        *_, digest = expert_digests(envs[ambiguity], task_id, seed)
        assert digest == digests[ambiguity, task_id, seed]
        # Interrupt an episode with the gripper closed and objects in motion.
        envs[ambiguity].reset(seed=100 + seed)
        for action in np.random.default_rng(seed).choice([-1.0, 1.0], (7, 4)):
            envs[ambiguity].step(action)
    for env in envs.values():
        env.close()


def test_interleaved_environments_repeat_to_the_last_bit(digests):
    envs = [PickPlaceEnv(scene=SceneConfig(ambiguity=ambiguity)) for ambiguity, _, _ in EPISODES]
    runs = [expert_digests(env, *episode[1:]) for env, episode in zip(envs, EPISODES, strict=True)]
    *_, last = zip(*runs, strict=True)
    assert list(last) == list(digests.values())
    for env in envs:
        env.close()


def test_episodes_repeat_to_the_last_bit_in_another_process(digests, monkeypatch):
    monkeypatch.setenv("PYTHONHASHSEED", "7")
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert pool.starmap(fresh_digest, digests) == list(digests.values())


def test_rendering_and_global_random_state_change_nothing():
    env = PickPlaceEnv(4, render_mode="rgb_array")
    actions = np.random.default_rng(3).choice([-1.0, 1.0], (12, 4))
    expected = actions_digest(env, 5, actions)
    assert actions_digest(env, 6, actions) != expected
    np.random.seed(1)  # noqa: NPY002
    state = np.random.get_state()[1].copy()  # noqa: NPY002
    digest = hashlib.sha256()
    absorb(digest, *env.reset(seed=5))
    for action in actions:
        env.render()
        absorb(digest, *env.step(action))
    assert digest.hexdigest() == expected
    np.testing.assert_array_equal(np.random.get_state()[1], state)  # noqa: NPY002
    env.close()


@pytest.mark.parametrize("context", ["fork", "spawn"])
def test_workers_of_vector_environments_agree_with_one_process(context):
    # With the module before the id, spawned workers register the environment.
    options = {"task_id": 4, "scene": SceneConfig(image_size=8)}
    make_env = functools.partial(gym.make, f"gym_deltaco:{ENV_ID}", **options)
    actions = np.random.default_rng(0).uniform(-1, 1, (3, 2, 4)).astype(np.float32)
    results = []
    for envs in (
        gym.vector.SyncVectorEnv([make_env] * 2),
        gym.vector.AsyncVectorEnv([make_env] * 2, context=context),
    ):
        digest = hashlib.sha256()
        absorb(digest, *envs.reset(seed=5))
        for action in actions:
            absorb(digest, *envs.step(action))
        assert envs.call("_max_episode_steps") == (30, 30)
        envs.close()
        results.append(digest.hexdigest())
    assert results[0] == results[1]
