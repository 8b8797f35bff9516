"""Exercises of 00_quickstart."""

import numpy as np

from exercises import checker, need, same


@checker
def check_trust_regions(results):
    """VGDS from one start with λ = 0, 20 and 100; results: {λ: SearchResult}."""
    need(set(results) == {0, 20, 100}, "Expected a dictionary with the keys 0, 20 and 100.")
    for size, result in results.items():
        used = result.settings["trust_region"]
        need(used == size, f"The search under {size} was called with trust_region={used:g}.")
    starts = [result.trajectory[0] for result in results.values()]
    need(np.ptp(starts, axis=0).max() == 0, "The searches began at different designs.")
    far = {size: np.sqrt(np.mean(results[size].design ** 2)) for size in (0, 20, 100)}
    told = ", ".join(f"{value:.3f} at λ = {size}" for size, value in far.items())
    need(far[0] >= far[20] >= far[100], f"|f| / √d is {told}; it should fall with λ.")
    return f"The distance |f| / √d from the reference is {told}: the larger λ, the closer."


@checker
def check_largest_step(answer, result):
    """The largest change of one design parameter in one iteration of a search."""
    path = result.trajectory
    whole = not same(answer, np.abs(path[-1] - path[0]).max())
    need(whole, "That is the change over the whole search; look at single iterations.")
    largest = np.abs(np.diff(path, axis=0)).max()
    need(same(answer, largest, 1e-3), "Take np.diff(..., axis=0), then the largest magnitude.")
    return f"{largest:.4f}: Adam's own step is about its learning rate, so 0.1 never binds."
