"""The demo: trains `deltaco_match` from scratch in a few minutes, and writes a page that shows what it does.

It is the experiment `random_objects/deltaco_match` with less data and fewer steps, evaluated on the 102 novel
tasks of scenario A. Finished steps are skipped, so the same command continues after an interruption.
"""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import date
from importlib.metadata import version
from pathlib import Path
from types import MappingProxyType
from typing import Literal

import numpy as np
import pandas as pd

from lerobot_deltaco.atomic_files import only_writer, read_json, write_json
from lerobot_deltaco.evaluation.records import EvaluationPlan, EvaluationRecord
from lerobot_deltaco.experiments.recipes import read_recipe
from lerobot_deltaco.experiments.run import TrainingRun, last_checkpoint, last_step, read_run_records
from lerobot_deltaco.pages.html import EpisodeView, write_page
from lerobot_deltaco.reports.leaderboard import CHANCE, PAPER
from lerobot_deltaco.reports.metrics import followed, success_interval

Minutes = Literal[8, 25]

EXPERIMENT = "random_objects/deltaco_match"
# Episodes of each of the 630 training tasks, and training steps, by the minutes that they take at most on two
# fast, idle cores. 25 minutes are enough for the full recipe.
BUDGETS: MappingProxyType[Minutes, tuple[int, int]] = MappingProxyType({8: (3, 800), 25: (16, 8000)})

_CALIBRATION_SIZE, _CALIBRATION_REPEATS = 1024, 20


def run_demo(minutes: Minutes = 8, out: Path = Path("outputs/demo")) -> Path:
    """Collects, trains and evaluates the project's method, and writes a page.

    Args:
        minutes: Duration on two fast, idle cores; 25 is the full recipe.
        out: Folder of all outputs.

    Returns:
        The page, `index.html`. A line about the run is appended to `records.csv` beside it.

    Raises:
        UserError: A step failed, or another process writes to the folder.
    """
    os.environ.setdefault("HF_HUB_OFFLINE", "1")  # the language encoder comes as a package
    with only_writer(out):
        return _run_demo(minutes, out)


def _run_demo(minutes: Minutes, out: Path) -> Path:
    episodes_per_task, steps = BUDGETS[minutes]
    settings = (
        f"data.episodes_per_task={episodes_per_task}",
        f"training.steps={steps}",
        f"training.save_freq={steps}",
    )
    recipe = read_recipe(EXPERIMENT, settings=settings)
    run = TrainingRun(recipe, seed=0, out=out / f"{minutes}_minutes")
    run.check_settings()
    times = run.out / "minutes.json"
    for step in run.steps():
        with _timed(times, step.name):
            step.run()
    swapped = {
        kind: replace(recipe.evaluation, counterfactual=kind, trials=1)
        for kind in ("demonstration", "instruction")
    }
    for plan in swapped.values():
        if run.unevaluated_steps(plan):
            with _timed(times, "counterfactuals"):
                run.evaluation(plan).run()
    scene = run.out / "scene.json"
    if not scene.is_file():
        with _timed(times, "videos"):
            write_json(scene, [view._asdict() for view in record_showcase(last_checkpoint(run.folder))])
    record, spent = _record(run, recipe.evaluation), read_json(times)
    total = np.sum(list(spent.values()), axis=0).tolist()
    rate, low, high = (100 * number for number in success_interval(record.episodes))
    paper = 100 * PAPER.rate["scenario_a/deltaco"]
    page = write_page(
        out,
        "demo.html",
        rate=rate,
        low=low,
        high=high,
        bars=[
            ("This policy", rate, f"95 % interval over tasks: {low:.1f} to {high:.1f}"),
            ("DeL-TaCo", paper, "as published: other simulation, 198 training tasks"),
            ("Random choice", 100 * CHANCE, "one of three objects, one of two bins"),
        ],
        n_episodes=len(record.episodes),
        n_tasks=len(recipe.evaluation.task_ids),
        n_training_episodes=recipe.data.n_episodes,
        training_steps=steps,
        views=[EpisodeView(**row) for row in read_json(scene)],
        followed=[
            (kind, *row)
            for kind, plan in swapped.items()
            for row in followed([_record(run, plan)]).itertuples(index=False)
        ],
        times=spent,
        total=total,
        checkpoint=last_checkpoint(run.folder),
    )
    line = {
        "date": date.today().isoformat(),
        "commit": _commit(),
        "budget_min": minutes,
        "minutes": total[0],
        "core_minutes": total[1],
        "success_rate": rate,
        "low": low,
        "high": high,
        "cores": len(os.sched_getaffinity(0)),
        "calibration_gflops": _calibration(),
    }
    table = out / "records.csv"
    pd.DataFrame([line]).to_csv(table, mode="a", header=not table.exists(), index=False, float_format="%.1f")
    return page


@contextmanager
def _timed(path: Path, name: str) -> Iterator[None]:
    """Adds the minutes and core-minutes of a block to those of a step in a JSON file, if it fails, too."""
    start = np.array([time.monotonic(), sum(os.times()[:4])])
    try:
        yield
    finally:
        spent = (np.array([time.monotonic(), sum(os.times()[:4])]) - start) / 60
        times = read_json(path) if path.is_file() else {}
        write_json(path, {**times, name: (spent + times.get(name, [0, 0])).tolist()})


def record_showcase(checkpoint: Path) -> list[EpisodeView]:
    """Runs a policy in one scene, with each of two demonstrations and each of two sentences."""
    # Only here, since LeRobot takes seconds to import.
    from lerobot_deltaco.evaluation.video import load_conditioned
    from lerobot_deltaco.pages.player import SHOWCASE, Player

    player = Player(load_conditioned(checkpoint))
    return [player.run(choice) for choice in SHOWCASE]


def _record(run: TrainingRun, plan: EvaluationPlan) -> EvaluationRecord:
    step = last_step(run.folder)
    return next(
        record for record in read_run_records(run.folder) if record.plan == plan and record.step == step
    )


def _commit() -> str:
    """Returns the commit of the clone that runs, or the version of the installed package."""
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return version("lerobot_policy_deltaco")


def _calibration() -> float:
    """Measures the speed of this machine with float32 matrix products, in GFLOP/s."""
    matrix = np.random.default_rng(0).random((_CALIBRATION_SIZE, _CALIBRATION_SIZE), dtype=np.float32)
    start = time.perf_counter()
    for _ in range(_CALIBRATION_REPEATS):
        matrix @ matrix  # noqa: B018
    return 2e-9 * _CALIBRATION_REPEATS * _CALIBRATION_SIZE**3 / (time.perf_counter() - start)
