"""The demo: trains `deltaco_match` from scratch in a few minutes, and writes a page that shows what it does.

It is the experiment `random_objects/deltaco_match` with less data and fewer steps, evaluated on the 102 novel
tasks of scenario A. Finished steps are skipped, so the same command continues after an interruption.
"""

from __future__ import annotations

import base64
import csv
import io
import os
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import date
from importlib.metadata import version
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import jinja2
import numpy as np
import pandas as pd

from gym_deltaco.atomic_files import read_json, write_json, write_text
from gym_deltaco.tasks import get_task
from lerobot_deltaco import experiments
from lerobot_deltaco.experiments import Run, available_cores, last_checkpoint, last_step, read_run_records
from lerobot_deltaco.recipes import read_recipe
from lerobot_deltaco.records import EvaluationPlan, EvaluationRecord
from lerobot_deltaco.statistics import followed, success_interval

Minutes = Literal[8, 25]

EXPERIMENT = "random_objects/deltaco_match"


@dataclass(frozen=True)
class Budget:
    """Sizes of a demo.

    Args:
        episodes_per_task: Number of episodes of each of the 630 training tasks.
        steps: Number of training steps.
        trials: Number of episodes of each of the 102 test tasks in the evaluation.
        counterfactual_trials: Number of episodes of each with the demonstration, or the instruction, of
            another task.
    """

    episodes_per_task: int
    steps: int
    trials: int = 4
    counterfactual_trials: int = 1


# By minutes on two idle cores. 25 minutes are enough for the full recipe.
BUDGETS: MappingProxyType[Minutes, Budget] = MappingProxyType({8: Budget(5, 2500), 25: Budget(16, 8000)})

# Success rates to compare with, on the novel tasks of scenario A, in %.
CHANCE = 16.7  # one of three objects, one of two containers
PAPER = 25.8  # DeL-TaCo, in the authors' simulation, trained on the 198 tasks
LONGER = 80.9  # the recipe of this demo in full: the shipped policy

# One scene and two tasks of novel objects in it. With either demonstration, either sentence is a task.
SCENE_TASK, SCENE_TRIAL = 25, 2
DEMONSTRATION_TASKS = MappingProxyType({"the gray ring": (25, 1), "the yellow lampshade": (29, 2)})
SENTENCES = ("Put it in green bin.", "Put it in red bin.")  # containers 0 and 1 of the scene
VIDEO_SIZE = 256  # px

CALIBRATION_SIZE, CALIBRATION_REPEATS = 1024, 20
STEP_NAMES = MappingProxyType(
    {
        "collect": "collecting episodes of the scripted expert",
        "train": "training",
        "evaluate": "evaluation on the 102 novel tasks",
        "counterfactuals": "evaluation with the inputs of other tasks",
        "videos": "recording the videos above",
    }
)


def run_demo(minutes: Minutes = 8, out: Path = Path("outputs/demo")) -> Path:
    """Collects, trains, evaluates, and writes a page.

    Args:
        minutes: Duration on two idle cores: 8, or 25 for the full recipe.
        out: Folder of all outputs.

    Returns:
        The page, `index.html`. A line about the run is appended to `records.csv` beside it.

    Raises:
        ExperimentError: A step failed.
    """
    os.environ.setdefault("HF_HUB_OFFLINE", "1")  # the language encoder comes as a package
    budget = BUDGETS[minutes]
    settings = {
        "data.episodes_per_task": budget.episodes_per_task,
        "training.steps": budget.steps,
        "training.save_freq": budget.steps,
        "evaluation.trials": budget.trials,
    }
    recipe = read_recipe(EXPERIMENT, settings=[f"{key}={value}" for key, value in settings.items()])
    run = Run(recipe, seed=0, out=out / f"{minutes}_minutes")
    run.check_settings()
    clock = Clock(run.out / "minutes.json")
    with clock.step("collect"):
        for command in run.collect_commands():
            experiments.call(command)
    with clock.step("train"):
        run.train()
    with clock.step("evaluate"):
        run.evaluate()
    with clock.step("counterfactuals"):
        for plan in _counterfactual_plans(recipe.evaluation, budget):
            if run.unevaluated_steps(plan):
                experiments.call(run.evaluate_command(plan))
    with clock.step("videos"):
        _record_scene(run)
    page = out / "index.html"
    write_text(page, render_page(run, budget, clock))
    if not clock.times.get("recorded"):
        _append_record(out / "records.csv", minutes, run, clock)
        clock.save(recorded=True)
    return page


