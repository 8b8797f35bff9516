"""Designs as MuJoCo models and as MJCF text."""

from __future__ import annotations

import copy
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator

import mujoco
import numpy as np

from shapebody.design.phi import MODEL_FIELDS, Embodiment
from shapebody.robot.geometry import standing_pose
from shapebody.robot.robot import Robot
from shapebody.robot.spec_edits import comment

TIGHT_RANGE = 0.001  # rad, half width of the exported range of a joint whose limits have crossed

_SIZES = {
    mujoco.mjtGeom.mjGEOM_PLANE: 3,
    mujoco.mjtGeom.mjGEOM_SPHERE: 1,
    mujoco.mjtGeom.mjGEOM_CAPSULE: 2,
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: 3,
    mujoco.mjtGeom.mjGEOM_CYLINDER: 2,
    mujoco.mjtGeom.mjGEOM_BOX: 3,
}

_ORIENTATIONS = ("quat", "euler", "axisangle", "xyaxes", "zaxis", "fromto")


def model_fields(embodiment: Embodiment) -> dict[str, np.ndarray]:
    """The fields of an embodiment that are fields of MjModel, as float64 arrays."""
    return {name: np.asarray(getattr(embodiment, name), np.float64) for name in MODEL_FIELDS}


def build_model(robot: Robot, embodiment: Embodiment, scale) -> mujoco.MjModel:
    """A copy of the robot's model with all fields of one embodiment.

    `scale` [3] are the size factors (s_x, s_y, s_z), for what is only looked at: sites (size by
    their mean) and cameras on the robot. The home keyframe gets the nominal pose with the
    lowest foot point on the floor, the custom entries the action scale and the velocity limits.
    """
    model = copy.copy(robot.model)
    for name, value in model_fields(embodiment).items():
        getattr(model, name)[:] = value
    # Flags set by the compiler for the reference. They would make MuJoCo ignore changed frames.
    model.body_sameframe[:] = 0
    model.geom_sameframe[:] = 0
    model.site_sameframe[:] = 0
    scale = np.asarray(scale, np.float64)
    model.site_size[model.site_bodyid > 0] *= scale.mean()
    for field in ("cam_pos", "cam_pos0", "cam_poscom0"):
        getattr(model, field)[model.cam_bodyid > 0] *= scale
    set_numeric(model, "action_scale", embodiment.action_scale)
    set_numeric(model, "velocity_limits", embodiment.velocity_limits)
    nominal = np.asarray(embodiment.nominal, np.float64)
    home = model.key("home").id
    model.key_qpos[home] = standing_pose(model, robot.pose(nominal), robot.feet)
    model.key_ctrl[home] = nominal
    return model


def set_numeric(model: mujoco.MjModel, name: str, values) -> None:
    """Overwrite the custom numeric entry `name`."""
    index = model.numeric(name).id
    start, size = model.numeric_adr[index], model.numeric_size[index]
    model.numeric_data[start : start + size] = np.asarray(values)


def balanced(inertia) -> np.ndarray:
    """Principal inertias [n, 3] that satisfy the triangle inequality, from any, kg m².

    Where the two smaller moments of a body add up to less than the largest, all three become their
    mean, as MuJoCo's compiler does with balanceinertia="true".
    """
    ordered = np.sort(inertia, axis=-1)
    violated = ordered[:, 0] + ordered[:, 1] < ordered[:, 2]
    return np.where(violated[:, None], inertia.mean(axis=-1, keepdims=True), inertia)


def ordered_ranges(ranges) -> np.ndarray:
    """Joint ranges [n, 2] with lower < upper, from any, rad.

    The design map can make the limits of a joint cross if its reference range is below 0.8 rad (no
    joint of Go2, MIT Humanoid or Golem, but e.g. ankles of small humanoids). C MuJoCo then applies
    both limits, MJX only the more violated one, and the MJCF compiler either rejects such a range
    or silently drops it. Here it becomes a tight range about the midpoint, where the two limits
    hold the joint in C MuJoCo.
    """
    crossed = ranges[:, 0] >= ranges[:, 1]
    middle = ranges.mean(axis=1, keepdims=True)
    tight = middle + np.array([-TIGHT_RANGE, TIGHT_RANGE])
    return np.where(crossed[:, None], tight, ranges)


