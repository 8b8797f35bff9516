"""What a robot file leaves out and can be inferred from the rest of it.

The method needs more than a simulation model says: which geoms are feet, a nominal pose, one pair
of gains, an action scale. `complete` adds what is missing to a file's spec, by the steps in
`STAGES`. Each takes the spec and its compiled model, changes the spec and yields one note per
change: what was missing, what is assumed, how to say it in the file. A file that needs nothing gets
no notes and stays as it is.
"""

from collections.abc import Iterator

import mujoco
import numpy as np

from shapebody.robot.entries import custom_numeric
from shapebody.robot.feet import foot_ids
from shapebody.robot.foot_completion import infer_feet
from shapebody.robot.home import infer_height, infer_home
from shapebody.robot.servos import infer_actuators
from shapebody.robot.spec_edits import (
    COLLISION_GROUP,
    FOOT,
    IMU,
    MESHES,
    add_floor,
    drop_assets,
    drop_geom,
    listed,
    ordered,
    rename_geom,
    rename_site,
    replace_geom,
    unused,
    write_inertial,
)
from shapebody.robot.urdf import VELOCITY_LIMIT

_GEOM = mujoco.mjtGeom


def complete(spec: mujoco.MjSpec, model: mujoco.MjModel) -> tuple[list[str], mujoco.MjModel]:
    """Add to `spec` what the method needs; `model` is its compiled form, before and after.

    Returns the notes and the compiled form of the completed spec. The robot must be one floating
    tree of limited hinge joints (`shapebody.robot.checks.CHECKS`). What cannot be inferred (feet of
    a robot without geometry) is left out.
    """
    notes = []
    for steps in STAGES:
        added = [note for step in steps for note in step(spec, model)]
        if added:
            notes += added
            model = spec.compile()
    return notes, model


def infer_options(spec, model) -> Iterator[str]:
    """Physics settings: all robots are simulated alike, 5 ms per step.

    Gravity and the air are the file's own.
    """
    standard = mujoco.MjSpec().option
    standard.timestep = 0.005
    changed = []
    for name in (
        *("timestep", "integrator", "cone", "solver", "jacobian", "impratio"),
        *("iterations", "ls_iterations", "tolerance", "disableflags", "enableflags"),
    ):
        if getattr(spec.option, name) != getattr(standard, name):
            changed.append(f"{name} {getattr(spec.option, name):g}")
            setattr(spec.option, name, getattr(standard, name))
    if changed:
        yield (
            f"physics options {', '.join(changed)} differ from those of the method: replaced by "
            'its own, <option timestep="0.005"/> with MuJoCo\'s defaults'
        )


def infer_inertials(spec, model) -> Iterator[str]:
    """Inertials are written out where they depend on meshes or on settings of the compiler."""
    compiler, standard = spec.compiler, mujoco.MjSpec().compiler
    settings = [
        name
        for name in (
            *("inertiafromgeom", "boundmass", "boundinertia", "settotalmass", "balanceinertia"),
            *("fusestatic", "discardvisual"),
        )
        if getattr(compiler, name) != getattr(standard, name)
    ]
    inferred = []
    for body in spec.bodies[1:]:
        meshes = any(geom.meshname or geom.type in MESHES for geom in body.geoms)
        if settings or (meshes and not body.explicitinertial):
            inferred += [] if body.explicitinertial else [body.name]
            write_inertial(body, model)
    for name in settings:
        setattr(compiler, name, getattr(standard, name))
    if settings:
        yield f"compiler settings {listed(settings)} are applied once and written out as inertials"
    if inferred:
        yield (
            f"bodies {listed(inferred)} have no <inertial>: computed from their geoms, meshes "
            "included; to say it yourself add <inertial pos mass diaginertia> to the body"
        )


