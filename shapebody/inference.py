"""What a robot file leaves out and can be inferred from the rest of it.

The method needs more than a simulation model says: which geoms are feet, a nominal pose, one pair
of gains, an action scale. `read` loads an MJCF or URDF file, `complete` adds what is missing by the
functions in `STEPS`. Each takes the spec and its compiled model, changes the spec and yields one
note per change: what was missing, what is assumed, how to say it in the file. A file that needs
nothing gets no notes and stays as it is.
"""

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np
from scipy.optimize import least_squares

COLLISION_GROUP = 5
FLOOR_TOLERANCE = 0.05  # of the home height: how far feet may be from the floor
VELOCITY_LIMIT = 15.0  # rad/s, the median over the 50 robots of their median joint

_GEOM, _JOINT, _TRN = mujoco.mjtGeom, mujoco.mjtJoint, mujoco.mjtTrn
# As integers, which compare equal with what models and specs hold.
_MESHES = tuple(map(int, (_GEOM.mjGEOM_MESH, _GEOM.mjGEOM_HFIELD, _GEOM.mjGEOM_SDF)))
_FEET = int(_GEOM.mjGEOM_SPHERE), int(_GEOM.mjGEOM_BOX)
_FOOT = re.compile("foot", re.IGNORECASE)


# Reading.


def read(path: Path) -> tuple[str, mujoco.MjSpec, mujoco.MjModel, list[str]]:
    """Text, spec, compiled model and first notes of an MJCF or URDF file.

    Raises ValueError, naming the fix, for a file that is no text, empty, cut off or not valid.
    """
    try:
        text = path.read_bytes().decode("utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{path} is not UTF-8 text (byte {error.start} is {error.object[error.start]:#04x}): "
            "expected an MJCF or URDF file; save it as UTF-8, or give the XML file that belongs "
            "to this binary file"
        ) from error
    if not text.strip():
        raise ValueError(f"{path} is empty: expected an MJCF or URDF file; write the robot to it")
    root = re.search(r"<([A-Za-z_][\w:.-]*)", re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL))
    urdf = root.group(1) == "robot" if root else path.suffix == ".urdf"
    notes = []
    try:
        if urdf:
            spec = _import_urdf(path, text, notes)
        else:
            spec = mujoco.MjSpec.from_file(str(path))
        _name_parts(spec)
        model = _compile(spec, notes)
        if urdf:
            model = _float(spec, model, text, notes)
    except ValueError as error:
        kind = "URDF" if urdf else "MJCF"
        raise ValueError(f"{path} is not a valid {kind} file: {_explained(error, kind)}") from error
    if re.search(r"<include\s", text):
        notes.append("other files are included: their text is merged into the completed file")
    return text, spec, model, notes


_FIXES = {
    "repeated name": "each name may be used once per kind of element; rename one of the two",
    "moving bodies": "give every body that moves an <inertial> with mass and inertia > 0",
    "qpos size": "give each keyframe as many numbers as the robot has positions (7 for the free "
    "joint, then 1 per hinge)",
    "balanceinertia": 'correct the inertia, or let <compiler balanceinertia="true"/> repair it',
    "XML": "expected a complete XML file; it may be cut off, so look at the place that is named",
}


def _explained(error: Exception, kind: str) -> str:
    reason = " ".join(str(error).split())
    root = {"MJCF": "<mujoco>", "URDF": "<robot>"}[kind]
    default = f"Expected a complete XML file with a {root} root; correct the reported element"
    fix = next((fix for part, fix in _FIXES.items() if part in reason), default)
    return f"MuJoCo reports {reason!r}. {fix[0].upper()}{fix[1:]}"


def _name_parts(spec):
    """Name what other elements refer to and MJCF leaves optional."""
    taken = {joint.name for joint in spec.joints}
    for index, joint in enumerate(spec.joints):
        if not joint.name and joint.type != _JOINT.mjJNT_FREE:
            joint.name = _unused(f"joint_{index}", taken)
            taken.add(joint.name)
    spheres = [geom for geom in spec.geoms if geom.group == COLLISION_GROUP]
    for index, geom in enumerate(spheres):
        geom.name = geom.name or f"sphere_{index}"
    for actuator in spec.actuators:
        actuator.name = actuator.name or actuator.target


def _compile(spec, notes) -> mujoco.MjModel:
    """The compiled model; without meshes and textures if their files cannot be read."""
    names = {geom.name for geom in spec.geoms}
    if any({pair.geomname1, pair.geomname2} - names == {"floor"} for pair in spec.pairs):
        notes += infer_floor(spec, None)
    try:
        return spec.compile()
    except ValueError as error:
        first = error
    if spec.meshes or spec.hfields or any(texture.file for texture in spec.textures):
        bodies = sorted(
            {geom.parent.name for geom in spec.geoms if geom.meshname or geom.type in _MESHES}
            & {body.name for body in spec.bodies if not body.explicitinertial}
        )
        reason = str(first).strip().splitlines()[0]
        for geom in [geom for geom in spec.geoms if geom.meshname or geom.type in _MESHES]:
            _drop_geom(spec, geom)
        _drop_assets(spec)
        notes.append(
            f"mesh or texture files cannot be read ({reason}): the robot is loaded without them"
            + (
                f"; bodies {_listed(bodies)} have no <inertial>, so their mass comes from their "
                "other geoms alone: add <inertial>, or put the files in place"
                if bodies
                else ""
            )
        )
        try:
            return spec.compile()
        except ValueError as error:
            first = error
    if "moving bodies" in str(first):
        # With tiny masses it compiles, and the checks can name every such body.
        spec.compiler.boundmass, spec.compiler.boundinertia = 1e-12, 1e-14
        return spec.compile()
    raise first


