"""Where a minute of a user's goes: `python benchmarks/minute.py [--json FILE]` prints a table.

The start of each command, the expert, a collection, a training step and an evaluation, each in processes of
its own. Beside the time on the clock stand the seconds of the processor, over all processes, which depend
less on what else the machine does. `--demo` adds `deltaco-demo`. The installation is timed by hand: `time
make install` in a fresh clone, with and without a built PyBullet. Times are of one machine and its load,
which is printed too; compare figures of one run.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from small_trainings import median_step

from lerobot_deltaco.common.cores import available_cores

ROOT = Path(__file__).parents[1]
PARTS = ("start", "expert", "collection", "training", "evaluation")
TASKS, EPISODES_PER_TASK = "0-15", 4
EXPERT_EPISODES = 120  # so many that making the objects, once in each process, matters little
STEPS, WARM_UP, BATCH_SIZE = 25, 5, 64
EVALUATED, TRIALS = "0-7", 2
# One process of the expert. It prints its seconds on the clock and those of the processor.
EXPERT = f"""
import time
from gym_deltaco.env import PickPlaceEnv
from gym_deltaco.expert import expert_episode
from gym_deltaco.seeding import episode_seed
env = PickPlaceEnv()
def run(numbers):
    for number in numbers:
        task_id = 7 * number % 300
        for _ in expert_episode(env, task_id, episode_seed(0, "evaluation", task_id, 0)):
            pass
run(range(3))
start, cpu = time.perf_counter(), time.process_time()
run(range(3, 3 + {EXPERT_EPISODES}))
print(time.perf_counter() - start, time.process_time() - cpu)
"""


class Line(NamedTuple):
    """A line of the table."""

    what: str
    clock: float  # s, or a rate on the clock
    processor: float | None  # the same by the processor's seconds; None if it is not known
    unit: str


def main(arguments: list[str] | None = None) -> None:
    """Measures, prints the table, and writes the figures."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS), help="parts to measure")
    parser.add_argument("--encoder", default="correspondence", help="demo_encoder (%(default)s)")
    parser.add_argument("--demo", action="store_true", help="also run deltaco-demo, for several minutes")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the figures to this file")
    options = parser.parse_args(arguments)

    lines: list[Line] = []
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        if "start" in options.only:
            scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
            modules = {name: script.split(":")[0] for name, script in scripts.items()}
            modules["lerobot-eval"] = "lerobot.scripts.lerobot_eval"
            for name, module in modules.items():
                clock, processor, _ = _run("-m", module, "--help")
                lines.append(Line(f"{name} --help", clock, processor, "s"))
        if "expert" in options.only:
            clock, processor = map(float, _run("-c", EXPERT)[2].split())
            rates = EXPERT_EPISODES / clock, EXPERT_EPISODES / processor
            lines.append(Line("expert, one process", *rates, "episodes/s"))
        if {"collection", "training", "evaluation"} & set(options.only):
            lines += _measure_recipe(out, options.encoder)
        if options.demo:
            lines.append(Line("deltaco-demo", *_run("-m", _command("demo"), "--out", str(out))[:2], "s"))
    width = max(len(line.what) for line in lines)
    sys.stdout.write(f"{'':{width}}  {'on the clock':>12}  {'processor':>12}\n")
    for what, clock, processor, unit in lines:
        by_processor = "" if processor is None else f"{processor:.2f}"
        sys.stdout.write(f"{what:{width}}  {clock:12.2f}  {by_processor:>12}  {unit}\n")
    load = os.getloadavg()
    sys.stdout.write(f"{available_cores()} cores; load averages over 1, 5 and 15 minutes: {load}\n")
    if options.json:
        contents = {"lines": [line._asdict() for line in lines], "load": load, "cores": available_cores()}
        options.json.write_text(json.dumps(contents, indent=2) + "\n")


