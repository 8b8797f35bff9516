"""The parameters of a design: the 26 blocks of the design vector and what each entry means.

`BLOCKS` is the table behind the design map: which property, one entry for each of what, how far it
can change. The formulas are in `phi`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from shapebody.robot.robot import Robot

SOFT_LIMIT = 0.9
"""Soft limits span this fraction of a joint's range, about its midpoint."""


class Block(NamedTuple):
    """One block of the design vector: one entry per `over` and component."""

    key: str  # its name in the code
    title: str  # of the property, for readers
    kind: str  # its row in the paper's figure of grouped changes, one of `KINDS`
    over: str  # "global", "body", "joint", "actuator" or "foot"
    components: tuple[str, ...]
    range: float  # range constant R, the relative or absolute change at f = 1
    unit: str  # of the property

    @property
    def adds(self) -> bool:
        """Whether an entry adds R f, in `unit`, instead of multiplying by 1 + R f."""
        offsets = ("ipos", "iquat", "pos", "quat", "imu", "axis", "nominal", "range")
        return self.key in offsets or self.key.endswith("_add")


XYZ = ("x", "y", "z")
BLOCKS = (
    Block("size", "size", "Body geometry", "global", XYZ, 0.8, ""),
    Block("coupled_mass", "mass and inertia", "Mass", "body", ("",), 0.25, "kg"),
    Block("mass", "mass", "Mass", "body", ("",), 0.25, "kg"),
    Block("inertia", "inertia", "Inertia", "body", XYZ, 0.25, "kg m²"),
    Block("ipos", "center of mass", "Center of mass", "body", XYZ, 0.02, "m"),
    Block("iquat", "inertia orientation", "Inertia", "body", ("",), 0.2, "rad"),
    Block("pos", "position", "Body geometry", "body", XYZ, 0.02, "m"),
    Block("quat", "orientation", "Body geometry", "body", ("",), 0.02, "rad"),
    Block("imu", "IMU position", "Body geometry", "global", XYZ, 0.1, "m"),
    Block("foot", "size", "Foot geometry", "foot", XYZ, 0.75, "m"),
    Block("axis", "joint axis", "Joint axis", "joint", ("",), 0.1, "rad"),
    Block("torque", "torque limit", "Torque limit", "actuator", ("",), 0.75, "N m"),
    Block("nominal", "nominal position", "Nominal position", "actuator", ("",), 0.1, "rad"),
    Block("velocity", "velocity limit", "Velocity limit", "actuator", ("",), 0.75, "rad/s"),
    Block("range", "joint range", "Joint range", "joint", ("lower", "upper"), 0.4, "rad"),
    Block("damping", "damping", "Damping", "joint", ("factor",), 1.0, "N m s/rad"),
    Block("damping_add", "damping", "Damping", "joint", ("offset",), 0.1, "N m s/rad"),
    Block("armature", "armature", "Armature", "joint", ("factor",), 1.0, "kg m²"),
    Block("armature_add", "armature", "Armature", "joint", ("offset",), 0.001, "kg m²"),
    Block("stiffness", "stiffness", "Stiffness", "joint", ("factor",), 1.0, "N m/rad"),
    Block("stiffness_add", "stiffness", "Stiffness", "joint", ("offset",), 0.1, "N m/rad"),
    Block("friction", "friction loss", "Friction loss", "joint", ("factor",), 1.0, "N m"),
    Block("friction_add", "friction loss", "Friction loss", "joint", ("offset",), 1e-5, "N m"),
    Block("p_gain", "P gain", "P gain", "global", ("",), 0.5, "N m/rad"),
    Block("d_gain", "D gain", "D gain", "global", ("",), 0.5, "N m s/rad"),
    Block("action_scale", "action scale", "Action scale", "global", ("",), 0.5, "rad"),
)


def block_slices(
    num_bodies: int, num_joints: int, num_actuators: int, num_feet: int
) -> dict[str, slice]:
    """Where each block lies in a design f [d], by its key, in the order of `BLOCKS`.

    d = 9 + 13 nb + 11 nj + 3 nu + 3 nf, with nb bodies (without the world), nj hinge joints, nu
    actuators and nf feet. Entries of a block are in the order of MuJoCo's ids, components last.
    """
    counts = {
        "global": 1,
        "body": num_bodies,
        "joint": num_joints,
        "actuator": num_actuators,
        "foot": num_feet,
    }
    slices, offset = {}, 0
    for block in BLOCKS:
        length = counts[block.over] * len(block.components)
        slices[block.key] = slice(offset, offset + length)
        offset += length
    return slices


