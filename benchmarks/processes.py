"""Training with one process and with several: `python benchmarks/processes.py [--json FILE]` prints a table.

Each process has one thread and `--batch-size` samples, as `torchrun` starts `deltaco-train`. What is compared
is samples per second over all processes, in turns, so that what else the machine does meets both; and samples
per second of the processor, which on a busy machine say more: by these, several processes on as many idle
cores are at most so much faster. Times are of one machine and its load; compare figures of one run.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

from small_trainings import SmallTrainings

ENCODERS = ("attention", "correspondence")


class Rate(NamedTuple):
    """The speed of a training."""

    clock: float  # samples/s of all processes
    processor: float  # samples per processor second


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
        trainings = SmallTrainings(Path(folder))
        for encoder in options.encoders:
            rates: dict[int, list[Rate]] = {1: [], options.processes: []}
            for _ in range(options.rounds):
                for n_processes, found in rates.items():
                    found.append(_measure(trainings, encoder, n_processes, options))
                    sys.stdout.write(
                        f"{encoder}, {n_processes} process(es): {found[-1].clock:.1f} samples/s, "
                        f"{found[-1].processor:.1f} per processor second; load {os.getloadavg()[0]:.1f}\n"
                    )
                    sys.stdout.flush()
            (one, one_cpu), (several, several_cpu) = (
                (statistics.median(rate.clock for rate in found), max(rate.processor for rate in found))
                for found in rates.values()
            )
            results |= {
                f"{encoder}: 1 process, samples/s": one,
                f"{encoder}: {options.processes} processes, samples/s": several,
                f"{encoder}: {options.processes} processes are faster by": several / one,
                f"{encoder}: 1 process, samples per processor second": one_cpu,
                f"{encoder}: {options.processes} processes, samples per processor second": several_cpu,
                f"{encoder}: at most so much faster on idle cores": options.processes * several_cpu / one_cpu,
            }
    results |= {"load average over the last minute": os.getloadavg()[0], "cores": os.cpu_count()}
    width = max(map(len, results))
    sys.stdout.writelines(f"{name:{width}}  {value:10.2f}\n" for name, value in results.items())
    if options.json:
        options.json.write_text(json.dumps(results, indent=2) + "\n")


def _measure(trainings: SmallTrainings, encoder: str, n_processes: int, options: argparse.Namespace) -> Rate:
    """Samples per second of all processes together, after the first steps."""
    launcher = ["-m", "torch.distributed.run", "--standalone", f"--nproc_per_node={n_processes}"]
    policy = {"demo_encoder": encoder, "motion_modes": 5 if encoder != "cnn" else 1}
    clock, processor = trainings.run(policy, options.batch_size, options.steps, launcher)
    return Rate(n_processes * options.batch_size / clock, options.batch_size / processor)


if __name__ == "__main__":
    main()
