"""Draws results/small_objects/objects.png: success on novel tasks against the number of training objects."""

from __future__ import annotations

import sys
from collections import defaultdict
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from gym_deltaco.atomic_files import atomic_write
from gym_deltaco.tasks import get_task
from lerobot_deltaco.evaluation.record import EpisodeResult, RecordError
from lerobot_deltaco.reporting.series import ReportError, find_records, make_report
from lerobot_deltaco.reporting.statistics import KINDS
from lerobot_deltaco.reporting.task_bootstrap import Estimate, mean_rate, task_rates

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "results" / "small_objects"
RECORDS = FOLDER / "records"
IMAGE = FOLDER / "objects.png"
COLORS = {"all tasks": "#c8102e", "name": "#2b3a55", "color": "#e69f00", "shape": "#009e73"}


def curves() -> dict[str, dict[int, Estimate]]:
    """Success of all tasks and of each kind, by the number of training objects."""
    found: dict[str, dict[int, Estimate]] = defaultdict(dict)
    for series in make_report(find_records([RECORDS])).regular:
        number = series.experiment.rpartition("/objects_")[2]
        if not number.isdecimal():
            continue  # another policy, with as many objects
        n_objects = int(number)
        groups: dict[str, list[EpisodeResult]] = {"all tasks": series.last_episodes}
        for kind in KINDS:
            groups[kind] = [item for item in series.last_episodes if get_task(item.task_id).kind == kind]
        for name, episodes in groups.items():
            found[name][n_objects] = mean_rate(task_rates(episodes))
    return found


def main() -> None:
    """Writes the image."""
    try:
        found = curves()
    except (RecordError, ReportError) as error:
        sys.exit(str(error))
    if not found:
        sys.exit(f"{RECORDS} has no records of the experiments objects_N, which are drawn.")
    figure = Figure(figsize=(6.5, 4.0), dpi=140, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    ax = figure.subplots()
    for n, (name, rates) in enumerate(found.items()):
        numbers = sorted(rates)
        values = [rates[number].value for number in numbers]
        errors = [
            [rates[number].value - rates[number].low for number in numbers],
            [rates[number].high - rates[number].value for number in numbers],
        ]
        places = [number * 1.04 ** (n - 1.5) for number in numbers]  # side by side
        width = 2.5 if name == "all tasks" else 1.2
        ax.errorbar(
            places, values, yerr=errors, fmt="o-", color=COLORS[name], label=name, linewidth=width, capsize=3
        )
    ax.set_xscale("log")
    ax.set_xticks(numbers, [str(number) for number in numbers])
    ax.minorticks_off()
    ax.set_xlabel("objects in the training scenes")
    ax.set_ylabel("success on novel tasks")
    ax.set_ylim(0, 1)
    ax.yaxis.set_major_formatter(lambda rate, _: f"{100 * rate:g} %")
    ax.grid(axis="y", color="0.9")
    ax.spines[["top", "right"]].set_visible(False)
    ax.legend(loc="lower right", fontsize=9)
    with atomic_write(IMAGE) as path, path.open("wb") as file:
        canvas.print_png(file)
    sys.stdout.write(f"{IMAGE.relative_to(ROOT)} shows {', '.join(map(str, numbers))} objects.\n")


if __name__ == "__main__":
    main()