def _import_urdf(path: Path, text: str, notes) -> mujoco.MjSpec:
    if not re.search(r"<mujoco[\s>]", text):
        settings = '<mujoco><compiler fusestatic="false" discardvisual="false"/></mujoco>'
        text = re.sub(r"(<robot\b[^>]*>)", lambda found: found.group(1) + settings, text, count=1)
    spec = mujoco.MjSpec.from_string(text)
    spec.modelfiledir = str(path.parent.absolute())
    spec.compiler.fusestatic = False
    spec.compiler.discardvisual = False
    notes.append("the file is a URDF: it is imported by MuJoCo and completed as MJCF")
    spec.compiler.balanceinertia = True  # many URDFs have inertias that no body can have
    for body in spec.bodies[1:]:
        xx, yy, zz, xy, xz, yz = body.fullinertia
        tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        if not body.explicitinertial or (body.mass == 0 and not tensor.any()):
            # A link without <inertial> has no mass; MuJoCo would give it the density of water.
            body.explicitinertial = False
            body.mass, body.fullinertia = 0, np.full(6, np.nan)
            for geom in body.geoms:
                geom.mass = 0
        elif not (np.isfinite(tensor).all() and np.linalg.eigvalsh(tensor)[0] > 1e-12):
            body.fullinertia, body.inertia = np.full(6, np.nan), np.full(3, 1e-14)
    _find_meshes(spec, path, notes)
    return spec


def _find_meshes(spec, path: Path, notes):
    """Resolve "package://" names beside and above the file; drop what MuJoCo cannot read."""
    lost = {}
    for mesh in spec.meshes:
        parts = Path(mesh.file.split("://")[-1]).parts
        places = (
            folder.joinpath(*parts[i:])
            for folder in path.absolute().parents
            for i in range(len(parts))
        )
        found = next((place for place in places if place.is_file()), None)
        if found is None or found.suffix.lower() not in (".stl", ".obj", ".msh"):
            lost[mesh.name] = mesh.file
        else:
            mesh.file = str(found)
    for geom in [geom for geom in spec.geoms if geom.meshname in lost]:
        spec.delete(geom)
    for mesh in [mesh for mesh in spec.meshes if mesh.name in lost]:
        spec.delete(mesh)
    if lost:
        names = _listed(Path(file).name for file in lost.values())
        notes.append(
            f"{len(lost)} meshes are not found beside the file, or of a kind that MuJoCo cannot "
            f"read (it reads .stl, .obj and .msh): {names}; the robot is loaded without them"
        )


def _float(spec, model, text, notes) -> mujoco.MjModel:
    """Free the base of an imported URDF and merge links that do not move by themselves."""
    bases = [body for body in spec.bodies[1:] if body.parent.name == "world"]
    if len(bases) == 1 and not spec.worldbody.geoms and not bases[0].joints:
        bases[0].add_freejoint(name=_unused("root", {joint.name for joint in spec.joints}))
        notes.append(
            f"URDF cannot say that the base floats: link {bases[0].name!r} gets a free joint"
        )
    fixed = [body for body in spec.bodies[1:] if not body.joints]
    for body in fixed:
        if _IMU.search(body.name):
            body.add_site(name=_unused(body.name, {site.name for site in spec.sites}))
    notes += _feet_of_links(spec, fixed)
    if fixed:
        names = _listed([body.name for body in fixed])
        notes.append(f"links {names} are fixed: merged into the links that carry them")
        spec.fuse_static()
    model = _compile(spec, notes)
    speeds = _urdf_velocities(text)
    hinges = [joint.name for joint in _ordered(spec.joints) if joint.type == _JOINT.mjJNT_HINGE]
    if any(name in speeds for name in hinges):
        data = [speeds.get(name, VELOCITY_LIMIT) for name in hinges]
        spec.add_numeric(name="velocity_limits", data=data, size=len(data))
        model = _compile(spec, notes)
    return model


_FOOT_LINK = re.compile(r"foot(_?link|_?frame)?(_?\d+|_[lr])?$", re.IGNORECASE)


