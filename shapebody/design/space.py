"""The design space of a robot: its designs f in [-1, 1]^d, their names, and Φ of them.

One number per continuous property, in 26 blocks (`parameters.BLOCKS`) of fixed order; f = 0 is the
reference robot. What Φ does is in `phi`.
"""

from __future__ import annotations

import difflib
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from shapebody.arguments import (
    require_array,
    require_integer,
    require_list,
    require_seed,
    require_text,
    single,
)
from shapebody.design.axes import published_axes, rotation_axes
from shapebody.design.export import build_model, write_mjcf
from shapebody.design.parameters import (
    BLOCKS,
    KINDS,
    Parameter,
    block_slices,
    parameter_table,
    part_label,
    part_name,
)
from shapebody.design.phi import Embodiment, phi, reference_of
from shapebody.robot.robot import Robot, require_robot

MOST_STARTS = 2**63
"""Numbers of start designs are below this."""


class DesignSpace:
    """The design space of one robot: f in [-1, 1]^d and the differentiable map Φ.

    Args:
        robot: the reference robot.
        axes_seed: the directions of the small rotations (inertia frames, body frames, joint axes)
            are not part of f. They are constants of the space, drawn from this seed ...
        published_axes_of: ... or, if given, those with which this published design [d] was built.

    Attributes:
        robot: the reference robot.
        dim: d, the length of a design.
        reference: the reference design, float32 zeros [d].
        reference_robot: what Φ starts from, for `phi(space.reference_robot, f)`.
        slices: where each block lies in f, by its key.
        inertia_axes, body_axes, joint_axes: the directions, float64 [nb, 3], [nb, 3], [nj, 3].

    `space(f)` maps float32 f [..., d] to an `Embodiment` with the same leading axes, and can be
    jitted, vmapped and differentiated. It checks the length of f only; `validate` checks values.

    Φ clips damping, armature, stiffness and friction loss at 0 and nominal positions to the soft
    limits of the reference joint ranges (also at f = 0), and nothing else: principal inertias
    mostly violate the triangle inequality, a joint's range may exclude its nominal position, and
    narrow ranges may have lower > upper. Physics takes all of that as it is; for MJCF see
    `to_mjcf`.
    """

    def __init__(self, robot: Robot, axes_seed: int = 0, published_axes_of=None):
        self.robot = require_robot(robot)
        self.slices = block_slices(
            robot.num_bodies, robot.num_joints, robot.num_actuators, robot.num_feet
        )
        self.dim = robot.design_dim
        self.reference = np.zeros(self.dim, np.float32)
        if published_axes_of is None:
            generator = np.random.default_rng(require_seed("axes_seed", axes_seed))
            axes = rotation_axes(generator, robot.model.jnt_axis[robot.joints], robot.num_bodies)
        else:
            axes = published_axes(robot, self._one(published_axes_of))
        self.inertia_axes, self.body_axes, self.joint_axes = axes
        self._check_layout()
        self.reference_robot = reference_of(robot, *axes)
        self._jitted = jax.jit(functools.partial(phi, self.reference_robot))

    def _check_layout(self):
        model, robot = self.robot.model, self.robot
        hinges = np.arange(1, model.njnt)
        if (
            model.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE
            or not np.array_equal(robot.joints, hinges)
            or not np.all(model.jnt_type[hinges] == mujoco.mjtJoint.mjJNT_HINGE)
        ):
            raise ValueError(
                f"robot {robot.name!r} must have one free joint first and hinge joints after it; "
                "fix its MJCF: one floating trunk, hinges elsewhere"
            )

    def __repr__(self):
        return f"DesignSpace({self.robot.name!r}, dim={self.dim})"

    def start(self, seed: int) -> np.ndarray:
        """Start design number `seed` of the paper: float32 [d], uniform in [-1, 1]."""
        require_integer("the number of a start design", seed, 0, MOST_STARTS)
        return np.random.default_rng(seed).uniform(-1, 1, self.dim).astype(np.float32)

    def validate(self, f) -> np.ndarray:
        """Return f as float32 [..., d]; ValueError if its length, finiteness or box is wrong."""
        f = self.as_float32(f, np)
        if not np.all(np.isfinite(f)):
            where = np.argwhere(~np.isfinite(f))[0]
            raise ValueError(
                f"design entry {tuple(map(int, where))} is {f[tuple(where)]}, expected a finite "
                "number; replace non-finite entries before using the design"
            )
        if np.any(np.abs(f) > 1):
            where = np.unravel_index(np.argmax(np.abs(f)), f.shape)
            raise ValueError(
                f"design entry {tuple(map(int, where))} is {f[where]}, expected [-1, 1]; "
                "clip the design with numpy.clip(f, -1, 1)"
            )
        return f

    def as_float32(self, f, numpy):
        """Designs [..., d] as float32, an array of `numpy` (or jax.numpy: also a traced one)."""
        if not isinstance(f, jax.Array):
            try:
                f = require_array("design", f, finite=False)
            except ValueError as error:
                raise ValueError(
                    f"{error}, {self.dim} of them; use a design of robot {self.robot.name!r}, such "
                    "as space.start(0)"
                ) from None
            f = single(f)
        f = numpy.asarray(f, numpy.float32)
        if f.ndim == 0 or f.shape[-1] != self.dim:
            raise ValueError(
                f"design has shape {f.shape}, expected [..., {self.dim}] for robot "
                f"{self.robot.name!r}; use a design of this robot, such as space.start(0)"
            )
        return f

    def __call__(self, f) -> Embodiment:
        """Φ(f): embodiment of designs f [..., d]."""
        f = self.as_float32(f, jnp)
        function = self._jitted
        for _ in range(f.ndim - 1):
            function = jax.vmap(function)
        return function(f)

    @functools.cached_property
    def parameters(self) -> list[Parameter]:
        """The d parameters in the order of f."""
        return parameter_table(self.robot)

    @functools.cached_property
    def groups(self) -> dict[str, np.ndarray]:
        """Indices into f by label: first every parameter type of `KINDS`, then every body part.

        Types partition f, and so do parts (`parts`): bodies, joints, actuators and feet under their
        `part_label` in alphabetical order, then "Trunk" and "Global". The paper's figure
        (Section 4.3) has separate columns for a joint and a body of the same label (two for "FL
        calf" of the Go2, 30 in all); here they share a part (18 in all).
        """
        kinds: dict[str, list[int]] = {kind: [] for kind in KINDS}
        parts: dict[str, list[int]] = {}
        for parameter in self.parameters:
            kinds[parameter.kind].append(parameter.index)
            parts.setdefault(part_label(parameter.part), []).append(parameter.index)
        ordered = {label: parts[label] for label in self._order_parts(parts)}
        return {label: np.array(index) for label, index in (kinds | ordered).items()}

    @property
    def parts(self) -> tuple[str, ...]:
        """Labels of `groups` that are body parts."""
        return tuple(label for label in self.groups if label not in KINDS)

    def frozen(self, names) -> np.ndarray:
        """Which entries of f the names stand for, bool [d].

        Args:
            names: keys of `slices` ("size": the three factors of the whole body), labels of
                `groups` ("Torque limit", "Trunk").

        Raises:
            ValueError: for a name that is neither; similar ones are named.
        """
        chosen = np.zeros(self.dim, bool)
        for name in (names,) if isinstance(names, str) else require_list("names", names):
            require_text("a name of parameters", name)
            known = self.slices if name in self.slices else self.groups
            if name not in known:
                names = [*self.slices, *self.groups]
                folded = {one.lower(): one for one in names}
                near = difflib.get_close_matches(name.lower(), folded, 3, 0.6)
                hint = f"did you mean {' or '.join(folded[one] for one in near)}? " if near else ""
                raise ValueError(
                    f"there are no parameters {name!r} of robot {self.robot.name!r} to be frozen; "
                    f"{hint}expected a key of `slices` ({', '.join(list(self.slices)[:3])}, ...) "
                    f"or a label of `groups` ({', '.join(list(self.groups)[:3])}, ...)"
                )
            chosen[known[name]] = True
        return chosen

    def _order_parts(self, labels):
        trunk = part_label(part_name(self.robot.model, "body", self.robot.trunk))
        last = {trunk: 1, "Global": 2}
        return sorted(labels, key=lambda label: (last.get(label, 0), label))

    def to_model(self, f) -> mujoco.MjModel:
        """A new model of design f [d], with the raw inertias of Φ, as the C engine simulates it.

        Also scales what is only looked at (site sizes, cameras) and puts the design into the home
        keyframe and the custom entries. Derived constants stay at the reference. The "same frame"
        flags are cleared: they would let MuJoCo ignore the changed frames of bodies and geoms.
        """
        return build_model(self.robot, *self._single(f))

    def to_mjcf(self, f) -> str:
        """MJCF text of design f [d] that compiles in any MuJoCo.

        It simulates as `to_model(f)` would with equally balanced inertias and recomputed derived
        constants: MJCF cannot hold inertias that violate the triangle inequality, so these become
        their mean, and a comment at the top says how many did: see `design.export.write_mjcf`.
        """
        return write_mjcf(self.robot, *self._single(f))

    def _single(self, f) -> tuple[Embodiment, np.ndarray]:
        """Embodiment and size factors (s_x, s_y, s_z) of one design."""
        f = self._one(f)
        return self(f), 1 + BLOCKS[0].range * f[self.slices["size"]]

    def _one(self, f) -> np.ndarray:
        f = self.validate(f)
        if f.ndim != 1:
            raise ValueError(
                f"design has shape {f.shape}, expected one design [{self.dim}]; "
                "take the designs of a batch one by one"
            )
        return f
