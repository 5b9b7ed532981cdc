"""Reports: a Markdown page, CSV tables and a figure, from records of evaluations."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import tyro

from gym_deltaco.tasks import get_task, task_kinds
from lerobot_deltaco.atomic_files import write_text
from lerobot_deltaco.errors import UserError
from lerobot_deltaco.evaluation.failures import FAILURES
from lerobot_deltaco.evaluation.records import read_records, scene_columns
from lerobot_deltaco.reports.leaderboard import CHANCE, Result, collect_results, settings_text
from lerobot_deltaco.reports.metrics import (
    Estimate,
    bootstrap,
    detectable_difference,
    followed,
    paper_rate,
    success_interval,
    task_differences,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RowsOf = Callable[[Result, Sequence[Result]], Iterator[dict[str, Any]]]
_MAX_CALIBRATED = 4  # experiments in the figure
PAGE, FIGURE, CALIBRATION = "report.md", "success.png", "calibration.png"
_CONFIDENCE_BOUNDS = (0, 0.5, 0.7, 0.9, 0.97, 1)  # of the probability of what a policy picks
# Options of a policy that may differ between the training runs of an experiment.
_OPTIONS_OF_A_RUN = {"seed", "device", "pretrained_path", "demo_root", "repo_id", "push_to_hub"}


def write_report(paths: tyro.conf.Positional[Sequence[Path]], out: Path = Path("outputs/report")) -> Path:
    """Writes a page, tables and a figure from records of evaluations.

    Args:
        paths: Files of records, or folders that contain some.
        out: Folder of the report. Tables of an earlier report are replaced or removed.

    Returns:
        The page, `report.md`.

    Raises:
        UserError: A path has no valid records, or they cannot be reported on together.
    """
    if not paths:
        raise UserError(
            "Name files or folders of records, such as the output folder of an evaluated training run."
        )
    results = collect_results(read_records(*paths))
    tables = {name: make_table(results, rows_of) for name, (rows_of, _) in TABLES.items()}
    out.mkdir(parents=True, exist_ok=True)
    for name, table in tables.items():
        if table.empty:
            (out / f"{name}.csv").unlink(missing_ok=True)
        else:
            write_text(out / f"{name}.csv", csv_table(table))
    draw_success(results).savefig(out / FIGURE)
    if tables["calibration"].empty:
        (out / CALIBRATION).unlink(missing_ok=True)
    else:
        draw_calibration(tables["calibration"]).savefig(out / CALIBRATION)
    write_text(out / PAGE, "\n".join(_page(results, tables)))
    return out / PAGE


def _page(results: Sequence[Result], tables: dict[str, pd.DataFrame]) -> Iterator[str]:
    versions = [record.versions for result in results for record in result.last]
    yield f"# Evaluation report\n\nSuccess rates in {versions[0]['benchmark']}, in %, with 95 % intervals.\n"
    for group in dict.fromkeys(result.group for result in results):
        members = [result for result in results if result.group == group]
        settings = min(members, key=lambda result: len(result.departures)).settings
        name = f"**{escape(group)}**: " if group else ""
        yield f"{name}{escape(settings_text(settings))}. Variants differ in what they name.\n"
    yield f"![Success with intervals, beside the paper's]({FIGURE})\n"
    for name, (_, text) in TABLES.items():
        if not tables[name].empty:
            yield f"## {name.capitalize()}\n\n{text} [CSV]({name}.csv)\n"
            yield markdown_table(tables[name].map(escape))
            if name == "calibration":
                yield f"![Right grasps by the policy's probability]({CALIBRATION})\n"
    if warnings := list(_warnings(results)):
        yield "## Warnings\n\n" + "".join(f"- {warning}\n" for warning in warnings)
    made_with = {f"{name} {version}" for item in versions for name, version in item.items()}
    yield f"Made with {', '.join(sorted(made_with))}.\n"


def _warnings(results: Sequence[Result]) -> Iterator[str]:
    for result in results:
        options = pd.DataFrame([record.policy for record in result.last]).map(repr, na_action="ignore")
        differing = set(options.columns[options.nunique() > 1]) - _OPTIONS_OF_A_RUN
        if differing:
            yield f"The trainings of {escape(result.name)} differ in `{'`, `'.join(sorted(differing))}`."


# Tables


def make_table(results: Sequence[Result], rows_of: RowsOf) -> pd.DataFrame:
    """Returns the rows that a function makes of each result; rates are fractions."""
    rows = [
        {"experiment": result.experiment, "variant": result.variant, **row}
        for result in results
        for row in rows_of(result, results)
    ]
    return pd.DataFrame(rows).dropna(axis=1, how="all")


def success_rows(result: Result, _: Sequence[Result]) -> Iterator[dict[str, Any]]:
    """Yields the success at the last step, next to the paper's."""
    best_sets, best_sets_sd = paper_rate(result.rates) if len(result.rates) > 1 else (np.nan, np.nan)
    seeds, rates = result.rates.columns, result.rates.iloc[-1]
    yield {
        "training_seeds": " ".join(map(str, seeds)),
        "step": result.rates.index[-1],
        "scenes": result.scenes,
        "episodes": len(result.episodes),
        "success": result.success,
        "each_seed": ", ".join(f"{100 * rate:.1f}" for rate in rates) if len(seeds) > 1 else None,
        "best_sets": best_sets,
        "best_sets_sd": best_sets_sd,
        "paper": result.paper.rate,
        "paper_sd": result.paper.sd,
    }


