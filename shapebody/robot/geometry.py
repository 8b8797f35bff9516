"""Measures of a compiled robot in a pose: how low its geoms reach, how high it stands."""

from __future__ import annotations

import mujoco
import numpy as np

_GEOM = mujoco.mjtGeom


LEVEL = 0.02  # of the standing height: what differs by less is equally high

SHOWN_GROUPS = (0, 1, 2)
"""Geom groups in pictures; collision spheres are in group 5."""


def posed(model: mujoco.MjModel, qpos) -> mujoco.MjData:
    """Positions of all parts of a model in the pose `qpos` [nq]."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    return data


def standing_pose(model: mujoco.MjModel, qpos=None, geoms=None) -> np.ndarray:
    """float64[nq], a pose with the trunk moved up or down until the robot touches the floor, z = 0.

    A design has other link lengths than the reference, so its own height differs.

    Args:
        qpos: [nq], the pose; if None, that of the keyframe "home", else of the first keyframe,
            else `qpos0`.
        geoms: ids of the geoms whose lowest point comes to z = 0, such as `Robot.feet`; if None,
            all of the robot that pictures show (`SHOWN_GROUPS`).

    A model that does not start with a free joint stands where its file puts it: its pose is
    returned as it is.
    """
    if qpos is None:
        home = max(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, "home"), 0)
        qpos = model.key_qpos[home] if model.nkey else model.qpos0
    qpos = np.array(qpos, np.float64)
    if not (model.njnt and model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE):
        return qpos
    if geoms is None:
        moving = model.body_weldid[model.geom_bodyid] > 0
        geoms = np.flatnonzero(moving & np.isin(model.geom_group, SHOWN_GROUPS))
    data = posed(model, qpos)
    qpos[2] -= min((lowest(model, data, geom) for geom in geoms), default=0.0)
    return qpos


def standing_height(model, data) -> float:
    """Height of the centre of mass above the lowest geom of the robot, m; at least 1 mm.

    Unlike the height of the trunk, it does not depend on where the trunk has its origin.
    """
    mujoco.mj_comPos(model, data)
    geoms = np.flatnonzero(model.geom_bodyid)
    bottom = min((lowest(model, data, i) for i in geoms), default=0.0)
    return float(max(data.subtree_com[1, 2] - bottom, 1e-3))


def lowest_geoms(model, data, group, height: float) -> list[int]:
    """The geoms of a group that are as low as the lowest, up to `LEVEL` of the standing height."""
    bottom = {int(i): lowest(model, data, i) for i in group}
    least = min(bottom.values())
    return [i for i in bottom if bottom[i] <= least + LEVEL * height]


def lowest(model, data, geom: int) -> float:
    """Height of the lowest point of a geom, m."""
    return data.geom_xpos[geom, 2] - reach_of(model, data, geom, np.array([0, 0, -1.0]))


def reach_of(model, data, geom: int, direction) -> float:
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
            return float(np.sum(size * np.abs(local)))
        case _GEOM.mjGEOM_MESH:
            mesh = model.geom_dataid[geom]
            start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
            return float(np.max(model.mesh_vert[start : start + count] @ local))
    centre, half = np.split(model.geom_aabb[geom], 2)
    return float(centre @ local + half @ np.abs(local))


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
