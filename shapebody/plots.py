"""House style of the figures, learning curves, and the table "paper | ours"."""

import html
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np

from shapebody.checks import (
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


@dataclass(frozen=True)
class Table:
    """A table that a notebook shows as HTML, and a terminal as text."""

    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    caption: str = ""

    def __post_init__(self):
        rows = require_list("rows", self.rows)
        for name, row in (("header", self.header), *(("a row", row) for row in rows)):
            require_kind(name, row, tuple, "of texts, see plots.table")
            for cell in row:
                require_text(f"a cell of {name}", cell, 10_000)
            if len(row) != len(self.header):
                raise ValueError(f"{name} has {len(row)} cells; expected {len(self.header)}")
        require_text("caption", self.caption, 10_000)

    def markdown(self) -> str:
        rule = ["---"] + ["---:"] * (len(self.header) - 1)
        lines = ["| " + " | ".join(row) + " |" for row in (self.header, rule, *self.rows)]
        return "\n".join(([self.caption, ""] if self.caption else []) + lines)

    def __str__(self) -> str:
        columns = list(zip(self.header, *self.rows, strict=True))
        widths = [max(len(cell) for cell in column) for column in columns]
        lines = [
            "  ".join(
                [row[0].ljust(widths[0])]
                + [cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True)]
            )
            for row in (self.header, *self.rows)
        ]
        return "\n".join(([self.caption] if self.caption else []) + lines)

    __repr__ = __str__

    def _repr_html_(self) -> str:
        def cells(row, tag):
            aligned = ["left"] + ["right"] * (len(row) - 1)
            return "".join(
                f'<{tag} style="text-align: {side}">{html.escape(cell)}</{tag}>'
                for side, cell in zip(aligned, row, strict=True)
            )

        body = "".join(f"<tr>{cells(row, 'td')}</tr>" for row in self.rows)
        caption = f"<caption>{html.escape(self.caption)}</caption>" if self.caption else ""
        return (
            f"<table>{caption}<thead><tr>{cells(self.header, 'th')}</tr></thead>"
            f"<tbody>{body}</tbody></table>"
        )


def table(rows: Iterable[Sequence], header: Sequence[str], digits: int = 2, caption: str = ""):
    """Table of values. A number gets `digits` decimals, a pair (m, h) becomes "m ± h", None "–"."""
    header = tuple(str(cell) for cell in require_list("header", header, 1000))
    if not header:
        raise ValueError("header is empty; expected the title of at least one column")
    require_integer("digits", digits, 0, 17)
    require_text("caption", caption, 10_000)
    rows = [require_list("a row", row) for row in require_list("rows", rows, 100_000)]
    rows = tuple(tuple(_text(cell, digits) for cell in row) for row in rows)
    for row in rows:
        if len(row) != len(header):
            raise ValueError(f"row {row} has {len(row)} cells for the {len(header)} of {header}")
    return Table(header, rows, caption)


def paper_table(rows: Iterable[Sequence], digits: int = 2, caption: str = "", note: str = "ours"):
    """Table "quantity | paper | ours". rows: (quantity, paper's value, our value).

    Values as in `table`. note: header of our column, best with scale and engine.
    """
    require_text("note", note)
    return table(rows, ("", "paper", note), digits, caption)


def agents_table(agents: Iterable):
    """Table of agents that are compared: their training, and that of the critic they bring."""
    from shapebody.checkpoints import load_curve, require_agent

    rows = []
    for agent in [require_agent(agent) for agent in require_list("agents", agents, 10_000)]:
        rows.append(
            (
                agent.name,
                f"{agent.metadata['steps'] / 1e6:.1f} million",
                float(load_curve(agent.name)["coefficient"][-1]),
                _policy_evaluation(agent.metadata.get("policy_evaluation")),
                f"{agent.policy_config.latent_scale:g}, {agent.critic_config.latent_scale:g}",
            )
        )
    scales = "latent scale of policy, critic"
    header = ("agent", "training steps", "c at their end", "policy evaluation", scales)
    return table(rows, header)


def _policy_evaluation(phase) -> str | None:
    if phase is None:
        return None
    actions = "mean" if phase["config"].get("mean_actions") else "noisy"
    return f"{phase['steps'] / 1e6:.1f} million, {actions} actions"


def _text(value, digits) -> str:
    if value is None:
        return "–"
    if isinstance(value, str):
        return value
    if isinstance(value, tuple | list) and len(value) == 2:
        return f"{_text(value[0], digits)} ± {_text(value[1], digits)}"
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, int | np.integer):
        return f"{value:,}"
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError) as error:
        expected = "a number, a text, a pair (mean, half width) or None"
        raise refuse("a cell", value, expected) from error
    return f"{number:.{digits}f}" if np.isfinite(number) else "–"
