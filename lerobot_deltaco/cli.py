"""The command `deltaco`: each subcommand is a function, whose arguments tyro turns into options."""

# No `from __future__ import annotations`: tyro reads the annotations of nested functions.

import ast
import logging
import os
import shlex
import sys
import textwrap
import traceback
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from gym_deltaco.atomic_files import parse_json

COMMANDS = {
    "collect": "Collect episodes of the scripted expert as a LeRobotDataset.",
    "check": "Show what a policy would take from a dataset, before it is trained.",
    "train": "Train a policy: `lerobot-train` over frames in memory.",
    "evaluate": "Evaluate a policy on the benchmark, and record every episode.",
    "report": "Write tables and a figure from the records of evaluations.",
    "experiment": "Run experiments: collect, train, evaluate and report.",
    "look": "Draw what a policy sees: what was moved, where it would pick and place.",
    "play": "Play with a policy in the browser.",
    "demo": "Train and evaluate the project's method in a few minutes.",
}
_PACKAGES = ("lerobot_deltaco", "gym_deltaco")
_POLICIES = {
    "deltaco_match": "deltaco_match/configuration_deltaco_match.py",
    "deltaco": "deltaco/configuration_deltaco.py",
}


def main() -> None:
    """Runs the subcommand given on the command line."""
    name, arguments = (sys.argv[1:2] or ["--help"])[0], sys.argv[2:]
    if name in ("-h", "--help"):
        _print(_overview())
        return
    if name not in COMMANDS:
        sys.exit(f"deltaco: unknown command {name!r}. The commands are {', '.join(COMMANDS)}.")
    if name == "train" and {"-h", "--help"} & set(arguments):
        _print(_training_help())
        return
    logging.basicConfig(format="%(levelname)s %(message)s", level=logging.WARNING)
    try:
        if name == "train":
            _train(arguments)
            return
        import tyro

        function = globals()[f"_{name}"]()
        result = tyro.cli(function, prog=f"deltaco {name}", description=COMMANDS[name], args=arguments)
        if result is not None:
            _print(str(result))
    except KeyboardInterrupt:
        sys.exit("\nInterrupted. Run the same command again to continue.")
    except Exception as error:
        if _is_ours(error):
            sys.exit(f"deltaco {name}: {error}")
        # Libraries report it as errors of their own.
        if "No space left on device" in str(error):
            sys.exit(
                f"deltaco {name}: The disk of {_output_folder(arguments)} is full. Free some space, and run "
                "the command again. Training continues from its last complete checkpoint with --resume=true "
                "--config_path=RUN/checkpoints/last/pretrained_model/train_config.json."
            )
        if isinstance(error, OSError):  # a file or folder that cannot be read or written
            sys.exit(f"deltaco {name}: {error}")
        raise


def _is_ours(error: BaseException) -> bool:
    """Returns whether an error was raised on purpose, with a message for the user, by this project.

    Other errors are reported with their traceback. LeRobot's parser may wrap an error that was raised on
    purpose.
    """
    frames = traceback.extract_tb(error.__traceback__)
    return bool(frames) and any(f"/{package}/" in frames[-1].filename for package in _PACKAGES)


def _output_folder(arguments: Sequence[str]) -> Path:
    """Returns the folder that a command writes to, as its arguments say."""
    words = [part for word in arguments for part in word.split("=", 1)]
    named = [words[n + 1] for n, word in enumerate(words[:-1]) if word in ("--output_dir", "--out", "--root")]
    return Path(*named[-1:]).resolve()


def _collect() -> Callable[..., Any]:
    import tyro

    from lerobot_deltaco.collect import CollectionPlan

    def collect(
        plan: Annotated[CollectionPlan, tyro.conf.arg(name="")],
        root: Path,
        workers: int = len(os.sched_getaffinity(0)),
        push_to_hub: bool = False,
        repo_id: str | None = None,
        private: bool = False,
    ) -> str:
        """Collects successful episodes of the expert, or continues an interrupted collection.

        Args:
            plan: Episodes to collect.
            root: Folder of the dataset.
            workers: Number of processes; the dataset is the same with any number.
            push_to_hub: Whether to publish the finished dataset with its card; needs HF_TOKEN.
            repo_id: Name of the dataset on the Hugging Face Hub, USER/NAME.
            private: Whether a new repository on the Hub is private.
        """
        from lerobot_deltaco import collect as room
        from lerobot_deltaco import hub

        if push_to_hub:
            if repo_id is None:
                raise ValueError("--push-to-hub needs --repo-id USER/NAME.")
            hub.check_push(repo_id)
        lines = [str(room.collect(root, plan, workers))]
        if push_to_hub and repo_id is not None:
            lines.append(f"The dataset is at {hub.push(root, repo_id, private)}.")
        return "\n".join(lines)

    return collect


