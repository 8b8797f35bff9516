"""What is frozen: one function per group, each returning a dictionary of NumPy arrays.

Every random number comes from a fixed seed. `GROUPS` lists the functions; `freeze.py` writes what
they return to one file per group, and `tests/test_golden.py` compares it with those files.
"""

import contextlib
import functools
import hashlib
import re
from dataclasses import fields
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from shapebody.agent.store import load_agent
from shapebody.design.descriptions import describe
from shapebody.design.space import DesignSpace
from shapebody.evaluation.evaluate import EvaluationConfig, evaluate
from shapebody.networks.critic import Critic
from shapebody.networks.inputs import initialize, standardization
from shapebody.networks.policy import Policy, entropy, log_prob
from shapebody.optimizers.search import METHODS, search
from shapebody.robot.robot import load_robot, robots
from shapebody.task.config import TaskConfig
from shapebody.task.env import Locomotion, Trajectory
from shapebody.task.observations import COMMAND, Observation, sphere_collisions
from shapebody.task.rewards import TERMS, Moment, combine, reward_terms
from shapebody.training.config import TrainConfig
from shapebody.training.losses import advantages
from shapebody.training.update import init_learner, ppo_update

FOLDER = Path(__file__).parent
GO2, HUMANOID, GOLEM = "unitree_go2", "mit_humanoid", "golem"
BODIES = (GO2, HUMANOID, GOLEM, "custom_hexapod", "bolt")
HASHED = (*BODIES, "anymal_c", "bittle", "spot", "talos", "unitree_h1")
QUICK = "jax_disable_most_optimizations"
ENTRIES = 16
"""Number of entries that are kept of a large row, at fixed places spread over it."""
NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w.])")
"""A number in MJCF, but not one that is part of a name."""
FULL = 32
"""Rows up to this size are kept as they are."""


@contextlib.contextmanager
def quick_compilation():
    """Programs compiled inside are little optimized: they are compiled more than they compute."""
    before = jax.config.read(QUICK)
    jax.config.update(QUICK, True)
    yield
    jax.config.update(QUICK, before)


def summarized(values: dict) -> dict:
    """Arrays [rows, ...]; of large rows: 16 entries, the sum and the sum of squares in float64."""
    result = {}
    for name, value in values.items():
        value = np.asarray(value)
        rows = value.reshape(len(value), -1) if value.ndim > 1 else value[..., None]
        size = rows.shape[-1]
        if size <= FULL:
            result[name] = value
            continue
        where = (np.arange(ENTRIES) * 0.6180339887 % 1 * size).astype(int)
        result[f"{name}: entries"] = rows[:, where]
        precise = rows.astype(np.float64)
        result[f"{name}: sum"] = precise.sum(-1)
        result[f"{name}: sum of squares"] = (precise**2).sum(-1)
    return result


def named(tree, prefix: str = "") -> dict:
    """Fields of a dataclass of arrays by name."""
    values = {prefix + field.name: getattr(tree, field.name) for field in fields(tree)}
    return {name: np.asarray(value) for name, value in values.items() if value is not None}


