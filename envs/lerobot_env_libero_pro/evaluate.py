"""Evaluates a policy of any LeRobot type on a suite, under conditions that tell what it follows.

    python -m lerobot_env_libero_pro.evaluate outputs/train/libero_b --suite libero_object_swap \
        --out records/object_swap.jsonl

Run it again to go on after an interruption, or to print the table once more.
"""

from __future__ import annotations

import itertools
import json
import shlex
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import tyro
from tqdm import tqdm

from lerobot_env_libero_pro.env import LiberoProEnv
from lerobot_env_libero_pro.expert import grasp_and_release, pick_and_place
from lerobot_env_libero_pro.installation import versions
from lerobot_env_libero_pro.scene import NO_ACTION
from lerobot_env_libero_pro.suites import Task, base_suite, category, load_tasks

Condition = Literal["full", "no_demonstration", "no_sentence", "wrong_demonstration", "oracle", "script"]
LURE_RADIUS = 0.05  # m around a place within which the gripper closes there
CLOSED_ACTIONS = 3  # in a row that close the gripper, so that one of them alone does not count


def main(
    checkpoint: tyro.conf.Positional[Path | None] = None,
    *,
    out: Path,
    suite: str = "libero_object",
    conditions: tuple[Condition, ...] = ("full",),
    task_ids: tuple[int, ...] | None = None,
    n_states: int = 50,
    layouts: Literal["standard", "permuted"] = "standard",
    to_the_end: bool = False,
    image_size: int | None = None,
    demo_root: Path | None = None,
    device: str | None = None,
) -> None:
    """Runs the episodes that are not recorded yet, and prints a table.

    Args:
        checkpoint: Output folder of a training run, whose last checkpoint is taken, or folder of a policy.
            Not needed for `script`.
        out: File of the record, JSON lines, which is continued if it exists: first what was evaluated, then
            the episodes.
        suite: Name of the suite.
        conditions: What the policy is given. `full`: all that it takes. `no_demonstration`, `no_sentence`:
            the other of the two alone. `wrong_demonstration`: the sentence, and a demonstration with another
            object of the scene. `oracle`: the true places, in place of what it would find. `script`: the
            expert acts. All but `full` and `script` are for policies with `set_tasks` and
            `set_pick_and_place`, such as deltaco_match.
        task_ids: Numbers of the suite's tasks; all by default.
        n_states: Number of initial states of each task, the first of the suite's 50.
        layouts: `standard`: the initial states. `permuted`: the same objects at random places.
        to_the_end: Whether episodes go on after a success until the horizon, to tell success at the end.
        image_size: Width and height of the images, pixels; by default, that of the training.
        demo_root: Folder of a dataset of demonstrations, in place of the checkpoint's own. Needed where it
            has none, as after a training without `demo_repo_id`.
        device: Device of the policy, such as cpu.

    Raises:
        ValueError: The record is of something else, or the policy or a task does not fit a condition.
    """
    tasks = load_tasks(suite, None if task_ids is None else list(task_ids))
    policy = None if checkpoint is None else LoadedPolicy.load(checkpoint, demo_root, device)
    size = image_size or (256 if policy is None else policy.image_size)
    header = {
        "suite": suite,
        "layouts": layouts,
        "to_the_end": to_the_end,
        "image_size": size,
        "policy": None if policy is None else policy.identity,
        "demonstrations": None if demo_root is None else str(demo_root),
        "versions": versions(),
    }
    rows = read_record(out, header)
    done = {(row["condition"], row["task_id"], row["state"]) for row in rows}
    planned = list(itertools.product(tasks, conditions, range(n_states)))
    missing = [
        (task, condition, state)
        for task, condition, state in planned
        if (condition, task.id, state) not in done
    ]
    actors = {condition: _make_actor(condition, policy) for condition in conditions}
    with tqdm(total=len(planned), initial=len(planned) - len(missing), unit="episode") as bar:
        for task, group in itertools.groupby(missing, key=lambda each: each[0]):
            env = LiberoProEnv(task, size, layouts, stop_at_success=not to_the_end)
            for _, condition, state in group:
                bar.set_description(f"{task.sentence}, {condition}")
                row = run_episode(env, actors[condition], state)
                rows.append({"condition": condition, "task_id": task.id, "state": state, **row})
                with out.open("a") as file:
                    file.write(json.dumps(rows[-1]) + "\n")
                bar.update()
            env.close()
    sys.stdout.write(table(rows) + "\n")


# Episodes


