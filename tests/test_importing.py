"""Importing: what is beside the point in a file costs nothing, and feet are what bears weight."""

import itertools
import struct

import mujoco
import numpy as np
import pytest

from shapebody.robot.report import validate_robot
from shapebody.robot.robot import load_robot

LINK = """
  <link name="{name}"><inertial><mass value="{mass}"/>
    <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial>{shapes}</link>"""
HINGE = """
  <joint name="{child}_joint" type="revolute"><parent link="{parent}"/><child link="{child}"/>
    <origin xyz="{xyz}"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="20" velocity="10"/></joint>"""
FIXED = """
  <joint name="{child}_mount" type="fixed"><parent link="{parent}"/><child link="{child}"/>
    <origin xyz="{xyz}"/></joint>"""
TRUNK = '<collision><geometry><box size="0.2 0.3 0.1"/></geometry></collision>'
ROD = (
    '<collision><origin xyz="0 0 -0.15"/><geometry><cylinder radius="0.02" length="0.2"/>'
    "</geometry></collision>"
)
SOLE = (
    '<collision><origin xyz="0.02 0 -0.03"/><geometry><box size="0.16 0.06 0.03"/></geometry>'
    "</collision>"
)


def mesh(file, kind="collision", scale=""):
    return (
        f'<{kind}><geometry><mesh filename="{file}" {scale}/></geometry></{kind}>' if file else ""
    )


def visual(geometry, rest=""):
    return f"<visual><geometry>{geometry}</geometry>{rest}</visual>"


def biped(folder, shin=ROD, sole=SOLE, frame=None, extra="", name="biped.urdf"):
    """Path of a URDF biped: legs of thigh, shin and sole (none if None), and perhaps a fixed link
    "l_foot" on each leg: `frame` is its parent, its place and its shapes."""
    text = LINK.format(name="base", mass=4, shapes=TRUNK)
    for side, y in (("l", 0.1), ("r", -0.1)):
        chain = [("thigh", 1, ROD, f"0 {y} 0", "base"), ("shin", 0.6, shin, "0 0 -0.3", "thigh")]
        if sole is not None:
            chain += [("sole", 0.1, sole, "0 0 -0.3", "shin")]
        for part, mass, shapes, place, parent in chain:
            above = parent if parent == "base" else f"{side}_{parent}"
            text += LINK.format(name=f"{side}_{part}", mass=mass, shapes=shapes)
            text += HINGE.format(parent=above, child=f"{side}_{part}", xyz=place)
        if frame is not None:
            parent, place, shapes = frame
            text += f'<link name="{side}_foot">{shapes}</link>'
            text += FIXED.format(parent=f"{side}_{parent}", child=f"{side}_foot", xyz=place)
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f'<robot name="biped">{extra}{text}</robot>')
    return path


def decorated(folder, shapes, extra="", **kind):
    """As `biped`, with one more link that is only for looks."""
    logo = f'<link name="logo">{shapes}</link>'
    logo += FIXED.format(parent="base", child="logo", xyz="0.1 0 0")
    return biped(folder, extra=extra + logo, **kind)


def stl(low, high):
    """Binary STL of a box."""
    corners = np.array([[(low, high)[(i >> k) & 1][k] for k in range(3)] for i in range(8)])
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    return triangles([corners[list(q)][i] for q in quads for i in ([0, 2, 1], [0, 3, 2])])


def triangles(faces):
    body = b"".join(struct.pack("<12fH", 0, 0, 0, *np.ravel(face), 0) for face in faces)
    return bytes(80) + struct.pack("<I", len(faces)) + body


