"""Diagrams of the method: the pipeline, the URMA encoder, and the two critics."""

import matplotlib.pyplot as plt
from matplotlib.patches import FancyArrowPatch

from shapebody.show.plots import COLOURS

DATA, NETWORK, STEP = "black", "blue", "green"
"""Colours of what is known, what is learned, and what is computed."""


def flow(boxes, arrows, size=(9.0, 2.4)):
    """A diagram of boxes and arrows; returns its figure.

    boxes: {name: (x, y, text, colour)} with x and y from 0 to 1 and a name of `plots.COLOURS`;
    arrows: (from, to).
    """
    figure = plt.figure(figsize=size, layout="none")
    ax = figure.add_axes((0, 0, 1, 1))
    ax.set(xlim=(0, 1), ylim=(0, 1))
    ax.axis("off")
    placed = {}
    for name, (x, y, text, colour) in boxes.items():
        shape = dict(boxstyle="round,pad=0.45", edgecolor=COLOURS[colour], facecolor="white")
        placed[name] = ax.text(x, y, text, ha="center", va="center", fontsize=9, bbox=shape)
    figure.canvas.draw()  # gives the boxes their sizes, at which the arrows end
    for start, end in arrows:
        (x0, y0), (x1, y1) = placed[start].get_position(), placed[end].get_position()
        arrow = FancyArrowPatch(
            (x0, y0),
            (x1, y1),
            arrowstyle="-|>",
            mutation_scale=12,
            color="#6B7280",
            shrinkA=2,
            shrinkB=2,
            patchA=placed[start].get_bbox_patch(),
            patchB=placed[end].get_bbox_patch(),
        )
        ax.add_patch(arrow)
    return figure


def pipeline():
    """From random bodies to a found one: training, policy evaluation, search, evaluation."""
    boxes = {
        "bodies": (0.09, 0.75, "random bodies\n$f \\sim U[-c, c]^d$, $\\Phi(f)$", DATA),
        "training": (0.31, 0.75, "training\npolicy π and a critic", NETWORK),
        "frozen": (0.52, 0.75, "policy evaluation\nπ frozen, critic V anew", NETWORK),
        "bank": (0.52, 0.25, "state bank\nstates $s_m$ of π", DATA),
        "search": (0.74, 0.75, "VGDS\nup $V(s, \\Phi(f))$,\nnear $f_{ref}$", STEP),
        "start": (0.74, 0.22, "start design\n$f_{init}$", DATA),
        "evaluation": (0.93, 0.75, "evaluation\nepisodes of π\nwith $f^*$", STEP),
    }
    arrows = (
        ("bodies", "training"),
        ("training", "frozen"),
        ("frozen", "search"),
        ("frozen", "bank"),
        ("bank", "search"),
        ("start", "search"),
        ("search", "evaluation"),
    )
    return flow(boxes, arrows)


def urma():
    """One joint through the encoder of the policy and back to its action."""
    boxes = {
        "d": (0.06, 0.80, "description $d_j$", DATA),
        "o": (0.06, 0.25, "observation $o_j$", DATA),
        "key": (0.24, 0.80, "key network\n$\\alpha_j$ [L]", NETWORK),
        "value": (0.24, 0.25, "value layer\n$g(o_j)$ [v]", NETWORK),
        "sum": (0.45, 0.52, "sum over joints\n$\\sum_j \\alpha_j \\otimes g(o_j)$", STEP),
        "rest": (0.45, 0.12, "general observations,\nstatic numbers", DATA),
        "core": (0.66, 0.52, "core network\n$h$ [L]", NETWORK),
        "action": (0.88, 0.80, "action of joint j\n$\\mu_j = h \\cdot \\alpha_j$", STEP),
    }
    arrows = (
        ("d", "key"),
        ("o", "key"),
        ("o", "value"),
        ("key", "sum"),
        ("value", "sum"),
        ("sum", "core"),
        ("rest", "core"),
        ("core", "action"),
        ("key", "action"),
    )
    return flow(boxes, arrows)


def critics():
    """Where a description enters: the original critic, and the direct-design critic."""
    boxes, arrows = {}, []
    for at, name, text, value in (
        (0.0, "original", "original", "value layer\n$g(o_j)$"),
        (0.52, "direct", "direct-design", "value layer\n$g(o_j, d_j)$"),
    ):
        boxes |= {
            f"{name} d": (at + 0.06, 0.78, "$d_j$", DATA),
            f"{name} o": (at + 0.06, 0.22, "$o_j$", DATA),
            f"{name} key": (at + 0.19, 0.78, "key network\n$\\alpha_j(d_j, o_j)$", NETWORK),
            f"{name} value": (at + 0.19, 0.22, value, NETWORK),
            f"{name} sum": (at + 0.31, 0.5, "sum", STEP),
            f"{name} head": (at + 0.41, 0.5, f"{text}\n$\\bar V(s, d)$", NETWORK),
        }
        parts = [
            ("d", "key"),
            ("o", "key"),
            ("o", "value"),
            ("key", "sum"),
            ("value", "sum"),
            ("sum", "head"),
        ]
        parts += [("d", "value")] if name == "direct" else []
        arrows += [(f"{name} {a}", f"{name} {b}") for a, b in parts]
    return flow(boxes, arrows)


def actor_and_learner(rollouts: int = 5):
    """Who works when on a CPU: the actor collects with the policy from before the update."""
    figure, ax = plt.subplots(figsize=(7, 1.9))
    style = dict(ha="center", va="center", fontsize=8)
    for n in range(rollouts):
        ax.broken_barh([(n, 0.96)], (1, 0.8), color=COLOURS["sky"])
        ax.text(n + 0.48, 1.4, f"collect {n} with π{max(n - 1, 0)}", **style)
        if n:
            ax.broken_barh([(n, 0.96)], (0, 0.8), color=COLOURS["orange"])
            ax.text(n + 0.48, 0.4, f"learn {n - 1}: π{n - 1} → π{n}", **style)
    ax.set(yticks=[0.4, 1.4], yticklabels=["learner", "actor"], xticks=[], xlabel="time")
    ax.grid(False)
    return figure
