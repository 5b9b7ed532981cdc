"""The report on evaluations: the paper's tables and curves, from the records of several runs."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from gym_deltaco.object_sets import find_label
from lerobot_deltaco.reporting.beside_paper import PaperComparison, draw_beside_paper
from lerobot_deltaco.reporting.curves import Curve, draw_curves
from lerobot_deltaco.reporting.novelty import (
    DESCRIPTIONS,
    NOVELTIES,
    Novelty,
    scenario_of,
    success_by_novelty,
)
from lerobot_deltaco.reporting.paper_results import (
    CHANCE,
    LEVELS,
    NOTE,
    PAPER_OPTIONS,
    TITLES,
    label_of,
    paper_result,
)
from lerobot_deltaco.reporting.report_files import csv_bytes, markdown_table, write_files
from lerobot_deltaco.reporting.series import Report, Series, counted, find_records, make_report
from lerobot_deltaco.reporting.statistics import (
    CUES,
    KINDS,
    N_BEST_SETS,
    OUTCOMES,
    WORDS,
    BreakdownRow,
    PaperRate,
    Proportion,
    breakdown,
    by_object,
    followed,
    paper_rate,
)
from lerobot_deltaco.reporting.task_bootstrap import Estimate, mean_rate, paired_difference

REPORT_FILE = "report.md"
CURVES_IMAGE = "curves.png"
BESIDE_PAPER_IMAGE = "beside_paper.png"
FILES = (
    CURVES_IMAGE,
    BESIDE_PAPER_IMAGE,
    "curves.csv",
    "rates.csv",
    "breakdown.csv",
    "differences.csv",
    "novelty.csv",
    "objects.csv",
    "counterfactual.csv",
    REPORT_FILE,
)
# Of the policy's configuration: what the report names.
_NAMED_OPTIONS = ("language_encoder", "demo_encoder", "backbone", "motion_modes", "dtype")


def write_report(folders: Sequence[Path], out: Path, authors_levels: bool = False) -> Report:
    """Reports on all evaluations of some runs, in Markdown, CSV files and an image.

    All files are written, or none. Those of an earlier report are replaced.

    Args:
        folders: Folders of runs, or folders that contain them at any depth.
        out: The report's folder, which is made.
        authors_levels: Draw the authors' rates into the image.

    Returns:
        What was reported. Without ordinary evaluations, there are no rates and no curves; with a single
        experiment, no `differences.csv`; without counterfactual evaluations, no `counterfactual.csv`.

    Raises:
        ReportError: A folder has no records, or they do not belong together.
        RecordError: A record is damaged.
        OSError: Something cannot be read or written.
    """
    report = make_report(find_records(folders))
    contents = {
        "curves.csv": csv_bytes(_curve_rows(report)),
        "breakdown.csv": csv_bytes(_breakdown_rows(report)),
    }
    if report.regular:
        contents["rates.csv"] = csv_bytes(_rate_rows(report))
        contents["novelty.csv"] = csv_bytes(_novelty_rows(report))
        contents["objects.csv"] = csv_bytes(_object_rows(report))
        differences = _difference_rows(report)
        if differences:
            contents["differences.csv"] = csv_bytes(differences)
        panels = [
            (_title(name), [Curve(series.experiment, series.steps, series.rates) for series in group])
            for name, group in report.comparisons.items()
        ]
        contents[CURVES_IMAGE] = draw_curves(panels, authors_levels)
        compared = _beside_paper(report)
        if compared:
            contents[BESIDE_PAPER_IMAGE] = draw_beside_paper(compared)
    if report.counterfactual:
        contents["counterfactual.csv"] = csv_bytes(_counterfactual_rows(report))
    contents[REPORT_FILE] = _markdown(report).encode()
    write_files(out, contents, FILES)
    return report


def _beside_paper(report: Report) -> list[tuple[str, list[PaperComparison]]]:
    """Titles and rows of the comparisons that have rows of the paper."""
    panels = []
    for name, group in report.comparisons.items():
        rows = [
            PaperComparison(
                label_of(series.experiment),
                mean_rate(series.last_task_rates),
                paper_result(series.experiment),
            )
            for series in group
        ]
        if any(row.published is not None for row in rows):
            panels.append((_title(name), rows))
    return panels


# The CSV files. Rates are shares, 0..1.


def _rate_rows(report: Report) -> list[dict[str, Any]]:
    rows = []
    for series in report.regular:
        paper, last = paper_rate(series.rates), series.last
        published = paper_result(series.experiment)
        rows.append(
            {
                "experiment": series.experiment,
                "seeds": _joined(series.seeds),
                "evaluation_sets": len(series.steps),
                "best_sets": len(paper.best),
                "best_steps": _joined(series.steps[index] for index in paper.best),
                "rate": paper.rate,
                "sd": paper.sd,
                "last_step": series.steps[-1],
                **_proportion_columns(last, "last_"),
                **_interval_columns(mean_rate(series.last_task_rates), "last_bootstrap_"),
                "authors_rate_in_another_simulation": published and published.rate,
                "authors_sd_in_another_simulation": published and published.sd,
            }
        )
    return rows


def _curve_rows(report: Report) -> list[dict[str, Any]]:
    return [
        {
            "experiment": series.experiment,
            "counterfactual": series.counterfactual,
            "seed": item.record.run_seed,
            "step": item.record.step,
            "successes": item.result.count,
            "episodes": item.result.total,
            "rate": item.result.rate,
            "counted": item.record.step in series.steps,
        }
        for series in report.series
        for item in series.sets
    ]


def _breakdown_rows(report: Report) -> list[dict[str, Any]]:
    return [
        {
            "experiment": series.experiment,
            "counterfactual": series.counterfactual,
            "step": series.steps[-1],
            "kind_of_task": row.kind,
            "kind_of_container_word": row.word,
            "outcome": outcome,
            **_proportion_columns(proportion),
        }
        for series in report.series
        for row in breakdown(series.last_episodes)
        for outcome, proportion in row.outcomes.items()
    ]


def _difference_rows(report: Report) -> list[dict[str, Any]]:
    return [
        {
            "experiment": series.experiment,
            "less": reference.experiment,
            "tasks": len(series.last_task_rates),
            "difference": estimate.value,
            **_interval_columns(estimate, "bootstrap_"),
        }
        for group in report.comparisons.values()
        for series, reference, estimate in _differences(group)
    ]


def _novelty_rows(report: Report) -> list[dict[str, Any]]:
    return [
        {
            "experiment": series.experiment,
            "step": series.steps[-1],
            "novelty": name,
            **_proportion_columns(proportion),
        }
        for series in report.regular
        for name, proportion in _by_novelty(series).items()
    ]


def _object_rows(report: Report) -> list[dict[str, Any]]:
    return [
        {
            "experiment": series.experiment,
            "step": series.steps[-1],
            "object": index,
            "name": find_label(index).name,
            "outcome": outcome,
            **_proportion_columns(proportion),
        }
        for series in report.regular
        for index, outcomes in by_object(series.last_episodes).items()
        for outcome, proportion in outcomes.items()
    ]


def _interval_columns(estimate: Estimate, prefix: str) -> dict[str, Any]:
    return {f"{prefix}low": estimate.low, f"{prefix}high": estimate.high}


def _by_novelty(series: Series) -> dict[Novelty, Proportion]:
    return success_by_novelty(series.last_episodes, scenario_of(series.sets[0].record.tasks))


def _differences(group: Sequence[Series]) -> list[tuple[Series, Series, Estimate]]:
    """The difference of each series of a comparison to the first one, in the order of the tables."""
    reference, *others = group
    return [
        (series, reference, paired_difference(series.last_task_rates, reference.last_task_rates))
        for series in others
    ]


def _counterfactual_rows(report: Report) -> list[dict[str, Any]]:
    return [
        {
            "experiment": series.experiment,
            "counterfactual": series.counterfactual,
            "step": series.steps[-1],
            "seeds": _joined(series.seeds),
            "aspect": item.aspect,
            "among": item.among,
            "followed": item.cue,
            **_proportion_columns(item.proportion),
        }
        for series in report.counterfactual
        for item in followed(series.last_episodes, series.counterfactual)
    ]


def _proportion_columns(proportion: Proportion, prefix: str = "") -> dict[str, Any]:
    low, high = proportion.interval or (None, None)
    values = {
        "count": proportion.count,
        "episodes": proportion.total,
        "rate": proportion.rate,
        "wilson_low": low,
        "wilson_high": high,
    }
    return {prefix + name: value for name, value in values.items()}


def _joined(numbers: Iterable[int]) -> str:
    return " ".join(map(str, numbers))


# Markdown. Rates are percentages.


def _markdown(report: Report) -> str:
    sections = [
        "# Evaluation report\n",
        _introduction(report),
        *(_comparison_section(name, group) for name, group in report.comparisons.items()),
    ]
    if report.regular:
        sections.append(
            "## Learning curves\n\n"
            f"![Success rates over training steps]({CURVES_IMAGE})\n\n"
            "Lines are means over seeds, bands one standard deviation to both sides. Nothing is smoothed.\n"
        )
        if any(paper_result(series.experiment) is not None for series in report.regular):
            sections.append(
                "## Beside the paper\n\n"
                f"![Success rates and the paper's]({BESIDE_PAPER_IMAGE})\n\n"
                "Ours are of the last step, with intervals of 95 % by bootstrap over tasks; the authors' are "
                f"with their standard deviation over seeds, and {NOTE}: compare the order, not the values.\n"
            )
    if report.counterfactual:
        sections.append(_counterfactual_section(report.counterfactual))
    notes = [f"- {note}" for note in report.notes] or ["Nothing."]
    sections.append("## Caveats\n\n" + "\n".join(notes) + "\n")
    sections.append(_origin_section(report))
    return "\n".join(sections)


def _introduction(report: Report) -> str:
    return (
        f"Success rates in {report.series[0].sets[0].benchmark}, in %. Those in another version of the "
        f"benchmark are not comparable. Random choices succeed in {_percent(CHANCE)}.\n\n"
        f"- **Rate (SD)** is the paper's: over the {N_BEST_SETS} evaluation sets (steps) with the highest "
        "mean over seeds, or all if there are fewer, the mean, and the mean of the standard deviation over "
        "seeds (the population's; – with one seed). It picks its sets by what it then averages, which "
        "flatters.\n"
        "- **Last** is the rate at the last step, over the episodes of all seeds, with a 95 % interval by "
        "bootstrap over tasks: the episodes of a task are alike, and seeds share scenes, so that neither are "
        "independent trials. The interval is that of these checkpoints; other seeds may differ more.\n"
        "- **Levels**, dotted in the curves, are the success of policies that know a part of what they are "
        f"asked for: {', '.join(f'{_percent(level)} ({label})' for label, level in LEVELS.items())}.\n"
        "- Only steps count of which all seeds of an experiment have a record.\n"
        f"- **Authors** are the paper's numbers, {NOTE}: compare them with one another, not with ours.\n"
    )


def _comparison_section(comparison: str, group: Sequence[Series]) -> str:
    example = group[0].sets[0]
    header = (
        f"{len(example.task_ids)} tasks (`{example.record.tasks}`), {example.record.trials} trials of each "
        f"in an evaluation set; evaluation seed {example.record.evaluation_seed}; ambiguity scheme "
        f"`{example.record.ambiguity}`; scenes of the objects `{example.record.objects}`, with adversarial "
        f"distractors at a probability of {example.record.adversarial_probability:g}.{_architecture(group)}"
    )
    rates = markdown_table(
        [
            "experiment",
            "seeds",
            "rate (SD)",
            "of the best",
            "last [95 %]",
            "at step",
            "authors, another simulation",
        ],
        [_rate_cells(series) for series in group],
    )
    breakdowns = {series.experiment: breakdown(series.last_episodes) for series in group}
    outcomes = markdown_table(
        ["experiment", "episodes", *(name.replace("_", " ") for name in OUTCOMES)],
        [
            [
                label_of(experiment),
                str(rows[0].outcomes["success"].total),
                *(_percent(proportion.rate) for proportion in rows[0].outcomes.values()),
            ]
            for experiment, rows in breakdowns.items()
        ],
    )
    columns = [
        *((kind, "all") for kind in KINDS),
        *(("all", word) for word in WORDS),
        *((kind, word) for kind in KINDS for word in WORDS),
    ]
    kinds = markdown_table(
        ["experiment", *(_group_name(kind, word) for kind, word in columns)],
        [
            [label_of(experiment), *(_success(rows, kind, word) for kind, word in columns)]
            for experiment, rows in breakdowns.items()
        ],
    )
    return (
        f"## {_title(comparison)}\n\n{header}\n\n{rates}\n"
        f"What happened at the last step that counts:\n\n{outcomes}\n"
        "Success there, by how the task asks for its object (name, color, shape) and for its container "
        f"(color word: green, red; position word: front, back, left, right):\n\n{kinds}"
        f"{_difference_section(group)}{_novelty_section(group)}{_object_section(group)}"
    )


def _architecture(group: Sequence[Series]) -> str:
    """How the policies of a comparison differ from the paper's, as a sentence; empty if they do not."""
    policies = [series.sets[-1].record.policy for series in group]
    policies = [policy for policy in policies if "type" not in policy]  # others have no paper to depart from
    differing = {
        name: dict.fromkeys(str(policy[name]) for policy in policies if policy.get(name, own) != own)
        for name, own in PAPER_OPTIONS.items()
    }
    options = [
        f"`{name}={'`, `'.join(values)}` (paper: `{PAPER_OPTIONS[name]}`)"
        for name, values in differing.items()
        if values
    ]
    if not options:
        return ""
    return (
        f"\n\n**Not the paper's architecture and training:** {', '.join(options)}. These rates say how "
        "methods compare under these settings; they do not reproduce the paper's numbers."
    )


