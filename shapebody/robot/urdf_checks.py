"""Checks of the text of a URDF, for mistakes that MuJoCo's importer does not notice."""

import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from shapebody.robot.finite import is_finite, not_finite
from shapebody.robot.spec_edits import each, listed


def check_urdf(path: Path, root) -> list[str]:
    """Notes on inertias. Raises ValueError for what MuJoCo's importer does not notice."""
    _check_base(path, root)
    repeated = [
        f"repeated name {name!r} in {kind} ({count} of them)"
        for kind in ("link", "joint")
        for name, count in Counter(part.get("name") for part in root.findall(kind)).items()
        if name and count > 1
    ]
    wrong: dict[tuple[str, str], list[str]] = {}
    for attribute in ("velocity", "effort"):
        for joint, value in limits_of(root, attribute):
            if not is_finite(as_number(value)):
                wrong.setdefault((attribute, value), []).append(repr(joint))
    reasons = []
    if repeated:
        reasons.append(
            f"{listed(repeated)}. Each name may be used once per kind of "
            "element; rename one of the two"
        )
    for (attribute, value), joints in wrong.items():
        unit = {"velocity": "rad/s", "effort": "N m"}[attribute]
        expected = (
            f"a number ({unit}); write it, or expand the xacro template that the file comes from"
            if np.isnan(as_number(value))
            else f"a finite number ({unit}); correct it, or write 0 for no limit"
        )
        reasons.append(
            f"{attribute} of {'joint' if len(joints) == 1 else 'joints'} {listed(joints)} is "
            f"{value!r}: expected {expected}"
        )
    planar = [repr(joint.get("name")) for joint in root.findall("joint") if _is_planar(joint)]
    if planar:
        reasons.append(
            f"{each('joint', planar)} is planar: expected revolute joints; if it holds the base to "
            "the world, give it the type floating"
        )
    notes, problems = _check_inertias(root)
    reasons += problems
    if not wrong:
        numbers = [part for kind in ("link", "joint") for part in root.findall(kind)]
        found = [finding for part in numbers for finding in not_finite(part)]
        if found:
            reasons.append(f"expected finite numbers, but {listed(found)}; correct them")
    if reasons:
        raise ValueError(f"{path} is not a valid URDF file: {'; '.join(reasons)}")
    _check_tree(path, root)
    return notes


def drop_endless_visuals(root) -> Iterator[str]:
    """Take visuals with numbers that are not finite out of a URDF: only looks depend on them."""
    for link in root.findall("link"):
        for visual in link.findall("visual"):
            wrong = not_finite(visual)
            if wrong:
                link.remove(visual)
                yield (
                    f"a visual of link {link.get('name')} cannot be drawn ({listed(wrong)}): it is "
                    "dropped; to say it yourself correct or remove the <visual>"
                )


def _is_planar(joint) -> bool:
    return joint.get("type") == "planar"


_WORLD = re.compile(
    "(world|ground|floor|table|pedestal|ceiling)(_?(link|frame|plane))?$", re.IGNORECASE
)
_LONGEST = 1000  # links from the root: MuJoCo reads no more, and takes long to say so


def _check_base(path: Path, root):
    """Raises ValueError for a robot that is fixed to the world."""
    joints = root.findall("joint")
    children = {link_of(joint, "child") for joint in joints}
    for link in root.findall("link"):
        name = link.get("name") or ""
        if not _WORLD.match(name):
            continue
        below = [joint for joint in joints if link_of(joint, "parent") == name]
        if name not in children and {joint.get("type") for joint in below} == {"fixed"}:
            fixed = listed(repr(joint.get("name")) for joint in below)
            bases = listed(repr(link_of(joint, "child")) for joint in below)
            raise ValueError(
                f"{path} cannot be used as a robot: it fixes the base {bases} to the world (link "
                f"{name!r}, joint {fixed}), as that of an arm on a table: expected a robot that "
                "walks, with a base that floats. If yours walks, remove that link and that joint"
            )


def _check_tree(path: Path, root):
    """Raises ValueError if links and joints do not form a tree, or form one that is too deep."""
    names = [link.get("name") for link in root.findall("link")]
    joints = [
        (joint.get("name"), link_of(joint, "parent"), link_of(joint, "child"))
        for joint in root.findall("joint")
    ]
    if len(set(names)) < len(names) or None in names:
        return  # reported as such
    if not names:
        raise ValueError(
            f"{path} has no links: expected the URDF of a robot; if it is made from other files, "
            "e.g. by xacro, expand it first"
        )
    known = set(names)
    problems = [
        f"joint {joint!r} has no <{kind} link>: add it"
        if link is None
        else f"joint {joint!r} has the {kind} {link!r}, which is not a link: correct its name, or "
        "add the link"
        for joint, *ends in joints
        for kind, link in zip(("parent", "child"), ends, strict=True)
        if link not in known
    ]
    parents: dict[str, list[tuple[str, str]]] = {}
    for joint, parent, child in joints:
        parents.setdefault(child, []).append((joint, parent))
    problems += [
        f"link {child!r} is the child of {each('joint', [repr(joint) for joint, _ in above])}: "
        "expected one, since a robot with closed loops cannot be used; remove the others"
        for child, above in parents.items()
        if len(above) > 1
    ]
    if not problems:
        problems += _not_one_tree(names, {child: above[0][1] for child, above in parents.items()})
    if problems:
        raise ValueError(f"{path} is not a valid URDF file: {listed(problems)}")