SHANK = stl((-0.01, -0.01, -0.2), (0.01, 0.01, 0))
SQUARE = np.array([[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0]])
ASCII = "solid a\n" + "".join(
    "facet normal 0 0 1\nouter loop\n"
    + "".join(f"vertex {x} {y} {z}\n" for x, y, z in SQUARE[face])
    + "endloop\nendfacet\n"
    for face in ([0, 1, 2], [0, 2, 3])
)
BROKEN = {
    "flat.stl": triangles([SQUARE[[0, 1, 2]]]),
    "square.stl": triangles([SQUARE[[0, 1, 2]], SQUARE[[0, 2, 3]]]),
    "ascii.stl": (ASCII + "endsolid a\n").encode(),
    "cut_off.stl": SHANK[:-30],
    "empty.stl": b"",
    "text.obj": b"hello",
}


def feet(robot):
    """Name, body, type, size and lowest point (in the trunk at home) of each foot."""
    model = robot.model
    return {
        model.geom(int(i)).name: (
            model.body(int(model.geom_bodyid[i])).name,
            mujoco.mjtGeom(model.geom_type[i]).name.removeprefix("mjGEOM_").lower(),
            model.geom_size[i],
        )
        for i in robot.feet
    }


def noted(robot, *texts):
    """Whether one note has all the texts."""
    return any(all(text in note for text in texts) for note in robot.inferred)


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    return load_robot(biped(tmp_path_factory.mktemp("plain")))


def assert_same(robot, plain):
    """The robot is the plain one: nothing but the notes may differ."""
    assert robot.num_feet == plain.num_feet and robot.model.ngeom == plain.model.ngeom
    for name in ("body_mass", "body_inertia", "geom_size", "geom_pos", "jnt_range"):
        np.testing.assert_array_equal(getattr(robot.model, name), getattr(plain.model, name))


# Comments.


@pytest.mark.parametrize(
    "comment",
    [
        '<!-- <xacro:leg prefix="l"/> was expanded below -->',
        "<!--\n<xacro:macro>\n-->\n<!-- <xacro:leg/> -->",
        '<!-- <robot name="old"> <link name="base"/> -->',
        '<!-- <mujoco><compiler meshdir="x"/></mujoco> -->',
        "<!-- <include file='x'/> > --><!---->",
        "<!-- <![CDATA[ --><?xacro <xacro:leg/> ?>",
    ],
)
def test_comments_say_nothing(tmp_path, plain, comment):
    path = biped(tmp_path)
    path.write_text(comment + biped(tmp_path).read_text().replace("</robot>", comment + "</robot>"))
    robot = load_robot(path)
    assert_same(robot, plain)
    assert robot.inferred == plain.inferred


@pytest.mark.parametrize(
    "old, new",
    [
        ("<robot", '<robot xmlns="http://www.ros.org"'),
        ("<robot", '<robot xmlns:xacro="http://ros.org/wiki/xacro"'),
        ("</robot>", "<gazebo><lidar:noise/></gazebo></robot>"),  # a prefix that nothing declares
    ],
)
def test_namespaces_say_nothing(tmp_path, plain, old, new):
    path = decorated(tmp_path, visual('<box size="0.1 0.1 0.1"/>'))
    path.write_text(path.read_text().replace(old, new))
    robot = load_robot(path)
    assert robot.model.ngeom == plain.model.ngeom + 1 and robot.num_feet == 2
    assert list(robot.velocity_limits[:2]) in ([10, 10], [15, 15])


def test_what_plugins_hold_says_nothing(tmp_path, plain):
    extra = "<gazebo><![CDATA[ <xacro:leg/> <link name='a'/> <!-- ]]></gazebo>"
    assert_same(load_robot(biped(tmp_path, extra=extra)), plain)


@pytest.mark.parametrize("expression", ["${width}", "$(arg width)"])
def test_expressions_of_a_template_are_named(tmp_path, expression):
    path = biped(tmp_path)
    path.write_text(path.read_text().replace('xyz="0 0.1 0"', f'xyz="0 {expression} 0"'))
    with pytest.raises(ValueError, match="part of a xacro template: expand it"):
        load_robot(path)


def test_a_template_is_a_template(tmp_path):
    path = biped(tmp_path, extra="<!-- a --><xacro:leg/><!-- b -->")
    with pytest.raises(ValueError, match="xacro template"):
        load_robot(path)


# Shapes that are only for looks.

