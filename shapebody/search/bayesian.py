"""Bayesian optimization (Appendix C: BO), by the library BoTorch, an optional dependency."""

from __future__ import annotations

import contextlib
import warnings
from dataclasses import dataclass

import jax
import numpy as np

from shapebody.search.loop import Search, last_finite, require_integers, score, start_key


@dataclass(frozen=True)
class BOConfig:
    """Settings of Bayesian optimization; the defaults are the paper's."""

    iterations: int = 50
    """Designs chosen by the acquisition function, one per iteration."""
    initial_points: int = 10
    """Points before the first iteration: the start design, then Sobol points."""
    restarts: int = 8
    """Starting points of the acquisition function's optimization."""
    raw_samples: int = 256
    """Points among which these are chosen."""
    steps: int = 50
    """Most steps of that optimization. The paper does not say; BoTorch's 200 take three times as
    long."""

    def __post_init__(self):
        require_integers(self, "iterations", "restarts", "raw_samples", "steps")
        require_integers(self, "initial_points", least=2)


def bo(objective, starts, key, config: BOConfig) -> Search:
    """Bayesian optimization, with a Gaussian process of its own for every start [S, d].

    BoTorch's SingleTaskGP with a Matérn 5/2 kernel, one length scale per parameter and BoTorch's
    priors, and qLogNoisyExpectedImprovement with q = 1. Returns the scored design with the highest
    posterior mean, since every value is of another minibatch. Designs whose value is not finite
    are not shown to the Gaussian process.

    Raises:
        ImportError: if PyTorch or BoTorch is not installed.
    """
    with _torch():
        return _bo(objective, np.asarray(starts, np.float32), key, config)


def _bo(objective, starts, key, config):
    keys = jax.random.split(key, config.iterations + 1)
    processes = [_Process(start, start_key(key, start), config) for start in starts]
    designs = np.stack([process.initial() for process in processes])
    values = np.asarray(score(objective, designs, keys[0]))
    trajectory, history = [starts], [values[:, 0]]
    for process, own_designs, own_values in zip(processes, designs, values, strict=True):
        process.add(own_designs, own_values)
    for batch_key in keys[1:]:
        designs = np.stack([process.propose() for process in processes])
        values = np.asarray(score(objective, designs, batch_key))
        for process, own_designs, own_values in zip(processes, designs, values, strict=True):
            process.add(own_designs, own_values)
        trajectory.append(np.stack([process.best() for process in processes]))
        history.append(np.asarray(score(objective, trajectory[-1][:, None], batch_key))[:, 0])
    trajectory, history = np.stack(trajectory), np.stack(history)
    found = last_finite(trajectory, history)
    return Search(found, trajectory, history, config.initial_points + config.iterations)


class _Process:
    """What one start knows: its scored designs and their Gaussian process in [0, 1]^d."""

    def __init__(self, start, key, config):
        self.config = config
        self.start = start
        self.seeds = np.random.default_rng(np.asarray(jax.random.key_data(key)))
        self.designs, self.values = [], []
        self.model = None

    def seed(self) -> int:
        return int(self.seeds.integers(2**31))

    def initial(self) -> np.ndarray:
        """The start and Sobol points, float32 [P, d]."""
        from botorch.utils.sampling import draw_sobol_samples

        bounds = _bounds(len(self.start), -1.0)
        points = draw_sobol_samples(bounds, self.config.initial_points - 1, 1, seed=self.seed())
        return np.concatenate([self.start[None], points[:, 0].numpy()]).astype(np.float32)

    def add(self, designs, values) -> None:
        """Take scored designs [P, d] with values [P] and fit the Gaussian process anew."""
        finite = np.isfinite(values)
        self.designs.extend(designs[finite])
        self.values.extend(values[finite])
        if finite.any():
            self.model = _fit(np.stack(self.designs), np.stack(self.values), self.model)

    def propose(self) -> np.ndarray:
        """The design that maximizes the acquisition function, float32 [1, d]."""
        import torch
        from botorch.acquisition.logei import qLogNoisyExpectedImprovement
        from botorch.optim import optimize_acqf
        from botorch.sampling import SobolQMCNormalSampler
        from botorch.utils.sampling import manual_seed

        if self.model is None:
            return self.initial()[1:2]
        sampler = SobolQMCNormalSampler(torch.Size([128]), seed=self.seed())
        with manual_seed(self.seed()):
            acquisition = qLogNoisyExpectedImprovement(
                self.model, self.model.train_inputs[0], sampler=sampler
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

    def best(self) -> np.ndarray:
        """The scored design [d] with the highest posterior mean; the start if there is none."""
        if self.model is None:
            return self.start
        mean = self.model.posterior(self.model.train_inputs[0]).mean
        return self.designs[int(mean.argmax())]


def _fit(designs, values, before):
    """Gaussian process of designs [P, d] in [-1, 1]^d, fitted from where `before` ended."""
    import torch
    from botorch.fit import fit_gpytorch_mll
    from botorch.models import SingleTaskGP
    from botorch.models.utils.gpytorch_modules import get_covar_module_with_dim_scaled_prior
    from gpytorch.mlls import ExactMarginalLogLikelihood

    kernel = get_covar_module_with_dim_scaled_prior(designs.shape[1], use_rbf_kernel=False)
    model = SingleTaskGP(
        torch.tensor((designs + 1) / 2, dtype=torch.float64),
        torch.tensor(values, dtype=torch.float64)[:, None],
        covar_module=kernel,
    )
    if before is not None:
        hyperparameters = dict(before.named_parameters())
        for name, parameter in model.named_parameters():
            parameter.data.copy_(hyperparameters[name].data)
    fit_gpytorch_mll(ExactMarginalLogLikelihood(model.likelihood, model))
    return model.eval()


def _bounds(dim, low):
    import torch

    return torch.tensor([[low], [1.0]], dtype=torch.float64).expand(2, dim).contiguous()


@contextlib.contextmanager
def _torch():
    """PyTorch on one thread, without the warnings of its modules and optimizers."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            import botorch  # noqa: F401
            import torch
        except ImportError as error:
            raise ImportError(
                "method 'bo' needs PyTorch and BoTorch, which are not part of environment.lock; "
                "install them with: pip install 'shapebody[bo]' (in this repository: "
                ".venv/bin/python -m pip install -e '.[bo]')"
            ) from error
        threads = torch.get_num_threads()
        torch.set_num_threads(1)  # the matrices are small; more threads only wait for each other
        try:
            yield
        finally:
            torch.set_num_threads(threads)
