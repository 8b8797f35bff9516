"""A URDF as a spec: through MuJoCo's importer, with what the format cannot say added.

That is a floating base, armature, and velocity limits and feet from elements that the importer
drops or merges.
"""

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np

from shapebody.robot.assets import Lost, find_meshes, parsed_urdf
from shapebody.robot.feet import sole_beside
from shapebody.robot.foot_shapes import add_foot, is_tall
from shapebody.robot.geometry import posed
from shapebody.robot.spec_edits import FOOT, IMU, MESHES, carrier, each, listed, ordered, unused
from shapebody.robot.urdf_checks import (
    as_number,
    check_urdf,
    drop_endless_visuals,
    limits_of,
    link_of,
)

_GEOM, _JOINT = mujoco.mjtGeom, mujoco.mjtJoint

VELOCITY_LIMIT = 15.0  # rad/s, the median over the 50 robots of their median joint
ARMATURE = 0.01  # kg m², the median of the 50 robots; 76 % are within a factor 2


def prepared_urdf(path: Path, text: str, notes: list[str]) -> str:
    """The text of a checked URDF whose first link is the base.

    Links are often put above the base for the navigation of wheeled robots ("base_footprint").
    Raises ValueError as `check_urdf`.
    """
    root = urdf_root(text)
    if root is None:
        return text
    changes = list(drop_endless_visuals(root))
    notes += changes + check_urdf(path, root)
    dropped = []
    while (link := _empty_root(root)) is not None:
        (joint,) = [joint for joint in root.findall("joint") if link_of(joint, "parent") == link]
        dropped.append(link)
        base = link_of(joint, "child")
        for element in root.findall("link"):
            if element.get("name") == link:
                root.remove(element)
        root.remove(joint)
    if dropped:
        notes.append(
            f"links {listed(dropped)} above {base!r} have no mass, no geometry and nothing else to "
            f"carry: {base!r} is the base, with its origin as that of the trunk"
        )
    if not dropped and not changes:
        return text
    return ElementTree.tostring(root, encoding="unicode")


def urdf_root(text: str):
    """Root element of a URDF; None if only MuJoCo's more lenient parser may be able to read it."""
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError:
        return None
    space, name = root.tag.rpartition("}")[::2]
    for element in root.iter() if name == "robot" and space else ():
        element.tag = element.tag.removeprefix(space + "}")
    return root


def _empty_root(root) -> str | None:
    """Name of the root link if it is only a frame: no mass, no geometry, one child that is fixed
    to it or floats."""
    joints = root.findall("joint")
    children = {link_of(joint, "child") for joint in joints}
    tops = [link for link in root.findall("link") if link.get("name") not in children]
    if len(tops) != 1:
        return None
    below = [joint for joint in joints if link_of(joint, "parent") == tops[0].get("name")]
    mass, origin = tops[0].find("inertial/mass"), below[0].find("origin") if below else None
    turn = "0" if origin is None else origin.get("rpy", "0")
    floats = [joint.get("type") for joint in below] == ["floating"]
    if floats:
        turn = "0"  # a floating base has no fixed orientation
    if (
        [joint.get("type") for joint in below] not in (["fixed"], ["floating"])
        or link_of(below[0], "child") not in {link.get("name") for link in root.findall("link")}
        or tops[0].find("visual") is not None
        or tops[0].find("collision") is not None
        or any(as_number(angle) != 0 for angle in turn.split())  # it says which way is up
        or (mass is not None and as_number(mass.get("value", "0")) != 0)
    ):
        return None
    return tops[0].get("name")


def import_urdf(path: Path, text: str, notes: list[str], lost: list[Lost]) -> mujoco.MjSpec:
    """The spec of a `prepared_urdf`; adds to the notes and to the meshes that are `lost`.

    Raises ValueError if MuJoCo cannot parse it.
    """
    spec, files = parsed_urdf(urdf_root(text), text, notes)
    spec.modelfiledir = str(path.parent.absolute())
    spec.compiler.fusestatic = False
    spec.compiler.discardvisual = False
    spec.compiler.balanceinertia = True  # many URDFs have inertias that are impossible
    for body in spec.bodies[1:]:
        xx, yy, zz, xy, xz, yz = body.fullinertia
        tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        if spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE:
            continue
        if not body.explicitinertial or (body.mass == 0 and not tensor.any()):
            # A link without <inertial> has no mass; MuJoCo would give it the density of water.
            body.explicitinertial = False
            body.mass, body.fullinertia = 0, np.full(6, np.nan)
            for geom in body.geoms:
                geom.mass = 0
        elif not (np.isfinite(tensor).all() and np.linalg.eigvalsh(tensor)[0] > 1e-12):
            body.fullinertia, body.inertia = np.full(6, np.nan), np.full(3, 1e-14)
    lost += find_meshes(spec, path, files, notes)
    return spec