def _difference_section(group: Sequence[Series]) -> str:
    if len(group) < 2:
        return ""
    table = markdown_table(
        ["experiment", f"difference to {label_of(group[0].experiment)}, in points [95 %]"],
        [
            [label_of(series.experiment), _estimate_text(estimate)]
            for series, _, estimate in _differences(group)
        ],
    )
    return (
        f"\nDifferences of success there, paired by task, with intervals by bootstrap over tasks:\n\n{table}"
    )


def _novelty_section(group: Sequence[Series]) -> str:
    shares = {series.experiment: _by_novelty(series) for series in group}
    columns = [name for name in NOVELTIES if any(name in found for found in shares.values())]
    table = markdown_table(
        ["experiment", *(DESCRIPTIONS[name] for name in columns)],
        [
            [
                label_of(experiment),
                *(_share(found[name]) if name in found else "–" for name in columns),
            ]
            for experiment, found in shares.items()
        ],
    )
    return (
        "\nSuccess there, by whether the scenario's training tasks ask for the target (the oracle trains on "
        f"the test tasks instead):\n\n{table}"
    )


def _object_section(group: Sequence[Series]) -> str:
    outcomes = [by_object(series.last_episodes) for series in group]
    indices = sorted({index for found in outcomes for index in found})
    table = markdown_table(
        ["target", *(label_of(series.experiment) for series in group)],
        [
            [
                f"{index} {find_label(index).name}",
                *(_success_and_object(found[index]) if index in found else "–" for found in outcomes),
            ]
            for index in indices
        ],
    )
    return (
        "\nSuccess there for each object that is a target, and in how many episodes it was the one grasped "
        f"last:\n\n{table}"
    )


