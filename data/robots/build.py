"""Turn robot fact sheets (JSON) into MJCF files.

    python data/robots/build.py [names...] [--sheets FOLDER] [--out FOLDER]

Without names every sheet is built. SOURCES.md in the output folder is rewritten for all robots that
have both a sheet and an MJCF file. The result depends on the sheets only.

A sheet holds numbers only, in SI units and radians, quaternions (w, x, y, z). paper: gains, action
scale and counts that the paper prints. bodies: kinematic tree from the floating body "trunk", pos
and quat in the parent's frame, inertia as in MuJoCo (principal moments), shapes for looks only.
joints: hinges; actuated ones carry torque_limit (N m), velocity_limit (rad/s) and nominal position;
actuator_order is the order of actions. feet: the only geoms that touch the floor.
collision_spheres: for self-collision. imu_pos: in the trunk's frame. keep_nominal: joints that
should stay where they are (arms, head, waist). sources, estimated, notes: where it comes from.
"""

import argparse
import json
import os
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import mujoco
import numpy as np

FRICTION = "1 1 0.005 0.0001 0.0001"
LICENCES = Path(__file__).resolve().parent / "licences.json"
MATERIALS = {  # red, green, blue, alpha, specular
    "trunk": ("0.17 0.19 0.23 1", "0.35"),
    "motor": ("0.30 0.33 0.38 1", "0.4"),
    "link": ("0.78 0.80 0.83 1", "0.3"),
    "posture": ("0.45 0.57 0.70 1", "0.3"),
    "foot": ("0.93 0.44 0.13 1", "0.1"),
    "sphere": ("0.85 0.20 0.25 0.35", "0"),
}


def number(value: float) -> str:
    """Shortest text that reads back as the same double."""
    value = float(value)
    if value == 0:
        return "0"
    return repr(value).removesuffix(".0")


def numbers(values) -> str:
    return " ".join(number(value) for value in values)


def frame(pos, quat) -> dict[str, str]:
    """pos and quat attributes, without those that are MuJoCo's defaults."""
    attributes = {}
    if any(pos):
        attributes["pos"] = numbers(pos)
    if list(quat) != [1, 0, 0, 0]:
        attributes["quat"] = numbers(quat)
    return attributes


def foot_name(name: str) -> str:
    """Feet are recognised by "foot" in their name."""
    name = re.sub("foot", "foot", name, flags=re.IGNORECASE)
    return name if "foot" in name else f"{name}_foot"


def look_material(sheet: dict, body: dict, shape: dict, posture: set[str]) -> str:
    if body["parent"] is None:
        return "trunk"
    for foot in sheet["feet"]:
        reach = max(shape["size"]) if shape["type"] != "capsule" else sum(shape["size"])
        distance = np.linalg.norm(np.subtract(foot["pos"], shape["pos"]))
        if foot["body"] == body["name"] and distance < reach < 4 * max(foot["size"]):
            return "foot"  # a shoe: it may hide the foot geom
    if shape["type"] == "cylinder":
        return "motor"
    return "posture" if body["name"] in posture else "link"


