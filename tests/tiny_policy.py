"""An untrained `deltaco_match` for the benchmark, with demonstrations of two tasks."""

import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies import make_pre_post_processors

from gym_deltaco.tasks import TASKS
from lerobot_deltaco.deltaco_match.configuration_deltaco_match import DeltacoMatchConfig
from lerobot_deltaco.deltaco_match.modeling_deltaco_match import DeltacoMatchPolicy
from lerobot_deltaco.deltaco_match.words import vocabulary_of
from lerobot_deltaco.demonstrations import DemonstrationBank
from lerobot_deltaco.recording import load_conditioned

DEMONSTRATED = (4, 26)


# Sentences whose words the policy knows.
SENTENCES = (
    *(task.instruction for task in TASKS),
    "Put it in the green bin.",
    "Put it in the red bin.",
    "wave at me",
    "",
    "put the blue mug into the red one",
)


def save_tiny_policy(folder, **options):
    """Saves the policy and its processors, and returns their folder."""
    torch.manual_seed(0)
    config = DeltacoMatchConfig(
        device="cpu",
        known_words=vocabulary_of(SENTENCES),
        gripper="3",
        input_features={
            "observation.image": PolicyFeature(FeatureType.VISUAL, (3, 48, 48)),
            "observation.state": PolicyFeature(FeatureType.STATE, (10,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (4,))},
        **options,
    )
    stats = {"observation.state": {"mean": torch.zeros(10), "std": torch.ones(10)}}
    policy = DeltacoMatchPolicy(config, stats).eval()
    frames = torch.randint(0, 256, (len(DEMONSTRATED), 2, 3, 48, 48), dtype=torch.uint8)
    tasks = [TASKS[task_id].instruction for task_id in DEMONSTRATED]
    policy.demonstrations = DemonstrationBank(frames, tasks, range(len(tasks)), [4, 26])
    policy.save_pretrained(folder)
    for processor in make_pre_post_processors(config, dataset_stats=stats):
        processor.save_pretrained(folder)
    return folder


def load_tiny_policy(folder, **options):
    return load_conditioned(save_tiny_policy(folder / "tiny", **options))
