"""Bootstrap intervals over starts and episodes, paired gains, rank correlation."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from shapebody.arguments import refuse, require_array, require_integer, require_number, require_seed

if TYPE_CHECKING:
    from shapebody.evaluation.evaluate import Evaluation

CONFIDENCE = 0.95

RESAMPLES = 10_000

MOST_EPISODES, MOST_RESAMPLES = 1_000_000, 1_000_000


def bootstrap_interval(
    values,
    baseline=None,
    *,
    confidence: float = CONFIDENCE,
    resamples: int = RESAMPLES,
    seed: int = 0,
):
    """Percentile bootstrap interval of a mean over the last axis.

    Args:
        values: [..., n] independent numbers, such as the returns of n episodes or of n starts.
        baseline: [..., n] numbers paired with them; the interval is then that of the mean
            difference values - baseline.
        confidence: coverage, between 0 and 1.
        resamples: number of bootstrap samples.
        seed: of the resampling; the same resamples are used for all leading axes.

    Returns:
        (low, high), floats or arrays [...].

    Raises:
        ValueError: for empty or non-finite values, a baseline of another shape, a confidence
            outside (0, 1).
    """
    values = _differences(values, baseline)
    _require_resampling(confidence, resamples, seed)
    weights = _resampled(np.random.default_rng(seed), values.shape[-1], resamples)
    low, high = _percentiles(values @ weights.T, confidence)
    return _out(low), _out(high)


def _require_resampling(confidence, resamples, seed) -> None:
    if require_number("confidence", confidence, 0, 1) in (0, 1):
        raise ValueError(f"confidence is {confidence!r}; expected a number between 0 and 1")
    require_integer("resamples", resamples, 1, MOST_RESAMPLES)
    require_seed("seed", seed)


def _resampled(rng, n: int, resamples: int):
    """Weights [resamples, n]: how often each of n numbers was drawn, over n."""
    return rng.multinomial(n, np.full(n, 1 / n), size=resamples) / n


def _percentiles(means, confidence: float):
    tail = (1 - confidence) / 2
    return np.quantile(means, [tail, 1 - tail], axis=-1)


class Gain(NamedTuple):
    """A mean paired difference and its interval."""

    mean: float
    low: float
    high: float
    differences: np.ndarray
    """[S], one per start (or [E], one per episode of a single design)."""


def paired_gain(
    after: Evaluation | np.ndarray,
    before: Evaluation | np.ndarray,
    *,
    confidence: float = CONFIDENCE,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Gain:
    """Gain in return ΔR of designs `after` over designs `before`, paired by start.

    With [S, E] returns the interval is a bootstrap over the S starts and the E episodes at once:
    all designs live through the same episodes, so what these episodes happen to favour is common
    to all starts and does not average out over them. With [E] returns of one design it is a
    bootstrap over the paired episodes. Evaluate both with the same seed.

    Raises:
        ValueError: if the shapes differ, or the two evaluations had other seeds or settings.
    """
    if hasattr(after, "returns") and hasattr(before, "returns"):
        for name in ("robot", "engine", "seed", "coefficient", "task"):
            if after.settings[name] != before.settings[name]:
                raise ValueError(
                    f"the evaluations differ in {name}: {after.settings[name]!r} and "
                    f"{before.settings[name]!r}; repeat one with the settings of the other"
                )
    _require_resampling(confidence, resamples, seed)
    after, before = (getattr(x, "returns", x) for x in (after, before))
    if before is None:
        raise refuse("before", before, "an evaluation or an array of numbers")
    differences = _differences(after, before, ("after", "before"))
    if differences.ndim > 2:
        raise ValueError(f"returns have shape {differences.shape}; expected [E] or [S, E]")
    if differences.ndim == 1:
        low, high = bootstrap_interval(
            differences, confidence=confidence, resamples=resamples, seed=seed
        )
    else:
        rng = np.random.default_rng(seed)
        starts, episodes = (_resampled(rng, n, resamples) for n in differences.shape)
        means = np.sum(starts @ differences * episodes, axis=-1)
        low, high = map(float, _percentiles(means, confidence))
        differences = differences.mean(-1)
    return Gain(float(differences.mean()), low, high, differences)


def _differences(values, baseline, names=("values", "baseline")):
    """values - baseline, float64 [..., n]; ValueError naming the argument that is wrong."""
    values = require_array(names[0], values, ("...", "n")).astype(np.float64)
    if baseline is None:
        return values
    baseline = require_array(names[1], baseline).astype(np.float64)
    if baseline.shape != values.shape:
        raise ValueError(
            f"{names[0]} {values.shape} and {names[1]} {baseline.shape} have different shapes; "
            "paired numbers need the same"
        )
    return values - baseline


def _out(value):
    return float(value) if np.ndim(value) == 0 else value


def verdict(low: float, high: float) -> str:
    """What an interval of a difference allows to say about its sign."""
    if require_number("low", low) > require_number("high", high):
        raise ValueError(f"low is {low} and high is {high}; expected low <= high")
    if low > 0:
        return "positive: the whole interval is above zero"
    if high < 0:
        return "negative: the whole interval is below zero"
    return "not settled: the interval contains zero"


def rank_correlation(x, y, resamples: int = 2000, seed: int = 0) -> tuple[float, float, float]:
    """Spearman's ρ of x and y [n] and its 95 % bootstrap interval over pairs: (ρ, low, high).

    NaN where ρ does not exist because x or y is constant. Raises ValueError below three pairs.
    """
    from scipy.stats import rankdata

    x, y = require_array("x", x).astype(float), require_array("y", y).astype(float)
    require_integer("resamples", resamples, 1, 1_000_000)
    require_seed("seed", seed)
    if x.shape != y.shape or x.ndim != 1 or len(x) < 3:
        raise ValueError(f"x {x.shape} and y {y.shape}: expected two lists of three or more pairs")

    def correlation(x, y):
        a, b = (rankdata(v, axis=-1) for v in (x, y))
        a, b = (v - v.mean(-1, keepdims=True) for v in (a, b))
        scale = np.sqrt((a * a).sum(-1) * (b * b).sum(-1))
        return np.where(scale > 0, (a * b).sum(-1) / np.where(scale > 0, scale, 1.0), np.nan)

    chosen = np.random.default_rng(seed).integers(0, len(x), (resamples, len(x)))
    samples = correlation(x[chosen], y[chosen])
    samples = samples[np.isfinite(samples)]
    low, high = np.quantile(samples, [0.025, 0.975]) if len(samples) else (np.nan, np.nan)
    return float(correlation(x, y)), float(low), float(high)
