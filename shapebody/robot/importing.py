"""Robot files, MJCF or URDF, as specs that compile. Missing meshes do not prevent reading."""

import re
from pathlib import Path

import mujoco

from shapebody.robot.assets import check_lost, drop_unreadable
from shapebody.robot.finite import not_finite
from shapebody.robot.spec_edits import add_floor, listed, name_parts
from shapebody.robot.survey import MAX_DEPTH, MAX_NUMBERS, too_many
from shapebody.robot.urdf import float_base, import_urdf, prepared_urdf, urdf_root


def read(path: Path) -> tuple[str, mujoco.MjSpec, mujoco.MjModel, list[str]]:
    """Text, spec, compiled model and first notes of an MJCF or URDF file.

    Files from elsewhere can crash this process: `shapebody.robot.guard.admit` comes first. Raises
    ValueError, naming the fix, for a file that is not text, is empty, cut off or not valid.
    """
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{path} is not UTF-8 text (byte {error.start} is {error.object[error.start]:#04x}): "
            "expected an MJCF or URDF file; save it as UTF-8, or give the XML file that belongs "
            "to this binary file"
        ) from error
    if not text.strip():
        raise ValueError(f"{path} is empty: expected an MJCF or URDF file; write the robot to it")
    shown = _without_comments(text)
    if "<xacro:" in shown:
        raise ValueError(
            f"{path} is a xacro template: expected a URDF; expand it first with "
            "'xacro FILE > robot.urdf', where ROS is installed"
        )
    root = re.search(r"<([A-Za-z_][\w:.-]*)", shown)
    is_urdf = root.group(1) == "robot" if root else path.suffix.lower() == ".urdf"
    notes, lost = [], []
    if is_urdf:
        notes.append("the file is a URDF: it is imported by MuJoCo and completed as MJCF")
        text = prepared_urdf(path, shown, notes)

    # To a spec that compiles, without the meshes that cannot be read.
    try:
        if is_urdf:
            spec = import_urdf(path, text, notes, lost)
        elif path.suffix == ".xml":
            spec = mujoco.MjSpec.from_file(str(path))
        else:  # MuJoCo knows a file by this ending only
            spec = mujoco.MjSpec.from_string(text)
            spec.modelfiledir = str(path.parent.absolute())
        name_parts(spec)
        try:
            model = _compile(spec, notes)
        except ValueError:
            lost += drop_unreadable(spec, "link" if is_urdf else "body", notes)
            model = _compile(spec, notes)
        if is_urdf:
            float_base(spec, text, notes)
            model = _compile(spec, notes)
    except ValueError as error:
        kind = "URDF" if is_urdf else "MJCF"
        reason = _explained(error, kind, text)
        raise ValueError(f"{path} is not a valid {kind} file: {reason}") from error

    # What compiles and still cannot be used: too much to write, or legs that have lost their ends.
    require_writable(path, model)
    check_lost(path, model, lost, "link" if is_urdf else "body")
    if re.search(r"<include\s", shown):
        notes.append("other files are included: their text is merged into the completed file")
    return text, spec, model, notes


def require_writable(path: Path, model) -> None:
    """ValueError if the completed file of a compiled robot could not be read again."""
    num_joints = int((model.jnt_type != 0).sum())  # without the free joint
    if max(num_joints, model.nu) > MAX_NUMBERS:
        what = "joints" if num_joints > MAX_NUMBERS else "actuators"
        raise ValueError(too_many(path, max(num_joints, model.nu), what))
    depth = [0] * model.nbody
    for body in range(1, model.nbody):
        depth[body] = depth[model.body_parentid[body]] + 1
    if max(depth) > MAX_DEPTH:
        raise ValueError(
            f"{path} has a chain of {max(depth)} bodies: expected at most {MAX_DEPTH}, the depth "
            "that MuJoCo can read; merge bodies that do not move by themselves"
        )


_FIXES = {
    "repeated name": "each name may be used once per kind of element; rename one of the two",
    "moving bodies": "give every body that moves an <inertial> with mass and inertia > 0",
    "qpos size": "give each keyframe as many numbers as the robot has positions (7 for the free "
    "joint, then 1 per hinge); if it has them, the trunk lacks its <freejoint/>",
    "balanceinertia": 'correct the inertia, or let <compiler balanceinertia="true"/> repair it',
    "positive eigenvalues": "an inertia must be positive definite; correct the numbers, e.g. to "
    "those of a box of the same mass and size",
    "opening file": "put the included file where the text says; a file that includes others must "
    "have a name that ends in '.xml'",
    "model type": "expected <mujoco> (MJCF) or <robot> (URDF) as the first element: this is "
    "another kind of file",
    "XML parse error": "expected a complete XML file; it may be cut off, so look at the place that "
    "is named",
    "allocate memory": "its sizes and counts ask for more memory than there is: make them smaller",
    "root element not found": "expected a complete XML file with a <mujoco> or <robot> root",
}


_TOP_LEVEL = {
    "URDF": "the base floats by itself: remove the link above the floating joint, and the joint; "
    "between links that move give the joint type revolute",
    "MJCF": "a <freejoint/> belongs to a body directly in <worldbody>: take the body out of the "
    "one around it, or move the <freejoint/> to the outermost body",
}


def _explained(error: Exception, kind: str, text: str) -> str:
    """What MuJoCo reports about a file of a kind ("URDF" or "MJCF"), and the fix."""
    reason = " ".join(str(error).split())
    default = (
        "correct the reported element" if "Element" in reason else "correct what the message names"
    )
    fixes = {**_FIXES, "top level": _TOP_LEVEL[kind]}
    fix = next((fix for part, fix in fixes.items() if part in reason), default)
    root = urdf_root(text)
    wrong = [] if root is None else not_finite(root)
    if "bad format" in reason and re.search(r"\$[({]", text):
        fix = "this is part of a xacro template: expand it with 'xacro FILE > robot.urdf'"
    if wrong:
        fix = f"expected finite numbers, but {listed(wrong)}; correct them"
    return f"MuJoCo reports {reason!r}. {fix[0].upper()}{fix[1:]}"


_NO_ELEMENTS = {"<!--": "-->", "<![CDATA[": "]]>", "<?": "?>"}


def _without_comments(text: str) -> str:
    """The text of an XML file without its comments, CDATA and instructions, with the same lines."""
    parts, start, position = [], 0, 0
    while (opening := text.find("<", position)) >= 0:
        position = opening + 1
        word = next((word for word in _NO_ELEMENTS if text.startswith(word, opening)), None)
        if word is None or text.startswith("<?xml ", opening):
            continue
        parts.append(text[start:opening])
        closing = text.find(_NO_ELEMENTS[word], opening + len(word))
        if closing < 0:
            return "".join(parts)
        start = position = closing + len(_NO_ELEMENTS[word])
        parts.append("\n" * text.count("\n", opening, start))
    return "".join([*parts, text[start:]])


def _compile(spec, notes) -> mujoco.MjModel:
    """The compiled model, with a floor if contact pairs name one that is not there."""
    names = {geom.name for geom in spec.geoms}
    if any({pair.geomname1, pair.geomname2} - names == {"floor"} for pair in spec.pairs):
        notes.append(add_floor(spec))
    try:
        return spec.compile()
    except ValueError as error:
        first = error
    if "moving bodies" in str(first):
        # With tiny masses it compiles, and the checks can name every such body.
        spec.compiler.boundmass, spec.compiler.boundinertia = 1e-12, 1e-14
        return spec.compile()
    raise first