def build(sheet: dict) -> str:
    """MJCF text of one fact sheet."""
    root = ET.Element("mujoco", model=sheet["name"])
    root.append(
        ET.Comment(
            f" {sheet['display_name']}. Made by data/robots/build.py; sources in SOURCES.md. "
            "SI units. "
        )
    )
    ET.SubElement(root, "compiler", angle="radian", autolimits="true")
    ET.SubElement(root, "option", timestep="0.005", density="1.2", viscosity="2e-5")
    statistic = ET.SubElement(root, "statistic")
    add_looks(root)
    world = ET.SubElement(root, "worldbody")
    ET.SubElement(
        world, "light", name="fill", directional="true", pos="0 0 4", dir="0.6 -0.3 -0.6",
        diffuse="0.25 0.25 0.28", castshadow="false",
    )  # fmt: skip
    ET.SubElement(world, "geom", {"name": "floor", "class": "floor"})
    feet, spheres, trunk = add_bodies(world, sheet)
    contact = ET.SubElement(root, "contact")
    for foot in feet:
        ET.SubElement(contact, "pair", geom1="floor", geom2=foot, condim="3", friction=FRICTION)
    add_actuators(root, sheet)
    add_sensors(root, feet, spheres, sheet["actuator_order"])
    keyframe = ET.SubElement(root, "keyframe")
    add_custom(root, sheet)

    model = mujoco.MjModel.from_xml_string(ET.tostring(root, encoding="unicode"))
    qpos, low, high = home(model, sheet, feet)
    nominal = {joint["name"]: joint["nominal"] for joint in sheet["joints"]}
    ctrl = [nominal[name] for name in sheet["actuator_order"]]
    ET.SubElement(keyframe, "key", name="home", qpos=numbers(qpos), ctrl=numbers(ctrl))
    extent = float(np.linalg.norm(high - low))
    middle = np.append(np.round((low + high)[:2] / 2, 2), round(float(qpos[2]) * 0.6, 2))
    statistic.set("center", numbers(middle))
    statistic.set("extent", number(round(extent, 2)))
    view = 1.35 * extent * np.array([0.74, -0.95, 0.36])
    trunk.find("camera").set("pos", numbers(np.round(view, 2)))
    # Shadows are sharp near a light's axis only, so the light follows the trunk.
    trunk.find("light").set("pos", numbers(np.round(1.5 * extent * np.array([0.4, -0.5, 1]), 2)))
    ET.indent(root, "  ")
    return ET.tostring(root, encoding="unicode").replace(" />", "/>") + "\n"


def add_looks(root: ET.Element) -> None:
    visual = ET.SubElement(root, "visual")
    for name, attributes in {
        "global": {"offwidth": "1280", "offheight": "960", "azimuth": "130", "elevation": "-18"},
        "headlight": {"ambient": "0.3 0.3 0.3", "diffuse": "0.3 0.3 0.3", "specular": "0 0 0"},
        "quality": {"shadowsize": "4096"},
        "rgba": {"haze": "0.86 0.90 0.95 1"},
    }.items():
        ET.SubElement(visual, name, attributes)
    asset = ET.SubElement(root, "asset")
    ET.SubElement(
        asset, "texture", name="sky", type="skybox", builtin="gradient",
        rgb1="0.86 0.90 0.95", rgb2="0.55 0.65 0.77", width="128", height="768",
    )  # fmt: skip
    ET.SubElement(
        asset, "texture", name="checker", type="2d", builtin="checker",
        rgb1="0.80 0.82 0.84", rgb2="0.70 0.73 0.76", width="256", height="256",
    )  # fmt: skip
    ET.SubElement(
        asset, "material", name="floor", texture="checker", texrepeat="2 2", texuniform="true"
    )
    for name, (rgba, specular) in MATERIALS.items():
        ET.SubElement(asset, "material", name=name, rgba=rgba, specular=specular)

    default = ET.SubElement(root, "default")
    ET.SubElement(default, "geom", contype="0", conaffinity="0")
    for name, attributes in {
        "floor": {"type": "plane", "size": "0 0 0.05", "material": "floor"},
        "look": {"group": "2", "material": "link"},
        "foot": {"group": "0", "material": "foot"},
        "sphere": {"type": "sphere", "group": "5", "material": "sphere"},
    }.items():
        ET.SubElement(ET.SubElement(default, "default", {"class": name}), "geom", attributes)


