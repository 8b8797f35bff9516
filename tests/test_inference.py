"""Inference: files of the usual kinds load, each assumption is as described, nothing twice."""

import re

import mujoco
import numpy as np
import pytest
from tiny import quick_compilation

from shapebody.design import DesignSpace
from shapebody.robots import load_robot

# In the manner of public collections: default classes, meshes for looks, motors, no floor, no
# keyframe, feet that are spheres named after the leg.
LEG = """
      <body name="{leg}_hip" pos="{x} {y} 0">
        <inertial pos="0 0 0" mass="0.6" diaginertia="0.001 0.001 0.001"/>
        <joint name="{leg}_hip_joint" class="abduction"/>
        <geom mesh="hip" class="visual"/>
        <body name="{leg}_thigh" pos="0 {out} 0">
          <inertial pos="0 0 -0.1" mass="1" diaginertia="0.005 0.005 0.001"/>
          <joint name="{leg}_thigh_joint" class="hip"/>
          <geom mesh="hip" class="visual"/>
          <geom class="collision" type="box" size="0.1 0.012 0.017" pos="0 0 -0.1" quat="1 0 1 0"/>
          <body name="{leg}_calf" pos="0 0 -0.2">
            <inertial pos="0 0 -0.1" mass="0.2" diaginertia="0.001 0.001 0.0001"/>
            <joint name="{leg}_calf_joint" class="knee"/>
            <geom class="collision" type="cylinder" size="0.012 0.06" pos="0 0 -0.08"/>
            {foot}
          </body>
        </body>
      </body>"""
SPHERE = '<geom name="{leg}" class="foot"/>'
LEGS = (("FL", 0.2, 0.05, 0.1), ("FR", 0.2, -0.05, -0.1), ("RL", -0.2, 0.05, 0.1))
LEGS += (("RR", -0.2, -0.05, -0.1),)
QUADRUPED = """
<mujoco model="dog">
  <compiler angle="radian" meshdir="assets" autolimits="true"/>
  <option cone="elliptic" impratio="100"/>
  <default>
    <default class="dog">
      <geom friction="0.6" margin="0.001" condim="1"/>
      <joint axis="0 1 0" damping="2" armature="0.01" frictionloss="0.2"/>
      <motor ctrlrange="-23.7 23.7"/>
      <default class="abduction"><joint axis="1 0 0" range="-1 1"/></default>
      <default class="hip"><joint range="-1.5 3.4"/></default>
      <default class="knee">
        <joint range="-2.7 -0.8"/><motor ctrlrange="-45.4 45.4"/>
      </default>
      <default class="visual"><geom type="mesh" contype="0" conaffinity="0" group="2"/></default>
      <default class="collision">
        <geom group="3"/>
        <default class="foot"><geom type="sphere" size="0.022" pos="0 0 -0.2"/></default>
      </default>
    </default>
  </default>
  <asset><mesh name="hip" file="{mesh}"/></asset>
  <worldbody>
    <body name="base" pos="0 0 0.45" childclass="dog">
      {inertial}
      <freejoint/>
      <geom mesh="hip" class="visual"/>
      <geom class="collision" type="box" size="0.18 0.05 0.06"/>
      <site name="imu" pos="0.01 0 0"/>{legs}
    </body>
  </worldbody>
  <actuator>{motors}</actuator>
</mujoco>
"""
INERTIAL = '<inertial pos="0.02 0 0" mass="7" diaginertia="0.1 0.1 0.03"/>'
TETRAHEDRON = """
v 0 0 0
v 0.1 0 0
v 0 0.1 0
v 0 0 0.1
f 1 3 2
f 1 2 4
f 1 4 3
f 2 3 4
"""


