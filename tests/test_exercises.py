"""The checkers accept right answers, and give hints for wrong ones."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from shapebody import exercises
from shapebody.design.space import DesignSpace
from shapebody.optimizers.search import SearchResult
from shapebody.robot.robot import load_robot
from shapebody.task.rewards import TERMS


@pytest.fixture(scope="module")
def space():
    return DesignSpace(load_robot("unitree_go2"))


def said(capsys):
    return capsys.readouterr().out.strip()


def result(trust_region, distance, start=0.5, method="vgds", seed=0):
    trajectory = np.linspace(np.full(4, start), np.full(4, distance), 11).astype(np.float32)
    settings = {"trust_region": float(trust_region), "max_update": 0.1, "learning_rate": 0.05}
    return SearchResult(
        design=trajectory[-1],
        trajectory=trajectory,
        objective=0.0,
        history=np.zeros(11, np.float32),
        evaluations=10,
        seconds=1.0,
        compile_seconds=0.0,
        method=method,
        settings=settings | {"seed": seed},
    )


@pytest.mark.parametrize(
    "check, arguments",
    [
        (exercises.check_trust_regions, ()),
        (exercises.check_largest_step, (None,)),
        (exercises.check_total_mass, (None,)),
        (exercises.check_heavier, (None,)),
        (exercises.check_reward, ()),
        (exercises.check_successes, ()),
    ],
)
def test_unanswered(check, arguments, capsys):
    check(None, *arguments)
    assert said(capsys).startswith("Not answered yet")


def test_trust_regions(capsys):
    good = {0: result(0, 0.4), 20: result(20, 0.2), 100: result(100, 0.1)}
    exercises.check_trust_regions(good)
    assert said(capsys).startswith("Right")
    wrong = (
        {0: good[0]},
        good | {20: good[0]},
        good | {20: result(20, 0.2, method="penalty-only")},
        good | {20: result(20, 0.2, start=0.6)},
        good | {100: result(100, 0.45)},
    )
    for answer in wrong:
        exercises.check_trust_regions(answer)
        assert said(capsys).startswith("Not yet")
    for answer, hint in (
        (dict.fromkeys((0, 20, 100), 0.4), "of type float"),
        ({key: one.design for key, one in good.items()}, "of type ndarray"),
        (good | {100: result(100, 0.1, seed=3)}, "differ in seed"),
    ):
        exercises.check_trust_regions(answer)
        text = said(capsys)
        assert text.startswith("Not yet") and hint in text, text


def test_largest_step(capsys):
    one = result(100, 0.1)
    exercises.check_largest_step(0.04, one)
    assert said(capsys).startswith("Right")
    for answer in (0.4, 0.05, "much", np.nan, 10**400, np.ones(3)):
        exercises.check_largest_step(answer, one)
        assert said(capsys).startswith("Not yet")


def test_total_mass(space, capsys):
    mass = space.robot.model.body_mass.sum()
    exercises.check_total_mass(lambda x: mass * (1 + 0.8 * x) ** 3, space)
    assert said(capsys).startswith("Right")
    exercises.check_total_mass(lambda x: mass * (1 + 0.8 * x), space)
    assert "three directions" in said(capsys)
    for answer in (mass, lambda x: None, lambda x: 1.0):
        exercises.check_total_mass(answer, space)
        assert said(capsys).startswith("Not yet")


def test_heavier(space, capsys):
    def mass(f):
        return space(f).body_mass.sum()

    f, target = space.reference, float(mass(space.reference)) + 1
    for _ in range(5):
        gradient = np.asarray(jax.grad(mass)(f))
        f = f + (target - float(mass(f))) * gradient / (gradient @ gradient)
    exercises.check_heavier(f, space)
    assert said(capsys).startswith("Right")
    long_way = f.copy()
    long_way[space.slices["range"]] = 0.5
    for answer in (space.reference, long_way, f[:5], 2 + f, np.stack([f, f])):
        exercises.check_heavier(answer, space)
        assert said(capsys).startswith("Not yet")
    for answer in ("heavy", {"mass": 1.0}, [[0.0], [0.0, 0.0]]):
        exercises.check_heavier(answer, space)
        assert "should be one design" in said(capsys)


WEIGHTS = np.array([term.weight for term in TERMS]) * 0.02


def reward(terms, c, weights=WEIGHTS):
    weighted = weights * terms
    inner = weighted[:2].sum() + c * (weighted[2] + weighted[4:].sum())
    return max(inner, 0) + c * weighted[3]


def with_factors(factors):
    """The reward with the weights of some terms (1 to 23) multiplied by a factor."""
    weights = WEIGHTS.copy()
    for term, factor in factors.items():
        weights[term - 1] *= factor
    return lambda terms, c: reward(terms, c, weights)


def test_reward(capsys):
    for answer in (reward, lambda terms, c: jnp.float32(reward(jnp.asarray(terms), c))):
        exercises.check_reward(answer)
        assert said(capsys).startswith("Right")
    inside = np.append(WEIGHTS[:2], np.zeros(21))
    wrong = (
        (lambda terms, c: reward(terms, c) / 0.02, "control step of 0.02 s"),
        (lambda terms, c: WEIGHTS @ terms, "is clipped at 0"),
        (
            lambda terms, c: max(inside @ terms + c * ((WEIGHTS - inside) @ terms), 0),
            "T4 is added after the clipping",
        ),
        (lambda terms, c: inside @ terms + c * ((WEIGHTS - inside) @ terms), "clipped at 0"),
        (lambda terms, c: c * reward(terms, 1.0), "T1 and T2 count in full"),
        (lambda terms, c: max(WEIGHTS @ terms - 0.001, 0) + c * 0.001, "T3 to T23 are multiplied"),
        (with_factors(dict.fromkeys(range(5, 24), -1)), "are negative; add them"),
        (lambda terms, c: 0.0, "do not count by their weights"),
        (lambda terms, c: "high", "one number"),
        (lambda terms, c: terms, "one number"),
        (3.0, "without calling"),
    )
    for answer, hint in wrong:
        exercises.check_reward(answer)
        text = said(capsys)
        assert text.startswith("Not yet") and hint in text, text


@pytest.mark.parametrize("term", range(1, 24))
def test_reward_with_one_wrong_weight(term, capsys):
    name = f"T{term} ({TERMS[term - 1].name})"
    # The tracking terms and T4 with a minus make the whole reward wrong, by the clipping.
    for factor in (0, 1.01, 2) if term < 5 else (0, 1.01, 2, -1):
        exercises.check_reward(with_factors({term: factor}))
        text = said(capsys)
        assert text.startswith(f"Not yet. At c = 1, {name}")
        assert ("does not count" if factor == 0 else f"{factor:g} times") in text


def test_reward_with_several_terms_dropped(capsys):
    dropped = (6, 7, 12, 13, 14, 15, 17, 18, 21, 22, 23)
    exercises.check_reward(with_factors(dict.fromkeys(dropped, 0)))
    assert said(capsys).startswith("Not yet. T6, T7, T12, T13, T14, T15, T17, T18, T21, T22, T23")
    exercises.check_reward(with_factors({3: 0, 4: 2}))
    assert said(capsys).startswith("Not yet. T3, T4 do not count")


@pytest.mark.parametrize("term", [1, 2, 3, *range(5, 24)])
def test_reward_with_c_at_a_wrong_place(term, capsys):
    def answer(terms, c):
        factor = c if term < 3 else 1 / c if c else 1
        return with_factors({term: factor})(terms, c)

    exercises.check_reward(answer)
    text = said(capsys)
    assert text.startswith(f"Not yet. At c = 0.4, T{term} (") and "multiplied by c" in text


def test_successes(capsys):
    exercises.check_successes(14)
    assert said(capsys).startswith("Right")
    for answer in (100, 10, 15, "many"):
        exercises.check_successes(answer)
        assert said(capsys).startswith("Not yet")


def gae(reward, value, last, discount, gae_lambda, steps_back=True, bootstrap=True):
    following = np.append(value[1:], last if bootstrap else 0)
    error = reward + discount * following - value
    for t in range(len(error) - 2, -1, -1):
        error[t] += steps_back * discount * gae_lambda * error[t + 1]
    return error


def test_gae(capsys):
    exercises.check_gae(gae)
    assert said(capsys).startswith("Right")
    wrong = (
        lambda *arguments: gae(*arguments, steps_back=False),
        lambda *arguments: gae(*arguments, bootstrap=False),
        lambda *arguments: gae(*arguments)[:-1],
        lambda reward, *_: reward,
        lambda *_: "good",
        lambda reward, *_: [[0.0], reward],
        1.0,
    )
    for answer in wrong:
        exercises.check_gae(answer)
        assert said(capsys).startswith("Not yet")


def test_surrogate(capsys):
    exercises.check_surrogate(lambda r, a: np.minimum(r * a, np.clip(r, 0.9, 1.1) * a))
    assert said(capsys).startswith("Right")
    wrong = (
        lambda r, a: np.clip(r, 0.9, 1.1) * a,
        lambda r, a: r * a,
        lambda r, a: a[0],
        lambda r, a: a * np.nan,
        lambda r, a: "gain",
        lambda r, a: [r, 0.0],
    )
    for answer in wrong:
        exercises.check_surrogate(answer)
        assert said(capsys).startswith("Not yet")


def test_step(capsys):
    exercises.check_step(lambda f, step: np.clip(f + np.clip(step, -0.1, 0.1), -1, 1))
    assert said(capsys).startswith("Right")
    wrong = (
        lambda f, step: f + np.clip(step, -0.1, 0.1),
        lambda f, step: np.clip(f + step, -1, 1),
        lambda f, step: np.maximum(f + np.clip(step, -0.1, 0.1), -1),
        lambda f, step: np.minimum(f + np.clip(step, -0.1, 0.1), 1),
        lambda f, step: np.clip(f + np.clip(step, -0.1, 0.1), -1, 5),
        lambda f, step: np.clip(f + np.minimum(step, 0.1), -1, 1),
        lambda f, step: np.clip(f + np.maximum(step, -0.1), -1, 1),
        lambda f, step: f,
        lambda f, step: f[0],
        lambda f, step: f * np.nan,
        lambda f, step: "next",
        lambda f, step: [f, 0.0],
    )
    for answer in wrong:
        exercises.check_step(answer)
        assert said(capsys).startswith("Not yet")


def test_radius(capsys):
    exercises.check_radius(lambda g, trust_region: min(358 * abs(g) / (2 * trust_region), 1))
    assert said(capsys).startswith("Right")
    wrong = (
        lambda g, trust_region: 358 * abs(g) / (2 * trust_region),
        lambda g, trust_region: min(358 * abs(g) / trust_region, 1),
        lambda g, trust_region: g,
        lambda g, trust_region: "far",
    )
    for answer in wrong:
        exercises.check_radius(answer)
        assert said(capsys).startswith("Not yet")


def test_untried_exercises_are_no_errors(capsys):
    names = ("check_gae", "check_surrogate", "check_step", "check_radius")
    for check in (getattr(exercises, name) for name in names):
        for answer in (None, lambda *_: None):
            check(answer)
            assert said(capsys).startswith("Not answered yet")


# 05 fifty robots


def test_growth(capsys):
    check_growth = exercises.check_growth
    for answer, expected in [
        (None, "Not answered yet"),
        (3, "three whole numbers"),
        ((13, 24), "three whole numbers"),
        ((13.9, 24.9, 30.9), "three whole numbers"),
        ((13, 24, np.inf), "three whole numbers"),
        ((14, 24, 30), "(a)"),
        ((13, 11, 30), "(b)"),
        ((13, 24, 27), "(c)"),
        ((13, 24, 30), "Right"),
        (np.array([13.0, 24.0, 30.0]), "Right"),
    ]:
        check_growth(answer)
        assert expected in capsys.readouterr().out


def test_per_motor(capsys):
    for answer, expected in [
        (None, "Not answered yet"),
        ("no_such_robot", "no robot"),
        (["nao_v5"], "name of one robot"),
        (load_robot("nao_v5"), "name of one robot"),
        ("unitree_go2", "another robot has more"),
        ("nao_v5", "Right"),
    ]:
        exercises.check_per_motor(answer)
        assert expected in capsys.readouterr().out


# 06 bring your own robot

LEGGED = """
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


