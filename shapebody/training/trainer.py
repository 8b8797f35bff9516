"""Training: PPO over randomized designs (Section 3.1, Appendix A), and policy evaluation.

One iteration collects a rollout of every environment, computes advantages with the current
critic, and takes several epochs of minibatch steps. A minibatch holds whole environments, so
that a design is encoded once for all its steps.

On a CPU, an actor thread collects the next rollout while the learner works on the last one.
The actor's policy is then one update old. The loss accounts for that as decoupled PPO does:
the trust region is around the policy at the start of the update, and the ratio of that policy
to the actor's enters as a truncated importance weight.

The second phase, policy evaluation, freezes the policy and trains critics alone on rollouts
over the full design space.
"""

import contextlib
import json
import math
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import jax
import numpy as np

from shapebody.agent.agent import Agent
from shapebody.agent.store import chosen_folder, save_agent
from shapebody.arguments import refuse, require_integer, require_path
from shapebody.configuration import to_json
from shapebody.files import alone_in, atomic_write, load_arrays, save_arrays
from shapebody.networks.critic import Critic
from shapebody.networks.inputs import initialize, standardization
from shapebody.networks.policy import Policy
from shapebody.robot.robot import load_robot
from shapebody.runtime import keep_memory
from shapebody.stored import ARRAYS_LIMIT
from shapebody.task.env import Locomotion, Trajectory
from shapebody.training.config import MOST_STEPS, TrainConfig, located
from shapebody.training.progress import CURVE_INTERVAL, _Curve, _Report, _rows
from shapebody.training.run_state import (
    STATE_FILES,
    _continued,
    _engine,
    _iterations,
    _require_budget,
    _require_run,
    _version,
)
from shapebody.training.update import make_policy_function, make_update