def float_base(spec, text: str, notes: list[str]) -> None:
    """Free the base of an imported URDF and merge links that do not move by themselves."""
    bases = [body for body in spec.bodies[1:] if body.parent.name == "world"]
    if len(bases) == 1 and not spec.worldbody.geoms and not bases[0].joints:
        bases[0].add_freejoint(name=unused("root", {joint.name for joint in spec.joints}))
        notes.append(
            f"URDF cannot say that the base floats: link {bases[0].name!r} gets a free joint"
        )
    fixed = [body for body in spec.bodies[1:] if not body.joints]
    for body in fixed:
        if IMU.search(body.name):
            body.add_site(name=unused(body.name, {site.name for site in spec.sites}))
    notes += _feet_of_links(spec, fixed)
    if fixed:
        names = listed([body.name for body in fixed])
        notes.append(f"links {names} are fixed: merged into the links that carry them")
        spec.fuse_static()
    hinges = [joint for joint in spec.joints if joint.type == _JOINT.mjJNT_HINGE]
    for joint in hinges:
        joint.armature = joint.armature or ARMATURE
    if hinges:
        notes.append(
            f"URDF has no armature: {ARMATURE:g} kg m² for every joint, the inertia of its motor "
            "as the joint feels it; to say it yourself write the completed file and edit <joint "
            'armature="..."/>'
        )
    _apply_limits(spec, text, notes)


def _apply_limits(spec, text, notes):
    """Drop efforts that are not above 0, and add the velocities, which the importer drops."""
    root = urdf_root(text)
    if root is None:
        return
    hinges = [joint for joint in ordered(spec.joints) if joint.type == _JOINT.mjJNT_HINGE]
    missing: dict[tuple[str, str], list[str]] = {}

    def given(attribute, name, values):
        if as_number(values.get(name, "0")) > 0:
            return True
        value = "is missing" if name not in values else f"is {values[name]}"
        missing.setdefault((attribute, value), []).append(name)
        return False

    efforts, speeds = (dict(limits_of(root, name)) for name in ("effort", "velocity"))
    data = []
    for joint in hinges:
        if not given("effort", joint.name, efforts):
            joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
            joint.actfrcrange = [0, 0]
        known = given("velocity", joint.name, speeds)
        data.append(float(speeds[joint.name]) if known else VELOCITY_LIMIT)
    if hinges:
        spec.add_numeric(name="velocity_limits", data=data, size=len(data))
    instead = {
        "effort": "which sets no limit: the weight on one foot times the length of a leg is "
        "used instead, as in the note on torque limits",
        "velocity": f"which sets no limit: {VELOCITY_LIMIT:g} rad/s is used instead",
    }
    notes += [
        f"{attribute} of {each('joint', names)} {value}, {instead[attribute]}; to say it yourself "
        f"correct {attribute} in <limit>"
        for (attribute, value), names in missing.items()
    ]


_FOOT_LINK = re.compile(r"foot(_?link|_?frame)?(_?\d+|_[lr])?$", re.IGNORECASE)


def _feet_of_links(spec, fixed) -> Iterator[str]:
    """Geoms of fixed links with "foot" in their names become feet, one link per leg.

    A link that touches nothing is a frame or a marker if another part of its leg collides as low:
    then that part is the foot.
    """
    if any(FOOT.search(geom.name) for geom in spec.geoms):
        return
    # One link per leg: of several, one that collides, then the one with most geoms.
    links = {}
    for link in (link for link in fixed if _FOOT_LINK.search(link.name)):
        leg = carrier(spec, link).name
        best = links.setdefault(leg, link)
        links[leg] = max(best, link, key=lambda x: (_touching(x) != [], len(x.geoms)))
    feet = {link.name: _touching(link) for link in links.values()}
    guessed, markers = [], []
    # A link that touches nothing leaves its name to the sole beside it, if there is one.
    if not all(feet.values()):
        model = spec.compile()
        data = posed(model, model.qpos0)
        geoms = {geom.id: geom for geom in spec.geoms}
        soles = {}
        for link in (link for link in links.values() if not feet[link.name]):
            shown = [data.geom_xpos[geom.id, 2] for geom in link.geoms]
            level = min(shown, default=data.xpos[link.id, 2])
            soles[link.name] = sole_beside(model, data, link.id, level)
        for name, group in soles.items():
            if group:
                markers.append(name)
                tall = is_tall(model, data, group)
                feet[name] = [geoms[index] for index in group]
                if tall:
                    feet[name] = [add_foot(spec, geoms, model, data, group)]
    # What is left gets a sphere, and all get the names of their links.
    for link in links.values():
        if not feet[link.name] and not link.geoms:
            length, body = 0.0, link
            while body.parent.name != "world":
                length, body = length + np.linalg.norm(body.pos), body.parent
            radius = float(f"{0.04 * length:.2g}")
            link.add_geom(type=_GEOM.mjGEOM_SPHERE, size=[radius, 0, 0], mass=0)
            guessed.append(f"{link.name!r} ({radius:g} m)")
        shapes = feet[link.name] or list(link.geoms)
        solid = [geom for geom in shapes if geom.type not in MESHES]
        for geom in solid or shapes:
            geom.name = unused(link.name, {other.name for other in spec.geoms})
    if markers:
        yield (
            f"links {listed(markers)} have no <collision> and are beside other parts of their legs "
            "that have one, which are the feet under these names; to say it yourself give the link "
            "a <collision> with a sphere or a box"
        )
    if guessed:
        yield (
            f"links {', '.join(guessed)} have no geometry that can be read: their feet are spheres "
            "at the origin of the link with a radius of 4 % of the leg; to say it yourself give "
            "the link a <collision> with a sphere or a box"
        )


def _touching(link) -> list:
    return [geom for geom in link.geoms if geom.contype]
