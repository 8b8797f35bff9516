"""Pictures of primitive geoms without OpenGL: shaded polygons, painted from far to near.

Slower and plainer than MuJoCo's renderer, but it needs nothing except NumPy and Pillow. `render`
falls back on it.
"""

import functools

import mujoco
import numpy as np
from PIL import Image, ImageDraw

FLOOR_COLOUR = (0.84, 0.86, 0.88)
BONE_COLOUR = (0.42, 0.45, 0.50, 1.0)
_BACKGROUND = (0.93, 0.95, 0.97)
_LINES = (0.72, 0.75, 0.78)
_LIGHT = np.array([0.35, -0.5, 0.8]) / np.linalg.norm([0.35, -0.5, 0.8])
_OVERSAMPLING = 2
_NEAR = 0.02

_GEOM = mujoco.mjtGeom


def _rings(radii, heights, segments=12):
    """Quads of a surface of revolution around z: float[(rings - 1) * segments, 4, 3]."""
    angle = np.linspace(0, 2 * np.pi, segments + 1)
    ring = np.stack([np.cos(angle), np.sin(angle)], -1)
    points = np.concatenate(
        [
            np.asarray(radii)[:, None, None] * ring,
            np.broadcast_to(np.asarray(heights)[:, None, None], (len(radii), segments + 1, 1)),
        ],
        -1,
    )
    quads = np.stack([points[:-1, :-1], points[:-1, 1:], points[1:, 1:], points[1:, :-1]], 2)
    return quads.reshape(-1, 4, 3)


@functools.cache
def _unit_surface(kind: mujoco.mjtGeom) -> np.ndarray:
    """float[n, 4, 3], outward quads of the primitive with size (1, 1, 1)."""
    if kind == _GEOM.mjGEOM_BOX:
        top = np.array([[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]], float)
        side = np.array([[1, -1, -1], [1, 1, -1], [1, 1, 1], [1, -1, 1]], float)
        turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]], float)
        sides = [side @ np.linalg.matrix_power(turn, k).T for k in range(4)]
        return np.stack([top, (top * [1, -1, -1]), *sides])
    if kind in (_GEOM.mjGEOM_SPHERE, _GEOM.mjGEOM_ELLIPSOID):
        angle = np.linspace(-np.pi / 2, np.pi / 2, 9)
        return _rings(np.cos(angle), np.sin(angle))
    if kind == _GEOM.mjGEOM_CYLINDER:
        return _rings([0, 1, 1, 0], [-1, -1, 1, 1])
    raise KeyError(kind)


def surface(kind: int, size: np.ndarray) -> np.ndarray | None:
    """Quads float[n, 4, 3] of a MuJoCo geom in its own frame; None for planes and meshes."""
    kind = _GEOM(int(kind))
    if kind == _GEOM.mjGEOM_CAPSULE:
        radius, half = size[:2]
        angle = np.linspace(-np.pi / 2, np.pi / 2, 8)
        heights = radius * np.sin(angle) + np.where(angle < 0, -half, half)
        return _rings(radius * np.cos(angle), heights)
    try:
        unit = _unit_surface(kind)
    except KeyError:
        return None
    if kind == _GEOM.mjGEOM_SPHERE:
        return unit * size[0]
    if kind == _GEOM.mjGEOM_CYLINDER:
        return unit * [size[0], size[0], size[1]]
    return unit * size


def colour(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """float[4], rgba as MuJoCo would show it: a material counts unless the geom has its own."""
    rgba = model.geom_rgba[geom]
    material = model.geom_matid[geom]
    if material >= 0 and np.allclose(rgba, [0.5, 0.5, 0.5, 1]):
        return model.mat_rgba[material].copy()
    return rgba.copy()


def bones(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
    """Where to draw rods so that a changed design hangs together: starts and ends, float64[n, 3].

    A design moves joints and feet, but the shapes of the links between them keep their size.
    """
    moving = [body for body in range(2, model.nbody) if model.body_parentid[body] > 0]
    feet = [
        geom
        for geom in range(model.ngeom)
        if model.geom_bodyid[geom] > 0 and "foot" in model.geom(geom).name
    ]
    starts = [data.xpos[model.body_parentid[body]] for body in moving]
    ends = [data.xpos[body] for body in moving]
    starts += [data.xpos[model.geom_bodyid[geom]] for geom in feet]
    ends += [data.geom_xpos[geom] for geom in feet]
    starts, ends = np.reshape(starts, (-1, 3)), np.reshape(ends, (-1, 3))
    return starts, ends


def bone_radius(model: mujoco.MjModel) -> float:
    """Radius of the rods in m."""
    return 0.011 * float(model.stat.extent)


def rotation_to(direction: np.ndarray) -> np.ndarray:
    """float64[3, 3], a rotation whose third column is along `direction`[3]."""
    quaternion, matrix = np.zeros(4), np.zeros(9)
    mujoco.mju_quatZ2Vec(quaternion, np.asarray(direction, float))
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)


def view_axes(azimuth: float, elevation: float) -> np.ndarray:
    """float64[3, 3], rows right, up and forward of MuJoCo's free camera; angles in degrees."""
    az, el = np.radians([azimuth, elevation])
    forward = np.array([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)])
    right = np.array([np.sin(az), -np.cos(az), 0.0])
    return np.stack([right, np.cross(right, forward), forward])


