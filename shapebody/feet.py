"""Where a robot touches the floor: the ends of its legs, and spheres or boxes for its feet."""

from itertools import pairwise

import mujoco
import numpy as np
from scipy.optimize import nnls

from shapebody.specs import FOOT, MESHES, add_like, drop_geom, replace_geom

_GEOM = mujoco.mjtGeom
FOOT_SHAPES = int(_GEOM.mjGEOM_SPHERE), int(_GEOM.mjGEOM_BOX)
TALL = 0.25  # of the standing height: what is taller is a leg; feet of the 50 robots are up to 0.24
LEVEL = 0.02  # of the standing height: what differs by less is equally high


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

    A tail is the only one of its kind (in joints and length), between the legs or in their middle
    plane, and bears no weight if the robot stands without it: the centre of mass is above what
    the other ends enclose on the floor.
    """
    return _ends(model, qpos, 0.2)[1]


def _ends(model, qpos, reach: float) -> tuple[dict[int, list[int]], list[int]]:
    """Ends of legs with their lowest geoms, and idle tails."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
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

    kinds = {body: _kind(model, body) for body in chosen}
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


def _kind(model, body: int) -> tuple[int, float]:
    """Joints and length, m, of the chain from the trunk to a body."""
    joints, length = 0, 0.0
    while body > 1:
        joints += int(model.body_jntnum[body])
        length += float(np.linalg.norm(model.body_pos[body]))
        body = int(model.body_parentid[body])
    return joints, length


def _alike(a, b) -> bool:
    """Whether two ends of legs are of one kind, as the left and the right one are."""
    return a[0] == b[0] and abs(a[1] - b[1]) <= 0.1 * max(a[1], b[1])


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
        data.geom_xpos[geom, :2] + sign * _reach(model, data, geom, sign * axis) * axis[:2]
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

    Asked before the robot is complete: the pose is "home" if there is one, else the zero pose
    within the joint limits. If no leg has an end, all such bodies count.
    """
    moving, qpos = model.body_weldid, _rest(model)
    filled = set(moving[model.geom_bodyid].tolist())
    bare = [body for body in _outermost(model) if body not in filled]
    ends = _footed(model) or set(leg_ends(model, qpos))
    if not bare or not ends:
        return bare
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    level = max(data.xpos[body, 2] for body in ends) + 0.05 * standing_height(model, data)
    return [body for body in bare if data.xpos[body, 2] <= level]


def has_feet(model) -> bool:
    """Whether there are feet, or legs that end in geoms. Asked before the robot is complete."""
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

    The leg is the body, what it carries, and what carries it up to a fork or the trunk. Empty if
    nothing of it collides so low.
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


def is_tall(model, data, group) -> bool:
    """Whether some geoms are too tall for a foot: as the shank of a leg is."""
    if len(group) == 1 and model.geom_type[group[0]] == _GEOM.mjGEOM_SPHERE:
        return False
    low, high = _span(model, data, group)
    return bool(high - low > TALL * standing_height(model, data))


def _span(model, data, group) -> tuple[float, float]:
    """Height of the lowest and of the highest point of some geoms, m."""
    up = np.array([0, 0, 1.0])
    high = max(data.geom_xpos[i, 2] + _reach(model, data, i, up) for i in group)
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
                reach = [[_reach(model, data, i, sign * axis) for axis in axes.T] for i in group]
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
