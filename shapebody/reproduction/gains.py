"""What designs gain over their start, over the reference and over penalty only."""

import numpy as np
import pandas as pd

from shapebody.arguments import require_kind, require_number, require_text, shown
from shapebody.evaluation.statistics import paired_gain
from shapebody.reproduction.results import frame


def gains(records, quantity: str = "return") -> pd.DataFrame:
    """Gains in return ΔR with 95 % intervals, from the records of `design_study`.

    The pairs are the starts; for a search from the reference they are the episodes of one pair of
    designs. Intervals of returns are over starts and episodes (`paired_gain`), those of other
    quantities over starts only, which leaves out the luck with the episodes that all starts share.

    Args:
        records: of one robot, a list or a table (`results.frame`).
        quantity: "return"; or another number of a record, such as "tracking_error", for
            comparisons between starts (those from the reference are left out).

    Returns:
        A row per comparison: method, over ("start", "penalty-only" or "reference"), trust_region
        (NaN for penalty only and the reference), mean, low and high of the paired difference, the
        number of pairs, and how many of them are positive. `gain` finds one row.

    Raises:
        ValueError: if a design has no counterpart to be compared with, or the records come from
            two engines.
    """
    table = frame(records)
    missing = {"origin", "method", "trust_region", "start"} - set(table)
    if missing:
        raise ValueError(f"records have no {min(missing)}; expected what design_study returns")
    engines = sorted(table["engine"].dropna().unique()) if "engine" in table else []
    if len(engines) > 1:
        raise ValueError(
            f"the records come from the engines {', '.join(engines)}, whose episodes are not the "
            "same; compute all of them with one (recompute=True)"
        )
    # Returns are stored by episode, other quantities as means.
    require_text("quantity", quantity)
    detail = "returns" if quantity == "return" else quantity
    whole = [column for column in table if not table[column].isna().any()]
    if detail not in whole:
        raise ValueError(f"quantity is {shown(quantity)}; expected one of {', '.join(whole)}")

    def by_start(rows):
        return rows.set_index("start")[detail].sort_index()

    starts, reference = (table[table["origin"] == x] for x in ("start", "reference"))
    initial = by_start(starts[starts["method"] == "none"])
    penalty = by_start(starts[starts["method"] == "penalty-only"])
    base = reference[reference["method"] == "none"]
    if len(base) != 1 or initial.empty:
        raise ValueError(
            f"the records hold {len(base)} evaluations of the reference and {len(initial)} of "
            "starts; expected one and at least one, as design_study returns them"
        )
    base = base[detail].iloc[0]

    # The reference and every search over the starts, and every search over penalty only.
    same = pd.Series([base] * len(initial), initial.index)
    rows = [_row("reference", "start", None, same, initial)]
    for method, value, found in _searches(starts):
        after = by_start(found)
        rows.append(_row(method, "start", value, after, initial))
        if method != "penalty-only" and not penalty.empty:
            rows.append(_row(method, "penalty-only", value, after, penalty))
    # Searches from the reference over the reference, paired by episode.
    if quantity == "return":
        for method, value, found in _searches(reference):
            episodes = (pd.Series(returns) for returns in (found[detail].iloc[0], base))
            rows.append(_row(method, "reference", value, *episodes))
    return pd.DataFrame(rows)


def gain(rows: pd.DataFrame, method: str, over: str, trust_region: float | None = None) -> dict:
    """The one row of `gains` with that method, comparison and λ; ValueError if there is none."""
    require_kind("rows", rows, pd.DataFrame, "gains(records)")
    require_text("method", method)
    require_text("over", over)
    if trust_region is not None:
        require_number("trust_region", trust_region, 0)
    value = rows["trust_region"]
    same = value.isna() if trust_region is None else value == trust_region
    found = rows[(rows["method"] == method) & (rows["over"] == over) & same]
    if found.empty:
        known = (f"{row.method} over {row.over} at {row.trust_region}" for row in rows.itertuples())
        raise ValueError(
            f"there is no gain of {shown(method)[1:-1]} over {shown(over)[1:-1]} at "
            f"{trust_region}; known: {', '.join(known)}"
        )
    return found.iloc[0].to_dict()


def _searches(rows: pd.DataFrame):
    """(method, λ or None, rows) of every search, in the order of its first row."""
    rows = rows[rows["method"] != "none"]
    groups = rows.groupby(["method", "trust_region"], dropna=False, sort=False)
    for (method, value), found in groups:
        yield method, None if pd.isna(value) else value, found


def _row(method, over, trust_region, after: pd.Series, before: pd.Series) -> dict:
    """The paired gain of one comparison; both by number of the start."""
    if not after.index.equals(before.index):
        raise ValueError(
            f"{method} at lambda {trust_region} has starts {list(after.index)}, {over} has "
            f"{list(before.index)}; both need the same, compute the records again"
        )
    found = paired_gain(np.array(after.tolist()), np.array(before.tolist()))
    row = {"method": method, "over": over, "trust_region": trust_region}
    row |= {"mean": found.mean, "low": found.low, "high": found.high}
    return row | {"pairs": len(after), "positive": int(np.sum(found.differences > 0))}
