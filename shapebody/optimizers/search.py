"""All search methods behind one function.

A method is a function `method(objective, starts [S, d], key, config) -> Search`. It may ask the
objective for minibatches of states (`objective.batch(key)`), values (`objective(designs, states)`)
and their gradients, keeps designs inside [-1, 1] and returns one design per start, which does not
depend on the other starts. What it returns is its own last recommendation: the last iterate of an
ascent (VGDS, ARS), the mean of a distribution (CEM, CMA-ES), the best design of a population or of
all draws.

To add a method:

1. Write a module with a `@configuration` class of its settings, of which `iterations` is one.
2. Write its function there. If the method proposes designs and learns from their scores, that is
   one call of `loop.iterate` with three small functions: `cem` is a short example. Otherwise write
   the loop yourself, as `vgds` does.
   `Search.evaluations` counts the scores that the method uses. That of the current recommendation,
   `Scored.current`, counts only if it is used, as in `turbo`, and not if it only fills `history`.
3. Enter both in `METHODS`. `search`, the design studies and the tests of all methods
   (tests/test_baselines.py) then know it.
4. Give it a colour and a label in `show.study_plots.METHOD_STYLES`, for the notebooks' figures.
"""

from __future__ import annotations

import dataclasses
import difflib
import hashlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from shapebody.agent.agent import Agent
from shapebody.arguments import require_seed, shown
from shapebody.optimizers.ars import ARSConfig, ars
from shapebody.optimizers.bayesian import BOConfig, bo
from shapebody.optimizers.cem import CEMConfig, cem
from shapebody.optimizers.cma_es import CMAESConfig, cma_es
from shapebody.optimizers.de import DEConfig, de
from shapebody.optimizers.gc_pfo import GCPFOConfig, gc_pfo
from shapebody.optimizers.loop import Search
from shapebody.optimizers.objective import Objective
from shapebody.optimizers.pso import PSOConfig, pso
from shapebody.optimizers.random_search import RandomConfig, random
from shapebody.optimizers.turbo import TuRBOConfig, turbo
from shapebody.optimizers.vgds import VGDSConfig, penalty_only, vgds
from shapebody.robot.robot import Robot
from shapebody.task.observations import Observation


class Method(NamedTuple):
    """A search method and the dataclass of its settings."""

    function: Callable[[Objective, jax.Array, jax.Array, Any], Search]
    config: type


METHODS: dict[str, Method] = {
    "vgds": Method(vgds, VGDSConfig),
    "penalty-only": Method(penalty_only, VGDSConfig),
    "random": Method(random, RandomConfig),
    "bo": Method(bo, BOConfig),
    "cma-es": Method(cma_es, CMAESConfig),
    "turbo": Method(turbo, TuRBOConfig),
    "pso": Method(pso, PSOConfig),
    "cem": Method(cem, CEMConfig),
    "de": Method(de, DEConfig),
    "ars": Method(ars, ARSConfig),
    "gc-pfo": Method(gc_pfo, GCPFOConfig),
}


@dataclass(frozen=True, eq=False)
class SearchResult:
    """Outcome of a search from one design [d] or from S designs [S, d]; NumPy arrays, float32."""

    design: np.ndarray
    """The found design(s), [d] or [S, d]."""
    trajectory: np.ndarray
    """Designs from the start (row 0) to the end, [N + 1, d] or [N + 1, S, d]."""
    objective: np.ndarray | float
    """Ĵ_λ of `design` on the whole state bank, a float or [S]."""
    history: np.ndarray
    """Ĵ_λ along the trajectory, each on the minibatch of its iteration, [N + 1] or [N + 1, S]."""
    evaluations: int
    """Number of designs that the method scored per start, each on one minibatch. Scores that only
    fill `history` are not counted."""
    seconds: float
    """Wall time of the search for all starts, compilation included."""
    compile_seconds: float
    """The part of it that went into compilation; 0 if a search of the same kind (method, settings,
    robot, size of the critic; VGDS also: number of starts) ran before."""
    method: str
    """Name of the method."""
    settings: dict
    """All settings, including trust_region, seed, batch_size and the agent's hash. `reference` is
    None if it was not given, else the first 16 digits of the SHA-256 of f_ref as float32;
    `states_hash` is that of the agent's states, or of those given instead."""


