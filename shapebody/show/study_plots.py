"""Figures of the design studies, for the notebooks.

Everything here draws what it is given: arrays, and rows of `gains` with their mean, low and high.
`axes` is what `plots.panels` returns, a panel per robot, unless a docstring says otherwise.
"""

from itertools import combinations

import matplotlib.pyplot as plt
import numpy as np

from shapebody.show.plots import COLOURS, DIVERGING, PAPER, intervals

METHOD_STYLES = {
    "vgds": ("blue", "-"),
    "gc-pfo": ("orange", "-"),
    "penalty-only": ("black", "--"),
    "cem": ("green", "-"),
    "ars": ("red", "-"),
    "de": ("purple", "-"),
    "cma-es": ("sky", "-"),
    "pso": ("green", ":"),
    "turbo": ("red", ":"),
    "bo": ("purple", ":"),
    "random": ("sky", ":"),
}
"""Colour and line of each search method."""


# ------------------------------------------------------------------ over the penalty coefficient


def lambda_axis(ax, lambdas, **labels) -> None:
    """Axis of λ with a tick per value, all equally far apart."""
    ax.set_xticks(range(len(lambdas)), [f"{value:g}" for value in lambdas], fontsize="x-small")
    ax.set(xlabel="λ", **labels)


def over_lambda(ax, lambdas, rows, **style) -> None:
    """Gains with their intervals, one row per λ."""
    mean, low, high = (np.array([row[key] for row in rows]) for key in ("mean", "low", "high"))
    ax.errorbar(range(len(rows)), mean, [mean - low, high - mean], capsize=3, marker="o", **style)
    lambda_axis(ax, lambdas)


def sweep(axes, lambdas, printed, over_start, control, over_control) -> None:
    """The two panels of one robot: gains over the start, and over penalty only.

    printed: ΔR of the paper [λ]; control: the gain of penalty only over the start.
    """
    left, right = axes
    left.plot(printed, "s--", color=PAPER, label="paper")
    over_lambda(left, lambdas, over_start, label="ours")
    left.axhline(control["mean"], color=COLOURS["orange"], label="penalty only, ours")
    left.axhspan(control["low"], control["high"], color=COLOURS["orange"], alpha=0.15, linewidth=0)
    left.set(ylabel="gain over the start")
    over_lambda(right, lambdas, over_control, color=COLOURS["green"])
    right.axhline(0, color=COLOURS["black"], linewidth=1)
    right.set(ylabel="gain over penalty only")


def prediction(ax, lambdas, start, control, found) -> None:
    """Predicted value and true return; start and control [2, S], found [λ, 2, S]."""
    colours = plt.get_cmap("viridis")(np.linspace(0, 0.95, len(lambdas)))
    ax.plot(*start, "o", mfc="none", color=PAPER, label="start")
    ax.plot(*control, "x", color=COLOURS["orange"], label="penalty only")
    for value, colour, points in zip(lambdas, colours, found, strict=True):
        ax.plot(*points, ".", color=colour, label=f"λ = {value:g}")
    ax.set(xlabel="predicted value", ylabel="true return")


def resting_places(ax, lambdas, found, estimate, control) -> None:
    """Distance from the reference by λ.

    found: designs [λ, S, d]; estimate: the distance at rest for each λ > 0; control: the distance
    at which penalty only ends.
    """
    far = np.sqrt(np.mean(found**2, -1)).mean(1)
    spread = np.sqrt(np.mean((found - found.mean(1, keepdims=True)) ** 2, -1)).mean(1)
    ax.plot(far, "o-", label="found designs")
    ax.plot(spread, "s-", color=COLOURS["green"], label="from their own mean")
    ax.plot(range(1, len(lambdas)), estimate, "k--", linewidth=1, label="estimate")
    ax.axhline(control, color=COLOURS["orange"], label="penalty only")
    lambda_axis(ax, lambdas, ylabel="|f| / √d", ylim=(0, None))


# ------------------------------------------------------------------ search methods