def add_bodies(world: ET.Element, sheet: dict) -> tuple[list[str], list[str], ET.Element]:
    """Add the tree; returns names of feet and spheres in MuJoCo order, and the trunk."""
    feet: list[str] = []
    spheres: list[str] = []
    kept = set(sheet["keep_nominal"])
    posture = {joint["body"] for joint in sheet["joints"] if joint["name"] in kept}

    def add(parent: ET.Element, body: dict) -> None:
        name = body["name"]
        attributes = {"name": name} | frame(body["pos"], body["quat"])
        element = ET.SubElement(parent, "body", attributes)
        if body["parent"] is None:
            element.set("pos", numbers(body["pos"]))
            ET.SubElement(element, "freejoint", name="root")
        ET.SubElement(
            element, "inertial", pos=numbers(body["ipos"]), quat=numbers(body["iquat"]),
            mass=number(body["mass"]), diaginertia=numbers(body["inertia"]),
        )  # fmt: skip
        for joint in sheet["joints"]:
            if joint["body"] == name:
                add_joint(element, joint)
        for shape in body["shapes"]:
            geom = {"class": "look", "type": shape["type"], "size": numbers(shape["size"])}
            material = look_material(sheet, body, shape, posture)
            geom |= frame(shape["pos"], shape["quat"])
            if material != "link":
                geom["material"] = material
            ET.SubElement(element, "geom", geom)
        for foot in sheet["feet"]:
            if foot["body"] == name:
                feet.append(foot_name(foot["name"]))
                geom = {"name": feet[-1], "class": "foot", "type": foot["type"]}
                geom |= {"size": numbers(foot["size"])} | frame(foot["pos"], foot["quat"])
                ET.SubElement(element, "geom", geom)
        for sphere in sheet["collision_spheres"]:
            if sphere["body"] == name:
                spheres.append(f"sphere_{len(spheres)}")
                geom = {"name": spheres[-1], "class": "sphere", "size": number(sphere["radius"])}
                ET.SubElement(element, "geom", geom | frame(sphere["pos"], [1, 0, 0, 0]))
        if body["parent"] is None:
            ET.SubElement(element, "site", name="imu", pos=numbers(sheet["imu_pos"]), size="0.01")
            ET.SubElement(
                element, "camera", name="track", mode="trackcom",
                xyaxes="0.79 0.61 0 -0.17 0.22 0.96",
            )  # fmt: skip
            ET.SubElement(
                element, "light", name="key", mode="trackcom", directional="true",
                dir="-0.4 0.5 -1", diffuse="0.6 0.6 0.6", specular="0.2 0.2 0.2",
            )  # fmt: skip
        for child in sheet["bodies"]:
            if child["parent"] == name:
                add(element, child)

    add(world, next(body for body in sheet["bodies"] if body["parent"] is None))
    return feet, spheres, world.find("body")


def add_joint(body: ET.Element, joint: dict) -> None:
    attributes = {"name": joint["name"]} | frame(joint["pos"], [1, 0, 0, 0])
    attributes |= {"axis": numbers(joint["axis"]), "range": numbers(joint["range"])}
    for key in ("damping", "armature", "stiffness", "frictionloss"):
        attributes[key] = number(joint[key])
    ET.SubElement(body, "joint", attributes)


def add_actuators(root: ET.Element, sheet: dict) -> None:
    actuators = ET.SubElement(root, "actuator")
    joints = {joint["name"]: joint for joint in sheet["joints"]}
    for name in sheet["actuator_order"]:
        limit = joints[name]["torque_limit"]
        ET.SubElement(
            actuators, "position", name=name, joint=name, kp=number(sheet["paper"]["p_gain"]),
            kv=number(sheet["paper"]["d_gain"]), forcerange=numbers([-limit, limit]),
        )  # fmt: skip


def add_sensors(root: ET.Element, feet: list, spheres: list, actuators: list) -> None:
    sensors = ET.SubElement(root, "sensor")

    def of_site(tag: str, name: str, **target: str) -> None:
        ET.SubElement(sensors, tag, name=name, **target)

    of_site("gyro", "imu_angular_velocity", site="imu")
    of_site("velocimeter", "imu_linear_velocity", site="imu")
    of_site("framepos", "imu_position", objtype="site", objname="imu")
    of_site("framequat", "imu_orientation", objtype="site", objname="imu")
    for tag, suffix, geoms in (
        ("framepos", "position", feet),
        ("framequat", "orientation", feet),
        ("framelinvel", "velocity", feet),
        ("framepos", "position", spheres),
    ):
        for geom in geoms:
            of_site(tag, f"{geom}_{suffix}", objtype="geom", objname=geom)
    for actuator in actuators:
        of_site("actuatorfrc", f"{actuator}_force", actuator=actuator)


def add_custom(root: ET.Element, sheet: dict) -> None:
    custom = ET.SubElement(root, "custom")
    joints = {joint["name"]: joint for joint in sheet["joints"]}
    order = sheet["actuator_order"]
    for name, values in {
        "action_scale": [sheet["paper"]["action_scale"]],
        "velocity_limits": [joints[joint]["velocity_limit"] for joint in order],
        "keep_nominal": [joint in sheet["keep_nominal"] for joint in order],
    }.items():
        ET.SubElement(custom, "numeric", name=name, data=numbers(values))
    ET.SubElement(custom, "text", name="display_name", data=sheet["display_name"])
    ET.SubElement(custom, "text", name="morphology", data=sheet["morphology"])


