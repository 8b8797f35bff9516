"""Inference: files of the usual kinds load, each assumption is as described, nothing twice."""

import re

import mujoco
import numpy as np
import pytest
from tiny import quick_compilation

from shapebody.design.space import DesignSpace
from shapebody.robot.robot import load_robot

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

    from shapebody.task.env import Locomotion

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


def test_primitives_with_the_size_of_a_mesh_keep_it(tmp_path):
    """Also when there are several in one body."""
    fitted = "".join(
        f'<geom name="fit_{shape}" type="{shape}" mesh="hip" class="visual" fitscale="{scale}"/>'
        for shape, scale in (("box", 0.5), ("sphere", 0.7), ("capsule", 0.9))
    )
    path = quadruped(tmp_path, inertial=INERTIAL + fitted)
    file, robot = mujoco.MjModel.from_xml_path(str(path)), load_robot(path).model
    for name in ("fit_box", "fit_sphere", "fit_capsule"):
        np.testing.assert_allclose(robot.geom(name).size, file.geom(name).size, rtol=1e-5)
        np.testing.assert_allclose(robot.geom(name).pos, file.geom(name).pos, atol=1e-6)


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
        "links base_link above 'torso' have no mass, no geometry",
        "'torso' gets a free joint",
        "links imu_link, left_foot, right_foot are fixed",
        "torque limits of the joints (actuatorfrcrange, effort)",
        "joints shoulder carry no foot",
    ):
        assert noted(robot, text), text


def edited_urdf(folder, *changes, **kind):
    """The biped with changes of its text."""
    path = biped_urdf(folder, **kind)
    text = path.read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path.write_text(text)
    return path


BASE = '<link name="base_link"/>'
TORSO_FIXED = FIXED.format(parent="base_link", child="torso", xyz="0 0 0")


def test_urdf_frames_above_the_base_are_dropped(tmp_path):
    above = FIXED.format(parent="base_footprint", child="base_link", xyz="0 0 0.8")
    path = edited_urdf(tmp_path, (BASE, f'<link name="base_footprint"/>{BASE}{above}'))
    robot = load_robot(path)
    assert noted(robot, "links base_footprint, base_link above 'torso' have no mass")
    assert robot.model.body(robot.trunk).name == "torso"
    assert robot.home[2] == pytest.approx(0.8, abs=0.05)


@pytest.mark.parametrize(
    "change",
    [
        # Geometry, a second child, and a turned child: the root says something.
        (BASE, f'<link name="base_link">{SOLE}</link>'),
        ('"torso"/><child link="imu_link"', '"base_link"/><child link="imu_link"'),
        (TORSO_FIXED, TORSO_FIXED.replace("<origin", '<origin rpy="0.1 0 0"')),
    ],
)
def test_other_urdf_roots_stay_the_base(tmp_path, change):
    robot = load_robot(edited_urdf(tmp_path, change))
    assert robot.model.body(robot.trunk).name == "base_link"
    assert not noted(robot, "have no mass, no geometry")


HIP = 'name="left_hip" type="revolute"'
BAD_URDF = {
    "repeated joint": (
        [('name="right_hip"', 'name="left_hip"')],
        "not a valid URDF file: repeated name 'left_hip' in joint .2 of them.*rename one",
    ),
    "repeated link": (
        [('<link name="imu_link"/>', '<link name="imu_link"/><link name="arm"/>')],
        "not a valid URDF file: repeated name 'arm' in link .2 of them.*rename one",
    ),
    "empty velocity": (
        [('velocity="12"', 'velocity=""')],
        "velocity of joints 'shoulder', 'left_hip', .* is '': expected a number",
    ),
    "velocity of a template": (
        [(HIP, f'{HIP}><limit velocity="${{fast}}"/></joint><joint name="x" type="fixed"')],
        r"velocity of joint 'left_hip' is '\${fast}': expected a number .rad/s.*xacro",
    ),
    "floating joint below a link": (
        [(HIP, 'name="left_hip" type="floating"')],
        "free joint can only be used on top level.*remove the link above the floating joint",
    ),
    "two floating bases": (
        [
            (BASE, f'<link name="world"/>{BASE}'),
            (
                TORSO_FIXED,
                FIXED.format(parent="world", child="base_link", xyz="0 0 0")
                + TORSO_FIXED.replace('parent link="base_link"', 'parent link="world"').replace(
                    "fixed", "floating"
                ),
            ),
            ('type="revolute">\n    <parent link="torso"/><child link="arm"/>', "FLOATING"),
            ("FLOATING", 'type="floating"><parent link="world"/><child link="arm"/>'),
        ],
        "2 free joints .bodies 'torso', 'arm'.: expected exactly one",
    ),
    "no limits": (
        [('type="revolute"', 'type="continuous"'), ("lower=", "low="), ("upper=", "high=")],
        "joints 'shoulder', 'left_hip', 'left_knee', .*'right_knee' has no limits: expected",
    ),
    "mimic joint": (
        [('<child link="left_thigh"/>', '<child link="left_thigh"/><mimic joint="shoulder"/>')],
        "type joint .*'left_hip' with 'shoulder'.*expected none",
    ),
}


