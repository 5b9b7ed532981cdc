"""`deltaco-evaluate`: evaluates checkpoints of training runs, and writes a record of each evaluation set."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from dataclasses import replace
from pathlib import Path

from gym_deltaco.instructions import INSTRUCTION_SPLITS
from gym_deltaco.layout import AMBIGUITIES
from gym_deltaco.object_sets import ADVERSARIAL_DRAWS
from lerobot_deltaco.commands.command_errors import exit_on_error
from lerobot_deltaco.common.run_folder import (
    Checkpoint,
    RunDescription,
    RunError,
    checkpoints,
    describe,
    is_checkpoint,
    weights_digest,
)
from lerobot_deltaco.evaluation.plan import EvaluationPlan
from lerobot_deltaco.evaluation.record import (
    COUNTERFACTUALS,
    EvaluationRecord,
    RecordError,
    extras_folder,
    read_record,
    record_path,
)

# What a record must share with the plan of an evaluation to be its record.
_SETTINGS = (
    "tasks",
    "trials",
    "scene_set",
    "counterfactual",
    "ambiguity",
    "image_size",
    "episode_length",
    "objects",
    "adversarial_probability",
    "adversarial_draw",
    "wording",
)


def main(arguments: list[str] | None = None) -> None:
    """Evaluates the checkpoints that have no record yet, and prints the success rates."""
    parser = _parser()
    options = parser.parse_args(arguments)
    command = shlex.join([parser.prog, *(sys.argv[1:] if arguments is None else arguments)])
    try:
        plan = EvaluationPlan(
            options.tasks,
            options.trials,
            options.seed,
            options.scene_set,
            options.counterfactual,
            options.ambiguity,
            objects=options.objects,
            adversarial_probability=options.adversarial_probability,
            adversarial_draw=options.adversarial_draw,
            instructions=options.instructions,
            instructions_split=options.instructions_split,
            instruction=options.instruction,
        )
        given = {
            name: getattr(options, name)
            for name in ("image_size", "episode_length")
            if getattr(options, name) is not None
        }
        plan = replace(plan, **given)
        if options.out is not None and len(options.runs) > 1:
            parser.error(f"--out holds the records of a single run. Got {len(options.runs)} runs.")
        if options.demo_root is not None and options.demo_repo_id is None:
            parser.error("--policy.demo_root is the folder of --policy.demo_repo_id. Give both.")
        others = (options.demo_repo_id, options.n_demonstrations, options.leave_out)
        if others != (None, None, None) and options.out is None:
            parser.error(
                "An evaluation with other demonstrations, or with something left out, must not be mixed with "
                "the run's own. Name another folder for its records with --out."
            )
        for name, minimum in (("processes", 1), ("n_demonstrations", 1), ("explain", 0), ("videos", 0)):
            number = getattr(options, name)
            if number is not None and number < minimum:
                parser.error(f"--{name.replace('_', '-')} must be at least {minimum}. Got {number}.")
        if plan.sentences is not None and options.out is None:
            parser.error(
                "With instructions in other words, an evaluation is not to be taken for the run's own. Name "
                "another folder for its records with --out."
            )
        todo = [(run, checkpoint) for run in options.runs for checkpoint in _chosen(run, options.steps)]
        alone = [run for run, checkpoint in todo if run == checkpoint.folder and is_checkpoint(run)]
        if alone and options.out is None:
            parser.error(
                f"{alone[0]} is a checkpoint, not the folder of a training run. Name a folder for its "
                "records with --out."
            )
    except (ValueError, OSError) as error:
        parser.error(str(error))
    with exit_on_error(parser, RunError, RecordError, ValueError, OSError):
        for run, checkpoint in todo:
            description = describe(checkpoint)
            trained_with = {
                "image_size": description.image_size,
                "episode_length": description.episode_length,
            }
            of_run = replace(plan, **{**trained_with, **given})
            _evaluate(run, checkpoint, description, of_run, options, command)


def _chosen(run: Path, steps: str) -> list[Checkpoint]:
    """The checkpoints of a run that `--steps` selects."""
    found = checkpoints(run)
    if steps == "all":
        return found
    if steps == "last":
        return found[-1:]
    wanted = {int(step) for step in steps.split(",")}
    missing = sorted(wanted - {checkpoint.step for checkpoint in found})
    if missing:
        available = ", ".join(str(checkpoint.step) for checkpoint in found)
        raise RunError(f"{run} has no checkpoint of step {missing[0]}. It has those of {available}.")
    return [checkpoint for checkpoint in found if checkpoint.step in wanted]


def _evaluate(
    run: Path,
    checkpoint: Checkpoint,
    description: RunDescription,
    plan: EvaluationPlan,
    options: argparse.Namespace,
    command: str,
) -> None:
    folder = options.out or run
    left_out = "" if options.leave_out is None else f"_without_{options.leave_out}"
    experiment = options.experiment or description.experiment + left_out
    if description.policy_type != "deltaco":
        ours = {
            "demo_repo_id": "--policy.demo_repo_id",
            "n_demonstrations": "--n-demonstrations",
            "leave_out": "--leave-out",
        }
        for name, option in ours.items():
            if getattr(options, name) is not None:
                raise RunError(
                    f"{run} holds a policy of the type {description.policy_type!r}, which takes no "
                    f"demonstrations. Leave out {option}."
                )
    path = record_path(folder, checkpoint.step, plan.counterfactual)
    record = None
    if path.exists():
        record = read_record(path)
        _check_same_evaluation(path, record, plan, experiment, description, options)
        if record.weights is not None and record.weights != weights_digest(checkpoint.folder):
            raise RecordError(
                f"{path} belongs to another policy: the weights of {checkpoint.folder} are not those that it "
                "is about. Name another folder for the records with --out, or move that record away."
            )
        remark = "already evaluated"
    if record is None or options.explain or options.videos:
        # Only here, since they take seconds to import.
        from lerobot_deltaco.evaluation.checkpoint_policy import load_policy
        from lerobot_deltaco.evaluation.demonstration_checks import check_combines
        from lerobot_deltaco.evaluation.episode_videos import (
            check_explainable,
            write_explanations,
            write_videos,
        )
        from lerobot_deltaco.evaluation.processes import default_processes
        from lerobot_deltaco.evaluation.sets import run_set

        names = ("device", "demo_repo_id", "demo_root", "n_demonstrations", "leave_out")
        given = {name: getattr(options, name) for name in names}
        overrides = [f"--{name}={value}" for name, value in given.items() if value is not None]
        loaded = load_policy(checkpoint.folder, overrides, options.rename_map)
        if options.n_demonstrations is not None:
            check_combines(loaded.policy)
        if options.explain:
            check_explainable(loaded)
        if record is None:
            record = run_set(
                folder,
                checkpoint.step,
                *loaded,
                plan,
                experiment=experiment,
                run_seed=description.seed,
                command=command,
                processes=options.processes or default_processes(str(loaded.policy.config.device)),
                weights=weights_digest(checkpoint.folder),
                demonstrations=options.demo_repo_id,
                demonstrations_digest=_demonstrations_digest(options),
            )
            remark = f"{record.seconds:.0f} s"
    sys.stdout.write(_text(run, record, remark))
    extras = extras_folder(folder, checkpoint.step, plan.counterfactual)
    if options.explain:
        images = write_explanations(extras, loaded, plan, record, options.explain)
        sys.stdout.write(f"Where the policy looked, in {len(images)} episodes: {images[0].parent}\n")
    if options.videos:
        sys.stdout.write(f"Videos: {write_videos(extras, loaded, plan, record, options.videos)}\n")


def _check_same_evaluation(
    path: Path,
    record: EvaluationRecord,
    plan: EvaluationPlan,
    experiment: str,
    description: RunDescription,
    options: argparse.Namespace,
) -> None:
    """Checks that a record that is there is what the arguments ask for.

    Raises:
        RecordError: It is another one.
    """
    if options.out is not None and (record.experiment, record.run_seed) != (experiment, description.seed):
        raise RecordError(
            f"{path} belongs to another run: {record.experiment!r} with seed {record.run_seed}. Expected "
            f"{experiment!r} with seed {description.seed}. Name another folder with --out."
        )
    made_for = {name: getattr(record, name) for name in _SETTINGS} | {"seed": record.evaluation_seed}
    asked_for = {name: getattr(plan, name) for name in _SETTINGS} | {"seed": plan.seed}
    # A record without a set of scenes has that of its step.
    made_for["scene_set"], asked_for["scene_set"] = (
        record.step if number is None else number for number in (record.scene_set, plan.scene_set)
    )
    if record.weights is not None:  # else, the record does not tell
        made_for["demonstrations"], asked_for["demonstrations"] = record.demonstrations, options.demo_repo_id
        digest = _demonstrations_digest(options)
        if None not in (digest, record.demonstrations_digest):
            name = "SHA-256 of the demonstrations' metadata"
            made_for[name], asked_for[name] = record.demonstrations_digest, digest
    if options.n_demonstrations is not None:
        made_for["n_demonstrations"] = record.policy.get("n_demonstrations", 1)
        asked_for["n_demonstrations"] = options.n_demonstrations
    if description.policy_type == "deltaco":
        made_for["leave_out"], asked_for["leave_out"] = record.policy.get("leave_out"), options.leave_out
    if made_for != asked_for:
        raise RecordError(
            f"{path} belongs to another evaluation: {made_for}. Expected {asked_for}. Use the same "
            "arguments, or name another folder for the records with --out."
        )


def _demonstrations_digest(options: argparse.Namespace) -> str | None:
    """Digest of the dataset of demonstrations that is given; None if none is, or it is not here yet."""
    from lerobot_deltaco.policy.dataset_folders import metadata_digest

    return None if options.demo_repo_id is None else metadata_digest(options.demo_repo_id, options.demo_root)


def _text(run: Path, record: EvaluationRecord, remark: str) -> str:
    n_episodes = len(record.episodes)
    what = "" if record.counterfactual == "none" else f", another task's {record.counterfactual}"
    return (
        f"{run}, step {record.step}{what}: {record.success_rate:.1%} of {n_episodes} episodes of "
        f"{record.tasks} succeeded ({remark}).\n"
    )


def _steps(text: str) -> str:
    if text not in ("all", "last") and not all(part.isdecimal() for part in text.split(",")):
        raise argparse.ArgumentTypeError(f"must be 'all', 'last' or steps such as 1000,2000. Got {text!r}.")
    return text


def _rename_map(text: str) -> dict[str, str]:
    try:
        names = json.loads(text)
    except ValueError:
        names = None
    if not isinstance(names, dict) or not all(isinstance(name, str) for name in names.values()):
        raise argparse.ArgumentTypeError(
            "must be names in JSON, such as "
            f'{{"observation.image": "observation.images.camera1"}}. Got {text!r}.'
        )
    return names


def _parser() -> argparse.ArgumentParser:
    plan = EvaluationPlan()
    parser = argparse.ArgumentParser(
        prog="deltaco-evaluate",
        description="Evaluates checkpoints of training runs, of any LeRobot policy, and writes a record of "
        "each evaluation set to the folder `evaluations` of the run. Checkpoints that have a record are "
        "skipped. `deltaco-report` tabulates the records.",
    )
    parser.add_argument(
        "runs",
        nargs="+",
        type=Path,
        metavar="RUN_DIR",
        help="folder of a training run, or of a checkpoint (then with --out)",
    )
    parser.add_argument(
        "--tasks",
        default=plan.tasks,
        help="task set (scenario_a_test, ...), or indices and ranges, such as 4,50-73 (default: %(default)s)",
    )
    parser.add_argument(
        "--trials",
        type=int,
        default=plan.trials,
        metavar="N",
        help="number of episodes of each task (default: %(default)s)",
    )
    parser.add_argument(
        "--seed",
        type=int,
        default=plan.seed,
        help="evaluation seed, from which the scenes derive, along with the number of their set (default: "
        "%(default)s)",
    )
    parser.add_argument(
        "--scene-set",
        type=int,
        metavar="N",
        help="number of the set of scenes: the same number gives checkpoints of different steps the same "
        "scenes (default: the checkpoint's step)",
    )
    parser.add_argument(
        "--counterfactual",
        choices=COUNTERFACTUALS,
        default=plan.counterfactual,
        help="input that is replaced by another task's (default: %(default)s)",
    )
    parser.add_argument(
        "--ambiguity",
        choices=AMBIGUITIES,
        default=plan.ambiguity,
        help="ambiguity scheme of the scenes: container (the paper's scheme i) or object (scheme ii) "
        "(default: %(default)s)",
    )
    parser.add_argument(
        "--image-size",
        type=int,
        metavar="PX",
        help="height and width of the environment's images (default: those of the training)",
    )
    parser.add_argument(
        "--episode-length",
        type=int,
        metavar="STEPS",
        help="number of steps of an episode (default: that of the training's environment, or "
        f"{plan.episode_length} if it had none)",
    )
    parser.add_argument(
        "--objects",
        metavar="SET",
        help="objects that scenes are made of: all; scenario_a_train, without test objects; or random:N "
        "(default: scenario_a_train for scenario_a_clean_train, all otherwise)",
    )
    parser.add_argument(
        "--adversarial-probability",
        type=float,
        default=plan.adversarial_probability,
        metavar="P",
        help="probability that a distractor is drawn from the objects that share the target's color or "
        "shape; 0 for uniform distractors, as in the authors' evaluation during training (default: "
        "%(default)s)",
    )
    parser.add_argument(
        "--adversarial-draw",
        choices=ADVERSARIAL_DRAWS,
        default=plan.adversarial_draw,
        help="scope of a draw with that probability: each, one distractor; or scene, both distractors of a "
        "scene, as in the authors' code (default: %(default)s)",
    )
    parser.add_argument(
        "--instructions",
        metavar="FILE",
        help="CSV file with sentences for the tasks, such as the one that deltaco-instructions downloads; "
        "needs --out (default: the benchmark's templates)",
    )
    parser.add_argument(
        "--instructions-split",
        choices=INSTRUCTION_SPLITS,
        default=plan.instructions_split,
        help="split of these sentences: held_out, the last one of each task; train, those not held out for "
        "any task; or all (default: %(default)s)",
    )
    parser.add_argument(
        "--instruction",
        metavar="SENTENCE",
        help="sentence of your own, in any words, as the instruction of every task; needs --out",
    )
    parser.add_argument(
        "--steps",
        type=_steps,
        default="all",
        metavar="all|last|STEP,...",
        help="checkpoints to evaluate (default: %(default)s)",
    )
    parser.add_argument(
        "--experiment",
        metavar="NAME",
        help="name of the experiment; runs with the same name differ only in their seeds (default: the run's "
        "--job_name)",
    )
    parser.add_argument(
        "--policy.demo_repo_id",
        dest="demo_repo_id",
        metavar="USER/NAME",
        help="dataset of demonstrations (default: the demonstrations in the checkpoint)",
    )
    parser.add_argument(
        "--policy.demo_root",
        dest="demo_root",
        metavar="DIR",
        help="folder of that dataset, if it is not in LeRobot's cache",
    )
    parser.add_argument(
        "--leave-out",
        choices=("demo", "instruction"),
        help="evaluate without the demonstration, or without the instruction, a policy that was trained with "
        "--policy.demo_dropout or --policy.instruction_dropout; needs --out",
    )
    parser.add_argument(
        "--n-demonstrations",
        type=int,
        metavar="N",
        help="number of demonstrations of each task that are combined, with demo_encoder=correspondence; "
        "needs --out (default: the checkpoint's, which is 1 unless it was trained otherwise)",
    )
    parser.add_argument(
        "--rename_map",
        "--rename-map",
        dest="rename_map",
        type=_rename_map,
        metavar="JSON",
        help="names under which the policy knows the environment's observations, as in lerobot-eval "
        "(default: those of its training)",
    )
    parser.add_argument(
        "--processes",
        type=int,
        metavar="N",
        help="number of processes that share the episodes; the record is the same with any number (default: "
        "one for each core, or OMP_NUM_THREADS; one for a policy on a GPU)",
    )
    parser.add_argument(
        "--explain",
        type=int,
        default=0,
        metavar="N",
        help="number of episodes for which to draw where the policy looks in the demonstration and in the "
        "scene, as PNG files beside the record",
    )
    parser.add_argument(
        "--videos",
        type=int,
        default=0,
        metavar="N",
        help="number of episodes of each outcome (success, wrong object, nothing grasped, wrong container, "
        "dropped) of which to make videos beside the record, with a page that shows them",
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="folder in which to put the folder `evaluations`, for a second evaluation of the same steps of "
        "a single RUN_DIR (default: RUN_DIR)",
    )
    parser.add_argument("--device", help="device, such as cpu or cuda (default: the checkpoint's)")
    return parser


if __name__ == "__main__":
    main()
