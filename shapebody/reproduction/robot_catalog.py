"""The shipped robots side by side: their table, how random bodies behave, a picture of all."""

from collections.abc import Sequence

import jax
import mujoco
import numpy as np

from shapebody.arguments import require_integer, require_list, require_seed, shown
from shapebody.design.space import DesignSpace
from shapebody.physics.native import NativePhysics
from shapebody.robot.geometry import standing_pose
from shapebody.robot.robot import Robot, load_robot, robots

TOPPLED_TILT = 60.0
"""Degrees from upright beyond which a body counts as toppled."""
TOPPLED_HEIGHT = 0.5
"""Share of its starting height below which a body counts as toppled."""


def robot_table(names: Sequence[str] | None = None) -> list[dict]:
    """One record per robot, in alphabetical order: what the paper's table of robots prints
    (Appendix A) and what a reader wants to know besides.

    Args:
        names: robots, all shipped ones if not given.

    Returns:
        Records with name, display_name, morphology, p_gain (N m/rad), d_gain (N m s/rad),
        action_scale (rad), actuators n_u, design_dim d_design, bodies, joints, feet, mass (kg) and
        height (m, of the trunk's origin in the home pose).
    """
    rows = []
    for robot in _loaded(names):
        rows.append(
            {
                "name": robot.name,
                "display_name": robot.display_name,
                "morphology": robot.morphology,
                "p_gain": robot.p_gain,
                "d_gain": robot.d_gain,
                "action_scale": robot.action_scale,
                "actuators": robot.num_actuators,
                "design_dim": robot.design_dim,
                "bodies": robot.num_bodies,
                "joints": robot.num_joints,
                "feet": robot.num_feet,
                "mass": float(np.sum(robot.model.body_mass)),
                "height": float(robot.home[2]),
            }
        )
    return rows


def _loaded(names) -> list[Robot]:
    """The robots of these names, all shipped ones if None."""
    names = robots() if names is None else require_list("names", names, 1000)
    if not names:
        raise ValueError("names is empty; expected at least one robot, see shapebody.robots()")
    return [load_robot(name) for name in names]


def random_bodies(robot: Robot, designs: int = 200, control_steps: int = 50, seed: int = 0) -> dict:
    """How random bodies of the full design space behave without a trained policy, in C MuJoCo.

    Designs f ~ U([-1, 1]^d) start in their nominal pose with the lowest foot on the floor. Once
    they hold that pose, once they get targets nominal + σ N(0, 1) in every control step, as from
    an untrained policy.

    Args:
        robot: the robot.
        designs: number of designs, `DesignSpace.start(seed)`, `start(seed + 1)`, ...
        control_steps: of 0.02 s.
        seed: number of the first design, and seed of the actions.

    Returns:
        name; designs; seconds simulated; for both kinds of targets ("holding" and "random") the
        share of designs whose simulation became invalid (non_finite_*, see `NativePhysics`) and
        of the others that ended more than TOPPLED_TILT degrees from upright or below
        TOPPLED_HEIGHT of their starting height (toppled_*); crossed_limits, the share with at
        least one joint whose limits have crossed (`design.export.ordered_ranges`).
    """
    space = DesignSpace(robot)
    require_integer("designs", designs, 1, 100_000)
    require_integer("control_steps", control_steps, 1, 1_000_000)
    require_seed("seed", seed)
    f = np.stack([space.start(seed + i) for i in range(designs)])
    bodies = jax.tree.map(np.asarray, jax.jit(jax.vmap(space))(f))
    physics = NativePhysics(robot, designs)
    ids = np.arange(designs)
    physics.set_designs(ids, bodies)
    poses = np.stack(
        [
            standing_pose(physics.get_model(i), robot.pose(bodies.nominal[i]), robot.feet)
            for i in ids
        ]
    )
    low, high = np.moveaxis(bodies.jnt_range[:, robot.joints], -1, 0)
    record = {
        "name": robot.name,
        "designs": designs,
        "seconds": control_steps * physics.substeps * float(robot.model.opt.timestep),
        "crossed_limits": float(np.mean(np.any(low >= high, axis=1))),
    }
    rng = np.random.default_rng(seed)
    for targets, deviation in (("holding", 0.0), ("random", bodies.action_scale[:, None])):
        physics.set_state(ids, poses, np.zeros((designs, robot.model.nv)))
        valid = np.ones(designs, bool)
        for _ in range(control_steps):
            noise = rng.normal(size=bodies.nominal.shape)
            valid &= physics.step(bodies.nominal + deviation * noise).finite
        fallen = _toppled(physics.qpos, poses)[valid]
        record[f"non_finite_{targets}"] = float(np.mean(~valid))
        record[f"toppled_{targets}"] = float(np.mean(fallen)) if len(fallen) else 0.0
    return record


