"""The design map Φ: from a design f to a robot body e = Φ(f) (Section 3 and Appendix A).

A *design* f is a vector in [-1, 1]^d. Every entry stands for one continuous property of a robot:
the mass of a body, the torque limit of a motor, the D gain of all of them. The entries lie in 26
blocks of fixed order (`parameters.BLOCKS`), one entry per body, joint, motor, foot or for the whole
robot, and each block has a range R. An *embodiment* e holds the properties themselves, in
kilograms, metres and radians, as a physics engine wants them (`Embodiment`).

Φ starts from a reference robot and changes a property by a factor or by an offset, and the passive
forces of joints by both:

- factors: value = reference x size x (1 + R f), for masses, inertias, torque limits, gains, ...
- offsets: value = reference x size + R f, for positions; without size for angles and joint ranges

where "size" is a power of the first block's three factors s (x, y, z) or of their mean a: lengths
grow with s, masses with a³, inertias with s⁵. So f = 0 gives the reference. The search
subtracts λ |f - f_ref|² / d from the value, where f_ref is 0 by default: large changes cost, and
none is forbidden.

Φ is written once, in JAX, as plain formulas. It can be compiled, mapped over designs and
differentiated, and it is smooth in f but for two kinds of clipping (passive joint forces at 0,
nominal positions at the soft limits of the reference). The search uses exactly this: the chain rule
carries the critic's gradient with respect to the body back to the design, ∂V/∂f = ∂V/∂e · ∂Φ/∂f.

The paper names the properties; order, ranges and formulas were recovered from the authors'
published designs, which Φ reproduces to the digits they are printed with.

>>> space = DesignSpace(load_robot("unitree_go2"))
>>> body = phi(space.reference_robot, space.start(0))     # the same as space(space.start(0))
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from shapebody.arguments import require_kind, require_shape
from shapebody.design.parameters import BLOCKS, block_slices, soft_limits
from shapebody.robot.robot import Robot
from shapebody.rotations import turned


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Embodiment:
    """A robot's physical and control parameters e = Φ(f), float32, in SI units and radians.

    The first part has the names, shapes and order of MuJoCo model fields (world body, floor and
    free joint included), so that an engine can copy it field by field.
    """

    body_mass: jax.Array  # [nbody] kg
    body_inertia: jax.Array  # [nbody, 3] principal moments, kg m²
    body_ipos: jax.Array  # [nbody, 3] centre of mass in the body frame, m
    body_iquat: jax.Array  # [nbody, 4]
    body_pos: jax.Array  # [nbody, 3] in the parent frame, m
    body_quat: jax.Array  # [nbody, 4]
    site_pos: jax.Array  # [nsite, 3] m
    geom_pos: jax.Array  # [ngeom, 3] m
    geom_size: jax.Array  # [ngeom, 3] m
    geom_rbound: jax.Array  # [ngeom] radius of the bounding sphere, m
    jnt_pos: jax.Array  # [njnt, 3] m
    jnt_axis: jax.Array  # [njnt, 3] unit vectors
    jnt_range: jax.Array  # [njnt, 2] rad
    jnt_stiffness: jax.Array  # [njnt] N m/rad
    dof_damping: jax.Array  # [nv] N m s/rad
    dof_armature: jax.Array  # [nv] kg m²
    dof_frictionloss: jax.Array  # [nv] N m
    actuator_forcerange: jax.Array  # [nu, 2] N m
    actuator_gainprm: jax.Array  # [nu, ...]
    actuator_biasprm: jax.Array  # [nu, ...]
    nominal: jax.Array  # [nu] nominal joint positions, rad
    velocity_limits: jax.Array  # [nu] rad/s
    p_gain: jax.Array  # [] N m/rad
    d_gain: jax.Array  # [] N m s/rad
    action_scale: jax.Array  # [] rad


CONTROL_FIELDS = ("nominal", "velocity_limits", "p_gain", "d_gain", "action_scale")

MODEL_FIELDS = tuple(
    field.name for field in dataclasses.fields(Embodiment) if field.name not in CONTROL_FIELDS
)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Reference:
    """What Φ starts from: a robot's own embodiment, and constants that no design changes.

    Made by `reference_of`, kept as `DesignSpace.reference_robot`. Not the reference design, which
    is f = 0 (`DesignSpace.reference`), nor f_ref, from which a trust region measures. A pytree of
    float32 arrays, so that it can be passed into compiled code.
    nb bodies (without the world), nj hinge joints, nu motors, nf feet.
    """

    embodiment: Embodiment  # of the robot as it is
    soft_limits: jax.Array  # [nu, 2] rad, which bound the nominal positions
    inertia_axes: jax.Array  # [nb, 3] unit vectors about which inertia frames turn
    body_axes: jax.Array  # [nb, 3] ... and bodies
    axis_directions: jax.Array  # [nj, 3] unit vectors towards which joint axes tilt
    on_robot_geoms: jax.Array  # [ngeom] 1 for geoms of the robot, 0 for the floor's
    on_robot_sites: jax.Array  # [nsite]
    feet: jax.Array  # [ngeom, nf] 1 where a geom is that foot
    size_share: jax.Array  # [ngeom, 3] share of each entry of a geom's size in its squared norm
    imu: jax.Array  # [nsite, 1] 1 for the site of the IMU

    @property
    def slices(self) -> dict[str, slice]:
        """Where each block of a design lies in f."""
        return block_slices(
            num_bodies=self.inertia_axes.shape[0],
            num_joints=self.axis_directions.shape[0],
            num_actuators=self.embodiment.nominal.shape[0],
            num_feet=self.feet.shape[1],
        )


def phi(reference: Reference, f) -> Embodiment:
    """The design map: e = Φ(f), of one design.

    Pure: can be compiled, mapped over designs with `jax.vmap`, and differentiated.

    Args:
        reference: of a robot, `DesignSpace.reference_robot`.
        f: float32 [d], within [-1, 1] (not checked here; `DesignSpace.validate` does).

    Raises:
        TypeError: for another reference.
        ValueError: for an f of another length.
    """
    require_kind("reference", reference, Reference, "DesignSpace(robot).reference_robot")
    x = _changes(reference, f)
    original = reference.embodiment

    # Block 1, size: in every local frame, lengths along its own x, y and z are multiplied by
    # s = 1 + R f; a is the mean of s.
    s = 1 + x["size"][0]
    a = 1 + jnp.mean(x["size"])  # exactly 1 at the reference

    # Blocks 2 to 4, mass m = m₀ a³ g (1 + R f) and principal inertias I = I₀ s⁵ g (1 + R f):
    # g = 1 + R f changes both together, the other two each alone. s⁵ is taken entry by entry, as
    # the authors do; of a stretched solid it is the inertia only if all s are equal.
    coupled = 1 + x["coupled_mass"]
    mass = original.body_mass[1:] * a**3 * coupled * (1 + x["mass"])
    inertia = original.body_inertia[1:] * s**5 * coupled[:, None] * (1 + x["inertia"])

    # Blocks 5 to 8, frames of the inertia and of the body: p = p₀ s + R f, turned by the angle R f
    # about a constant axis.
    ipos = original.body_ipos[1:] * s + x["ipos"]
    iquat = turned(original.body_iquat[1:], reference.inertia_axes, x["iquat"])
    pos = original.body_pos[1:] * s + x["pos"]
    quat = turned(original.body_quat[1:], reference.body_axes, x["quat"])

    # Block 9, IMU: p = p₀ s + R f. The other sites, like geoms, only follow the size.
    site_scale = jnp.where(reference.on_robot_sites[:, None] > 0, s, 1)
    site_pos = original.site_pos * site_scale + reference.imu * x["imu"]

    # Block 10, feet: r = r₀ a (1 + R f), and so the radius of the bounding sphere.
    # One-hot sums instead of scatters: exact, and faster in a batch on a CPU.
    on_robot = reference.on_robot_geoms > 0
    geom_scale = jnp.where(on_robot, a, 1)
    foot_scale = 1 + jnp.sum(reference.feet[:, :, None] * x["foot"], axis=1)
    geom_size = original.geom_size * geom_scale[:, None] * foot_scale
    # The bounding radius of a sphere or a box is the norm of its size; written relative to the
    # reference, so that f = 0 gives exactly that.
    stretch = jnp.sqrt(1 + jnp.sum(reference.size_share * (foot_scale**2 - 1), axis=1))
    rbound = original.geom_rbound * geom_scale * stretch
    geom_pos = original.geom_pos * jnp.where(on_robot[:, None], s, 1)

    # Block 11, joint axes: tilted by the angle R f towards a constant perpendicular direction.
    cosine, sine = jnp.cos(x["axis"])[:, None], jnp.sin(x["axis"])[:, None]
    axis = cosine * original.jnt_axis[1:] + sine * reference.axis_directions

    # Blocks 12, 24 and 25, motors: v = v₀ a (1 + R f) for the torque limit of each and the gains
    # of all. A motor is a position servo, torque = P (target - q) - D q̇, whose gains MuJoCo keeps
    # in two tables.
    torque = original.actuator_forcerange[:, 1] * a * (1 + x["torque"])
    p_gain = (original.p_gain * a * (1 + x["p_gain"]))[0]
    d_gain = (original.d_gain * a * (1 + x["d_gain"]))[0]
    p_column = jnp.broadcast_to(p_gain, (len(torque), 1))
    d_column = jnp.broadcast_to(d_gain, (len(torque), 1))
    gain, bias = original.actuator_gainprm, original.actuator_biasprm

    # Blocks 13 and 15, nominal positions and joint ranges: q = q₀ + R f. The former stay within
    # the soft limits of the reference, at f = 0 too; the latter are not ordered.
    low, high = reference.soft_limits[:, 0], reference.soft_limits[:, 1]
    nominal = jnp.clip(original.nominal + x["nominal"], low, high)
    jnt_range = original.jnt_range[1:] + x["range"]

    # Blocks 16 to 23, passive forces of the joints: v = max(0, v₀ a (1 + R f) + R' f').
    def passive(values, key):
        return jnp.maximum(0, values * a * (1 + x[key]) + x[f"{key}_add"])

    stiffness = passive(original.jnt_stiffness[1:], "stiffness")
    damping = passive(original.dof_damping[6:], "damping")
    armature = passive(original.dof_armature[6:], "armature")
    frictionloss = passive(original.dof_frictionloss[6:], "friction")

    # Blocks 14 and 26, what the environment applies: v = v₀ a (1 + R f) for the velocity limits,
    # to which it clips the joints' velocities, and for the angle that an action of 1 stands for.
    velocity = original.velocity_limits * a * (1 + x["velocity"])
    action_scale = (original.action_scale * a * (1 + x["action_scale"]))[0]

    return Embodiment(
        body_mass=_completed(original.body_mass, mass),
        body_inertia=_completed(original.body_inertia, inertia),
        body_ipos=_completed(original.body_ipos, ipos),
        body_iquat=_completed(original.body_iquat, iquat),
        body_pos=_completed(original.body_pos, pos),
        body_quat=_completed(original.body_quat, quat),
        site_pos=site_pos,
        geom_pos=geom_pos,
        geom_size=geom_size,
        geom_rbound=rbound,
        jnt_pos=_completed(original.jnt_pos, original.jnt_pos[1:] * s),
        jnt_axis=_completed(original.jnt_axis, axis),
        jnt_range=_completed(original.jnt_range, jnt_range),
        jnt_stiffness=_completed(original.jnt_stiffness, stiffness),
        dof_damping=_completed(original.dof_damping, damping),
        dof_armature=_completed(original.dof_armature, armature),
        dof_frictionloss=_completed(original.dof_frictionloss, frictionloss),
        actuator_forcerange=jnp.stack([-torque, torque], axis=-1),
        actuator_gainprm=jnp.concatenate([p_column, gain[:, 1:]], axis=1),
        actuator_biasprm=jnp.concatenate([bias[:, :1], -p_column, -d_column, bias[:, 3:]], axis=1),
        nominal=nominal,
        velocity_limits=velocity,
        p_gain=p_gain,
        d_gain=d_gain,
        action_scale=action_scale,
    )


def _changes(reference: Reference, f) -> dict[str, jax.Array]:
    """R f by key of the block, [n], or [n, 3] and [n, 2] where bodies or joints have several."""
    slices = reference.slices
    require_shape("f", f, (list(slices.values())[-1].stop,))
    changes = {}
    for block in BLOCKS:
        entries = f[slices[block.key]]
        components = len(block.components)
        entries = entries.reshape(-1, components) if components > 1 else entries
        changes[block.key] = block.range * entries
    return changes


def _completed(reference, values):
    """`values` after those rows of the reference that no design changes: the world's, or the free
    joint's, which come first."""
    return jnp.concatenate([reference[: len(reference) - len(values)], values])