def ranking(ax, rows, labels, printed=None, sign=1) -> None:
    """Methods from the worst to the best, each with its interval and the paper's value in grey.

    rows: {method: gain}; printed: {method: number}; sign: -1 where less is better.
    """
    printed = printed or {}
    ours = {m: [sign * row[key] for key in ("mean", "low", "high")] for m, row in rows.items()}
    order = [m for m in printed if m not in ours] + sorted(ours, key=lambda m: ours[m][0])
    shades = {"vgds": "blue", "penalty-only": "black", "reference": "orange"}
    colours = [COLOURS[shades.get(m, "sky")] for m in order]
    intervals([labels[m] for m in order], [ours.get(m) for m in order], colours, ax)
    for method, value in printed.items():
        ax.plot(value, order.index(method), "D", color=PAPER, fillstyle="none")
    ax.axvline(0, color=PAPER, linewidth=1)


def convergence(ax, curves, labels, reference) -> None:
    """Objective over critic evaluations; curves: {method: (evaluations [n], objective [n])}.

    The start, at 0 evaluations, is drawn at 1.
    """
    for method, (evaluations, objective) in curves.items():
        shade, line = METHOD_STYLES[method]
        x = np.maximum(evaluations, 1)
        ax.plot(x, objective, line, color=COLOURS[shade], label=labels[method])
    ax.axhline(reference, color=PAPER, label=labels["reference"], zorder=0)
    ax.set(xscale="log", xlabel="critic evaluations", ylabel="objective")
    _stretch(ax, "y")


def climbers(ax, reached, labels, reference, stretched=True) -> None:
    """Objective and true return; reached: {method: (objective [S], return [S])}.

    reference: its (objective, return). stretched: the objective is logarithmic beyond ±5.
    """
    for method, (x, y) in reached.items():
        shade, line = METHOD_STYLES[method]
        style = dict(color=COLOURS[shade], linestyle="none")
        style |= dict(marker={"-": "o", ":": "^", "--": "s"}[line])
        ax.plot(x, y, alpha=0.25, markersize=4, **style)
        style |= dict(markersize=9, markeredgecolor="w", label=labels[method])
        ax.plot(np.mean(x), np.mean(y), **style)
    ax.plot(*reference, "k*", markersize=11, label=labels["reference"])
    ax.set(xlabel="objective reached", ylabel="true return")
    if stretched:
        _stretch(ax, "x")


def _stretch(ax, axis):
    ticks = (-40, -20, -10, -5, 0, 5)
    getattr(ax, f"set_{axis}scale")("symlog", linthresh=5)
    getattr(ax, f"set_{axis}ticks")(ticks, [str(tick) for tick in ticks])
    ax.minorticks_off()


# ------------------------------------------------------------------ trajectories


def _rms(x, axis=-1):
    return np.sqrt(np.mean(np.square(x), axis=axis))


def meeting(axes, paths) -> None:
    """How starts come together: two panels of one robot.

    paths: {label: (designs [N + 1, S, d], line style)}; chance is shown for the first. Left is the
    mean distance between two starts, right that of their mean from the reference.
    """
    left, right = axes
    for label, (path, style) in paths.items():
        pairs = [np.mean([_rms(a - b) for a, b in combinations(f, 2)]) for f in path]
        left.plot(pairs, style, label=label)
        right.plot(_rms(path.mean(1)), style, label=f"{label}: common point")
    first, _ = next(iter(paths.values()))
    spread = _rms(first - first.mean(1, keepdims=True), (1, 2))
    right.plot(spread / np.sqrt(first.shape[1] - 1), ":", color=PAPER, label="by chance")
    left.set(ylabel="between two starts", ylim=(0, None), xlabel="iteration")
    right.set(ylabel="from the reference", ylim=(0, None), xlabel="iteration")


def distances(ax, apart, order, largest) -> None:
    """Distances between designs [S, S] as a picture, in the order of their points of rest."""
    picture = ax.imshow(apart[order][:, order], cmap="magma", vmin=0, vmax=largest)
    ax.set(xticks=range(len(order)), xticklabels=order, yticks=range(len(order)))
    ax.set(yticklabels=order, xlabel="start", ylabel="start")
    ax.grid(False)
    ax.figure.colorbar(picture, ax=ax, shrink=0.8, label="distance")


