"""House style of the figures, learning curves, and rows of intervals."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np

from shapebody.arguments import (
    refuse,
    require_array,
    require_integer,
    require_kind,
    require_list,
    require_text,
    shown,
)
from shapebody.files import read_curve

# Okabe and Ito's colours stay distinct for colour-blind readers.
COLOURS = {
    "blue": "#0072B2",
    "orange": "#E69F00",
    "green": "#009E73",
    "red": "#D55E00",
    "purple": "#CC79A7",
    "sky": "#56B4E9",
    "yellow": "#F0E442",
    "black": "#222222",
}

PAPER = "#8A8F98"
"""Grey of every number taken from the paper."""

DIVERGING = "PuOr_r"
"""Colour map of signed quantities such as f in [-1, 1]; centre it on zero."""


def use_style() -> None:
    """Set Matplotlib's defaults: 100 dpi (small notebooks), quiet axes, colour-blind safe."""
    mpl.rcParams.update(
        {
            "figure.dpi": 100,
            "savefig.dpi": 100,
            "figure.figsize": (7.0, 3.4),
            "figure.constrained_layout.use": True,
            "axes.prop_cycle": mpl.cycler(color=list(COLOURS.values())),
            "axes.spines.top": False,
            "axes.spines.right": False,
            "axes.grid": True,
            "axes.axisbelow": True,
            "axes.titlesize": "medium",
            "grid.color": "#E3E5E8",
            "grid.linewidth": 0.7,
            "lines.linewidth": 1.8,
            "legend.frameon": False,
            "image.cmap": "viridis",
            "svg.hashsalt": "shapebody",
        }
    )


def _axes(ax):
    """Axes to draw into, or None; TypeError for anything else."""
    if ax is not None:
        require_kind("ax", ax, mpl.axes.Axes, "from plt.subplots()")
    return ax


def learning_curve(path: str | Path, y: str, x: str = "steps", ax=None, smooth: int = 1, **style):
    """Plot column `y` of a learning curve over column `x`; returns the axes.

    smooth: number of records averaged; above 1, the raw values are shown faintly behind.
    Raises ValueError for a column that the file does not have.
    """
    require_integer("smooth", smooth, 1, 1_000_000)
    ax = _axes(ax)
    columns = read_curve(path)
    for name in (x, y):
        if not isinstance(name, str) or name not in columns:
            raise ValueError(f"{path} has no column {shown(name)}; it has {', '.join(columns)}")
    ax = ax or plt.gca()
    values = columns[y]
    if smooth > 1:
        weights = np.ones(smooth)
        present = np.isfinite(values)
        total = np.convolve(np.where(present, values, 0), weights, mode="same")
        count = np.convolve(present, weights, mode="same")
        smoothed = np.where(count > 0.5, total / np.maximum(count, 1), np.nan)
        (line,) = ax.plot(columns[x], smoothed, **style)
        ax.plot(columns[x], values, color=line.get_color(), alpha=0.25, linewidth=0.8)
    else:
        ax.plot(columns[x], values, **style)
    ax.set(xlabel="training steps" if x == "steps" else x, ylabel=y.replace("_", " "))
    return ax


def intervals(labels: Sequence[str], values: Sequence, colours: Sequence = (), ax=None):
    """Plot means with their intervals, one row each from the bottom up; returns the axes.

    values: (mean, low, high) per label, or None for an empty row; colours: one per label, if any.
    """
    labels = [require_text("a label", label) for label in require_list("labels", labels)]
    values, colours = require_list("values", values), require_list("colours", colours)
    for name, given in (("values", values), ("colours", colours)):
        if len(given) != len(labels) and (given or name == "values"):
            raise ValueError(f"{len(given)} {name} for {len(labels)} labels; give one each")
    for colour in colours:
        if not mpl.colors.is_color_like(colour):
            raise refuse("a colour", colour, "one that Matplotlib knows, such as '#0072B2'")
    rows = [None if row is None else require_array("a value", row, (3,)) for row in values]
    ax = _axes(ax) or plt.gca()
    for place, value in enumerate(rows):
        if value is not None:
            mean, low, high = value
            colour = colours[place] if len(colours) else COLOURS["blue"]
            ax.plot([low, high], [place, place], color=colour, linewidth=2.5)
            ax.plot(mean, place, "o", color=colour)
    ax.set(yticks=range(len(labels)), yticklabels=labels, ylim=(-0.7, len(labels) - 0.3))
    return ax


def panels(titles: Sequence[str], columns: int = 1, size=(3.3, 3.0), **options) -> list:
    """Axes of a figure with a panel per title side by side, or with a row of `columns` per title.

    Returns a list of axes, or of rows of axes. size: of one panel, in inches; options go to
    `plt.subplots`. The title is above the first panel of a row.
    """
    titles = [require_text("a title", title) for title in require_list("titles", titles)]
    if not titles:
        raise ValueError("titles is empty; expected the title of at least one panel")
    require_integer("columns", columns, 1, 20)
    width, height = require_array("size", size, (2,))
    shape = (1, len(titles)) if columns == 1 else (len(titles), columns)
    figsize = (max(shape[1] * width, 4), shape[0] * height)
    _, axes = plt.subplots(*shape, figsize=figsize, squeeze=False, **options)
    axes = list(axes[0]) if columns == 1 else list(axes)
    for ax, title in zip(axes if columns == 1 else [row[0] for row in axes], titles, strict=True):
        ax.set_title(title)
    return axes


def legend_beside(axes: Sequence) -> None:
    """One legend for all panels, beside the last, since an entry may be in some of them only."""
    entries = {}
    axes = require_list("axes", axes)
    if not axes:
        raise ValueError("axes is empty; expected at least one panel")
    for ax in map(_axes, axes):
        entries |= dict(zip(*reversed(ax.get_legend_handles_labels()), strict=True))
    axes[-1].legend(entries.values(), entries.keys(), loc="center left", bbox_to_anchor=(1.0, 0.5))