def legged(folder, joints, changes=()):
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
    text = LEGGED.format(legs=legs, motors=motors, zeros=" 0" * number, speeds=" 15" * number)
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = folder / "legged.xml"
    path.write_text(text)
    return path


def test_knee_torque(tmp_path, capsys):
    robot = load_robot(legged(tmp_path, ("swing", "knee")))
    exercises.check_knee_torque(None, robot)
    assert said(capsys).startswith("Not answered yet")
    for answer in (4 * 9.81 / 4 * 0.05, -0.49):
        exercises.check_knee_torque(answer, robot)
        assert said(capsys) == "Right. It is 0.49 N m; the weakest motor has 9 N m."
    for answer, hint in (
        (4 * 9.81 * 0.05, "all feet"),
        (0.05, "not a force"),
        (9.81 * 0.15, "vertical"),
        (9.81 * np.hypot(0.05, 0.15), "length of the shin"),
        (7, "Weight on one foot"),
        ("much", "should be one number"),
    ):
        exercises.check_knee_torque(answer, robot)
        text = said(capsys)
        assert text.startswith("Not yet") and hint in text, answer


def test_twelve_motors(tmp_path, capsys):
    exercises.check_twelve_motors(None)
    assert said(capsys).startswith("Not answered yet")
    joints = ("swing", "lift", "knee")
    exercises.check_twelve_motors(legged(tmp_path, joints))
    assert said(capsys).startswith("Right. d = 306")
    sphere = '<geom type="sphere" size="0.05" mass="0" group="5"/>'
    for path, hint in (
        (legged(tmp_path, ("swing", "knee")), "8 motors"),
        (3, "not int"),
        (tmp_path / "none.xml", "does not exist"),
        ("solo12", "13 bodies and the Turtle has 9"),
        ("berkeley_humanoid", "13 bodies"),
    ):
        exercises.check_twelve_motors(path)
        text = said(capsys)
        assert text.startswith("Not yet") and hint in text
    for change, hint in (
        ((' axis="0 1 0" range="-1 1"', ' axis="0 1 0"'), "has no limits"),
        (('<site name="imu"/>', ""), 'no site "imu"'),
        ((sphere, ""), "no collision spheres"),
        (("FL_thigh", "FL_upper"), "no body 'FL_thigh'"),
        (('lift" axis="0 1 0"', 'lift" axis="1 0 0"'), "0 of the two hinges of FL_thigh"),
        (('swing" axis="0 0 1"', 'swing" axis="0 1 0"'), "2 of the two hinges of FL_thigh"),
        (('range="-0.6 0.6"', 'range="-0.6 0.7"'), "-0.6 to 0.7 instead"),
        (('name="FL_lift" axis="0 1 0"', 'name="FL_lift" axis="0 -1 0"'), "Right"),
        (("_lift", "_third"), "Right"),
    ):
        exercises.check_twelve_motors(legged(tmp_path, joints, [change]))
        text = said(capsys)
        assert text.startswith("Right" if hint == "Right" else "Not yet") and hint in text, text


