"""Designs as scenes to turn and zoom in the browser, with MeshCat's viewer.

A `Scene` is one HTML page of about 0.9 MB with everything inside (in a notebook it takes a third of
that). It needs no server, so it also works in a notebook that is opened later or somewhere else.
"""

import base64
import gzip
import html
import importlib.util
import json
from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import numpy as np

from shapebody.arguments import (
    require_array,
    require_flag,
    require_integer,
    require_kind,
    require_list,
    require_number,
    single,
)
from shapebody.design.space import DesignSpace
from shapebody.files import atomic_write
from shapebody.robot.geometry import SHOWN_GROUPS, standing_pose
from shapebody.show import render, software_renderer

_ROOT = "/robot"
_LOOP_BACK_AND_FORTH = 2202  # THREE.LoopPingPong


@dataclass(frozen=True)
class Scene:
    """A page with one robot. As the last value of a notebook cell it is shown there."""

    commands: list = field(repr=False)
    """Commands of MeshCat's viewer, as JSON-able dicts."""
    height: int = 420
    """Height in the notebook, in pixels."""

    def __post_init__(self):
        for command in require_list("commands", self.commands):
            require_kind("a command", command, dict, "of MeshCat's viewer")
        require_integer("height", self.height, 16, 8192)

    def static_html(self) -> str:
        """The whole page as text."""
        # Importing meshcat would load its server, which is not needed here.
        viewer = (
            Path(importlib.util.find_spec("meshcat").origin).parent
            / "viewer"
            / "dist"
            / "main.min.js"
        )
        commands = json.dumps(self.commands, separators=(",", ":"))
        return _PAGE.replace("@viewer@", viewer.read_text(encoding="utf-8")).replace(
            "@commands@", commands
        )

    def save(self, path: str | Path) -> Path:
        """Write the page to a file that any browser opens."""
        return atomic_write(path, self.static_html())

    def _repr_html_(self) -> str:
        packed = gzip.compress(self.static_html().encode(), mtime=0)
        page = _PACKED.replace("@page@", base64.b64encode(packed).decode())
        page = html.escape(page, quote=True)
        return (
            f'<iframe srcdoc="{page}" style="width: 100%; height: {self.height}px; border: 0">'
            "</iframe>"
        )


_PAGE = """<!DOCTYPE html>
<html>
<head><meta charset="utf-8"><title>shapebody</title>
<style>
body { margin: 0; }
#meshcat-pane { width: 100vw; height: 100vh; overflow: hidden; }
</style></head>
<body><div id="meshcat-pane"></div>
<script>@viewer@</script>
<script>
var viewer = new MeshCat.Viewer(document.getElementById("meshcat-pane"));
for (const command of @commands@) {
  if (command.type === "look") {
    viewer.camera.fov = 45;
    viewer.camera.position.set(...command.from);
    viewer.controls.target.set(...command.at);
    viewer.controls.update();
  } else {
    viewer.handle_command(command);
  }
}
viewer.gui.close();
</script>
</body></html>
"""
# A page that unpacks another one in its place. Browsers can do that since 2023.
_PACKED = """<!DOCTYPE html>
<p>This scene needs scripts and a browser of 2023 or later.</p>
<script>
(async () => {
  const packed = Uint8Array.from(atob("@page@"), (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  const page = await new Response(stream).text();
  document.open();
  document.write(page);
  document.close();
})();
</script>
"""


def show_design(robot_or_space, f=None, qpos=None, spheres: bool = False, height: int = 420):
    """Scene of a robot, or of the design `f`[d] of a DesignSpace (the reference if None).

    qpos: [nq], the standing pose if None. spheres: also show the collision spheres.
    """
    model = _model(robot_or_space, f)
    require_integer("height", height, 16, 8192)
    parts = _parts(model, require_flag("spheres", spheres))
    pose = standing_pose(model) if qpos is None else render.require_qpos(model, qpos, 1)
    commands = [_add(part) for part in parts]
    commands += [_place(part.path, place) for part, place in _transforms(parts, model, pose)]
    return Scene([*_surroundings(model, pose), *commands], height)


