"""Reports: one Markdown page, CSV tables and figures, from records of evaluations."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import cycle, product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from gym_deltaco.atomic_files import write_text
from lerobot_deltaco import report_tables
from lerobot_deltaco.paper_results import CHANCE, LEVELS, paper_result, title_of
from lerobot_deltaco.records import read_records
from lerobot_deltaco.report_tables import Series, make_series, name_of
from lerobot_deltaco.statistics import N_BEST_SETS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PAGE, SUCCESS_FIGURE, CURVES_FIGURE = "report.md", "success.png", "curves.png"
# Options of a policy that may differ between the training runs of an experiment.
_OPTIONS_OF_A_RUN = {"seed", "device", "pretrained_path", "demo_root", "repo_id", "push_to_hub"}

# Function, title and explanation of each table, by the name of its CSV file.
TABLES: dict[str, tuple[Callable[[Sequence[Series]], pd.DataFrame], str, str]] = {
    "success": (
        report_tables.success_table,
        "Success",
        "Success at the last step, of all training seeds and of each, with a 95 % interval by bootstrap "
        "over tasks. It covers the choice of tasks; other training seeds may differ by more. For rates "
        "near 0, it is too narrow: see Wilson's. A policy that picks at random succeeds in "
        f"{100 * CHANCE:.1f} %.",
    ),
    "kinds": (
        report_tables.kinds_table,
        "Kinds of task",
        "Success by how the task describes its object (name, color, shape) and its container (color word:"
        " green, red; position word: front, back, left, right).",
    ),
    "outcomes": (
        report_tables.outcomes_table,
        "Failures",
        "Fraction of the episodes in which something was grasped, the right object was held last, and the"
        " right container alone was filled; then of those in which something was grasped or placed.",
    ),
    "differences": (
        report_tables.differences_table,
        "Differences",
        "Differences of success, paired by task, with a 95 % interval by bootstrap over tasks.",
    ),
    "novelty": (
        report_tables.novelty_table,
        "Novelty of the target",
        "Success by what the scenario's training tasks ask for: the same task; the target, but in other "
        "words; the target by its color or shape alone (unnamed: object 29 in scenario A); or never the "
        "target. The oracle is trained on the test tasks instead.",
    ),
    "paraphrases": (
        report_tables.paraphrases_table,
        "People's words",
        "Success with people's instructions and with the benchmark's templates, in the same scenes.",
    ),
    "counterfactuals": (
        report_tables.counterfactuals_table,
        "Which input behavior follows",
        "The demonstration or the instruction is another task's. Counted are the episodes in which both "
        "ask for different objects or containers: whether the object held last, and the only container in"
        " which something lies, are the demonstration's, the instruction's or neither's.",
    ),
    "beside_paper": (
        report_tables.paper_table,
        "Beside the paper",
        f"The rate by the paper's protocol is the mean over the {N_BEST_SETS} evaluation sets (steps) with"
        " the highest mean over seeds, or over all if there are fewer; its SD is that over seeds. It "
        "chooses its sets by what it averages, which flatters. The authors' rates were measured in "
        "another simulation, with other objects: compare the order, not the values.",
    ),
    "curves": (
        report_tables.curves_table,
        "Learning curves",
        "Success of every evaluation. Lines are means over seeds, bands one standard deviation.",
    ),
}


def write_report(paths: Sequence[Path], out: Path) -> Path:
    """Writes tables and figures from records of evaluations.

    Args:
        paths: Files of records, or folders that contain some.
        out: Folder of the report. Files of an earlier report that this one lacks are removed.

    Returns:
        The page, `report.md`.

    Raises:
        RecordError: A path has no valid records.
        ReportError: Two records are of the same checkpoint and settings, or the benchmark's versions differ.
    """
    everything = make_series(read_records(*paths))
    tables = {name: make(everything) for name, (make, _, _) in TABLES.items()}
    tables = {name: table for name, table in tables.items() if len(table)}
    main = [series for series in everything if not series.is_counterfactual]
    out.mkdir(parents=True, exist_ok=True)
    for name in TABLES:
        (out / f"{name}.csv").unlink(missing_ok=True)
    for name, table in tables.items():
        text = table.round(6).map(_spreadsheet_text).to_csv(index=False, lineterminator="\n")
        write_text(out / f"{name}.csv", text)
    has_figures = {SUCCESS_FIGURE: bool(main), CURVES_FIGURE: any(len(item.steps) > 1 for item in main)}
    for name, draw in {SUCCESS_FIGURE: success_figure, CURVES_FIGURE: curves_figure}.items():
        (out / name).unlink(missing_ok=True)
        if has_figures[name]:
            draw(main).savefig(out / name)
    figures = [name for name, has in has_figures.items() if has]
    write_text(out / PAGE, _page(everything, tables, figures))
    return out / PAGE


# The page


def _page(everything: Sequence[Series], tables: Mapping[str, pd.DataFrame], figures: Sequence[str]) -> str:
    benchmark = everything[0].last[0].versions["benchmark"]
    parts = [
        f"# Evaluation report\n\nSuccess rates in {benchmark}, in %.\n",
        *(_group_text(group, everything) for group in dict.fromkeys(item.group for item in everything)),
    ]
    for name, (_, title, text) in TABLES.items():
        if name not in tables:
            continue
        parts.append(f"## {title}\n\n{text} [CSV]({name}.csv)\n")
        if name == "curves":
            parts.append(f"![Success over training steps]({CURVES_FIGURE})\n")
            continue
        if name == "success" and SUCCESS_FIGURE in figures:
            parts.append(f"![Success with intervals, beside the paper's]({SUCCESS_FIGURE})\n")
        groups = tables[name]["experiment"].str.rpartition("/")[0]
        for group in dict.fromkeys(groups):
            if groups.nunique() > 1:
                parts.append(f"**{escape(title_of(group))}**\n")
            parts.append(markdown_table(_readable(tables[name][groups == group])))
    notes = list(_notes(everything))
    if notes:
        parts.append("## Caveats\n\n" + "".join(f"- {note}\n" for note in notes))
    parts.append(_origin_text(everything))
    return "\n".join(parts)


def _group_text(group: str, everything: Sequence[Series]) -> str:
    series = min((item for item in everything if item.group == group), key=lambda item: len(item.departures))
    settings = series.settings
    n_tasks = series.last[0].episodes["task_id"].nunique()
    is_drawn_once = settings["adversarial_draw"] == "scene"
    return (
        f"**{escape(title_of(group))}**: {n_tasks} tasks (`{settings['tasks']}`), {settings['trials']} "
        f"trials of each; evaluation seed {settings['seed']}; ambiguity scheme `{settings['ambiguity']}`; "
        f"objects `{settings['objects']}`, with adversarial distractors at a probability of "
        f"{settings['adversarial_probability']:g}{', drawn once a scene' if is_drawn_once else ''}. Names of "
        "rows say what differs.\n"
    )


def _notes(everything: Sequence[Series]) -> Iterator[str]:
    for group in dict.fromkeys(item.group for item in everything):
        main = [item for item in everything if item.group == group and not item.departures]
        ends = {item.steps[-1] for item in main}
        if len(ends) > 1:
            yield f"The experiments of '{escape(title_of(group))}' end at different steps: {_listed(ends)}."
        scene_sets = {record.plan.scene_set for item in main for record in item.last}
        if len(scene_sets) > 1:
            yield (
                f"The last evaluations of '{escape(title_of(group))}' are of different sets of scenes, "
                f"{_listed(scene_sets)}: differences are paired by task, but not by scene."
            )
    for series in everything:
        policies = [record.policy for record in series.last]
        names = set().union(*policies) - _OPTIONS_OF_A_RUN
        differing = sorted(
            name
            for name in names
            # Older records lack newer options.
            if len({repr(policy[name]) for policy in policies if name in policy}) > 1
        )
        if differing:
            yield f"The trainings of {escape(series.name)} differ in `{'`, `'.join(differing)}`."
        left_out = {step for run in series.runs.values() for step in run} - set(series.steps)
        if left_out:
            yield f"{escape(series.name)}: not every seed was evaluated at the steps {_listed(left_out)}."


def _listed(values: set[Any]) -> str:
    return ", ".join(
        f"{value:,}" if isinstance(value, int) else str(value) for value in sorted(values, key=str)
    )


def _origin_text(everything: Sequence[Series]) -> str:
    records = [record for series in everything for record in series.last]
    versions = sorted({f"{name} {value}" for record in records for name, value in record.versions.items()})
    commands = [
        f"    # {' '.join(', '.join(filter(None, [series.experiment, series.variant])).split())}\n"
        + "".join(f"    {line}\n" for line in series.last[0].command.splitlines())
        for series in everything
    ]
    return (
        f"## Origin\n\nMade with {', '.join(versions)}. The commands of each first seed; the records have "
        f"those of all:\n\n{''.join(commands)}"
    )


def _readable(table: pd.DataFrame) -> pd.DataFrame:
    """Returns a table as text: one column for the name of a row, one for a rate with its interval, in %."""
    table = table.dropna(axis=1, how="all")
    cells = {"experiment": _names(table, "experiment", "variant")}
    for name in table.columns:
        base, _, suffix = name.rpartition("_")
        if name in ("experiment", "variant", "less_variant") or (base in table and suffix in _SUFFIXES):
            continue
        values = table[name]
        header = name.replace("_", " ")
        if name == "less":
            cells["compared with"] = _names(table, "less", "less_variant")
        elif name == "wilson_low":
            cells["Wilson's, % [95 %]"] = [
                f"[{low:.1f}, {high:.1f}]"
                for low, high in zip(100 * values, 100 * table["wilson_high"], strict=True)
            ]
        elif name == "wilson_high":
            continue
        elif pd.api.types.is_float_dtype(values):
            unit = ", points" if name == "difference" else ", %"
            with_interval = " [95 %]" if f"{name}_low" in table else " (SD)" if f"{name}_sd" in table else ""
            cells[f"{header}{unit}{with_interval}"] = [_cell(row, name) for _, row in table.iterrows()]
        elif pd.api.types.is_integer_dtype(values):
            cells[header.removeprefix("n ")] = [f"{value:,}" for value in values]
        else:
            cells[header] = [escape(str(value)) for value in values]
    return pd.DataFrame(cells)


_SUFFIXES = ("low", "high", "sd", "episodes")


def _names(table: pd.DataFrame, experiment: str, variant: str) -> list[str]:
    variants = table[variant] if variant in table else [""] * len(table)
    return [escape(name_of(name, text)) for name, text in zip(table[experiment], variants, strict=True)]


def _cell(row: pd.Series, name: str) -> str:
    if pd.isna(row[name]):
        return "–"
    text = f"{100 * row[name]:.1f}"
    if f"{name}_low" in row:
        text += f" [{100 * row[f'{name}_low']:.1f}, {100 * row[f'{name}_high']:.1f}]"
    if f"{name}_sd" in row and not pd.isna(row[f"{name}_sd"]):
        text += f" ({100 * row[f'{name}_sd']:.1f})"
    if f"{name}_episodes" in row:
        text += f" (of {row[f'{name}_episodes']:,.0f})"
    return text


def markdown_table(table: pd.DataFrame) -> str:
    """Returns a table of text in Markdown; its cells are Markdown, too."""
    lines = [table.columns, ["---"] * len(table.columns), *table.itertuples(index=False)]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def escape(text: str) -> str:
    """Escapes a text for Markdown, and so for HTML."""
    return re.sub(r"([\\`*_\[\]<>&|#~])", r"\\\1", " ".join(text.split()))


def _spreadsheet_text(value: Any) -> Any:
    """Returns a value of a CSV file; texts that a spreadsheet would compute begin with an apostrophe."""
    return (
        f"'{value}"
        if isinstance(value, str) and value.startswith(("=", "+", "-", "@", "\t", "\r"))
        else value
    )


# Figures

_COLORS = {
    "deltaco": "#c8102e",
    "demo_only": "#e69f00",
    "language_only": "#0072b2",
    "bc_z": "#7f7f7f",
    "mcil": "#7b4b2a",
    "one_hot": "#2b3a55",
    "oracle": "#009e73",
}
_OTHER_COLORS = ("#cc79a7", "#56b4e9", "#6a3d9a", "#a6a600", "#ff7f50", "#33691e", "#17a2b8", "#455a64")
_DOTTED = (0, (1, 3))


def success_figure(everything: Sequence[Series]) -> Figure:
    """Draws the success at the last step with its intervals, next to the paper's."""
    figure, panels = _panels(everything, frame=0.8, line=0.4)
    for ax, group in panels:
        rows = np.arange(len(group))
        ours = [series.success for series in group]
        values = np.array([item.value for item in ours])
        errors = np.array(
            [[item.value - item.low for item in ours], [item.high - item.value for item in ours]]
        )
        ax.errorbar(values, rows - 0.15, xerr=errors, fmt="o", color="#c8102e", label="ours [95 %]")
        published = [
            (n + 0.15, result.rate, result.sd)
            for n, series in enumerate(group)
            if not series.departures and (result := paper_result(series.experiment)) is not None
        ]
        if published:
            places, rates, sds = zip(*published, strict=True)
            label = "authors (SD), another simulation"
            ax.errorbar(rates, places, xerr=sds, fmt="s", color="0.45", markersize=4, label=label)
        for level in LEVELS.values():
            ax.axvline(level, color="0.8", linewidth=1, linestyle=_DOTTED)
        ax.set_yticks(rows, [_plain(series.name) for series in group], fontsize=8)
        ax.set_ylim(len(group) - 0.5, -0.5)
        ax.set_xlim(0, 1)
        ax.xaxis.set_major_formatter(lambda rate, _: f"{100 * rate:g} %")
        ax.grid(axis="x", color="0.92")
        ax.legend(loc="best", fontsize=8)
    panels[-1][0].set_xlabel("success")
    return figure