def draw(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    geoms: np.ndarray,
    lookat: np.ndarray,
    distance: float,
    azimuth: float,
    elevation: float,
    height: int,
    width: int,
) -> np.ndarray:
    """Picture uint8[height, width, 3] of `geoms` (ids) and a floor grid at z = 0.

    The camera is MuJoCo's free camera: `distance` in m from `lookat`, angles in degrees.
    """
    view = view_axes(azimuth, elevation)
    forward = view[2]
    eye = np.asarray(lookat) - distance * forward
    rows, columns = height * _OVERSAMPLING, width * _OVERSAMPLING
    focal = rows / 2 / np.tan(np.radians(model.vis.global_.fovy) / 2)

    def project(points):
        seen = (points - eye) @ view.T
        depth = np.maximum(seen[..., 2], _NEAR)
        pixels = np.stack(
            [columns / 2 + focal * seen[..., 0] / depth, rows / 2 - focal * seen[..., 1] / depth],
            -1,
        )
        return pixels, seen[..., 2]

    picture = Image.new("RGB", (columns, rows), _rgb(_BACKGROUND))
    canvas = ImageDraw.Draw(picture)
    _draw_floor(canvas, project, np.asarray(lookat), forward, distance)

    quads, normals, colours = _world_quads(model, data, geoms)
    if len(quads):
        brightness = 0.55 + 0.45 * np.clip(normals @ _LIGHT, -0.4, 1)
        shades = np.clip(colours * brightness[:, None] * 255, 0, 255).astype(int)
        pixels, depth = project(quads)
        facing = np.einsum("nk,nk->n", normals, quads.mean(1) - eye) < 0
        visible = np.flatnonzero(facing & (depth.min(1) > _NEAR))
        # From far to near, so that what is near covers what is behind it.
        for i in visible[np.argsort(-depth[visible].mean(1), kind="stable")]:
            canvas.polygon([tuple(p) for p in pixels[i]], fill=tuple(shades[i].tolist()))
    return np.asarray(picture.resize((width, height), Image.Resampling.BOX))


def _world_quads(model, data, geoms):
    """All quads of geoms and bones: corners [n, 4, 3], outward normals [n, 3], colours [n, 3]."""
    shapes = [
        (
            surface(model.geom_type[geom], model.geom_size[geom]),
            data.geom_xmat[geom].reshape(3, 3),
            data.geom_xpos[geom],
            colour(model, geom),
        )
        for geom in geoms
    ]
    for start, end in zip(*bones(model, data), strict=True):
        # Sorting by distance cannot show a rod inside the trunk as hidden.
        if np.array_equal(start, data.xpos[1]):
            continue
        size = np.array([bone_radius(model), np.linalg.norm(end - start) / 2, 0])
        rod = surface(_GEOM.mjGEOM_CAPSULE, size)
        shapes.append((rod, rotation_to(end - start), (start + end) / 2, np.array(BONE_COLOUR)))
    quads, colours = [np.empty((0, 4, 3))], [np.empty((0, 3))]
    for local, rotation, position, rgba in shapes:
        if local is not None:
            quads.append(local @ rotation.T + position)
            colours.append(np.broadcast_to(rgba[:3], (len(local), 3)))
    quads = np.concatenate(quads)
    normals = np.cross(quads[:, 2] - quads[:, 0], quads[:, 3] - quads[:, 1])
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True) + 1e-12
    return quads, normals, np.concatenate(colours)


def _draw_floor(canvas, project, lookat, forward, distance):
    """A grid of half-metre squares around the camera's target."""
    reach = 4 * distance
    centre = np.round(lookat[:2] / 0.5) * 0.5
    steps = np.arange(-np.ceil(reach / 0.5), np.ceil(reach / 0.5) + 1) * 0.5
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * reach + lookat[:2]
    dense = np.linspace(0, 1, 60)[:, None]
    border = np.concatenate(
        [corners[k] * (1 - dense) + corners[(k + 1) % 4] * dense for k in range(4)]
    )
    pixels, depth = project(np.column_stack([border, np.zeros(len(border))]))
    front = depth > _NEAR
    if forward[2] < 0 and front.sum() > 2:
        canvas.polygon([tuple(p) for p in pixels[front]], fill=_rgb(FLOOR_COLOUR))
    for axis in (0, 1):
        for step in steps:
            ends = np.zeros((2, 3))
            ends[:, axis] = centre[axis] + step
            ends[:, 1 - axis] = lookat[1 - axis] + np.array([-reach, reach])
            points = ends[0] + np.linspace(0, 1, 40)[:, None] * (ends[1] - ends[0])
            pixels, depth = project(points)
            line = [tuple(p) for p, d in zip(pixels, depth, strict=True) if d > _NEAR]
            if len(line) > 1:
                canvas.line(line, fill=_rgb(_LINES), width=_OVERSAMPLING)


def _rgb(colour):
    return tuple(int(round(255 * c)) for c in colour)
