"""Tables of notebooks, "paper | ours" among them: pandas' styled data frames."""

import hashlib
import html
import re
from collections.abc import Iterable, Sequence

import numpy as np
import pandas as pd
from pandas.io.formats.style import Styler

from shapebody.agent.agent import require_agent
from shapebody.agent.store import load_curve
from shapebody.arguments import refuse, require_integer, require_kind, require_list, require_text

PAPER_TEXT = "#71767F"
"""Grey of a column that holds the paper's numbers."""


class Table(Styler):
    """A styled data frame of texts (`data`) that prints as a table, too."""

    def __repr__(self) -> str:
        cells = [list(self.data.columns), *self.data.values.tolist()]
        widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
        rows = [
            "  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])])
            for row in cells
        ]
        return "\n".join(([html.unescape(self.caption)] if self.caption else []) + rows)


def table(rows: Iterable[Sequence], header: Sequence[str], digits: int = 2, caption: str = ""):
    """Table of values with the first column to the left and all others to the right.

    A number gets `digits` decimals, a pair (m, h) becomes "m ± h", None "–". A column is grey if
    its title begins or ends with the word "paper". Raises ValueError for rows of another length
    than the header, and for two columns of one title.
    """
    header = [str(cell) for cell in require_list("header", header, 1000)]
    if not header:
        raise ValueError("header is empty; expected the title of at least one column")
    if len(set(header)) < len(header):
        raise ValueError(f"header is {header}; expected titles that differ")
    require_integer("digits", digits, 0, 17)
    require_text("caption", caption, 10_000)
    rows = [require_list("a row", row) for row in require_list("rows", rows, 100_000)]
    for row in rows:
        if len(row) != len(header):
            raise ValueError(f"row {row} has {len(row)} cells for the {len(header)} of {header}")
    texts = [[_text(cell, digits) for cell in row] for row in rows]
    frame = pd.DataFrame(texts, columns=header, dtype=object)
    styles = [("th, td", "text-align: right"), (".col0", "text-align: left")]
    for number, title in enumerate(header):
        words = re.findall(r"\w+", title.lower())
        if "paper" in (*words[:1], *words[-1:]) and "ours" not in words:
            styles.append((f"td.col{number}", f"color: {PAPER_TEXT}"))
    # The identifier would be drawn at random, and every execution would be another file.
    name = hashlib.sha256(repr((header, texts)).encode()).hexdigest()[:8]
    styled = Table(frame, uuid=name, cell_ids=False, caption=html.escape(caption) or None)
    styled.format(escape="html").format_index(escape="html", axis="columns").hide(axis="index")
    return styled.set_table_styles([{"selector": x, "props": y} for x, y in styles])


def paper_table(rows: Iterable[Sequence], digits: int = 2, caption: str = "", note: str = "ours"):
    """Table "quantity | paper | ours". rows: (quantity, paper's value, our value).

    Values as in `table`. note: header of our column, best with scale and engine.
    """
    require_text("note", note)
    return table(rows, ("", "paper", note), digits, caption)


def interval(gain, digits: int = 2) -> str:
    """Text "+1.20 [+0.50, +1.90]" of a mean with its interval.

    gain: (mean, low, high, ...), as from `paired_gain`, or a dictionary of "mean", "low", "high".
    """
    require_integer("digits", digits, 0, 17)
    values = [gain[x] for x in ("mean", "low", "high")] if isinstance(gain, dict) else gain[:3]
    mean, low, high = (f"{value:+.{digits}f}" for value in values)
    return f"{mean} [{low}, {high}]"


class Folded:
    """Tables behind a line that opens them; in a terminal they are simply printed."""

    def __init__(self, title: str, *parts):
        self.title, self.parts = require_text("title", title), parts
        for part in parts:
            require_kind("a part", part, Table, "from tables.table")

    def __repr__(self) -> str:
        return "\n\n".join(map(repr, self.parts))

    def _repr_html_(self) -> str:
        inside = "".join(part.to_html() for part in self.parts)
        return f"<details><summary>{html.escape(self.title)}</summary>{inside}</details>"


def agents_table(agents: Iterable):
    """Table of agents that are compared: their training, and that of the critic they bring."""
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
