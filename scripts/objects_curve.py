"""Draws results/small_objects/objects.png: success on novel tasks against the number of training objects."""

from __future__ import annotations

from pathlib import Path

from matplotlib.figure import Figure

from gym_deltaco.tasks import get_task
from lerobot_deltaco.records import read_records
from lerobot_deltaco.report_tables import make_series
from lerobot_deltaco.statistics import success_interval

FOLDER = Path(__file__).parents[1] / "results" / "small_objects"
COLORS = {"all tasks": "#c8102e", "name": "#2b3a55", "color": "#e69f00", "shape": "#009e73"}
NUMBERS = (24, 100, 400)


def main() -> None:
    """Writes the image."""
    found = {series.experiment: series for series in make_series(read_records(FOLDER / "records.parquet"))}
    figure = Figure(figsize=(6.5, 4.0), dpi=140, layout="constrained")
    ax = figure.subplots()
    for n, (name, color) in enumerate(COLORS.items()):
        rates = []
        for number in NUMBERS:
            episodes = found[f"small_objects/objects_{number}"].episodes
            kinds = episodes["task_id"].map(lambda task_id: get_task(task_id).kind)
            rates.append(success_interval(episodes[(kinds == name) | (name == "all tasks")]))
        ax.errorbar(
            [number * 1.04 ** (n - 1.5) for number in NUMBERS],  # side by side
            [rate.value for rate in rates],
            yerr=[[rate.value - rate.low for rate in rates], [rate.high - rate.value for rate in rates]],
            fmt="o-",
            color=color,
            label=name,
            linewidth=2.5 if name == "all tasks" else 1.2,
            capsize=3,
        )
    ax.set_xscale("log")
    ax.set_xticks(NUMBERS, [str(number) for number in NUMBERS])
    ax.minorticks_off()
    ax.set_xlabel("objects in the training scenes")
    ax.set_ylabel("success on novel tasks")
    ax.set_ylim(0, 1)
    ax.yaxis.set_major_formatter(lambda rate, _: f"{100 * rate:g} %")
    ax.grid(axis="y", color="0.9")
    ax.spines[["top", "right"]].set_visible(False)
    ax.legend(loc="lower right", fontsize=9)
    figure.savefig(FOLDER / "objects.png")


if __name__ == "__main__":
    main()
