"""Golden values: what the code computes is what it computed when they were frozen.

The values are those of one processor type and of the locked versions of all packages. Exact resume
of a training run needs no frozen value: see `test_ppo.py`.
"""

import jax
import numpy as np
import pytest
from golden import values

TOLERANCES = {
    "embodiments": (1e-5, 1e-6),
    "descriptions": (1e-5, 1e-6),
    "episode_native": (2e-5, 2e-5),
    "episode_mjx": (1e-4, 1e-4),
    "networks": (1e-5, 1e-5),
    "gae": (1e-5, 1e-6),
    "update": (1e-5, 1e-6),
    "searches": (1e-5, 1e-4),
    "evaluation": (3e-5, 3e-5),
    "mjcf": (1e-5, 1e-6),
    "hashes": (0, 0),
    "dimensions": (0, 0),
}
"""Relative and absolute tolerance of floats. Hashes, integers and flags must be equal everywhere.

Floats of programs compiled with other optimizations differ by less than a third of this. The text
of MJCF does not stay the same then: its last digits are those of one compilation of Φ.
"""

SLOW = "embodiments episode_native episode_mjx networks update searches evaluation".split()


def limits(field: str, frozen: dict, relative: float, absolute: float):
    """Largest allowed difference of every number of a field.

    A sum may differ by the relative tolerance times a bound on the sum of absolute values.
    """
    scale = np.abs(np.asarray(frozen[field], np.float64))
    if field.endswith(": sum"):
        # Of up to 1000 numbers; where they cancel, their errors do not.
        scale = np.sqrt(1000 * frozen[f"{field} of squares"])
    return absolute + relative * scale


def compare(group: str, got: dict, frozen: dict) -> None:
    """AssertionError naming the group and every field that differs, with its largest difference."""
    problems = [f"{field} is missing" for field in frozen if field not in got]
    problems += [f"{field} is new" for field in got if field not in frozen]
    for field in sorted(frozen.keys() & got.keys()):
        new, old = np.asarray(got[field]), np.asarray(frozen[field])
        if new.shape != old.shape or new.dtype.kind != old.dtype.kind:
            problems.append(
                f"{field} is {new.dtype.kind}{new.shape}, was {old.dtype.kind}{old.shape}"
            )
        elif old.dtype.kind != "f":
            if not np.array_equal(new, old):
                problems.append(f"{field} is {new}, was {old}")
        else:
            allowed = limits(field, frozen, *TOLERANCES[group])
            difference = np.abs(new.astype(np.float64) - old.astype(np.float64))
            # Not "difference > allowed", which would let a NaN pass.
            if not np.all(difference <= allowed):
                excess = np.where(np.isnan(difference), np.inf, difference / allowed)
                where = np.unravel_index(np.argmax(excess), excess.shape)
                problems.append(
                    f"{field} differs by {difference[where]:.3g} (allowed {allowed[where]:.3g}) "
                    f"at {tuple(map(int, where))}: is {new[where]:.8g}, was {old[where]:.8g}; "
                    f"largest difference {np.max(difference):.3g}"
                )
    assert not problems, f"{group}: " + f"\n{group}: ".join(problems)


def frozen_values(group: str) -> dict:
    with np.load(values.path_of(group), allow_pickle=False) as file:
        return dict(file)


@pytest.mark.parametrize(
    "group", [pytest.param(g, marks=[pytest.mark.slow] * (g in SLOW)) for g in values.GROUPS]
)
def test_golden(group):
    if jax.default_backend() != "cpu":
        pytest.skip("the golden values are those of a CPU")
    compare(group, values.compute(group), frozen_values(group))


def test_every_group_is_frozen_and_small():
    files = {path.stem for path in values.FOLDER.glob("*.npz")}
    assert files == set(values.GROUPS) == set(TOLERANCES)
    assert sum(values.path_of(group).stat().st_size for group in files) < 300_000


@pytest.mark.parametrize("group", values.GROUPS)
def test_every_field_counts(group):
    """The comparison fails for each field that is changed, absent or new."""
    frozen = frozen_values(group)
    compare(group, frozen, frozen)
    for field, old in frozen.items():
        # A sum is judged by the sum of squares beside it.
        near = {name: frozen[name] for name in (field, f"{field} of squares") if name in frozen}
        if old.dtype.kind in "fiu":
            changed = old.astype(old.dtype, copy=True)
            place = (-1,) * old.ndim
            changed[place] = 1.01 * float(old[place]) + 1 if changed.dtype.kind == "f" else 99
        else:
            changed = np.array("other") if old.dtype.kind == "U" else ~old
        with pytest.raises(AssertionError, match=f"^{group}: ") as error:
            compare(group, near | {field: changed}, near)
        assert str(error.value).startswith(f"{group}: {field} ")
        if old.dtype.kind == "f":
            with pytest.raises(AssertionError, match="differs by nan"):
                compare(group, near | {field: np.full_like(old, np.nan)}, near)
    first, *_ = frozen
    rest = {field: value for field, value in frozen.items() if field != first}
    for got, expected in ((rest, frozen), (frozen, rest)):
        with pytest.raises(AssertionError, match="is missing|is new"):
            compare(group, got, expected)
