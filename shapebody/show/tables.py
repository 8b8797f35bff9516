"""Tables of notebooks, "paper | ours" among them."""

import html
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from shapebody.arguments import refuse, require_integer, require_kind, require_list, require_text


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
    from shapebody.agent.agent import require_agent
    from shapebody.agent.store import load_curve

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
