"""Gymnasium environment of the DeL-TaCo benchmark (Yu & Mooney, ICLR 2023): 300 pick-and-place tasks.

Importing the package registers `gym_deltaco/PickPlace-v0`.
"""

import gymnasium

# The number is the benchmark's version: results of different versions are not comparable.
ENV_ID = "gym_deltaco/PickPlace-v0"
EPISODE_STEPS = 30  # default length of an episode
CONTROL_FPS = 24  # Hz, nominal: a step is 10 physics steps of 1/240 s, or 75 when the gripper opens or closes
EXPERT_NOISE = 0.1  # standard deviation of the noise on the first three numbers of the expert's actions

# The environment truncates its episodes itself, after `SceneConfig.episode_length` steps.
gymnasium.register(id=ENV_ID, entry_point="gym_deltaco.env:PickPlaceEnv")