def _toppled(qpos, start):
    """bool[n]: tilted too far, or too low, compared with the starting positions [n, nq]."""
    x, y = qpos[:, 4:6].T  # of the unit quaternion (w, x, y, z); at the start the robot is upright
    tilted = 1 - 2 * (x**2 + y**2) < np.cos(np.radians(TOPPLED_TILT))
    return tilted | (qpos[:, 2] < TOPPLED_HEIGHT * start[:, 2])


# ------------------------------------------------------------------ a picture of all


MORPHOLOGY_COLOURS = {
    "quadruped": (0.16, 0.44, 0.70, 1.0),
    "biped": (0.80, 0.36, 0.10, 1.0),
    "humanoid": (0.80, 0.36, 0.10, 1.0),
    "hexapod": (0.05, 0.55, 0.42, 1.0),
}
"""Colour of the trunk in `group_scene`: quadrupeds, bipeds and humanoids, hexapods."""


def group_scene(names: Sequence[str] | None = None, rows: int = 4):
    """One MuJoCo model with several robots at the same scale, as for a group photograph.

    The smallest stand in front. Trunks are coloured by morphology; the model is for looking at
    only (no actuators, sensors or contacts).

    Args:
        names: robots, all shipped ones if not given.
        rows: number of rows they stand in.

    Returns:
        (model, qpos [nq], order), the last with the names from front left to back right.
    """
    require_integer("rows", rows, 1, 1000)
    crowd = _loaded(names)
    if len({robot.name for robot in crowd}) < len(crowd):
        raise ValueError(f"names is {shown(names)}; expected robots of different names")
    boxes = {robot.name: _bounding_box(robot) for robot in crowd}
    crowd.sort(key=lambda robot: boxes[robot.name][1, 2])
    spec = _empty_scene()
    places, order = {}, []
    depth = 0.0
    for row in _rows(crowd, boxes, rows):
        # From front to back along -x, centred along y; robots face the camera at +x.
        sizes = [boxes[robot.name][1] - boxes[robot.name][0] for robot in row]
        gap = 0.35 * float(np.mean([size[1] for size in sizes]))
        side = -(sum(size[1] for size in sizes) + gap * (len(row) - 1)) / 2
        length = max(size[0] for size in sizes)
        for robot, size in zip(row, sizes, strict=True):
            low, high = boxes[robot.name]
            x, y = depth - length / 2 - (low[0] + high[0]) / 2, side - low[1]
            _attach(spec, robot, x, y)
            places[robot.name] = np.array([x, y])
            order.append(robot.name)
            side += size[1] + gap
        depth -= length + 0.6 * float(np.mean([size[2] for size in sizes]))
    model = spec.compile()
    qpos = model.qpos0.copy()
    for robot in crowd:
        for joint in range(robot.model.njnt):
            name = (
                f"{robot.name}/{mujoco.mj_id2name(robot.model, mujoco.mjtObj.mjOBJ_JOINT, joint)}"
            )
            start, source = model.joint(name).qposadr[0], robot.model.jnt_qposadr[joint]
            if robot.model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
                qpos[start : start + 7] = robot.home[source : source + 7]
                qpos[start : start + 2] += places[robot.name]
            else:
                qpos[start] = robot.home[source]
    return model, qpos, order