def outcome_rows(result: Result, _: Sequence[Result]) -> Iterator[dict[str, Any]]:
    """Yields the success by kind of task, and which of the steps to success episodes reach."""
    episodes = result.episodes
    kinds = episodes["task_id"].map(lambda task_id: get_task(task_id).kind)
    has_grasped = episodes["grasped_object"] >= 0
    has_placed = episodes["object_containers"].map(max) >= 0
    yield {
        **episodes["success"].groupby(kinds).mean().reindex(task_kinds()),
        "grasped_anything": has_grasped.mean(),
        "right_object_of_grasped": episodes["right_object"][has_grasped].mean(),
        "right_container_of_placed": episodes["right_container"][has_placed].mean(),
    }


def ladder_rows(result: Result, _: Sequence[Result]) -> Iterator[dict[str, Any]]:
    """Yields where episodes end, and how far locations are from the true ones, if that was recorded."""
    episodes = result.episodes
    if episodes["failure"].isna().any():
        return
    ends = pd.concat([scene_columns(record)["success_at_end"] for record in result.last])
    errors = {}
    for name in ("pick_error", "place_error"):
        if episodes[name].notna().any():
            errors[f"{name}_mm"] = "{:.1f}, {:.1f}".format(*episodes[name].quantile([0.5, 0.9]))
    yield {
        "oracle": result.settings["oracle"],
        "success": float(episodes["success"].mean()),
        "success_at_end": float(ends.mean()),
        "picked_right": float(episodes["right_object"].mean()),
        "placed_right": float(episodes["right_container"].mean()),
        **{name.replace(" ", "_"): float((episodes["failure"] == name).mean()) for name in FAILURES},
        **errors,
    }


def difference_rows(result: Result, results: Sequence[Result]) -> Iterator[dict[str, Any]]:
    """Yields the difference of success to another result, paired by task.

    A variant is compared with the same training runs in the main settings, or in those nearest to them; all
    others with the first experiment of their group in the same settings.
    """
    group = [item for item in results if item.group == result.group]
    same_training = [
        item
        for item in group
        if item.experiment == result.experiment
        and item.departures.items() < result.departures.items()
        and item.settings["tasks"] == result.settings["tasks"]
        and set(item.last.index) & set(result.last.index)
    ]
    if same_training:
        reference = max(same_training, key=lambda item: len(item.departures))
        records = reference.last[reference.last.index.intersection(result.last.index)]
    else:
        reference = next(item for item in group if item.settings == result.settings)
        records = reference.last
    if reference is not result:
        differences = task_differences(result.episodes, pd.concat([each.episodes for each in records]))
        yield {
            "compared_with": reference.name,
            "difference": bootstrap(differences) if len(differences) else None,
            "detectable": detectable_difference(differences) if len(differences) > 1 else None,
        }