def quadruped(folder, mesh="hip.obj", inertial=INERTIAL, foot=SPHERE, changes=()):
    """Path of the quadruped file with its mesh beside it."""
    (folder / "assets").mkdir(exist_ok=True)
    (folder / "assets" / "hip.obj").write_text(TETRAHEDRON)
    legs = "".join(
        LEG.format(leg=leg, x=x, y=y, out=out, foot=foot.format(leg=leg)) for leg, x, y, out in LEGS
    )
    motors = "".join(
        f'\n    <motor class="{kind}" name="{leg}_{part}" joint="{leg}_{part}_joint"/>'
        for leg, *_ in LEGS
        for kind, part in (("abduction", "hip"), ("hip", "thigh"), ("knee", "calf"))
    )
    text = QUADRUPED.format(mesh=mesh, inertial=inertial, legs=legs, motors=motors)
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = folder / "dog.xml"
    path.write_text(text)
    return path


LINK = """
  <link name="{name}">
    <inertial><origin xyz="0 0 {z}"/><mass value="{mass}"/>
      <inertia ixx="0.02" iyy="0.02" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>
    {shapes}
  </link>"""
REVOLUTE = """
  <joint name="{name}" type="revolute">
    <parent link="{parent}"/><child link="{child}"/><origin xyz="{xyz}"/><axis xyz="0 1 0"/>
    <limit lower="{low}" upper="{high}" effort="60" velocity="12"/><dynamics damping="0.1"/>
  </joint>"""
FIXED = """
  <joint name="{child}_fixed" type="fixed">
    <parent link="{parent}"/><child link="{child}"/><origin xyz="{xyz}"/></joint>"""
MESH = '<visual><geometry><mesh filename="package://walker/meshes/{0}.dae"/></geometry></visual>'
SOLE = '<collision><geometry><box size="0.2 0.08 0.02"/></geometry></collision>'


def biped_urdf(folder, sole=SOLE, inertia=True):
    """Path of a URDF: two legs with knees, an arm, a fixed IMU and fixed feet, no mesh files."""
    parts = ['<robot name="walker">', '<link name="base_link"/>']
    parts += [LINK.format(name="torso", z=0.2, mass=15, shapes=MESH.format("torso"))]
    parts += [FIXED.format(parent="base_link", child="torso", xyz="0 0 0")]
    parts += ['<link name="imu_link"/>']
    parts += [FIXED.format(parent="torso", child="imu_link", xyz="0.05 0 0.1")]
    parts += [LINK.format(name="arm", z=-0.1, mass=1, shapes=MESH.format("arm"))]
    parts += [
        REVOLUTE.format(
            name="shoulder", parent="torso", child="arm", xyz="0 0.2 0.4", low=-1, high=1
        )
    ]
    for side, y in (("left", 0.1), ("right", -0.1)):
        thigh, shank, foot = (f"{side}_{part}" for part in ("thigh", "shank", "foot"))
        for link, mass in ((thigh, 3), (shank, 2)):
            parts += [LINK.format(name=link, z=-0.2, mass=mass, shapes=MESH.format("leg"))]
        parts += [f'<link name="{foot}">{sole}</link>']
        place = dict(parent="torso", child=thigh, xyz=f"0 {y} 0")
        parts += [REVOLUTE.format(name=f"{side}_hip", low=-1.5, high=1.5, **place)]
        place = dict(parent=thigh, child=shank, xyz="0 0 -0.4")
        parts += [REVOLUTE.format(name=f"{side}_knee", low=0.2, high=2.2, **place)]
        parts += [FIXED.format(parent=shank, child=foot, xyz="0.03 0 -0.4")]
    text = "\n".join(parts + ["</robot>"])
    if not inertia:
        start = text.index("<inertial>", text.index('name="left_shank"'))
        text = text[:start] + text[text.index("</inertial>", start) + len("</inertial>") :]
    path = folder / "walker.urdf"
    path.write_text(text)
    return path


