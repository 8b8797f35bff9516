"""Feet of a robot file that names none, or names other shapes than spheres and boxes."""

from collections.abc import Iterator

import mujoco

from shapebody.robot.entries import home_qpos
from shapebody.robot.feet import colliding, foot_name, idle_tails, leg_ends, sole_beside, solid
from shapebody.robot.foot_shapes import FOOT_SHAPES, add_foot, is_tall, shape_name
from shapebody.robot.geometry import lowest_geoms, posed, standing_height
from shapebody.robot.spec_edits import FOOT, each, listed, rename_geom, unused, write_inertial

_GEOM = mujoco.mjtGeom


def infer_feet(spec, model) -> Iterator[str]:
    """One sphere or box per foot, with "foot" in its name and nothing else so named.

    Named geoms of other shapes are replaced by the sphere or box that bounds them, and named
    geoms that touch nothing by the colliding sole of the same leg, if it is as low. Without names,
    feet are the lowest geoms of the legs: of the outermost moving bodies that reach the floor in
    the home pose. Of geoms as tall as a shank the foot is the lower end.
    """
    geoms = {geom.id: geom for geom in spec.geoms}
    named: dict[int, list[int]] = {}
    for index, geom in geoms.items():
        if FOOT.search(geom.name) and geom.parent.name != "world":
            named.setdefault(int(model.geom_bodyid[index]), []).append(index)
    data = posed(model, home_qpos(model))
    tails, marked = [], []
    if named:
        groups, labels, marked = _named_feet(model, data, geoms, named)
    else:
        groups, tails = list(leg_ends(model, data.qpos).values()), idle_tails(model, data.qpos)
        labels = {group[0]: foot_name(geoms, group) for group in groups}
    if not groups:
        return

    # The geoms that are feet already, by the first of their group.
    own_names = {group[0] for group in named.values() if len(group) == 1}
    ready = {
        group[0]
        for group in groups
        if len(group) == 1
        and model.geom_type[group[0]] in FOOT_SHAPES
        and not geoms[group[0]].meshname
        and (group[0] in own_names or not is_tall(model, data, group))
    }
    if named and ready == own_names and len(ready) == len(named):
        return

    # A mesh that is only for looks must not count as a foot.
    for group in named.values():
        for index in group:
            names = {geom.name for geom in spec.geoms}
            rename_geom(spec, geoms[index], unused(FOOT.sub("sole", geoms[index].name), names))
    made = ", ".join(
        _make_foot(spec, geoms, model, data, group, labels[group[0]], group[0] in ready)
        for group in groups
    )
    yield _why(made, named, marked)
    if tails:
        yield (
            f"{each('body', [model.body(body).name for body in tails])} reaches the floor too, but "
            "is not like the legs, and the robot stands without it: it is a tail that bears no "
            'weight, and passes through the floor; to make it a foot put "foot" into the names of '
            "all geoms that touch the floor"
        )


def _why(made: str, named, marked) -> str:
    """The note about the feet `made`: what was wrong with the geoms that are named as feet."""
    if marked:
        return (
            f"geoms {listed(marked)} touch nothing, and beside them other geoms of the same legs "
            f'do: these are the feet: {made}; to say it yourself put "foot" only into the names '
            "of the geoms that touch the floor"
        )
    if named:
        return f"feet must be one sphere or box each: {made}; to say it yourself replace the geoms"
    return (
        f'no geom has "foot" in its name: the lowest geoms of the legs are the feet: {made}; to '
        'say it yourself name the geoms that touch the floor, e.g. name="left_foot"'
    )


def _named_feet(model, data, geoms, named):
    """Groups of geoms that are feet, the names of the feet by the first geom of a group, and the
    names of geoms that are not feet after all; `named` are the ids of named geoms by bodies."""
    groups: dict[int, list[int]] = {}
    labels, marked = {}, []
    height = standing_height(model, data)
    for body, group in named.items():
        touching = colliding(model, group)
        level = data.geom_xpos[group, 2].min()
        sole = [] if touching else sole_beside(model, data, body, level)
        if sole:
            marked += [geoms[index].name for index in group]
        found = sole or lowest_geoms(model, data, solid(model, touching or group), height)
        # Two names for one sole are one foot.
        groups.setdefault(found[0], found)
        labels.setdefault(found[0], foot_name(geoms, group if sole else found))
    return list(groups.values()), labels, marked


def _make_foot(spec, geoms, model, data, group, label: str, ready: bool) -> str:
    """Name the foot that a group of geoms is (if `ready`) or becomes; says what it was."""
    geom = geoms[group[0]]
    body = geom.parent
    # The inertia of the body must not follow its new foot.
    if not body.explicitinertial:
        write_inertial(body, model)
    was = shape_name(model, group)
    if not ready:
        if is_tall(model, data, group):
            was = f"the lower end of {was}"
        geom = add_foot(spec, geoms, model, data, group)
    rename_geom(spec, geom, unused(label, {other.name for other in spec.geoms}))
    shape = "sphere" if geom.type == _GEOM.mjGEOM_SPHERE else "box"
    return f"{geom.name!r} (body {body.name!r}, {was}, now a {shape})"
