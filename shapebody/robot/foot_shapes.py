"""Spheres and boxes for feet of other shapes: about the whole, or the lower end of a shank."""

from itertools import pairwise

import mujoco
import numpy as np

from shapebody.robot.geometry import lowest, reach_of, standing_height
from shapebody.robot.spec_edits import add_like, drop_geom, replace_geom

_GEOM = mujoco.mjtGeom


FOOT_SHAPES = int(_GEOM.mjGEOM_SPHERE), int(_GEOM.mjGEOM_BOX)
TALL = 0.25  # of the standing height: what is taller is a leg; feet of the 50 robots are up to 0.24


def is_tall(model, data, group) -> bool:
    """Whether some geoms are too tall for a foot: as the shank of a leg is."""
    if len(group) == 1 and model.geom_type[group[0]] == _GEOM.mjGEOM_SPHERE:
        return False
    low, high = _span(model, data, group)
    return bool(high - low > TALL * standing_height(model, data))


def _span(model, data, group) -> tuple[float, float]:
    """Height of the lowest and of the highest point of some geoms, m."""
    up = np.array([0, 0, 1.0])
    high = max(data.geom_xpos[i, 2] + reach_of(model, data, i, up) for i in group)
    return float(min(lowest(model, data, i) for i in group)), float(high)


def foot_shape(model, data, group):
    """Type, size, position and quaternion (in the body frame) of the foot for some geoms.

    A capsule or long cylinder that stands becomes the sphere at its lower end. Of what is too tall
    for a foot (`is_tall`) the lower end is bounded, of all else the whole: by the smallest box
    along the axes of the first geom, of the body or of the world, or the sphere of the same width
    if that box is nearly a cube.
    """
    first = group[0]
    kind = model.geom_type[first]
    frame = data.geom_xmat[first].reshape(3, 3)
    radius, half, _ = model.geom_size[first]
    capsule = kind == _GEOM.mjGEOM_CAPSULE
    long = capsule or (kind == _GEOM.mjGEOM_CYLINDER and half > 2 * radius)
    if len(group) == 1 and long and abs(frame[2, 2]) > 0.5:
        body = model.geom_bodyid[first]
        below = half if capsule else half - radius
        end = data.geom_xpos[first] - np.sign(frame[2, 2]) * below * frame[:, 2]
        position = data.xmat[body].reshape(3, 3).T @ (end - data.xpos[body])
        return _GEOM.mjGEOM_SPHERE, [radius, 0, 0], position, np.eye(4)[0]
    if is_tall(model, data, group):
        return bounding(model, data, group, _lower_end(model, data, group))
    return bounding(model, data, group)


def bounding(model, data, group, points=None):
    """Type, size, position and quaternion of the box or sphere about geoms; see `foot_shape`.

    About `points` [n, 3] of the world, if they are given.
    """
    body = model.geom_bodyid[group[0]]
    turn, origin = data.xmat[body].reshape(3, 3), data.xpos[body]
    frame = data.geom_xmat[group[0]].reshape(3, 3)

    def box(axes):
        """Half size and centre along the columns of `axes`."""
        if points is not None:
            along = points @ axes
            low, high = along.min(axis=0), along.max(axis=0)
        else:
            ends = []
            for sign in (1, -1):
                reach = [[reach_of(model, data, i, sign * axis) for axis in axes.T] for i in group]
                ends.append(np.max(sign * (data.geom_xpos[group] @ axes) + reach, axis=0))
            high, low = ends[0], -ends[1]
        return (high - low) / 2, axes @ ((high + low) / 2)

    axes = min((frame, turn, np.eye(3)), key=lambda axes: np.prod(box(axes)[0]))
    half, centre = box(axes)
    position = turn.T @ (centre - origin)
    if half.max() < 1.3 * half.min():
        return _GEOM.mjGEOM_SPHERE, [float(half.mean()), 0, 0], position, np.eye(4)[0]
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, (turn.T @ axes).ravel())
    return _GEOM.mjGEOM_BOX, half, position, quaternion