def _not_one_tree(names, parents: dict[str, str]) -> Iterator[str]:
    """Why links do not hang from one base: at most one message. `parents` are links by child."""
    tops = [name for name in names if name not in parents and name != "world"]
    tops += ["world"] if "world" in parents.values() else []
    if len(tops) > 1:
        yield (
            f"links {listed(map(repr, tops))} are not the child of any joint: expected one such "
            "link, the base; connect the others to it by joints, or remove them"
        )
        return
    children: dict[str, list[str]] = {}
    for child, parent in parents.items():
        children.setdefault(parent, []).append(child)
    depth, waiting = {name: 0 for name in tops}, list(tops)
    while waiting:
        name = waiting.pop()
        for child in children.get(name, ()):
            depth[child] = depth[name] + 1
            waiting.append(child)
    circle = [name for name in names if name not in depth and name != "world"]
    if circle:
        yield (
            f"links {listed(map(repr, circle))} are below each other in a circle: expected a tree "
            "that starts at the base; correct the parents of their joints"
        )
    elif max(depth.values(), default=0) > _LONGEST:
        yield (
            f"it has a chain of {max(depth.values()):,} links: expected at most {_LONGEST:,}; "
            "merge links that do not move by themselves"
        )


def _check_inertias(root) -> tuple[list[str], list[str]]:
    """Notes and problems about inertias that a real body cannot have.

    Those that are not positive definite are left out, which is a problem if a moving part has no
    other. Those with one principal moment above the sum of the others get three equal moments.
    """
    links = {link.get("name"): link for link in root.findall("link")}
    part = {name: name for name in links}  # the first link of what moves as one
    fixed = {
        link_of(joint, "child"): link_of(joint, "parent")
        for joint in root.findall("joint")
        if joint.get("type") == "fixed"
    }
    for name in part:
        seen = set()
        while part[name] in fixed and part[name] not in seen:
            seen.add(part[name])
            part[name] = fixed[part[name]]
    wrong, uneven, right = {}, [], set()
    for name, link in links.items():
        inertia = link.find("inertial/inertia")
        if inertia is None:
            continue
        xx, yy, zz, xy, xz, yz = (
            as_number(inertia.get(key, "0")) for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
        )
        tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        if not is_finite(tensor).all() or not tensor.any():
            continue  # reported as such
        least, middle, most = np.linalg.eigvalsh(tensor)
        if least > 1e-12:
            right.add(part[name])
            if most - middle - least > 1e-12 * most:
                mean = (least + middle + most) / 3
                uneven.append(f"{name!r} ({least:.3g}, {middle:.3g}, {most:.3g}, now {mean:.3g})")
        else:
            wrong[name] = f"{name!r} (its smallest principal moment is {least:.3g} kg m²)"
    lone = [text for name, text in wrong.items() if part[name] not in right]
    merged = [text for name, text in wrong.items() if part[name] in right]
    problems = [
        f"inertia of {each('link', lone)} is not positive definite, which is impossible: correct "
        "ixx to izz, e.g. to those of a box of the same mass and size"
    ]
    notes = []
    if merged:
        notes.append(
            f"inertia of {each('link', merged)} is not positive definite, which is impossible: it "
            "is left out, and what moves as one with it has the inertia of the other links"
        )
    if uneven:
        notes.append(
            f"inertia of {each('link', uneven)} has a principal moment above the sum of the "
            "others, which is impossible: it is replaced by three equal ones of the same sum (kg "
            "m²); to say it yourself correct ixx to izz"
        )
    return notes, problems if lone else []


def link_of(joint, kind: str) -> str | None:
    """Name of the "parent" or "child" link of a URDF joint; None if it does not have one."""
    element = joint.find(kind)
    return None if element is None else element.get("link")


def as_number(text: str) -> float:
    """A text as a number; NaN if it is not a number."""
    try:
        return float(text)
    except ValueError:
        return float("nan")


def limits_of(root, attribute: str) -> Iterator[tuple[str, str]]:
    """Names of joints with the text of an attribute ("effort", "velocity") of their <limit>."""
    for joint in root.findall("joint"):
        limit = joint.find("limit")
        if limit is not None and limit.get(attribute) is not None:
            yield joint.get("name"), limit.get(attribute)