# 08 VGDS versus baselines


def generation(designs, scores, config):
    elites = designs[np.argsort(scores)[-config.elites :]]
    return elites.mean(axis=0), np.maximum(elites.std(axis=0), config.minimum_std)


def test_cem_generation(capsys):
    check = exercises.check_cem_generation
    for answer in (None, lambda *_: None):
        check(answer)
        assert said(capsys).startswith("Not answered yet")
    check(generation)
    assert said(capsys).startswith("Right")

    def other_deviation(change):
        def function(designs, scores, config):
            elites = designs[np.argsort(scores)[-config.elites :]]
            return elites.mean(axis=0), change(elites, config.minimum_std)

        return function

    for answer, hint in (
        (3, "the function itself"),
        (lambda designs, scores, config: designs[0], "two arrays"),
        (lambda designs, scores, config: 2, "two arrays"),
        (lambda designs, scores, config: generation(designs, -scores, config), "the worst ones"),
        (lambda designs, scores, config: (designs.mean(0), designs.std(0)), "best of 32 designs."),
        (other_deviation(lambda elites, floor: elites.std(0)), "below 0.02"),
        (other_deviation(lambda elites, floor: np.maximum(elites.std(0), 0.02)), "the deviations"),
        (lambda designs, scores, config: ("mean", "std"), "two arrays"),
        (other_deviation(lambda elites, floor: np.maximum(elites.std(0, ddof=1), floor)), "ddof"),
        (other_deviation(lambda elites, floor: elites.var(0)), "one number per parameter"),
    ):
        check(answer)
        text = said(capsys)
        assert text.startswith("Not yet") and hint in text, text


