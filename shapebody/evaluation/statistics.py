"""Bootstrap intervals over starts and episodes, paired gains, rank correlation.

The bootstrap of a mean is our own: it is the one-axis case of the bootstrap over starts and
episodes at once, which libraries do not have.
"""

from __future__ import annotations

import warnings
from typing import NamedTuple

import numpy as np

from shapebody.arguments import refuse, require_array, require_integer, require_number, require_seed

CONFIDENCE = 0.95
"""Coverage of all intervals, unless another one is asked for."""
RESAMPLES = 10_000
"""Bootstrap samples of a mean."""
MOST_EPISODES, MOST_RESAMPLES = 1_000_000, 1_000_000
"""Largest numbers of episodes and of bootstrap samples."""


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
    return float_or_array(low), float_or_array(high)


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
    after,
    before,
    *,
    confidence: float = CONFIDENCE,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Gain:
    """Gain in return ΔR of designs `after` over designs `before`, paired by start.

    With [S, E] returns the interval is a bootstrap over the S starts and the E episodes at once:
    all designs have the same episodes, so the luck of these episodes is common to all starts and
    does not average out over them. With [E] returns of one design it is a
    bootstrap over the paired episodes. Evaluate both with the same seed.

    Args:
        after, before: what `evaluate` returned, or arrays of returns [S, E] or [E].
        confidence, resamples, seed: see `bootstrap_interval`.

    Raises:
        ValueError: if the shapes differ, or the two evaluations differ in seed or settings.
    """
    # Two evaluations have to be of the same episodes.
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


def float_or_array(value):
    """A float in place of an array without axes."""
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

    ρ is NaN if x or y is constant; resamples in which one is constant are left out of the interval.

    Raises:
        ValueError: if there are fewer than three pairs, or x and y have different lengths.
    """
    from scipy import stats

    x, y = require_array("x", x).astype(float), require_array("y", y).astype(float)
    require_integer("resamples", resamples, 2, MOST_RESAMPLES)
    require_seed("seed", seed)
    if x.shape != y.shape or x.ndim != 1 or len(x) < 3:
        raise ValueError(f"x {x.shape} and y {y.shape}: expected two lists of three or more pairs")

    def correlation(x, y, axis):
        ranks = (stats.rankdata(values, axis=axis) for values in (x, y))
        return stats.pearsonr(*ranks, axis=axis).statistic

    with warnings.catch_warnings():
        # Of a resample in which x or y is constant.
        warnings.simplefilter("ignore", stats.DegenerateDataWarning)
        rho = stats.spearmanr(x, y).statistic
        samples = stats.bootstrap(
            (x, y),
            correlation,
            n_resamples=resamples,
            paired=True,
            vectorized=True,
            method="percentile",
            rng=np.random.default_rng(seed),
        ).bootstrap_distribution
    samples = samples[np.isfinite(samples)]
    low, high = _percentiles(samples, CONFIDENCE) if len(samples) else (np.nan, np.nan)
    return float(rho), float(low), float(high)
