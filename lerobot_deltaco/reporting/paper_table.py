"""The tables of docs/paper.md: the paper's rows beside the records of the same rows at a small scale.

`python scripts/update_docs.py`, in a clone of the repository, writes them anew.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache, partial
from pathlib import Path
from types import MappingProxyType

from lerobot_deltaco.reporting.page_tables import replaced
from lerobot_deltaco.reporting.paper_results import (
    PAPER_RESULTS,
    TITLES,
    PaperResult,
    small_scale_experiment,
)
from lerobot_deltaco.reporting.report_files import markdown_table
from lerobot_deltaco.reporting.series import Series, find_records, make_report
from lerobot_deltaco.reporting.task_bootstrap import estimate_text, mean_rate, paired_difference

PAPER_PAGE = Path("docs", "paper.md")
PAPER_BEGIN = "<!-- The tables are made from the records in results/. -->"
PAPER_END = "<!-- End of the tables. -->"
NOT_RUN = "not run"
_HEADER = (
    "row",
    "paper, % (SD)",
    "here, % [95 %]",
    "seeds",
    "paper: less DeL-TaCo",
    "here: less DeL-TaCo [95 %]",
)
# Of the paper's rows that begin so: the row of DeL-TaCo that they are compared with.
_REFERENCES: Mapping[str, str] = MappingProxyType(
    {
        "scenario_a": "scenario_a/deltaco",
        "scenario_b": "scenario_b/deltaco",
        "ambiguity_object": "ambiguity_object/deltaco",
        "ablations": "scenario_a/deltaco",
    }
)


def paper_tables(root: Path) -> str:
    """The paper's tables in Markdown, with this project's rates at a small scale.

    Args:
        root: Folder of the repository.

    Raises:
        ReportError: Records do not belong together.
        RecordError: A record is damaged.
    """
    measured = cache(partial(_measured, root=root))
    sections = []
    for comparison, reference in _REFERENCES.items():
        rows = {name: result for name, result in PAPER_RESULTS.items() if name.startswith(f"{comparison}/")}
        table = markdown_table(
            _HEADER, [_cells(name, result, reference, measured) for name, result in rows.items()]
        )
        sections.append(f"### {TITLES[comparison]}\n\n{table}")
    return "\n".join(sections)


def updated_paper_page(page: str, root: Path) -> str:
    """The page with its tables made anew.

    Raises:
        PageTableError: The page has no place for them.
    """
    return replaced(page, PAPER_BEGIN, PAPER_END, paper_tables(root))


def _cells(
    name: str, published: PaperResult, reference: str, find_measured: Callable[[str], Series | None]
) -> list[str]:
    cells = [published.label, f"{100 * published.rate:.1f} ({100 * published.sd:.1f})"]
    paper_difference = ""
    if name != reference:
        paper_difference = f"{100 * (published.rate - PAPER_RESULTS[reference].rate):+.1f}"
    measured, deltaco = find_measured(name), find_measured(reference)
    if measured is None:
        return [*cells, NOT_RUN, "", paper_difference, ""]
    difference = ""
    if name != reference and deltaco is not None:
        difference = estimate_text(paired_difference(measured.last_task_rates, deltaco.last_task_rates), "+")
    return [
        *cells,
        estimate_text(mean_rate(measured.last_task_rates)),
        str(len(measured.seeds)),
        paper_difference,
        difference,
    ]


def _measured(name: str, root: Path) -> Series | None:
    """The evaluations of a row of the paper at a small scale; None if it was not run."""
    experiment = small_scale_experiment(name)
    comparison, _, own_name = experiment.rpartition("/")
    records = root / "results" / comparison / "records" / own_name
    if not records.is_dir():
        return None
    return next(series for series in make_report(find_records([records])).regular)