ZERO = {
    "box": '<box size="0 0 0"/>',
    "one side": '<box size="0.1 0.1 0"/>',
    "negative": '<box size="-1 1 1"/>',
    "sphere": '<sphere radius="0"/>',
    "cylinder": '<cylinder radius="0.1" length="0"/>',
    "no number": '<box size="nan 1 1"/>',
    "endless": '<sphere radius="inf"/>',
    "endless mesh": '<mesh filename="shank.stl" scale="1e39 1 1"/>',
    "long name": f'<mesh filename="{"a" * 300}.stl"/>',
    "too few": '<box size="1 1"/>',
    "letters": '<box size="a b c"/>',
    "nothing": "",
    "unknown": "<cone/>",
    "no file": "<mesh/>",
    "empty name": '<mesh filename=""/>',
    "missing": '<mesh filename="package://r/lost.stl"/>',
    "flattened": '<mesh filename="shank.stl" scale="1 0 1"/>',
}


@pytest.mark.parametrize("case", ZERO)
def test_a_broken_visual_goes_alone_and_its_link_is_named(tmp_path, plain, case):
    (tmp_path / "shank.stl").write_bytes(SHANK)
    good = visual('<box size="0.05 0.05 0.05"/>')
    robot = load_robot(decorated(tmp_path, visual(ZERO[case]) + good))
    assert noted(robot, "logo", "cannot be") or noted(robot, "logo", "not found")
    assert not any("l_shin" in note and "cannot be" in note for note in robot.inferred)
    # The other visual of the link and all that collides are there.
    assert robot.model.ngeom == plain.model.ngeom + 1
    assert feet(robot).keys() == feet(plain).keys()


@pytest.mark.parametrize("file", BROKEN)
def test_a_broken_mesh_leaves_the_others(tmp_path, file):
    (tmp_path / "shank.stl").write_bytes(SHANK)
    for name, data in BROKEN.items():
        (tmp_path / name).write_bytes(data)
    shapes = mesh(file, "visual")
    robot = load_robot(decorated(tmp_path, shapes, shin=mesh("shank.stl"), sole=None))
    assert noted(robot, file, "link logo") and not noted(robot, "shank.stl")
    assert {part[0] for part in feet(robot).values()} == {"l_shin", "r_shin"}
    # As a shape of the legs it is named as the reason why there are no feet.
    path = biped(tmp_path, shin=mesh(file), sole=None)
    with pytest.raises(ValueError, match=f"no foot where legs end in l_shin, r_shin.*{file}"):
        load_robot(path)


def test_a_collision_of_no_size_is_named(tmp_path):
    path = biped(tmp_path, sole=SOLE.replace("0.16 0.06 0.03", "0.16 0 0.03"))
    with pytest.raises(ValueError, match="size 1 must be positive.*l_sole"):
        load_robot(path)


def test_visuals_of_mjcf(tmp_path):
    (tmp_path / "flat.stl").write_bytes(BROKEN["flat.stl"])
    (tmp_path / "shank.stl").write_bytes(SHANK)
    looks = (
        '<geom type="mesh" mesh="flat" contype="0" conaffinity="0"/>'
        '<geom type="box" size="0 0.1 0.1" contype="0" conaffinity="0"/>'
    )
    text = walker(shin='<geom type="mesh" mesh="shank"/>', trunk=looks).replace(
        "<worldbody>",
        '<asset><mesh name="flat" file="flat.stl"/><mesh name="shank" file="shank.stl"/>'
        '<texture name="t" type="2d" file="lost.png"/><material name="m" texture="t"/>'
        "</asset><worldbody>",
    )
    (tmp_path / "walker.xml").write_text(text)
    robot = load_robot(tmp_path / "walker.xml")
    assert noted(robot, "flat.stl (body trunk)", "lost.png") and not noted(robot, "shank.stl")
    assert noted(robot, "visual of body trunk is a box of size 0 0.1 0.1")
    assert robot.num_feet == 4