def counterfactual_rows(result: Result, _: Sequence[Result]) -> Iterator[dict[str, Any]]:
    """Yields which input the policy follows where demonstration and instruction disagree."""
    if result.settings["counterfactual"] != "none":
        table = followed(result.last)
        sources = ["demonstration", "instruction", "neither"]
        table[sources] = table[sources].div(table["episodes"], axis=0)
        yield from table.to_dict("records")


def calibration_rows(result: Result, _: Sequence[Result]) -> Iterator[dict[str, Any]]:
    """Yields how often grasps are of the right object, by how sure the policy was, if its inputs agree."""
    if result.settings["counterfactual"] != "none":
        return
    grasps = result.episodes[result.episodes["grasped_object"] >= 0]
    for sure, some in grasps.groupby(
        pd.cut(grasps["pick_confidence"], _CONFIDENCE_BOUNDS, include_lowest=True), observed=True
    ):
        yield {
            "sure": f"{100 * max(sure.left, 0):.0f} to {100 * sure.right:.0f} %",
            "grasps": len(some),
            "mean_probability": some["pick_confidence"].mean(),
            "right_object": some["right_object"].mean(),
        }


def evaluation_rows(result: Result, _: Sequence[Result]) -> Iterator[dict[str, Any]]:
    """Yields the success of every evaluation, by training seed and step, if there are several."""
    for (seed, step), record in result.records.unstack().items():
        if result.records.size > 1:
            success = success_interval(record.episodes)
            yield {
                "training_seed": str(seed),
                "step": step,
                "episodes": len(record.episodes),
                "success": success,
            }


# Rows and explanation of each table, by the name of its CSV file
TABLES: dict[str, tuple[RowsOf, str]] = {
    "success": (
        success_rows,
        "Success at the last step that was evaluated for all training seeds. The interval is by bootstrap "
        "over tasks, or Wilson's where fewer than 5 episodes succeed. It covers the choice of tasks; other "
        "training seeds may differ by more. A policy that picks at random succeeds in "
        f"{100 * CHANCE:.1f} %. Best sets is the rate by the paper's protocol: the mean over the ten "
        "evaluation sets (steps) with the highest mean over seeds, or over all if there are fewer, which "
        "flatters; its SD is that over seeds. The authors' rates were measured in another simulation, with "
        "other objects: compare the order, not the values.",
    ),
    "outcomes": (
        outcome_rows,
        "Success by how the task describes its object; then the fraction of the episodes in which something "
        "was grasped, of these in which it was the right object, and of the episodes in which something was "
        "placed, in the right container alone.",
    ),
    "ladder": (
        ladder_rows,
        "Where episodes end, as fractions of all. With the oracle location, the benchmark says where to pick "
        "and place; with the oracle controller, its scripted expert moves the arm to where the policy would. "
        "Success counts at any step; at the end, the object still lies in the container. Not found: the "
        "location is nearer to another object or container. Thrown off: the object left the tray. Missed: it "
        "was never held. Lost: it slipped. Not put down: it was still held at the end. Put down beside: it "
        "was released elsewhere. Errors are the median and the 90th percentile: of the end effector's "
        "position at the pick, and of the horizontal one from the container's middle at the place.",
    ),
    "differences": (
        difference_rows,
        "Differences of success in points, paired by task. A variant is compared with the same training runs "
        "in the settings above, another experiment with the first one in the same settings. Detectable: the "
        "smallest true difference that such a comparison decides with a probability of 80 %.",
    ),
    "counterfactuals": (
        counterfactual_rows,
        "The demonstration or the instruction is another task's. Counted are the episodes in which both ask "
        "for different objects or containers: whether the object held last, and the only container in which "
        "something lies, are the demonstration's, the instruction's or neither's.",
    ),
    "calibration": (
        calibration_rows,
        "How often the right object is grasped, by the probability that the policy gave its choice.",
    ),
    "evaluations": (evaluation_rows, "Every evaluation, where there are several of training seeds or steps."),
}


# Formats