@pytest.fixture(scope="module", params=["mjcf", "urdf"])
def robot(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp(request.param)
    return load_robot(quadruped(folder) if request.param == "mjcf" else biped_urdf(folder))


def noted(robot, text: str) -> bool:
    return any(text in note for note in robot.inferred)


def test_completed_text_gives_the_same_robot_with_nothing_inferred(robot, tmp_path):
    path = tmp_path / f"{robot.path.stem}.xml"
    path.write_text(robot.xml)
    again = load_robot(path)
    assert again.inferred == () and again.xml == robot.xml
    assert repr(again) == repr(robot)
    for name in ("body_mass", "body_inertia", "geom_size", "jnt_range", "actuator_gainprm"):
        np.testing.assert_array_equal(getattr(again.model, name), getattr(robot.model, name))
    np.testing.assert_array_equal(again.home, robot.home)
    np.testing.assert_array_equal(again.keep_nominal, robot.keep_nominal)


def test_every_note_is_a_sentence_about_one_thing(robot):
    assert len(set(robot.inferred)) == len(robot.inferred) > 5
    assert all(len(note) > 30 for note in robot.inferred)


def test_designs_and_their_mjcf(robot, tmp_path):
    space = DesignSpace(robot)
    path = tmp_path / "design.xml"
    path.write_text(space.to_mjcf(space.start(1)))
    design = load_robot(path)
    assert design.inferred == () and design.design_dim == robot.design_dim == space.dim
    expected = space.to_model(space.start(1)).body_mass
    np.testing.assert_allclose(design.model.body_mass, expected, rtol=1e-6)


def test_one_step_of_the_task(robot):
    import jax

    from shapebody.locomotion import Locomotion

    def still(params, key, descriptions, observation):
        return jax.numpy.zeros(observation.joints.shape[:2]), ()

    with quick_compilation():
        env = Locomotion(robot, num_envs=2, engine="native")
        state = env.reset(jax.random.PRNGKey(0))
        state, record, _ = env.step(still, None, state, jax.random.PRNGKey(1))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree_util.tree_leaves(record))


def test_quadruped(tmp_path):
    robot = load_robot(quadruped(tmp_path))
    model = robot.model
    assert (robot.morphology, robot.num_actuators, robot.num_feet) == ("quadruped", 12, 4)
    assert {model.geom(int(i)).name for i in robot.feet} == {f"{leg[0]}_foot" for leg in LEGS}
    np.testing.assert_array_equal(model.geom_size[robot.feet, 0], [0.022] * 4)
    np.testing.assert_array_equal(model.actuator_forcerange[:3, 1], [23.7, 23.7, 45.4])
    # 7 + 4 * 1.8 kg: 1.5 N m/rad per kg, and D a fortieth of it.
    assert (robot.p_gain, robot.d_gain, robot.action_scale) == (21.0, 0.525, 0.25)
    np.testing.assert_array_equal(robot.velocity_limits, [15] * 12)
    assert model.nmesh == 0 and model.opt.timestep == 0.005
    assert not model.geom_contype.any() and not robot.keep_nominal.any()
    np.testing.assert_allclose(model.dof_damping[6:], 2)
    np.testing.assert_array_equal(model.dof_damping[:6], 0)
    assert not model.actuator_ctrllimited.any()
    for text in (
        "physics options timestep 0.002, cone 1, impratio 100",
        "at the nearest position within their limits",
        'no geom has "foot" in its name',
        "are motors or other drives",
        "no gains: kp = 21",
        "mesh geoms and 1 mesh",
        "no floor",
        "no action scale: 0.25 rad",
        "no velocity limits: 15 rad/s",
    ):
        assert noted(robot, text), text


