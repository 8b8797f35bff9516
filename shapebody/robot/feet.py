"""Where a robot touches the floor: feet, ends of legs, and tails that only look like legs."""

import mujoco
import numpy as np
from scipy.optimize import nnls

from shapebody.robot.geometry import (
    LEVEL,
    lowest,
    lowest_geoms,
    posed,
    reach_of,
    standing_height,
)
from shapebody.robot.spec_edits import FOOT, MESHES


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
    """The geoms of a group that are not meshes, or all of them if it only has meshes."""
    return [i for i in group if model.geom_type[i] not in MESHES] or group


def colliding(model, group) -> list[int]:
    """The geoms of a group that can touch something."""
    paired = {*model.pair_geom1.tolist(), *model.pair_geom2.tolist()}
    return [i for i in group if model.geom_contype[i] or model.geom_conaffinity[i] or i in paired]


def leg_ends(model, qpos, reach: float = 0.2) -> dict[int, list[int]]:
    """Moving body -> geom ids of its lowest geoms, for bodies at the end of a leg in pose qpos.

    Those are the outermost bodies that come as close to the lowest of them as `reach` times the
    standing height, without a tail (`idle_tails`).
    """
    return _ends(model, qpos, reach)[0]


def idle_tails(model, qpos) -> list[int]:
    """Bodies that reach the floor as legs do in pose qpos, but are tails that bear no weight.

    A tail is the only one of its kind (in joints, lengths and mass), in the middle of the legs as
    seen from the side or from ahead, and bears no weight if the robot stands without it: the
    centre of mass is above what the other ends enclose on the floor.
    """
    return _ends(model, qpos, 0.2)[1]


def _ends(model, qpos, reach: float) -> tuple[dict[int, list[int]], list[int]]:
    """Ends of legs with their lowest geoms, and idle tails."""
    data = posed(model, qpos)
    height = standing_height(model, data)
    heights, chosen = {}, {}
    for body in _outermost(model):
        shapes = solid(model, list(np.flatnonzero(model.body_weldid[model.geom_bodyid] == body)))
        group = colliding(model, shapes) or shapes
        if group:
            chosen[body] = lowest_geoms(model, data, group, height)
            heights[body] = lowest(model, data, chosen[body][0])

    def reaching(bodies):
        floor = min((heights[body] for body in bodies), default=0)
        return {b: chosen[b] for b in bodies if heights[b] <= floor + reach * height}

    kinds = {body: _kind(model, body, group[0]) for body, group in chosen.items()}
    bodies, tails = list(chosen), []
    for body in list(chosen):
        others = reaching([other for other in bodies if other != body])
        if (
            body in reaching(bodies)
            and not any(_alike(kinds[body], kinds[o]) for o in chosen if o != body)
            and any(_alike(kinds[o], kinds[p]) for o in others for p in others if o != p)
            and _in_the_middle(data, chosen[body], others)
            and _carry(model, data, others, 0.05 * height)
        ):
            bodies.remove(body)
            tails.append(body)
    return reaching(bodies), tails


def _outermost(model) -> list[int]:
    """Moving bodies that carry no other moving body."""
    moving = model.body_weldid
    parents = {int(moving[model.body_parentid[body]]) for body in np.unique(moving) if body}
    return [int(body) for body in np.unique(moving) if body and body not in parents]


def _kind(model, body: int, end: int) -> tuple[int, np.ndarray]:
    """Joints, and mass (kg) and lengths (m) of the parts, from the trunk to a geom of a body."""
    joints, mass, lengths = 0, 0.0, [np.linalg.norm(model.geom_pos[end])]
    while body > 1:
        joints += int(model.body_jntnum[body])
        mass += float(model.body_mass[body])
        lengths.append(np.linalg.norm(model.body_pos[body]))
        body = int(model.body_parentid[body])
    return joints, np.array([mass, *lengths])


def _alike(a, b) -> bool:
    """Whether two ends of legs are of one kind, as the left and the right one are."""
    same = a[0] == b[0] and len(a[1]) == len(b[1])
    return same and np.allclose(a[1], b[1], rtol=0.1, atol=0.1 * max(a[1][1:].max(), 1e-3))


