"""The image of our success rates beside the paper's."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

from lerobot_deltaco.reporting.curves import DOTS_PER_INCH
from lerobot_deltaco.reporting.paper_results import LEVELS, PaperResult
from lerobot_deltaco.reporting.task_bootstrap import Estimate

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WIDTH, ROW_HEIGHT, FRAME_HEIGHT = 8.0, 0.3, 0.8  # inches
OUR_COLOR, AUTHORS_COLOR = "#c8102e", "0.45"
_OFFSET = 0.15  # of the two marks of a row from its middle


class PaperComparison(NamedTuple):
    """A row of ours and the paper's.

    Attributes:
        label: Name of the row.
        ours: Success rate with its interval, 0..1.
        published: The paper's result; None if the paper has no such row.
    """

    label: str
    ours: Estimate
    published: PaperResult | None


def draw_beside_paper(panels: Sequence[tuple[str, Sequence[PaperComparison]]]) -> bytes:
    """Draws success rates as dots, ours above the paper's in each row.

    Args:
        panels: Titles and rows, one panel below the other.

    Returns:
        A PNG.
    """
    # Only here, so that the command line answers quickly; and without pyplot, which would look for a screen.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    heights = [FRAME_HEIGHT + ROW_HEIGHT * len(rows) for _, rows in panels]
    figure = Figure(figsize=(WIDTH, sum(heights)), dpi=DOTS_PER_INCH, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots(
        len(panels), 1, squeeze=False, sharex=True, gridspec_kw={"height_ratios": heights}
    )[:, 0]
    for ax, (title, rows) in zip(axes, panels, strict=True):
        _draw_panel(ax, rows)
        ax.set_title(title, loc="left", fontsize=11)
    axes[0].legend(loc="upper right", fontsize=8)
    axes[-1].set_xlabel("success rate")
    image = io.BytesIO()
    canvas.print_png(image)
    return image.getvalue()


def _draw_panel(ax: Axes, rows: Sequence[PaperComparison]) -> None:
    for level in LEVELS.values():
        ax.axvline(level, color="0.8", linewidth=1, linestyle=(0, (1, 3)))
    ours = [row.ours for row in rows]
    values = [estimate.value for estimate in ours]
    errors = [
        [estimate.value - estimate.low for estimate in ours],
        [estimate.high - estimate.value for estimate in ours],
    ]
    places = [n - _OFFSET for n in range(len(rows))]
    ax.errorbar(values, places, xerr=errors, fmt="o", color=OUR_COLOR, markersize=5, label="ours [95 %]")
    published = [(n + _OFFSET, row.published) for n, row in enumerate(rows) if row.published is not None]
    ax.errorbar(
        [result.rate for _, result in published],
        [place for place, _ in published],
        xerr=[result.sd for _, result in published],
        fmt="s",
        color=AUTHORS_COLOR,
        markersize=4,
        label="authors (SD), another simulation",
    )
    ax.set_yticks(range(len(rows)), [row.label for row in rows], fontsize=9)
    ax.set_ylim(len(rows) - 0.5, -0.5)
    ax.set_xlim(0, 1)
    ax.xaxis.set_major_formatter(lambda rate, _: f"{100 * rate:g} %")
    ax.grid(axis="x", color="0.92")
    ax.set_axisbelow(True)
    ax.spines[["top", "right"]].set_visible(False)