def write_mjcf(robot: Robot, embodiment: Embodiment, scale) -> str:
    """MJCF text of one embodiment and its size factors [3], see `build_model`.

    It compiles in any MuJoCo and holds what the robot's file holds for a simulation: contacts of
    the feet, sensors, the home pose as keyframe.

    The text says in a comment what MJCF could not take over: inertias that violate the triangle
    inequality are balanced (`balanced`) and crossed joint limits are tightened (`ordered_ranges`).
    Compiling also recomputes MuJoCo's derived constants, which a design otherwise keeps from the
    reference. Meshes keep their size.

    Raises:
        ValueError: if the text does not compile to the design, which a MJCF of the robot with
            features that move its parts (such as fusestatic) can cause.
    """
    # What the design is, and what MJCF can hold of it.
    design = build_model(robot, embodiment, scale)
    fields = model_fields(embodiment)
    inertia = balanced(fields["body_inertia"])
    ranges = fields["jnt_range"].copy()
    hinges = robot.joints
    ranges[hinges] = ordered_ranges(ranges[hinges])
    num_balanced = int(np.sum(np.any(inertia != fields["body_inertia"], axis=1)))
    num_tightened = int(np.sum(np.any(ranges != fields["jnt_range"], axis=1)))
    fields |= {"body_inertia": inertia, "jnt_range": ranges}

    # Bodies, motors, home pose, and what the robot says in custom entries.
    root = ElementTree.fromstring(_reference_text(robot))
    _TreeWriter(design, fields).write_body(root.find("worldbody"))
    for element, gain, bias, force in zip(
        root.find("actuator"),
        fields["actuator_gainprm"],
        fields["actuator_biasprm"],
        fields["actuator_forcerange"],
        strict=True,
    ):
        element.set("gainprm", _text(np.trim_zeros(gain, "b")))
        element.set("biasprm", _text(np.trim_zeros(bias, "b")))
        element.set("forcerange", _text(force))
    home = design.key("home")
    key = root.find("keyframe/key[@name='home']")
    key.set("qpos", _text(home.qpos))
    key.set("ctrl", _text(home.ctrl))
    for name in ("action_scale", "velocity_limits"):
        element = root.find(f"custom/numeric[@name='{name}']")
        element.set("data", _text(design.numeric(name).data))
    ElementTree.indent(root)

    # The comment, and a test that the text is the design.
    notes = [
        f"A design of {robot.display_name}.",
        f"Inertias of {num_balanced} of {robot.num_bodies} bodies violated the triangle "
        "inequality and are balanced (replaced by their mean).",
    ]
    if num_tightened:
        notes.append(f"Limits of {num_tightened} joints had crossed and are tight around the mean.")
    text = f"{comment(' '.join(notes))}\n{ElementTree.tostring(root, encoding='unicode')}\n"
    _check(text, fields, robot)
    return text


def _reference_text(robot: Robot) -> str:
    """The robot's MJCF as MuJoCo writes it: one file, radians, resolved defaults and order."""
    spec = mujoco.MjSpec.from_string(robot.xml)
    # Settings with which a compiler would change the inertials that are written below.
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    spec.compiler.boundmass = spec.compiler.boundinertia = 0
    spec.compiler.settotalmass = -1
    spec.compiler.balanceinertia = False
    spec.compile()
    return spec.to_xml()


