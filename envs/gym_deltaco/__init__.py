"""The benchmark of DeL-TaCo (Yu & Mooney, ICLR 2023) for gymnasium: 300 pick-and-place tasks.

Importing it registers `gym_deltaco/PickPlace-v0`; the simulator is loaded when the first environment
is made.
"""

import gymnasium

# The number is the benchmark's version: results of different versions are not comparable.
ENV_ID = "gym_deltaco/PickPlace-v0"
EPISODE_STEPS = 30
CONTROL_FPS = 24  # nominal: 10 physics steps of 1/240 s
MIN_IMAGE_SIZE, MAX_IMAGE_SIZE = 8, 4096  # px
EXPERT_NOISE = 0.1  # standard deviation of the noise on each of an action's three motions

gymnasium.register(id=ENV_ID, entry_point="gym_deltaco.env:PickPlaceEnv", max_episode_steps=EPISODE_STEPS)