def test_home_has_the_feet_on_the_floor_below_the_body(tmp_path):
    robot = load_robot(quadruped(tmp_path))
    data = mujoco.MjData(robot.model)
    data.qpos[:] = robot.home
    mujoco.mj_kinematics(robot.model, data)
    low, high = robot.model.jnt_range[robot.joints].T
    assert np.all((low <= robot.nominal) & (robot.nominal <= high))
    positions = data.geom_xpos[robot.feet]
    np.testing.assert_allclose(positions[:, 2], 0.022, atol=1e-3)
    straight = np.array([[x, y + out] for _, x, y, out in LEGS])
    np.testing.assert_allclose(positions[:, :2], straight, atol=0.02)
    assert robot.nominal[2] < -0.8 and robot.nominal[1] > 0.3


def test_another_keyframe_is_the_home(tmp_path):
    key = '<keyframe><key name="{}" qpos="0 0 0.3 1 0 0 0{}"/></keyframe></mujoco>'
    angles = " 0 0.7 -1.4" * 4
    stand = load_robot(quadruped(tmp_path, changes=[("</mujoco>", key.format("stand", angles))]))
    np.testing.assert_allclose(stand.nominal, [0, 0.7, -1.4] * 4)
    assert noted(stand, "keyframe 'stand'")
    home = load_robot(quadruped(tmp_path, changes=[("</mujoco>", key.format("home", angles))]))
    assert not noted(home, "no keyframe") and noted(home, 'the feet of "home" are')


@pytest.mark.parametrize(
    "inertial, mesh, message",
    [
        (INERTIAL, "lost.obj", "cannot be read .*lost.obj.*loaded without them$"),
        ("", "hip.obj", "bodies base have no <inertial>: computed from their geoms, meshes"),
        ("", "lost.obj", "bodies base have no <inertial>, so their mass comes from their other"),
    ],
)
def test_meshes(tmp_path, inertial, mesh, message):
    path = quadruped(tmp_path, inertial=inertial, mesh=mesh)
    robot = load_robot(path)
    assert any(re.search(message, note) for note in robot.inferred)
    assert "<mesh" not in robot.xml
    if mesh == "hip.obj":
        mass = mujoco.MjModel.from_xml_path(str(path)).body_mass
        np.testing.assert_allclose(robot.model.body_mass, mass, rtol=1e-5)


FEET = {
    "capsule": (
        '<geom class="collision" type="capsule" size="0.02 0.05" pos="0 0 -0.15"/>',
        (0, [0.02], -0.2),
    ),
    "lying capsule": (
        '<geom class="collision" type="capsule" size="0.02 0.06" quat="1 0 1 0" pos="0 0 -0.2"/>',
        (1, [0.02, 0.02, 0.08], -0.2),
    ),
    "flat cylinder": (
        '<geom class="collision" type="cylinder" size="0.05 0.01" pos="0 0 -0.2"/>',
        (1, [0.05, 0.05, 0.01], -0.2),
    ),
    "four spheres": (
        "".join(
            f'<geom class="collision" size="0.01" pos="{x} {y} -0.2"/>'
            for x in (-0.05, 0.09)
            for y in (-0.03, 0.03)
        ),
        (1, [0.08, 0.04, 0.01], -0.2),
    ),
    "ball and its adapter, both named foot": (
        '<geom name="{leg}_foot_adapter" class="collision" type="cylinder" size="0.01 0.05"/>'
        '<geom name="{leg}_foot" class="foot"/>',
        (0, [0.022], -0.2),
    ),
    "ball named foot, and a mesh too": (
        '<geom name="{leg}_foot_look" mesh="hip" class="visual"/>'
        '<geom name="{leg}_foot" class="foot"/>',
        (0, [0.022], -0.2),
    ),
    "mesh": (
        '<geom name="{leg}_foot" mesh="hip" class="visual" pos="0 0 -0.2"/>',
        (1, None, None),
    ),
}


