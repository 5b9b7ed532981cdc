"""The report's page in Markdown. Rates are percentages."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence

from gym_deltaco.object_sets import find_label
from lerobot_deltaco.reporting.comparisons import by_novelty, differences, title_of
from lerobot_deltaco.reporting.novelty import DESCRIPTIONS, NOVELTIES
from lerobot_deltaco.reporting.paper_results import (
    CHANCE,
    LEVELS,
    NOTE,
    PAPER_OPTIONS,
    label_of,
    paper_result,
)
from lerobot_deltaco.reporting.report_files import markdown_table
from lerobot_deltaco.reporting.series import Report, Series, counted
from lerobot_deltaco.reporting.statistics import (
    ALL_KINDS,
    CUES,
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
from lerobot_deltaco.reporting.task_bootstrap import estimate_text, mean_rate

CURVES_IMAGE = "curves.png"
BESIDE_PAPER_IMAGE = "beside_paper.png"
# Of the policy's configuration: what the report names.
_NAMED_OPTIONS = ("language_encoder", "demo_encoder", "backbone", "motion_modes", "dtype")


def markdown_page(report: Report) -> str:
    """The page of a report."""
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
    is_drawn_once = example.record.adversarial_draw == "scene"
    header = (
        f"{len(example.task_ids)} tasks (`{example.record.tasks}`), {example.record.trials} trials of each "
        f"in an evaluation set; evaluation seed {example.record.evaluation_seed}; ambiguity scheme "
        f"`{example.record.ambiguity}`; scenes of the objects `{example.record.objects}`, with adversarial "
        f"distractors at a probability of {example.record.adversarial_probability:g}"
        f"{', decided by one draw for both of a scene' if is_drawn_once else ''}.{_architecture(group)}"
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
    found = {row.kind for rows in breakdowns.values() for row in rows}
    kinds_of_task = [kind for kind in ALL_KINDS if kind in found]
    columns = [
        *((kind, "all") for kind in kinds_of_task),
        *(("all", word) for word in WORDS),
        *((kind, word) for kind in kinds_of_task for word in WORDS),
    ]
    kinds = markdown_table(
        ["experiment", *(_group_name(kind, word) for kind, word in columns)],
        [
            [label_of(experiment), *(_success(rows, kind, word) for kind, word in columns)]
            for experiment, rows in breakdowns.items()
        ],
    )
    return (
        f"## {title_of(comparison)}\n\n{header}\n\n{rates}\n"
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
            [label_of(series.experiment), estimate_text(estimate)]
            for series, _, estimate in differences(group)
        ],
    )
    return (
        f"\nDifferences of success there, paired by task, with intervals by bootstrap over tasks:\n\n{table}"
    )


def _novelty_section(group: Sequence[Series]) -> str:
    shares = {series.experiment: by_novelty(series) for series in group}
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
    return estimate_text(mean_rate(series.last_task_rates))


def _group_name(kind: str, word: str) -> str:
    parts = [part.replace("_", " ") for part in (kind, word) if part != "all"]
    return ", ".join(parts)


def _success(rows: Sequence[BreakdownRow], kind: str, word: str) -> str:
    row = next((row for row in rows if (row.kind, row.word) == (kind, word)), None)
    return "–" if row is None else _percent(row.outcomes["success"].rate)


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


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{100 * share:.1f}"
