"""Where a robot touches the floor: the ends of its legs, and spheres or boxes for its feet."""

import mujoco
import numpy as np

from shapebody.specs import FOOT, MESHES

_GEOM = mujoco.mjtGeom
FOOT_SHAPES = int(_GEOM.mjGEOM_SPHERE), int(_GEOM.mjGEOM_BOX)


def foot_ids(model) -> np.ndarray:
    """int[nf], geoms of the robot with "foot" in their names."""
    names = (
        mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, i) or "" for i in range(model.ngeom)
    )
    found = [i for i, name in enumerate(names) if model.geom_bodyid[i] and FOOT.search(name)]
    return np.array(found, dtype=int)


def foot_name(geoms, group) -> str:
    """The name of the geom, or of the body if there are several, with "foot" in it."""
    geom = geoms[group[0]]
    name = geom.name if geom.name and len(group) == 1 else geom.parent.name
    return name if FOOT.search(name) else f"{name}_foot"


def solid(model, group) -> list[int]:
    """The geoms of a group that are not meshes; all of them if it has only meshes."""
    return [i for i in group if model.geom_type[i] not in MESHES] or group


def leg_ends(model, qpos, reach: float = 0.2) -> dict[int, list[int]]:
    """Moving body -> geom ids of its lowest geoms, for bodies at the end of a leg in pose qpos.

    Those are the outermost bodies that come as close to the lowest of them as `reach` times the
    standing height.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    moving = model.body_weldid
    parents = {int(moving[model.body_parentid[body]]) for body in np.unique(moving) if body}
    height = standing_height(model, data)
    heights, chosen = {}, {}
    for body in (int(body) for body in np.unique(moving) if body and body not in parents):
        group = np.flatnonzero(moving[model.geom_bodyid] == body)
        shapes = solid(model, list(group))
        touching = [i for i in shapes if model.geom_contype[i] or model.geom_conaffinity[i]]
        group = touching or shapes
        if group:
            chosen[body] = lowest_geoms(model, data, group, height)
            heights[body] = lowest(model, data, chosen[body][0])
    if not heights:
        return {}
    floor = min(heights.values())
    return {
        body: group for body, group in chosen.items() if heights[body] <= floor + reach * height
    }


def ends_without_foot(model, qpos) -> dict[int, list[int]]:
    """As `leg_ends`, for those at the height of the floor that have no foot."""
    footed = set(model.body_weldid[model.geom_bodyid[foot_ids(model)]].tolist())
    ends = leg_ends(model, qpos, reach=0.05)
    return {body: group for body, group in ends.items() if body not in footed}


def standing_height(model, data) -> float:
    """Height of the centre of mass above the lowest geom of the robot, m; at least 1 mm.

    Unlike the height of the trunk, it does not depend on where the trunk has its origin.
    """
    mujoco.mj_comPos(model, data)
    geoms = np.flatnonzero(model.geom_bodyid)
    bottom = min((lowest(model, data, i) for i in geoms), default=0.0)
    return float(max(data.subtree_com[1, 2] - bottom, 1e-3))


def lowest_geoms(model, data, group, height: float) -> list[int]:
    """The geoms of a group that are as low as the lowest, up to 2 % of the standing height."""
    bottom = {int(i): lowest(model, data, i) for i in group}
    least = min(bottom.values())
    return [i for i in bottom if bottom[i] <= least + 0.02 * height]


def lowest(model, data, geom: int) -> float:
    """Height of the lowest point of a geom, m."""
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


def bounding(model, data, group):
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


def shape_name(model, group) -> str:
    """What a group of geoms is, for a message."""
    kinds = {_GEOM(model.geom_type[i]).name.removeprefix("mjGEOM_").lower() for i in group}
    return f"{len(group)} geoms" if len(group) > 1 else f"a {kinds.pop()}"


def leg_length(model, ends) -> float:
    """Mean length of the chains of bodies from the trunk to some geoms, m."""
    lengths = []
    for geom in ends:
        length, body = np.linalg.norm(model.geom_pos[geom]), model.geom_bodyid[geom]
        while body > 1:
            length += np.linalg.norm(model.body_pos[body])
            body = model.body_parentid[body]
        lengths.append(length)
    return float(np.mean(lengths)) if lengths else 0.3
