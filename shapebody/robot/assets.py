"""Meshes and shapes that a robot file names: found beside the file, or dropped alone, with a note.

A robot needs no mesh. One that is missing, flat or of another kind must not cost the others, and
a shape that is only for looks must not keep a file from being read.
"""

import html
import itertools
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from shapebody.robot.feet import has_feet, legs_without_geom
from shapebody.robot.spec_edits import MESHES, carrier, drop_geom, each, listed, unused

_GEOM = mujoco.mjtGeom


READABLE = (".stl", ".obj", ".msh")

_MESH_FIELDS = (
    *("file", "content_type", "inertia", "scale", "refpos", "refquat", "maxhullvert"),
    *("smoothnormal", "uservert", "userface", "usernormal"),
)


@dataclass(frozen=True)
class Lost:
    """A file of a geom that was dropped because it cannot be read."""

    body: str
    """The body (in a URDF, the link) of the geom."""
    carrier: str
    """The body that moves it: itself, or the one that it is fixed to."""
    file: str
    reason: str


def parsed_urdf(root, text: str, notes: list[str]) -> tuple[mujoco.MjSpec, dict[str, str]]:
    """The spec of a URDF with its visuals, and the mesh files by the names that it has for them.

    `root` is the element of the text, or None if MuJoCo has to read it alone. What a <mujoco>
    element in the file says holds, with one other default: visuals stay.
    """
    if root is None:
        if "<mujoco" not in text:
            settings = '<mujoco><compiler discardvisual="false"/></mujoco>'
            text = re.sub(r"(<robot\b[^<>]*>)", rf"\1{settings}", text, count=1)
        return mujoco.MjSpec.from_string(text), {}
    extension = root.find("mujoco")
    if extension is None:
        extension = ElementTree.SubElement(root, "mujoco")
    compiler = extension.find("compiler")
    if compiler is None:
        compiler = ElementTree.SubElement(extension, "compiler")
    # With masses from geoms MuJoCo's own default holds: visuals must not be weighed too.
    weighed = compiler.get("inertiafromgeom") == "true"
    looks = compiler.get("discardvisual", "true" if weighed else "false")
    compiler.set("discardvisual", looks)
    files = _name_meshes(root)

    def spec():
        return mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))

    try:
        return spec(), files
    except ValueError:
        if not _mend_visuals(root, notes):
            mujoco.MjSpec.from_string(text)  # fails too, and names the line of the file
            raise
        return spec(), files


def _name_meshes(root) -> dict[str, str]:
    """Give each mesh file of a URDF its own name, in place; returns name -> file.

    MuJoCo's importer calls meshes by the end of their path, and takes `visual/shin.stl` for
    `collision/shin.stl` too.
    """
    names: dict[str, str] = {}
    for mesh in root.iter("mesh"):
        file = mesh.get("filename")
        if file is not None:
            mesh.set("filename", names.setdefault(file, f"mesh_{len(names)}{Path(file).suffix}"))
    return {name: file for file, name in names.items()}


def find_meshes(spec, path: Path, files: dict[str, str], notes: list[str]) -> Iterator[Lost]:
    """Resolve the mesh files of an imported URDF; drop what is missing or of another kind.

    `files` are the names of `_name_meshes`. A file is looked for in the folder that
    <compiler meshdir> names, then beside and above the file, by ever shorter ends of its path;
    "package://" and "file://" names work so too.
    """
    path = path.absolute()
    lost = {}
    for mesh in spec.meshes:
        file = html.unescape(files.get(mesh.file, mesh.file))
        parts = Path(file.split("://")[-1].replace("\\", "/")).parts
        ends = [parts[i:] for i in range(len(parts))]
        # With strippath the end of the path counts, without it the whole path.
        inner = list(reversed(ends) if spec.strippath else ends) if spec.meshdir else []
        places = itertools.chain(
            (path.parent.joinpath(spec.meshdir, *end) for end in inner),
            (folder.joinpath(*end) for folder in path.parents for end in ends),
        )
        found = next((place for place in places if _is_file(place)), None)
        if found is None or found.suffix.lower() not in READABLE:
            kind = "not found" if found is None else f"MuJoCo cannot read {found.suffix} files"
            lost[mesh.name] = file, kind
        else:
            mesh.file = str(found)
    spec.meshdir, spec.strippath = "", False  # the names are whole paths now
    dropped = list(_drop_meshes(spec, lost))
    if lost:
        count = f"{len(lost)} meshes are" if len(lost) > 1 else "1 mesh is"
        notes.append(
            f"{count} not found beside the file, or of a kind that MuJoCo cannot read (it reads "
            f".stl, .obj and .msh): {_shown(dropped, 'link')}; the robot is loaded without "
            f"{'them' if len(lost) > 1 else 'it'}"
        )
    yield from dropped


def _is_file(place: Path) -> bool:
    try:
        return place.is_file()
    except (OSError, ValueError):  # a name that no file can have
        return False


