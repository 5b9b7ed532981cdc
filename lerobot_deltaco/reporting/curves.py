"""The image of the learning curves."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lerobot_deltaco.reporting.paper_results import LEVELS, label_of, paper_result

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PANEL_SIZE = (9.0, 4.4)  # inches; higher, where the legend is
_LEGEND_LINE, _LEGEND_FRAME = 0.205, 0.9  # inches
DOTS_PER_INCH = 140
# The same method has the same color in every image.
COLORS = MappingProxyType(
    {
        "deltaco": "#c8102e",
        "demo_only": "#e69f00",
        "language_only": "#0072b2",
        "bc_z": "#7f7f7f",
        "mcil": "#7b4b2a",
        "one_hot": "#2b3a55",
        "oracle": "#009e73",
    }
)
_OTHER_COLORS = (
    "#cc79a7",
    "#56b4e9",
    "#6a3d9a",
    "#a6a600",
    "#ff7f50",
    "#33691e",
    "#17a2b8",
    "#b15928",
    "#455a64",
)
_OTHER_STYLES = tuple((color, line) for line, color in product(("-", "-.", ":"), _OTHER_COLORS))
_DASHED, _DOTTED = (0, (6, 4)), (0, (1, 3))
_SHADES_OF_LEVELS = ("black", "0.35", "0.55")


@dataclass(frozen=True)
class Curve:
    """The success of an experiment over its training.

    Args:
        experiment: Name of the experiment.
        steps: Ascending.
        rates: (steps, seeds), 0..1.
    """

    experiment: str
    steps: Sequence[int]
    rates: NDArray[np.float64]


def draw_curves(panels: Sequence[tuple[str, Sequence[Curve]]], authors_levels: bool = False) -> bytes:
    """Draws success over training steps: the mean over seeds, with a band of one standard deviation.

    Args:
        panels: Titles and curves, one panel below the other.
        authors_levels: Draw the authors' rates too, as dashed lines in their experiments' colors.

    Returns:
        A PNG.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    image = io.BytesIO()
    FigureCanvasAgg(curves_figure(panels, authors_levels)).print_png(image)
    return image.getvalue()


def curves_figure(panels: Sequence[tuple[str, Sequence[Curve]]], authors_levels: bool = False) -> Figure:
    """The image of `draw_curves` as a figure, whose panels are as high as their legends."""
    # Only here, so that the command line answers quickly; and without pyplot, which would look for a screen.
    from matplotlib.figure import Figure

    width, least_height = PANEL_SIZE
    n_lines = [len(curves) + 2 * len(LEVELS) + 2 for _, curves in panels]
    heights = [max(least_height, _LEGEND_FRAME + _LEGEND_LINE * number) for number in n_lines]
    figure = Figure(figsize=(width, sum(heights)), dpi=DOTS_PER_INCH, layout="constrained")
    axes = figure.subplots(len(panels), 1, squeeze=False, height_ratios=heights)[:, 0]
    for ax, (title, curves) in zip(axes, panels, strict=True):
        _draw_panel(ax, curves, authors_levels)
        ax.set_title(title, loc="left", fontsize=12)
    return figure


def _label(curve: Curve) -> str:
    n_seeds = curve.rates.shape[1]
    return f"{label_of(curve.experiment)} ({n_seeds} seed{'s' * (n_seeds > 1)})"


def _draw_panel(ax: Axes, curves: Sequence[Curve], authors_levels: bool) -> None:
    from matplotlib.lines import Line2D

    other_styles = iter(_OTHER_STYLES * (1 + len(curves) // len(_OTHER_STYLES)))
    highest = max(LEVELS.values())
    has_levels = False
    for curve in curves:
        method = curve.experiment.rpartition("/")[2]
        color, line = (COLORS[method], "-") if method in COLORS else next(other_styles)
        mean, sd = curve.rates.mean(axis=1), curve.rates.std(axis=1)
        label = _label(curve)
        if len(curve.steps) == 1:
            ax.errorbar(curve.steps, mean, yerr=sd, fmt="o", color=color, capsize=4, label=label)
        else:
            ax.fill_between(curve.steps, mean - sd, mean + sd, color=color, alpha=0.15, linewidth=0)
            marker = "o" if len(curve.steps) <= 20 else None
            ax.plot(
                curve.steps, mean, line, color=color, marker=marker, markersize=3.5, linewidth=2, label=label
            )
        highest = max(highest, (mean + sd).max())
        published = paper_result(curve.experiment)
        if authors_levels and published is not None:
            ax.axhline(published.rate, color=color, linewidth=1, linestyle=_DASHED, alpha=0.8)
            highest, has_levels = max(highest, published.rate), True
    # In the order in which the curves end, so that they can be told apart.
    last = {_label(curve): curve.rates[-1].mean() for curve in curves}
    handles, labels = ax.get_legend_handles_labels()
    order = sorted(range(len(labels)), key=lambda number: -last[labels[number]])
    handles = [handles[number] for number in order]
    for (label, level), shade in zip(LEVELS.items(), _SHADES_OF_LEVELS, strict=True):
        ax.axhline(level, color=shade, linewidth=1, linestyle=_DOTTED)
        name = f"{100 * level:.1f} %: {label}".replace(", ", ",\n")
        handles.append(Line2D([], [], color=shade, linewidth=1, linestyle=_DOTTED, label=name))
    if has_levels:
        label = "authors' rates\n(another simulation)"
        handles.append(Line2D([], [], color="gray", linewidth=1, linestyle=_DASHED, label=label))
    # Beside the axes, where it hides no curve.
    ax.legend(handles=handles, loc="upper left", bbox_to_anchor=(1.01, 1), frameon=False, fontsize=9)
    ax.set_xlabel("training step")
    ax.set_ylabel("success rate")
    ax.set_xlim(left=0)
    ax.set_ylim(0, min(1.0, 1.08 * highest))
    ax.xaxis.set_major_formatter(lambda step, _: f"{step / 1000:g}k" if step >= 1000 else f"{step:g}")
    ax.yaxis.set_major_formatter(lambda rate, _: f"{100 * rate:g} %")
    ax.grid(axis="y", color="0.9")
    ax.set_axisbelow(True)
    ax.spines[["top", "right"]].set_visible(False)
