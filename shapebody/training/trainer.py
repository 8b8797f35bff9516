"""Training: PPO over randomized designs (Section 3.1, Appendix A), and policy evaluation.

One iteration collects a rollout of every environment (`rollout.py`), computes advantages with the
current critic, and takes several epochs of minibatch steps (`update.py`). A minibatch holds whole
environments, so that a design is encoded once for all its steps.

The second phase, policy evaluation, freezes the policy and trains critics alone on rollouts
over the full design space.
"""

import contextlib
import json
import math
import time
from collections.abc import Collection
from dataclasses import replace

import jax
import numpy as np

from shapebody.agent.agent import Agent
from shapebody.agent.store import chosen_folder, save_agent
from shapebody.arguments import require_choice, require_integer, require_list, require_path
from shapebody.configuration import to_json
from shapebody.files import alone_in, atomic_write, load_arrays, save_arrays
from shapebody.networks.critic import Critic
from shapebody.networks.inputs import initialize, standardization
from shapebody.networks.policy import Policy
from shapebody.robot.robot import load_robot
from shapebody.runtime import keep_memory
from shapebody.task.env import Locomotion
from shapebody.training.config import MOST_STEPS, TrainConfig, located
from shapebody.training.diagnosis import TELLS_FROM, Diagnosis, diagnose
from shapebody.training.portable import load_portable, save_portable
from shapebody.training.progress import CURVE_INTERVAL, Curve, Progress, read_rows
from shapebody.training.rollout import (
    Actor,
    Failures,
    collect_states,
    make_policy_function,
    require_state_bank,
)
from shapebody.training.run_state import (
    CURVE,
    PHASES,
    PORTABLE,
    STATE,
    continued_phases,
    finished_iterations,
    has_run,
    read_config,
    require_budget,
    require_run,
    run_engine,
    state_version,
)
from shapebody.training.update import (
    init_learner,
    learned_policy,
    ppo_update,
    require_variables,
)
from shapebody.training.yardstick import curve_columns, due


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
        require_run(config, engine)
        if policy is not None:
            require_variables("policy", policy)
        keep_memory()
        robots = tuple(located(robot) for robot in config.robots)
        config = config if robots == config.robots else replace(config, robots=robots)
        self.config = config
        self.folder = chosen_folder(folder, config.name)
        robots = [load_robot(name) for name in config.robots]
        task = config.task
        if not config.learn_policy:
            task = replace(task, fixed_coefficient=True)
        engine = run_engine(self.folder, engine)
        self.env = Locomotion(robots, config.num_envs, engine, task, mirror=config.mirrors)
        require_state_bank(config, self.env.sizes)

        # Networks, and the learner and actor that use them.
        self.policy, self.critic = Policy(config.policy), Critic(config.critic)
        keys = jax.random.split(jax.random.PRNGKey(config.seed), 4)
        constants = self._constants(keys[1]) if config.standardize else None
        if policy is None:
            policy = initialize(self.policy, keys[2], constants)
        self.learner = init_learner(config, policy, initialize(self.critic, keys[3], constants))
        self.key = keys[0]
        act = make_policy_function(self.policy, config.mean_actions)
        self.actor = Actor(self.env, act, self.key, config.rollout_length)
        self.actor.behaviour = self.learner.policy

        self.seconds = 0.0
        self.phases = []
        self.holds_lock = False
        self.known = None  # `state_version` of the state on disk that this trainer read or wrote

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

    def everything(self) -> dict:
        """What determines the run's future, as `training.safetensors` holds it."""
        return {
            "learner": self.learner,
            "behaviour": self.actor.behaviour,
            "state": self.actor.state,
            "physics": self.actor.physics,
            "seconds": np.float64(self.seconds),
        }

    def _as_saved(self) -> dict:
        """`everything` with the structure that the file in the folder has."""
        averages = read_config(self.folder).average_half_life is not None
        average = self.learner.policy["params"] if averages else None
        return {**self.everything(), "learner": replace(self.learner, average=average)}

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
        if state_version(self.folder) != self.known:
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
            path = self.folder / PHASES
            text = json.dumps(self.phases, indent=1) + "\n"
            if not path.exists() or path.read_bytes() != text.encode():
                atomic_write(path, text)
            save_arrays(self.folder / STATE, self.everything())
            self.known = state_version(self.folder)

    def start(self, changeable: Collection[str] = ()) -> bool:
        """Resume from the folder, or start afresh; True if resumed.

        Args:
            changeable: names of settings in which the configuration may differ from that of the
                run in the folder; if it does, the next save records it as a new phase.

        Raises:
            FileNotFoundError: if the run in the folder lacks its training.json.
            ValueError: if the run in the folder has another configuration, or its files are
                damaged.
        """
        changeable = require_list("changeable", changeable)
        for name in changeable:
            require_choice("an entry of changeable", name, vars(self.config))
        # Before anything is read: what another trainer writes meanwhile is noticed in `run`.
        self.known = state_version(self.folder)
        resumed = has_run(self.folder)
        if resumed:
            # Before the arrays are read, whose shapes depend on the configuration.
            steps = finished_iterations(self.folder) * self.config.batch
            self.phases = continued_phases(
                self.folder, self.config, steps, self.env.robots, changeable
            )
        self.actor.reset(0.0 if self.config.learn_policy else 1.0)
        if not resumed:
            robots = {robot.name: robot.hash for robot in self.env.robots}
            first = {"from_step": 0, "config": to_json(self.config)}
            self.phases = [first | {"robots": robots, "engine": self.env.engine}]
            return False
        if self.known is None:
            self._start_from_portable()
        else:
            self._take(load_arrays(self.folder / STATE, self._as_saved()))
        # An average that is new begins with the policy; one that is no longer wanted goes.
        averages = self.config.average_half_life is not None
        if averages != (self.learner.average is not None):
            average = self.learner.policy["params"] if averages else None
            self.learner = replace(self.learner, average=average)
        return True

    def _take(self, saved: dict) -> None:
        self.learner, self.seconds = saved["learner"], float(saved["seconds"])
        self.actor.resume(saved["behaviour"], saved["state"], saved["physics"])

    def _start_from_portable(self) -> None:
        like, number = self._as_saved()["learner"], self.config.num_envs
        saved = load_portable(self.folder / PORTABLE, like, number)
        self.learner, coefficient, self.seconds = saved
        self.actor.behaviour = self.learner.policy
        self.actor.reset(coefficient, int(self.learner.iteration))

    def save_portable(self) -> None:
        """Write the small state from which the run can go on with new episodes."""
        coefficient = np.asarray(self.actor.state.coefficient)
        save_portable(self.folder / PORTABLE, self.learner, coefficient, self.seconds)

    # -------------------------------------------------------------- the agent

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
            policy=learned_policy(self.learner),
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
        rows, _ = read_rows(self.folder / CURVE)
        save_agent(agent, folder, rows or None)
        return agent

    def state_bank(self, rollouts: int = 8):
        """States from rollouts of the policy on random designs at c = 1 (`collect_states`).

        Designs and episodes are those of the task: the policy-evaluation phase, from which the
        shipped banks come, has f ~ U([-r, r]^d) with r ~ U(0, 1) and short episodes.

        Returns (Observation [M, ...] of numpy arrays, robot index int32[M]); None if the
        simulation fails in every step.
        """
        require_integer("rollouts", rollouts, 1, 100_000)
        config = self.config
        return collect_states(
            self.env,
            self.actor.act,
            learned_policy(self.learner),
            self.key,
            length=config.rollout_length,
            count=config.state_bank,
            rollouts=rollouts,
            seed=config.seed,
        )

    def diagnosis(self) -> Diagnosis | None:
        """Whether the robot walks, only stands or falls so far.

        None before 1 million steps, and for a run of several robots.
        """
        if len(self.env.robots) > 1 or self.steps < TELLS_FROM:
            return None
        policy = self.config.policy, learned_policy(self.learner)
        return diagnose(*policy, self.env.robots[0], self.env.engine)

    # -------------------------------------------------------------- the loop

    def last_iteration(self, max_steps=None) -> int:
        """Number of finished iterations at which `run` ends with that budget."""
        if max_steps is not None:
            require_integer("max_steps", max_steps, 0, MOST_STEPS)
        last = self.config.iterations
        return last if max_steps is None else min(last, max_steps // self.config.batch)

    def run(self, max_steps=None, max_seconds=None, progress=True, curve_interval=None) -> None:
        """Train until the configured number of steps, or until a budget is used up.

        Args:
            max_steps, max_seconds, progress: see `train`.
            curve_interval: iterations per row of the learning curve, CURVE_INTERVAL if not given.

        Raises:
            ValueError: if another process trains in the same folder, or has trained there since
                `start`; if the simulation of a robot always fails.
        """
        require_budget(max_steps, max_seconds, progress)
        if curve_interval is not None:
            require_integer("curve_interval", curve_interval, 1)
        number, last = int(self.learner.iteration), self.last_iteration(max_steps)
        if number >= last:
            return
        batch, failures = self.config.batch, Failures(self.env)
        per_row = curve_interval or CURVE_INTERVAL
        with self.alone(), self.actor as actor:
            self._require_latest()
            curve = Curve(self.folder / CURVE, self.steps)
            trajectory, compiling = actor.repeat(number), True
            mark = time.monotonic()
            until = mark + (math.inf if max_seconds is None else max_seconds)
            with Progress(last * batch, until, progress) as report:
                while True:
                    metrics = self._iteration(trajectory, number)
                    number += 1
                    now = time.monotonic()
                    self.seconds, elapsed, mark = self.seconds + now - mark, now - mark, now
                    failures.add(trajectory)
                    curve.add(trajectory, metrics, batch, None if compiling else elapsed)
                    if number % per_row == 0:
                        measured = {}
                        if due(self.config.yardstick_interval, self.steps, per_row * batch):
                            policy = self.config.policy, learned_policy(self.learner)
                            measured = curve_columns(*policy, self.env.robots, self.env.engine)
                            report.note(self.diagnosis)
                        # The yardstick takes time, but does not slow down the training itself.
                        mark = time.monotonic()
                        self.seconds += mark - now
                        curve.write(self.steps, self.seconds, measured)
                    report.show(self.steps, curve)
                    self.save()
                    if number >= last or now >= until:
                        break
                    trajectory, compiling = actor.result(), False
        curve.write(self.steps, self.seconds)

    def _iteration(self, trajectory, number: int) -> dict[str, float]:
        """Learn from rollout `number` and begin the next one; returns the update's metrics."""
        actor = self.actor
        if actor.beside:
            # With the policy before the update, so that both work at the same time.
            actor.begin(self.learner.policy, number + 1)
        metrics = self._learn(trajectory, number)
        if not actor.beside:
            actor.begin(self.learner.policy, number + 1)
        actor.wait()
        return metrics

    def _learn(self, trajectory, number: int) -> dict[str, float]:
        key = jax.random.fold_in(self.key, 2 * number + 1)
        self.learner, metrics = ppo_update(self.config, self.learner, trajectory, key)
        return {name: float(x) for name, x in metrics.items()}
