"""Runs an experiment: collects its data, trains and evaluates all checkpoints. Finished steps are skipped.

A step alone needs what the steps before it made, and says what is missing. It neither begins nor locks
anything else, so that the jobs of a cluster may each run one.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

from gym_deltaco.atomic_files import write_json
from lerobot_deltaco.common.run_folder import last_policy, last_step, last_train_config
from lerobot_deltaco.evaluation.record import RECORDS_FOLDER, read_record, record_path
from lerobot_deltaco.experiments.command_runner import CommandRunner, ExperimentError
from lerobot_deltaco.experiments.config import BEST_SEED, SAME_SEED, ExperimentConfig

Step = Literal["collect", "train", "evaluate"]
STEPS: tuple[Step, ...] = get_args(Step)


class Command(NamedTuple):
    """A command of this project: `deltaco-NAME ARGUMENTS`."""

    name: str
    arguments: list[str]


class ExperimentRun:
    """An experiment with a seed, in a folder for the outputs of experiments.

    Args:
        config: The experiment.
        seed: Seed of the training: of the weights, the order of the data and the draws.
        outputs: Folder of all outputs: experiments share `data/`; a run's folder is `EXPERIMENT/seed_SEED`.
    """

    def __init__(self, config: ExperimentConfig, seed: int, outputs: Path) -> None:
        self.config = config
        self.seed = seed
        self.outputs = outputs
        self.folder = run_folder(outputs, config.name, seed)
        self.log = self.folder.with_name(f"{self.folder.name}.log")  # if several run at the same time

    def run(self, step: Step | None = None) -> None:
        """Runs all steps that are not finished yet, or one of them.

        Raises:
            ExperimentError: A step failed or lacks what it needs, or the run was started with other settings.
        """
        self.check_settings()
        if step in (None, "collect"):
            self.collect()
        if step != "collect":
            self.train_and_evaluate(CommandRunner(), step)

    def commands(self) -> list[Command]:
        """The commands that `run` would run now."""
        train = self._train_command()
        return [*self._collect_commands(), *([train] if train else []), self._evaluate_command()]

    def check_settings(self) -> None:
        """Checks that the run, if it exists, was started with the same settings.

        Raises:
            ExperimentError: It was started with others.
        """
        file, settings = self._settings_file(), self._settings()
        found = json.loads(file.read_text(encoding="utf-8")) if file.exists() else settings
        for section, values in settings.items():
            if found.get(section) != values:
                raise ExperimentError(
                    f"{self.folder} was started with other settings: {section} was {found.get(section)}, now "
                    f"{values}. Use the same settings or another --out, or move the run and {file.name} away."
                )

    @property
    def uses_any_gpu(self) -> bool:
        """Whether it trains on whichever GPU it sees, rather than on a certain one or on none."""
        return self.config.policy.get("device") in (None, "cuda")

    def collect(self, options: Sequence[str] = ()) -> None:
        """Collects the datasets that the experiment needs; complete ones are kept as they are.

        Args:
            options: More options of `deltaco-collect`, such as "--join".
        """
        for command, arguments in self._collect_commands():
            CommandRunner().run(command, [*arguments, *options])

    def train_and_evaluate(self, runner: CommandRunner, step: Step | None = None) -> None:
        """Trains on the collected datasets, and evaluates; or does one of both.

        Raises:
            ExperimentError: A step failed; the experiment that this one starts from was not trained; or a
                step that is run alone lacks what it needs.
        """
        if step in (None, "train"):
            if step == "train":
                self.check_data()
            self._train(runner)
        if step in (None, "evaluate"):
            if step == "evaluate":
                self.check_trained()
            runner.run(*self._evaluate_command())

    def check_data(self) -> None:
        """Checks that the datasets are finished; they are not locked.

        Raises:
            ExperimentError: One is missing, or its collection is not finished.
        """
        # Only here, since it takes seconds to import.
        from lerobot_deltaco.data.finished_dataset import is_finished

        plans = (self.config.data, self.config.demonstrations)
        for root in dict.fromkeys(dataset_folder(self.outputs, plan) for plan in plans):
            if not is_finished(root):
                state = "is not finished" if root.exists() else "is missing"
                raise ExperimentError(
                    f"{self.config.name} is trained on the dataset {root}, which {state}. Collect it first: "
                    f"deltaco-experiment {self.config.name} --only collect, with the same --set and --out."
                )

    def check_trained(self) -> None:
        """Checks that the training has come to its end.

        Raises:
            ExperimentError: It has not.
        """
        steps = self.config.training["steps"]
        reached = last_step(self.folder) if last_train_config(self.folder).exists() else 0
        if reached < steps:
            state = f"stands at step {reached} of {steps}" if reached else "has no checkpoint"
            raise ExperimentError(
                f"The training in {self.folder} {state}. Finish it first: deltaco-experiment "
                f"{self.config.name} --seed {self.seed} --only train, with the same --set and --out."
            )

    def has_records(self) -> bool:
        """Whether an evaluation has left a record, from which a report can be made."""
        return any((self.folder / RECORDS_FOLDER).glob("*.json"))

    def _train(self, runner: CommandRunner) -> None:
        train = self._train_command()
        begins = train is not None and not last_train_config(self.folder).exists()
        if begins:
            self._check_start()
        write_json(self._settings_file(), self._settings())
        if train is None:
            return
        if begins:
            # An interrupted training may have left a folder without any checkpoint.
            shutil.rmtree(self.folder, ignore_errors=True)
        try:
            runner.run(*train)
        except BaseException:
            if not self.folder.exists():
                # Nothing has begun, so that the settings may still be corrected.
                self._settings_file().unlink(missing_ok=True)
            raise

    def _settings_file(self) -> Path:
        return self.folder.with_name(f"{self.folder.name}.json")

    def _settings(self) -> dict[str, Any]:
        return {
            "data": dict(self.config.data),
            "demonstrations": dict(self.config.demonstrations),
            "policy": dict(self.config.policy),
            "training": dict(self.config.training),
            "start_from": self._start_in_words(),
        }

    def _collect_commands(self) -> list[Command]:
        return [
            Command(
                "collect",
                [
                    *(f"--{name.replace('_', '-')}={value}" for name, value in plan.items()),
                    f"--root={dataset_folder(self.outputs, plan)}",
                ],
            )
            for plan in (self.config.data, self.config.demonstrations)
        ]

    def _train_command(self) -> Command | None:
        """The command that trains, or resumes the training; None if it is finished."""
        last = last_train_config(self.folder)
        if last.exists():
            if last_step(self.folder) >= self.config.training["steps"]:
                return None
            return Command("train", [f"--config_path={last}", "--resume=true"])
        options = {
            **{f"policy.{name}": value for name, value in self.config.policy.items() if value is not None},
            "policy.seed": self.seed,
            "policy.demo_repo_id": "deltaco/demonstrations",
            "policy.demo_root": dataset_folder(self.outputs, self.config.demonstrations),
            "dataset.repo_id": "deltaco/training",
            "dataset.root": dataset_folder(self.outputs, self.config.data),
            **self.config.training,
            "seed": self.seed,
            "job_name": self.config.name,
            "output_dir": self.folder,
        }
        if self.config.training.get("env_eval_freq"):
            own = [name for name in ("scene_set", "seed") if self.config.evaluation.get(name)]
            if own:
                raise ExperimentError(
                    f"{self.config.name} sets `evaluation.{own[0]}`, which evaluations in training do not "
                    "have. Set `training.env_eval_freq` to 0: checkpoints are evaluated afterwards."
                )
            options |= {
                "env.type": "deltaco",
                "env.task": self.config.evaluation["tasks"],
                "env.ambiguity": self.config.evaluation.get("ambiguity", "container"),
                **{
                    f"env.{name}": self.config.evaluation[name]
                    for name in ("objects", "adversarial_probability", "adversarial_draw")
                    if name in self.config.evaluation
                },
                "eval.n_episodes": self.config.evaluation["trials"],
            }
            if "image_size" in self.config.data:
                options["env.image_size"] = self.config.data["image_size"]
        start = self._start_folder()
        if self.config.start_from is None:
            options = {"policy.type": "deltaco", **options}
        else:
            # Without any run to start from, a dry run shows where the run's own seed would be.
            start = start or run_folder(self.outputs, self.config.start_from, self.seed)
            options = {"policy.path": last_policy(start), **options}
        return Command("train", [f"--{name}={_text(value)}" for name, value in options.items()])

    def may_start_from(self, folder: Path) -> bool:
        """Whether the run in a folder is one that this one starts from, or may be."""
        start = self.config.start_from
        if start is None:
            return False
        own = run_folder(self.outputs, start, self.seed)
        return folder == own or (self.config.start_from_seed == BEST_SEED and folder.parent == own.parent)

    def _start_folder(self) -> Path | None:
        """The folder of the run that this one starts from; None without one."""
        start = self.config.start_from
        if start is None:
            return None
        own = run_folder(self.outputs, start, self.seed)
        if self.config.start_from_seed == SAME_SEED:
            return own if last_policy(own).exists() else None
        rates = {}
        for folder in sorted(own.parent.glob("seed_*/")):
            if last_train_config(folder).exists():
                path = record_path(folder, last_step(folder))
                if path.exists():
                    rates[folder] = read_record(path).success_rate
        return max(rates, key=lambda folder: rates[folder]) if rates else None

    def _start_in_words(self) -> str | None:
        if self.config.start_from_seed == BEST_SEED:
            return f"{self.config.start_from}, the best seed"
        return self.config.start_from

    def _check_start(self) -> None:
        if self.config.start_from is None or self._start_folder() is not None:
            return
        lacks = f"trained with seed {self.seed}"
        if self.config.start_from_seed == BEST_SEED:
            lacks = "trained and evaluated with any seed"
        raise ExperimentError(
            f"{self.config.name} starts from {self.config.start_from}, which was not {lacks}. Run that "
            "experiment first."
        )

    def _evaluate_command(self) -> Command:
        """The command that evaluates the checkpoints that the training has not evaluated."""
        options = [f"--{name.replace('_', '-')}={value}" for name, value in self.config.evaluation.items()]
        return Command("evaluate", [str(self.folder), *options, f"--experiment={self.config.name}"])


def run_folder(outputs: Path, experiment_name: str, seed: int) -> Path:
    """The folder of an experiment's run with a seed."""
    return outputs / experiment_name / f"seed_{seed}"


def dataset_folder(outputs: Path, plan: Mapping[str, Any]) -> Path:
    """The folder of a collection's dataset, which experiments share."""
    name = "_".join(f"{key}-{value}" for key, value in sorted(plan.items()))
    # Such as that of "random:100", which not every file system takes.
    return outputs / "data" / name.replace(":", "-")


def missing_records(runs: Sequence[ExperimentRun]) -> str | None:
    """What to do about the runs without any record; None if all have some."""
    missing = [f"{run.config.name} with seed {run.seed}" for run in runs if not run.has_records()]
    if not missing:
        return None
    return (
        f"There is no record of an evaluation of {', '.join(missing)}. Evaluate first: deltaco-experiment "
        "--only evaluate, with the same --set and --out; or name fewer experiments and seeds."
    )


def _text(value: Any) -> str:
    return json.dumps(value) if isinstance(value, bool | list) else str(value)