def _feet_of_links(spec, fixed) -> Iterator[str]:
    """Geoms of fixed links with "foot" in their names become feet, one link per leg."""
    if any(_FOOT.search(geom.name) for geom in spec.geoms):
        return
    links = {}
    for link in (link for link in fixed if _FOOT_LINK.search(link.name)):
        leg = link.parent
        while leg.name != "world" and not leg.joints:
            leg = leg.parent
        best = links.setdefault(leg.name, link)
        links[leg.name] = link if len(link.geoms) > len(best.geoms) else best
    guessed = []
    for link in links.values():
        if not link.geoms:
            length, body = 0.0, link
            while body.parent.name != "world":
                length, body = length + np.linalg.norm(body.pos), body.parent
            radius = float(f"{0.04 * length:.2g}")
            link.add_geom(type=_GEOM.mjGEOM_SPHERE, size=[radius, 0, 0], mass=0)
            guessed.append(f"{link.name!r} ({radius:g} m)")
        touching = [geom for geom in link.geoms if geom.contype] or link.geoms
        solid = [geom for geom in touching if geom.type not in _MESHES]
        for geom in solid or touching:
            geom.name = _unused(link.name, {other.name for other in spec.geoms})
    if guessed:
        yield (
            f"links {', '.join(guessed)} have no geometry that can be read: their feet are spheres "
            "at the origin of the link with a radius of 4 % of the leg; to say it yourself give "
            "the link a <collision> with a sphere or a box"
        )


def _urdf_velocities(text: str) -> dict[str, float]:
    """Velocity limits > 0 by joint; MuJoCo's importer has no place for them."""
    speeds = {}
    for joint in ElementTree.fromstring(text).iter("joint"):
        limit = joint.find("limit")
        if limit is not None and float(limit.get("velocity", 0)) > 0:
            speeds[joint.get("name")] = float(limit.get("velocity"))
    return speeds


# Completing.


def complete(spec: mujoco.MjSpec, model: mujoco.MjModel) -> list[str]:
    """Add to `spec` what the method needs; `model` is its compiled form. Returns the notes.

    The robot must be one floating tree of limited hinge joints (`robots.CHECKS`). What cannot be
    inferred (feet of a robot without geometry) is left out.
    """
    notes = []
    for step in STEPS:
        added = list(step(spec, model))
        if added:
            notes += added
            model = spec.compile()
    return notes


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
        meshes = any(geom.meshname or geom.type in _MESHES for geom in body.geoms)
        if settings or (meshes and not body.explicitinertial):
            inferred += [] if body.explicitinertial else [body.name]
            _write_inertial(body, model)
    for name in settings:
        setattr(compiler, name, getattr(standard, name))
    if settings:
        yield f"compiler settings {_listed(settings)} are applied once and written out as inertials"
    if inferred:
        yield (
            f"bodies {_listed(inferred)} have no <inertial>: computed from their geoms, meshes "
            "included; to say it yourself add <inertial pos mass diaginertia> to the body"
        )


def _write_inertial(body, model):
    body.explicitinertial = True
    body.mass = model.body_mass[body.id]
    body.ipos = model.body_ipos[body.id]
    body.iquat = model.body_iquat[body.id]
    body.inertia = model.body_inertia[body.id]
    body.fullinertia = np.full(6, np.nan)


_STANDING = re.compile("home|stand|nominal|default|init", re.IGNORECASE)


def infer_home(spec, model) -> Iterator[str]:
    """Keyframe "home": another keyframe, or all joints as near to zero as their limits allow."""
    if any(key.name == "home" for key in spec.keys):
        return
    hint = (
        f'to say it yourself add <keyframe><key name="home" qpos="..."/></keyframe> with '
        f"{model.nq} numbers"
    )
    named = [key for key in spec.keys if _STANDING.search(key.name)] or list(spec.keys)
    if named:
        qpos = np.array(model.key_qpos[named[0].id])
        note = f"the nominal pose is that of keyframe {named[0].name!r}"
    else:
        qpos, moved = _near_zero(model)
        note = "the nominal pose has all joints at zero"
        if moved:
            note += (
                f", but {_listed(moved)} at the nearest position within their limits, and the "
                "others so that the feet stay below the body"
            )
    for key in list(spec.keys):
        spec.delete(key)
    spec.add_key(name="home", qpos=qpos)
    yield f'no keyframe "home": {note}; {hint}'


def _near_zero(model) -> tuple[np.ndarray, list[str]]:
    """qpos [nq] within limits near qpos0, and names of the joints that qpos0 puts outside.

    If there are any, the others move so that the leg ends stay where qpos0 has them, seen from
    above: bent knees alone would put the feet beside the body.
    """
    hinges = np.flatnonzero(model.jnt_type == _JOINT.mjJNT_HINGE)
    where = model.jnt_qposadr[hinges]
    low, high = model.jnt_range[hinges].T
    qpos = np.array(model.qpos0)
    clipped = np.clip(qpos[where], low, high)
    moved = [model.joint(int(j)).name for j in hinges[clipped != qpos[where]]]
    if not moved:
        return qpos, moved
    data = mujoco.MjData(model)
    ends = [geoms[0] for geoms in _leg_ends(model, _with(qpos, where, clipped)).values()]
    if not ends:
        return _with(qpos, where, clipped), moved

    def positions(angles):
        data.qpos[:] = _with(qpos, where, angles)
        mujoco.mj_kinematics(model, data)
        return data.geom_xpos[ends, :2].ravel()

    goal = positions(qpos[where])
    length = _leg_length(model, ends)
    margin = 0.1 * (high - low)  # the soft limits of the method are inside the hard ones
    bounds = low + margin, high - margin
    start = np.clip(qpos[where], *bounds)

    def residual(angles):
        return np.concatenate([(positions(angles) - goal) / length, 0.03 * (angles - start)])

    found = least_squares(residual, start, bounds=(bounds[0] - 1e-9, bounds[1] + 1e-9))
    return _with(qpos, where, np.round(found.x, 4)), moved