def animate_designs(space, trajectory, seconds: float = 4.0, frames: int = 60, height: int = 420):
    """Scene that morphs along the designs `trajectory`[n, d] of a search, forth and back.

    At most `frames` of the n designs are used, evenly spread, the first and the last included.
    """
    _require_space(space)
    require_number("seconds", seconds, 0.01, 3600)
    require_integer("frames", frames, 2, 10_000)
    require_integer("height", height, 16, 8192)
    trajectory = single(require_array("trajectory", trajectory))
    if trajectory.ndim != 2 or trajectory.shape[1] != space.dim or len(trajectory) < 2:
        raise ValueError(
            f"trajectory has shape {list(trajectory.shape)}, expected [n >= 2, {space.dim}]; "
            "give the designs of one start"
        )
    space.validate(trajectory)
    rows = np.unique(np.linspace(0, len(trajectory) - 1, frames).round().astype(int))
    models = [space.to_model(f) for f in trajectory[rows]]
    poses = [standing_pose(model) for model in models]
    parts = _parts(models[0], spheres=False)
    every = [
        [transform for _, transform in _transforms(parts, model, pose)]
        for model, pose in zip(models, poses, strict=True)
    ]
    commands = [_add(part) for part in parts]
    commands += [_place(part.path, place) for part, place in zip(parts, every[0], strict=True)]
    clips = [
        {
            "path": part.path,
            "clip": {
                "fps": len(rows) / seconds,
                "name": "default",
                "tracks": _tracks([transforms[i] for transforms in every]),
            },
        }
        for i, part in enumerate(parts)
    ]
    commands.append(
        {
            "type": "set_animation",
            "path": "",
            "animations": clips,
            "options": {"play": True, "loopMode": _LOOP_BACK_AND_FORTH, "repetitions": 100_000},
        }
    )
    return Scene([*_surroundings(models[0], poses[0]), *commands], height)


_ROD = "_between"


@dataclass(frozen=True)
class _Part:
    """One unit shape: all of a geom, the shaft or an end of a capsule, or a rod between joints."""

    geom: int
    """Id of the geom, or number of the rod."""
    role: str
    shape: str
    colour: int
    opacity: float

    @property
    def path(self) -> str:
        return f"{_ROOT}/{'rod' if self.role == _ROD else 'geom'}_{self.geom}{self.role}"


_UNIT_SHAPES = {
    "BoxGeometry": {"width": 2, "height": 2, "depth": 2},
    "SphereGeometry": {"radius": 1, "widthSegments": 24, "heightSegments": 16},
    "CylinderGeometry": {"radiusTop": 1, "radiusBottom": 1, "height": 2, "radialSegments": 24},
}

# MuJoCo's cylinders stand along z, those of three.js along y.
_Y_TO_Z = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


def _require_space(space) -> None:
    require_kind("space", space, DesignSpace, "shapebody.DesignSpace(robot)")


def _model(robot_or_space, f):
    if isinstance(robot_or_space, DesignSpace):
        return robot_or_space.to_model(robot_or_space.reference if f is None else f)
    if f is not None:
        raise ValueError("a design f needs a DesignSpace: show_design(DesignSpace(robot), f)")
    return render.model_of(robot_or_space, "robot_or_space")


def _parts(model, spheres):
    groups = (*SHOWN_GROUPS, 5) if spheres else SHOWN_GROUPS
    kinds = mujoco.mjtGeom
    shapes = {
        int(kinds.mjGEOM_BOX): [("", "BoxGeometry")],
        int(kinds.mjGEOM_SPHERE): [("", "SphereGeometry")],
        int(kinds.mjGEOM_ELLIPSOID): [("", "SphereGeometry")],
        int(kinds.mjGEOM_CYLINDER): [("", "CylinderGeometry")],
        int(kinds.mjGEOM_CAPSULE): [
            ("_shaft", "CylinderGeometry"),
            ("_top", "SphereGeometry"),
            ("_bottom", "SphereGeometry"),
        ],
    }
    parts = []
    for geom in np.flatnonzero(np.isin(model.geom_group, groups)):
        rgba = software_renderer.colour(model, geom)
        for role, shape in shapes.get(int(model.geom_type[geom]), []):
            parts.append(_Part(int(geom), role, shape, _number(rgba), float(rgba[3])))
    rods = len(software_renderer.bones(model, mujoco.MjData(model))[0])
    colour = _number(software_renderer.BONE_COLOUR)
    return parts + [_Part(rod, _ROD, "CylinderGeometry", colour, 1.0) for rod in range(rods)]


def _number(rgba):
    red, green, blue = (int(round(255 * c)) for c in rgba[:3])
    return (red << 16) + (green << 8) + blue