def _success_and_object(outcomes: Mapping[str, Proportion]) -> str:
    success = outcomes["success"]
    return f"{_percent(success.rate)}, {_percent(outcomes['right_object'].rate)} (of {success.total})"


def _rate_cells(series: Series) -> list[str]:
    paper, published = paper_rate(series.rates), paper_result(series.experiment)
    return [
        label_of(series.experiment),
        ", ".join(map(str, series.seeds)),
        rate_text(paper),
        f"{len(paper.best)} of {len(series.steps)} sets",
        last_text(series),
        f"{series.steps[-1]:,}",
        "–" if published is None else f"{_percent(published.rate)} ({_percent(published.sd)})",
    ]


def rate_text(paper: PaperRate) -> str:
    """The paper's rate in %, such as "25.8 (3.4)"."""
    return f"{_percent(paper.rate)} ({_percent(paper.sd)})"


def last_text(series: Series) -> str:
    """The rate at the last step that counts in %, with its interval over tasks: "24.1 [20.9, 27.6]"."""
    return _estimate_text(mean_rate(series.last_task_rates))


def _estimate_text(estimate: Estimate) -> str:
    return f"{_percent(estimate.value)} [{_percent(estimate.low)}, {_percent(estimate.high)}]"


def _group_name(kind: str, word: str) -> str:
    parts = [part.replace("_", " ") for part in (kind, word) if part != "all"]
    return ", ".join(parts)