def _with(qpos, where, angles) -> np.ndarray:
    qpos = np.array(qpos)
    qpos[where] = angles
    return qpos


def infer_feet(spec, model) -> Iterator[str]:
    """One sphere or box per foot, with "foot" in its name and nothing else so named.

    Named geoms of other shapes are replaced by the sphere or box that bounds them. Without names,
    feet are the lowest geoms of the legs: of the outermost moving bodies that reach the floor in
    the home pose.
    """
    geoms = {geom.id: geom for geom in spec.geoms}
    named: dict[int, list[int]] = {}
    for index, geom in geoms.items():
        if _FOOT.search(geom.name) and geom.parent.name != "world":
            named.setdefault(int(model.geom_bodyid[index]), []).append(index)
    if named and all(
        len(group) == 1 and model.geom_type[group[0]] in _FEET and not geoms[group[0]].meshname
        for group in named.values()
    ):
        return
    data = _home_data(model)
    if named:
        groups = {body: _solid(model, group) for body, group in named.items()}
    else:
        groups = _leg_ends(model, data.qpos)
    labels = {group[0]: _foot_name(geoms, group) for group in groups.values()}
    # A mesh that is only for looks must not count as a foot.
    for group in named.values():
        for index in group:
            _rename(spec, geoms[index], _FOOT.sub("sole", geoms[index].name))
    made = []
    for group in groups.values():
        geom = geoms[group[0]]
        body = geom.parent
        # The inertia of the body must not follow its new foot.
        if not body.explicitinertial:
            _write_inertial(body, model)
        was = _shape_name(model, group)
        if len(group) > 1 or model.geom_type[group[0]] not in _FEET or geom.meshname:
            geom = _replace(spec, geom, *_bounding(model, data, group))
            for other in group[1:]:
                _drop_geom(spec, geoms[other])
        _rename(spec, geom, _unused(labels[group[0]], {other.name for other in spec.geoms}))
        shape = "sphere" if geom.type == _GEOM.mjGEOM_SPHERE else "box"
        made.append(f"{geom.name!r} (body {body.name!r}, {was}, now a {shape})")
    if not made:
        return
    if named:
        yield (
            f"feet must be one sphere or box each: {', '.join(made)}; to say it yourself replace "
            "the geoms"
        )
    else:
        yield (
            'no geom has "foot" in its name: the lowest geoms of the legs are the feet: '
            f"{', '.join(made)}; to say it yourself name the geoms that touch the floor, "
            'e.g. name="left_foot"'
        )


def _foot_name(geoms, group) -> str:
    """The name of the geom, or of the body if there are several, with "foot" in it."""
    geom = geoms[group[0]]
    name = geom.name if geom.name and len(group) == 1 else geom.parent.name
    return name if _FOOT.search(name) else f"{name}_foot"


def _solid(model, group) -> list[int]:
    """The geoms of a group that are not meshes; all of them if it has only meshes."""
    return [i for i in group if model.geom_type[i] not in _MESHES] or group