def _train(arguments: list[str]) -> None:
    sys.argv = ["lerobot-train", *arguments]
    import lerobot_policy_deltaco  # noqa: F401  (registers the types of this project)
    from lerobot_deltaco.train import train

    train()


def _evaluate() -> Callable[..., Any]:
    import tyro

    from lerobot_deltaco.records import EvaluationPlan

    def evaluate(
        checkpoint: tyro.conf.Positional[Path],
        plan: Annotated[EvaluationPlan, tyro.conf.arg(name="")],
        steps: str = "all",
        out: Path | None = None,
        processes: int | None = None,
        device: str | None = None,
        demo_repo_id: str | None = None,
        demo_root: Path | None = None,
        experiment: str | None = None,
        rename_map: str | None = None,
    ) -> str:
        """Evaluates a policy of any LeRobot type. Without options, this is the leaderboard's protocol.

        Args:
            checkpoint: Output folder of a training run, or folder of a policy.
            plan: Episodes to run.
            steps: Checkpoints of a training run to evaluate: all, last, or steps such as 4000,8000.
            out: Folder of the records; by default, that of the training run, or outputs/evaluate/NAME.
            processes: Number of processes that share the episodes; by default, one for each core.
            device: Device of the policy, such as cpu.
            demo_repo_id: Dataset of demonstrations, in place of the checkpoint's own.
            demo_root: Folder of that dataset, if it is not in LeRobot's cache.
            experiment: Name of the policy in tables; by default, the job name of its training run.
            rename_map: Names under which the policy knows the environment's observations, as JSON.
        """
        from lerobot_deltaco.evaluate import evaluate_checkpoints

        return evaluate_checkpoints(
            checkpoint,
            plan,
            steps,
            out,
            processes=processes or len(os.sched_getaffinity(0)),
            device=device,
            demo_repo_id=demo_repo_id,
            demo_root=demo_root,
            experiment=experiment,
            rename_map=None if rename_map is None else parse_json(rename_map, "--rename-map"),
            command=shlex.join(["deltaco", *sys.argv[1:]]),
        )

    return evaluate


def _report() -> Callable[..., Any]:
    import tyro

    def report(paths: tyro.conf.Positional[tuple[Path, ...]], out: Path = Path("outputs/report")) -> str:
        """Writes tables and a figure from records.

        Args:
            paths: Files of records, or folders that contain some, such as those of training runs.
            out: Folder of the report.
        """
        from lerobot_deltaco.report import write_report

        return f"The report is {write_report(paths, out)}."

    return report


def _experiment() -> Callable[..., Any]:
    import tyro

    def experiment(
        names: tyro.conf.Positional[tuple[str, ...]] = (),
        scale: Literal["small", "paper"] = "small",
        seed: tuple[int, ...] = (0,),
        out: Path = Path("outputs/experiments"),
        set: tuple[str, ...] = (),
        jobs: int = 1,
        only: Literal["collect", "train", "evaluate", "report"] | None = None,
        dry_run: bool = False,
        list: bool = False,
    ) -> str | None:
        """Runs the steps of experiments that are not finished yet.

        Args:
            names: Experiments, such as scenario_a/deltaco.
            scale: Size of data, networks and training: small for a CPU, or the paper's.
            seed: Seeds of the training.
            out: Folder of all outputs.
            set: Settings that override the recipe, such as training.steps=2000.
            jobs: Number of training runs at a time; each gets its share of the cores.
            only: Run this step alone.
            dry_run: Print the commands without running them.
            list: Print the names of all experiments.
        """
        from lerobot_deltaco.experiments import run_experiments
        from lerobot_deltaco.recipes import experiment_names

        if list:
            return "\n".join(experiment_names())
        run_experiments(names, scale, seed, out, set, jobs, only, dry_run)
        return None

    return experiment


@dataclass(frozen=True)
class PolicyOptions:
    """Options of `deltaco train` on which it depends what is taken from a dataset.

    Args:
        demo_camera: Name of the camera of demonstrations. By default, the first.
        gripper: Gripper's dimension of the action: an index, or "auto" for the last one whose name contains
            "gripper".
        gripper_closed: Whether low or high values of the gripper's dimension mean closed.
        image_size: Height and width to which images are scaled, px.
        chunk_size: Number of steps that the policy predicts at once, on which the time depends; None, as in
            training, chooses it by the length of the episodes.
    """

    demo_camera: str | None = None
    gripper: str = "auto"
    gripper_closed: str = "low"
    image_size: int = 48
    chunk_size: int | None = None