def curves_figure(everything: Sequence[Series]) -> Figure:
    """Draws the success over training steps: means over seeds, with a band of one SD."""
    everything = [series for series in everything if len(series.steps) > 1]
    figure, panels = _panels(everything, frame=2.4, line=0.205)
    for ax, group in panels:
        styles = cycle(product(("-", "--", "-.", ":"), _OTHER_COLORS))
        for series in sorted(group, key=lambda item: -item.rates[-1].mean()):
            mean, sd = series.rates.mean(axis=1), series.rates.std(axis=1)
            method = series.experiment.rpartition("/")[2]
            line, color = ("-", _COLORS[method]) if method in _COLORS else next(styles)
            ax.fill_between(series.steps, mean - sd, mean + sd, color=color, alpha=0.15, linewidth=0)
            marker = "o" if len(series.steps) <= 20 else None
            label = f"{_plain(series.name)}, {len(series.seeds)} seed{'s' * (len(series.seeds) > 1)}"
            ax.plot(series.steps, mean, line, color=color, marker=marker, markersize=3.5, label=label)
        for (name, level), shade in zip(LEVELS.items(), ("0", "0.35", "0.55"), strict=True):
            ax.axhline(
                level, color=shade, linewidth=1, linestyle=_DOTTED, label=f"{100 * level:.1f} %: {name}"
            )
        ax.legend(loc="upper left", bbox_to_anchor=(1.01, 1), frameon=False, fontsize=8)
        ax.set_xlabel("training step")
        ax.set_ylabel("success")
        ax.set_xlim(left=0)
        ax.set_ylim(bottom=0)
        ax.xaxis.set_major_formatter(lambda step, _: f"{step:,.0f}")
        ax.yaxis.set_major_formatter(lambda rate, _: f"{100 * rate:g} %")
        ax.grid(axis="y", color="0.9")
    return figure


def _panels(
    everything: Sequence[Series], frame: float, line: float
) -> tuple[Figure, list[tuple[Axes, list[Series]]]]:
    """Makes a figure with one panel for each group; `frame` and `line` are heights, inches."""
    from matplotlib.figure import Figure  # without pyplot, which would look for a screen

    groups = defaultdict(list)
    for series in everything:
        groups[series.group].append(series)
    heights = [frame + line * len(group) for group in groups.values()]
    # Names are placed beside the axes.
    width = 6.0 + 0.06 * max(len(line) for series in everything for line in _plain(series.name).split("\n"))
    figure = Figure(figsize=(width, sum(heights)), dpi=140, layout="constrained")
    axes = figure.subplots(len(groups), 1, squeeze=False, height_ratios=heights)[:, 0]
    for ax, name in zip(axes, groups, strict=True):
        ax.set_title(title_of(name), loc="left", fontsize=11, parse_math=False)
        ax.set_axisbelow(True)
        ax.spines[["top", "right"]].set_visible(False)
    return figure, list(zip(axes, groups.values(), strict=True))


def _plain(text: str) -> str:
    """Returns a name on one or two lines, without what matplotlib would read as a formula."""
    return text.replace("$", r"\$").replace(": ", ":\n", 1)