class Clock:
    """Measures the steps of a demo, and stores the times in a file.

    Args:
        path: JSON file with minutes and core-minutes by step, interrupted attempts included.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.times: dict[str, Any] = read_json(path) if path.is_file() else {}

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Adds the time of a block to that of a step."""
        start = time.monotonic(), sum(os.times()[:4])
        try:
            yield
        finally:
            earlier = self.times.get(name, (0.0, 0.0))
            spent = (time.monotonic() - start[0]) / 60, (sum(os.times()[:4]) - start[1]) / 60
            self.save(**{name: [before + now for before, now in zip(earlier, spent, strict=True)]})

    def save(self, **times: Any) -> None:
        """Updates the file."""
        self.times |= times
        write_json(self.path, self.times)

    @property
    def steps(self) -> dict[str, tuple[float, float]]:
        """Minutes and core-minutes of each step, by its description."""
        return {text: tuple(self.times[name]) for name, text in STEP_NAMES.items() if name in self.times}

    @property
    def total(self) -> tuple[float, float]:
        """Minutes and core-minutes of all steps."""
        minutes, core_minutes = (float(sum(column)) for column in zip(*self.steps.values(), strict=True))
        return minutes, core_minutes


def render_page(run: Run, budget: Budget, clock: Clock) -> str:
    """Renders the page, with its images and videos inside.

    Args:
        run: A run with finished evaluations and videos.
        budget: Sizes of the demo.
        clock: Times of its steps.
    """
    record = _record(run, run.recipe.evaluation)
    rate, low, high = _rate(record)
    bars = [
        ("This policy", rate, f"{low:.1f} to {high:.1f}"),
        ("The paper's", PAPER, "its own simulation, 198 training tasks"),
        ("Random choices", CHANCE, "one of three objects, one of two containers"),
        ("Trained for longer", LONGER, "the shipped policy: 8,000 steps on 10,080 episodes"),
    ]
    values = {
        "rate": rate,
        "low": low,
        "high": high,
        "bars": bars,
        "n_episodes": len(record.episodes),
        "budget": budget,
        "n_training_episodes": 630 * budget.episodes_per_task,
        "sentences": SENTENCES,
        "demonstrations": _scene_rows(run),
        "followed": [
            (plan.counterfactual, row)
            for plan in _counterfactual_plans(run.recipe.evaluation, budget)
            for row in _followed(_record(run, plan))
        ],
        "steps": clock.steps,
        "total": clock.total,
        "checkpoint": last_checkpoint(run.folder),
    }
    environment = jinja2.Environment(undefined=jinja2.StrictUndefined, autoescape=True, trim_blocks=True)
    template = Path(__file__).with_name("demo.html").read_text(encoding="utf-8")
    return environment.from_string(template).render(**values)


# Evaluations


def _counterfactual_plans(plan: EvaluationPlan, budget: Budget) -> list[EvaluationPlan]:
    trials = budget.counterfactual_trials
    return [replace(plan, counterfactual=kind, trials=trials) for kind in ("demonstration", "instruction")]


def _record(run: Run, plan: EvaluationPlan) -> EvaluationRecord:
    step = last_step(run.folder)
    return next(
        record for record in read_run_records(run.folder) if record.plan == plan and record.step == step
    )


def _rate(record: EvaluationRecord) -> tuple[float, float, float]:
    """Returns the success rate and its 95 % interval by bootstrap over tasks, in %."""
    rate, low, high = success_interval(record.episodes)
    return 100 * rate, 100 * low, 100 * high


def _followed(record: EvaluationRecord) -> list[dict[str, Any]]:
    """Counts which input behavior followed, of the object and of the container."""
    return followed([record]).to_dict("records")


# The scene with two demonstrations and two sentences


def record_episode(
    checkpoint: Path,
    task_id: int,
    seed: int,
    demonstration_task: int,
    instruction: str,
    video: Path,
    maps: Path,
) -> list[int]:
    """Records one episode of a policy.

    Args:
        checkpoint: Folder of the policy, which keeps demonstrations of the test tasks.
        task_id: Task that the scene is drawn for.
        seed: Seed of the environment's reset.
        demonstration_task: Task whose demonstration the policy gets.
        instruction: Sentence that the policy gets.
        video: MP4 file for the episode, 256 px.
        maps: PNG file for the first image with the maps of where the policy looks for the object and for the
            container.

    Returns:
        Container of each of the three objects at the end: 0 green, 1 red, -1 none.
    """
    # Only here, since LeRobot takes seconds to import.
    from lerobot_deltaco.pictures import demonstration_ends, draw_found, write_video
    from lerobot_deltaco.recording import benchmark_scene, load_conditioned
    from lerobot_deltaco.recording import record_episode as record

    loaded = load_conditioned(checkpoint)
    bank = loaded.policy.demonstrations
    demonstrations = bank.of_task(get_task(demonstration_task).instruction)[:1]
    scene = benchmark_scene(loaded.policy.config)
    recording = record(loaded, task_id, seed, instruction, demonstrations, scene, VIDEO_SIZE)
    assert recording.found is not None
    write_video(recording.frames, video)
    draw_found(recording.frames[0], demonstration_ends(demonstrations[0]), recording.found).save(maps)
    return recording.info["object_containers"].tolist()