def markdown_table(table: pd.DataFrame) -> str:
    """Returns a table in Markdown, with rates in %. Its texts are Markdown, too."""
    header = [name.replace("_", " ") for name in table.columns]
    rows = [header, ["---"] * len(header), *(map(_cell, row) for row in table.itertuples(index=False))]
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def _cell(value: Any) -> str:
    if isinstance(value, Estimate):
        return "{:.1f} [{:.1f}, {:.1f}]".format(*(100 * number for number in value))
    if pd.isna(value):
        return "–"
    if isinstance(value, float):
        return f"{100 * value:.1f}"
    return value if isinstance(value, str) else f"{value:,}"


def csv_table(table: pd.DataFrame) -> str:
    """Returns a table as CSV, with estimates in three columns."""
    columns: dict[str, pd.Series] = {}
    for name, values in table.items():
        if isinstance(values.iloc[0], Estimate):
            columns |= {name: values.str[0], f"{name}_low": values.str[1], f"{name}_high": values.str[2]}
        else:
            columns[name] = values
    return pd.DataFrame(columns).round(6).to_csv(index=False, lineterminator="\n")


def escape(value: Any) -> Any:
    """Escapes a text for Markdown, and so for HTML; returns other values as they are."""
    if not isinstance(value, str):
        return value
    return re.sub(r"([\\`*_\[\]<>&|#~])", r"\\\1", " ".join(value.split()))


def draw_success(results: Sequence[Result]) -> Figure:
    """Draws the success with its intervals next to the paper's and, with several steps, over training."""
    from matplotlib.figure import Figure  # without pyplot, which would look for a screen

    names = [result.name for result in results]
    has_curves = any(len(result.rates) > 1 for result in results)
    width, height = 6 + 0.06 * max(map(len, names)) + 5 * has_curves, max(1 + 0.25 * len(names), 3)
    figure = Figure(figsize=(width, height), dpi=140, layout="constrained")
    axes = figure.subplots(1, 1 + has_curves, squeeze=False)[0]
    for n, result in enumerate(results):
        style = {"color": f"C{n % 10}", "linestyle": ("-", "--", ":", "-.")[n // 10 % 4]}
        value, low, high = result.success
        axes[0].plot([low, high], [n, n], **style)
        axes[0].plot(value, n, "o", color=style["color"])
        axes[0].errorbar(result.paper.rate, n + 0.3, xerr=result.paper.sd, fmt="s", color="0.6", markersize=3)
        if len(result.rates) > 1:
            axes[1].plot(result.rates.mean(axis=1), marker="o", markersize=3, **style)
    axes[0].axvline(CHANCE, color="0.8", linestyle=":")
    axes[0].set_yticks(range(len(names)), names, fontsize=8, parse_math=False)
    axes[0].set_ylim(len(names) - 0.5, -0.5)
    axes[0].set_xlim(0, 1)
    axes[0].set_xlabel("success at the last step, 95 % (gray: the authors, SD; dotted: random)")
    axes[0].xaxis.set_major_formatter("{x:.0%}")
    for ax in axes[1:]:
        ax.set_ylim(0, 1)
        ax.set(xlabel="training step", ylabel="success, mean over seeds, in the same colors")
        ax.yaxis.set_major_formatter("{x:.0%}")
    for ax in axes:
        ax.grid(color="0.92")
        ax.spines[["top", "right"]].set_visible(False)
    return figure


def draw_calibration(table: pd.DataFrame) -> Figure:
    """Draws how often grasps are right over the policy's probability, points as large as their number.

    Of many experiments, those with the most grasps are drawn.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5, 4.2), dpi=140, layout="constrained")
    ax = figure.subplots()
    ax.plot([0, 1], [0, 1], color="0.8", linestyle=":")
    groups = table.groupby(["experiment", "variant"], sort=False)
    for experiment, variant in groups["grasps"].sum().nlargest(_MAX_CALIBRATED).index:
        rows = groups.get_group((experiment, variant))
        (line,) = ax.plot(rows["mean_probability"], rows["right_object"], linewidth=1, label=experiment)
        ax.scatter(rows["mean_probability"], rows["right_object"], rows["grasps"], color=line.get_color())
    ax.set(xlim=(0, 1.02), ylim=(0, 1.02), xlabel="probability of the choice", ylabel="right object grasped")
    ax.legend(frameon=False, fontsize=7, loc="lower right")
    ax.grid(color="0.92")
    ax.spines[["top", "right"]].set_visible(False)
    return figure
