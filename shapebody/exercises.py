"""Checkers of the exercises in the notebooks.

Each takes an answer and prints either "Right" with a sentence about why, or a hint. An answer of
None means "not tried yet". Answers that are functions may be called with any valid input.
"""

import numpy as np

from shapebody.arguments import require_array, require_integer, require_kind, require_number, single


def _waiting(answer, task: str) -> bool:
    if answer is None:
        print(f"Not answered yet: {task}")
        return True
    return False


def _is_function(answer, task: str) -> bool:
    """Whether a function was handed over; says what is missing if not."""
    if _waiting(answer, task):
        return False
    if not callable(answer):
        print("Not yet. Hand over the function itself, without calling it.")
        return False
    return True


def _require_space(space) -> None:
    from shapebody.design.space import DesignSpace

    require_kind("space", space, DesignSpace, "shapebody.DesignSpace(robot)")


def _say(right: bool, praise: str, hint: str) -> None:
    print(f"Right. {praise}" if right else f"Not yet. {hint}")


def _shown(answer) -> str:
    """An answer on one line, shortened if it is long."""
    text = " ".join(repr(answer).split())
    return text if len(text) <= 80 else f"{text[:77]}..."


def _number(answer) -> float | None:
    try:
        value = float(answer)
    except (TypeError, ValueError, OverflowError):
        value = np.nan
    if not np.isfinite(value):
        print(f"Not yet. The answer is {_shown(answer)}; it should be one number.")
        return None
    return value


def _numbers(answer, count: int) -> np.ndarray | None:
    """The answer as `count` finite numbers, None if it is anything else."""
    try:
        values = np.array([float(x) for x in answer])
    except (TypeError, ValueError, OverflowError):
        return None
    return values if values.shape == (count,) and np.isfinite(values).all() else None


def _array(returned) -> np.ndarray | None:
    """What a function returned, as an array; says what is wrong if there is none."""
    if returned is None:
        print("Not answered yet: the function returns None.")
        return None
    try:
        return np.asarray(returned, float)
    except (TypeError, ValueError):
        print(f"Not yet. The function returns {_shown(returned)}; expected an array of numbers.")
        return None


# ------------------------------------------------------------------ 00 quickstart


def check_trust_regions(results) -> None:
    """Exercise: VGDS from one start with λ = 0, 20 and 100.

    results: {λ: SearchResult}.
    """
    if _waiting(results, "put the three results into a dictionary {0: ..., 20: ..., 100: ...}."):
        return
    if not isinstance(results, dict) or set(results) != {0, 20, 100}:
        print("Not yet. Expected a dictionary with the keys 0, 20 and 100.")
        return
    from shapebody.optimizers.search import SearchResult

    for trust_region, result in results.items():
        if not isinstance(result, SearchResult):
            print(
                f"Not yet. The value under {trust_region} is of type {type(result).__name__}; "
                "keep the whole result that search returns."
            )
            return
        used = result.settings["trust_region"]
        if result.method != "vgds" or used != trust_region:
            print(
                f"Not yet. The result under {trust_region} is of method {result.method!r} with "
                f"trust_region={used:g}; call search('vgds', ..., trust_region={trust_region})."
            )
            return
    starts = [np.asarray(result.trajectory)[0] for result in results.values()]
    if any(not np.array_equal(starts[0], start) for start in starts[1:]):
        print("Not yet. The searches began at different designs; use one start for all three.")
        return
    first, *others = (result.settings for result in results.values())
    changed = [key for key in first if any(first[key] != other.get(key) for other in others)]
    changed = [key for key in changed if key != "trust_region"]
    if changed:
        print(f"Not yet. The searches also differ in {', '.join(changed)}; change λ alone.")
        return
    distance = {key: float(np.sqrt(np.mean(results[key].design ** 2))) for key in (0, 20, 100)}
    listing = ", ".join(f"{value:.3f} at λ = {key}" for key, value in distance.items())
    _say(
        distance[0] >= distance[20] >= distance[100],
        f"The distance |f| / √d from the reference is {listing}: the larger λ, the closer.",
        f"The distance |f| / √d is {listing}. It should fall with λ.",
    )


def check_largest_step(answer, result) -> None:
    """Exercise: the largest change of one design parameter in one iteration of a search."""
    if _waiting(answer, "the largest change of any parameter between two rows of the trajectory."):
        return
    from shapebody.optimizers.search import SearchResult

    require_kind("result", result, SearchResult, "shapebody.optimizers(...)")
    answer = _number(answer)
    if answer is None:
        return
    largest = float(np.abs(np.diff(result.trajectory, axis=0)).max())
    if abs(answer - float(np.abs(result.trajectory[-1] - result.trajectory[0]).max())) < 1e-4:
        print("Not yet. That is the change over the whole search; look at single iterations.")
        return
    limit = result.settings["max_update"]
    _say(
        abs(answer - largest) < 1e-3,
        f"It is {largest:.4f}, while δ_max = {limit:g} would allow more: Adam's own step is about "
        f"its learning rate {result.settings['learning_rate']:g}.",
        "Take differences of neighbouring rows with np.diff(..., axis=0), then the largest "
        "magnitude.",
    )


# ------------------------------------------------------------------ 01 robots and designs


