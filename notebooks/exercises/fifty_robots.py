"""Exercises of 02_fifty_robots."""

from statistics import median

from exercises import checker, need


@checker
def check_growth(answer):
    """Parameters of a fixed body, a body on a hinge without a motor, a driven segment with foot."""
    a, b, c = answer
    need(a == 13, "(a) A body by itself has 13 parameters, with or without a hinge.")
    need(b == 24, "(b) A hinge adds 11 to its body's 13, with or without a motor.")
    need(c == 30, "(c) Body and hinge, then 3 for the motor and 3 for the foot.")
    return "13 per body, 11 per hinge, 3 per motor, 3 per foot."


@checker
def check_per_motor(name, table):
    """The name of the robot with the most design parameters per motor; table: {name: row}."""
    ratios = {x: row["design_dim"] / row["actuators"] for x, row in table.items()}
    need(name in ratios, f"There is no robot {name!r}; use a name of sb.robots().")
    best = max(ratios.values())
    need(ratios[name] == best, f"{name} has {ratios[name]:.1f} per motor, another robot has more.")
    return f"{best:.1f} parameters per motor; the median is {median(ratios.values()):.1f}."