def walker(shin="", trunk="", extra="", foot='<geom type="sphere" size="0.02" pos="0 0 -0.2"/>'):
    """MJCF text of a quadruped; `extra` hangs from its trunk."""
    legs = "".join(
        f"""<body name="{name}_thigh" pos="{x} {y} 0"><joint name="{name}_hip" axis="0 1 0"
        range="-60 60" armature="0.01"/><geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.2"
        mass="0.4"/><body name="{name}_shin" pos="0 0 -0.2"><joint name="{name}_knee" axis="0 1 0"
        range="-100 60" armature="0.01"/><inertial mass="0.2" pos="0 0 -0.1"
        diaginertia="0.001 0.001 0.0001"/>{shin or foot}</body></body>"""
        for name, x, y in (
            ("fl", 0.2, 0.1),
            ("fr", 0.2, -0.1),
            ("rl", -0.2, 0.1),
            ("rr", -0.2, -0.1),
        )
    )
    return f"""<mujoco model="walker"><worldbody><body name="trunk" pos="0 0 0.42"><freejoint/>
    <geom type="box" size="0.2 0.1 0.05" mass="4"/>{trunk}{legs}{extra}</body>
    </worldbody></mujoco>"""


TWO = '<material name="a"><color rgba="1 0 0 1"/></material><material name="b"/>'


@pytest.mark.parametrize(
    "rest, extra, advice",
    [
        (TWO, "", "link logo has more than one <material>"),
        ('<material name="a"><color rgba="1 0"/></material>', "", "<color rgba> four numbers"),
        ("", '<material name="a"><color rgba="1 x 0 1"/></material>', "<color rgba> four numbers"),
    ],
)
def test_materials_get_advice_and_cost_nothing(tmp_path, plain, rest, extra, advice):
    shapes = visual('<box size="0.1 0.1 0.1"/>', rest)
    robot = load_robot(decorated(tmp_path, shapes, extra=extra))
    assert noted(robot, advice) and robot.model.ngeom == plain.model.ngeom + 1


def test_other_errors_keep_the_line_of_the_file(tmp_path):
    path = biped(tmp_path)
    text = path.read_text().replace('<robot name="biped">', '<robot\n\nname="biped">\n<!--\n-->')
    text = text.replace('<axis xyz="0 1 0"/>', '<axis xyz="0 1"/>', 1)
    path.write_text(text)
    line = 1 + text[: text.index('<axis xyz="0 1"/>')].count("\n")
    with pytest.raises(ValueError, match=f"'axis', line {line}"):
        load_robot(path)


# Where meshes are.

PLACES = {
    "beside": ("meshes/shank.stl", "meshes/shank.stl", ""),
    "package": ("meshes/shank.stl", "package://r/meshes/shank.stl", ""),
    "meshdir": ("parts/x/shank.stl", "package://else/shank.stl", 'meshdir="parts/x"'),
    "meshdir above": ("../parts/shank.stl", "shank.stl", 'meshdir="../parts" strippath="true"'),
    "assetdir": ("parts/shank.stl", "some/where/shank.stl", 'assetdir="parts"'),
    "whole path": ("parts/a/shank.stl", "a/shank.stl", 'meshdir="parts" strippath="false"'),
    "stripped": ("parts/shank.stl", "a/shank.stl", 'meshdir="parts" strippath="true"'),
}


@pytest.mark.parametrize("case", PLACES)
def test_meshes_are_found_where_the_file_says(tmp_path, case):
    place, name, settings = PLACES[case]
    wide = stl((-0.03, -0.03, -0.2), (0.03, 0.03, 0))
    places = {place: SHANK}
    if settings:  # others of the same name, which are not meant
        places |= {"shank.stl": wide}
    if case == "whole path":
        places |= {"parts/shank.stl": wide}
    if case == "stripped":
        places |= {"parts/a/shank.stl": wide}
    for where, data in places.items():
        path = tmp_path / "urdf" / where
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    extension = f"<mujoco><compiler {settings}/></mujoco>" if settings else ""
    path = biped(tmp_path, mesh(name), None, extra=extension, name="urdf/biped.urdf")
    sizes = [part[2][0] for part in feet(load_robot(path)).values()]
    np.testing.assert_allclose(sizes, [0.01, 0.01], atol=1e-6)


