"""Robot files: MJCF, or URDF through MuJoCo's importer, as specs that compile.

Missing meshes do not prevent reading. A URDF gets what the format cannot say: a floating base, and
velocity limits and feet from its own elements.
"""

import re
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np

from shapebody.guard import admit, require_writable
from shapebody.specs import (
    FOOT,
    MESHES,
    add_floor,
    drop_assets,
    drop_geom,
    listed,
    name_parts,
    ordered,
    unused,
)

VELOCITY_LIMIT = 15.0  # rad/s, the median over the 50 robots of their median joint
ARMATURE = 0.01  # kg m², the median of the 50 robots; 76 % are within a factor 2
IMU = re.compile("imu", re.IGNORECASE)

_GEOM, _JOINT = mujoco.mjtGeom, mujoco.mjtJoint


def read(path: Path) -> tuple[str, mujoco.MjSpec, mujoco.MjModel, list[str]]:
    """Text, spec, compiled model and first notes of an MJCF or URDF file.

    Raises ValueError, naming the fix, for a file that is no text, empty, cut off or not valid, and
    for one that MuJoCo should not be given (`shapebody.guard`).
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
    if "<xacro:" in text:
        raise ValueError(
            f"{path} is a xacro template: expected a URDF; expand it first with "
            "'xacro FILE > robot.urdf', where ROS is installed"
        )
    root = re.search(r"<([A-Za-z_][\w:.-]*)", re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL))
    urdf = root.group(1) == "robot" if root else path.suffix.lower() == ".urdf"
    notes = []
    if urdf:
        notes.append("the file is a URDF: it is imported by MuJoCo and completed as MJCF")
        text = _prepared_urdf(path, text, notes)
    try:
        if urdf:
            spec = _import_urdf(path, text, notes)
        elif path.suffix == ".xml":
            spec = mujoco.MjSpec.from_file(str(path))
        else:  # MuJoCo knows a file by this ending only
            spec = mujoco.MjSpec.from_string(text)
            spec.modelfiledir = str(path.parent.absolute())
        name_parts(spec)
        model = _compile(spec, notes)
        if urdf:
            model = _float(spec, model, text, notes)
    except ValueError as error:
        kind = "URDF" if urdf else "MJCF"
        raise ValueError(f"{path} is not a valid {kind} file: {_explained(error)}") from error
    require_writable(path, model)
    if re.search(r"<include\s", text):
        notes.append("other files are included: their text is merged into the completed file")
    return text, spec, model, notes


_FIXES = {
    "repeated name": "each name may be used once per kind of element; rename one of the two",
    "moving bodies": "give every body that moves an <inertial> with mass and inertia > 0",
    "qpos size": "give each keyframe as many numbers as the robot has positions (7 for the free "
    "joint, then 1 per hinge); if it has them, the trunk lacks its <freejoint/>",
    "balanceinertia": 'correct the inertia, or let <compiler balanceinertia="true"/> repair it',
    "top level": "the base floats by itself: remove the link above the floating joint, and the "
    "joint; between links that move give the joint type revolute",
    "opening file": "put the included file where the text says; a file that includes others must "
    "have a name that ends in '.xml'",
    "model type": "expected <mujoco> (MJCF) or <robot> (URDF) as the first element: this is "
    "another kind of file",
    "XML parse error": "expected a complete XML file; it may be cut off, so look at the place that "
    "is named",
    "root element not found": "expected a complete XML file with a <mujoco> or <robot> root",
}


def _explained(error: Exception) -> str:
    reason = " ".join(str(error).split())
    default = "correct the reported element"
    fix = next((fix for part, fix in _FIXES.items() if part in reason), default)
    return f"MuJoCo reports {reason!r}. {fix[0].upper()}{fix[1:]}"


def _compile(spec, notes) -> mujoco.MjModel:
    """The compiled model; without meshes and textures if their files cannot be read."""
    names = {geom.name for geom in spec.geoms}
    if any({pair.geomname1, pair.geomname2} - names == {"floor"} for pair in spec.pairs):
        notes.append(add_floor(spec))
    try:
        return spec.compile()
    except ValueError as error:
        first = error
    if spec.meshes or spec.hfields or any(texture.file for texture in spec.textures):
        bodies = sorted(
            {geom.parent.name for geom in spec.geoms if geom.meshname or geom.type in MESHES}
            & {body.name for body in spec.bodies if not body.explicitinertial}
        )
        reason = str(first).strip().splitlines()[0]
        for geom in [geom for geom in spec.geoms if geom.meshname or geom.type in MESHES]:
            drop_geom(spec, geom)
        drop_assets(spec)
        notes.append(
            f"mesh or texture files cannot be read ({reason}): the robot is loaded without them"
            + (
                f"; bodies {listed(bodies)} have no <inertial>, so their mass comes from their "
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


def _prepared_urdf(path: Path, text: str, notes) -> str:
    """The text of a checked URDF whose first link is the base.

    Links are often put above the base for the navigation of wheeled robots ("base_footprint").
    """
    root = _urdf_root(text)
    if root is None:
        return text
    _check_urdf(path, root)
    dropped = []
    while (link := _empty_root(root)) is not None:
        (joint,) = [joint for joint in root.findall("joint") if _end(joint, "parent") == link]
        dropped.append(link)
        base = _end(joint, "child")
        for element in root.findall("link"):
            if element.get("name") == link:
                root.remove(element)
        root.remove(joint)
    if not dropped:
        return text
    notes.append(
        f"links {listed(dropped)} above {base!r} have no mass, no geometry and nothing else to "
        f"carry: {base!r} is the base, with its origin as that of the trunk"
    )
    return ElementTree.tostring(root, encoding="unicode")


def _check_urdf(path: Path, root):
    """Raises ValueError for what MuJoCo's importer does not notice."""
    repeated = [
        f"repeated name {name!r} in {kind} ({count} of them)"
        for kind in ("link", "joint")
        for name, count in Counter(part.get("name") for part in root.findall(kind)).items()
        if name and count > 1
    ]
    wrong: dict[str, list[str]] = {}
    for joint, velocity in _urdf_velocities(root):
        if not np.isfinite(_number(velocity)):
            wrong.setdefault(velocity, []).append(repr(joint))
    reasons = []
    if repeated:
        reasons.append(f"{listed(repeated)}. {_FIXES['repeated name'].capitalize()}")
    for velocity, joints in wrong.items():
        reasons.append(
            f"velocity of {'joint' if len(joints) == 1 else 'joints'} {listed(joints)} is "
            f"{velocity!r}: expected a number (rad/s); write it, or expand the xacro template that "
            "the file comes from"
        )
    if reasons:
        raise ValueError(f"{path} is not a valid URDF file: {'; '.join(reasons)}")