KINDS = (
    "P gain",
    "D gain",
    "Action scale",
    "Torque limit",
    "Velocity limit",
    "Nominal position",
    "Joint range",
    "Damping",
    "Armature",
    "Stiffness",
    "Friction loss",
    "Joint axis",
    "Mass",
    "Inertia",
    "Center of mass",
    "Body geometry",
    "Foot geometry",
)
"""Rows of the paper's figure of grouped design changes, from top to bottom."""


@dataclass(frozen=True)
class Parameter:
    """One entry of the design vector.

    `low` and `high` are the physical value at f = -1 and f = +1 with all other entries 0 (for
    rotations the angle; for `size` the scale factor). `part` is the name of the body, joint,
    actuator or foot geom, or "global"; `kind` is the row of the paper's heatmap.
    """

    index: int
    name: str
    kind: str
    part: str
    component: str
    low: float
    high: float
    unit: str


def part_label(name: str) -> str:
    """A readable label of a body, joint, actuator or foot: "FL_calf_joint" -> "FL calf"."""
    words = [word for word in name.replace("-", "_").split("_") if word and word != "joint"]
    label = " ".join(words) or name
    return label[0].upper() + label[1:]


def soft_limits(joint_range):
    """Soft limits [..., 2] of joint ranges [..., 2]: the midpoint ± 0.9 of the half range."""
    low, high = joint_range[..., 0], joint_range[..., 1]
    middle, half = 0.5 * (low + high), 0.5 * SOFT_LIMIT * (high - low)
    stack = jnp.stack if isinstance(joint_range, jax.Array) else np.stack
    return stack([middle - half, middle + half], axis=-1)


def part_name(model: mujoco.MjModel, over: str, index: int) -> str:
    """Name of a "body", "joint", "actuator" or "foot" (geom) by MuJoCo id."""
    kind = {
        "body": mujoco.mjtObj.mjOBJ_BODY,
        "joint": mujoco.mjtObj.mjOBJ_JOINT,
        "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR,
        "foot": mujoco.mjtObj.mjOBJ_GEOM,
    }[over]
    return mujoco.mj_id2name(model, kind, int(index)) or f"{over}_{index}"


def parameter_table(robot: Robot) -> list[Parameter]:
    """The parameters of a robot's design space, in the order of f."""
    model = robot.model
    trunk = part_name(model, "body", robot.trunk)
    ids = {
        "global": [None],
        "body": range(1, model.nbody),
        "joint": robot.joints,
        "actuator": range(model.nu),
        "foot": robot.feet,
    }
    references = _reference_values(robot)
    limits = soft_limits(model.jnt_range[robot.joints[robot.actuated]])
    table = []
    for block in BLOCKS:
        # The physical values at f = -1 and f = +1, [2, n].
        length = len(ids[block.over]) * len(block.components)
        reference = references.get(block.key.removesuffix("_add"), np.zeros(length)).ravel()
        change = block.range * (np.ones(length) if block.adds else reference)
        values = np.stack([reference - change, reference + change])
        if block.key == "nominal":
            values = np.clip(values, limits[:, 0], limits[:, 1])
        elif block.key.endswith("_add"):
            values = np.maximum(values, 0)

        # Their names.
        names = [
            (part_name(model, block.over, index) if index is not None else "global", component)
            for index in ids[block.over]
            for component in block.components
        ]
        for (part, component), (low, high) in zip(names, values.T, strict=True):
            part = trunk if block.key == "imu" else part
            words = (part_label(part) if part != "global" else "", block.title, component)
            name = " ".join(word for word in words if word)
            table.append(
                Parameter(
                    index=len(table),
                    name=name[0].upper() + name[1:],
                    kind=block.kind,
                    part=part,
                    component=component,
                    low=float(low),
                    high=float(high),
                    unit=block.unit,
                )
            )
    return table


def _reference_values(robot: Robot) -> dict[str, np.ndarray]:
    """Values of the reference by key of their block, those of a factor and its offset once.
    Rotations are missing: their angles start at 0."""
    model = robot.model
    dofs = model.jnt_dofadr[robot.joints]
    return {
        "size": np.ones(3),
        "coupled_mass": model.body_mass[1:],
        "mass": model.body_mass[1:],
        "inertia": model.body_inertia[1:],
        "ipos": model.body_ipos[1:],
        "pos": model.body_pos[1:],
        "imu": model.site_pos[robot.imu_site],
        "foot": model.geom_size[robot.feet],
        "torque": model.actuator_forcerange[:, 1],
        "nominal": robot.nominal,
        "velocity": robot.velocity_limits,
        "range": model.jnt_range[robot.joints],
        "damping": model.dof_damping[dofs],
        "armature": model.dof_armature[dofs],
        "stiffness": model.jnt_stiffness[robot.joints],
        "friction": model.dof_frictionloss[dofs],
        "p_gain": np.array([robot.p_gain]),
        "d_gain": np.array([robot.d_gain]),
        "action_scale": np.array([robot.action_scale]),
    }