@pytest.mark.parametrize("case", BAD_URDF)
def test_urdf_that_does_not_fit(tmp_path, case):
    changes, message = BAD_URDF[case]
    with pytest.raises(ValueError, match=message):
        load_robot(edited_urdf(tmp_path, *changes))


def test_all_problems_of_a_urdf_text_are_named(tmp_path):
    changes = ('name="right_hip"', 'name="left_hip"'), ('velocity="12"', 'velocity="fast"')
    with pytest.raises(ValueError, match="repeated name 'left_hip'.*velocity of joints .*'fast'"):
        load_robot(edited_urdf(tmp_path, *changes))


def test_files_by_any_name(tmp_path, monkeypatch):
    text = biped_urdf(tmp_path).read_text()
    (tmp_path / "WALKER.URDF").write_text(text)
    (tmp_path / "walker").write_text(text)
    (tmp_path / "dog.mjcf").write_text(quadruped(tmp_path).read_text())
    (tmp_path / "unitree_go2").write_text("not this one")
    monkeypatch.chdir(tmp_path)
    for name in ("WALKER.URDF", "./walker", "walker"):
        assert load_robot(name).num_feet == 2
    dog = load_robot("dog.mjcf")
    assert dog.num_feet == 4 and not noted(dog, "cannot be read")
    assert load_robot("unitree_go2").inferred == ()
    with pytest.raises(FileNotFoundError, match="./wlaker.*does not exist"):
        load_robot("./wlaker")


FLOOR = '<geom name="{}" type="plane" size="0 0 1" {}/>'


@pytest.mark.parametrize(
    "name, pose, note",
    [
        ("floor", 'pos="0 0 -0.5"', '"floor" is at z = -0.5 m and tilted by 0 degrees'),
        ("floor", 'euler="0.35 0 0"', '"floor" is at z = 0 m and tilted by 20.1 degrees'),
        ("ground", 'pos="0 0 1" euler="0.35 0 0"', "plane 'ground' is the floor"),
        ("floor", 'pos="1 2 0" euler="0 0 1"', None),
    ],
)
def test_the_floor_is_level_at_zero(tmp_path, name, pose, note):
    change = "<worldbody>", "<worldbody>" + FLOOR.format(name, pose)
    robot = load_robot(quadruped(tmp_path, changes=[change]))
    floor = robot.model.geom("floor")
    assert floor.pos[2] == 0
    np.testing.assert_allclose(floor.quat[1:3], 0, atol=1e-12)
    assert noted(robot, note or '"floor"') == (note is not None)


def test_trunk_with_its_origin_at_the_feet_or_below(tmp_path):
    # The parts of the trunk are where they were, its origin is not.
    for lower in (0.4, 0.5):
        changes = [
            (f'_hip" pos="{x} {y} 0"', f'_hip" pos="{x} {y} {lower}"') for _, x, y, _ in LEGS
        ]
        with pytest.raises(ValueError, match="origin of the trunk 'base' is .*expected it well ab"):
            load_robot(quadruped(tmp_path, changes=changes))


def test_head_above_the_trunk(tmp_path):
    head = (
        '<body name="head" pos="0.2 0 0.2"><inertial pos="0 0 0" mass="0.1" diaginertia="1e-4 1e-4'
        ' 1e-4"/><joint name="neck" range="-1 1"/><geom size="0.05"/><geom size="0.04"/></body>'
    )
    site = '<site name="imu" pos="0.01 0 0"/>'
    robot = load_robot(quadruped(tmp_path, changes=[(site, site + head)]))
    assert robot.num_feet == 4


def test_unnamed_parts_get_names_that_are_free(tmp_path):
    sphere = '<geom {} class="collision" type="sphere" size="0.03" group="5"/>'
    site = '<site name="imu" pos="0.01 0 0"/>'
    spheres = sphere.format('name="sphere_1"') + sphere.format("")
    robot = load_robot(quadruped(tmp_path, changes=[(site, site + spheres)]))
    names = [robot.model.geom(int(i)).name for i in robot.spheres]
    assert len(set(names)) == 2 and "sphere_1" in names
    motor = '<motor class="hip" name="FL_thigh" joint="FL_thigh_joint"/>'
    twice = '<motor joint="FL_thigh_joint"/>' * 2
    with pytest.raises(ValueError, match="'FL_thigh_joint' and 'FL_thigh_joint_2' drive the same"):
        load_robot(quadruped(tmp_path, changes=[(motor, twice)]))


def test_a_footprint_is_no_foot(tmp_path):
    box = '<geom class="collision" type="box" size="0.18 0.05 0.06"/>'
    named = box.replace("<geom", '<geom name="base_footprint"')
    robot = load_robot(quadruped(tmp_path, changes=[(box, named)]))
    assert {robot.model.geom(int(i)).name for i in robot.feet} == {f"{leg[0]}_foot" for leg in LEGS}
    changes = [(box, box.replace("<geom", '<geom name="foot_guard"'))]
    with pytest.raises(ValueError, match="'foot_guard' is rigidly on the trunk 'base'.*'FL_calf'"):
        load_robot(quadruped(tmp_path, changes=changes))


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