def _success(rows: Sequence[BreakdownRow], kind: str, word: str) -> str:
    (row,) = (row for row in rows if (row.kind, row.word) == (kind, word))
    return _percent(row.outcomes["success"].rate)


def _counterfactual_section(group: Sequence[Series]) -> str:
    parts = [
        "## Counterfactuals\n\n"
        "The demonstration or the instruction was another task's than the scene's, at the last step that "
        "counts. Success is still that of the scene's task. The tables tell whose object was held last, and "
        "whose container alone got something: in % of the episodes in which that task asks for some of the "
        "scene's objects (containers), but not all; and of the conflicts, in which demonstration and "
        "instruction ask for different ones that are both there. Counts and intervals are in "
        "`counterfactual.csv`.\n"
    ]
    for series in group:
        rows = followed(series.last_episodes, series.counterfactual)
        shares = {(row.aspect, row.among, row.cue): _share(row.proportion) for row in rows}
        table = markdown_table(
            ["followed", "scene's task", "demonstration's", "instruction's", "neither"],
            [
                [
                    f"{aspect}, in conflicts" if among == "conflicts" else aspect,
                    *(shares.get((aspect, among, cue), "") for cue in (*CUES, "neither")),
                ]
                for aspect in ("object", "container")
                for among in ("all", "conflicts")
            ],
        )
        parts.append(
            f"### {series.name}\n\n"
            f"Step {series.steps[-1]:,}, {counted('seed', series.seeds)}; "
            f"success {last_text(series)}.\n\n{table}"
        )
    return "\n".join(parts)


