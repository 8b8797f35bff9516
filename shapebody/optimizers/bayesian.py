"""Bayesian optimization (Appendix C: BO), by the library BoTorch, an optional dependency.

    score the start and Sobol points on the first minibatch of states
    repeat N times
        fit a Gaussian process to all scored designs
        choose the design with the highest expected improvement, and score it on a new minibatch

The Gaussian process is BoTorch's SingleTaskGP with a Matérn 5/2 kernel, one length scale per
parameter and BoTorch's priors; the acquisition function is qLogNoisyExpectedImprovement with q = 1.
"""

from __future__ import annotations

import warnings

import jax
import numpy as np

from shapebody.configuration import Count, configuration, integer
from shapebody.optimizers.loop import Search, cores, last_finite, score, start_key

PROCESSES = 4
"""Most Python processes that a search starts."""


@configuration
class BOConfig:
    """Settings of Bayesian optimization; the defaults are the paper's."""

    iterations: Count = 50
    """Designs chosen by the acquisition function, one per iteration."""
    initial_points: integer(2) = 10
    """Points before the first iteration: the start design, then Sobol points."""
    restarts: Count = 8
    """Starting points of the acquisition function's optimization."""
    raw_samples: Count = 256
    """Points among which these are chosen."""
    steps: Count = 50
    """Most steps of that optimization; not given in the paper. BoTorch's 200 take three times as
    long."""


def bo(objective, starts, key, config: BOConfig) -> Search:
    """Bayesian optimization, with a Gaussian process of its own for every start [S, d].

    Returns the scored design with the highest posterior mean, since every value is of another
    minibatch. Designs whose value is not finite are not shown to the Gaussian process.

    The Gaussian processes of different starts are fitted side by side, in up to `PROCESSES` Python
    processes, of some hundred megabytes each; the objective is computed in this one.

    Raises:
        ImportError: if PyTorch, BoTorch or joblib is not installed.
    """
    _require_botorch()
    from joblib import Parallel, delayed
    from joblib.externals.loky import get_reusable_executor

    starts = np.asarray(starts, np.float32)
    keys = jax.random.split(key, config.iterations + 1)
    surrogates = [_Surrogate(start, start_key(key, start), config) for start in starts]
    designs = [surrogate.initial() for surrogate in surrogates]
    trajectory, history = [], []
    # Not threads, which would share PyTorch's random numbers.
    processes = min(cores(), len(starts), PROCESSES)
    try:
        with (
            warnings.catch_warnings(),
            Parallel(n_jobs=processes, backend="loky") as parallel,
        ):
            # joblib replaces a process that has grown; its work is done all the same.
            warnings.filterwarnings("ignore", message="A worker stopped while some jobs")
            for iteration, batch_key in enumerate(keys):
                values = np.asarray(score(objective, np.stack(designs), batch_key))
                turns = parallel(
                    delayed(_turn)(*scored, last=iteration == config.iterations)
                    for scored in zip(surrogates, designs, values, strict=True)
                )
                surrogates, best, designs = zip(*turns, strict=True)
                if iteration == 0:  # the first of the initial points
                    best = starts
                else:
                    values = np.asarray(score(objective, np.stack(best)[:, None], batch_key))
                trajectory.append(np.stack(best))
                history.append(values[:, 0])
    finally:
        if processes > 1:
            # joblib would keep the processes, and their memory, for minutes.
            get_reusable_executor().shutdown(wait=True)
    trajectory, history = np.stack(trajectory), np.stack(history)
    found = last_finite(trajectory, history)
    return Search(found, trajectory, history, config.initial_points + config.iterations)


