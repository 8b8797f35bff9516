"""The learning curve of a run, and its progress line."""

import math
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from tqdm import tqdm

from shapebody.files import atomic_write, curve_text, names_path
from shapebody.stored import read_text
from shapebody.task.trajectory import Trajectory
from shapebody.training.diagnosis import Diagnosis
from shapebody.training.run_state import ANEW

# ---------------------------------------------------------------------- the learning curve

CURVE = (
    "steps seconds return length tracking_error coefficient reward non_finite kl clipped std "
    "value_loss explained_variance learning_rate steps_per_second "
    "success_c1 return_c1 success_half return_half"
).split()
"""Columns of the learning curve. return, length, tracking_error (m/s): means over the episodes that
ended since the last row; coefficient and reward: means over steps; non_finite: episodes that
were ended because the simulation became invalid; steps_per_second: without the first iteration of
a call, which compiles; success and return, at c = 1 and c = 0.5: on the bodies of the yardstick,
where it was measured (`training.yardstick`)."""

CURVE_INTERVAL = 10
"""Iterations per row of the learning curve."""


def read_rows(path: Path) -> tuple[list[dict[str, str]], bool]:
    """The rows of a learning curve as text, and whether others in the file are damaged.

    A last row that a killed run left unfinished is left out and does not count as damage. Without
    a file there are no rows.
    """
    if not path.exists():
        return [], False
    try:
        text = read_text(path, ANEW)
    except ValueError:
        return [], True
    # The end of a line is written last; without it, even the last number may be cut off.
    header, *lines = [_cells(line) for line in text.split("\n")[:-1]] or [[]]
    # A file of another version may have other columns; what is not a header at all is damaged.
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


class Curve:
    """Averages over iterations, appended to a CSV file. Rows after the resumed step go.

    A damaged file is kept beside it, and its undamaged rows are used.

    Args:
        path: of the file.
        steps: environment steps of the run that goes on.
    """

    def __init__(self, path: Path, steps: int):
        self.path = path
        rows, damaged = read_rows(path)
        if damaged:
            kept = path.with_suffix(".damaged.csv")
            os.replace(path, kept)
            print(f"{path} was damaged: kept as {kept.name}, {len(rows)} rows could be read")
        rows = [row for row in rows if int(row["steps"]) <= steps]
        # Of rows that are there twice, the first.
        rows = list({int(row["steps"]): row for row in reversed(rows)}.values())[::-1]
        atomic_write(path, curve_text(rows, CURVE))
        self.latest = {}
        self._clear()

    def _clear(self):
        self.sums, self.count, self.ended = {}, 0, []
        self.steps, self.seconds = 0, 0.0

    def add(self, trajectory: Trajectory, metrics: dict, steps: int, seconds: float | None):
        """Take an iteration into account.

        Args:
            trajectory: its rollout.
            metrics: of its update.
            steps: its environment steps.
            seconds: how long it took; None if the time does not count, since it compiled.
        """
        done = np.asarray(trajectory.terminated) | np.asarray(trajectory.truncated)
        columns = (
            trajectory.episode_return,
            trajectory.episode_length,
            trajectory.episode_error,
        )
        self.ended.append(np.stack([np.asarray(x)[done] for x in columns], -1))
        values = {
            **metrics,
            "coefficient": float(np.mean(trajectory.coefficient)),
            "reward": float(np.mean(trajectory.reward)),
            "non_finite": float(np.sum(~np.asarray(trajectory.finite))),
        }
        self.count += 1
        for name, value in values.items():
            self.sums[name] = self.sums.get(name, 0.0) + value
        if seconds is not None:
            self.steps, self.seconds = self.steps + steps, self.seconds + seconds
        # Where no episode has ended since the last row, the last ones that did are shown.
        self.latest = self.latest | self._row()

    def _row(self) -> dict[str, float]:
        row = {name: self.sums[name] / self.count for name in CURVE if name in self.sums}
        ended = np.concatenate(self.ended)
        if len(ended):
            row |= dict(
                zip(("return", "length", "tracking_error"), ended.mean(0).tolist(), strict=True)
            )
        row["non_finite"] = self.sums["non_finite"]
        if self.steps:
            row["steps_per_second"] = self.steps / max(self.seconds, 1e-9)
        return row

    def write(self, steps: int, seconds: float, measured: dict[str, float] | None = None) -> None:
        """Append the averages since the last row, if there are any.

        steps, seconds: of the whole run so far; measured: columns of the yardstick.
        """
        if not self.count:
            return
        self.latest |= measured or {}
        row = self._row() | (measured or {})
        row = {name: f"{value:.5g}" for name, value in row.items()}
        row |= {"steps": str(steps), "seconds": str(round(seconds, 1))}
        line = ",".join(row.get(name, "") for name in CURVE)
        with names_path(self.path), self.path.open("a", newline="") as file:
            file.write(line + "\n")
        self._clear()