def _check() -> Callable[..., Any]:
    import tyro

    def check(
        dataset: tyro.conf.Positional[str],
        policy: PolicyOptions = PolicyOptions(),  # noqa: B008
        batch_size: int = 64,
        steps: int = 8000,
        episodes: int = 48,
        out: Path = Path("outputs/check"),
    ) -> str:
        """Shows what a policy would take from a dataset, on one self-contained page.

        Args:
            dataset: Folder of a LeRobotDataset, or its id on the Hugging Face Hub.
            policy: Options as for `deltaco train`.
            batch_size: Batch size that the time of training is estimated for.
            steps: Number of training steps that it is estimated for.
            episodes: Number of episodes to show; those that are left out come first.
            out: Folder for the page.
        """
        from lerobot_deltaco.check import check

        return check(dataset, asdict(policy), batch_size, steps, episodes, out)

    return check


def _look() -> Callable[..., Any]:
    import tyro

    def look(
        checkpoint: tyro.conf.Positional[str],
        dataset: str | None = None,
        episodes: int = 12,
        out: Path = Path("outputs/look"),
    ) -> str:
        """Draws where a policy looks in episodes of a dataset or of the benchmark, on one page.

        Args:
            checkpoint: Folder of a policy of the type deltaco_match, or of its training run; or id of a
                repository on the Hugging Face Hub.
            dataset: Folder of a LeRobotDataset, or its id on the Hub. Without one, episodes of the
                benchmark's test tasks are run.
            episodes: Number of episodes, evenly spread.
            out: Folder for the page.
        """
        from lerobot_deltaco.look import look

        return look(checkpoint, dataset, episodes, out)

    return look


def _play() -> Callable[..., Any]:
    import tyro

    def play(checkpoint: tyro.conf.Positional[str | None] = None, port: int = 7860) -> None:
        """Serves the page on this machine until it is interrupted.

        Args:
            checkpoint: Folder of a policy or of a training run, or id of a repository on the Hugging Face
                Hub. By default, it is the one that comes with the project.
            port: Port to serve at.
        """
        from lerobot_deltaco.play import play

        play(checkpoint, port)

    return play


def _demo() -> Callable[..., Any]:
    def demo(minutes: Literal[8, 25] = 8, out: Path = Path("outputs/demo")) -> str:
        """Collects, trains and evaluates the project's method, and writes a page.

        Args:
            minutes: Duration on two idle cores; 25 is the full recipe.
            out: Folder of all outputs.
        """
        from lerobot_deltaco.demo import run_demo

        return f"See {run_demo(minutes, out)}."

    return demo


# Help


def _overview() -> str:
    width = max(map(len, COMMANDS))
    lines = [f"  {name:{width}}  {text}" for name, text in COMMANDS.items()]
    return "\n".join(
        ["usage: deltaco COMMAND ...", "", *lines, "", "deltaco COMMAND --help shows its options."]
    )


def _training_help() -> str:
    """Returns the help of `deltaco train`, from the source: importing LeRobot takes 10 s."""
    parts = [
        "usage: deltaco train --policy.type=deltaco_match --dataset.repo_id=NAME [--dataset.root=DIR] ...\n\n"
        "Takes the arguments of lerobot-train, such as --batch_size, --steps, --save_freq, --output_dir,\n"
        "--job_name, --seed, and --resume=true --config_path=RUN/checkpoints/last/pretrained_model/"
        "train_config.json."
    ]
    folder = Path(__file__).parent
    for name, file in _POLICIES.items():
        parts.append(f"--policy.type={name}\n\n{_options(folder / file)}")
    parts.append(f"Both policies\n\n{_options(folder / 'base_config.py')}")
    return "\n\n".join(parts)


def _options(path: Path) -> str:
    """Returns the options of the configuration in a file, as its docstring describes them."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    config = next(
        node for node in tree.body if isinstance(node, ast.ClassDef) and node.name.endswith("Config")
    )
    defaults = {
        node.target.id: ast.unparse(node.value)
        for node in config.body
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.value is not None
    }
    _, _, described = (ast.get_docstring(config) or "").partition("Args:\n")
    lines = []
    for entry in textwrap.dedent(described).replace("\n    ", " ").splitlines():
        name, _, text = entry.partition(": ")
        if name in defaults:
            lines.append(f"  --policy.{name} (default: {defaults[name]})")
            lines.append(textwrap.fill(text, 110, initial_indent="      ", subsequent_indent="      "))
    return "\n".join(lines)


def _print(text: str) -> None:
    sys.stdout.write(f"{text}\n")


if __name__ == "__main__":
    main()
