"""The learning curve of a run, and its progress line."""

import csv
import io
import os
import sys
import time
from pathlib import Path

import numpy as np

from shapebody.files import atomic_write, names_path
from shapebody.stored import read_text
from shapebody.task.env import Trajectory
from shapebody.training.run_state import ANEW

CURVE = (
    "steps seconds return length tracking_error coefficient reward non_finite kl clipped std "
    "value_loss explained_variance learning_rate steps_per_second"
).split()
"""Columns of the learning curve. return, length, tracking_error (m/s): means over the episodes that
ended since the last row; coefficient and reward: means over steps; non_finite: episodes that
were ended because the simulation became invalid."""

CURVE_INTERVAL = 10
"""Iterations per row of the learning curve."""


def _rows(path: Path) -> tuple[list[dict[str, str]], bool]:
    """The rows of a learning curve as text, and whether others in the file are damaged.

    A last row that a killed run left unfinished is left out and is no damage. No file, no rows.
    """
    if not path.exists():
        return [], False
    try:
        text = read_text(path, ANEW)
    except ValueError:
        return [], True
    # The end of a line is written last; without it, even the last number may be cut off.
    header, *lines = [_cells(line) for line in text.split("\n")[:-1]] or [[]]
    # A file of another version may have other columns; what is no header at all is damaged.
    known = "steps" in header and set(header) <= set(CURVE)
    names = header if known else CURVE
    rows = [dict(zip(names, x, strict=True)) if _is_row(x, names) else None for x in lines]
    whole = [row for row in rows if row is not None]
    unfinished = bool(rows) and rows[-1] is None
    return whole, bool(lines) and not known or len(rows) - len(whole) > unfinished


def _cells(line: str) -> list[str]:
    """Cells of a line; numbers have no quotes."""
    return line.removesuffix("\r").split(",")


def _is_row(cells: list[str], names) -> bool:
    """Whether these are the cells of a row: a number of steps, and numbers or nothing."""
    if len(cells) != len(names):
        return False
    steps = cells[names.index("steps")]
    try:
        [float(cell) for cell in cells if cell]
    except ValueError:
        return False
    return steps.isascii() and steps.isdigit() and len(steps) < 20


class _Curve:
    """Averages over iterations, appended to a CSV file. Rows after the resumed step go.

    A damaged file is kept beside it, and its undamaged rows are used.
    """

    def __init__(self, path: Path, steps: int):
        self.path = path
        rows, damaged = _rows(path)
        if damaged:
            kept = path.with_suffix(".damaged.csv")
            os.replace(path, kept)
            print(f"{path} was damaged: kept as {kept.name}, {len(rows)} rows could be read")
        rows = [row for row in rows if int(row["steps"]) <= steps]
        # Of rows that are there twice, the first.
        rows = list({int(row["steps"]): row for row in reversed(rows)}.values())[::-1]
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, CURVE)
        writer.writeheader()
        writer.writerows(rows)
        atomic_write(path, text.getvalue())
        self.latest = {}
        self.episodes = (0, 0.0, 0.0, 0.0)
        self._clear()

    def _clear(self):
        self.sums, self.count, self.ended = {}, 0, []

    def add(self, trajectory: Trajectory, metrics, seconds, batch):
        done = np.asarray(trajectory.terminated) | np.asarray(trajectory.truncated)
        columns = (
            trajectory.episode_return,
            trajectory.episode_length,
            trajectory.episode_error,
        )
        self.ended.append(np.stack([np.asarray(x)[done] for x in columns], -1))
        values = {
            **metrics,
            "seconds": seconds,
            "batch": batch,
            "coefficient": float(np.mean(trajectory.coefficient)),
            "reward": float(np.mean(trajectory.reward)),
            "non_finite": float(np.sum(~np.asarray(trajectory.finite))),
        }
        self.count += 1
        for name, value in values.items():
            self.sums[name] = self.sums.get(name, 0.0) + value
        # Where no episode has ended since the last row, the last ones that did are shown.
        self.latest = self.latest | self._row()

    def _row(self):
        row = {name: self.sums[name] / self.count for name in CURVE if name in self.sums}
        ended = np.concatenate(self.ended)
        if len(ended):
            row |= dict(
                zip(("return", "length", "tracking_error"), ended.mean(0).tolist(), strict=True)
            )
        row["non_finite"] = self.sums["non_finite"]
        row["steps_per_second"] = self.sums["batch"] / max(self.sums["seconds"], 1e-9)
        return row

    def write(self, steps, seconds):
        row = {"steps": steps, "seconds": round(seconds, 1)}
        row |= {
            name: f"{value:.5g}"
            for name, value in self._row().items()
            if name in CURVE and name != "seconds"
        }
        with names_path(self.path), self.path.open("a", newline="") as file:
            csv.DictWriter(file, CURVE).writerow(row)
        self._clear()


class _Report:
    """One progress line every few seconds, rewritten in place on a terminal.

    last: steps at which the call ends; until: time (`time.monotonic`) at which it does, if earlier.
    """

    def __init__(self, last: int, until: float, active: bool, interval: float = 5.0):
        self.last, self.until, self.active = last, until, active
        self.interactive = sys.stdout.isatty() or "ipykernel" in sys.modules
        self.interval = interval if self.interactive else 12 * interval
        self.next = 0.0

    def show(self, steps: int, curve: _Curve):
        now = time.monotonic()
        if not self.active or now < self.next:
            return
        self.next = now + self.interval
        row = curve.latest
        left = (self.last - steps) / max(row["steps_per_second"], 1e-9)
        left = max(min(left, self.until - now), 0.0)
        ended = "no episode has ended yet"
        if "return" in row:
            ended = f"return {row['return']:6.2f}  xy error {row['tracking_error']:.3f} m/s"
        line = (
            f"{steps:>12,} steps  {ended}  c {row['coefficient']:.2f}  "
            f"{row['steps_per_second']:,.0f} steps/s  {_duration(left)} left"
        )
        print(
            ("\r" if self.interactive else "") + line,
            flush=True,
            end="" if self.interactive else "\n",
        )

    def end(self):
        if self.active and self.interactive:
            print(flush=True)


def _duration(seconds: float) -> str:
    minutes = int(seconds // 60)
    return (
        f"{minutes // 60}h{minutes % 60:02d}"
        if minutes >= 60
        else f"{minutes}m{int(seconds) % 60:02d}"
    )
