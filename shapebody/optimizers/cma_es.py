"""Covariance matrix adaptation evolution strategy (Appendix C: CMA-ES), by the library `cma`.

    m <- start, σ <- initial_std, C <- I, diagonal
    repeat N times
        draw P designs from N(m, σ² C), and score them on a new minibatch of states
        m <- weighted mean of the better half; σ and C follow the paths that m has taken

The library keeps the box by a smooth transformation. What is found is the last mean, which averages
over samples and minibatches: in hundreds of dimensions it is far better than every sample drawn
around it.
"""

from __future__ import annotations

import math
import warnings

import jax
import numpy as np

from shapebody.arguments import require_integer
from shapebody.configuration import Count, Positive, configuration, integer
from shapebody.optimizers.loop import Search, last_finite, score, start_key


@configuration
class CMAESConfig:
    """Settings of CMA-ES; the defaults are the paper's."""

    iterations: Count = 50
    """Number of generations."""
    initial_std: Positive = 0.5
    """Initial step size σ_0."""
    particles: integer(2) | None = None
    """Population size; 4 + ⌊3 ln d⌋ if None."""

    def population(self, dim: int) -> int:
        """Population size for designs of length `dim`, 21 for the Go2's 358."""
        require_integer("dim", dim, 1)
        return int(self.particles or 4 + math.floor(3 * math.log(dim)))


def cma_es(objective, starts, key, config: CMAESConfig) -> Search:
    """CMA-ES with a diagonal covariance, one strategy for each of the starts [S, d]."""
    starts = np.asarray(starts, np.float32)
    particles = config.population(starts.shape[1])
    strategies = [_strategy(start, key, config, particles) for start in starts]
    keys = jax.random.split(key, config.iterations + 1)
    trajectory, history = [starts], []
    for batch_key in keys[:-1]:
        # The mean is scored with the samples, for the history alone.
        asked = np.clip([strategy.ask() for strategy in strategies], -1, 1)
        rows = np.concatenate([trajectory[-1][:, None], asked], axis=1).astype(np.float32)
        values = np.asarray(score(objective, rows, batch_key), np.float64)
        history.append(values[:, 0])
        for strategy, samples, costs in zip(strategies, asked, _costs(values[:, 1:]), strict=True):
            strategy.tell(list(samples), list(costs))
        means = [strategy.result.xfavorite for strategy in strategies]
        trajectory.append(np.clip(means, -1, 1).astype(np.float32))
    history.append(np.asarray(score(objective, trajectory[-1][:, None], keys[-1]))[:, 0])
    trajectory, history = np.stack(trajectory), np.stack(history).astype(np.float32)
    designs = last_finite(trajectory, history)
    return Search(designs, trajectory, history, config.iterations * particles)


def _strategy(start, key, config, particles):
    import cma  # here, because it loads plotting modules

    numbers = np.random.default_rng(np.asarray(jax.random.key_data(start_key(key, start))))
    options = {
        "CMA_diagonal": True,
        "bounds": [-1, 1],
        "popsize": particles,
        "randn": lambda *shape: numbers.standard_normal(shape),
        "seed": np.nan,  # the global random state stays as it is
        "verbose": -9,
        "verb_log": 0,
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return cma.CMAEvolutionStrategy(start.astype(np.float64), config.initial_std, options)


def _costs(values):
    """Costs [S, P] for minimization; a value that is not finite costs more than all others."""
    finite = np.isfinite(values)
    worst = np.max(np.where(finite, -values, -np.inf), axis=1, keepdims=True)
    return np.where(finite, -values, np.where(np.isfinite(worst), worst, 0.0) + 1.0)
