"""The benchmark of DeL-TaCo (Yu & Mooney, ICLR 2023) for gymnasium: 300 pick-and-place tasks.

Importing it registers `gym_deltaco/PickPlace-v0`; the simulator is loaded when the first environment is made.
"""

import gymnasium

EPISODE_STEPS = 30

gymnasium.register(
    id="gym_deltaco/PickPlace-v0", entry_point="gym_deltaco.env:PickPlaceEnv", max_episode_steps=EPISODE_STEPS
)