def _leg_ends(model, qpos) -> dict[int, list[int]]:
    """Moving body -> geom ids of its lowest geoms, for bodies at the end of a leg in pose qpos."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    moving = model.body_weldid
    parents = {int(moving[model.body_parentid[body]]) for body in np.unique(moving) if body}
    lowest, chosen = {}, {}
    for body in (int(body) for body in np.unique(moving) if body and body not in parents):
        group = np.flatnonzero(moving[model.geom_bodyid] == body)
        solid = _solid(model, list(group))
        touching = [i for i in solid if model.geom_contype[i] or model.geom_conaffinity[i]]
        group = touching or solid
        if group:
            bottom = np.array([_lowest(model, data, i) for i in group])
            lowest[body], chosen[body] = bottom.min(), (np.array(group), bottom)
    if not lowest:
        return {}
    floor = min(lowest.values())
    height = data.xpos[1, 2] - floor
    return {
        body: [int(i) for i in group[bottom <= lowest[body] + 0.02 * height]]
        for body, (group, bottom) in chosen.items()
        if lowest[body] <= floor + 0.2 * height
    }


def _lowest(model, data, geom: int) -> float:
    return data.geom_xpos[geom, 2] - _reach(model, data, geom, np.array([0, 0, -1.0]))


def _reach(model, data, geom: int, direction) -> float:
    """How far a geom extends from its centre along a unit vector of the world, m."""
    size = model.geom_size[geom]
    local = data.geom_xmat[geom].reshape(3, 3).T @ direction
    along, across = abs(local[2]), np.hypot(local[0], local[1])
    match _GEOM(model.geom_type[geom]):
        case _GEOM.mjGEOM_SPHERE:
            return size[0]
        case _GEOM.mjGEOM_CAPSULE:
            return size[0] + size[1] * along
        case _GEOM.mjGEOM_CYLINDER:
            return size[0] * across + size[1] * along
        case _GEOM.mjGEOM_ELLIPSOID:
            return float(np.linalg.norm(size * local))
        case _GEOM.mjGEOM_BOX:
            return float(size @ np.abs(local))
        case _GEOM.mjGEOM_MESH:
            mesh = model.geom_dataid[geom]
            start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
            return float(np.max(model.mesh_vert[start : start + count] @ local))
    centre, half = np.split(model.geom_aabb[geom], 2)
    return float(centre @ local + half @ np.abs(local))


def _bounding(model, data, group):
    """Type, size, position and quaternion (in the body frame) of the foot for some geoms.

    A capsule or long cylinder that stands becomes the sphere at its lower end. All else becomes
    the smallest box about the geoms along the axes of the first geom, of the body or of the world,
    or the sphere of the same width if that box is nearly a cube.
    """
    first = group[0]
    kind = model.geom_type[first]
    body = model.geom_bodyid[first]
    turn, origin = data.xmat[body].reshape(3, 3), data.xpos[body]
    frame = data.geom_xmat[first].reshape(3, 3)
    upright = np.eye(4)[0]
    radius, half, _ = model.geom_size[first]
    capsule = kind == _GEOM.mjGEOM_CAPSULE
    long = capsule or (kind == _GEOM.mjGEOM_CYLINDER and half > 2 * radius)
    if len(group) == 1 and long and abs(frame[2, 2]) > 0.5:
        below = half if capsule else half - radius
        end = data.geom_xpos[first] - np.sign(frame[2, 2]) * below * frame[:, 2]
        return _GEOM.mjGEOM_SPHERE, [radius, 0, 0], turn.T @ (end - origin), upright

    def box(axes):
        """Half size and centre along the columns of `axes`."""
        ends = []
        for sign in (1, -1):
            reach = [[_reach(model, data, i, sign * axis) for axis in axes.T] for i in group]
            ends.append(np.max(sign * (data.geom_xpos[group] @ axes) + reach, axis=0))
        high, low = ends[0], -ends[1]
        return (high - low) / 2, axes @ ((high + low) / 2)

    axes = min((frame, turn, np.eye(3)), key=lambda axes: np.prod(box(axes)[0]))
    half, centre = box(axes)
    position = turn.T @ (centre - origin)
    if half.max() < 1.3 * half.min():
        return _GEOM.mjGEOM_SPHERE, [float(half.mean()), 0, 0], position, upright
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, (turn.T @ axes).ravel())
    return _GEOM.mjGEOM_BOX, half, position, quaternion


def _replace(spec, geom, kind, size, position, quaternion):
    """A new geom in the place of another one, with its name and looks, posed in the body frame."""
    new = geom.parent.add_geom(type=kind, size=size, pos=position, quat=quaternion)
    for name in ("group", "rgba", "material", "contype", "conaffinity"):
        setattr(new, name, getattr(geom, name))
    name = geom.name
    spec.delete(geom)
    new.name = name
    return new


def _shape_name(model, group) -> str:
    kinds = {_GEOM(model.geom_type[i]).name.removeprefix("mjGEOM_").lower() for i in group}
    return f"{len(group)} geoms" if len(group) > 1 else f"a {kinds.pop()}"


def infer_height(spec, model) -> Iterator[str]:
    """The trunk in "home" so high that the lowest foot touches the floor."""
    feet = _feet(model)
    if not feet:
        return
    data = _home_data(model)
    gap = min(_lowest(model, data, foot) for foot in feet)
    height = data.xpos[1, 2] - gap
    if abs(gap) <= FLOOR_TOLERANCE * height:
        return
    key = spec.key("home")
    qpos = np.array(data.qpos)
    qpos[2] -= gap
    key.qpos = qpos
    side = "above" if gap > 0 else "below"
    yield (
        f'the feet of "home" are {abs(gap):.3f} m {side} the floor: the trunk is moved to z = '
        f"{qpos[2]:.4f} m; to say it yourself correct the third number of qpos"
    )


def infer_actuators(spec, model) -> Iterator[str]:
    """Position servos with symmetric torque limits and one pair of gains for the whole robot.

    P and D gain are the medians of the file's position servos. Without any, P is 1.5 N m/rad per
    kg of the robot, within 20 and 80, and D = P / 40: for the 50 robots of the paper P is within a
    factor 1.5 of the paper's for 92 %, D within a factor 2 for all (1.5 for 84 %).
    Without a torque limit in the file (of the actuator, of its control range or of the joint) it is
    `leg_torque`.
    """
    hinges = np.flatnonzero(model.jnt_type == _JOINT.mjJNT_HINGE)
    if model.nu == 0 and len(hinges) == 0:
        return
    joints = {joint.id: joint for joint in spec.joints}
    servos = [_is_servo(model, i) for i in range(model.nu)]
    gains = np.array([_gains(model, i) for i in range(model.nu) if servos[i]]).reshape(-1, 2)
    limits = [_torque_limit(model, i) for i in range(model.nu)]
    driven = model.actuator_trnid[:, 0] if model.nu else hinges
    fits = (
        model.nu > 0
        and all(servos)
        and len(np.unique(gains, axis=0)) == 1
        and np.all(model.actuator_trntype == _TRN.mjTRN_JOINT)
        and np.all(model.actuator_gear[:, 0] == 1)
        and np.all(model.actuator_forcelimited)
        and np.all(model.actuator_forcerange[:, 0] == -model.actuator_forcerange[:, 1])
        and not np.any(model.actuator_ctrllimited)
        and not np.any(model.jnt_actfrclimited[driven])
    )
    if fits:
        return
    if model.nu == 0:
        yield (
            f"no actuators: one position servo for each of the {len(hinges)} hinge joints; to say "
            "it yourself add an <actuator> section"
        )
        limits = [_joint_limit(model, j) for j in driven]
        for joint in driven:
            spec.add_actuator(name=joints[joint].name, target=joints[joint].name)
    elif not all(servos):
        others = [_actuator_name(model, i) for i in range(model.nu) if not servos[i]]
        yield (
            f"actuators {_listed(others)} are motors or other drives: replaced by position "
            "servos, the form of control of the method; to say it yourself use <position>"
        )

    if len(gains):
        p_gain, d_gain = np.median(gains, axis=0)
        different = np.unique(gains, axis=0)
        if len(different) > 1:
            listing = ", ".join(f"{p:g}/{d:g}" for p, d in different)
            yield (
                f"{len(different)} different kp/kv ({listing}): the method has one pair for the "
                f"whole robot, the median {p_gain:g}/{d_gain:g}; to say it yourself use the same "
                "kp and kv everywhere"
            )
    else:
        p_gain = float(np.round(np.clip(1.5 * model.body_mass[1:].sum(), 20, 80)))
        d_gain = p_gain / 40
        yield (
            f"no gains: kp = {p_gain:g} N m/rad and kv = {d_gain:g} N m s/rad from the mass of "
            f"{model.body_mass[1:].sum():.3g} kg; to say it yourself give them in <position>"
        )

    missing = [int(driven[i]) for i, limit in enumerate(limits) if limit is None]
    if missing:
        guess = float(f"{leg_torque(model):.3g}")
        names = [model.joint(j).name for j in missing]
        yield (
            f"no torque limits of joints {_listed(names)}: {guess:g} N m, the weight on one foot "
            "times the length of a leg; to say it yourself add forcerange to the actuators"
        )
        limits = [guess if limit is None else limit for limit in limits]
    if np.any(model.actuator_ctrllimited[servos]):
        yield "control ranges of the actuators are removed: joint limits and torque limits remain"
    geared = [i for i in range(model.nu) if model.actuator_gear[i, 0] != 1]
    if geared:
        yield (
            f"gears of actuators {_listed([_actuator_name(model, i) for i in geared])} are "
            "multiplied into torque limits and gains, which are those of the joint"
        )
    low, high = model.actuator_forcerange.T
    uneven = [i for i in np.flatnonzero(model.actuator_forcelimited) if -low[i] != high[i]]
    if uneven:
        yield (
            f"torque limits of {_listed([_actuator_name(model, i) for i in uneven])} are not "
            "symmetric: the smaller one holds in both directions"
        )
    if np.any(model.jnt_actfrclimited[driven]):
        yield "torque limits of the joints (actuatorfrcrange, effort) are moved to the actuators"

    for actuator, joint, limit in zip(_ordered(spec.actuators), driven, limits, strict=True):
        _make_servo(actuator, joints[int(joint)], p_gain, d_gain, limit)
    home = np.array(model.key_qpos[_home_id(model)])
    for key in [key for key in spec.keys if key.name != "home"]:
        spec.delete(key)
    key = spec.key("home")
    key.act = []
    key.ctrl = home[model.jnt_qposadr[driven]]


def _ordered(elements) -> list:
    return sorted(elements, key=lambda element: element.id)


def _is_servo(model, i) -> bool:
    p_gain = model.actuator_gainprm[i, 0]
    return bool(
        model.actuator_gaintype[i] == mujoco.mjtGain.mjGAIN_FIXED
        and model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_AFFINE
        and model.actuator_dyntype[i] == mujoco.mjtDyn.mjDYN_NONE
        and p_gain > 0
        and model.actuator_biasprm[i, 1] == -p_gain
    )


def _gains(model, i) -> tuple[float, float]:
    """P and D gain at the joint."""
    square = model.actuator_gear[i, 0] ** 2
    return square * model.actuator_gainprm[i, 0], 0.0 - square * model.actuator_biasprm[i, 2]


def _torque_limit(model, i) -> float | None:
    """Smallest torque limit that the file gives for an actuator, at the joint, N m."""
    gear = abs(model.actuator_gear[i, 0])
    limits = [_joint_limit(model, model.actuator_trnid[i, 0])]
    if model.actuator_forcelimited[i]:
        limits.append(gear * _smaller(model.actuator_forcerange[i]))
    if (
        model.actuator_ctrllimited[i]
        and model.actuator_gaintype[i] == mujoco.mjtGain.mjGAIN_FIXED
        and model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_NONE
    ):
        gain = abs(model.actuator_gainprm[i, 0])
        limits.append(gear * gain * _smaller(model.actuator_ctrlrange[i]))
    return min((limit for limit in limits if limit), default=None)


def _joint_limit(model, joint) -> float | None:
    if not model.jnt_actfrclimited[joint]:
        return None
    return _smaller(model.jnt_actfrcrange[joint]) or None


def _smaller(bounds) -> float:
    low, high = np.abs(bounds)
    return float(min(low, high) or max(low, high))


def leg_torque(model) -> float:
    """Weight on one foot times the length of a leg, N m.

    Its ratio to the torque limit of a robot's strongest leg joint has the median 1.1 over the 50
    robots of the paper, and is within a factor 2 for 86 %.
    """
    feet = _feet(model)
    weight = model.body_mass[1:].sum() * np.linalg.norm(model.opt.gravity)
    return float(weight * _leg_length(model, feet) / max(1, len(feet)))


def _leg_length(model, ends) -> float:
    """Mean length of the chains of bodies from the trunk to some geoms, m."""
    lengths = []
    for geom in ends:
        length, body = np.linalg.norm(model.geom_pos[geom]), model.geom_bodyid[geom]
        while body > 1:
            length += np.linalg.norm(model.body_pos[body])
            body = model.body_parentid[body]
        lengths.append(length)
    return float(np.mean(lengths)) if lengths else 0.3


def _make_servo(actuator, joint, p_gain, d_gain, limit):
    actuator.trntype = _TRN.mjTRN_JOINT
    actuator.target = joint.name
    actuator.dyntype = mujoco.mjtDyn.mjDYN_NONE
    actuator.dynprm = [1] + [0] * (len(actuator.dynprm) - 1)
    actuator.actdim = -1
    actuator.set_to_position(kp=p_gain, kv=d_gain)
    actuator.gear = [1, 0, 0, 0, 0, 0]
    actuator.inheritrange = 0
    actuator.ctrllimited = mujoco.mjtLimited.mjLIMITED_FALSE
    actuator.actlimited = mujoco.mjtLimited.mjLIMITED_FALSE
    actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
    actuator.forcerange = [-limit, limit]
    joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE


def drop_meshes(spec, model) -> Iterator[str]:
    """Meshes, height fields and image files are dropped; the file then stands by itself."""
    fitted = [geom for geom in spec.geoms if geom.meshname and geom.type not in _MESHES]
    for geom in fitted:  # primitives whose size the compiler takes from a mesh
        size, position = model.geom_size[geom.id], model.geom_pos[geom.id]
        _replace(spec, geom, geom.type, size, position, model.geom_quat[geom.id])
    meshes = [geom for geom in spec.geoms if geom.type in _MESHES]
    bodies = [geom.parent for geom in meshes]
    for geom in meshes:
        _drop_geom(spec, geom)
    assets = _drop_assets(spec)
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


def _drop_assets(spec) -> int:
    files = [texture for texture in spec.textures if texture.file or any(texture.cubefiles)]
    names = {texture.name for texture in files}
    for material in spec.materials:
        if names & set(material.textures):
            material.textures = [""] * len(material.textures)
    assets = [*spec.meshes, *spec.hfields, *spec.skins, *files]
    for asset in assets:
        spec.delete(asset)
    return len(assets)


def infer_contacts(spec, model) -> Iterator[str]:
    """Only feet meet the floor; all other contacts are switched off."""
    colliding = [geom for geom in spec.geoms if geom.contype or geom.conaffinity]
    for geom in colliding:
        geom.contype = geom.conaffinity = 0
    pairs = [
        pair
        for pair in spec.pairs
        if not any(
            floor == "floor" and _FOOT.search(foot)
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
    planes = [geom for geom in spec.worldbody.geoms if geom.type == _GEOM.mjGEOM_PLANE]
    if any(geom.name == "floor" for geom in planes):
        return
    for geom in spec.geoms:
        if geom.name == "floor":
            _rename(spec, geom, _unused("ground", {other.name for other in spec.geoms}))
    if planes:
        was = planes[0].name
        _rename(spec, planes[0], "floor")
        planes[0].pos, planes[0].quat = [0, 0, 0], [1, 0, 0, 0]
        yield f'no geom "floor": the plane {was!r} is the floor; to say it yourself rename it'
    else:
        spec.worldbody.add_geom(
            name="floor", type=_GEOM.mjGEOM_PLANE, size=[0, 0, 0.05], contype=0, conaffinity=0
        )
        yield (
            "no floor: a plane at z = 0 is added; to say it yourself add "
            '<geom name="floor" type="plane" size="0 0 0.05" contype="0" conaffinity="0"/>'
        )


_IMU = re.compile("imu", re.IGNORECASE)


def infer_imu(spec, model) -> Iterator[str]:
    """A site "imu" in the trunk."""
    sites = [site for site in _ordered(spec.sites) if _IMU.search(site.name)]
    trunk = [site for site in sites if model.site_bodyid[site.id] == 1]
    if any(site.name == "imu" for site in trunk):
        return
    for site in sites:
        if site.name == "imu":  # of another body
            _rename_site(spec, site, _unused(f"imu_{site.parent.name}", {s.name for s in sites}))
    if trunk:
        was = trunk[0].name
        _rename_site(spec, trunk[0], "imu")
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
    if _has_numeric(model, "action_scale"):
        return
    mass, feet = model.body_mass[1:].sum(), len(_feet(model))
    scale = 0.25 if feet == 4 and mass < 25 else 0.75 if feet == 2 and mass > 40 else 0.5
    spec.add_numeric(name="action_scale", data=[scale], size=1)
    yield (
        f"no action scale: {scale:g} rad, as robots of {feet} feet and {mass:.3g} kg have it; to "
        f'say it yourself add <custom><numeric name="action_scale" data="{scale:g}"/></custom>'
    )


def infer_velocity_limits(spec, model) -> Iterator[str]:
    """15 rad/s: within a factor 2 of the median joint for 62 % of the 50 robots."""
    if _has_numeric(model, "velocity_limits") or model.nu == 0:
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
    if _has_numeric(model, "keep_nominal"):
        return
    carrying = set()
    for foot in _feet(model):
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
        f"joints {_listed(names)} carry no foot: they should keep their nominal positions; to say "
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
        f"tendons {_listed(sorted(names))} are dropped, with their springs and limits: the design "
        "of the robot has no parameters for them"
    )


STEPS = (
    infer_options,
    infer_inertials,
    drop_tendons,
    infer_home,
    infer_feet,
    infer_height,
    infer_actuators,
    drop_meshes,
    infer_floor,
    infer_contacts,
    infer_imu,
    infer_action_scale,
    infer_velocity_limits,
    infer_keep_nominal,
)


# Small helpers.


def _home_id(model) -> int:
    return mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, "home")


def _home_data(model) -> mujoco.MjData:
    """Positions of all parts in the home pose."""
    data = mujoco.MjData(model)
    data.qpos[:] = model.key_qpos[_home_id(model)]
    mujoco.mj_kinematics(model, data)
    return data


def _feet(model) -> list[int]:
    return [
        i
        for i in range(model.ngeom)
        if model.geom_bodyid[i] and _FOOT.search(model.geom(i).name or "")
    ]


def _has_numeric(model, name: str) -> bool:
    return mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, name) >= 0


def _actuator_name(model, i: int) -> str:
    return model.actuator(i).name or model.joint(int(model.actuator_trnid[i, 0])).name


def _unused(name: str, taken) -> str:
    candidates = [name, *(f"{name}_{i}" for i in range(2, len(taken) + 3))]
    return next(candidate for candidate in candidates if candidate not in taken)


def _listed(names) -> str:
    """Names for a message; of many, the first ones and how many more."""
    shown = [str(name) or "(unnamed)" for name in names]
    more = f" and {len(shown) - 6} more" if len(shown) > 6 else ""
    return ", ".join(shown[:6]) + more


def _references(spec):
    """Attributes of other elements that name geoms."""
    for pair in spec.pairs:
        yield pair, "geomname1"
        yield pair, "geomname2"
    for sensor in spec.sensors:
        if sensor.objtype == mujoco.mjtObj.mjOBJ_GEOM:
            yield sensor, "objname"
        if sensor.reftype == mujoco.mjtObj.mjOBJ_GEOM:
            yield sensor, "refname"


def _rename(spec, geom, name: str):
    old = geom.name
    geom.name = name
    for element, attribute in _references(spec) if old else ():
        if getattr(element, attribute) == old:
            setattr(element, attribute, name)


def _rename_site(spec, site, name: str):
    for sensor in spec.sensors:
        if sensor.objtype == mujoco.mjtObj.mjOBJ_SITE and sensor.objname == site.name:
            sensor.objname = name
    site.name = name


def _drop_geom(spec, geom):
    """Delete a geom and what refers to it."""
    dangling = [
        element
        for element, attribute in _references(spec)
        if geom.name and getattr(element, attribute) == geom.name
    ]
    for element in {id(element): element for element in dangling}.values():
        spec.delete(element)
    spec.delete(geom)