def _in_the_middle(data, group, others) -> bool:
    """Whether geoms are, from the side or from ahead, near the middle of the other ends."""
    where = data.geom_xpos[group, :2].mean(axis=0)
    places = np.array([data.geom_xpos[other, :2].mean(axis=0) for other in others.values()])
    low, high = places.min(axis=0), places.max(axis=0)
    turned = data.xmat[1].reshape(3, 3)[:2, :2].T  # along the axes of the trunk
    off = np.abs(turned @ (where - (low + high) / 2))
    return bool(np.any((off <= 0.125 * np.abs(turned @ (high - low))) & (high - low > 1e-6)))


def _carry(model, data, ends, tolerance: float) -> bool:
    """Whether the centre of mass is above what ends of legs enclose, up to a tolerance, m."""
    points = [
        data.geom_xpos[geom, :2] + sign * reach_of(model, data, geom, sign * axis) * axis[:2]
        for group in ends.values()
        for geom in group
        for axis in np.eye(3)[:2]
        for sign in (-1, 1)
    ]
    if not points:
        return False
    # Weights >= 0 of sum 1 that take the points closest to the centre of mass.
    _, distance = nnls(
        np.vstack([np.transpose(points), np.full(len(points), 1e3)]),
        np.append(data.subtree_com[1, :2], 1e3),
    )
    return distance <= tolerance


def legs_without_geom(model) -> list[int]:
    """Outermost bodies without any geom that are as low as bodies with feet, or as ends of legs.

    For robots that are not complete yet: the pose is "home" if there is one, else the zero pose
    within the joint limits. If no leg ends in a geom, all such bodies count.
    """
    moving, qpos = model.body_weldid, _rest(model)
    filled = set(moving[model.geom_bodyid].tolist())
    bare = [body for body in _outermost(model) if body not in filled]
    ends = _footed(model) or set(leg_ends(model, qpos))
    if not bare or not ends:
        return bare
    data = posed(model, qpos)
    level = max(data.xpos[body, 2] for body in ends) + 0.05 * standing_height(model, data)
    return [body for body in bare if data.xpos[body, 2] <= level]


def has_feet(model) -> bool:
    """Whether there are feet, or legs that end in geoms. For robots that are not complete yet."""
    return bool(_footed(model) or leg_ends(model, _rest(model)))


def _rest(model) -> np.ndarray:
    """qpos [nq] of "home" if there is one, else zero within the joint limits."""
    home = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, "home")
    qpos = np.array(model.qpos0 if home < 0 else model.key_qpos[home])
    for joint in np.flatnonzero((model.jnt_limited == 1) & (home < 0)):
        address = model.jnt_qposadr[joint]
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE:
            qpos[address] = np.clip(qpos[address], *model.jnt_range[joint])
    return qpos


def _footed(model) -> set[int]:
    """Moving bodies with feet."""
    return set(model.body_weldid[model.geom_bodyid[foot_ids(model)]].tolist())


def sole_beside(model, data, body: int, height: float) -> list[int]:
    """The lowest colliding geoms of the leg of a body, if they reach down to a height, m.

    The leg is the body, what it carries, and what carries it up to a fork or the trunk. The list is
    empty if no part of the leg collides that low.
    """
    moving = model.body_weldid
    above = {int(b): int(moving[model.body_parentid[b]]) for b in np.unique(moving) if b}
    trunk = int(moving[1])
    body = int(moving[body])
    if body == trunk:
        return []
    while above[body] not in (0, trunk) and list(above.values()).count(above[body]) == 1:
        body = above[body]
    leg = {body}
    for other in sorted(above):  # parents come first
        if above[other] in leg:
            leg.add(other)
    scale = standing_height(model, data)
    shapes = {}
    for part in leg:
        group = solid(model, colliding(model, np.flatnonzero(moving[model.geom_bodyid] == part)))
        if group:
            group = lowest_geoms(model, data, group, scale)
            shapes[lowest(model, data, group[0])] = group
    bottom = min(shapes, default=np.inf)
    return shapes[bottom] if bottom <= height + LEVEL * scale else []


def ends_without_foot(model, qpos) -> dict[int, list[int]]:
    """As `leg_ends`, for those at the height of the floor that have no foot."""
    ends, footed = leg_ends(model, qpos, reach=0.05), _footed(model)
    return {body: group for body, group in ends.items() if body not in footed}