# ---------------------------------------------------------------------- the progress line

COMPILATION = {"native": 50, "mjx": 180}
"""Seconds until the first iteration, on two CPU cores and nothing in the compilation cache; for the
robots after the first, a quarter more each."""


def announce(engine: str, robots: int, progress: bool) -> None:
    """Say that compilation comes first, and about how long it takes."""
    if progress:
        seconds = COMPILATION.get(engine, COMPILATION["native"]) * (3 + robots) / 4
        print(
            f"compiling, about {seconds:.0f} s (less if it was compiled before on this machine)",
            flush=True,
        )


class Progress:
    """The progress of one call: a line that is rewritten in a terminal or notebook.

    Where the output is neither, at most one line a minute is printed, and one at the end. Speed
    and time left are measured from the second iteration on: the first one compiles.

    Args:
        last: environment steps at which the call ends.
        until: time (`time.monotonic`) at which it does, if that is earlier.
        active: whether anything is shown.
    """

    def __init__(self, last: int, until: float, active: bool):
        self.last, self.until, self.active = last, until, active
        self.first = None  # steps after the first iteration, and when that was
        self.bar = None
        self.walks = False

    def __enter__(self) -> "Progress":
        return self

    def __exit__(self, *_) -> None:
        """Show the last state."""
        if self.bar is not None:
            self.bar.close()

    def show(self, steps: int, curve: Curve) -> None:
        """Note that the run has `steps` environment steps, and show it if it is time to."""
        if not self.active:
            return
        if self.bar is None:
            self.first = steps, time.monotonic()
            self.bar = _Bar(self._text(steps, curve.latest))
            return
        self.bar.set_description_str(self._text(steps, curve.latest), refresh=False)
        self.bar.update(self._share(steps) - self.bar.n)

    def _share(self, steps: int) -> float:
        """What is behind of the budget that ends first, 0 to 1: that of steps or that of time."""
        first, began = self.first
        of_steps = (steps - first) / max(self.last - first, 1)
        of_time = (time.monotonic() - began) / max(self.until - began, 1e-9)
        return min(max(of_steps, of_time), 1.0)

    def note(self, diagnosis: Callable[[], Diagnosis | None]) -> None:
        """Show what a run has come to on a line of its own, until the robot walks."""
        if self.active and not self.walks:
            found = diagnosis()
            if found is not None:
                tqdm.write(found.sentence(), file=sys.stdout)
                self.walks = found.finding == "walks"

    def _text(self, steps: int, row: dict) -> str:
        text = f"{steps:,} steps  no episode has ended yet"
        if "return" in row:
            text = (
                f"{steps:,} steps  return {row['return']:.2f}  "
                f"xy error {row['tracking_error']:.3f} m/s"
            )
        text += f"  c {row['coefficient']:.2f}"
        if "success_c1" in row:
            text += f"  walks {row['success_c1']:.0%} of all bodies"
        done, now = steps - self.first[0], time.monotonic()
        if done:
            rate = done / max(now - self.first[1], 1e-9)
            left = max(min((self.last - steps) / rate, self.until - now), 0.0)
            text += f"  {rate:,.0f} steps/s  {tqdm.format_interval(left)} left"
        return text


class _Bar(tqdm):
    """tqdm's bar on stdout, as lines where that is neither a terminal nor a notebook."""

    monitor_interval = 0  # no thread of its own, which would print more often

    def __init__(self, text: str):
        interactive = sys.stdout.isatty() or "ipykernel" in sys.modules
        super().__init__(
            desc=text,
            total=1.0,
            file=sys.stdout if interactive else _Lines(),
            mininterval=1 if interactive else 60,
            miniters=0,
            maxinterval=math.inf,
            bar_format="{percentage:3.0f}%|{bar:12}| {desc}" if interactive else "{desc}",
            dynamic_ncols=interactive,
        )


class _Lines:
    """A file that makes lines of what tqdm writes over and over in one."""

    def __init__(self):
        self.last = ""

    def write(self, text: str) -> None:
        text = text.strip()
        if text and text != self.last:
            print(text)
            self.last = text

    def flush(self) -> None:
        sys.stdout.flush()
