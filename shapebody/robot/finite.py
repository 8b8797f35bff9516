"""Numbers of a robot file that are not finite, also those that are too large for float32.

MuJoCo computes in float64 and accepts "nan", "inf" and 1e39 silently; MJX and the networks compute
in float32, where each of them ruins every simulation.
"""

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator

import mujoco
import numpy as np

from shapebody.robot.spec_edits import each, listed

_OBJ = mujoco.mjtObj


LARGEST = float(np.finfo(np.float32).max)

DOF_FIELDS = ("dof_damping", "dof_armature", "dof_frictionloss")
"""Properties of joints that MuJoCo keeps per degree of freedom."""

_KINDS = {  # first part of the name of a field of mjModel -> what its rows belong to
    "body": (_OBJ.mjOBJ_BODY, "nbody"),
    "jnt": (_OBJ.mjOBJ_JOINT, "njnt"),
    "geom": (_OBJ.mjOBJ_GEOM, "ngeom"),
    "site": (_OBJ.mjOBJ_SITE, "nsite"),
    "cam": (_OBJ.mjOBJ_CAMERA, "ncam"),
    "light": (_OBJ.mjOBJ_LIGHT, "nlight"),
    "mat": (_OBJ.mjOBJ_MATERIAL, "nmat"),
    "pair": (_OBJ.mjOBJ_PAIR, "npair"),
    "eq": (_OBJ.mjOBJ_EQUALITY, "neq"),
    "tendon": (_OBJ.mjOBJ_TENDON, "ntendon"),
    "actuator": (_OBJ.mjOBJ_ACTUATOR, "nu"),
    "sensor": (_OBJ.mjOBJ_SENSOR, "nsensor"),
    "key": (_OBJ.mjOBJ_KEY, "nkey"),
}
# What MuJoCo computes from other fields. If those are right, it is only reported for values that
# overflow on the way.
_COMPUTED = frozenset(
    "body_invweight0 body_subtreemass body_margin dof_M0 dof_invweight0 dof_length actuator_acc0 "
    "actuator_length0 actuator_lengthrange geom_aabb geom_rbound tendon_length0 tendon_invweight0 "
    "cam_pos0 cam_poscom0 cam_mat0 light_pos0 light_poscom0 light_dir0 bvh_aabb oct_aabb "
    "flexedge_length0 flexedge_invweight0".split()
)
_ATTRIBUTES = {"qpos0": "ref", "qpos_spring": "springref"}  # of joints, by the fields they go to
_EXPECTED = f"finite numbers (up to {LARGEST:.1e}, the largest of float32)"
_SUSPICIOUS = re.compile(r"nan|inf|\de\+?\d\d|\d{38}", re.IGNORECASE)
_NOT_NUMBERS = frozenset("name class childclass model file text".split())


def is_finite(values) -> np.ndarray:
    """bool[...], whether numbers stay finite in float32."""
    return np.abs(values) <= LARGEST  # false for NaN


def check_numbers(model: mujoco.MjModel) -> Iterator[str]:
    """Finite numbers in all fields, and none below zero where negative ones make no sense."""
    fields = [name for name in dir(model) if _is_floats(getattr(model, name, None))]
    found = [
        message
        for name in fields
        if name not in _COMPUTED and name != "numeric_data"
        for message in _not_finite_in(model, name)
    ]
    found += _custom(model)
    found += _settings(model.opt, "<option>")
    for part in ("global_", "quality", "headlight", "map", "scale", "rgba"):
        found += _settings(getattr(model.vis, part, None), f"<visual><{part.rstrip('_')}>")
    if not found:
        found += _settings(model.stat, "<statistic>")
    for field in (*DOF_FIELDS, "jnt_stiffness", "pair_friction"):
        found += wrong(model, field, lambda x: x < 0, "at least 0")
    for name in ("density", "viscosity"):
        if (value := getattr(model.opt, name)) < 0:
            found.append(f"{name} of <option> is {value:g}: expected at least 0; correct it")
    if not found:
        found += [
            message
            for name in fields
            if name in _COMPUTED
            for message in _not_finite_in(model, name)
        ]
    yield from found


def check_inertials(spec: mujoco.MjSpec, model: mujoco.MjModel) -> Iterator[str]:
    """Masses and inertias of the file that make no sense, and that compiling has replaced."""
    found: dict[str, list[str]] = {}
    for body in spec.bodies[1:]:
        if not body.explicitinertial:
            continue
        values = {"mass": np.array(body.mass), "diaginertia": body.inertia}
        if not np.isnan(body.fullinertia[0]):  # NaN says that it is not given
            values["fullinertia"] = body.fullinertia
        for name, value in values.items():
            compiled = np.append(model.body_inertia[body.id], model.body_mass[body.id])
            unseen = is_finite(compiled).all() and not is_finite(value).all()
            expected = _EXPECTED if unseen else None
            if name != "fullinertia" and np.any(value < 0):
                expected = "numbers above 0, since an inertia is positive definite"
            if expected:
                finding = f"{name} is {_shown(value)}: expected {expected}"
                found.setdefault(finding, []).append(repr(body.name))
    for finding, names in found.items():
        yield f"<inertial> of {each('body', names)}: {finding}; correct it"


