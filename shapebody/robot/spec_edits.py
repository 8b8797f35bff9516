"""Small edits of an MjSpec that keep what refers to the edited elements."""

import itertools
import re

import mujoco
import numpy as np

_GEOM, _JOINT = mujoco.mjtGeom, mujoco.mjtJoint


COLLISION_GROUP = 5
FOOT = re.compile("foot(?!print)", re.IGNORECASE)  # "base_footprint" is not a foot
IMU = re.compile("imu", re.IGNORECASE)

# Integers compare equal with what models hold and with what specs hold.
MESHES = tuple(map(int, (_GEOM.mjGEOM_MESH, _GEOM.mjGEOM_HFIELD, _GEOM.mjGEOM_SDF)))


def unused(name: str, taken) -> str:
    """The name, with a number if it is taken."""
    candidates = itertools.chain([name], (f"{name}_{i}" for i in itertools.count(2)))
    return next(candidate for candidate in candidates if candidate not in taken)


def listed(names) -> str:
    """Names for a message; of many, the first ones and how many more."""
    shown = [str(name) or "(unnamed)" for name in names]
    more = f" and {len(shown) - 6} more" if len(shown) > 6 else ""
    return ", ".join(shown[:6]) + more


def comment(text: str) -> str:
    """An XML comment; two hyphens would end it, so a space goes between them."""
    return f"<!-- {re.sub('-(?=-)', '- ', text)} -->"


def each(kind: str, names) -> str:
    """Singular subject of a message about elements: "body 'a'", "each of bodies 'a', 'b'"."""
    names = list(names)
    if len(names) == 1:
        return f"{kind} {names[0]}"
    plural = f"{kind[:-1]}ies" if kind.endswith("y") else f"{kind}s"
    return f"each of {plural} {listed(names)}"


def ordered(elements) -> list:
    """Elements of a compiled spec in the order of the model."""
    return sorted(elements, key=lambda element: element.id)


def carrier(spec, body):
    """The body of a spec that moves a body: itself, or the one that it is fixed to.

    Fixed to the base, or to the world, it is the outermost body.
    """
    # `body.joints` raises the compiler's error again if the spec did not compile.
    moving = {joint.parent.name for joint in spec.joints}
    while body.name not in moving and body.name != "world" and body.parent.name != "world":
        body = body.parent
    return body


def name_parts(spec):
    """Name what other elements refer to and MJCF leaves optional."""
    taken = {joint.name for joint in spec.joints}
    for index, joint in enumerate(spec.joints):
        if not joint.name and joint.type != _JOINT.mjJNT_FREE:
            joint.name = unused(f"joint_{index}", taken)
            taken.add(joint.name)
    taken = {geom.name for geom in spec.geoms}
    spheres = [geom for geom in spec.geoms if geom.group == COLLISION_GROUP]
    for index, geom in enumerate(spheres):
        if not geom.name:
            geom.name = unused(f"sphere_{index}", taken)
            taken.add(geom.name)
    taken = {actuator.name for actuator in spec.actuators}
    for actuator in spec.actuators:
        if not actuator.name:
            actuator.name = unused(actuator.target, taken)
            taken.add(actuator.name)


def write_inertial(body, model):
    """Make the inertial of a body explicit, as it was compiled."""
    body.explicitinertial = True
    body.mass = model.body_mass[body.id]
    body.ipos = model.body_ipos[body.id]
    body.iquat = model.body_iquat[body.id]
    body.inertia = model.body_inertia[body.id]
    body.fullinertia = np.full(6, np.nan)


def keep_inertias_writable(spec, model):
    """Let the inertias of flat bodies survive MuJoCo's writer, which rounds to six digits.

    The two smaller moments of a flat body add up to the largest. Rounded, they can fall short of
    it, and MuJoCo then refuses its own text; so they are raised by what rounding can take.
    """
    for body in spec.bodies[1:]:
        if not body.explicitinertial:
            continue
        moments = model.body_inertia[body.id]
        largest, margin = moments.max(), 1e-5 * moments.max()
        if moments.sum() < 2 * largest + margin:
            write_inertial(body, model)
            body.inertia = np.where(moments == largest, moments, moments + margin)


def add_like(geom, kind, size, position, quaternion):
    """A new geom without a name, with the looks of another one, posed in the frame of its body."""
    new = geom.parent.add_geom(type=kind, size=size, pos=position, quat=quaternion)
    for name in ("group", "rgba", "material", "contype", "conaffinity"):
        setattr(new, name, getattr(geom, name))
    return new


def replace_geom(spec, geom, kind, size, position, quaternion):
    """A new geom in the place of another one, with its name and looks, posed in the body frame."""
    new = add_like(geom, kind, size, position, quaternion)
    name = geom.name
    spec.delete(geom)
    new.name = name
    return new


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


def rename_geom(spec, geom, name: str):
    """Rename a geom, and in what refers to it."""
    old = geom.name
    geom.name = name
    for element, attribute in _references(spec) if old else ():
        if getattr(element, attribute) == old:
            setattr(element, attribute, name)


def rename_site(spec, site, name: str):
    """Rename a site, and in the sensors that refer to it."""
    for sensor in spec.sensors:
        if sensor.objtype == mujoco.mjtObj.mjOBJ_SITE and sensor.objname == site.name:
            sensor.objname = name
    site.name = name


def drop_geom(spec, geom):
    """Delete a geom and what refers to it."""
    dangling = [
        element
        for element, attribute in _references(spec)
        if geom.name and getattr(element, attribute) == geom.name
    ]
    for element in {id(element): element for element in dangling}.values():
        spec.delete(element)
    spec.delete(geom)


def add_floor(spec) -> str:
    """Add the floor; returns the note that says so.

    A file without a floor rarely has a light or a sky, and pictures of it would be black: both are
    added where they are missing.
    """
    floor = spec.worldbody.add_geom(name="floor", type=_GEOM.mjGEOM_PLANE, size=[0, 0, 0.05])
    floor.contype = floor.conaffinity = 0
    floor.rgba = [0.8, 0.82, 0.84, 1]
    sky = mujoco.mjtTexture.mjTEXTURE_SKYBOX
    if not any(texture.type == sky for texture in spec.textures):
        flat, colour = mujoco.mjtBuiltin.mjBUILTIN_FLAT, [0.86, 0.9, 0.95]
        name = unused("sky", {texture.name for texture in spec.textures})
        spec.add_texture(
            name=name, type=sky, builtin=flat, rgb1=colour, rgb2=colour, width=8, height=48
        )
    if not spec.lights:
        spec.visual.headlight.ambient = [0.45, 0.45, 0.45]
    return (
        "no floor: a plane at z = 0 is added; to say it yourself add "
        '<geom name="floor" type="plane" size="0 0 0.05" contype="0" conaffinity="0"/>'
    )


def drop_assets(spec) -> int:
    """Delete meshes, height fields, skins and image files; returns how many."""
    files = [texture for texture in spec.textures if texture.file or any(texture.cubefiles)]
    names = {texture.name for texture in files}
    for material in spec.materials:
        if names & set(material.textures):
            material.textures = [""] * len(material.textures)
    assets = [*spec.meshes, *spec.hfields, *spec.skins, *files]
    for asset in assets:
        spec.delete(asset)
    return len(assets)
