"""A policy of LeRobot's own trains and is evaluated as the dataset's card says."""

import json
import os
import re
import shlex
import subprocess
import sys

import pytest

from lerobot_deltaco.cards.dataset_card import card_text
from lerobot_deltaco.data.collection import collect
from lerobot_deltaco.data.collection_plan import CollectionPlan

# Without a network, and in a minute: nothing that this dataset or environment would need.
QUICK = {
    "lerobot-train": [
        *("--policy.pretrained_backbone_weights=null", "--policy.device=cpu", "--policy.dim_model=32"),
        *("--policy.n_heads=2", "--policy.dim_feedforward=32", "--policy.n_encoder_layers=1"),
        *("--steps=3", "--batch_size=2", "--num_workers=0", "--log_freq=1", "--env_eval_freq=3"),
        *("--eval.n_episodes=1", "--eval.batch_size=1"),
    ],
    "lerobot-eval": ["--eval.n_episodes=2", "--output_dir=outputs/eval"],
}


def card_commands(card):
    """The commands in a card, as lists of words, by the name of the program."""
    blocks = re.findall(r"```bash\n(.*?)```", card, re.DOTALL)
    lines = "".join(blocks).replace("\\\n", " ").splitlines()
    return {words[0]: words for words in map(shlex.split, lines)}


def without(words, changes):
    """Words whose options are not changed: LeRobot takes each only once."""
    changed = {change.split("=")[0] for change in changes}
    return [word for word in words if word.split("=")[0] not in changed]


@pytest.mark.slow
def test_act_trains_and_is_evaluated_by_the_commands_of_the_card(tmp_path):
    root = tmp_path / "dataset"
    collect(root, CollectionPlan("4", 2))
    commands = card_commands(card_text(root))
    environment = {**os.environ, "HF_HOME": str(tmp_path / "cache")}
    for program, changes in QUICK.items():
        name, *words = [word.replace("DIR", str(root)) for word in commands[program]]
        module = f"lerobot.scripts.{name.replace('-', '_')}"
        subprocess.run(
            [sys.executable, "-m", module, *without(words, changes), *changes],
            cwd=tmp_path,
            env=environment,
            check=True,
        )
    info = json.loads((tmp_path / "outputs/eval/eval_info.json").read_text())
    assert info["overall"]["n_episodes"] == 2
    assert set(info["per_group"]) == {"name"}
    assert "env.task=4" in " ".join(commands["lerobot-train"])