def drop_meshes(spec, model) -> Iterator[str]:
    """Meshes, height fields and image files are dropped; the file then stands by itself."""
    # Primitives whose size the compiler takes from a mesh. Replacing one changes the ids of others.
    fitted = [(geom, geom.id) for geom in spec.geoms if geom.meshname and geom.type not in MESHES]
    for geom, index in fitted:
        size, position = model.geom_size[index], model.geom_pos[index]
        replace_geom(spec, geom, geom.type, size, position, model.geom_quat[index])
    meshes = [geom for geom in spec.geoms if geom.type in MESHES]
    bodies = [geom.parent for geom in meshes]
    for geom in meshes:
        drop_geom(spec, geom)
    assets = drop_assets(spec)
    # What the meshes hid is now all that can be seen.
    for body in bodies:
        if body.name != "world" and not any(geom.group <= 2 for geom in body.geoms):
            for geom in body.geoms:
                geom.group = geom.group if geom.group == COLLISION_GROUP else 2
    if meshes or assets:
        yield (
            f"{len(meshes)} mesh geoms and {assets} mesh, height field or texture assets are "
            "dropped: the method does not use them, and looks come from the primitives"
        )


def infer_contacts(spec, model) -> Iterator[str]:
    """Only feet meet the floor; all other contacts are switched off."""
    colliding = [geom for geom in spec.geoms if geom.contype or geom.conaffinity]
    for geom in colliding:
        geom.contype = geom.conaffinity = 0
    pairs = [
        pair
        for pair in spec.pairs
        if not any(
            floor == "floor" and FOOT.search(foot)
            for floor, foot in (
                (pair.geomname1, pair.geomname2),
                (pair.geomname2, pair.geomname1),
            )
        )
    ]
    excludes = list(spec.excludes)
    for element in (*pairs, *excludes):
        spec.delete(element)
    if colliding or pairs or excludes:
        yield (
            f"contacts of {len(colliding)} geoms, {len(pairs)} contact pairs and {len(excludes)} "
            "excludes are removed: in the method only feet touch, and only the floor; the geoms "
            f"stay for looks. Give spheres group {COLLISION_GROUP} to penalize self-collision"
        )


def infer_floor(spec, model) -> Iterator[str]:
    """A plane geom "floor" at z = 0."""
    level = dict(position=[0, 0, 0], quaternion=[1, 0, 0, 0])
    planes = [geom for geom in spec.worldbody.geoms if geom.type == _GEOM.mjGEOM_PLANE]
    for geom in (geom for geom in planes if geom.name == "floor"):
        height, normal = model.geom_pos[geom.id, 2], np.zeros(3)
        mujoco.mju_rotVecQuat(normal, np.array([0.0, 0, 1]), model.geom_quat[geom.id])
        tilt = np.degrees(np.arccos(np.clip(normal[2], -1, 1)))
        if abs(height) > 1e-6 or tilt > 0.01:
            replace_geom(spec, geom, geom.type, geom.size, **level)
            yield (
                f'the plane "floor" is at z = {height:g} m and tilted by {tilt:.3g} degrees: the '
                "method walks on level ground at z = 0, and the plane is put there; to say it "
                "yourself remove its position and orientation"
            )
        return
    for geom in spec.geoms:
        if geom.name == "floor":
            rename_geom(spec, geom, unused("ground", {other.name for other in spec.geoms}))
    if planes:
        was = planes[0].name
        rename_geom(spec, planes[0], "floor")
        replace_geom(spec, planes[0], planes[0].type, planes[0].size, **level)
        yield f'no geom "floor": the plane {was!r} is the floor; to say it yourself rename it'
    else:
        yield add_floor(spec)


def infer_imu(spec, model) -> Iterator[str]:
    """A site "imu" in the trunk."""
    sites = [site for site in ordered(spec.sites) if IMU.search(site.name)]
    trunk = [site for site in sites if model.site_bodyid[site.id] == 1]
    if any(site.name == "imu" for site in trunk):
        return
    for site in sites:
        if site.name == "imu":  # of another body
            rename_site(spec, site, unused(f"imu_{site.parent.name}", {s.name for s in sites}))
    if trunk:
        was = trunk[0].name
        rename_site(spec, trunk[0], "imu")
        yield f'no site "imu": site {was!r} is the IMU; to say it yourself rename it'
    else:
        spec.bodies[1].add_site(name="imu")
        where = f" (not in body {sites[0].parent.name!r})" if sites else ""
        yield (
            f'no site "imu" in the trunk{where}: the IMU is at the origin of the trunk; to say it '
            'yourself add <site name="imu" pos="0 0 0"/> to the trunk'
        )