def _lower_end(model, data, group) -> np.ndarray:
    """Points [n, 3] of the world about the lowest part of geoms: at most a tenth of their height,
    and not higher than it is wide."""
    surfaces = [_surface(model, data, geom) for geom in group]
    bottom, top = _span(model, data, group)

    def below(level):
        found = []
        for points, edges in surfaces:
            found.append(points[points[:, 2] <= level])
            ends = points[edges]
            cut = ends[(ends[:, 0, 2] <= level) != (ends[:, 1, 2] <= level)]
            share = (level - cut[:, :1, 2]) / (cut[:, 1:, 2] - cut[:, :1, 2])
            found.append(cut[:, 0] + share * (cut[:, 1] - cut[:, 0]))
        return np.concatenate(found)

    tenth = 0.1 * (top - bottom)
    width = np.ptp(below(bottom + tenth)[:, :2], axis=0).min()
    return below(bottom + min(tenth, max(width, 0.1 * tenth)))


def _surface(model, data, geom: int) -> tuple[np.ndarray, np.ndarray]:
    """Points [n, 3] of the world and edges int[m, 2] of the surface of a geom."""
    size, kind = model.geom_size[geom], model.geom_type[geom]
    if kind == _GEOM.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        points = model.mesh_vert[start : start + count]
        start, count = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
        faces = model.mesh_face[start : start + count]
        edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    else:
        # Rings about the z axis, each of a width and at a height.
        slope = np.linspace(-np.pi / 2, np.pi / 2, 18)
        corners = np.linspace(0, 2 * np.pi, 32, endpoint=False)
        middle = np.zeros(3)
        if kind in (_GEOM.mjGEOM_SPHERE, _GEOM.mjGEOM_CAPSULE, _GEOM.mjGEOM_ELLIPSOID):
            x, y, z = size if kind == _GEOM.mjGEOM_ELLIPSOID else np.full(3, size[0])
            wide, high = np.cos(slope), z * np.sin(slope)
            if kind == _GEOM.mjGEOM_CAPSULE:
                high += np.sign(slope) * size[1]
        else:
            cylinder = kind == _GEOM.mjGEOM_CYLINDER
            if cylinder:
                x, y, z = size[0], size[0], size[1]
            else:  # a box, or the box about anything else
                middle, (x, y, z) = np.split(model.geom_aabb[geom], 2)
                corners = np.pi / 4 + np.pi / 2 * np.arange(4)
            wide, high = np.full(2, 1 if cylinder else np.sqrt(2)), np.array([-z, z])
        ring = np.stack([x * np.cos(corners), y * np.sin(corners)], axis=1)
        rings = [
            np.column_stack([w * ring, np.full(len(ring), h)])
            for w, h in zip(wide, high, strict=True)
        ]
        points = middle + np.concatenate(rings)
        index = np.arange(len(points)).reshape(len(rings), len(ring))
        edges = [np.stack([row, np.roll(row, 1)], axis=1) for row in index]
        edges += [np.stack(pair, axis=1) for pair in pairwise(index)]
        edges = np.concatenate(edges)
    return data.geom_xpos[geom] + points @ data.geom_xmat[geom].reshape(3, 3).T, edges


def add_foot(spec, geoms, model, data, group):
    """The geom of `spec` that is the foot for a group of geoms, with the name of the first.

    The geoms become their foot (`foot_shape`). Those of a leg (`is_tall`) stay beside it for their
    looks, meshes as the boxes about them. `geoms` are those of the spec by their ids in the model.
    """
    first, shape = geoms[group[0]], foot_shape(model, data, group)
    if not is_tall(model, data, group):
        for other in group[1:]:
            drop_geom(spec, geoms[other])
        return replace_geom(spec, first, *shape)
    foot, name = add_like(first, *shape), first.name
    for index in group:
        if geoms[index].meshname:
            geoms[index] = replace_geom(spec, geoms[index], *bounding(model, data, [index]))
    geoms[group[0]].name = ""
    foot.name = name
    return foot


def shape_name(model, group) -> str:
    """What a group of geoms is, for a message."""
    kinds = {_GEOM(model.geom_type[i]).name.removeprefix("mjGEOM_").lower() for i in group}
    if len(group) > 1:
        return f"{len(group)} geoms"
    kind = kinds.pop()
    return f"an {kind}" if kind == "ellipsoid" else f"a {kind}"