def _record_scene(run: Run) -> None:
    """Records the episodes that are missing, and their outcomes."""
    seed = run.recipe.evaluation.scene_seed(SCENE_TASK, SCENE_TRIAL)
    for task_id, _ in DEMONSTRATION_TASKS.values():
        for container, sentence in enumerate(SENTENCES):
            stem = _episode_stem(run, task_id, container)
            if stem.with_suffix(".json").is_file():
                continue
            stem.parent.mkdir(parents=True, exist_ok=True)
            files = stem.with_suffix(".mp4"), stem.with_suffix(".png")
            found = record_episode(last_checkpoint(run.folder), SCENE_TASK, seed, task_id, sentence, *files)
            write_json(stem.with_suffix(".json"), found)


def _episode_stem(run: Run, demonstration_task: int, container: int) -> Path:
    return run.out / "videos" / f"demonstration_{demonstration_task}_container_{container}"


def _scene_rows(run: Run) -> list[dict[str, Any]]:
    """Returns each demonstration with its images and its episodes, one of each sentence."""
    rows = []
    for name, (task_id, index) in DEMONSTRATION_TASKS.items():
        episodes = []
        for container, sentence in enumerate(SENTENCES):
            stem = _episode_stem(run, task_id, container)
            containers = read_json(stem.with_suffix(".json"))
            episodes.append(
                {
                    "sentence": sentence,
                    "video": _data_uri(stem.with_suffix(".mp4").read_bytes(), "video/mp4"),
                    "maps": _data_uri(stem.with_suffix(".png").read_bytes(), "image/png"),
                    "success": containers[index] == container,
                }
            )
        rows.append({"name": name, "images": _demonstration_images(run, task_id), "episodes": episodes})
    return rows


def _demonstration_images(run: Run, task_id: int) -> list[str]:
    """Returns the first and the last image of the demonstration of a task."""
    frames = pd.read_parquet(
        run.dataset(run.recipe.demonstrations) / "data",
        columns=["frame_index", "observation.image"],
        filters=[("benchmark.task_id", "==", task_id)],
    ).sort_values("frame_index")
    images = frames["observation.image"]
    return [_data_uri(image["bytes"], "image/png") for image in (images.iloc[0], images.iloc[-1])]


def _data_uri(content: bytes, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


# Records


def _append_record(path: Path, minutes: int, run: Run, clock: Clock) -> None:
    """Appends a line about a run to the table of records."""
    rate, low, high = _rate(_record(run, run.recipe.evaluation))
    line = {
        "date": date.today().isoformat(),
        "commit": _commit(),
        "budget_min": minutes,
        "minutes": f"{clock.total[0]:.1f}",
        "core_minutes": f"{clock.total[1]:.1f}",
        "success_rate": f"{rate:.1f}",
        "low": f"{low:.1f}",
        "high": f"{high:.1f}",
        "cores": available_cores(),
        "calibration_gflops": f"{_calibration():.0f}",
    }
    text = io.StringIO()
    writer = csv.DictWriter(text, line, lineterminator="\n")
    if not path.is_file():
        writer.writeheader()
    writer.writerow(line)
    write_text(path, (path.read_text(encoding="utf-8") if path.is_file() else "") + text.getvalue())


def _commit() -> str:
    """Returns the commit of the clone that runs, or the version of the installed package."""
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return version("lerobot_policy_deltaco")


def _calibration() -> float:
    """Measures the speed of this machine with float32 matrix products, in GFLOP/s."""
    matrix = np.random.default_rng(0).random((CALIBRATION_SIZE, CALIBRATION_SIZE), dtype=np.float32)
    start = time.perf_counter()
    for _ in range(CALIBRATION_REPEATS):
        matrix @ matrix  # noqa: B018
    return 2e-9 * CALIBRATION_REPEATS * CALIBRATION_SIZE**3 / (time.perf_counter() - start)