def _shown(lost, kind: str) -> str:
    """Files with the bodies that have them."""
    bodies: dict[str, list[str]] = {}
    for loss in lost:
        bodies.setdefault(Path(loss.file).name, []).append(loss.body)
    return listed(
        f"{file or '(no name)'} ({_several(kind, names)})" for file, names in bodies.items()
    )


def _several(kind: str, names) -> str:
    """ "link a", "links a, b"."""
    return each(kind, dict.fromkeys(names)).removeprefix("each of ")


def _drop_meshes(spec, names: dict[str, tuple[str, str]]) -> Iterator[Lost]:
    """Delete meshes and the geoms that show them; `names` are mesh -> (file, reason)."""
    uses = [geom for geom in spec.geoms if geom.meshname or geom.type == _GEOM.mjGEOM_MESH]
    for geom in [geom for geom in uses if geom.meshname in names]:
        file, reason = names[geom.meshname]
        body = geom.parent
        yield Lost(body.name, carrier(spec, body).name, file, reason)
        drop_geom(spec, geom)
    for mesh in [mesh for mesh in spec.meshes if mesh.name in names]:
        spec.delete(mesh)


def drop_unreadable(spec, kind: str, notes: list[str]) -> list[Lost]:
    """Drop from a spec that does not compile every mesh, image and visual that prevents it.

    To find them, each is compiled alone. `kind` is what the file calls a body ("link" or "body").
    Geoms that collide stay, and get names so that the compiler's message can be understood.
    """
    lost = []
    for skin in list(spec.skins):
        spec.delete(skin)
    broken = {}
    for mesh in spec.meshes:
        if reason := _error(_alone(spec, mesh)):
            broken[mesh.name] = mesh.file or f"mesh {mesh.name}", reason
    if broken:
        lost += _drop_meshes(spec, broken)
    lost += _drop_images(spec)
    if lost or broken:
        first = lost[0].reason if lost else next(iter(broken.values()))[1]
        shown = _shown(lost, kind) or listed(Path(file).name for file, _ in broken.values())
        fix = "; save STL files as binary STL" if "ASCII" in first else ""
        bare = sorted({x.body for x in lost if x.body != "world"} & _without_inertial(spec))
        notes.append(
            f"mesh or texture files cannot be read ({first}{fix}): {shown}; the robot is loaded "
            "without them"
            + (
                f"; bodies {listed(bare)} have no <inertial>, so their mass comes from their "
                "other geoms alone: add <inertial>, or put the files in place"
                if bare and kind == "body"
                else ""
            )
        )
    paired = {name for pair in spec.pairs for name in (pair.geomname1, pair.geomname2)}
    gone: dict[str, list[str]] = {}
    for geom in list(spec.geoms):
        if geom.meshname or geom.type in MESHES or not _error(_shape_alone(geom)):
            continue
        if geom.contype or geom.conaffinity or geom.name in paired - {""}:
            name = geom.name or f"(collision of {kind} {geom.parent.name})"
            geom.name = geom.name or unused(name, {other.name for other in spec.geoms})
            continue
        size = " ".join(f"{float(x):g}" for x in np.trim_zeros(geom.size, "b")) or "0"
        shape = _GEOM(geom.type).name.removeprefix("mjGEOM_").lower()
        gone.setdefault(f"a {shape} of size {size}", []).append(geom.parent.name)
        drop_geom(spec, geom)
    for shape, bodies in gone.items():
        notes.append(
            f"a visual of {_several(kind, bodies)} is {shape}, which cannot be drawn: it is "
            "dropped; to say it yourself give it sizes above 0, or remove it"
        )
    return lost


def _without_inertial(spec) -> set[str]:
    return {body.name for body in spec.bodies if not body.explicitinertial}


def _drop_images(spec) -> Iterator[Lost]:
    """Delete height fields and textures whose files cannot be read."""
    for field in list(spec.hfields):
        probe = _probe(spec)
        copy = probe.add_hfield(name="probe")
        for name in ("file", "content_type", "size", "nrow", "ncol", "userdata"):
            setattr(copy, name, getattr(field, name))
        probe.worldbody.add_geom(type=_GEOM.mjGEOM_HFIELD, hfieldname="probe")
        if reason := _error(probe):
            for geom in [geom for geom in spec.geoms if geom.hfieldname == field.name]:
                yield Lost(geom.parent.name, carrier(spec, geom.parent).name, field.file, reason)
                drop_geom(spec, geom)
            spec.delete(field)
    for texture in [t for t in spec.textures if t.file or any(t.cubefiles)]:
        probe = _probe(spec)
        copy = probe.add_texture(name="probe")
        for name in ("type", "file", "cubefiles", "content_type", "gridsize", "gridlayout"):
            setattr(copy, name, getattr(texture, name))
        for name in ("width", "height", "nchannel", "hflip", "vflip", "colorspace"):
            setattr(copy, name, getattr(texture, name))
        if reason := _error(probe):
            file = texture.file or next(file for file in texture.cubefiles if file)
            for material in spec.materials:
                if texture.name in material.textures:
                    material.textures = [""] * len(material.textures)
            spec.delete(texture)
            yield Lost("world", "world", file, reason)