def test_meshes_of_one_name_in_two_folders_are_two(tmp_path):
    for folder, wide in (("visual", 0.03), ("collision", 0.01)):
        (tmp_path / folder).mkdir()
        data = stl((-wide, -wide, -0.2), (wide, wide, 0))
        (tmp_path / folder / "shank.stl").write_bytes(data)
    shin = mesh("visual/shank.stl", "visual") + mesh("collision/shank.stl")
    robot = load_robot(biped(tmp_path, shin, None))
    np.testing.assert_allclose([part[2][0] for part in feet(robot).values()], 0.01, atol=1e-6)


@pytest.mark.parametrize("settings, shown", [("", 1), ('discardvisual="true"', 0)])
def test_visuals_stay_unless_the_file_discards_them(tmp_path, plain, settings, shown):
    extension = f'<mujoco><compiler meshdir="x" {settings}/></mujoco>'
    robot = load_robot(decorated(tmp_path, visual('<box size="1 1 1"/>'), extra=extension))
    assert robot.model.ngeom == plain.model.ngeom + shown


def test_missing_meshes_are_the_reason_why_there_is_no_foot(tmp_path):
    lost = mesh("package://r/meshes/lost.dae")
    for sole, shin, links in ((None, lost, "l_shin, r_shin"), (lost, ROD, "l_sole, r_sole")):
        report = validate_robot(biped(tmp_path, shin, sole))
        (problem,) = report.problems
        assert "lost.dae" in problem and links in problem and "<collision>" in problem
    # One leg that is lost is not made up for by the other, nor legs by an arm.
    path = biped(tmp_path, shin=lost, sole=None)
    text = path.read_text()
    path.write_text(text.replace(lost, ROD, 1))
    with pytest.raises(ValueError, match="legs end in r_shin"):
        load_robot(path)
    arm = LINK.format(name="arm", mass=1, shapes=ROD)
    arm += HINGE.format(parent="base", child="arm", xyz="0 0.2 0.1")
    path.write_text(text.replace("</robot>", f"{arm}</robot>"))
    with pytest.raises(ValueError, match="legs end in l_shin, r_shin"):
        load_robot(path)
    # An arm whose mesh is lost is no leg.
    path = biped(tmp_path)
    arm = arm.replace(ROD, lost)
    path.write_text(path.read_text().replace("</robot>", f"{arm}</robot>"))
    robot = load_robot(path)
    assert robot.num_feet == 2 and noted(robot, "lost.dae (link arm)")


# Feet.

MARKER = visual('<sphere radius="0.01"/>')
FRAMES = {
    "marker on the sole": (("sole", "0.02 0 -0.045", MARKER), "sole"),
    "marker without a size": (("sole", "0.02 0 -0.045", visual('<box size="0 0 0"/>')), "sole"),
    "large marker": (("sole", "0.02 0 -0.045", visual('<sphere radius="0.03"/>')), "sole"),
    "frame at the sole": (("sole", "0.02 0 -0.045", ""), "sole"),
    "frame inside of the sole": (("sole", "0 0 -0.03", ""), "sole"),
    "frame at the ankle": (("sole", "0 0 0", ""), "sole"),
    "frame on the shin": (("shin", "0.02 0 -0.345", ""), "sole"),
    "missing mesh": (("sole", "0.02 0 -0.04", mesh("lost.stl", "visual")), "sole"),
    # What is below all that collides is a foot, whatever it is made of.
    "frame far below": (("sole", "0 0 -0.2", ""), "ball"),
    "collision below": (("sole", "0 0 -0.2", MARKER.replace("visual", "collision")), "ball"),
}


