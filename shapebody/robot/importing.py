"""Robot files: MJCF, or URDF through MuJoCo's importer, as specs that compile.

Missing meshes do not prevent reading. A URDF gets what the format cannot say: a floating base, and
velocity limits and feet from its own elements.
"""

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np

from shapebody.robot.assets import check_lost, drop_unreadable, find_meshes, parsed_urdf
from shapebody.robot.feet import sole_beside
from shapebody.robot.finite import not_finite
from shapebody.robot.foot_shapes import add_foot, is_tall
from shapebody.robot.geometry import posed
from shapebody.robot.guard import admit, require_writable
from shapebody.robot.spec_edits import (
    FOOT,
    MESHES,
    add_floor,
    carrier,
    each,
    listed,
    name_parts,
    ordered,
    unused,
)
from shapebody.robot.urdf import as_number, check_urdf, drop_endless_visuals, limits_of, link_of

_GEOM, _JOINT = mujoco.mjtGeom, mujoco.mjtJoint


VELOCITY_LIMIT = 15.0  # rad/s, the median over the 50 robots of their median joint
ARMATURE = 0.01  # kg m², the median of the 50 robots; 76 % are within a factor 2
IMU = re.compile("imu", re.IGNORECASE)


def read(path: Path) -> tuple[str, mujoco.MjSpec, mujoco.MjModel, list[str]]:
    """Text, spec, compiled model and first notes of an MJCF or URDF file.

    Raises ValueError, naming the fix, for a file that is not text, is empty, cut off or not valid,
    and for one that MuJoCo should not be given (`shapebody.robot.guard`).
    """
    admit(path)
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{path} is not UTF-8 text (byte {error.start} is {error.object[error.start]:#04x}): "
            "expected an MJCF or URDF file; save it as UTF-8, or give the XML file that belongs "
            "to this binary file"
        ) from error
    if not text.strip():
        raise ValueError(f"{path} is empty: expected an MJCF or URDF file; write the robot to it")
    shown = _without_comments(text)
    if "<xacro:" in shown:
        raise ValueError(
            f"{path} is a xacro template: expected a URDF; expand it first with "
            "'xacro FILE > robot.urdf', where ROS is installed"
        )
    root = re.search(r"<([A-Za-z_][\w:.-]*)", shown)
    urdf = root.group(1) == "robot" if root else path.suffix.lower() == ".urdf"
    notes, lost = [], []
    if urdf:
        notes.append("the file is a URDF: it is imported by MuJoCo and completed as MJCF")
        text = _prepared_urdf(path, shown, notes)

    # To a spec that compiles, without the meshes that cannot be read.
    try:
        if urdf:
            spec = _import_urdf(path, text, notes, lost)
        elif path.suffix == ".xml":
            spec = mujoco.MjSpec.from_file(str(path))
        else:  # MuJoCo knows a file by this ending only
            spec = mujoco.MjSpec.from_string(text)
            spec.modelfiledir = str(path.parent.absolute())
        name_parts(spec)
        try:
            model = _compile(spec, notes)
        except ValueError:
            lost += drop_unreadable(spec, "link" if urdf else "body", notes)
            model = _compile(spec, notes)
        if urdf:
            model = _float(spec, text, notes)
    except ValueError as error:
        kind = "URDF" if urdf else "MJCF"
        reason = _explained(error, kind, text)
        raise ValueError(f"{path} is not a valid {kind} file: {reason}") from error

    # What compiles and still cannot be used: too much to write, or legs that have lost their ends.
    require_writable(path, model)
    check_lost(path, model, lost, "link" if urdf else "body")
    if re.search(r"<include\s", shown):
        notes.append("other files are included: their text is merged into the completed file")
    return text, spec, model, notes


_FIXES = {
    "repeated name": "each name may be used once per kind of element; rename one of the two",
    "moving bodies": "give every body that moves an <inertial> with mass and inertia > 0",
    "qpos size": "give each keyframe as many numbers as the robot has positions (7 for the free "
    "joint, then 1 per hinge); if it has them, the trunk lacks its <freejoint/>",
    "balanceinertia": 'correct the inertia, or let <compiler balanceinertia="true"/> repair it',
    "positive eigenvalues": "an inertia must be positive definite; correct the numbers, e.g. to "
    "those of a box of the same mass and size",
    "opening file": "put the included file where the text says; a file that includes others must "
    "have a name that ends in '.xml'",
    "model type": "expected <mujoco> (MJCF) or <robot> (URDF) as the first element: this is "
    "another kind of file",
    "XML parse error": "expected a complete XML file; it may be cut off, so look at the place that "
    "is named",
    "allocate memory": "its sizes and counts ask for more memory than there is: make them smaller",
    "root element not found": "expected a complete XML file with a <mujoco> or <robot> root",
}


_TOP_LEVEL = {
    "URDF": "the base floats by itself: remove the link above the floating joint, and the joint; "
    "between links that move give the joint type revolute",
    "MJCF": "a <freejoint/> belongs to a body directly in <worldbody>: take the body out of the "
    "one around it, or move the <freejoint/> to the outermost body",
}


def _explained(error: Exception, kind: str, text: str) -> str:
    """What MuJoCo reports about a file of a kind ("URDF" or "MJCF"), and the fix."""
    reason = " ".join(str(error).split())
    default = (
        "correct the reported element" if "Element" in reason else "correct what the message names"
    )
    fixes = {**_FIXES, "top level": _TOP_LEVEL[kind]}
    fix = next((fix for part, fix in fixes.items() if part in reason), default)
    root = _urdf_root(text)
    wrong = [] if root is None else not_finite(root)
    if "bad format" in reason and re.search(r"\$[({]", text):
        fix = "this is part of a xacro template: expand it with 'xacro FILE > robot.urdf'"
    if wrong:
        fix = f"expected finite numbers, but {listed(wrong)}; correct them"
    return f"MuJoCo reports {reason!r}. {fix[0].upper()}{fix[1:]}"


_NO_ELEMENTS = {"<!--": "-->", "<![CDATA[": "]]>", "<?": "?>"}


def _without_comments(text: str) -> str:
    """The text of an XML file without its comments, CDATA and instructions, with the same lines."""
    parts, start, position = [], 0, 0
    while (opening := text.find("<", position)) >= 0:
        position = opening + 1
        word = next((word for word in _NO_ELEMENTS if text.startswith(word, opening)), None)
        if word is None or text.startswith("<?xml ", opening):
            continue
        parts.append(text[start:opening])
        closing = text.find(_NO_ELEMENTS[word], opening + len(word))
        if closing < 0:
            return "".join(parts)
        start = position = closing + len(_NO_ELEMENTS[word])
        parts.append("\n" * text.count("\n", opening, start))
    return "".join([*parts, text[start:]])


def _compile(spec, notes) -> mujoco.MjModel:
    """The compiled model, with a floor if contact pairs name one that is not there."""
    names = {geom.name for geom in spec.geoms}
    if any({pair.geomname1, pair.geomname2} - names == {"floor"} for pair in spec.pairs):
        notes.append(add_floor(spec))
    try:
        return spec.compile()
    except ValueError as error:
        first = error
    if "moving bodies" in str(first):
        # With tiny masses it compiles, and the checks can name every such body.
        spec.compiler.boundmass, spec.compiler.boundinertia = 1e-12, 1e-14
        return spec.compile()
    raise first


def _prepared_urdf(path: Path, text: str, notes) -> str:
    """The text of a checked URDF whose first link is the base.

    Links are often put above the base for the navigation of wheeled robots ("base_footprint").
    """
    root = _urdf_root(text)
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


def _urdf_root(text: str):
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


def _import_urdf(path: Path, text: str, notes, lost) -> mujoco.MjSpec:
    spec, files = parsed_urdf(_urdf_root(text), text, notes)
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


def _float(spec, text, notes) -> mujoco.MjModel:
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
    return _compile(spec, notes)


def _apply_limits(spec, text, notes):
    """Drop efforts that are not above 0, and add the velocities, which the importer drops."""
    root = _urdf_root(text)
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