def search(
    method: str,
    agent: Agent,
    robot: Robot,
    f,
    *,
    trust_region: float = 100.0,
    reference=None,
    seed: int = 0,
    batch_size: int = 64,
    states: Observation | None = None,
    frozen: tuple[str, ...] = (),
    **settings,
) -> SearchResult:
    """Search for a better design with a frozen agent (Section 3.2; baselines: Appendix C).

    Args:
        method: a name in `METHODS`: "vgds"; "penalty-only", which is VGDS without the critic; or a
            baseline that maximizes the same objective: "random", "bo", "cma-es", "turbo", "pso",
            "cem", "de", "ars", "gc-pfo". The defaults of every method are the paper's settings.
            "bo" needs PyTorch (the extra `bo`).
        agent: the frozen agent; its critic judges designs on the states of its state bank.
        robot: the robot to be designed.
        f: start design(s) [d] or [S, d] in [-1, 1]; several are searched at once, each on its own.
        trust_region: penalty coefficient λ >= 0.
        reference: f_ref [d], the anchor of the trust region; f = 0 if not given.
        seed: of the minibatches and of the method's own random numbers.
        batch_size: states per minibatch.
        states: state bank to use instead of the agent's (see `state_bank.bank`).
        frozen: parameters that stay as they are in f_ref, in the starts too, such as ("size",) or
            ("Torque limit", "Trunk"); see `DesignSpace.frozen`. None in the paper.
        **settings: fields of the method's configuration, such as iterations=50.

    Raises:
        ValueError: for an unknown method or setting, a wrong design or reference, a negative λ, or
            an agent that does not fit the robot.
        ImportError: for "bo" without PyTorch and BoTorch.
    """
    # What is asked for: the method with its settings, the objective, the starts.
    function, config = _method(method, settings)
    require_seed("seed", seed)
    objective = Objective.of(agent, robot, trust_region, reference, states, batch_size, frozen)
    starts = objective.design_critic.space.validate(f)
    if starts.ndim > 2 or len(starts) == 0:
        raise ValueError(
            f"f has shape {starts.shape}; expected one design [{objective.dim}] or at least one "
            f"row of [S, {objective.dim}]"
        )
    single, starts = starts.ndim == 1, np.asarray(objective.hold(starts))

    # The search, timed.
    began, compiled = time.perf_counter(), _compilation.seconds
    found = function(objective, jnp.atleast_2d(starts), jax.random.key(seed), config)
    # Methods that draw designs leave noise in entries that the objective does not see.
    held = (objective.hold(found.designs), objective.hold(found.trajectory))
    found = jax.block_until_ready(Search(*held, found.history, found.evaluations))
    seconds = time.perf_counter() - began
    compile_seconds = min(_compilation.seconds - compiled, seconds)

    # The result, without the axis of starts if one design was given.
    objectives = np.asarray(objective(found.designs))

    def out(values, axis):
        values = np.asarray(values)
        return values.take(0, axis) if single else values

    return SearchResult(
        design=out(found.designs, 0),
        trajectory=out(found.trajectory, 1),
        objective=float(objectives[0]) if single else objectives,
        history=out(found.history, 1),
        evaluations=int(found.evaluations),
        seconds=seconds,
        compile_seconds=compile_seconds,
        method=method,
        settings={
            **dataclasses.asdict(config),
            "trust_region": float(trust_region),
            "reference": None if reference is None else _short_hash(objective.reference),
            "seed": seed,
            "frozen": tuple(frozen),
            "batch_size": objective.batch_size,
            "states": objective.num_states,
            "states_hash": _states_hash(agent, states),
            "robot": robot.name,
            "agent": agent.name,
            "agent_hash": agent.hash,
        },
    )


def _short_hash(design) -> str:
    return hashlib.sha256(np.asarray(design, "<f4").tobytes()).hexdigest()[:16]


def _states_hash(agent: Agent, states: Observation | None) -> str | None:
    """SHA-256 of the agent's state bank, or of the `states` that were given instead."""
    if states is not None:
        owners = np.zeros(len(states.general), np.int32)
        agent = dataclasses.replace(agent, states=states, state_robots=owners)
    return agent.states_hash


class _Compilation:
    """Sums the seconds that JAX spends on tracing, lowering and compiling."""

    def __init__(self):
        self.seconds = 0.0
        jax.monitoring.register_event_duration_secs_listener(self.add)

    def add(self, event: str, duration: float, **_):
        if event.startswith("/jax/core/compile/"):
            self.seconds += duration


_compilation = _Compilation()


def _method(name: str, settings: dict):
    if not isinstance(name, str) or name not in METHODS:
        close = difflib.get_close_matches(str(name)[:100], METHODS, n=1)
        hint = f"; did you mean {close[0]!r}?" if close else "."
        raise ValueError(f"there is no method {shown(name)}{hint} Methods: {', '.join(METHODS)}")
    function, kind = METHODS[name]
    known = [field.name for field in dataclasses.fields(kind)]
    unknown = [setting for setting in settings if setting not in known]
    if unknown:
        raise ValueError(
            f"method {name!r} has no setting {unknown[0]!r}; its settings are {', '.join(known)}"
        )
    return function, kind(**settings)
