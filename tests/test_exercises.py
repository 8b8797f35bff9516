"""The checkers accept right answers, and say what is wrong with typical wrong ones."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from exercises import (
    bring_your_own_robot,
    design_trajectories,
    fifty_robots,
    locomotion_task,
    quickstart,
    robots_and_designs,
    training_and_policy_evaluation,
    trust_region,
    urma_networks,
    value_gradient_design,
    vgds_versus_baselines,
)

from shapebody.design.space import DesignSpace
from shapebody.robot.robot import load_robot
from shapebody.task.rewards import TERMS


@pytest.fixture
def says(capsys):
    """Ask a checker, and compare how its answer begins and what it contains."""

    def ask(check, answer, *more, hint=None):
        check(answer, *more)
        text = capsys.readouterr().out
        assert text.startswith("Not yet." if hint else "Right."), text
        assert (hint or "") in text, text

    return ask


def functions():
    """Checkers that take a function, with what they take beside it."""
    space = DesignSpace(load_robot("unitree_go2"))
    return (
        (robots_and_designs.check_total_mass, space),
        (locomotion_task.check_reward,),
        (urma_networks.check_latent,),
        (training_and_policy_evaluation.check_gae,),
        (training_and_policy_evaluation.check_surrogate,),
        (value_gradient_design.check_step,),
        (value_gradient_design.check_radius,),
        (trust_region.check_penalty_coefficient,),
        (vgds_versus_baselines.check_cem_generation,),
        (vgds_versus_baselines.check_climb, lambda *_: None),
        (design_trajectories.check_pair_distance,),
        (design_trajectories.check_covered, np.ones((3, 1, 2))),
    )


def test_untried_exercises(says):
    for check, *more in functions():
        says(check, None, *more, hint="Nothing is answered")
        if check is not vgds_versus_baselines.check_climb:
            says(check, lambda *_: None, *more, hint="returns None")


def test_quickstart(says):
    def result(size, end, start=0.5):
        path = np.linspace(np.full(4, start), np.full(4, end), 11)
        return SimpleNamespace(trajectory=path, design=path[-1], settings={"trust_region": size})

    good = {0: result(0, 0.4), 20: result(20, 0.2), 100: result(100, 0.1)}
    check = quickstart.check_trust_regions
    says(check, good)
    says(check, {0: good[0]}, hint="keys 0, 20 and 100")
    says(check, good | {20: good[0]}, hint="trust_region=0")
    says(check, good | {20: result(20, 0.2, start=0.6)}, hint="different designs")
    says(check, good | {100: result(100, 0.45)}, hint="should fall with λ")
    says(quickstart.check_largest_step, 0.04, good[100])
    says(quickstart.check_largest_step, 0.4, good[100], hint="whole search")
    says(quickstart.check_largest_step, 0.1, good[100], hint="np.diff")


def test_robots_and_designs(says):
    space = DesignSpace(load_robot("unitree_go2"))

    def mass(f):
        return space(f).body_mass.sum()

    at_reference = float(mass(space.reference))
    check = robots_and_designs.check_total_mass
    says(check, lambda x: at_reference * (1 + 0.8 * x) ** 3, space)
    says(check, lambda x: at_reference * (1 + 0.8 * x), space, hint="three directions")
    f = space.reference
    for _ in range(5):
        gradient = np.asarray(jax.grad(mass)(f))
        f = f + float(at_reference + 1 - mass(f)) * gradient / (gradient @ gradient)
    check, far = robots_and_designs.check_heavier, f.copy()
    far[space.slices["range"]] = 0.5
    says(check, f, space)
    says(check, far, space, hint="along the gradient")
    says(check, space.reference, space, hint="gains +0.000 kg")


WEIGHTS = np.array([term.weight for term in TERMS]) * 0.02


def reward(terms, c, weights=WEIGHTS):
    weighted = weights * terms
    inner = weighted[:2].sum() + c * (weighted[2] + weighted[4:].sum())
    return max(inner, 0) + c * weighted[3]


@pytest.mark.parametrize("term", range(23))
def test_a_wrong_weight_is_named(says, term):
    for factor in (0, 1.01, -1):
        weights = WEIGHTS * np.where(np.arange(23) == term, factor, 1)
        hint = f"weights: T{term + 1}."
        says(locomotion_task.check_reward, lambda *x, w=weights: reward(*x, w), hint=hint)


def test_locomotion_task(says):
    check = locomotion_task.check_reward
    inside = np.append(WEIGHTS[:2], np.zeros(21))
    says(check, reward)
    says(check, lambda terms, c: reward(terms, c) / 0.02, hint="0.02 s")
    says(check, lambda terms, c: c * reward(terms, 1.0), hint="T1 and T2 count in full")
    says(check, lambda terms, c: max(WEIGHTS @ terms, 0), hint="multiplied by c")
    clipped = "clipped at 0"
    says(check, lambda terms, c: inside @ terms + c * ((WEIGHTS - inside) @ terms), hint=clipped)
    says(locomotion_task.check_successes, 14)
    says(locomotion_task.check_successes, 100, hint="k times as much")
    says(locomotion_task.check_successes, 10, hint="smallest n")


def test_networks_and_training(says):
    check = urma_networks.check_latent
    says(check, lambda keys, values, mask: np.einsum("nl,nv,n->lv", keys, values, mask))
    says(check, lambda keys, values, mask: keys.T @ values, hint="padding")
    says(check, lambda keys, values, mask: values.T @ keys, hint="shape (6, 3)")

    def gae(reward, value, last, discount, gae_lambda, back=True):
        error = reward + discount * np.append(value[1:], last) - value
        for t in range(len(error) - 2, -1, -1):
            error[t] += back * discount * gae_lambda * error[t + 1]
        return error

    check = training_and_policy_evaluation.check_gae
    says(check, gae)
    says(check, lambda *x: gae(*x, back=False), hint="go backwards")
    says(check, lambda r, v, _, *x: gae(r, v, 0, *x), hint="last_value")
    check = training_and_policy_evaluation.check_surrogate
    says(check, lambda r, a: np.minimum(r * a, np.clip(r, 0.9, 1.1) * a))
    says(check, lambda r, a: np.clip(r, 0.9, 1.1) * a, hint="Clipping alone")
    says(check, lambda r, a: r * a, hint="smaller of")


def test_searches(says):
    check = value_gradient_design.check_step
    says(check, lambda f, step: np.clip(f + np.clip(step, -0.1, 0.1), -1, 1))
    says(check, lambda f, step: f + np.clip(step, -0.1, 0.1), hint="leaves [-1, 1]")
    says(check, lambda f, step: np.clip(f + step, -1, 1), hint="more than 0.1")
    says(check, lambda f, step: f, hint="lead to")
    check = value_gradient_design.check_radius
    says(check, lambda g, size: min(358 * abs(g) / (2 * size), 1))
    says(check, lambda g, size: 358 * abs(g) / (2 * size), hint="at most 1")
    says(check, lambda g, size: 358 * abs(g) / size, hint="derivative")
    check = trust_region.check_penalty_coefficient
    says(check, lambda p, a: p / (1 / 3 + a**2))
    says(check, lambda p, a: 3 * p, hint="a counts too")
    says(check, lambda p, a: p, hint="a = 0")
    gains = np.array([[1.0, 1.0, 5.0, 5.0], [2.0, 2.0, 0.0, 1.0], [0.0, 0.0, 0.0, 0.0]])
    check, sizes = trust_region.check_held_out, (0, 20, 100)
    says(check, (20, 2.0, 0.5), gains, sizes)
    says(check, (0, 1.0, 5.0), gains, sizes, hint="first half of the columns")
    says(check, (20, 0.5, 2.0), gains, sizes, hint="one row")
    x = np.random.default_rng(0).uniform(-1, 1, (21, 3, 4)) * 0.8 ** np.arange(21)[:, None, None]

    def apart(x):
        return np.sqrt(((x[:, None] - x[None]) ** 2).mean(-1))

    def covered(path, share=0.1):
        left = np.linalg.norm(path - path[-1], axis=1)
        return np.argmax(left <= share * left[0])

    check = design_trajectories.check_pair_distance
    says(check, lambda x: apart(x).sum() / (len(x) * (len(x) - 1)))
    says(check, lambda x: apart(x).mean(), hint="with itself")
    says(design_trajectories.check_covered, covered, x)
    says(design_trajectories.check_covered, lambda p: covered(p, 0.9), x, hint="It is iteration")


def generation(designs, scores, config):
    elites = designs[np.argsort(scores)[-config.elites :]]
    return elites.mean(axis=0), np.maximum(elites.std(axis=0), config.minimum_std)


def test_cem_generation(says):
    check = vgds_versus_baselines.check_cem_generation
    says(check, generation)
    says(check, lambda f, scores, config: generation(f, -scores, config), hint="best designs")
    says(check, lambda *x: (generation(*x)[0], 0.4 * np.ones(6)), hint="deviation of each")


def propose(config, memory, key):
    noise = jax.random.normal(key, (config.particles, len(memory.design)))
    return jnp.clip(memory.design + config.std * noise, -1, 1)


def update(config, memory, scored, key):
    best = jnp.argmax(scored.values)
    better = scored.values[best] > scored.current
    return memory._replace(design=jnp.where(better, scored.designs[best], memory.design))


def test_climb(says):
    check = vgds_versus_baselines.check_climb
    says(check, propose, update)
    says(check, lambda *_: None, update, hint="Propose an array")
    says(check, propose, lambda *_: None, hint="update returns None")
    says(check, lambda c, m, key: 2 * propose(c, m, key), update, hint="leaves the box")
    says(check, lambda c, m, key: jnp.tile(m.design, (16, 1)), update, hint="remain")
    first = lambda c, m, scored, key: m._replace(design=scored.designs[0])  # noqa: E731
    says(check, propose, first, hint="best proposal")


def test_fifty_robots(says):
    says(fifty_robots.check_growth, (13, 24, 30))
    for answer, hint in (((14, 24, 30), "(a)"), ((13, 11, 30), "(b)"), ((13, 24, 27), "(c)")):
        says(fifty_robots.check_growth, answer, hint=hint)
    columns = ("design_dim", "actuators")
    table = {"a": (358, 12), "b": (1102, 22)}
    table = {name: dict(zip(columns, row, strict=True)) for name, row in table.items()}
    says(fifty_robots.check_per_motor, "b", table)
    says(fifty_robots.check_per_motor, "c", table, hint="no robot")
    says(fifty_robots.check_per_motor, "a", table, hint="another robot has more")


LEGS = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.005"/>
  <default>
    <geom contype="0" conaffinity="0"/>
    <position kp="20" kv="0.5" forcerange="-9 9"/>
    <joint damping="0.1" armature="0.01"/>
  </default>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 0.05"/>
    <body name="trunk" pos="0 0 0.2">
      <freejoint/>
      <site name="imu"/>
      <geom type="box" size="0.1 0.1 0.03" mass="3.2"/>
      <geom type="sphere" size="0.05" mass="0" group="5"/>{legs}
    </body>
  </worldbody>
  <actuator>{motors}</actuator>
  <keyframe><key name="home" qpos="0 0 0.17 1 0 0 0{zeros}"/></keyframe>
  <custom>
    <numeric name="action_scale" data="0.3"/>
    <numeric name="velocity_limits" data="{speeds}"/>
  </custom>
</mujoco>
"""
LEG = """
      <body name="{leg}_thigh" pos="{x} {y} 0">{hinges}
        <geom type="capsule" fromto="0 0 0 {x} 0 0" size="0.02" mass="0.1"/>
        <body name="{leg}_shin" pos="{x} 0 0">
          <joint name="{leg}_knee" axis="0 1 0" range="-1 1"/>
          <geom name="{leg}_foot" type="sphere" size="0.02" mass="0.1" pos="{out} 0 -0.15"/>
        </body>
      </body>"""


