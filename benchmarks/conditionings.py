"""Time of a training step by conditioning: `python benchmarks/conditionings.py [--json FILE]` prints a table.

Each training has one process with one thread, and those settings of the small experiments (`small_a`,
`small_a_correspondence`) that change the time of a step. In each round, all of them are trained in turn, so
that what else the machine does meets all. Processor seconds depend less on that than those on the clock.
Compare figures of one run.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import tempfile
from pathlib import Path
from types import MappingProxyType
from typing import Any

from small_trainings import SmallTrainings, StepTime

_SHARED = MappingProxyType(
    {
        "motion_modes": 5,
        "dtype": "bfloat16",
        "gripper_loss": "cross_entropy",
        "crop_padding": 0,
    }
)
_CORRESPONDENCE = MappingProxyType(
    {
        "demo_encoder": "correspondence",
        "recolor_share": 0.7,
        "color_blind_tasks": "shaped object",
        "frames_after_release": 2,
    }
)
REFERENCE = "attention"  # the others are compared with it
CONDITIONINGS: MappingProxyType[str, dict[str, Any]] = MappingProxyType(
    {
        "language only": {"method": "language_only"},
        "cnn, the paper's encoder": {"demo_encoder": "cnn"},
        REFERENCE: {"demo_encoder": "attention"},
        "correspondence": {**_CORRESPONDENCE},
        "correspondence, locator_share=0.125": {**_CORRESPONDENCE, "locator_share": 0.125},
    }
)


def main(arguments: list[str] | None = None) -> None:
    """Measures, prints the table, and writes the figures."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--batch-size", type=int, default=64, help="a multiple of 16 (%(default)s)")
    parser.add_argument("--steps", type=int, default=40, help="measured steps of a run (%(default)s)")
    parser.add_argument("--rounds", type=int, default=3, help="runs of each conditioning (%(default)s)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the figures to this file")
    options = parser.parse_args(arguments)
    if options.batch_size % 16 or min(options.batch_size, options.steps, options.rounds) < 1:
        parser.error("--batch-size must be a multiple of 16, and the others at least 1.")

    found: dict[str, list[StepTime]] = {name: [] for name in CONDITIONINGS}
    with tempfile.TemporaryDirectory() as folder:
        trainings = SmallTrainings(Path(folder))
        for _ in range(options.rounds):
            for name, policy in CONDITIONINGS.items():
                step = trainings.run({**_SHARED, **policy}, options.batch_size, options.steps)
                found[name].append(step)
                load = os.getloadavg()[0]
                sys.stderr.write(f"{name}: {1000 * step.processor:.1f} ms; load {load:.1f}\n")
    steps = {
        name: StepTime(*(statistics.median(figures) for figures in zip(*times, strict=True)))
        for name, times in found.items()
    }
    width = max(map(len, steps))
    sys.stdout.write(f"{'a step, in ms':{width}}  on the clock  processor  times {REFERENCE}\n")
    for name, (clock, processor) in steps.items():
        ratio = processor / steps[REFERENCE].processor
        sys.stdout.write(f"{name:{width}}  {1000 * clock:12.1f}  {1000 * processor:9.1f}  {ratio:15.2f}\n")
    load = os.getloadavg()
    averages = ", ".join(f"{average:.1f}" for average in load)
    sys.stdout.write(f"Batches of {options.batch_size}; load averages over 1, 5 and 15 minutes: {averages}\n")
    if options.json:
        contents = {"steps": {name: step._asdict() for name, step in steps.items()}, "load": load}
        options.json.write_text(json.dumps(contents, indent=2) + "\n")


if __name__ == "__main__":
    main()
