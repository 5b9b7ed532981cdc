"""Training with one process and with several: `python benchmarks/processes.py [--json FILE]` prints a table.

Each process has one thread and `--batch-size` samples, as `torchrun` starts `deltaco-train`. What is compared
is samples per second over all processes, in turns, so that what else the machine does meets both. Times are
of one machine and its load, which is printed too; compare figures of one run.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import torch

from gym_deltaco.tasks import get_task
from lerobot_deltaco.common.cores import available_cores
from lerobot_deltaco.data.collection import collect
from lerobot_deltaco.data.collection_plan import CollectionPlan
from lerobot_deltaco.policy.language import InstructionTable
from lerobot_deltaco.policy.task_file import write_task_file

PLAN = CollectionPlan("0-15", episodes_per_task=4)
ENCODERS = ("attention", "correspondence")
LANGUAGE_ENCODER = "all-MiniLM-L6-v2"
# Steps before those that are measured: they warm up.
WARM_UP = 5


def main(arguments: list[str] | None = None) -> None:
    """Measures, prints the table, and writes the figures."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--processes", type=int, default=2, help="to compare with one (%(default)s)")
    parser.add_argument("--batch-size", type=int, default=64, help="of each process (%(default)s)")
    parser.add_argument("--steps", type=int, default=30, help="measured steps of a run (%(default)s)")
    parser.add_argument("--rounds", type=int, default=2, help="runs of each kind (%(default)s)")
    parser.add_argument("--encoders", nargs="+", choices=("cnn", *ENCODERS), default=list(ENCODERS))
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the figures to this file")
    options = parser.parse_args(arguments)
    if options.processes < 2 or options.batch_size % 16 or min(options.steps, options.rounds) < 1:
        parser.error("--processes must be at least 2, --batch-size a multiple of 16, the others at least 1.")

    results: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "dataset"
        collect(root, PLAN, available_cores())
        embeddings = _write_embeddings(Path(folder))
        for encoder in options.encoders:
            rates: dict[int, list[float]] = {1: [], options.processes: []}
            for number in range(options.rounds):
                for n_processes, found in rates.items():
                    output = Path(folder) / f"{encoder}_{n_processes}_{number}"
                    found.append(_samples_per_s(root, embeddings, output, encoder, n_processes, options))
                    load = os.getloadavg()[0]
                    print(f"{encoder}, {n_processes} process(es): {found[-1]:.1f} samples/s, load {load:.1f}")  # noqa: T201
            one, several = (statistics.median(found) for found in rates.values())
            results |= {
                f"{encoder}: 1 process, samples/s": one,
                f"{encoder}: {options.processes} processes, samples/s": several,
                f"{encoder}: {options.processes} processes are faster by": several / one,
            }
    results |= {"load average over the last minute": os.getloadavg()[0], "cores": os.cpu_count()}
    width = max(map(len, results))
    sys.stdout.writelines(f"{name:{width}}  {value:10.2f}\n" for name, value in results.items())
    if options.json:
        options.json.write_text(json.dumps(results, indent=2) + "\n")


def _write_embeddings(folder: Path) -> Path:
    """Embeddings of the instructions, so that no language model is needed."""
    table = InstructionTable(LANGUAGE_ENCODER)
    instructions = [get_task(task_id).instruction for task_id in PLAN.task_ids]
    table.put(instructions, torch.eye(len(instructions), 384))
    path = folder / "embeddings.safetensors"
    write_task_file(path, table.contents())
    return path


def _samples_per_s(
    root: Path, embeddings: Path, output: Path, encoder: str, n_processes: int, options: argparse.Namespace
) -> float:
    """Samples per second of all processes together, after the first steps."""
    arguments = {
        "policy.type": "deltaco",
        "policy.device": "cpu",
        "policy.backbone": "strided",
        "policy.demo_encoder": encoder,
        "policy.motion_modes": 5 if encoder != "cnn" else 1,
        "policy.language_encoder": LANGUAGE_ENCODER,
        "policy.instruction_embeddings": embeddings,
        "policy.tasks_per_batch": len(PLAN.task_ids),
        "dataset.repo_id": "benchmark/processes",
        "dataset.root": root,
        "batch_size": options.batch_size,
        "steps": WARM_UP + options.steps,
        "log_freq": 1,
        "save_checkpoint": "false",
        "output_dir": output,
    }
    launcher = ["-m", "torch.distributed.run", "--standalone", f"--nproc_per_node={n_processes}"]
    command = [sys.executable, *launcher, "-m", "lerobot_deltaco.commands.train"]
    settings = {"OMP_NUM_THREADS": "1", "GLOO_SOCKET_IFNAME": "lo", "HF_HUB_OFFLINE": "1"}
    result = subprocess.run(
        [*command, *(f"--{name}={value}" for name, value in arguments.items())],
        env={**os.environ, **settings},
        capture_output=True,
        text=True,
    )
    if result.returncode != 0:
        sys.exit(f"The training failed:\n{result.stderr[-3000:]}")
    # LeRobot logs the seconds of each step: of the update, and of waiting for the batch.
    found = re.findall(r"updt_s:([\d.]+) data_s:([\d.]+)", result.stderr + result.stdout)
    seconds = [float(update) + float(data) for update, data in found[WARM_UP:]]
    if not seconds:
        sys.exit("LeRobot's log has no times of the steps any more.")
    return n_processes * options.batch_size / statistics.median(seconds)


if __name__ == "__main__":
    main()