def named_leaves(tree, prefix: str) -> dict:
    """Leaves of nested dictionaries by their path, each as one row."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {prefix + jax.tree_util.keystr(path): np.asarray(x)[None] for path, x in leaves}


def designs_of(space) -> np.ndarray:
    """The reference and two random designs."""
    return np.stack([space.reference, space.start(1), 0.5 * space.start(2)])


@functools.cache
def _bodies(name: str):
    """Embodiments and descriptions of the three designs of a robot, mapped one by one."""
    robot = load_robot(name)
    space, to_descriptions = DesignSpace(robot), jax.jit(describe(robot))
    bodies = [space(f) for f in designs_of(space)]
    described = [to_descriptions(body) for body in bodies]
    return tuple(
        jax.tree.map(lambda *x: np.stack([np.asarray(y) for y in x]), *trees)
        for trees in (bodies, described)
    )


def embodiments() -> dict:
    """Φ of three designs of five robots."""
    values = {}
    for name in BODIES:
        values |= named(_bodies(name)[0], f"{name} ")
    return summarized(values)


def descriptions() -> dict:
    """Descriptions of the same bodies."""
    values = {}
    for name in BODIES:
        values |= named(_bodies(name)[1], f"{name} ")
    return summarized(values)


STEPS = 30
SHOWN = [0, 1, 2, 5, 10, 20, 29]
"""Control steps whose observations and readings are kept."""


def _given_action(action, key, descriptions, observation):
    return action * descriptions.joint_mask, ()


@jax.jit
@jax.vmap
def _terms(before, after):
    """Reward terms of the control step between two states of an episode."""
    moment = Moment(
        readings=after.readings,
        descriptions=before.descriptions,
        command=before.command,
        keep_nominal=before.keep_nominal,
        actions=after.actions,
        contact=after.contact,
        air_time=before.air_time,
        last_joint_velocity=before.readings.joint_velocity,
        last_linear_velocity=before.readings.linear_velocity,
        collisions=sphere_collisions(after.readings, before.descriptions),
    )
    terms = reward_terms(moment)
    return terms, combine(terms, before.coefficient)


def _episode(engine: str) -> dict:
    """The Go2 and another body of it under actions that are sine waves, at c = 1."""
    robot = load_robot(GO2)
    config = TaskConfig.evaluation()
    env = Locomotion(robot, 2, engine, config, auto_reset=False)
    space = DesignSpace(robot)
    designs = np.stack([space.reference, 0.5 * space.start(2)])
    keys = jax.random.split(jax.random.PRNGKey(11), 2)
    state = env.reset(None, designs=designs, keys=keys)
    joints = np.arange(robot.num_actuators)
    rows = []
    for step in range(STEPS):
        wave = 0.5 * np.sin(0.3 * step + joints)
        action = np.tile(wave, (2, 1)).astype(np.float32)
        before = state
        state, trajectory = env.rollout(
            _given_action, action, before, jax.random.PRNGKey(step), length=1
        )
        terms, total = _terms(before, state)
        row = {
            "terms": terms,
            "reward": trajectory.reward[0],
            "reward from terms": total,
            "terminated": trajectory.terminated[0],
            "episode_error": trajectory.episode_error[0],
            "episode_return": trajectory.episode_return[0],
            "command": state.command,
        }
        row |= named(jax.tree.map(lambda x: x[0], trajectory.observation), "observation ")
        row |= named(state.readings, "readings ")
        rows.append({name: np.array(value) for name, value in row.items()})
    values = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
    terms = values.pop("terms")
    by_term = {
        f"T{number} {term.name}": terms[..., number - 1] for number, term in enumerate(TERMS, 1)
    }
    shown = {
        name: value[SHOWN] if name.startswith(("observation", "readings")) else value
        for name, value in values.items()
    }
    return by_term | summarized(shown)


def episode_native() -> dict:
    """Rewards, observations and readings of a fixed episode with C MuJoCo."""
    return _episode("native")


def episode_mjx() -> dict:
    """The same episode with MJX."""
    return _episode("mjx")


def networks() -> dict:
    """Outputs of shipped and of fresh networks, for three designs [3] in four states [4]."""
    values = {}
    for name in (GO2, HUMANOID):
        agent = load_agent(name)
        places = np.linspace(0, agent.num_states - 1, 4).astype(int)
        states = jax.tree.map(lambda x, at=places: jnp.asarray(x)[at][None], agent.states)
        bodies = jax.tree.map(lambda x: jnp.asarray(x)[:, None], _bodies(name)[1])
        policy, critic = jax.jit(agent.policy_module.apply), jax.jit(agent.critic_module.apply)
        mean, std = policy(agent.policy, bodies, states)
        values[f"{name} action"] = agent.act(bodies, states)
        values[f"{name} mean"], values[f"{name} std"] = mean, std
        values[f"{name} heads"] = critic(agent.critic, bodies, states)
        values[f"{name} values"] = agent.values(bodies, states)
    config = TrainConfig.smoke(GO2)
    for name in (GO2, HUMANOID):
        agent = load_agent(name)
        states = jax.tree.map(lambda x: jnp.asarray(x)[None, :4], agent.states)
        bodies = jax.tree.map(lambda x: jnp.asarray(x)[:, None], _bodies(name)[1])
        policy, critic = Policy(config.policy), Critic(config.critic)
        variables = initialize(policy, jax.random.PRNGKey(1))
        mean, std = jax.jit(policy.apply)(variables, bodies, states)
        values[f"fresh {name} mean"], values[f"fresh {name} std"] = mean, std
        mask = bodies.joint_mask
        values[f"fresh {name} log density"] = log_prob(mean, std, 0.5 * jnp.ones_like(mean), mask)
        values[f"fresh {name} entropy"] = entropy(std, mask)
        variables = initialize(critic, jax.random.PRNGKey(2))
        values[f"fresh {name} heads"] = jax.jit(critic.apply)(variables, bodies, states)
    return summarized(values)


def gae() -> dict:
    """Advantages of six environments in ten steps."""
    rng = np.random.default_rng(5)
    reward, value = rng.normal(size=(2, 6, 10)).astype(np.float32)
    last = rng.normal(size=6).astype(np.float32)
    terminated, truncated = rng.random((2, 6, 10)) < 0.15
    return {
        f"lambda {lam}": np.asarray(
            advantages(reward, value, last, terminated, truncated, 0.99, lam)
        )
        for lam in (0.0, 0.7, 0.95)
    }


def _rollout(config, robot) -> Trajectory:
    """A made-up rollout: random observations and actions, designs at c = 1."""
    rng = np.random.default_rng(3)
    n, t, nu, nf = config.num_envs, config.rollout_length, robot.num_actuators, robot.num_feet

    def draw(*shape, scale=1.0):
        return (scale * rng.normal(size=shape)).astype(np.float32)

    space = DesignSpace(robot)
    bodies = jax.jit(lambda f: describe(robot)(space(f)))(
        np.stack([space.start(i) for i in range(2 * n)])
    )
    bodies = jax.tree.map(lambda x: jnp.reshape(x, (2, n, *x.shape[1:])), bodies)

    def observe(*leading):
        general = draw(*leading, 13, scale=0.5)
        general[..., COMMAND] = np.float32(0.5)
        return Observation(
            joints=draw(*leading, nu, 4, scale=0.3),
            feet=draw(*leading, nf, 3),
            general=general,
            privileged=draw(*leading, 5, scale=0.3),
        )

    observation, last = observe(t, n), observe(n)
    observation.general[t // 2 :, : n // 2, COMMAND] = -0.25  # another command
    last.general[: n // 2, COMMAND] = -0.25
    action = draw(t, n, nu)
    terminated, truncated = rng.random((2, t, n)) < 0.08
    done = terminated | truncated
    number, final = np.cumsum(done, 0) - done, np.sum(done, 0)
    zeros = np.zeros((t, n), np.float32)
    return Trajectory(
        observation=observation,
        action=action,
        extra=log_prob(jnp.zeros_like(action), jnp.ones_like(action), action, jnp.ones(nu)),
        reward=draw(t, n, scale=0.1),
        terminated=terminated,
        truncated=truncated,
        finite=np.ones((t, n), bool),
        slot=((number == final) & (final > 0)).astype(np.int32),
        valid=((number == 0) | (number == final)).astype(np.float32),
        descriptions=bodies,
        last_observation=last,
        episode_return=zeros,
        episode_length=zeros.astype(np.int32),
        episode_error=zeros,
        coefficient=zeros + 1,
    )


def update() -> dict:
    """Weights before and after one iteration of PPO, and its metrics."""
    config = TrainConfig.smoke(GO2)
    rollout = _rollout(config, load_robot(GO2))
    policy, critic = Policy(config.policy), Critic(config.critic)
    constants = standardization(jax.tree.map(lambda x: x[0], rollout.descriptions))
    keys = jax.random.split(jax.random.PRNGKey(4), 3)
    learner = init_learner(
        config, initialize(policy, keys[0], constants), initialize(critic, keys[1], constants)
    )
    values = named_leaves({"policy": learner.policy, "critic": learner.critic}, "before ")
    learner, metrics = ppo_update(config, learner, rollout, keys[2])
    values |= named_leaves({"policy": learner.policy, "critic": learner.critic}, "after ")
    values |= {f"metric {name}": np.asarray(x)[None] for name, x in metrics.items()}
    return summarized(values)


BUDGETS = {
    "vgds": dict(iterations=12),
    "penalty-only": dict(iterations=12),
    "random": dict(iterations=4, candidates=6),
    "cma-es": dict(iterations=4, particles=6),
    "turbo": dict(iterations=4, candidates=6),
    "pso": dict(iterations=4, particles=6),
    "cem": dict(iterations=4, particles=8),
    "de": dict(iterations=4, particles=6),
    "ars": dict(iterations=4, directions=4),
    "gc-pfo": dict(iterations=4, particles=4),
}
"""Settings of every method; "bo" needs an optional package."""


def searches() -> dict:
    """What every method finds for the Go2 with the shipped agent."""
    assert set(METHODS) - set(BUDGETS) <= {"bo"}, "a method without a frozen search"
    agent, robot = load_agent(GO2), load_robot(GO2)
    start = DesignSpace(robot).start(3)
    values = {}
    for method, settings in BUDGETS.items():
        found = search(method, agent, robot, start, seed=6, batch_size=8, **settings)
        values |= {
            f"{method} design": found.design[None],
            f"{method} objective": np.asarray(found.objective)[None],
            f"{method} history": found.history[None],
            f"{method} trajectory": found.trajectory[None],
            f"{method} evaluations": np.asarray(found.evaluations)[None],
        }
    return summarized(values)


def hashes() -> dict:
    """Hashes of shipped agents and of robots."""
    values = {}
    for name in (GO2, HUMANOID, GOLEM):
        agent = load_agent(name)
        for kind in ("hash", "policy_hash", "states_hash"):
            values[f"agent {name} {kind}"] = np.asarray(getattr(agent, kind))
    return values | {f"robot {name}": np.asarray(load_robot(name).hash) for name in HASHED}


def mjcf() -> dict:
    """MJCF text of designs: its SHA-256, that of the text without its numbers, and the numbers.

    The last two tell another text from another rounding of Φ, which changes only the last digits.
    """

    def digest(text):
        return np.asarray(hashlib.sha256(text.encode()).hexdigest())

    values = {}
    for name in (GO2, HUMANOID, "custom_hexapod"):
        space = DesignSpace(load_robot(name))
        for label, f in zip(("reference", "random", "half"), designs_of(space), strict=True):
            text = space.to_mjcf(f)
            numbers = np.array([[float(number) for number in NUMBER.findall(text)]])
            values |= {
                f"{name} {label}: text": digest(text),
                f"{name} {label}: words": digest(NUMBER.sub("#", text)),
            }
            values |= summarized({f"{name} {label}: numbers": numbers})
    return values


def evaluation() -> dict:
    """Two episodes of 100 control steps on the reference and on start design 3 of the Go2."""
    agent, robot = load_agent(GO2), load_robot(GO2)
    space = DesignSpace(robot)
    config = EvaluationConfig(episodes=2, task=TaskConfig.evaluation(horizon=100))
    designs = np.stack([space.reference, space.start(3)])
    score = evaluate(agent, robot, designs, seed=2, engine="native", config=config)
    names = ("returns", "tracking_error", "lengths", "finite")
    return {name: np.asarray(getattr(score, name)) for name in names}


def dimensions() -> dict:
    """Number of design parameters of every shipped robot."""
    return {name: np.asarray(load_robot(name).design_dim) for name in robots()}


GROUPS = {
    function.__name__: function
    for function in (
        embodiments,
        descriptions,
        episode_native,
        episode_mjx,
        networks,
        gae,
        update,
        searches,
        hashes,
        mjcf,
        evaluation,
        dimensions,
    )
}


def compute(group: str) -> dict:
    """The values of a group as the code gives them now."""
    with quick_compilation():
        return {name: np.asarray(value) for name, value in GROUPS[group]().items()}


def path_of(group: str) -> Path:
    """The file that holds the frozen values of a group."""
    return FOLDER / f"{group}.npz"