def run_episode(env: LiberoProEnv, actor: Script | PolicyActor, state: int) -> dict[str, Any]:
    """Runs an episode.

    Args:
        env: The environment of a task.
        actor: What acts.
        state: Number of the initial state.

    Returns:
        `success` at any step, and `success_at_end`; `n_steps`; the object that was `lifted` first, and the
        `target`; where the target stood, `target_at`, and where the hand was when the gripper closed,
        `closed_at`, m; whether it was `lured`: it closed where the target stands in the suite without
        perturbation (None if it stands there now); `seconds`; and what the actor has to say.
    """
    start = time.monotonic()
    env.draws = True
    observation, info = env.reset(seed=state)
    target_at = info["target_position"]
    notes = actor.start(env, state)
    closed_at, closing, is_success, is_over, n_steps = None, 0, False, False, 0
    while not is_over:
        action = actor.act(observation)
        closing = closing + 1 if action[-1] > 0 else 0
        if closed_at is None and closing == CLOSED_ACTIONS:
            closed_at = env.scene.hand_position()
        observation, _, terminated, truncated, info = env.step(action)
        is_success = is_success or info["is_success"]
        is_over, n_steps = terminated or truncated, n_steps + 1
    return {
        "sentence": env.task_description,
        "success": is_success,
        "success_at_end": info["is_success"],
        "n_steps": n_steps,
        "target": info["target"],
        "lifted": info["lifted"],
        "target_at": _rounded(target_at),
        "closed_at": _rounded(closed_at),
        "lured": is_lured(closed_at, target_at, training_places(env)),
        "seconds": round(time.monotonic() - start, 2),
        **notes,
    }


def is_lured(closed_at: np.ndarray | None, target_at: np.ndarray, places: np.ndarray | None) -> bool | None:
    """Tells whether the gripper closed where the target stood in training, and not where it stands.

    Args:
        closed_at: Position of the hand when the gripper closed, (3,), m; None if it did not.
        target_at: Where the target stands, (3,), m.
        places: Where it stood in training, (n, 3), m; None if that is not known.

    Returns:
        None if the target's places cannot be told apart.
    """
    if places is None or _distance(places, target_at) < 2 * LURE_RADIUS:
        return None
    return closed_at is not None and _distance(places, closed_at) < LURE_RADIUS


def training_places(env: LiberoProEnv) -> np.ndarray | None:
    """Returns where the target of the task stands in the suite without perturbation, (50, 3), m.

    None if that is not an object that moves, or if the scenes differ in more than places.
    """
    task, scene = env.scene.task, env.scene
    (base,) = load_tasks(base_suite(task.suite), [task.id])
    if base.target not in base.objects:
        return None
    states = base.initial_states()
    name = task.objects[base.objects.index(base.target)]
    return scene.positions_in(states, name) if states.shape[1] == scene.state_size else None


def _distance(places: np.ndarray, point: np.ndarray) -> float:
    return float(np.linalg.norm(places[:, :2] - point[:2], axis=1).min())


def _rounded(values: np.ndarray | None) -> list[float] | None:
    return None if values is None or np.isnan(values).any() else np.round(values, 4).tolist()


# What acts


class Script:
    """The expert, without noise."""

    def start(self, env: LiberoProEnv, state: int) -> dict[str, Any]:
        """Plans the episode. See `PolicyActor.start`."""
        task = env.scene.task
        if task.place is None or task.target not in task.objects:
            raise ValueError(
                f"The expert picks and places, but task {task.id} of {task.suite} is {task.sentence!r}. "
                "Leave the task out (`--task-ids`)."
            )
        actions = pick_and_place(env.scene, task.target, task.place)
        self._actions: Iterator[np.ndarray] = itertools.chain(actions, itertools.repeat(NO_ACTION))
        env.draws = False
        return {}

    def act(self, observation: dict[str, Any]) -> np.ndarray:
        """Returns the next action. See `PolicyActor.act`."""
        return next(self._actions)


