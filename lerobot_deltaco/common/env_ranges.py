"""The least and the greatest valid value of each setting of the environment."""

from types import MappingProxyType

from gym_deltaco import MIN_IMAGE_SIZE

ENV_RANGES = MappingProxyType(
    {
        "fps": (1, 10_000),
        "episode_length": (1, 100_000),
        "image_size": (MIN_IMAGE_SIZE, 4096),
        "render_size": (MIN_IMAGE_SIZE, 4096),
        "max_parallel_tasks": (1, 1000),
    }
)