def reference_of(robot: Robot, inertia_axes, body_axes, joint_axes) -> Reference:
    """What Φ needs of a robot. The axes are those of `axes.rotation_axes`, [nb, 3] or [nj, 3]."""
    model = robot.model
    control = dict(
        nominal=robot.nominal,
        velocity_limits=robot.velocity_limits,
        p_gain=robot.p_gain,
        d_gain=robot.d_gain,
        action_scale=robot.action_scale,
    )
    feet = np.zeros((model.ngeom, robot.num_feet))
    feet[robot.feet, np.arange(robot.num_feet)] = 1
    squares = model.geom_size**2
    imu = np.zeros((model.nsite, 1))
    imu[robot.imu_site] = 1
    reference = Reference(
        embodiment=Embodiment(**{name: getattr(model, name) for name in MODEL_FIELDS}, **control),
        soft_limits=soft_limits(model.jnt_range[robot.joints[robot.actuated]]),
        inertia_axes=inertia_axes,
        body_axes=body_axes,
        axis_directions=np.cross(joint_axes, model.jnt_axis[robot.joints]),
        on_robot_geoms=model.geom_bodyid > 0,
        on_robot_sites=model.site_bodyid > 0,
        feet=feet,
        size_share=squares / np.maximum(squares.sum(axis=1, keepdims=True), 1e-30),
        imu=imu,
    )
    return jax.tree.map(lambda value: np.asarray(value, np.float32), reference)
