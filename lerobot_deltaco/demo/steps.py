"""The steps of the demo: each is a command, and runs once. An interrupted demo continues."""

from __future__ import annotations

import json
import shutil
import sys
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tqdm import tqdm

from gym_deltaco.atomic_files import write_json
from lerobot_deltaco.common.cores import available_cores
from lerobot_deltaco.common.run_folder import last_policy, last_train_config
from lerobot_deltaco.demo import recipe
from lerobot_deltaco.demo.commands import Command, deltaco, lerobot, run
from lerobot_deltaco.demo.machine import fast_dtype, seconds_per_step

TRAINING_SET = "deltaco/demo"
DEMONSTRATIONS = "deltaco/demo_demonstrations"
# What a finished step leaves, with the seconds that it took.
_DONE = "done.json"


class DemoError(RuntimeError):
    """A step failed; the message says which, and how it was called."""


class Demo:
    """A demo in a folder.

    Args:
        folder: Folder of all outputs. It must not hold a demo with other settings.
        settings: Changes of the recipe, for tests: steps, episodes per task, trials.

    Raises:
        DemoError: The folder holds a demo with other settings.
    """

    def __init__(self, folder: Path, settings: Mapping[str, Any] | None = None) -> None:
        self.folder = folder
        self.settings: dict[str, Any] = {
            "tasks": list(recipe.TRAINED_TASKS),
            "new_combinations": list(recipe.NEW_COMBINATIONS),
            "episodes_per_task": recipe.EPISODES_PER_TASK,
            "steps": None,  # as many as this machine does in the time for it
            "save_every": recipe.SAVE_EVERY,
            "batch_size": recipe.BATCH_SIZE,
            "trials": dict(recipe.TRIALS),
            "counterfactual_trials": recipe.COUNTERFACTUAL_TRIALS,
            "policy": dict(recipe.POLICY_OPTIONS),
            **(settings or {}),
        }
        file = folder / "settings.json"
        there = json.loads(file.read_text()) if file.exists() else None
        # Once chosen, they stay, also if the folder is moved to another machine.
        if there is not None and self.settings["steps"] is None:
            self.settings["steps"] = there.get("steps")
        if there is not None and "dtype" not in self.settings["policy"]:
            self.settings["policy"]["dtype"] = there.get("policy", {}).get("dtype")
        elif "dtype" not in self.settings["policy"]:
            self.settings["policy"]["dtype"] = fast_dtype()
        if there not in (None, self.settings):
            raise DemoError(
                f"{folder} has a demo with other settings. Move that folder away, and run the demo again."
            )
        folder.mkdir(parents=True, exist_ok=True)
        self._write_settings()

    def _write_settings(self) -> None:
        write_json(self.folder / "settings.json", self.settings)

    @property
    def run(self) -> Path:
        """The folder of the training run."""
        return self.folder / "training"

    @property
    def checkpoint(self) -> Path:
        """The policy at the end of the training."""
        return last_policy(self.run)

    def seconds(self) -> dict[str, float]:
        """Seconds of each finished step and of its unfinished attempts, by name.

        Commands that run together have no seconds of their own: 0.
        """
        file = self.folder / _DONE
        return json.loads(file.read_text()) if file.exists() else {}

    def collect(self) -> None:
        """Collects the training set and the demonstrations."""
        tasks = recipe.selection(tuple(self.settings["tasks"]))
        everything = recipe.selection((*self.settings["tasks"], *self.settings["new_combinations"]))
        number = str(self.settings["episodes_per_task"])
        self._do(
            "collect",
            "Collecting the expert's episodes",
            deltaco(
                "collect", "--tasks", tasks, "--episodes-per-task", number, "--root", self.folder / "dataset"
            ),
        )
        self._do(
            "demonstrate",
            "Collecting one demonstration of each task",
            deltaco(
                "collect",
                "--tasks",
                everything,
                "--episodes-per-task",
                str(recipe.DEMONSTRATIONS_PER_TASK),
                "--split",
                "validation",
                "--root",
                self.folder / "demonstrations",
            ),
        )

    def train(self) -> None:
        """Trains with `deltaco-train`, from the last checkpoint if there is one."""
        if self.settings["steps"] is None:
            self.settings["steps"] = self._affordable_steps()
            self._write_settings()
        steps = self.settings["steps"]
        last = last_train_config(self.run)
        if last.exists():
            arguments = [f"--config_path={last}", "--resume=true"]
        else:
            # What an interrupted training left before its first checkpoint.
            shutil.rmtree(self.run, ignore_errors=True)
            policy = {f"policy.{name}": value for name, value in self.settings["policy"].items()}
            options = {
                **policy,
                "policy.demo_repo_id": DEMONSTRATIONS,
                "policy.demo_root": self.folder / "demonstrations",
                "dataset.repo_id": TRAINING_SET,
                "dataset.root": self.folder / "dataset",
                "batch_size": self.settings["batch_size"],
                "steps": steps,
                "save_freq": min(self.settings["save_every"], steps),
                "log_freq": 100,
                "job_name": "demo",
                "output_dir": self.run,
            }
            arguments = [f"--{name}={value}" for name, value in options.items()]
        self._do("train", f"Training for {steps} steps", deltaco("train", *arguments))

    def _affordable_steps(self) -> int:
        """Number of training steps that this machine manages in the time for them."""
        sys.stdout.write("\n[demo] Measuring how many training steps this machine manages in the time.\n")
        sys.stdout.flush()
        start = time.monotonic()
        seconds = seconds_per_step(
            TRAINING_SET, self.folder / "dataset", self.settings["policy"], self.settings["batch_size"]
        )
        self._note("measure", time.monotonic() - start)
        steps = round(recipe.TRAINING_SECONDS / seconds, -2)
        return int(min(max(steps, recipe.LEAST_STEPS), recipe.MOST_STEPS))

    def evaluate(self) -> None:
        """Evaluates on new scenes of trained tasks, on new combinations, and with counterfactual inputs.

        As many run at a time as there are cores.
        """
        evaluations = {}
        for name, tasks in (("trained", "tasks"), ("new", "new_combinations")):
            trials = self.settings["trials"][name]
            options = {
                "policy.path": self.checkpoint,
                "env.type": "deltaco",
                "env.task": recipe.selection(tuple(self.settings[tasks])),
                "env.render_size": 128,
                "eval.n_episodes": trials,
                "eval.batch_size": min(10, trials),
                "eval.use_async_envs": "false",
                "output_dir": self.folder / "evaluation" / name,
            }
            arguments = [f"--{key}={value}" for key, value in options.items()]
            evaluations[f"evaluate_{name}"] = lerobot("eval", *arguments)
        everything = recipe.selection((*self.settings["tasks"], *self.settings["new_combinations"]))
        trials = str(self.settings["counterfactual_trials"])
        for what in ("demo", "instruction"):
            arguments = [
                "--tasks",
                everything,
                "--steps",
                "last",
                "--counterfactual",
                what,
                "--trials",
                trials,
            ]
            evaluations[f"other_{what}"] = deltaco("evaluate", self.run, *arguments)
        self._do_together("evaluate", "Evaluating", evaluations)

    def _do(self, name: str, what: str, command: Command) -> None:
        """Runs a command, unless it was run to its end before."""
        seconds = self.seconds()
        if name in seconds:
            sys.stdout.write(f"[demo] {what}: done before.\n")
            return
        sys.stdout.write(f"\n[demo] {what}:\n{command}\n")
        sys.stdout.flush()
        with self._timed(name):
            code = run(command)
            if code != 0:
                raise DemoError(_failure(what, code, command, "above"))

    def _do_together(self, name: str, what: str, commands: Mapping[str, Command]) -> None:
        """Runs commands, as many at a time as there are cores, unless they were run to their ends before.

        The output of each goes to a file of its own.
        """
        seconds = self.seconds()
        if name in seconds:
            sys.stdout.write(f"[demo] {what}: done before.\n")
            return
        left = {part: command for part, command in commands.items() if part not in seconds}
        n_workers = max(1, min(available_cores(), len(left)))
        logs = self.folder / "logs"
        logs.mkdir(exist_ok=True)
        sys.stdout.write(f"\n[demo] {what}, {n_workers} at a time; their output is in {logs}:\n")
        sys.stdout.writelines(f"{command}\n" for command in left.values())
        sys.stdout.flush()
        n_threads = max(1, available_cores() // n_workers)

        def run_part(part: str) -> tuple[str, int]:
            return part, run(left[part], logs / f"{part}.txt", n_threads)

        with self._timed(name), ThreadPoolExecutor(n_workers) as threads:
            runs = [threads.submit(run_part, part) for part in left]
            failure: DemoError | None = None
            try:
                for finished in tqdm(as_completed(runs), what, total=len(runs), unit="evaluation"):
                    part, code = finished.result()
                    if code == 0:
                        self._note(part, 0.0)
                    else:
                        log = str(logs / f"{part}.txt")
                        failure = failure or DemoError(_failure(part, code, left[part], log))
            except BaseException:  # such as an interrupt: what waits must not start
                threads.shutdown(wait=False, cancel_futures=True)
                raise
            if failure is not None:
                raise failure

    @contextmanager
    def _timed(self, name: str) -> Iterator[None]:
        """Notes a step as finished, with its seconds, those of interrupted attempts included."""
        start = time.monotonic()
        try:
            yield
        finally:
            self._note(f"{name}_so_far", time.monotonic() - start)
        self._note(name, self.seconds()[f"{name}_so_far"])

    def _note(self, name: str, seconds: float) -> None:
        everything = self.seconds()
        everything[name] = everything.get(name, 0.0) + seconds
        write_json(self.folder / _DONE, everything)


def _failure(what: str, code: int, command: Command, where: str) -> str:
    return (
        f"{what} failed (exit status {code}); see {where} for why. The command was\n{command}\n"
        "After fixing the cause, run the demo again: it continues from here."
    )