class _Surrogate:
    """What one start knows: its scored designs and where the last fit to them ended."""

    def __init__(self, start, key, config):
        self.config = config
        self.start = start
        self.seeds = np.random.default_rng(np.asarray(jax.random.key_data(key)))
        self.designs, self.values = [], []
        self.hyperparameters = None

    def seed(self) -> int:
        """A new seed for one of the library's random numbers."""
        return int(self.seeds.integers(2**31))

    def initial(self) -> np.ndarray:
        """The start and Sobol points, float32 [P, d]."""
        from botorch.utils.sampling import draw_sobol_samples

        bounds = _bounds(len(self.start), -1.0)
        points = draw_sobol_samples(bounds, self.config.initial_points - 1, 1, seed=self.seed())
        return np.concatenate([self.start[None], points[:, 0].numpy()]).astype(np.float32)

    def add(self, designs, values) -> None:
        """Take scored designs [P, d] with values [P]."""
        finite = np.isfinite(values)
        self.designs.extend(designs[finite])
        self.values.extend(values[finite])

    def fit(self):
        """Gaussian process in [0, 1]^d, fitted from where the last fit ended."""
        import torch
        from botorch.fit import fit_gpytorch_mll
        from botorch.models import SingleTaskGP
        from botorch.models.utils.gpytorch_modules import get_covar_module_with_dim_scaled_prior
        from gpytorch.mlls import ExactMarginalLogLikelihood

        kernel = get_covar_module_with_dim_scaled_prior(len(self.start), use_rbf_kernel=False)
        model = SingleTaskGP(
            torch.tensor((np.stack(self.designs) + 1) / 2, dtype=torch.float64),
            torch.tensor(np.stack(self.values), dtype=torch.float64)[:, None],
            covar_module=kernel,
        )
        if self.hyperparameters is not None:
            for name, parameter in model.named_parameters():
                parameter.data.copy_(self.hyperparameters[name])
        fit_gpytorch_mll(ExactMarginalLogLikelihood(model.likelihood, model))
        self.hyperparameters = {name: p.detach() for name, p in model.named_parameters()}
        return model.eval()

    def propose(self, model) -> np.ndarray:
        """The design that maximizes the acquisition function, float32 [1, d]."""
        import torch
        from botorch.acquisition.logei import qLogNoisyExpectedImprovement
        from botorch.optim import optimize_acqf
        from botorch.sampling import SobolQMCNormalSampler
        from botorch.utils.sampling import manual_seed

        sampler = SobolQMCNormalSampler(torch.Size([128]), seed=self.seed())
        with manual_seed(self.seed()):
            acquisition = qLogNoisyExpectedImprovement(
                model, model.train_inputs[0], sampler=sampler
            )
            point, _ = optimize_acqf(
                acquisition,
                _bounds(len(self.start), 0.0),
                q=1,
                num_restarts=self.config.restarts,
                raw_samples=self.config.raw_samples,
                options={"maxiter": int(self.config.steps)},
            )
        return np.clip(2 * point.numpy() - 1, -1, 1).astype(np.float32)


def _turn(surrogate: _Surrogate, designs, values, last: bool):
    """Learn from scored designs [P, d]; returns (surrogate, best design [d], next designs [1, d]).

    The best is the scored design with the highest posterior mean, or the start if none has a
    finite value. After the `last` turn nothing new is proposed.
    """
    import torch

    surrogate.add(designs, values)
    if not surrogate.values:
        return surrogate, surrogate.start, surrogate.initial()[1:2]
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # the matrices are small; more threads only wait for each other
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model = surrogate.fit()
            mean = model.posterior(model.train_inputs[0]).mean
            best = surrogate.designs[int(mean.argmax())]
            return surrogate, best, designs[:1] if last else surrogate.propose(model)
    finally:
        torch.set_num_threads(threads)


def _bounds(dim, low):
    import torch

    return torch.tensor([[low], [1.0]], dtype=torch.float64).expand(2, dim).contiguous()


def _require_botorch():
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            import botorch  # noqa: F401
            import joblib  # noqa: F401
    except ImportError as error:
        raise ImportError(
            "method 'bo' needs PyTorch and BoTorch, which are not part of environment.lock; "
            "install them, in the folder of this repository, with: "
            ".venv/bin/python -m pip install -e '.[bo]'"
        ) from error