def test_the_exercise_is_what_cem_does():
    from shapebody.optimizers.cem import _CEM, CEMConfig
    from shapebody.optimizers.loop import Scored

    rng = np.random.default_rng(3)
    for spread in (0.3, 0.005):
        designs = rng.normal(0, spread, (32, 4)).clip(-1, 1).astype(np.float32)
        scores = rng.normal(size=32).astype(np.float32)
        memory = _CEM.begin(CEMConfig(), designs[0], None)
        memory = _CEM.update(CEMConfig(), memory, Scored(designs, scores, None, scores[0]), None)
        mean, std = generation(designs, scores, CEMConfig())
        np.testing.assert_allclose(memory.design, mean, atol=1e-6)
        np.testing.assert_allclose(memory.std, std, atol=1e-6)


def climb_propose(config, memory, key):
    noise = jax.random.normal(key, (config.particles, len(memory.design)))
    return jnp.clip(memory.design + config.std * noise, -1, 1)


def climb_update(config, memory, scored, key):
    best = jnp.argmax(scored.values)
    better = scored.values[best] > scored.current
    return memory._replace(design=jnp.where(better, scored.designs[best], memory.design))


def test_climb(capsys):
    check = exercises.check_climb
    check(climb_propose, climb_update)
    assert said(capsys).startswith("Right")

    def nothing(config, memory, *_):
        return None

    for functions in ((nothing, nothing), (climb_propose, nothing)):
        check(*functions)
        assert said(capsys).startswith("Not answered yet")

    def unclipped(config, memory, key):
        return memory.design + jax.random.normal(key, (config.particles, len(memory.design)))

    def single(config, memory, key):
        return memory.design

    def frozen(config, memory, key):
        return jnp.tile(memory.design, (config.particles, 1))

    def careless(config, memory, scored, key):
        return memory._replace(design=scored.designs[0])

    def branching(config, memory, scored, key):
        best = scored.values.argmax()
        return memory._replace(
            design=scored.designs[best] if scored.values[best] > scored.current else memory.design
        )

    def bare(config, memory, scored, key):
        return scored.designs[0]

    def listed(config, memory, key):
        return list(climb_propose(config, memory, key))

    def with_numpy(config, memory, key):
        return np.minimum(climb_propose(config, memory, key), 1)

    def whole(config, memory, key):
        return jnp.zeros((config.particles, len(memory.design)), int)

    def undefined(config, memory, key):
        return climb_propose(config, memory, key) * jnp.nan

    def narrow(config, memory, key):
        noise = jax.random.normal(key, (config.particles, len(memory.design)))
        return jnp.clip(memory.design + 0.1 * noise, -1, 1)

    def unison(config, memory, key):
        step = config.std * jax.random.normal(key, memory.design.shape)
        signs = jnp.where(jnp.arange(config.particles) < 15, 1.0, -1.0)
        return jnp.clip(memory.design + signs[:, None] * step, -1, 1)

    def repeated(config, memory, key):
        return climb_propose(config, memory, jax.random.key(3))

    def integer(config, memory, scored, key):
        return memory._replace(design=scored.designs[int(scored.values.argmax())])

    def masked(config, memory, scored, key):
        return memory._replace(design=scored.designs[scored.values > scored.current][0])

    def numpy_update(config, memory, scored, key):
        best = jnp.argmax(scored.values)
        design = np.where(scored.values[best] > scored.current, scored.designs[best], memory.design)
        return memory._replace(design=design)

    def first_better(config, memory, scored, key):
        first = jnp.argmax(scored.values > scored.current)
        better = scored.values[first] > scored.current
        return memory._replace(design=jnp.where(better, scored.designs[first], memory.design))

    def lost(config, memory, scored, key):
        return memory._replace(design=memory.design * jnp.nan)

    for propose, update, hint in (
        (unclipped, climb_update, "leaves the box"),
        (single, climb_update, "expected one row"),
        (frozen, climb_update, "remain"),
        (climb_propose, careless, "worse design"),
        (climb_propose, branching, "jnp.where"),
        (climb_propose, bare, "_replace"),
        (listed, climb_update, "returns list; expected one array"),
        (lambda *_: "designs", climb_update, "returns str; expected one array"),
        (lambda *_: np.array(["a"]), climb_update, "one array of floats"),
        (whole, climb_update, "returns int32; expected one array of floats"),
        (with_numpy, climb_update, "jnp instead of np"),
        (undefined, climb_update, "leaves the box"),
        (narrow, climb_update, "expected config.std"),
        (unison, climb_update, "Not yet"),
        (repeated, climb_update, "key"),
        (climb_propose, integer, "int or float"),
        (climb_propose, masked, "by a mask"),
        (climb_propose, numpy_update, "jnp instead of np"),
        (climb_propose, first_better, "not always to the best"),
        (climb_propose, lost, "worse design"),
        (climb_propose, lambda *_: "memory", "_replace"),
        (climb_propose, 3, "without calling"),
    ):
        check(propose, update)
        text = said(capsys)
        assert text.startswith("Not yet") and hint in text, text
    check(None, None)
    assert said(capsys).startswith("Not answered yet")


