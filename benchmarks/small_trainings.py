"""Small trainings whose steps the benchmarks time: their data, their settings, and the time of a step."""

from __future__ import annotations

import itertools
import json
import os
import statistics
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from gym_deltaco.tasks import get_task
from lerobot_deltaco.common.cores import available_cores
from lerobot_deltaco.data.collection import collect
from lerobot_deltaco.data.collection_plan import CollectionPlan

# What takes long to import is imported where it is used: the workers of the collection import it, too.
PLAN = CollectionPlan("0-15", episodes_per_task=4)
LANGUAGE_ENCODER = "all-MiniLM-L6-v2"
STEP_TIMES = Path(__file__).with_name("step_times.py")
WARM_UP = 5  # steps before those that are measured


class StepTime(NamedTuple):
    """Median time of a step."""

    clock: float  # s
    processor: float  # s of the process that notes the times


class SmallTrainings:
    """Trainings on 64 episodes of 16 tasks, without a language model.

    Args:
        folder: Empty folder for the data and all outputs.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._root = folder / "dataset"
        collect(self._root, PLAN, available_cores())
        self._embeddings = _write_embeddings(folder)
        self._n_runs = 0

    def run(
        self,
        policy: dict[str, Any],
        batch_size: int,
        steps: int,
        launcher: Sequence[str] = (),
    ) -> StepTime:
        """Trains in processes of one thread, and measures the steps after the first few.

        Args:
            policy: Options of the policy, beside those that all of these trainings have.
            batch_size: Samples in each step of a process, a multiple of 16.
            steps: Number of measured steps.
            launcher: Arguments of Python that start the processes; none for one process.
        """
        self._n_runs += 1
        output = self._folder / f"run_{self._n_runs}"
        arguments = {
            "policy.type": "deltaco",
            "policy.device": "cpu",
            "policy.backbone": "strided",
            "policy.language_encoder": LANGUAGE_ENCODER,
            "policy.instruction_embeddings": self._embeddings,
            "policy.tasks_per_batch": len(PLAN.task_ids),
            **{f"policy.{name}": value for name, value in policy.items()},
            "dataset.repo_id": "benchmark/small",
            "dataset.root": self._root,
            "batch_size": batch_size,
            "steps": WARM_UP + steps,
            "log_freq": 1,
            "save_checkpoint": "false",
            "output_dir": output,
        }
        times = output.with_suffix(".json")
        command = [sys.executable, *launcher, str(STEP_TIMES), str(times)]
        settings = {"OMP_NUM_THREADS": "1", "GLOO_SOCKET_IFNAME": "lo", "HF_HUB_OFFLINE": "1"}
        result = subprocess.run(
            [*command, *(f"--{name}={value}" for name, value in arguments.items())],
            env={**os.environ, **settings},
            capture_output=True,
            text=True,
        )
        if result.returncode != 0:
            sys.exit(f"The training failed:\n{result.stderr[-3000:]}")
        return median_step(times, WARM_UP)


def median_step(times: Path, warm_up: int) -> StepTime:
    """Median time of the steps after the first `warm_up`, from a file of `step_times.py`."""
    ends = json.loads(times.read_text())[warm_up - 1 :]
    clock, processor = (
        statistics.median(later[which] - earlier[which] for earlier, later in itertools.pairwise(ends))
        for which in (0, 1)
    )
    return StepTime(clock, processor)


def _write_embeddings(folder: Path) -> Path:
    """Embeddings of the instructions, so that no language model is needed."""
    import torch

    from lerobot_deltaco.policy.language.instruction_table import InstructionTable
    from lerobot_deltaco.policy.task_file import write_task_file

    table = InstructionTable(LANGUAGE_ENCODER)
    instructions = [get_task(task_id).instruction for task_id in PLAN.task_ids]
    table.put(instructions, torch.eye(len(instructions), 384))
    path = folder / "embeddings.safetensors"
    write_task_file(path, table.contents())
    return path