@pytest.mark.parametrize("case", FRAMES)
def test_a_frame_or_marker_does_not_replace_the_sole(tmp_path, case):
    frame, expected = FRAMES[case]
    robot = load_robot(biped(tmp_path, frame=frame))
    found = feet(robot)
    assert list(found) == ["l_foot", "r_foot"]
    for body, kind, size in found.values():
        assert body.endswith("_sole")
        if expected == "sole":
            assert kind == "box"
            np.testing.assert_allclose(size, [0.08, 0.03, 0.015])
        else:
            assert kind == "sphere"
    assert noted(robot, "links l_foot, r_foot have no <collision>", "beside") == (
        expected == "sole"
    )


def test_several_frames_of_one_leg(tmp_path):
    # Two markers, more than the link with the sole has shapes.
    path = biped(tmp_path, sole="", frame=("sole", "0 0 0", SOLE))
    links = "".join(
        f'<link name="{side}_foot_frame">{MARKER * 2}</link>'
        + FIXED.format(parent=f"{side}_foot", child=f"{side}_foot_frame", xyz="0 0 -0.045")
        for side in "lr"
    )
    path.write_text(path.read_text().replace("</robot>", f"{links}</robot>"))
    assert [kind for _, kind, _ in feet(load_robot(path)).values()] == ["box", "box"]


MARKED = '<geom name="{}_foot" type="sphere" size="0.01" pos="0 0 -0.22" {}/>'
UNSEEN = 'contype="0" conaffinity="0"'


@pytest.mark.parametrize("fixed", [False, True])
def test_markers_of_mjcf(tmp_path, fixed):
    path = tmp_path / "walker.xml"
    ball = '<geom type="sphere" size="0.02" pos="0 0 -0.2"/>'
    text = walker(foot=f"{ball}MARKER")
    for leg in ("fl", "fr", "rl", "rr"):
        marker = MARKED.format(leg, UNSEEN)
        marker = f'<body name="{leg}_frame">{marker}</body>' if fixed else marker
        text = text.replace("MARKER", marker, 1)
    path.write_text(text)
    robot = load_robot(path)
    found = feet(robot)
    assert list(found) == [f"{leg}_foot" for leg in ("fl", "fr", "rl", "rr")]
    assert all(size[0] == 0.02 for _, _, size in found.values())
    assert noted(robot, "touch nothing", "fl_foot")
    # Named, and in contact with the floor, by itself or by a pair: as the file says.
    path.write_text(text.replace(UNSEEN, ""))
    assert all(size[0] == 0.01 for _, _, size in feet(load_robot(path)).values())


SHINS = {
    "mesh": (SHANK, 0),
    "wide mesh": (stl((-0.04, -0.03, -0.2), (0.04, 0.03, 0)), 0),
    "mesh that leans": (SHANK, 0.5),
    "box": (None, 0),
    "box that leans": (None, 0.5),
}


@pytest.mark.parametrize("case", SHINS)
def test_the_foot_of_a_shank_is_its_lower_end(tmp_path, case):
    data, pitch = SHINS[case]
    if data:
        (tmp_path / "shank.stl").write_bytes(data)
        shin = mesh("shank.stl")
    else:
        shin = SOLE.replace("0.16 0.06 0.03", "0.02 0.03 0.2").replace("0.02 0 -0.03", "0 0 -0.1")
    path = biped(tmp_path, shin, None)
    text = path.read_text()
    for side in "lr":  # shins that lean in the zero pose
        joint = f'<child link="{side}_shin"/>\n    <origin xyz="0 0 -0.3"'
        assert joint in text
        text = text.replace(joint, f'{joint} rpy="0 {pitch} 0"')
    path.write_text(text)
    robot = load_robot(path)
    assert noted(robot, "the lower end of a ")
    data = mujoco.MjData(robot.model)
    data.qpos[:] = robot.home
    mujoco.mj_kinematics(robot.model, data)
    assert robot.num_feet == 2
    for foot in robot.feet:
        frame, size = data.geom_xmat[foot].reshape(3, 3), robot.model.geom_size[foot]
        box = robot.model.geom_type[foot] == mujoco.mjtGeom.mjGEOM_BOX
        half = np.abs(frame[2]) @ size if box else size[0]
        assert half <= 0.025
        # It is where the shank ends.
        where = data.geom_xpos[foot] - data.xpos[robot.model.geom_bodyid[foot]]
        end = np.array([-np.sin(pitch), 0, -np.cos(pitch)]) * 0.2
        assert np.linalg.norm(where - end) < 0.05
        np.testing.assert_allclose(data.geom_xpos[foot, 2] - half, 0, atol=0.01)
    # The shank is still seen.
    shin = robot.model.body("l_shin").id
    assert np.sum(robot.model.geom_bodyid == shin) == 2