def agreement(ax, kinds, common, spread) -> None:
    """Root mean square of the common point and of the spread around it, by kind of parameter."""
    place = np.arange(len(kinds))
    ax.barh(place - 0.2, common, 0.4, label="common point")
    ax.barh(place + 0.2, spread, 0.4, label="spread")
    ax.set(yticks=place, yticklabels=kinds, xlabel="|f|, root mean square")


def way(axes, searches) -> None:
    """Predicted value, penalty and distance over the iterations, a thin line per start.

    searches: {colour: (value [N + 1, S], penalty [N + 1, S], designs [N + 1, S, d])}.
    """
    for colour, (value, penalty, designs) in searches.items():
        for ax, curve in zip(axes, (value, penalty, _rms(designs)), strict=True):
            ax.plot(curve, color=colour, linewidth=0.9)
    axes[1].set_yscale("log")
    for ax, title in zip(axes, ("predicted value", "penalty", "|f − f_ref| / √d"), strict=True):
        ax.set(xlabel="iteration", ylabel=title)


def planes(axes, path, control) -> None:
    """Paths [N + 1, S, d] on two planes: the whole way, and its second half.

    Left are the two principal directions of all points. Right is the direction to the common point
    of the last designs, and the main direction of what is left; `control` is drawn grey.
    """
    left, right = axes
    dim, half = path.shape[-1], len(path) // 2
    points = path.reshape(-1, dim)
    directions, share = _principal(points, 2)
    whole = path @ directions.T / np.sqrt(dim)
    left.plot(whole[..., 0], whole[..., 1], linewidth=1)
    left.plot(*whole[0].T, "o", color=COLOURS["black"], markersize=3, label="start")
    left.set(title=f"the whole way, {share:.0%} of the variance")
    forward = path[-1].mean(0) / np.linalg.norm(path[-1].mean(0))
    late = np.concatenate([path[half:], control[half:]]).reshape(-1, dim)
    across, _ = _principal(late - np.outer(late @ forward, forward), 1)
    plane = np.stack([forward, across[0]])
    late = late - late.mean(0)
    share = np.sum((late @ plane.T) ** 2) / np.sum(late**2)
    for designs, colour in ((control, PAPER), (path, None)):
        end = designs[half:] @ plane.T / np.sqrt(dim)
        right.plot(end[..., 0], end[..., 1], linewidth=0.8, color=colour)
        right.plot(*end[-1].T, "o", markersize=4, color=colour or COLOURS["black"])
    right.set(title=f"its second half, {share:.0%} of the variance")
    for ax in axes:
        ax.plot(0, 0, "*", color=COLOURS["red"], markersize=12, label="reference")
        ax.set_aspect("equal", adjustable="datalim")


def _principal(points, count):
    """Principal directions [count, d] of points [n, d], and their share of the variance."""
    _, lengths, directions = np.linalg.svd(points - points.mean(0), full_matrices=False)
    return directions[:count], np.sum(lengths[:count] ** 2) / np.sum(lengths**2)


# ------------------------------------------------------------------ encoder


def encoder(keys, values, latent) -> None:
    """Keys [n, L], values [n, v] and their sum over the parts, latent [L, v], as pictures."""
    figure, axes = plt.subplots(1, 3, figsize=(9, 3), width_ratios=(4, 1, 4))
    for ax, data, title, labels in zip(
        axes,
        (keys, values, latent.T),
        ("keys", "values", "sum over parts"),
        (("slot", "part"), ("value", "part"), ("slot", "value")),
        strict=True,
    ):
        limit = None if title == "keys" else float(abs(data).max())
        colours = dict(cmap="viridis") if limit is None else dict(cmap=DIVERGING, vmin=-limit)
        figure.colorbar(ax.imshow(data, aspect="auto", vmax=limit, **colours), ax=ax)
        ax.set(title=title, xlabel=labels[0], ylabel=labels[1])
        ax.locator_params(integer=True)
        ax.grid(False)