def check_total_mass(function, space) -> None:
    """Exercise: total mass in kg of the design whose three size entries are x, all others 0.

    function: x -> kg, without calling Φ.
    """
    if not _is_function(
        function, "write a function of x and hand the function over, not a number."
    ):
        return
    _require_space(space)
    xs = np.array([-1.0, -0.4, 0.0, 0.3, 1.0], np.float32)
    designs = np.zeros((len(xs), space.dim), np.float32)
    designs[:, space.slices["size"]] = xs[:, None]
    true = np.asarray(space(designs).body_mass).sum(-1)
    for x, expected in zip(xs, true, strict=True):
        given = _number(function(float(x)))
        if given is None:
            return
        if abs(given - expected) > 1e-3 * expected:
            linear = abs(given - true[2] * (1 + 0.8 * x)) < 1e-3 * abs(given)
            hint = "A body grows in three directions, so its mass grows with a³." if linear else ""
            print(
                f"Not yet. At x = {x:g} the robot weighs {expected:.3f} kg and the function says "
                f"{given:.3f}. {hint}".rstrip()
            )
            return
    _say(True, f"From {true[0]:.2f} kg at x = -1 to {true[-1]:.1f} kg at x = 1.", "")


def check_heavier(f, space, kilograms: float = 1.0) -> None:
    """Exercise: the design nearest to the reference that is `kilograms` heavier."""
    if _waiting(f, "use the gradient of the total mass at the reference, and a step along it."):
        return
    _require_space(space)
    require_number("kilograms", kilograms)
    try:
        f = single(require_array("f", f, finite=False))
    except ValueError:
        print(f"Not yet. The answer is {_shown(f)}; it should be one design [{space.dim}].")
        return
    try:
        f = space.validate(f)
    except ValueError as error:
        print(f"Not yet. {error}")
        return
    if f.ndim != 1:
        print(f"Not yet. Expected one design [{space.dim}], got shape {f.shape}.")
        return
    import jax

    def mass(design):
        return space(design).body_mass.sum()

    gradient = np.asarray(jax.grad(mass)(space.reference))
    gained = float(mass(f) - mass(space.reference))
    # To first order, the shortest step is along the gradient.
    shortest = kilograms / np.linalg.norm(gradient)
    length = float(np.linalg.norm(f))
    if abs(gained - kilograms) > 0.02 * kilograms:
        print(
            f"Not yet. The design is {gained:+.3f} kg off the reference instead of "
            f"{kilograms:+g}. Φ is not linear: correct the step, or take several small ones."
        )
        return
    _say(
        length <= 1.05 * shortest,
        f"{gained:+.3f} kg with |f| = {length:.4f}; a straight line of that gradient needs "
        f"{shortest:.4f}.",
        f"The mass is right, but |f| = {length:.4f} is far from the shortest, {shortest:.4f}. "
        "Move along the gradient and leave everything else at 0.",
    )


# ------------------------------------------------------------------ 02 locomotion task