def test_low_feet_stay_whole(tmp_path):
    (tmp_path / "boot.stl").write_bytes(stl((-0.06, -0.03, -0.05), (0.1, 0.03, 0)))
    robot = load_robot(biped(tmp_path, sole=mesh("boot.stl")))
    for _, kind, size in feet(robot).values():
        assert kind == "box"
        np.testing.assert_allclose(np.sort(size), [0.025, 0.03, 0.08], atol=1e-6)


TAIL = """<body name="tail" pos="{root}"><joint name="tail_pitch" axis="0 1 0" range="-40 40"
armature="0.01"/><geom type="capsule" size="0.02" fromto="0 0 0 {end}" mass="{mass}"/>
{more}</body>"""
SECOND = """<body name="tail_tip" pos="-0.15 0 -0.2"><joint name="tip" axis="0 1 0" range="-40 40"
armature="0.01"/><geom type="capsule" size="0.02" fromto="0 0 0 -0.1 0 -0.22"
mass="0.1"/></body>"""
IDLE = {
    "as low as the legs": ("-0.2 0 0.05", "-0.3 0 -0.42", 0.2, ""),
    "a little higher": ("-0.2 0 0.05", "-0.3 0 -0.41", 0.2, ""),
    "lower than the legs": ("-0.2 0 0.05", "-0.1 0 -0.65", 0.2, ""),
    "of two joints": ("-0.2 0 0.05", "-0.15 0 -0.2", 0.1, SECOND),
    "a trunk at the front": ("0.2 0 0.05", "0.3 0 -0.42", 0.2, ""),
}


@pytest.mark.parametrize("case", IDLE)
def test_a_tail_is_no_foot(tmp_path, case):
    root, end, mass, more = IDLE[case]
    path = tmp_path / "walker.xml"
    tail = TAIL.format(root=root, end=end, mass=mass, more=more)
    path.write_text(walker(extra=tail))
    report = validate_robot(path)
    assert report.ok and report.robot.num_feet == 4
    assert noted(report.robot, "tail that bears no weight")
    assert not any("reach the floor like legs" in warning for warning in report.warnings)
    # What is named is a foot.
    named = '<geom name="tail_foot"'.join(tail.rsplit("<geom", 1))
    path.write_text(walker(extra=named, foot='<geom name="F" size="0.02" pos="0 0 -0.2"/>'))
    text = path.read_text()
    for leg in "abcd":
        text = text.replace('name="F"', f'name="{leg}_foot"', 1)
    path.write_text(text)
    assert load_robot(path).num_feet == 5


def test_a_tail_that_bears_weight_is_a_foot(tmp_path):
    # The hind legs are gone: what is left stands on the front legs and the tail.
    path = tmp_path / "walker.xml"
    text = walker(extra=TAIL.format(root="-0.2 0 0.05", end="-0.1 0 -0.45", mass=0.5, more=""))
    start, end = text.index('<body name="rl_thigh"'), text.index('<body name="tail"')
    path.write_text(text[:start] + text[end:])
    robot = load_robot(path)
    assert [body for body, _, _ in feet(robot).values()] == ["fl_shin", "fr_shin", "tail"]