def _measure_recipe(out: Path, encoder: str) -> list[Line]:
    """A small collection, a few steps of the small scale's training on it, and an evaluation."""
    shared = [f"--tasks={TASKS}", f"--workers={available_cores()}"]
    summary = out / "summary.json"
    clock, processor, _ = _run(
        "-m", _command("collect"), *shared, f"--episodes-per-task={EPISODES_PER_TASK}",
        f"--root={out / 'train'}", f"--summary={summary}",
    )  # fmt: skip
    rate = json.loads(summary.read_text())["episodes_per_s"]
    n_episodes = json.loads(summary.read_text())["episodes"]
    lines = [
        Line(f"deltaco-collect, {n_episodes} episodes, card included", clock, processor, "s"),
        Line("    of which the episodes", rate, None, "stored episodes/s"),
    ]
    _run(
        "-m", _command("collect"), *shared, "--episodes-per-task=1", "--split=validation",
        f"--root={out / 'demos'}",
    )  # fmt: skip
    settings = {
        "policy.type": "deltaco",
        "policy.device": "cpu",
        "policy.language_encoder": "all-MiniLM-L6-v2",
        "policy.backbone": "strided",
        "policy.demo_encoder": encoder,
        "policy.motion_modes": 5 if encoder != "cnn" else 1,
        "policy.gripper_loss": "cross_entropy",
        "policy.dtype": "bfloat16",
        "policy.tasks_per_batch": 16,
        "policy.demo_repo_id": "minute/demos",
        "policy.demo_root": out / "demos",
        "dataset.repo_id": "minute/train",
        "dataset.root": out / "train",
        "batch_size": BATCH_SIZE,
        "steps": WARM_UP + STEPS,
        "output_dir": out / "run",
    }
    arguments = [f"--{name}={value}" for name, value in settings.items()]
    clock, processor, steps = _measure_training(out / "times.json", arguments, n_threads=1)
    name = f"deltaco-train, {WARM_UP + STEPS} steps, {encoder}, start included"
    lines += [Line(name, clock, processor, "s"), *steps]
    if available_cores() > 1:
        settings["output_dir"] = out / "run_of_all_cores"
        arguments = [f"--{name}={value}" for name, value in settings.items()]
        lines += _measure_training(out / "times.json", arguments, available_cores())[2]
    clock, processor, _ = _run(
        "-m", _command("evaluate"), str(out / "run"), f"--tasks={EVALUATED}", f"--trials={TRIALS}"
    )
    (record,) = (out / "run" / "evaluations").glob("*.json")
    contents = json.loads(record.read_text())
    n_evaluated = len(contents["episodes"])
    return [
        *lines,
        Line(f"deltaco-evaluate, {n_evaluated} episodes, start included", clock, processor, "s"),
        Line("    of which the episodes", n_evaluated / contents["seconds"], None, "episodes/s"),
    ]


def _measure_training(
    times: Path, arguments: Sequence[str], n_threads: int
) -> tuple[float, float, list[Line]]:
    """A training: its seconds on the clock and of the processor, and lines on its steps."""
    script = str(Path(__file__).with_name("step_times.py"))
    clock, processor, _ = _run(script, str(times), *arguments, OMP_NUM_THREADS=str(n_threads))
    step, step_cpu = median_step(times, WARM_UP)
    threads = f"{n_threads} thread{'s' if n_threads > 1 else ''}"
    lines = [
        Line(f"    a step of {BATCH_SIZE} samples, {threads}", step, step_cpu, "s"),
        Line(f"    samples, {threads}", BATCH_SIZE / step, BATCH_SIZE / step_cpu, "samples/s"),
    ]
    return clock, processor, lines


def _command(name: str) -> str:
    return f"lerobot_deltaco.commands.{name}"


def _run(*words: str, **settings: str) -> tuple[float, float, str]:
    """Runs Python. Seconds on the clock, those of the processor, and what it printed."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    result = subprocess.run(
        [sys.executable, *words],
        env={**os.environ, "HF_HUB_OFFLINE": "1", **settings},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT if "-c" not in words else None,
        text=True,
    )
    clock, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    if result.returncode != 0:
        sys.exit(f"{' '.join(words[:2])} failed:\n{(result.stdout or '')[-3000:]}")
    processor = after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
    return clock, processor, result.stdout


if __name__ == "__main__":
    main()