def _urdf_root(text: str):
    """Root element of a URDF; None if MuJoCo's more lenient parser has to read it alone."""
    try:
        return ElementTree.fromstring(text)
    except ElementTree.ParseError:
        return None


def _end(joint, kind: str) -> str | None:
    """Name of the "parent" or "child" link of a URDF joint."""
    element = joint.find(kind)
    return None if element is None else element.get("link")


def _empty_root(root) -> str | None:
    """Name of the root link if it is only a frame: no mass, no geometry, one fixed child."""
    joints = root.findall("joint")
    children = {_end(joint, "child") for joint in joints}
    tops = [link for link in root.findall("link") if link.get("name") not in children]
    if len(tops) != 1:
        return None
    below = [joint for joint in joints if _end(joint, "parent") == tops[0].get("name")]
    mass, origin = tops[0].find("inertial/mass"), below[0].find("origin") if below else None
    turn = "0" if origin is None else origin.get("rpy", "0")
    if (
        [joint.get("type") for joint in below] != ["fixed"]
        or _end(below[0], "child") not in {link.get("name") for link in root.findall("link")}
        or tops[0].find("visual") is not None
        or tops[0].find("collision") is not None
        or any(_number(angle) != 0 for angle in turn.split())  # it says what is up
        or (mass is not None and _number(mass.get("value", "0")) != 0)
    ):
        return None
    return tops[0].get("name")


def _number(text: str) -> float:
    """The number that a text is; NaN if it is none."""
    try:
        return float(text)
    except ValueError:
        return float("nan")


def _import_urdf(path: Path, text: str, notes) -> mujoco.MjSpec:
    if not re.search(r"<mujoco[\s>]", text):
        settings = '<mujoco><compiler fusestatic="false" discardvisual="false"/></mujoco>'
        text = re.sub(r"(<robot\b[^<>]*>)", lambda found: found.group(1) + settings, text, count=1)
    spec = mujoco.MjSpec.from_string(text)
    spec.modelfiledir = str(path.parent.absolute())
    spec.compiler.fusestatic = False
    spec.compiler.discardvisual = False
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
        names = listed(Path(file).name for file in lost.values())
        notes.append(
            f"{len(lost)} meshes are not found beside the file, or of a kind that MuJoCo cannot "
            f"read (it reads .stl, .obj and .msh): {names}; the robot is loaded without them"
        )


def _float(spec, model, text, notes) -> mujoco.MjModel:
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
    model = _compile(spec, notes)
    root = _urdf_root(text)
    speeds = {} if root is None else {name: float(v) for name, v in _urdf_velocities(root)}
    speeds = {name: speed for name, speed in speeds.items() if speed > 0}
    hinges = [joint.name for joint in ordered(spec.joints) if joint.type == _JOINT.mjJNT_HINGE]
    if any(name in speeds for name in hinges):
        data = [speeds.get(name, VELOCITY_LIMIT) for name in hinges]
        spec.add_numeric(name="velocity_limits", data=data, size=len(data))
        model = _compile(spec, notes)
    return model


_FOOT_LINK = re.compile(r"foot(_?link|_?frame)?(_?\d+|_[lr])?$", re.IGNORECASE)


def _feet_of_links(spec, fixed) -> Iterator[str]:
    """Geoms of fixed links with "foot" in their names become feet, one link per leg."""
    if any(FOOT.search(geom.name) for geom in spec.geoms):
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
        solid = [geom for geom in touching if geom.type not in MESHES]
        for geom in solid or touching:
            geom.name = unused(link.name, {other.name for other in spec.geoms})
    if guessed:
        yield (
            f"links {', '.join(guessed)} have no geometry that can be read: their feet are spheres "
            "at the origin of the link with a radius of 4 % of the leg; to say it yourself give "
            "the link a <collision> with a sphere or a box"
        )


def _urdf_velocities(root) -> Iterator[tuple[str, str]]:
    """Joints and the texts of their velocity limits; MuJoCo's importer has no place for them."""
    for joint in root.findall("joint"):
        limit = joint.find("limit")
        if limit is not None and limit.get("velocity") is not None:
            yield joint.get("name"), limit.get("velocity")