def gallery(
    names: Sequence[str] | None = None, rows: int = 4, height: int = 520, width: int = 1400
) -> np.ndarray:
    """Picture uint8[height, width, 3] of `group_scene`."""
    from shapebody.show.render import Renderer, require_size

    require_integer("rows", rows, 1, 1000)
    require_size(height, width)
    model, qpos, _ = group_scene(names, rows)
    with Renderer(model, height, width, smooth=True) as renderer:
        return renderer.picture(qpos, azimuth=180.0, elevation=-20.0)


def _bounding_box(robot: Robot) -> np.ndarray:
    """float[2, 3], lowest and highest corner of the robot's visible geoms in its home pose, m."""
    data = mujoco.MjData(robot.model)
    data.qpos[:] = robot.home
    mujoco.mj_kinematics(robot.model, data)
    shown = (robot.model.geom_bodyid > 0) & (robot.model.geom_group < 3)
    centre, local = data.geom_xpos[shown], robot.model.geom_aabb[shown]
    rotation = data.geom_xmat[shown].reshape(-1, 3, 3)
    centre = centre + np.einsum("nij,nj->ni", rotation, local[:, :3])
    reach = np.einsum("nij,nj->ni", np.abs(rotation), local[:, 3:])
    return np.stack([(centre - reach).min(0), (centre + reach).max(0)])


def _rows(crowd, boxes, count):
    """Split a list sorted by height into rows of about the same total width."""
    widths = np.array([boxes[robot.name][1, 1] - boxes[robot.name][0, 1] for robot in crowd])
    middle = np.cumsum(widths) - widths / 2
    number = np.minimum((count * middle / widths.sum()).astype(int), count - 1)
    return [[r for r, n in zip(crowd, number, strict=True) if n == i] for i in np.unique(number)]


def _empty_scene() -> mujoco.MjSpec:
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.stat.extent = 0.35  # thickness of the rods between joints
    spec.visual.map.zfar = 1000
    spec.visual.global_.fovy = 16  # far away, so that sizes can be compared
    spec.visual.headlight.ambient = spec.visual.headlight.diffuse = [0.41, 0.41, 0.41]
    spec.visual.headlight.specular = [0, 0, 0]
    sky = dict(type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT)
    spec.add_texture(name="sky", width=8, height=48, rgb1=[1, 1, 1], rgb2=[1, 1, 1], **sky)
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    spec.worldbody.add_geom(
        name="floor",
        type=plane,
        size=[0, 0, 0.05],
        rgba=[0.93, 0.94, 0.95, 1],
        contype=0,
        conaffinity=0,
    )
    kind = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    spec.worldbody.add_light(
        pos=[5, -3, 8], dir=[-0.6, 0.3, -1], diffuse=[0.5, 0.5, 0.5], type=kind
    )
    return spec


def _attach(spec: mujoco.MjSpec, robot: Robot, x: float, y: float) -> None:
    """Add a robot's visible body to a scene, at (x, y)."""
    child = mujoco.MjSpec.from_string(robot.xml)
    for name in ("timestep", "density", "viscosity"):  # attaching warns where these differ
        setattr(child.option, name, getattr(spec.option, name))
    for kind in (
        child.pairs,
        child.sensors,
        child.actuators,
        child.keys,
        child.lights,
        child.cameras,
    ):
        for element in list(kind):
            child.delete(element)
    for geom in list(child.geoms):
        if geom.name == "floor" or geom.group > 2:
            child.delete(geom)
    child.material("trunk").rgba = MORPHOLOGY_COLOURS[robot.morphology]
    frame = spec.worldbody.add_frame(pos=[x, y, 0])
    spec.attach(child, prefix=f"{robot.name}/", frame=frame)