def _share(proportion: Proportion) -> str:
    return f"{_percent(proportion.rate)} (of {proportion.total})"


def _origin_section(report: Report) -> str:
    parts = ["## How the records were made\n"]
    for series in report.series:
        records = [item.record for item in series.sets]
        policy = records[-1].policy
        kind = "type" if "type" in policy else "method"  # another of LeRobot's policies, or one of ours
        options = "".join(f", `{name}={policy[name]}`" for name in _NAMED_OPTIONS if name in policy)
        versions = defaultdict(set)
        for record in records:
            for name, version in record.versions.items():
                versions[name].add(version)
        commands = dict.fromkeys(record.command for record in records)
        n_records = f"{len(records)} record{'s' * (len(records) > 1)}"
        parts.append(
            f"### {series.name}\n\n"
            f"- Policy: `{kind}={records[0].method}`{options}.\n"
            f"- {counted('seed', series.seeds).capitalize()}; {n_records}; "
            f"{sum(record.seconds for record in records) / 60:.0f} min of evaluation.\n"
            f"- {', '.join(f'{name} {" and ".join(sorted(found))}' for name, found in versions.items())}.\n\n"
            + "\n".join(f"    {line}" for command in commands for line in command.splitlines())
            + "\n"
        )
    return "\n".join(parts)


def _title(comparison: str) -> str:
    return TITLES.get(comparison, comparison or "Experiments")


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{100 * share:.1f}"