def test_penalty_coefficient(capsys):
    exercises.check_penalty_coefficient(None)
    exercises.check_penalty_coefficient(lambda p, a: None)
    assert said(capsys).count("Not answered yet") == 2
    exercises.check_penalty_coefficient(lambda p, a: p / (1 / 3 + a**2))
    assert said(capsys).startswith("Right")
    wrong = {
        "length 2": lambda p, a: p / (1 / 12 + a**2),
        "mean of f²": lambda p, a: 2 * p,
        "part from a": lambda p, a: 3 * p,
        "both signs": lambda p, a: p / (1 / 3 - a**2),
        "one entry": lambda p, a: p,
        "one number": lambda p, a: "large",
        "without calling": 99.0,
    }
    for hint, answer in wrong.items():
        exercises.check_penalty_coefficient(answer)
        text = said(capsys)
        assert text.startswith("Not yet") and hint in text


def test_held_out(capsys):
    gains = np.array([[1.0, 1.0, 5.0, 5.0], [2.0, 2.0, 0.0, 1.0], [0.0, 0.0, 0.0, 0.0]])
    lambdas = (0.0, 20.0, 100.0)
    exercises.check_held_out(None, gains, lambdas)
    assert said(capsys).startswith("Not answered yet")
    exercises.check_held_out((20, 2.0, 0.5), gains, lambdas)
    # Means of the chosen λ over the six splits, by hand: inside 19/6, outside 13.5/6.
    assert "6 ways of choosing the half: +3.17 and +2.25, overstated by 0.92" in said(capsys)
    wrong = {
        "best on all starts": (0, 1.0, 5.0),
        "largest mean": (100, 0.0, 0.0),
        "second number": (20, 0.5, 2.0),
        "third number": (20, 2.0, 2.0),
        "three numbers": (20, 2.0),
        "should be": "none",
    }
    for hint, answer in wrong.items():
        exercises.check_held_out(answer, gains, lambdas)
        text = said(capsys)
        assert text.startswith("Not yet") and hint in text