def wrong(model, field: str, is_wrong: Callable, expected: str) -> Iterator[str]:
    """A message per value of a field that `is_wrong`, with the names of all that have it."""
    found: dict[str, list[str]] = {}
    values = np.asarray(getattr(model, field))
    owner = _owner(model, field, len(values))
    if owner is None:
        values = values.reshape(1, -1)
        values = values[:, is_wrong(values[0])]
    for index, value in enumerate(values):
        if np.any(is_wrong(value)):
            named = found.setdefault(_shown(value, is_wrong), [])
            named.append("the file" if owner is None else owner(index))
    attribute = _ATTRIBUTES.get(field, field)
    for shown, names in found.items():
        yield f"{attribute} of {listed(names)} is {shown}: expected {expected}; correct it"


def _is_floats(value) -> bool:
    return isinstance(value, np.ndarray) and value.dtype.kind == "f"


def _not_finite_in(model, field: str) -> Iterator[str]:
    if not is_finite(getattr(model, field)).all():
        yield from wrong(model, field, lambda x: ~is_finite(x), _EXPECTED)


def _owner(model, field: str, rows: int) -> Callable[[int], str] | None:
    """The function that names a row of a field; None if its rows have no elements with names."""

    def named(kind):
        return lambda i: repr(mujoco.mj_id2name(model, kind, int(i)) or _unnamed(model, kind, i))

    joint = named(_OBJ.mjOBJ_JOINT)
    if field in ("qpos0", "qpos_spring"):  # ref and springref
        return lambda i: joint(np.searchsorted(model.jnt_qposadr, i, side="right") - 1)
    prefix = field.split("_")[0]
    if prefix == "dof":
        return lambda i: joint(model.dof_jntid[i])
    kind, count = _KINDS.get(prefix, (None, None))
    return named(kind) if kind is not None and getattr(model, count) == rows else None


def _unnamed(model, kind, index: int) -> str:
    """What to call an element without a name: its number, and for a geom its body."""
    if kind != _OBJ.mjOBJ_GEOM:
        return f"number {index}"
    body = mujoco.mj_id2name(model, _OBJ.mjOBJ_BODY, int(model.geom_bodyid[index]))
    return f"number {index} of body {body}"


def _custom(model) -> Iterator[str]:
    """Custom numbers; those of the method have checks of their own."""
    ours = ("action_scale", "velocity_limits", "keep_nominal")
    for index in range(model.nnumeric):
        name = mujoco.mj_id2name(model, _OBJ.mjOBJ_NUMERIC, index)
        start = model.numeric_adr[index]
        data = model.numeric_data[start : start + model.numeric_size[index]]
        if name not in ours and not is_finite(data).all():
            yield f"custom numeric {name!r} is {_shown(data)}: expected {_EXPECTED}; correct it"


def _settings(settings, element: str) -> Iterator[str]:
    """The numbers of a structure without rows, such as the physics options."""
    for name in dir(settings):
        value = None if name.startswith("_") else getattr(settings, name)
        if isinstance(value, float) or _is_floats(value):
            if not is_finite(value).all():
                shown = _shown(np.asarray(value))
                yield f"{name} of {element} is {shown}: expected {_EXPECTED}; correct it"


def check_text(text: str) -> Iterator[str]:
    """Finite numbers in the attributes of an XML file, also those that compiling hides."""
    if not _SUSPICIOUS.search(text):
        return
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError:
        return
    for finding in not_finite(root):
        yield f"{finding}: expected {_EXPECTED}; correct it"


def not_finite(root: ElementTree.Element) -> list[str]:
    """The attributes in an XML tree with numbers that are not finite, in the words of the file.

    The name of an element is not read as a number, even if it looks like one.
    """
    names = {element.get("name") for element in root.iter()}
    found: dict[str, list[str]] = {}

    def visit(element, owner):
        # An element without a name is known by what it belongs to.
        owner = element.get("name") or element.get("joint") or element.get("body") or owner
        for attribute, text in element.attrib.items():
            if attribute in _NOT_NUMBERS or text in names:
                continue
            if any(not is_finite(number) for number in _numbers(text)):
                where = f" in {owner!r}" if owner else ""
                finding = f"{attribute} of <{element.tag}>{{}} is {text!r}"
                found.setdefault(finding, []).append(where)
        for child in element:
            visit(child, owner)

    visit(root, None)
    return [
        finding.format("" if where == [""] else where[0] + _more(where))
        for finding, where in found.items()
    ]


def _more(where) -> str:
    return f" and {len(where) - 1} more" if len(where) > 1 else ""


def _numbers(text: str) -> Iterator[float]:
    for part in text.split():
        try:
            yield float(part)
        except ValueError:
            return


def _shown(values, is_wrong: Callable | None = None) -> str:
    """Numbers for a message; of many, only the wrong ones with their places."""
    values = np.asarray(values)
    if values.size > 6 and is_wrong is not None:
        places = np.flatnonzero(is_wrong(values))
        return listed(f"{values.flat[i]:g} (number {i + 1})" for i in places)
    return np.array2string(values, threshold=6)