@pytest.mark.parametrize("case", FEET)
def test_feet(tmp_path, case):
    foot, (kind, size, height) = FEET[case]
    # Legs are straight at home, so that the lowest geoms are those that are named here.
    robot = load_robot(quadruped(tmp_path, foot=foot, changes=[('"-2.7 -0.8"', '"-2.7 0.8"')]))
    assert robot.num_feet == 4
    if case == "mesh":
        # The box along the axes of the mesh is the smallest, and no larger than that of its file.
        assert np.all(np.prod(2 * robot.model.geom_size[robot.feet], axis=1) <= 0.1**3)
    else:
        np.testing.assert_array_equal(robot.foot_types, [kind] * 4)
        np.testing.assert_allclose(
            np.sort(robot.model.geom_size[robot.feet][:, : len(size)]),
            np.tile(np.sort(size), (4, 1)),
            atol=1e-3,
        )
        np.testing.assert_allclose(robot.model.geom_pos[robot.feet, 2], height, atol=1e-3)
    data = mujoco.MjData(robot.model)
    mujoco.mj_resetDataKeyframe(robot.model, data, robot.model.key("home").id)
    for _ in range(10):
        mujoco.mj_step(robot.model, data)
    assert set(data.contact.geom[: data.ncon].ravel()) == {robot.floor, *robot.feet}


ACTUATORS = {
    "several gains": (
        '<position class="dog" name="{leg}_{part}" joint="{leg}_{part}_joint" kp="{kp}" kv="1"'
        ' forcerange="-30 20"/>',
        (20, 1, 20),
        "2 different kp/kv (20/1, 50/1)",
    ),
    "gear": (
        '<position name="{leg}_{part}" joint="{leg}_{part}_joint" kp="5" kv="0.1" gear="2"'
        ' forcerange="-10 10"/>',
        (20, 0.4, 20),
        "multiplied into torque limits",
    ),
    "general servo with a filter": (
        '<general name="{leg}_{part}" joint="{leg}_{part}_joint" dyntype="filter" dynprm="0.1"'
        ' gainprm="40" biastype="affine" biasprm="0 -40 -1" forcerange="-10 10"/>',
        (21, 0.525, 10),
        "motors or other drives",
    ),
    "none": ("", (21, 0.525, None), "one position servo for each of the 12 hinge joints"),
}


@pytest.mark.parametrize("case", ACTUATORS)
def test_actuators(tmp_path, case):
    text, (p_gain, d_gain, limit), note = ACTUATORS[case]
    path = quadruped(tmp_path)
    xml = path.read_text()
    start, end = xml.index("<actuator>"), xml.index("</actuator>")
    servos = "".join(
        text.format(leg=leg, part=part, kp=50 if part == "calf" else 20)
        for leg, *_ in LEGS
        for part in ("hip", "thigh", "calf")
    )
    path.write_text(xml[:start] + "<actuator>" + servos + xml[end:])
    robot = load_robot(path)
    assert noted(robot, note) and robot.num_actuators == 12
    assert (robot.p_gain, robot.d_gain) == pytest.approx((p_gain, d_gain))
    limits = robot.model.actuator_forcerange[:, 1]
    if limit is None:  # the weight on one foot times the length of a leg
        limit = 14.2 * 9.81 / 4 * (np.hypot(0.2, 0.05) + 0.1 + 0.2 + 0.2)
    np.testing.assert_allclose(limits, limit, rtol=0.01)
    np.testing.assert_array_equal(robot.model.actuator_gear[:, 0], 1)
    assert robot.model.na == 0


def test_biped_urdf(tmp_path):
    robot = load_robot(biped_urdf(tmp_path))
    model = robot.model
    assert (robot.num_bodies, robot.num_joints, robot.num_feet) == (6, 5, 2)
    assert model.body_mass[1:].sum() == pytest.approx(26)
    assert [model.geom(int(i)).name for i in robot.feet] == ["left_foot", "right_foot"]
    np.testing.assert_allclose(model.geom_size[robot.feet], [[0.1, 0.04, 0.01]] * 2)
    np.testing.assert_array_equal(model.actuator_forcerange[:, 1], 60)
    np.testing.assert_array_equal(robot.velocity_limits, 12)
    np.testing.assert_array_equal(model.dof_armature[6:], 0.01)
    np.testing.assert_allclose(model.site_pos[robot.imu_site], [0.05, 0, 0.1])
    kept = {model.actuator(int(i)).name for i in np.flatnonzero(robot.keep_nominal)}
    assert kept == {"shoulder"}
    assert robot.home[2] == pytest.approx(0.8, abs=0.05)
    for text in (
        "the file is a URDF",
        "3 meshes are not found",
        "'base_link' gets a free joint",
        "links torso, imu_link, left_foot, right_foot are fixed",
        "torque limits of the joints (actuatorfrcrange, effort)",
        "joints shoulder carry no foot",
    ):
        assert noted(robot, text), text