def _probe(spec):
    """An empty spec that looks for files where `spec` does."""
    probe = mujoco.MjSpec()
    for name in ("modelfiledir", "meshdir", "texturedir", "strippath"):
        setattr(probe, name, getattr(spec, name))
    return probe


def _alone(spec, mesh):
    """A spec with one mesh and a geom that shows it."""
    probe = _probe(spec)
    copy = probe.add_mesh(name="probe")
    for name in _MESH_FIELDS:
        setattr(copy, name, getattr(mesh, name))
    probe.worldbody.add_geom(type=_GEOM.mjGEOM_MESH, meshname="probe")
    return probe


def _shape_alone(geom):
    """A spec with one geom of the type and size of another."""
    probe = mujoco.MjSpec()
    probe.worldbody.add_geom(type=geom.type, size=geom.size, fromto=geom.fromto)
    return probe


def _error(probe) -> str | None:
    """Why a spec does not compile, in one line; None if it does."""
    try:
        probe.compile()
    except ValueError as error:
        return str(error).strip().splitlines()[0].removeprefix("Error: ").replace(": probe", "")
    return None


def check_lost(path: Path, model, lost: list[Lost], kind: str):
    """Raises ValueError if a leg ends in nothing because its meshes were dropped."""
    if (
        not lost
        or np.count_nonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE) != 1
        or model.njnt < 2
    ):
        return
    names = [model.body(body).name for body in legs_without_geom(model)]
    to_blame = [loss for loss in lost if loss.carrier in names]
    if not to_blame and not has_feet(model):
        to_blame = lost
    if to_blame:
        files = listed(dict.fromkeys(Path(x.file).name or "(no name)" for x in to_blame))
        bodies = listed(dict.fromkeys(x.body for x in to_blame))
        reasons = listed(dict.fromkeys(x.reason for x in to_blame))
        where = "a <collision>" if kind == "link" else "a geom"
        raise ValueError(
            f"{path} has no foot where legs end in {bodies}, because meshes are dropped: {files} "
            f"({reasons}). Put files that can be read (binary .stl, or .obj) where the names say, "
            f"or give {bodies} {where} with a sphere or a box where it touches the floor"
        )


def _mend_visuals(root, notes: list[str]) -> bool:
    """Take out of a URDF what MuJoCo cannot parse and only looks depend on.

    Of several materials of a visual the first counts. Materials and visuals that cannot be parsed
    are removed. Returns whether anything was changed.
    """
    several, colours, dropped = [], [], {}
    for material in root.findall("material"):
        if _parse_error(material):
            root.remove(material)
            colours.append(repr(material.get("name")))
    for link in root.findall("link"):
        name = link.get("name") or "(unnamed)"
        for visual in link.findall("visual"):
            materials = visual.findall("material")
            for material in materials[1:]:
                visual.remove(material)
            if len(materials) > 1:
                several.append(name)
            if materials and _parse_error(visual, link=True):
                visual.remove(materials[0])
                colours.append(f"of link {name}")
            if reason := _parse_error(visual, link=True):
                link.remove(visual)
                dropped.setdefault(reason, []).append(name)
    if several:
        notes.append(
            f"{_several('link', several)} has more than one <material> in one <visual>, which may "
            "have one: the first counts; to say it yourself remove the others"
        )
    if dropped:
        # A visual with a wrong material is dropped for another reason if it is dropped.
        colours = [colour for colour in colours if colour not in _links(dropped)]
    if colours:
        notes.append(
            f"materials {listed(colours)} cannot be read and are left out: they only colour the "
            "links; to say it yourself give <color rgba> four numbers"
        )
    for reason, names in dropped.items():
        notes.append(
            f"a visual of {_several('link', names)} cannot be read ({reason}): it is dropped; to "
            "say it yourself correct or remove the <visual>"
        )
    return bool(several or colours or dropped)


def _links(dropped) -> set[str]:
    return {f"of link {name}" for names in dropped.values() for name in names}


def _parse_error(element, link: bool = False) -> str | None:
    """Why MuJoCo cannot parse a part of a URDF that stands in the robot or in a link."""
    robot = ElementTree.Element("robot", name="probe")
    place = ElementTree.SubElement(robot, "link", name="probe")
    (place if link else robot).append(element)
    settings = ElementTree.SubElement(ElementTree.SubElement(robot, "mujoco"), "compiler")
    settings.set("discardvisual", "false")
    try:
        mujoco.MjSpec.from_string(ElementTree.tostring(robot, encoding="unicode"))
    except ValueError as error:
        return str(error).strip().splitlines()[0].removeprefix("XML Error: ")
    return None