def _transforms(parts, model, qpos):
    """(part, (position[3], rotation[3, 3], scale[3])) of all parts at `qpos`."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    starts, ends = software_renderer.bones(model, data)
    placed = []
    for part in parts:
        if part.role == _ROD:
            start, end = starts[part.geom], ends[part.geom]
            radius, half = software_renderer.bone_radius(model), np.linalg.norm(end - start) / 2
            rotation = software_renderer.rotation_to(end - start) @ _Y_TO_Z
            scale = np.maximum([radius, half, radius], 1e-6)
            placed.append((part, ((start + end) / 2, rotation, scale)))
            continue
        kind, size = model.geom_type[part.geom], model.geom_size[part.geom]
        position = data.geom_xpos[part.geom].copy()
        rotation = data.geom_xmat[part.geom].reshape(3, 3).copy()
        scale = size.copy()
        if part.role in ("_top", "_bottom"):
            position += rotation[:, 2] * (size[1] if part.role == "_top" else -size[1])
        if kind == mujoco.mjtGeom.mjGEOM_SPHERE or part.role in ("_top", "_bottom"):
            scale = np.repeat(size[0], 3)
        elif part.shape == "CylinderGeometry":
            rotation, scale = rotation @ _Y_TO_Z, np.array([size[0], size[1], size[0]])
        placed.append((part, (position, rotation, np.maximum(scale, 1e-6))))
    return placed


def _matrix(position, rotation, scale):
    matrix = np.eye(4)
    matrix[:3, :3] = rotation * scale
    matrix[:3, 3] = position
    return matrix


def _rounded(values):
    return [round(float(v), 5) for v in values]


def _add(part):
    return _mesh(part.path, part.shape, "MeshLambertMaterial", part.colour, part.opacity)


def _mesh(path, shape, material, colour, opacity=1.0):
    """The command that puts a unit shape at a path of the scene."""
    surface = {
        "uuid": f"material{path}",
        "type": material,
        "color": colour,
        "opacity": opacity,
        "transparent": opacity < 1,
    }
    geometry = {"uuid": f"shape{path}", "type": shape, **_UNIT_SHAPES[shape]}
    mesh = {
        "uuid": f"mesh{path}",
        "type": "Mesh",
        "geometry": geometry["uuid"],
        "material": surface["uuid"],
    }
    return {
        "type": "set_object",
        "path": path,
        "object": {
            "metadata": {"version": 4.5, "type": "Object"},
            "geometries": [geometry],
            "materials": [surface],
            "object": mesh,
        },
    }


def _place(path, transform):
    columns = _matrix(*transform).T.flatten()
    return {"type": "set_transform", "path": path, "matrix": _rounded(columns)}


def _tracks(transforms):
    """Keyframe tracks of one part; what does not change has none."""
    values = {
        ("position", "vector3"): [position for position, _, _ in transforms],
        ("quaternion", "quaternion"): _quaternions([rotation for _, rotation, _ in transforms]),
        ("scale", "vector3"): [scale for _, _, scale in transforms],
    }
    tracks = []
    for (name, kind), rows in values.items():
        if np.ptp(rows, axis=0).max() > 1e-5 or name == "position":
            keys = [{"time": i, "value": _rounded(row)} for i, row in enumerate(rows)]
            tracks.append({"name": f".{name}", "type": kind, "keys": keys})
    return tracks


def _quaternions(rotations):
    """(x, y, z, w) of each rotation, signs chosen so that neighbours are close."""
    quaternions = []
    for rotation in rotations:
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, rotation.flatten())
        quaternion = np.roll(quaternion, -1)
        if quaternions and quaternion @ quaternions[-1] < 0:
            quaternion = -quaternion
        quaternions.append(quaternion)
    return quaternions


def _surroundings(model, qpos):
    """Camera, background and floor. The camera's frame is the viewer's, whose y axis points up."""
    with render.Renderer(model, opengl=False) as view:
        view.place(qpos)
        centre = view.centre()
        eye = centre - 1.2 * view.distance(centre) * software_renderer.view_axes(130, -18)[2]
    return [
        {
            "type": "look",
            "from": _rounded([eye[0], eye[2], -eye[1]]),
            "at": _rounded([centre[0], centre[2], -centre[1]]),
        },
        *[
            {"type": "set_property", "path": path, "property": name, "value": value}
            for path, name, value in (
                ("/Axes", "visible", False),
                ("/Background", "top_color", [0.80, 0.86, 0.93]),
                ("/Background", "bottom_color", [0.97, 0.98, 0.99]),
            )
        ],
        *_floor(),
    ]


def _floor():
    """A plate below the viewer's grid of half-metre squares, which alone is hardly seen.

    Its colour does not depend on the lights, and its top is 4 mm below the grid, so that the two
    are told apart from afar.
    """
    colour = _number(software_renderer.FLOOR_COLOUR)
    below = np.array([0, 0, -0.009]), np.eye(3), np.array([10, 10, 0.005])
    return [_mesh("/floor", "BoxGeometry", "MeshBasicMaterial", colour), _place("/floor", below)]