def test_foot_links_without_geometry_become_spheres(tmp_path):
    robot = load_robot(biped_urdf(tmp_path, sole=MESH.format("foot")))
    assert noted(robot, "spheres at the origin of the link")
    np.testing.assert_array_equal(robot.foot_types, [0, 0])
    np.testing.assert_allclose(robot.model.geom_size[robot.feet, 0], 0.036)
    np.testing.assert_allclose(robot.model.geom_pos[robot.feet], [[0.03, 0, -0.4]] * 2)


def test_urdf_meshes_of_a_package_are_found_beside_the_file(tmp_path):
    folder = tmp_path / "walker" / "urdf"
    folder.mkdir(parents=True)
    (tmp_path / "walker" / "meshes").mkdir()
    (tmp_path / "walker" / "meshes" / "foot.obj").write_text(TETRAHEDRON)
    robot = load_robot(biped_urdf(folder, sole=MESH.format("foot").replace(".dae", ".obj")))
    assert noted(robot, "3 meshes are not found")
    assert not noted(robot, "foot.obj") and not noted(robot, "spheres at the origin")
    assert robot.num_feet == 2


def test_urdf_link_without_inertia(tmp_path):
    with pytest.raises(ValueError, match="body 'left_shank' has mass and inertia 0 kg.*<inertial>"):
        load_robot(biped_urdf(tmp_path, inertia=False))


def test_included_files_are_merged(tmp_path):
    quadruped(tmp_path)
    scene = tmp_path / "scene.xml"
    scene.write_text(
        '<mujoco><include file="dog.xml"/><worldbody><light pos="0 0 2"/>'
        '<geom name="ground" type="plane" size="0 0 0.1"/></worldbody></mujoco>'
    )
    robot = load_robot(scene)
    assert noted(robot, "other files are included") and noted(robot, "'ground' is the floor")
    assert "<include" not in robot.xml and robot.num_feet == 4


def test_tendons_pairs_and_excludes_are_dropped(tmp_path):
    extra = (
        '<tendon><fixed name="spring" stiffness="3"><joint joint="FL_hip_joint" coef="1"/></fixed>'
        '</tendon><sensor><tendonpos tendon="spring"/><clock name="mine"/></sensor>'
        '<contact><pair geom1="FL" geom2="FR"/><exclude body1="base" body2="FL_hip"/></contact>'
    )
    robot = load_robot(quadruped(tmp_path, changes=[("</mujoco>", f"{extra}</mujoco>")]))
    assert noted(robot, "tendons spring are dropped")
    assert noted(robot, "1 contact pairs and 1 excludes are removed")
    assert robot.model.ntendon == 0 and robot.model.npair == 4
    assert robot.model.sensor("mine").dim[0] == 1


def test_imu_of_another_body_is_not_the_imu(tmp_path):
    changes = [
        ('<site name="imu" pos="0.01 0 0"/>', ""),
        ('<joint name="FL_hip_joint"', '<site name="imu"/><joint name="FL_hip_joint"'),
    ]
    robot = load_robot(quadruped(tmp_path, changes=changes))
    assert robot.model.site_bodyid[robot.imu_site] == robot.trunk
    assert noted(robot, "not in body 'FL_hip'")
