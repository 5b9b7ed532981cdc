"""Trains small policies in one of several processes; `test_several_processes.py` starts them."""

import json
import os
import shutil
import sys
import time
from pathlib import Path

import numpy as np
from accelerate.state import AcceleratorState
from safetensors.torch import save_file
from small_policies import fake_encoder

from lerobot_deltaco.lerobot_internals import run_training_loop
from lerobot_deltaco.policy.language import instruction_table
from lerobot_deltaco.training.loop import InMemoryTraining


class ObservedTraining(InMemoryTraining):
    """Keeps the policy, and notes which frames this process trains on."""

    def __init__(self):
        super().__init__()
        self.places = []

    def make_policy(self, **arguments):
        self.policy = super().make_policy(**arguments)
        return self.policy

    def batches(self, loader):
        for batch in super().batches(loader):
            self.places.append(batch["index"].tolist())
            yield batch


def train(name, options, out):
    """Trains once, and writes what this process ends with."""
    sys.argv = ["deltaco-train", *(f"--{key}={value}" for key, value in options.items())]
    training = ObservedTraining()
    with training.active():
        run_training_loop()
    AcceleratorState._reset_state(reset_partial_state=True)  # so that there may be another training
    rank = os.environ["RANK"]
    # What follows does not belong to the weights that processes agree on: statistics of their own batches.
    save_file(dict(training.policy.named_parameters()), out / f"{name}_{rank}.safetensors")
    np.save(out / f"{name}_{rank}.npy", np.array(training.places))


def main():
    out = Path(sys.argv[1])
    jobs = json.loads((out / "jobs.json").read_text())
    instruction_table.load_language_encoder = fake_encoder
    fake_encoder.calls = []
    for number, (name, options, interrupted_at) in enumerate(jobs):
        os.environ["MASTER_PORT"] = str(int(os.environ["FIRST_PORT"]) + 2 * number)
        whole, halved = out / name, out / f"{name}_resumed"
        train(name, {**options, "output_dir": whole}, out)
        done = out / f"{name}.copied"
        if os.environ["RANK"] == "0":
            # What is left of a training that was killed after this step.
            shutil.copytree(whole, halved, symlinks=True)
            for checkpoint in (halved / "checkpoints").iterdir():
                if checkpoint.is_symlink() or int(checkpoint.name) > interrupted_at:
                    checkpoint.unlink() if checkpoint.is_symlink() else shutil.rmtree(checkpoint)
            done.touch()
        while not done.exists():
            time.sleep(0.05)
        os.environ["MASTER_PORT"] = str(int(os.environ["FIRST_PORT"]) + 2 * number + 1)
        config = halved / f"checkpoints/{interrupted_at:06}/pretrained_model/train_config.json"
        train(f"{name}_resumed", {"config_path": config, "resume": "true", "output_dir": halved}, out)


if __name__ == "__main__":
    main()