class Trainer:
    """A resumable training run.

    Everything that determines its future is in `training.safetensors` in the agent's folder,
    written after every iteration: a killed run continues as if nothing had happened and
    repeats at most one rollout. Beside it, `training.csv` is the learning curve so far; the
    agent itself and its `curve.csv` change only in `save_agent`. Of several trainers in a folder,
    one writes at a time (`alone`), and none replaces a state that another has written since it
    last read or wrote its own.

    Args:
        config: the run.
        folder: the agent's folder; data/checkpoints/<name> if not given.
        engine: "native", "mjx" or "auto": that of the run in the folder or, if there is none, the
            one that `Locomotion` chooses.
        policy: variables of a frozen policy, for the policy-evaluation phase.

    Raises:
        ValueError: if the run in the folder has another engine, or the state bank of `config` is
            too large for the file of an agent.
    """

    def __init__(self, config: TrainConfig, folder=None, engine: str = "auto", policy=None):
        _require_run(config, engine)
        if policy is not None and not (isinstance(policy, Mapping) and "params" in policy):
            raise refuse("policy", policy, "variables of a Policy, such as agent.policy")
        keep_memory()
        robots = tuple(located(robot) for robot in config.robots)
        config = config if robots == config.robots else replace(config, robots=robots)
        self.config = config
        self.folder = chosen_folder(folder, config.name)
        robots = [load_robot(name) for name in config.robots]
        task = config.task
        if not config.learn_policy:
            task = replace(task, fixed_coefficient=True)
        engine = _engine(self.folder, engine)
        self.env = Locomotion(robots, config.num_envs, engine=engine, config=task)
        _check_state_bank(config, self.env.sizes)
        self.policy, self.critic = Policy(config.policy), Critic(config.critic)
        self.update, start = make_update(config, self.policy, self.critic)
        self.act = make_policy_function(self.policy, config.mean_actions)
        keys = jax.random.split(jax.random.PRNGKey(config.seed), 4)
        self.key = keys[0]
        constants = self._constants(keys[1]) if config.standardize else None
        if policy is None:
            policy = initialize(self.policy, keys[2], constants)
        self.learner = start(policy, initialize(self.critic, keys[3], constants))
        self.behaviour = self.learner.policy
        self.seconds = 0.0
        self.phases = []
        self.state = None
        self.saved_physics = None
        self.in_step = True  # whether the engine is where `state` is
        self.holds_lock = False
        self.known = None  # `_version` of the state on disk that this trainer read or wrote

    def _constants(self, key):
        """Input standardization over the designs of all robots."""
        batches = []
        for i, robot in enumerate(self.env.robots):
            keys = jax.random.fold_in(key, i)
            f = jax.random.uniform(keys, (512, robot.design_dim), minval=-1.0, maxval=1.0)
            batches.append(self.env.descriptions(i, f))
        return standardization(*batches)

    # -------------------------------------------------------------- state on disk

    @property
    def steps(self) -> int:
        """Environment steps the learner has consumed."""
        return int(self.learner.iteration) * self.config.batch

    def _everything(self):
        return {
            "learner": self.learner,
            "behaviour": self.behaviour,
            "state": self.state,
            "physics": self.saved_physics,
            "seconds": np.float64(self.seconds),
        }

    @contextlib.contextmanager
    def alone(self):
        """Keep other trainers out of the folder while the block runs; blocks may be nested.

        Raises:
            ValueError: if another process, or another trainer, is at work there.
        """
        if self.holds_lock:
            yield
            return
        created = not self.folder.exists()
        self.folder.mkdir(parents=True, exist_ok=True)
        try:
            with alone_in(self.folder):
                self.holds_lock = True
                yield
        finally:
            self.holds_lock = False
            if created:
                with contextlib.suppress(OSError):  # unless something was written there
                    self.folder.rmdir()

    def _require_latest(self) -> None:
        """ValueError if the state on disk is another than this trainer read or wrote last."""
        if _version(self.folder) != self.known:
            raise ValueError(
                f"the run in {self.folder} has changed since this trainer read it: another one has "
                "trained there; call start() to go on from its state, or choose another name or "
                "folder"
            )

    def save(self) -> None:
        """Write the training state.

        Raises:
            ValueError: if another trainer has written one since this trainer's own.
        """
        with self.alone():
            self._require_latest()
            path = self.folder / "training.json"
            text = json.dumps(self.phases, indent=1) + "\n"
            if not path.exists() or path.read_bytes() != text.encode():
                atomic_write(path, text)
            save_arrays(self.folder / STATE_FILES[0], self._everything())
            self.known = _version(self.folder)

    def start(self) -> bool:
        """Resume from the folder, or start afresh; True if resumed.

        Raises:
            FileNotFoundError: if the run in the folder lacks its training.json.
            ValueError: if the run in the folder is of another configuration, or its files are
                damaged.
        """
        path = self.folder / "training.safetensors"
        # Before anything is read: what another trainer writes meanwhile is noticed in `run`.
        self.known = _version(self.folder)
        resumed = path.exists()
        if resumed:
            # Before the arrays are read, whose shapes depend on the configuration.
            steps = _iterations(self.folder) * self.config.batch
            about = self.folder / "training.json"
            self.phases = _continued(about, self.config, steps, self.env.robots)
        coefficient = 0.0 if self.config.learn_policy else 1.0
        self.state = self.env.reset(self.key, coefficient=coefficient, spread=True)
        native = self.env.engine == "native"
        self.saved_physics = self.env.physics_arrays() if native else self.env.physics_state
        if not resumed:
            robots = {robot.name: robot.hash for robot in self.env.robots}
            first = {"from_step": 0, "config": to_json(self.config)}
            self.phases = [first | {"robots": robots, "engine": self.env.engine}]
            return False
        saved = load_arrays(path, self._everything())
        self.learner, self.behaviour = saved["learner"], saved["behaviour"]
        self.state, self.seconds = saved["state"], float(saved["seconds"])
        self.saved_physics = saved["physics"]
        self.in_step = False
        return True

    def agent(self, states=None) -> Agent:
        """The agent as trained so far."""
        config = self.config
        metadata = {
            "config": to_json(config),
            "phases": self.phases,
            "scale": config.scale,
            "engine": self.env.engine,
            "steps": self.steps,
            "seconds": round(self.seconds, 1),
        }
        return Agent(
            name=config.name,
            robots=tuple(robot.name for robot in self.env.robots),
            sizes=self.env.sizes,
            policy_config=config.policy,
            critic_config=config.critic,
            policy=self.learner.policy,
            critic=self.learner.critic,
            states=None if states is None else states[0],
            state_robots=None if states is None else states[1],
            metadata=metadata,
        )

    def save_agent(self, folder=None) -> Agent:
        """Write the agent as trained so far, with a fresh state bank and its learning curve.

        folder: where to; the run's own if not given.
        """
        folder = self.folder if folder is None else require_path("folder", folder)
        agent = self.agent(self.state_bank())
        rows, _ = _rows(self.folder / "training.csv")
        save_agent(agent, folder, rows or None)
        return agent

    # -------------------------------------------------------------- the loop

    def _collect(self, behaviour, state, number):
        key = jax.random.fold_in(self.key, 2 * number)
        return self.env.rollout(self.act, behaviour, state, key, self.config.rollout_length)

    def last_iteration(self, max_steps=None) -> int:
        """Number of finished iterations at which `run` ends with that budget."""
        if max_steps is not None:
            require_integer("max_steps", max_steps, 0, MOST_STEPS)
        last = self.config.iterations
        return last if max_steps is None else min(last, max_steps // self.config.batch)

    def run(self, max_steps=None, max_seconds=None, progress=True, curve_interval=None) -> None:
        """Train until the configured number of steps, or until a budget is used up.

        Args:
            max_steps: stop once this many steps in all have been consumed.
            max_seconds: stop after this many seconds of this call.
            progress: print a line every few seconds.
            curve_interval: iterations per row of the learning curve, CURVE_INTERVAL if not given.

        Raises:
            ValueError: if another process trains in the same folder, or has trained there since
                `start`; if the simulation of a robot always fails.
        """
        _require_budget(max_steps, max_seconds, progress)
        if curve_interval is not None:
            require_integer("curve_interval", curve_interval, 1)
        config = self.config
        number, last = int(self.learner.iteration), self.last_iteration(max_steps)
        if number >= last:
            return
        if not self.in_step:
            if self.env.engine == "native":
                self.env.restore(self.state, self.saved_physics)
            else:
                self.env.physics_state = self.saved_physics
        self.in_step = False
        # On an accelerator there is nothing to overlap: the device does one thing at a time.
        overlap = self.env.engine == "native"
        failures = Failures(self.env)
        with self.alone(), ThreadPoolExecutor(1) as actor:
            self._require_latest()
            curve = _Curve(self.folder / "training.csv", self.steps)
            state, trajectory = self._collect(self.behaviour, self.state, number)
            mark = time.monotonic()
            until = mark + (math.inf if max_seconds is None else max_seconds)
            report = _Report(last * config.batch, until, progress)
            while True:
                # A snapshot from which the rollout below can be repeated.
                self.state, self.behaviour = state, self.learner.policy
                if overlap:
                    self.saved_physics = self.env.physics_arrays()
                    pending = actor.submit(self._collect, self.behaviour, state, number + 1)
                key = jax.random.fold_in(self.key, 2 * number + 1)
                self.learner, metrics = self.update(self.learner, trajectory, key)
                metrics = {name: float(x) for name, x in metrics.items()}
                if overlap:
                    state, following = pending.result()
                else:
                    self.behaviour = self.learner.policy
                    self.saved_physics = self.env.physics_state
                number += 1
                now = time.monotonic()
                self.seconds, elapsed, mark = self.seconds + now - mark, now - mark, now
                failures.add(trajectory)
                curve.add(trajectory, metrics, elapsed, config.batch)
                if number % (curve_interval or CURVE_INTERVAL) == 0:
                    curve.write(self.steps, self.seconds)
                report.show(self.steps, curve)
                self.save()
                if number >= last or now >= until:
                    break
                if not overlap:
                    state, following = self._collect(self.behaviour, state, number)
                trajectory = following
        if curve.count:
            curve.write(self.steps, self.seconds)
        report.end()

    def state_bank(self, rollouts: int = 8):
        """States from rollouts of the policy on random designs at c = 1 (Section 3.2).

        Designs and episodes are those of the task: the policy-evaluation phase, from which the
        shipped banks come, has f ~ U([-r, r]^d) with r ~ U(0, 1) and short episodes.

        Returns (Observation [M, ...] of numpy arrays, robot index int32[M]); None if the
        simulation fails in every step. Rollouts that fail so are left out.
        """
        require_integer("rollouts", rollouts, 1, 100_000)
        count = self.config.state_bank
        env = self.env
        if not env.config.fixed_coefficient:
            # In the training environment, c would fall on bodies that the policy cannot move.
            env = env.with_task(replace(env.config, fixed_coefficient=True))
        self.in_step = False
        state = env.reset(jax.random.fold_in(self.key, 1), coefficient=1.0, spread=True)
        length = self.config.rollout_length
        parts, robots, per = [], [], -(-count // rollouts)
        owner = np.concatenate([np.full(g.count, i) for i, g in enumerate(env.groups)])
        skip = max(1, 64 // length)
        rng = np.random.default_rng(self.config.seed)
        for r in range(rollouts):
            # Rollouts far apart, so that states come from many moments of an episode.
            for s in range(skip):
                key = jax.random.fold_in(self.key, 1_000_003 + r * skip + s)
                state, trajectory = env.rollout(self.act, self.learner.policy, state, key, length)
            good = np.argwhere(np.asarray(trajectory.finite))
            if not len(good):
                continue
            t, n = good[rng.choice(len(good), per, replace=per > len(good))].T
            parts.append(
                jax.tree.map(lambda x, t=t, n=n: np.asarray(x)[t, n], trajectory.observation)
            )
            robots.append(owner[n])
        if not parts:
            return None
        bank = jax.tree.map(lambda *x: np.concatenate(x)[:count].astype(np.float32), *parts)
        return bank, np.concatenate(robots)[:count].astype(np.int32)


class Failures:
    """Watches rollouts for robots whose simulation always fails: nothing can be learned there."""

    LEAST = 16
    """Failed episodes without one that ends otherwise, at least; and one per environment."""

    def __init__(self, env: Locomotion):
        self.names = [robot.name for robot in env.robots]
        counts = [group.count for group in env.groups]
        self.owner = np.repeat(np.arange(len(counts)), counts)
        self.limits = np.maximum(counts, self.LEAST)
        self.failed = np.zeros(len(counts), int)

    def add(self, trajectory: Trajectory) -> None:
        """Count the episodes that ended in a rollout.

        Raises:
            ValueError: if all latest episodes of a robot ended with a simulation that is not
                finite, as many as it has environments and at least LEAST.
        """
        finite = np.asarray(trajectory.finite)
        ended = np.asarray(trajectory.terminated) | np.asarray(trajectory.truncated)

        def per_robot(which):
            return np.bincount(self.owner, which.sum(0), len(self.failed)).astype(int)

        sound = per_robot(ended & finite) > 0
        self.failed = np.where(sound, 0, self.failed + per_robot(~finite))
        for name, failed, limit in zip(self.names, self.failed, self.limits, strict=True):
            if failed >= limit:
                raise ValueError(
                    f"the simulation of robot {name!r} fails in every episode: its positions or "
                    f"velocities became infinite in {failed} of the last {failed} episodes, so "
                    "there is nothing to learn from; check the file (shapebody.validate_robot), "
                    "above all gains, masses, inertias and armature, or give it a smaller timestep"
                )


def _check_state_bank(config: TrainConfig, sizes) -> None:
    """ValueError before the training if its states could not be saved at the end."""
    most = ARRAYS_LIMIT // (4 * (4 * sizes.joints + 3 * sizes.feet + 32))
    if config.state_bank > most:
        raise ValueError(
            f"state_bank is {config.state_bank}; expected at most {most:,} for these robots, as "
            "many as fit the file of an agent"
        )