# 09 design trajectories


def test_pair_distance(capsys):
    check = exercises.check_pair_distance

    def distances(x):
        return np.sqrt(((x[:, None] - x[None]) ** 2).mean(-1))

    def right(x):
        return distances(x).sum() / (len(x) * (len(x) - 1))

    check(None)
    check(lambda x: None)
    assert said(capsys).count("Not answered yet") == 2
    check(right)
    assert said(capsys).startswith("Right")
    wrong = {
        "diagonal": lambda x: distances(x).mean(),
        "Euclidean": lambda x: right(x) * np.sqrt(x.shape[1]),
        "every pair first": lambda x: np.sqrt((distances(x) ** 2).sum() / (len(x) * (len(x) - 1))),
        "root is missing": lambda x: (distances(x) ** 2).sum() / (len(x) * (len(x) - 1)),
        "a loop gives": lambda x: 0.0,
        "one number": lambda x: distances(x),
        "without calling": 0.5,
    }
    for hint, answer in wrong.items():
        check(answer)
        text = said(capsys)
        assert text.startswith("Not yet") and hint in text, text


def test_covered(capsys):
    shrinking = np.array([0.9, 0.8])[:, None] ** np.arange(21)[:, None, None]
    search = 0.1 + shrinking * np.array([0.5, -0.8, 0.3])  # 20 iterations from two starts

    def left(path):
        return np.linalg.norm(path - path[-1], axis=1)

    def right(path):
        return np.argmax(left(path) <= 0.1 * left(path)[0])

    def along(path):
        length = np.linalg.norm(np.diff(path, axis=0), axis=1).cumsum()
        return 1 + np.argmax(length >= 0.9 * length[-1])

    def settled(path):
        return np.flatnonzero(left(path) > 0.1 * left(path)[0])[-1] + 1

    def to_reference(path):
        far = np.linalg.norm(path, axis=1)
        return np.argmax(far <= 0.1 * far[0])

    def largest_entry(path):
        far = np.abs(path - path[-1]).max(1)
        return np.argmax(far <= 0.1 * far[0])

    check = exercises.check_covered
    check(None, search)
    check(lambda path: None, search)
    assert said(capsys).count("Not answered yet") == 2
    check(right, search)
    assert said(capsys).startswith("Right. These starts need")
    wrong = {
        "10 % of the way": lambda path: np.argmax(left(path) <= 0.9 * left(path)[0]),
        "length of the path": along,
        "reference": to_reference,
        "row n is iteration n": lambda path: right(path) + 1,
        "Here it is iteration": largest_entry,
        "first time": settled,
        "one number": lambda path: "soon",
        "without calling": 7,
    }
    for hint, answer in wrong.items():
        check(answer, search)
        text = said(capsys)
        assert text.startswith("Not yet") and hint in text, text
