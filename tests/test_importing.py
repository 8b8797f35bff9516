"""Importing: what a file says beside the point costs nothing, and feet are what bears the weight."""

import struct

import mujoco
import numpy as np
import pytest

from shapebody.robots import load_robot
from shapebody.validation import validate_robot

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
    ],
)
def test_comments_say_nothing(tmp_path, plain, comment):
    path = biped(tmp_path)
    path.write_text(comment + biped(tmp_path).read_text().replace("</robot>", comment + "</robot>"))
    robot = load_robot(path)
    assert_same(robot, plain)
    assert robot.inferred == plain.inferred


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
        for name, x, y in (("fl", 0.2, 0.1), ("fr", 0.2, -0.1), ("rl", -0.2, 0.1), ("rr", -0.2, -0.1))
    )
    return f"""<mujoco model="walker"><worldbody><body name="trunk" pos="0 0 0.42"><freejoint/>
    <geom type="box" size="0.2 0.1 0.05" mass="4"/>{trunk}{legs}{extra}</body></worldbody></mujoco>"""


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