class _TreeWriter:
    """Writes the numbers of a design into the bodies of an MJCF tree and what they hold.

    MuJoCo's ids follow the order of the document, so that counting elements gives their ids.
    """

    def __init__(self, model: mujoco.MjModel, fields: dict[str, np.ndarray]):
        self.model, self.fields = model, fields
        self.next_id = dict.fromkeys(("body", "geom", "site", "joint", "camera"), 0)

    def write_body(self, element) -> None:
        """A body, by its element, and all below it."""
        model, fields = self.model, self.fields
        body = self._take("body")
        if body > 0:
            _set_pose(element, fields["body_pos"][body], fields["body_quat"][body])
        # All elements of a body come before its children in MuJoCo's order of ids.
        children = []
        for child in list(_unframed(element)):
            if child.tag == "body":
                children.append(child)
            elif child.tag == "geom":
                self._write_geom(child, self._take("geom"))
            elif child.tag == "site":
                site = self._take("site")
                _set_pose(child, fields["site_pos"][site], model.site_quat[site])
                child.set("size", _text(model.site_size[site]))
            elif child.tag == "camera":
                camera = self._take("camera")
                _set_pose(child, model.cam_pos[camera], model.cam_quat[camera])
            elif child.tag in ("joint", "freejoint"):
                self._write_joint(child, self._take("joint"))
        if body > 0:
            self._write_inertial(element, body)
        for child in children:
            self.write_body(child)

    def _take(self, kind: str) -> int:
        self.next_id[kind] += 1
        return self.next_id[kind] - 1

    def _write_inertial(self, element, body: int) -> None:
        fields = self.fields
        inertial = element.find("inertial")
        if inertial is None:
            inertial = ElementTree.Element("inertial")
            element.insert(0, inertial)
        inertial.attrib.pop("fullinertia", None)
        _set_pose(inertial, fields["body_ipos"][body], fields["body_iquat"][body])
        inertial.set("mass", _text(fields["body_mass"][body]))
        inertial.set("diaginertia", _text(fields["body_inertia"][body]))

    def _write_geom(self, element, geom: int) -> None:
        count = _SIZES.get(mujoco.mjtGeom(self.model.geom_type[geom]))
        if count is None:  # meshes and height fields keep their looks
            return
        _set_pose(element, self.fields["geom_pos"][geom], self.model.geom_quat[geom])
        element.set("size", _text(self.fields["geom_size"][geom][:count]))

    def _write_joint(self, element, joint: int) -> None:
        if self.model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
            return
        fields, dof = self.fields, self.model.jnt_dofadr[joint]
        element.set("pos", _text(fields["jnt_pos"][joint]))
        element.set("axis", _text(fields["jnt_axis"][joint]))
        element.set("limited", "true")
        element.set("range", _text(fields["jnt_range"][joint]))
        element.set("stiffness", _text(fields["jnt_stiffness"][joint]))
        for name in ("damping", "armature", "frictionloss"):
            element.set(name, _text(fields[f"dof_{name}"][dof]))


def _set_pose(element, pos, quat) -> None:
    """Position and orientation of an element, instead of any that it had."""
    for name in _ORIENTATIONS:
        element.attrib.pop(name, None)
    element.set("pos", _text(pos))
    element.set("quat", _text(quat))


def _unframed(element) -> Iterator:
    """Children of a body, those inside <frame> included; the frames lose their own pose."""
    for child in element:
        if child.tag == "frame":
            for name in ("pos", *_ORIENTATIONS):
                child.attrib.pop(name, None)
            yield from _unframed(child)
        else:
            yield child


def _text(values) -> str:
    """Shortest decimals that read back as the same float64."""
    return " ".join(repr(float(x)).removesuffix(".0") for x in np.ravel(values))


def _check(text: str, fields: dict[str, np.ndarray], robot: Robot) -> None:
    """Raise ValueError unless `text` compiles to `fields`."""
    try:
        model = mujoco.MjModel.from_xml_string(text)
    except ValueError as error:
        raise ValueError(f"the MJCF of this design of {robot.name!r} does not compile") from error
    for name, expected in fields.items():
        value = getattr(model, name)
        if value.shape != expected.shape or not np.allclose(value, expected, 1e-6, 1e-9):
            raise ValueError(
                f"the MJCF of this design of {robot.name!r} compiles to another {name}; expected "
                "an MJCF file of the robot with one element per body, joint and geom: remove "
                "<compiler> options and elements that merge, replicate or attach bodies"
            )
