"""The report on instructions in other words: success by tasks and by the wording of their instructions."""

from __future__ import annotations

import io
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from lerobot_deltaco.evaluation.record import TEMPLATES, read_record
from lerobot_deltaco.reporting.curves import DOTS_PER_INCH
from lerobot_deltaco.reporting.paper_results import CHANCE, in_order, label_of
from lerobot_deltaco.reporting.report_files import csv_bytes, markdown_table, write_files
from lerobot_deltaco.reporting.series import (
    ReportError,
    Series,
    check_same_scenes,
    find_records,
    make_report,
)
from lerobot_deltaco.reporting.task_bootstrap import Estimate, estimate_text, mean_rate, paired_difference

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WORDINGS_REPORT = "wordings.md"
WORDINGS_IMAGE = "wordings.png"
WORDINGS_TABLE = "wordings.csv"
WORDINGS_FILES = (WORDINGS_TABLE, WORDINGS_IMAGE, WORDINGS_REPORT)
WIDTH, ROW_HEIGHT, FRAME_HEIGHT = 8.0, 0.45, 0.8  # inches
_COLORS = ("#2b3a55", "#e69f00", "#009e73", "#cc79a7", "#56b4e9")
_SPREAD = 0.4  # of the marks of one row, in rows


class WordingResult(NamedTuple):
    """The success of an experiment on tasks whose instructions have one wording.

    Attributes:
        experiment: Name of the experiment.
        tasks: Name of the task set.
        wording: Source of the instructions, as in the records.
        seeds: Seeds of training.
        step: Training step of the checkpoints.
        episodes: Number of episodes.
        rate: Success rate, 0..1.
        difference: Difference to the success rate with templates, paired by task, -1..1; None if that was not
            measured, or if this is it.
        share: Share of the success rate with templates; None if that was not measured, or is zero.
    """

    experiment: str
    tasks: str
    wording: str
    seeds: tuple[int, ...]
    step: int
    episodes: int
    rate: Estimate
    difference: Estimate | None
    share: float | None


def write_wordings_report(folders: Sequence[Path], out: Path) -> list[WordingResult]:
    """Reports how success depends on the wording of the instructions, as Markdown, CSV and an image.

    All files are written, or none. Counterfactual evaluations are left out.

    Args:
        folders: Folders of runs, or folders that contain them at any depth. Their evaluations may differ in
            the task set and in the wording, and in nothing else that concerns the scenes.
        out: Folder of the report; it is created.

    Returns:
        The results, by experiment, task set and wording.

    Raises:
        ReportError: A folder has no records, or they do not belong together.
        RecordError: A record is damaged.
        OSError: Something cannot be read or written.
    """
    results = wording_results(find_records(folders))
    contents = {
        WORDINGS_TABLE: csv_bytes([_columns(result) for result in results]),
        WORDINGS_IMAGE: draw_wordings(results),
        WORDINGS_REPORT: _markdown(results).encode(),
    }
    write_files(out, contents, WORDINGS_FILES)
    return results


def wording_results(paths: Sequence[Path]) -> list[WordingResult]:
    """The success rates in some records, by experiment, task set and wording.

    Raises:
        ReportError: The records do not belong together.
        RecordError: One is damaged.
    """
    groups = defaultdict(list)
    for path in paths:
        record = read_record(path)
        groups[record.tasks, record.wording].append(path)
    measured = {
        (series.experiment, *key): series
        for key, group in groups.items()
        for series in make_report(group).regular
    }
    check_same_scenes("records", list(measured.values()))
    for (experiment, tasks, wording), series in measured.items():
        template = measured.get((experiment, tasks, TEMPLATES), series)
        if series.last_scene_sets != template.last_scene_sets:
            raise ReportError(
                f"The records of {experiment!r} on {tasks!r}, with templates and with "
                f"{wording_label(wording)}, are of different sets of scenes, but wordings are compared scene "
                "by scene. Evaluate one of them again with `deltaco-evaluate --scene-set`."
            )
    results = [
        _result(series, tasks, wording, measured.get((experiment, tasks, TEMPLATES)))
        for (experiment, tasks, wording), series in measured.items()
    ]
    results.sort(key=lambda item: (in_order(item.experiment), item.tasks, _wording_order(item.wording)))
    return results


def wording_label(wording: str) -> str:
    """A wording without the SHA-256 of its file, for example "human_instructions.csv (held_out)"."""
    return wording.partition(", SHA-256 ")[0]


