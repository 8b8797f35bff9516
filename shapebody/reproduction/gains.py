"""What designs gain over their start, the reference and the penalty alone."""

import numpy as np

from shapebody.arguments import require_number, require_records, require_text, shown
from shapebody.evaluation.statistics import paired_gain


def gains(records: list[dict], quantity: str = "return") -> list[dict]:
    """Gains in return ΔR with 95 % intervals, from the records of `design_study`.

    Args:
        records: of one robot.
        quantity: "return"; or another number of a record, such as "tracking_error", for
            comparisons between starts (those from the reference are left out).

    Returns:
        One record per comparison: method, over ("start", "penalty-only" or "reference"),
        trust_region (None where none was used), mean, low and high of the paired difference,
        the number of pairs, and how many of them are positive. The pairs are the starts; for the
        search from the reference they are the episodes of one pair of designs. Intervals of
        returns are over starts and episodes (`paired_gain`), those of other quantities over starts
        alone, which leaves out the luck with the episodes that all starts share.

    Raises:
        ValueError: if a design has no counterpart to be compared with, or the records come from
            two engines.
    """
    records = require_records("records", records, ("origin", "method", "trust_region", "start"))
    require_text("quantity", quantity)
    # Returns are stored by episode, other quantities as means.
    detail = "returns" if quantity == "return" else quantity
    for record in records:
        if detail not in record:
            raise ValueError(f"quantity is {shown(quantity)}; expected one of {', '.join(record)}")
    found: dict = {}
    for record in records:
        if record["origin"] == "start":
            key = record["method"], record["trust_region"]
            found.setdefault(key, {})[record["start"]] = record[detail]
    reference = [r for r in records if r["origin"] == "reference"]
    base = [r for r in reference if r["method"] == "none"]
    initial = found.get(("none", None), {})
    engines = sorted({r["engine"] for r in records if "engine" in r})
    if len(engines) > 1:
        raise ValueError(
            f"the records come from the engines {', '.join(engines)}, whose episodes are not the "
            "same; compute all of them with one (recompute=True)"
        )
    if len(base) != 1 or not initial:
        raise ValueError(
            f"the records hold {len(base)} evaluations of the reference and {len(initial)} of "
            "starts; expected one and at least one, as design_study returns them"
        )
    rows = []

    def compare(method, over, trust_region, after, before):
        if after.keys() != before.keys():
            raise ValueError(
                f"{method} at lambda {trust_region} has starts {sorted(after)}, {over} has "
                f"{sorted(before)}; both need the same, compute the records anew"
            )
        order = sorted(after)
        gain = paired_gain([after[i] for i in order], [before[i] for i in order])
        row(method, over, trust_region, *gain[:3], len(order), int(np.sum(gain.differences > 0)))

    def row(method, over, trust_region, mean, low, high, pairs, positive):
        values = dict(mean=mean, low=low, high=high, pairs=pairs, positive=positive)
        rows.append({"method": method, "over": over, "trust_region": trust_region, **values})

    compare("reference", "start", None, dict.fromkeys(initial, base[0][detail]), initial)
    for (method, trust_region), after in found.items():
        if method == "none":
            continue
        compare(method, "start", trust_region, after, initial)
        if method != "penalty-only":
            control = found.get(("penalty-only", None))
            if control is not None:
                compare(method, "penalty-only", trust_region, after, control)
    for r in reference:
        if r["method"] != "none" and quantity == "return":
            own = paired_gain(r["returns"], base[0]["returns"])
            positive = int(np.sum(own.differences > 0))
            row(r["method"], "reference", r["trust_region"], *own[:3], len(r["returns"]), positive)
    return rows


def gain(rows: list[dict], method: str, over: str, trust_region: float | None = None) -> dict:
    """The one row of `gains` with that method, comparison and λ; ValueError if there is none."""
    require_text("method", method)
    require_text("over", over)
    if trust_region is not None:
        require_number("trust_region", trust_region, 0)
    wanted = {"method": method, "over": over, "trust_region": trust_region}
    rows = require_records("rows", rows, wanted)
    for row in rows:
        if all(row[name] == value for name, value in wanted.items()):
            return row
    known = ", ".join(f"{r['method']} over {r['over']} at {r['trust_region']}" for r in rows)
    raise ValueError(
        f"there is no gain of {shown(method)[1:-1]} over {shown(over)[1:-1]} at {trust_region}; "
        f"known: {known or 'none'}"
    )