def home(model: mujoco.MjModel, sheet: dict, feet: list[str]):
    """Home qpos with the lowest foot point on the floor, and the corners of the bounding box."""
    data = mujoco.MjData(model)
    qpos = np.zeros(model.nq)
    qpos[3] = 1
    for joint in sheet["joints"]:
        qpos[model.joint(joint["name"]).qposadr[0]] = joint["nominal"] or 0
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    lowest = np.inf
    for foot in feet:
        geom = model.geom(foot).id
        size, rotation = model.geom_size[geom], data.geom_xmat[geom].reshape(3, 3)
        is_box = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX
        below = np.abs(rotation[2]) @ size if is_box else size[0]
        lowest = min(lowest, data.geom_xpos[geom, 2] - below)
    qpos[2] = round(-lowest, 8)
    moving = model.geom_bodyid > 0
    return qpos, data.geom_xpos[moving].min(axis=0), data.geom_xpos[moving].max(axis=0)


def licence(source: dict, licences: dict) -> str:
    """Licence of a source in words; a repository of many robots may have one per folder."""
    folder = f"{source['repo']}/{source['path'].split('/')[0]}"
    found = licences.get(folder) or licences.get(source["repo"])
    return (
        f"licence: {found['licence']}, read in {found['read_in']}" if found else "licence not found"
    )


def sources(sheets: list[dict], licences: dict) -> str:
    """Markdown page with the sources and estimates of the given robots."""
    lines = [
        "# Robots and their sources",
        "",
        "Every robot file contains numbers (lengths, masses, inertias, limits) that were read from",
        "the public descriptions named below; shapes are plain primitives, without meshes or",
        "textures. `d` is the dimension of the design vector.",
        "",
        "Gains, action scale, number of actuators and `d` are those of the paper. What the sources",
        "do not give, or what was chosen, is listed as estimated. No file was copied. Licences",
        "are those of the sources, as far as one was found, for those who go back to them.",
        "",
    ]
    for sheet in sheets:
        paper = sheet["paper"]
        lines += [
            f"## {sheet['display_name']} (`{sheet['name']}`)",
            "",
            f"{sheet['morphology'].capitalize()}, {paper['n_actuated']} actuated joints, "
            f"{len(sheet['feet'])} feet, d = {paper['d_design']}.",
            "",
        ]
        lines += [
            f"- Source: {source['repo']}, `{source['path']}` ({source['use']}; "
            f"{licence(source, licences)})"
            for source in sheet["sources"]
        ]
        estimated = "; ".join(sheet["estimated"]) or "nothing besides the shapes drawn for looks"
        lines.append(f"- Estimated: {estimated}")
        if sheet["notes"]:
            lines.append(f"- Notes: {sheet['notes']}")
        lines.append("")
    return "\n".join(lines).rstrip() + "\n"


def write(path: Path, text: str) -> None:
    partial = path.with_name(path.name + ".tmp")
    partial.write_text(text, encoding="utf-8")
    os.replace(partial, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    here = Path(__file__).resolve().parent
    parser.add_argument("names", nargs="*", help="robots to build; default all")
    parser.add_argument("--sheets", type=Path, default=here / "sheets", help="one JSON per robot")
    parser.add_argument("--out", type=Path, default=here)
    arguments = parser.parse_args()
    sheets = {path.stem: path for path in sorted(arguments.sheets.glob("*.json"))}
    unknown = [name for name in arguments.names if name not in sheets]
    if unknown or not sheets:
        parser.error(f"no fact sheet for {unknown or 'any robot'} in {arguments.sheets}")
    for name in arguments.names or sheets:
        sheet = json.loads(sheets[name].read_text(encoding="utf-8"))
        write(arguments.out / f"{name}.xml", build(sheet))
        print(f"{name}.xml")
    built = [path for name, path in sheets.items() if (arguments.out / f"{name}.xml").exists()]
    pages = [json.loads(path.read_text(encoding="utf-8")) for path in built]
    licences = json.loads(LICENCES.read_text(encoding="utf-8"))
    write(arguments.out / "SOURCES.md", sources(pages, licences))


if __name__ == "__main__":
    main()