def draw_wordings(results: Sequence[WordingResult]) -> bytes:
    """Draws the success rates, one panel for each task set, with a color for each wording.

    Args:
        results: At least one.

    Returns:
        A PNG.
    """
    # Only here, so that the command line answers quickly; and without pyplot, which would look for a screen.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    panels = defaultdict(list)
    for result in results:
        panels[result.tasks].append(result)
    wordings = sorted({result.wording for result in results}, key=_wording_order)
    colors = {wording: _COLORS[n % len(_COLORS)] for n, wording in enumerate(wordings)}
    heights = [
        FRAME_HEIGHT + ROW_HEIGHT * len({result.experiment for result in group}) for group in panels.values()
    ]
    figure = Figure(figsize=(WIDTH, sum(heights)), dpi=DOTS_PER_INCH, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots(
        len(panels), 1, squeeze=False, sharex=True, gridspec_kw={"height_ratios": heights}
    )[:, 0]
    for ax, (tasks, group) in zip(axes, panels.items(), strict=True):
        _draw_panel(ax, group, colors)
        ax.set_title(tasks, loc="left", fontsize=11)
    handles = {
        label: handle for ax in axes for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)
    }
    figure.legend(handles.values(), handles.keys(), loc="outside upper right", ncols=2, fontsize=8)
    axes[-1].set_xlabel("success rate")
    image = io.BytesIO()
    canvas.print_png(image)
    return image.getvalue()


def _draw_panel(ax: Axes, results: Sequence[WordingResult], colors: dict[str, str]) -> None:
    experiments = list(dict.fromkeys(result.experiment for result in results))
    ax.axvline(CHANCE, color="0.6", linewidth=1, linestyle=(0, (1, 3)), label="random choice")
    for n, (wording, color) in enumerate(colors.items()):
        group = [result for result in results if result.wording == wording]
        offset = _SPREAD * (n - (len(colors) - 1) / 2) / max(1, len(colors) - 1)
        rates = [result.rate for result in group]
        ax.errorbar(
            [rate.value for rate in rates],
            [experiments.index(result.experiment) + offset for result in group],
            xerr=[[rate.value - rate.low for rate in rates], [rate.high - rate.value for rate in rates]],
            fmt="o",
            color=color,
            markersize=5,
            label=wording_label(wording).replace("$", r"\$"),  # which would begin a formula
        )
    ax.set_yticks(range(len(experiments)), [label_of(name) for name in experiments], fontsize=9)
    ax.set_ylim(len(experiments) - 0.5, -0.5)
    ax.set_xlim(0, 1)
    ax.xaxis.set_major_formatter(lambda rate, _: f"{100 * rate:g} %")
    ax.grid(axis="x", color="0.92")
    ax.set_axisbelow(True)
    ax.spines[["top", "right"]].set_visible(False)


def _result(series: Series, tasks: str, wording: str, templates: Series | None) -> WordingResult:
    rate = mean_rate(series.last_task_rates)
    difference = share = None
    if templates is not None and wording != TEMPLATES:
        difference = paired_difference(series.last_task_rates, templates.last_task_rates)
        reference = mean_rate(templates.last_task_rates).value
        share = rate.value / reference if reference else None
    return WordingResult(
        series.experiment,
        tasks,
        wording,
        series.seeds,
        series.steps[-1],
        series.last.total,
        rate,
        difference,
        share,
    )


def _wording_order(wording: str) -> tuple[bool, str]:
    """Templates come first."""
    return wording != TEMPLATES, wording


def _columns(result: WordingResult) -> dict[str, Any]:
    difference = result.difference
    return {
        "experiment": result.experiment,
        "tasks": result.tasks,
        "wording": result.wording,
        "seeds": " ".join(map(str, result.seeds)),
        "step": result.step,
        "episodes": result.episodes,
        "rate": result.rate.value,
        "bootstrap_low": result.rate.low,
        "bootstrap_high": result.rate.high,
        "less_templates": difference and difference.value,
        "less_templates_low": difference and difference.low,
        "less_templates_high": difference and difference.high,
        "share_of_templates": result.share,
    }


def _markdown(results: Sequence[WordingResult]) -> str:
    wordings = sorted({result.wording for result in results}, key=_wording_order)
    rows: dict[tuple[str, str], dict[str, str]] = defaultdict(dict)
    for result in results:
        rows[result.experiment, result.tasks][result.wording] = _cell(result)
    table = markdown_table(
        ["policy", "tasks", *(wording_label(wording).replace("|", r"\|") for wording in wordings)],
        [
            [label_of(experiment), f"`{tasks}`", *(cells.get(wording, "–") for wording in wordings)]
            for (experiment, tasks), cells in rows.items()
        ],
    )
    return (
        "# Instructions in other words\n\n"
        "Success rates at the last step, in %, with 95 % intervals by bootstrap over tasks; in parentheses, "
        "the share of the same policy's rate with the benchmark's templates.\n\n"
        f"{table}\n![Success rates by wording]({WORDINGS_IMAGE})\n"
    )


def _cell(result: WordingResult) -> str:
    text = estimate_text(result.rate)
    return text if result.share is None else f"{text} ({100 * result.share:.0f} %)"