def infer_action_scale(spec, model) -> Iterator[str]:
    """0.25 rad on four feet under 25 kg, 0.75 rad on two feet over 40 kg, else 0.5 rad.

    This is exactly the paper's value for 74 % of its 50 robots, and within a factor 2 for 96 %.
    """
    if custom_numeric(model, "action_scale") is not None:
        return
    mass, feet = model.body_mass[1:].sum(), len(foot_ids(model))
    scale = 0.25 if feet == 4 and mass < 25 else 0.75 if feet == 2 and mass > 40 else 0.5
    spec.add_numeric(name="action_scale", data=[scale], size=1)
    yield (
        f"no action scale: {scale:g} rad, as robots of {feet} feet and {mass:.3g} kg have it; to "
        f'say it yourself add <custom><numeric name="action_scale" data="{scale:g}"/></custom>'
    )


def infer_velocity_limits(spec, model) -> Iterator[str]:
    """15 rad/s: within a factor 2 of the median joint for 62 % of the 50 robots."""
    if custom_numeric(model, "velocity_limits") is not None or model.nu == 0:
        return
    spec.add_numeric(name="velocity_limits", data=[VELOCITY_LIMIT] * model.nu, size=model.nu)
    yield (
        f"no velocity limits: {VELOCITY_LIMIT:g} rad/s for each of the {model.nu} actuators; to "
        'say it yourself add <custom><numeric name="velocity_limits" data="..."/></custom>'
    )


def infer_keep_nominal(spec, model) -> Iterator[str]:
    """Driven joints that carry no foot (arms, head) should keep their nominal positions.

    For 47 of the 50 robots of the paper these are exactly the joints that it keeps.
    """
    if custom_numeric(model, "keep_nominal") is not None:
        return
    carrying = set()
    for foot in foot_ids(model):
        body = int(model.geom_bodyid[foot])
        while body > 0:
            carrying.add(body)
            body = int(model.body_parentid[body])
    driven = model.actuator_trnid[:, 0]
    keep = [float(int(model.jnt_bodyid[joint]) not in carrying) for joint in driven]
    if not carrying or not any(keep):
        return
    spec.add_numeric(name="keep_nominal", data=keep, size=model.nu)
    names = [model.joint(int(j)).name for j, kept in zip(driven, keep, strict=True) if kept]
    yield (
        f"joints {listed(names)} carry no foot: they should keep their nominal positions; to say "
        'it yourself add <custom><numeric name="keep_nominal" data="..."/></custom>, 0 or 1 each'
    )


def drop_tendons(spec, model) -> Iterator[str]:
    """Tendons that nothing drives are dropped."""
    if not spec.tendons:
        return
    names = {tendon.name for tendon in spec.tendons}
    for sensor in [s for s in spec.sensors if s.objtype == mujoco.mjtObj.mjOBJ_TENDON]:
        spec.delete(sensor)
    for tendon in list(spec.tendons):
        spec.delete(tendon)
    yield (
        f"tendons {listed(sorted(names))} are dropped, with their springs and limits: the design "
        "of the robot has no parameters for them"
    )


# The model is compiled after each stage: no step needs to see what an earlier one of its own stage
# has changed. Ids of parts of the spec are those of the model only until a part of the tree is
# added or deleted, so a step that does so is the last of its stage to use them.
STAGES = (
    (infer_options, infer_inertials, drop_tendons, infer_home),
    (infer_feet,),
    (infer_height, infer_actuators, drop_meshes),
    (infer_floor,),
    (infer_contacts, infer_imu, infer_action_scale, infer_velocity_limits, infer_keep_nominal),
)