class LoadedPolicy(NamedTuple):
    """A policy, its processors, and what tells it from others."""

    policy: Any
    preprocessor: Any
    postprocessor: Any
    identity: dict[str, Any]

    @property
    def image_size(self) -> int:
        """Width of the images that it was trained on, pixels."""
        return int(next(iter(self.policy.config.image_features.values())).shape[-1])

    @classmethod
    def load(cls, path: Path, demo_root: Path | None, device: str | None) -> LoadedPolicy:
        """Loads a policy. For the arguments, see `main`.

        Raises:
            ValueError: There is none.
        """
        import hashlib

        import torch
        from lerobot.configs import PreTrainedConfig
        from lerobot.policies import get_policy_class, make_pre_post_processors
        from lerobot.utils.import_utils import register_third_party_plugins

        torch.set_num_threads(1)
        register_third_party_plugins()
        last = path / "checkpoints" / "last" / "pretrained_model"
        folder = last if last.is_dir() else path
        weights = folder / "model.safetensors"
        if not weights.is_file():
            raise ValueError(f"{path} is neither the output folder of a training run nor that of a policy.")
        options = [] if device is None else [f"--device={device}"]
        if demo_root is not None:
            options += ["--demo_repo_id=local/demonstrations", f"--demo_root={demo_root}"]
        config = PreTrainedConfig.from_pretrained(folder, cli_overrides=options)
        if getattr(config, "pretrained_backbone_weights", None) is not None:
            # The checkpoint's weights replace them, so they need not be downloaded.
            config.pretrained_backbone_weights = None
        policy = get_policy_class(config.type).from_pretrained(folder, config=config)
        policy.to(config.device).eval()
        device_step = {"device_processor": {"device": str(config.device)}}
        processors = make_pre_post_processors(
            config, pretrained_path=str(folder), preprocessor_overrides=device_step
        )
        digest = hashlib.sha256(weights.read_bytes()).hexdigest()
        return cls(policy, *processors, {"type": config.type, "weights": digest})


class PolicyActor:
    """A policy under a condition.

    Args:
        loaded: The policy.
        condition: What it is given, as in `main`, but `script`.

    Raises:
        ValueError: The policy cannot be given that.
    """

    def __init__(self, loaded: LoadedPolicy, condition: Condition) -> None:
        needed = {"full": "reset", "oracle": "set_pick_and_place"}.get(condition, "set_tasks")
        if not hasattr(loaded.policy, needed):
            raise ValueError(
                f"{condition!r} is for policies with a method `{needed}`, such as deltaco_match. Evaluate "
                f"{loaded.identity['type']} with `--conditions full`."
            )
        takes = needed != "reset" or getattr(loaded.policy.config, "uses_demonstrations", False)
        if takes and condition != "no_demonstration" and loaded.policy.demonstrations is None:
            raise ValueError(
                f"{condition!r} needs demonstrations, and the checkpoint has none. Name a dataset of them "
                "with --demo-root, or use `--conditions no_demonstration`."
            )
        self._loaded, self._condition = loaded, condition
        self._sentence, self._env = "", None

    def start(self, env: LiberoProEnv, state: int) -> dict[str, Any]:
        """Gives the policy its task.

        Args:
            env: The environment, after its reset.
            state: Number of the initial state, by which demonstrations take turns.

        Returns:
            What to record of it; more may be added until the episode's end.
        """
        policy, condition = self._loaded.policy, self._condition
        self._env, task = env, env.scene.task
        self._notes: dict[str, Any] = {}
        self._is_first = True
        self._sentence = "" if condition == "no_sentence" else task.sentence
        policy.reset()
        if not hasattr(policy, "set_tasks"):
            return self._notes
        demonstrations = []
        if condition != "no_demonstration" and getattr(policy.config, "uses_demonstrations", True):
            sentences = demonstrating_sentences(
                task, list(policy.demonstrations.rows), condition == "wrong_demonstration", state
            )
            known = [each for sentence in sentences for each in policy.demonstrations.of_task(sentence)]
            demonstrations = [known[state % len(known)]]
            self._notes["demonstration"] = demonstrations[0].task
            self._notes["demonstration_episode"] = demonstrations[0].episode
        policy.set_tasks([self._sentence], [demonstrations])
        if condition == "oracle":
            import torch

            states = grasp_and_release(env.scene, task.target, task.place or "")
            policy.set_pick_and_place(torch.from_numpy(states)[None].to(policy.config.device))
        return self._notes

    def act(self, observation: dict[str, Any]) -> np.ndarray:
        """Returns the next action, (7,).

        Args:
            observation: Observation of the environment.
        """
        import torch
        from lerobot.envs.utils import preprocess_observation

        policy, before, after, _ = self._loaded
        batch = {**preprocess_observation(observation), "task": [self._sentence]}
        with torch.inference_mode():
            action = after(policy.select_action(before(batch)))[0].cpu().numpy()
        assert self._env is not None
        if self._is_first:
            self._is_first = False
            self._notes |= localization(policy, self._env)
        self._env.draws = getattr(policy, "needs_images", True)
        return np.clip(action, -1, 1)