@pytest.mark.parametrize("count", [3, 5, 6])
def test_no_leg_of_a_star_is_a_tail(tmp_path, count):
    angles = 2 * np.pi * np.arange(count) / count
    text = walker()
    start, end = text.index('<body name="fl_thigh"'), text.rindex("</body>")
    legs = "".join(
        f'<body name="arm{i}" pos="{np.cos(a):.6f} {np.sin(a):.6f} 0"><joint name="j{i}" '
        'axis="0 1 0" range="-60 60" armature="0.01"/><geom type="capsule" size="0.02" '
        'fromto="0 0 0 0 0 -0.4" mass="0.3"/></body>'
        for i, a in enumerate(angles)
    )
    path = tmp_path / "star.xml"
    path.write_text(text[:start] + legs + text[end:])
    assert load_robot(path).num_feet == count


def test_a_leg_unlike_its_partner_is_a_leg(tmp_path):
    # A longer thigh and a shorter shin: other lengths than those of all other legs.
    text = walker()
    text = text.replace('name="fl_thigh" pos="0.2 0.1 0"', 'name="fl_thigh" pos="0.3 0.12 0"')
    path = tmp_path / "walker.xml"
    path.write_text(text)
    assert load_robot(path).num_feet == 4


# Links and joints.


@pytest.mark.parametrize("parent", ["world", "odom", "base_footprint"])
@pytest.mark.parametrize("between", [False, True])
def test_a_base_below_a_floating_joint(tmp_path, plain, parent, between):
    floating = FIXED.replace('"fixed"', '"floating"')
    extra = f'<link name="{parent}"/>'
    if between:
        extra += '<link name="frame"/>'
        extra += floating.format(parent=parent, child="frame", xyz="0 0 1")
        extra += FIXED.format(parent="frame", child="base", xyz="0 0 0.6")
    else:
        extra += floating.format(parent=parent, child="base", xyz="0 0 1")
    robot = load_robot(biped(tmp_path, extra=extra))
    assert_same(robot, plain)
    assert robot.model.body(1).name == "base" and robot.home[2] == plain.home[2]


NO_TREE = {
    "planar": ('<link name="odom"/>' + FIXED.replace('"fixed"', '"planar"'), "odom base", "planar"),
    "table": ('<link name="table"/>' + FIXED, "table base", "fixes the base 'base' to the world"),
    "no such link": (FIXED, "base hand", "has the child 'hand', which is not a link"),
    "two bases": ('<link name="spare"/>', None, "are not the child of any joint"),
    "circle": (FIXED, "l_sole base", "in a circle"),
    "own parent": ('<link name="q"/>' + FIXED, "q q", "'q' are below each other in a circle"),
    "two parents": (FIXED, "r_shin l_sole", "'l_sole' is the child of each of joints"),
}


@pytest.mark.parametrize("case", NO_TREE)
def test_links_that_do_not_form_a_tree(tmp_path, case):
    extra, ends, message = NO_TREE[case]
    parent, child = ends.split() if ends else ("", "")
    (problem,) = validate_robot(
        biped(tmp_path, extra=extra.format(parent=parent, child=child, xyz="0 0 1"))
    ).problems
    assert message in problem and "MuJoCo reports" not in problem


def test_a_chain_of_links_that_is_too_long(tmp_path):
    chain = ["base", *(f"c{i}" for i in range(1100))]
    extra = "".join(f'<link name="{name}"/>' for name in chain[1:])
    for parent, child in itertools.pairwise(chain):
        extra += FIXED.format(parent=parent, child=child, xyz="0 0 0")
    (problem,) = validate_robot(biped(tmp_path, extra=extra)).problems
    assert "a chain of 1,100 links: expected at most 1,000" in problem


def test_what_to_do_about_a_leg_without_a_foot(tmp_path):
    path = biped(tmp_path, frame=("sole", "0 0 -0.04", ""))
    path.write_text(path.read_text().replace("r_foot", "r_frame"))
    (text,) = [text for text in validate_robot(path).warnings if "have no foot" in text]
    assert "r_sole" in text and "unnamed" not in text and 'a link with "foot"' in text