def legged(folder, joints, *change):
    """File of a four-legged robot of 4 kg whose feet are 0.05 m outside its knees."""
    legs = motors = ""
    for leg, x, y in (("FL", 1, 1), ("FR", 1, -1), ("RL", -1, 1), ("RR", -1, -1)):
        hinges = "".join(
            f'\n        <joint name="{leg}_{joint}" axis="{axis}" range="-{limit} {limit}"/>'
            for joint, axis, limit in (("swing", "0 0 1", 0.7), ("lift", "0 1 0", 0.6))
            if joint in joints
        )
        legs += LEG.format(leg=leg, hinges=hinges, x=0.1 * x, y=0.1 * y, out=0.05 * x)
        motors += "".join(f'<position name="{leg}_{j}" joint="{leg}_{j}"/>' for j in joints)
    number = 4 * len(joints)
    text = LEGS.format(legs=legs, motors=motors, zeros=" 0" * number, speeds=" 15" * number)
    path = folder / "legged.xml"
    path.write_text(text.replace(*change) if change else text)
    return path


def test_bring_your_own_robot(says, tmp_path):
    check, robot = bring_your_own_robot.check_knee_torque, load_robot(legged(tmp_path, ["knee"]))
    says(check, 4 * 9.81 / 4 * 0.05, robot)
    says(check, 4 * 9.81 * 0.05, robot, hint="horizontal distance")
    check, joints = bring_your_own_robot.check_twelve_motors, ("swing", "lift", "knee")
    says(check, legged(tmp_path, joints))
    says(check, legged(tmp_path, joints[1:]), hint="8 motors")
    says(check, "solo12", hint="13 bodies")
    says(check, tmp_path / "none.xml", hint="does not exist")
    says(check, legged(tmp_path, joints, 'range="-0.6 0.6"', 'range="-0.6 0.7"'), hint="0 joints")
    sphere = '<geom type="sphere" size="0.05" mass="0" group="5"/>'
    says(check, legged(tmp_path, joints, sphere, ""), hint="no collision spheres")