def demonstrating_sentences(task: Task, known: Sequence[str], is_wrong: bool, state: int) -> list[str]:
    """Returns the tasks of a dataset whose episodes demonstrate a task, or another one.

    Those are the task itself; where the dataset does not have it, tasks with the same object and place, or
    else with the same object, as in a pairing that is new.

    Args:
        task: The task.
        known: Sentences of the dataset.
        is_wrong: Whether another object of the scene is to be demonstrated instead, or else another task.
        state: Number of the initial state, by which wrong demonstrations take turns.

    Raises:
        ValueError: There are none.
    """
    base = base_suite(task.suite)
    suites = (base, *(f"{base}_{name}" for name in ("task", "lan")))
    meanings = {
        each.sentence: (category(each.target), each.place) for suite in suites for each in load_tasks(suite)
    }
    target = category(task.target)
    if is_wrong:
        present = {category(name) for name in task.objects} - {target}
        others = [sentence for sentence in known if meanings.get(sentence, ("",))[0] in present]
        others = others or [sentence for sentence in known if sentence != task.sentence]
        found = others[state % len(others) :][:1] if others else []
    else:
        found = (
            [sentence for sentence in known if sentence == task.sentence]
            or [sentence for sentence in known if meanings.get(sentence) == (target, task.place)]
            or [sentence for sentence in known if meanings.get(sentence, ("",))[0] == target]
        )
    if not found:
        raise ValueError(
            f"No demonstration for {task.sentence!r}. There are some of {', '.join(map(repr, known))}. Name "
            "a dataset of others with --demo-root, or leave the task out (`--task-ids`)."
        )
    return found


def localization(policy: Any, env: LiberoProEnv) -> dict[str, Any]:
    """Returns where a policy has found the target, if it says so.

    Returns:
        `localized`, the object nearest to the pick; `pick_error` and `place_error`, horizontal distances of
        the hand from where the expert's would grasp and release, m; and `confidence` of the pick, 0..1.
    """
    states = getattr(policy, "localized_states", None)
    if states is None:
        return {}
    scene, task = env.scene, env.scene.task
    hands = states[0, :, :3].cpu().double().numpy()
    distances = {name: np.linalg.norm(scene.position(name)[:2] - hands[0, :2]) for name in scene.task.objects}
    found = {"localized": min(distances, key=lambda name: distances[name])}
    if task.place is not None and task.target in task.objects:
        expected = grasp_and_release(scene, task.target, task.place)[:, :3]
        errors = np.linalg.norm((hands - expected)[:, :2], axis=1).round(4).tolist()
        found |= dict(zip(("pick_error", "place_error"), errors, strict=True))
    confidence = getattr(policy, "pick_confidence", None)
    return found if confidence is None else found | {"confidence": round(float(confidence[0]), 4)}


def _make_actor(condition: Condition, policy: LoadedPolicy | None) -> Script | PolicyActor:
    if condition == "script":
        return Script()
    if policy is None:
        raise ValueError(
            f"{condition!r} evaluates a policy. Name its checkpoint, or use `--conditions script`."
        )
    return PolicyActor(policy, condition)


# Records


def read_record(path: Path, header: dict[str, Any]) -> list[dict[str, Any]]:
    """Reads the episodes of a record, or begins one.

    Args:
        path: The file.
        header: What is evaluated.

    Raises:
        ValueError: The file is the record of something else.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    whole = path.read_text().rpartition("\n")[0] if path.is_file() else ""
    lines = [json.loads(line) for line in whole.splitlines()]
    if not lines:
        lines = [{**header, "command": shlex.join(sys.argv)}]
        whole = json.dumps(lines[0])
    path.write_text(whole + "\n")  # without a line that an interruption cut off
    for name, value in header.items():
        if lines[0].get(name) != value:
            raise ValueError(
                f"{path} is a record of something else: its {name} is {lines[0].get(name)}, and not {value}. "
                "Name another file with --out."
            )
    return lines[1:]


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Returns a table of the conditions, in Markdown: rates in percent, with 95 % intervals by Wilson."""
    names = ("condition", "episodes", "success", "at the end", "found", "lifted", "lured", "s an episode")
    lines = [f"| {' | '.join(names)} |", "|---" * len(names) + "|"]
    for condition in dict.fromkeys(row["condition"] for row in rows):
        chosen = [row for row in rows if row["condition"] == condition]
        rates = (
            [row["success"] for row in chosen],
            [row["success_at_end"] for row in chosen],
            [row["localized"] == row["target"] for row in chosen if "localized" in row],
            [row["lifted"] == row["target"] for row in chosen],
            [row["lured"] for row in chosen if row["lured"] is not None],
        )
        seconds = np.mean([row["seconds"] for row in chosen])
        cells = [condition, str(len(chosen)), *map(_rate, rates), f"{seconds:.1f}"]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _rate(outcomes: Sequence[bool]) -> str:
    from scipy.stats import binomtest

    if not outcomes:
        return "-"
    interval = binomtest(sum(outcomes), len(outcomes)).proportion_ci(method="wilson")
    return f"{100 * np.mean(outcomes):.0f} ({100 * interval.low:.0f} to {100 * interval.high:.0f})"


if __name__ == "__main__":
    tyro.cli(main)