def check_reward(function) -> None:
    """Exercise: the reward of one step from its 23 terms.

    function: (terms [23], unweighted; coefficient c) -> reward.
    """
    if not _is_function(function, "write a function (terms, c) and hand the function over."):
        return
    from shapebody.task.config import CONTROL_STEP
    from shapebody.task.rewards import TERMS, combine

    def compared(terms, c):
        """The reward that the function gives, None if it is no number, and the right one."""
        given = _number(function(terms.copy(), c))
        return given, float(combine(terms.astype(np.float32), c))

    step_hint = "All weights are multiplied by the control step of 0.02 s."
    c_hint = "T1 and T2 count in full; T3 to T23 are multiplied by c."
    alive_hint = "T4 is added after the clipping, so that being alive always pays."
    clip_hint = "The reward is never negative: one part of the sum is clipped at 0."
    weights = CONTROL_STEP * np.array([term.weight for term in TERMS])
    calm = np.array([0.5, 0.5, 1, 1, *np.zeros(19)])
    charged = calm.copy()
    charged[4] = -1000.0  # so much that the sum is clipped
    # One term at a time, changed by an amount that its weight makes noticeable while the sum stays
    # positive. T3 and T4 are 1 in every step, so they are judged by the reward itself. Weights
    # show at c = 1, the terms that c multiplies below it.
    varied = [0, 1, *range(4, len(TERMS))]
    for c in (1.0, 0.4):
        given, expected = compared(calm, c)
        if given is None:
            return
        counts = np.ones(len(TERMS))  # how often a term counts, 1 if it counts by its weight
        for i in varied:
            terms = calm.copy()
            terms[i] += 0.5 if i < 2 else -0.005 / weights[i]
            changed, right = compared(terms, c)
            if changed is None:
                return
            counts[i] = (changed - given) / (right - expected)
        if np.abs(counts - 1).max() < 1e-3:
            clipped, left = compared(charged, c)
            if clipped is None:
                return
            if clipped < 0:
                print(f"Not yet. With large penalties the reward is {clipped:.5f}. {clip_hint}")
                return
            if abs(given - expected) < 1e-6 and clipped < left - 1e-6:
                print(
                    f"Not yet. With large penalties the reward is {left:.5f} at c = {c:g}, not "
                    f"{clipped:.5f}. {alive_hint}"
                )
                return
            # Of the two terms only T4 counts where the sum is clipped.
            counts[3] = clipped / left
            counts[2] = 1 + (given - expected - (clipped - left)) / (c * weights[2])
        wrong = np.flatnonzero(np.abs(counts - 1) > 1e-3)
        if len(wrong) == 0:
            continue
        names = ", ".join(f"T{i + 1}" for i in wrong)
        if np.allclose(counts[varied], 1 / CONTROL_STEP, rtol=1e-3):
            print(f"Not yet. The reward is {1 / CONTROL_STEP:g} times too large. {step_hint}")
        elif np.allclose(counts[4:], -1, rtol=1e-3):
            print("Not yet. T5 to T23 are penalties because they are negative; add them.")
        elif len(wrong) == 1:
            i = wrong[0]
            how = "does not count"
            if abs(counts[i]) > 1e-3:
                how = f"counts {counts[i]:.4g} times as much as it should"
            hint = c_hint if c < 1 else "Term k has the weight TERMS[k - 1].weight."
            print(f"Not yet. At c = {c:g}, {names} ({TERMS[i].name}) {how}. {hint}")
        elif c < 1:
            print(f"Not yet. At c = {c:g}, {names} count too much or too little. {c_hint}")
        else:
            print(f"Not yet. {names} do not count by their weights, which are in TERMS.")
        return
    generator = np.random.default_rng(0)
    for trial in range(20):
        terms = np.concatenate(
            [generator.uniform(0, 1, 2), [1, 1], -generator.exponential(1.0, 19)]
        )
        # The first trials are gentle, so that the clipping does not hide the sum.
        terms[4:] *= 1e-3 if trial < 10 else 1.0
        c = float(generator.uniform(0.05, 1)) if trial % 10 else float(trial // 10)
        given, expected = compared(terms, c)
        if given is None:
            return
        if abs(given - expected) < 1e-5:
            continue
        hint = clip_hint if given < 0 else c_hint if trial < 10 else alive_hint
        print(f"Not yet. At c = {c:.2f} the reward is {expected:.5f}, not {given:.5f}. {hint}")
        return
    _say(True, "The function agrees with the task term by term and on 20 random steps.", "")


def check_successes(answer, levels: int = 100) -> None:
    """Exercise: successes in a row that raise the curriculum coefficient from 0 to 1."""
    require_integer("levels", levels, 1)
    if _waiting(answer, "the number of successful episodes in a row."):
        return
    answer = _number(answer)
    if answer is None:
        return
    needed = next(n for n in range(1, levels + 1) if n * (n + 1) // 2 >= levels)
    if answer == levels:
        print(
            f"Not yet. That would be right if every success added 1/{levels}; "
            "the k-th success in a row adds k times as much."
        )
        return
    _say(
        answer == needed,
        f"1 + 2 + … + {needed} = {needed * (needed + 1) // 2} ≥ {levels}.",
        "Find the smallest n with 1 + 2 + … + n at least "
        f"{levels}. A streak starts at 1 with the first success.",
    )


# ------------------------------------------------------------------ 03 training


def check_gae(function) -> None:
    """Exercise: generalized advantage estimation of one episode that does not end.

    function: (reward [T], value [T], last_value, discount, gae_lambda) -> advantages [T].
    """
    if not _is_function(function, "write the function and hand it over."):
        return
    import jax.numpy as jnp

    from shapebody.training.losses import advantages

    generator = np.random.default_rng(0)
    for steps, discount, gae_lambda in (
        (1, 0.9, 0.5),
        (6, 0.9, 0.0),
        (6, 0.9, 1.0),
        (9, 0.99, 0.7),
    ):
        reward, value = generator.normal(size=(2, steps)).astype(np.float32)
        last = np.float32(generator.normal())
        given = _array(function(reward.copy(), value.copy(), float(last), discount, gae_lambda))
        if given is None:
            return
        never = jnp.zeros((1, steps), bool)
        arguments = (jnp.asarray(x)[None] for x in (reward, value))
        expected = advantages(
            *arguments, jnp.asarray(last)[None], never, never, discount, gae_lambda
        )
        expected = np.asarray(expected)[0]
        if given.shape != expected.shape:
            print(f"Not yet. Expected one number per step, {expected.shape}, got {given.shape}.")
            return
        if np.abs(given - expected).max() < 1e-4:
            continue
        error = reward + discount * np.append(value[1:], last) - value
        if abs(given[-1] - error[-1]) > 1e-4:
            hint = "After the last step comes last_value."
        elif np.abs(given - error).max() < 1e-4:
            hint = "These are the one-step errors; add the discounted advantage of the next step."
        else:
            hint = "Go backwards: A_t = δ_t + γ λ A_{t+1}."
        print(f"Not yet. At γ = {discount:g} and λ = {gae_lambda:g} the numbers differ. {hint}")
        return
    _say(True, "The function agrees with the one that trains the agent.", "")


def check_surrogate(function, clip_range: float = 0.1) -> None:
    """Exercise: the clipped surrogate of PPO. function: (ratio, advantage) -> gain, arrays."""
    require_number("clip_range", clip_range, 0, 1)
    if not _is_function(function, "write the function and hand it over."):
        return
    ratio, advantage = (
        x.ravel() for x in np.meshgrid([0.5, 0.95, 1.0, 1.05, 1.5], [-2.0, -1.0, 0.0, 1.0, 2.0])
    )
    given = _array(function(ratio.copy(), advantage.copy()))
    if given is None:
        return
    clipped = np.clip(ratio, 1 - clip_range, 1 + clip_range)
    expected = np.minimum(ratio * advantage, clipped * advantage)
    if given.shape != expected.shape:
        print(f"Not yet. Expected an array of shape {expected.shape}, got {given.shape}.")
        return
    wrong = np.flatnonzero(~(np.abs(given - expected) <= 1e-6))  # so that NaN is wrong
    if len(wrong) == 0:
        _say(True, "The gain is never above the unclipped one: a pessimistic estimate.", "")
    elif np.abs(given - clipped * advantage).max() < 1e-6:
        print("Not yet. Clipping alone would stop the correction of a step that went wrong.")
    else:
        i = wrong[0]
        print(
            f"Not yet. At ratio {ratio[i]:g} and advantage {advantage[i]:g} the gain is "
            f"{expected[i]:g}, not {given[i]:g}."
        )


# ------------------------------------------------------------------ 04 value-gradient design


def check_step(function, max_update: float = 0.1) -> None:
    """Exercise: the two clips of eq. (7). function: (f [d], Adam's step [d]) -> next design [d]."""
    require_number("max_update", max_update, above=0)
    if not _is_function(function, "write the function and hand it over."):
        return
    f = np.array([0.0, 0.0, 0.0, 0.95, 0.95, -0.95, 0.98, 1.0, 1.0, -1.0])
    step = np.array([0.05, 0.3, -0.3, 0.04, 0.3, -0.4, -0.5, -0.02, 0.05, -0.05])
    given = _array(function(f.copy(), step.copy()))
    if given is None:
        return
    expected = np.clip(f + np.clip(step, -max_update, max_update), -1, 1)
    if given.shape != expected.shape:
        print(f"Not yet. Expected a design of shape {expected.shape}, got {given.shape}.")
        return
    wrong = np.flatnonzero(~(np.abs(given - expected) <= 1e-6))  # so that NaN is wrong
    i = wrong[0] if len(wrong) else 0
    if np.abs(given).max() > 1 + 1e-6:
        hint = "An entry leaves [-1, 1]; the outer clip keeps the design in its box."
    elif np.abs(given - f).max() > max_update + 1e-6:
        hint = f"An entry moves by more than δ_max = {max_update:g}; the inner clip comes first."
    else:
        hint = f"From {f[i]:g} a step of {step[i]:g} leads to {expected[i]:g}, not {given[i]:g}."
    _say(len(wrong) == 0, "Both clips are in their places.", hint)


def check_radius(function, dim: int = 358) -> None:
    """Exercise: how far a value gradient can pull one entry from the reference.

    function: (one entry g of the value gradient, λ) -> |f - f_ref| where it balances the penalty.
    """
    require_integer("dim", dim, 1)
    if not _is_function(function, "write a function (g, λ) and hand it over."):
        return
    for g, trust_region in ((0.1, 20.0), (-0.1, 100.0), (0.02, 50.0), (5.0, 20.0)):
        given = function(g, trust_region)
        if given is None:
            print("Not answered yet: the function returns None.")
            return
        given = _number(given)
        if given is None:
            return
        balance = dim * abs(g) / (2 * trust_region)
        if abs(given - min(balance, 1.0)) < 1e-3:
            continue
        if given < 0:
            hint = "A distance is not negative: the sign of g says only to which side."
        elif abs(given - balance) < 1e-3:
            hint = "No entry can leave the box, so the distance from f = 0 is at most 1."
        elif abs(abs(given) - 2 * min(balance, 1.0)) < 1e-3:
            hint = "The derivative of a square brings a factor of 2."
        else:
            hint = "Set the derivative of the penalty, 2 λ (f - f_ref) / d, equal to g."
        print(f"Not yet. For g = {g:g} and λ = {trust_region:g}: {hint}")
        return
    _say(True, f"With d = {dim}, larger λ means a proportionally smaller distance.", "")


# ------------------------------------------------------------------ 05 fifty robots


def check_growth(answer) -> None:
    """Exercise: parameters that a fixed body, a body on a hinge without a motor, and a driven
    segment with a foot add to a design vector; three numbers."""
    if _waiting(answer, "three numbers (a, b, c)."):
        return
    given = _numbers(answer, 3)
    if given is None or np.any(given % 1):
        print(
            f"Not yet. The answer is {_shown(answer)}; it should be three whole numbers (a, b, c)."
        )
        return
    hints = (
        "(a) A body by itself has 13 parameters, with or without a hinge.",
        "(b) A hinge adds 11 to its body's 13, with or without a motor.",
        "(c) Body and hinge, then 3 for the motor and 3 for the foot.",
    )
    wrong = [hint for x, y, hint in zip(given, (13, 24, 30), hints, strict=True) if x != y]
    _say(not wrong, "13 per body, 11 per hinge, 3 per motor, 3 per foot.", " ".join(wrong[:1]))


def check_per_motor(answer) -> None:
    """Exercise: the name of the shipped robot with the most design parameters per motor."""
    if _waiting(answer, 'the name of a robot, such as "unitree_go2".'):
        return
    if not isinstance(answer, str):
        print(f"Not yet. The answer is {_shown(answer)}; it should be the name of one robot.")
        return
    from shapebody.reproduction.robot_catalog import robot_table
    from shapebody.robot.robot import robots

    if answer not in robots():
        print(f"Not yet. There is no robot {_shown(answer)}; use a name of sb.robots().")
        return
    ratios = {row["name"]: row["design_dim"] / row["actuators"] for row in robot_table()}
    best = max(ratios, key=ratios.get)
    _say(
        answer == best,
        f"{ratios[best]:.1f} parameters per motor; the median is "
        f"{np.median(list(ratios.values())):.1f}.",
        f"{answer} has {ratios[answer]:.1f} per motor, another robot has more.",
    )


# ------------------------------------------------------------------ 06 bring your own robot


def check_knee_torque(answer, robot) -> None:
    """Exercise: torque in N m at the last hinge of a leg, with the weight shared by all feet."""
    from shapebody.robot.robot import require_robot

    require_robot(robot)
    if _waiting(answer, "one number in N m."):
        return
    answer = _number(answer)
    if answer is None:
        return
    import mujoco

    model, data = robot.model, mujoco.MjData(robot.model)
    data.qpos[:] = robot.home
    mujoco.mj_kinematics(model, data)
    joint = model.body_jntadr[robot.foot_bodies[0]]
    reach = data.geom_xpos[robot.feet[0]] - data.xanchor[joint]
    weight = -model.body_mass[1:].sum() * model.opt.gravity
    turn = np.cross(reach, weight) @ data.xaxis[joint]
    expected = abs(turn) / robot.num_feet

    def near(value):
        return abs(abs(answer) - value) <= 0.05 * value

    hints = (
        (expected * robot.num_feet, "That is one knee with the whole weight; all feet carry it."),
        (expected / 9.81, "A mass is not a force: multiply by 9.81 m/s²."),
        (
            np.linalg.norm(weight) / robot.num_feet * abs(reach[2]),
            "The force is vertical, so its lever is the horizontal distance from knee to foot.",
        ),
        (
            np.linalg.norm(weight) / robot.num_feet * np.linalg.norm(reach),
            "The lever is not the length of the shin, only its horizontal part.",
        ),
    )
    hint = next(
        (text for value, text in hints if near(value)),
        "Weight on one foot times the horizontal distance from knee to foot.",
    )
    limit = model.actuator_forcerange[:, 1].min()
    _say(
        near(expected),
        f"It is {expected:.2f} N m; the weakest motor has {limit:g} N m.",
        hint,
    )


def check_twelve_motors(path) -> None:
    """Exercise: the notebook's robot with a third hinge and motor in each leg.

    path: a file that validates with nothing left to say.
    """
    if _waiting(path, "write the file and hand over its path."):
        return
    from shapebody.robot.report import validate_robot

    try:
        report = validate_robot(path)
    except TypeError:
        print(f"Not yet. Hand over the path of the file, not {type(path).__name__}.")
        return
    except ValueError as error:
        print(f"Not yet. {error}")
        return
    problem = report.problems[0] if report.problems else _lift_problem(report.robot)
    if problem:
        print(f"Not yet. {problem}")
        return
    left = (*report.inferred, *report.warnings)
    _say(
        not left,
        f"d = {report.robot.design_dim}: a hinge adds 11 parameters and its motor 3, a further "
        "body would add 13.",
        f"The report still says: {left[0]}" if left else "",
    )


def _lift_problem(robot) -> str:
    """What keeps a robot from being the Turtle with a lift in each thigh; empty if nothing does."""
    import mujoco

    model, data = robot.model, mujoco.MjData(robot.model)
    bodies = {model.body(i).name: i for i in range(1, model.nbody)}
    legs = ("FL", "FR", "RL", "RR")
    turtle = ["trunk", *(f"{leg}_{part}" for leg in legs for part in ("thigh", "shin"))]
    missing = [name for name in turtle if name not in bodies]
    if robot.num_actuators != 12:
        return f"The robot has {robot.num_actuators} motors instead of 12."
    if len(bodies) != len(turtle):
        return (
            f"The robot has {len(bodies)} bodies and the Turtle has {len(turtle)}. Start from the "
            "Turtle, and put the hinge into the thigh without a new body."
        )
    if missing:
        return f"There is no body {missing[0]!r} in the file. Start from the Turtle."
    data.qpos[:] = robot.home
    mujoco.mj_kinematics(model, data)
    for leg in legs:
        thigh, shin = (
            model.body_jntadr[body] + np.arange(model.body_jntnum[body])
            for body in (bodies[f"{leg}_thigh"], bodies[f"{leg}_shin"])
        )
        if (len(thigh), len(shin)) != (2, 1):
            return (
                f"{leg}_thigh has {len(thigh)} of the hinges and {leg}_shin {len(shin)}; expected "
                "2 and 1, the new one in the thigh."
            )
        along = np.abs(data.xaxis[thigh] @ data.xaxis[shin[0]]) > 0.999
        if along.sum() != 1:
            return (
                f"{along.sum()} of the two hinges of {leg}_thigh turn about the axis of the knee; "
                "expected 1, the new one."
            )
        lift = int(thigh[np.argmax(along)])
        low, high = model.jnt_range[lift]
        if abs(low + 0.6) > 1e-3 or abs(high - 0.6) > 1e-3:
            return (
                f"Joint {model.joint(lift).name!r} has the range {low:.3g} to {high:.3g} instead "
                "of -0.6 to 0.6 rad."
            )
    return ""


# ------------------------------------------------------------------ 07 trust region


def check_penalty_coefficient(function) -> None:
    """Exercise: the λ at which a uniformly random design has a given mean penalty.

    function: (mean penalty p, value a of all entries of the reference) -> λ.
    """
    if not _is_function(function, "write a function (p, a) and hand it over."):
        return
    for p, a in ((33.0, 0.0), (10.0, 0.0), (10.0, 0.5), (4.0, -1.0)):
        given = function(p, a)
        if given is None:
            print("Not answered yet: the function returns None.")
            return
        given = _number(given)
        if given is None:
            return
        expected = p / (1 / 3 + a * a)

        def near(value, given=given):
            return abs(given - value) < 1e-3 * abs(value)

        if near(expected):
            continue
        if a and near(3 * p):
            hint = "That is right for a = 0; the mean of (f - a)² also has a part from a."
        elif a and near(p / (1 / 3 - a * a)):
            hint = "A reference away from the middle makes the penalty larger, for both signs of a."
        elif near(p / (1 / 12 + a * a)):
            hint = "1/12 is the variance on an interval of length 1; ours has length 2."
        elif near(p / (1 / 2 + a * a)):
            hint = "The penalty squares the entries: take the mean of f², not that of |f|."
        else:
            hint = "Find the mean of (f - a)² for one entry f; all entries have the same."
        print(f"Not yet. For p = {p:g} and a = {a:g}: {hint}")
        return
    _say(True, "For a = 0 it is 3 p: at λ = 100 a random design pays about 33.", "")


def check_held_out(answer, gains, trust_regions) -> None:
    """Exercise: choose λ on the first half of the starts, and test it on the others.

    answer: (λ, its mean gain on the first half, its mean gain on the other starts).
    gains: [λ, start]. trust_regions: the λ of its rows.
    """
    gains = require_array("gains", gains, ("λ", "start")).astype(float)
    rows = require_array("trust_regions", trust_regions, (len(gains),)).astype(float)
    if gains.shape[1] < 2:
        raise ValueError(f"gains has shape {gains.shape}; expected two or more starts")
    if _waiting(answer, "three numbers (λ, mean on the first half, mean on the second half)."):
        return
    given = _numbers(answer, 3)
    if given is None:
        print(f"Not yet. The answer is {_shown(answer)}; it should be three numbers.")
        return
    from itertools import combinations

    trust_regions, count = rows, gains.shape[1]

    def halves(chosen):
        inside = np.isin(np.arange(count), chosen)
        first, second = gains[:, inside].mean(1), gains[:, ~inside].mean(1)
        best = int(np.argmax(first))
        return trust_regions[best], first[best], second[best]

    expected = halves(range(count // 2))
    if abs(given[0] - expected[0]) > 1e-6:
        at_all = trust_regions[int(np.argmax(gains.mean(1)))]
        hint = "Take the largest mean over the first half of the columns."
        if abs(given[0] - at_all) < 1e-6:
            hint = "That λ is the best on all starts; the second half must not be asked yet."
        print(f"Not yet. λ = {given[0]:g} is not the one. {hint}")
        return
    for number, x, y in (("second", given[1], expected[1]), ("third", given[2], expected[2])):
        if abs(x - y) > 1e-2 + 1e-3 * abs(y):
            half = "first" if number == "second" else "other"
            print(f"Not yet. The {number} number is the mean of that row over the {half} half.")
            return
    splits = list(combinations(range(count), count // 2))
    _, inside, outside = np.mean([halves(chosen) for chosen in splits], axis=0)
    _say(
        True,
        f"λ = {expected[0]:g} gains {expected[1]:+.2f} where it was chosen and {expected[2]:+.2f} "
        f"elsewhere. Over all {len(splits)} ways of choosing the half: {inside:+.2f} and "
        f"{outside:+.2f}, overstated by {inside - outside:.2f} on average.",
        "",
    )


# ------------------------------------------------------------------ 08 VGDS versus baselines


def check_cem_generation(function) -> None:
    """Exercise: one generation of the cross-entropy method.

    function: (designs [P, d], scores [P], CEMConfig) -> (mean [d], standard deviations [d]) of the
    next Gaussian.
    """
    if not _is_function(function, "write the function and hand it over."):
        return
    from shapebody.optimizers.cem import CEMConfig

    generator = np.random.default_rng(0)
    for config, spread in (
        (CEMConfig(), 0.4),
        (CEMConfig(particles=10, elite_fraction=0.3), 0.4),
        (CEMConfig(), 0.01),
        (CEMConfig(minimum_std=0.1), 0.1),
    ):
        designs = np.clip(generator.normal(0.2, spread, (config.particles, 6)), -1, 1)
        scores = generator.normal(size=config.particles)
        given = function(designs.copy(), scores.copy(), config)
        if given is None:
            print("Not answered yet: the function returns None.")
            return
        try:
            mean, std = (np.asarray(x, float) for x in given)
        except (TypeError, ValueError):
            mean = std = np.empty(0)
        if mean.shape != (6,) or std.shape != (6,):
            print("Not yet. Expected two arrays of the length of a design: mean and deviations.")
            return
        order = np.argsort(scores)
        elites, losers = designs[order[-config.elites :]], designs[order[: config.elites]]
        if not np.allclose(mean, elites.mean(0), atol=1e-5):
            lost = np.allclose(mean, losers.mean(0), atol=1e-5)
            hint = "These are the worst ones; scores are maximized." if lost else ""
            print(
                f"Not yet. The mean is not that of the {config.elites} best of "
                f"{config.particles} designs. {hint}".rstrip()
            )
            return
        if np.allclose(std, np.maximum(elites.std(0), config.minimum_std), atol=1e-5):
            continue
        if np.allclose(std, elites.std(0), atol=1e-5):
            hint = f"No deviation may fall below {config.minimum_std:g}, or the search freezes."
        elif np.allclose(std, np.maximum(elites.std(0, ddof=1), config.minimum_std), atol=1e-5):
            hint = "Divide by the number of elites, not by one less (ddof=0)."
        else:
            hint = "It is one number per parameter, over the elites."
        print(f"Not yet. The mean is right, the deviations are not. {hint}")
        return
    _say(True, "The search method does the same in every generation.", "")


def check_climb(propose, update) -> None:
    """Exercise: hill climbing, as two functions of the contract `search.loop.Steps`.

    propose: (config, memory, key) -> designs [P, d] in [-1, 1]; update: (config, memory, scored,
    key) -> next memory. config has particles and std, memory is a NamedTuple of the design [d].
    """
    for function in (propose, update):
        if not _is_function(function, "write propose and update and hand both over."):
            return
    import jax

    try:
        left = _climb(propose, update)
    except _NotYetError as error:
        print(error)
    except jax.errors.TracerArrayConversionError:
        print("Not yet. Compiled code cannot use NumPy on arrays; use jnp instead of np.")
    except jax.errors.JAXIndexError:
        print("Not yet. Compiled code cannot pick entries by a mask; use jnp.where or jnp.argmax.")
    except jax.errors.JAXTypeError:
        print(
            "Not yet. Compiled code cannot use if, while, int or float on arrays; use jnp.where "
            "and other functions of jnp."
        )
    else:
        _say(True, f"It stops within {left:.1%} of the first squared distance to the optimum.", "")


class _NotYetError(Exception):
    """What to tell about an answer; raised where no value can be returned, in compiled code."""


def _climb(propose, update) -> float:
    """Climb a quadratic with two functions; the share of the squared distance that is left."""
    from collections import namedtuple
    from types import SimpleNamespace

    import jax
    import jax.numpy as jnp

    from shapebody.optimizers.loop import Scored

    Memory = namedtuple("Memory", "design")
    config = SimpleNamespace(particles=16, std=0.12)
    generator = np.random.default_rng(0)
    optimum = jnp.asarray(generator.uniform(-0.7, 0.7, 10), jnp.float32)
    starts = [np.ones(10, np.float32), generator.uniform(-1, 1, 10).astype(np.float32)]

    def is_array(x):
        array = isinstance(x, jax.Array | np.ndarray)
        return array and jnp.issubdtype(x.dtype, jnp.floating)

    @jax.jit
    def proposer(memory, key):
        designs = propose(config, memory, key)
        if designs is None:
            raise _NotYetError("Not answered yet: propose returns None.")
        if not is_array(designs):
            kind = getattr(designs, "dtype", type(designs).__name__)
            raise _NotYetError(
                f"Not yet. propose returns {kind}; expected one array of floats. jnp.stack makes "
                "one of a list of designs."
            )
        if designs.shape != (config.particles, 10):
            raise _NotYetError(
                f"Not yet. Proposals have shape {designs.shape}; expected one row for each of the "
                f"{config.particles} particles, ({config.particles}, 10)."
            )
        return designs

    @jax.jit
    def updater(memory, scored, key):
        changed = update(config, memory, scored, key)
        if changed is None:
            raise _NotYetError("Not answered yet: update returns None.")
        right = isinstance(changed, Memory) and is_array(changed.design)
        if not right or changed.design.shape != (10,):
            raise _NotYetError(
                "Not yet. update has to return memory._replace(design=...), one design."
            )
        return changed

    @jax.jit
    def height(designs):
        return -jnp.mean((designs - optimum) ** 2, -1)

    inexact = False
    for start in starts:
        memory = Memory(jnp.asarray(start))
        for key in jax.random.split(jax.random.key(0), 150):
            designs = proposer(memory, key)
            values, current = height(designs), height(memory.design)
            before, memory = memory, updater(memory, Scored(designs, values, None, current), key)
            if not float(jnp.abs(designs).max()) <= 1:
                raise _NotYetError("Not yet. A proposal leaves the box [-1, 1]; clip it.")
            reached, best = float(height(memory.design)), float(values.max())
            if not reached >= float(current) - 1e-6:
                raise _NotYetError(
                    "Not yet. The search moved to a worse design. Compare scored.values of the "
                    "best proposal with scored.current."
                )
            target = designs[int(values.argmax())] if best > float(current) else before.design
            tie = abs(best - float(current)) < 1e-6
            inexact |= not tie and float(jnp.abs(memory.design - target).max()) > 1e-5
        left = float(jnp.sum((memory.design - optimum) ** 2) / np.sum((start - optimum) ** 2))
        if left > 0.1:
            raise _NotYetError(
                f"Not yet. After 150 iterations {left:.0%} of the squared distance to the optimum "
                "remain. Do proposals depend on the key, and does the best of them win?"
            )
    if inexact:
        raise _NotYetError(
            "Not yet. The search climbs, but not always to the best proposal, scored.designs at "
            "jnp.argmax(scored.values)."
        )
    middle = Memory(jnp.asarray(starts[1] / 2))
    keys = jax.random.split(jax.random.key(1), 20)
    steps = np.stack([proposer(middle, key) for key in keys]) - middle.design
    if np.array_equal(steps[0], steps[1]):
        raise _NotYetError("Not yet. The proposals are the same for every key; draw them with it.")
    # Within a generation, so that a step shared by all particles counts as none.
    deviation = float(np.sqrt(steps.var(axis=1, ddof=1).mean()))
    shift = float(np.abs(steps.mean((0, 1))).max())
    if abs(deviation - config.std) > 0.1 * config.std or shift > 0.4 * config.std:
        raise _NotYetError(
            f"Not yet. Among the particles, steps have a deviation of {deviation:.3f} and a mean "
            f"of up to {shift:.3f}; expected config.std = {config.std:g} and 0."
        )
    return left


# ------------------------------------------------------------------ 09 design trajectories


def check_pair_distance(function) -> None:
    """Exercise: mean root-mean-square distance over all pairs of designs, without a loop.

    function: (designs [S, d], S >= 2) -> one number.
    """
    if not _is_function(function, "write the function and hand it over."):
        return
    from itertools import combinations

    generator = np.random.default_rng(0)
    for count, dim in ((2, 1), (3, 4), (10, 7)):
        designs = generator.uniform(-1, 1, (count, dim)).astype(np.float32)
        given = function(designs.copy())
        if given is None:
            print("Not answered yet: the function returns None.")
            return
        given = _number(given)
        if given is None:
            return
        pairs = [np.mean((a - b) ** 2, dtype=float) for a, b in combinations(designs, 2)]
        expected = np.mean(np.sqrt(pairs))
        wrong = {
            expected * (count - 1) / count: "The zeros on the diagonal are no pairs: divide by "
            f"S (S - 1) = {count * (count - 1)} instead of S² = {count**2}.",
            expected * np.sqrt(dim): "That is the Euclidean distance; divide the sum of squares by "
            "d before the square root.",
            np.mean(pairs): "The square root is missing.",
            np.sqrt(np.mean(pairs)): "Take the root of every pair first, then the mean.",
        }
        if abs(given - expected) < 1e-4:
            continue
        hints = [hint for value, hint in wrong.items() if abs(given - value) < 1e-4]
        print(
            f"Not yet. For {count} designs of {dim} entries a loop gives {expected:.4f} and the "
            f"function {given:.4f}. {' '.join(hints[:1])}".rstrip()
        )
        return
    _say(True, "It agrees with a loop over all pairs.", "")


def check_covered(function, trajectory) -> None:
    """Exercise: the first iteration at which a start has covered 90 % of its way.

    function: (trajectory [N + 1, d] of one start) -> n, the first with
    |f_n - f_N| <= 0.1 |f_0 - f_N|. trajectory: [N + 1, S, d] of a search, to say what it finds.
    """
    trajectory = require_array("trajectory", trajectory, ("n", "S", "d")).astype(float)
    if not _is_function(function, "write the function and hand it over."):
        return

    def covered(path):
        left = np.linalg.norm(path - path[-1], axis=-1)
        return int(np.argmax(left <= 0.1 * left[0]))

    generator = np.random.default_rng(0)
    # Entries of different speed, so that only the Euclidean distance gives the right number.
    rates = np.linspace(0.8, 0.95, 5) ** np.arange(41)[:, None]
    slow = 0.3 + rates * generator.uniform(-0.5, 0.5, 5)
    turns = np.cos(0.4 * np.arange(41)) * 0.93 ** np.arange(41)
    swinging = np.outer(turns, generator.uniform(-0.5, 0.5, 5)) - 0.2
    real = trajectory
    for path in (slow, swinging, *np.moveaxis(real, 1, 0)):
        given = function(path.copy())
        if given is None:
            print("Not answered yet: the function returns None.")
            return
        given = _number(given)
        if given is None:
            return
        if given == covered(path):
            continue
        left = np.linalg.norm(path - path[-1], axis=-1)
        steps = np.linalg.norm(np.diff(path, axis=0), axis=-1).cumsum()
        to_reference = np.linalg.norm(path, axis=-1)
        wrong = {
            int(np.argmax(left <= 0.9 * left[0])): "That is 10 % of the way.",
            1 + int(np.argmax(steps >= 0.9 * steps[-1])): "That is 90 % of the length of the path, "
            "with all its turns; measure how far it still is to the end.",
            int(np.argmax(to_reference <= 0.1 * to_reference[0])): "Measure the distance to the "
            "last design; the search need not end at the reference.",
            covered(path) + 1: "Row 0 is the start itself, so row n is iteration n.",
            int(np.flatnonzero(left > 0.1 * left[0])[-1]) + 1: "It comes so near earlier already; "
            "the first time counts.",
        }
        print(
            f"Not yet. Here it is iteration {covered(path)}, not {given:g}. "
            f"{wrong.get(int(given), '')}".rstrip()
        )
        return
    found = [covered(path) for path in np.moveaxis(real, 1, 0)]
    last = len(real) - 1
    _say(True, f"These starts need {min(found)} to {max(found)} of {last} iterations.", "")
