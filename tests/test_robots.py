"""Robots: numbers of the shipped files, arrays of Robot, and messages for files that do not fit."""

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest

from shapebody.files import data_dir
from shapebody.robot.robot import load_robot, robots

NAMES = ("golem", "mit_humanoid", "unitree_go2")

# Typed by hand from the robots' descriptions and the paper's table of robots.
GOLDEN = {
    "golem": dict(
        display_name="Golem",
        morphology="hexapod",
        bodies=25,
        actuators=24,
        feet=6,
        spheres=30,
        design_dim=688,
        gains=(25.0, 0.5, 0.5),
        total_mass=8.5,
        home_height=0.14574,
    ),
    "mit_humanoid": dict(
        display_name="MIT Humanoid",
        morphology="humanoid",
        bodies=19,
        actuators=18,
        feet=2,
        spheres=19,
        design_dim=514,
        gains=(30.0, 0.5, 0.5),
        total_mass=24.249608,
        home_height=0.65516785,
    ),
    "unitree_go2": dict(
        display_name="Unitree Go2",
        morphology="quadruped",
        bodies=13,
        actuators=12,
        feet=4,
        spheres=14,
        design_dim=358,
        gains=(20.0, 0.5, 0.3),
        total_mass=15.206408,
        home_height=0.32350257,
    ),
}


@pytest.fixture(scope="module", params=NAMES)
def robot(request):
    return load_robot(request.param)


def test_registry_lists_the_shipped_robots():
    assert set(NAMES) <= set(robots())
    assert robots() == sorted(robots())


def test_sizes_and_gains(robot):
    golden = GOLDEN[robot.name]
    assert robot.display_name == golden["display_name"]
    assert robot.morphology == golden["morphology"]
    assert robot.num_bodies == golden["bodies"]
    assert robot.num_joints == robot.num_actuators == golden["actuators"]
    assert robot.num_feet == golden["feet"]
    assert robot.num_spheres == golden["spheres"]
    assert robot.design_dim == golden["design_dim"]
    assert (robot.p_gain, robot.d_gain, robot.action_scale) == golden["gains"]
    assert robot.model.body_mass.sum() == pytest.approx(golden["total_mass"], abs=1e-12)
    assert robot.path is not None and robot.xml == robot.path.read_text()


@pytest.mark.parametrize("name", robots())
def test_nothing_is_inferred_for_shipped_robots(name):
    assert load_robot(name).inferred == ()


def test_go2_numbers():
    robot = load_robot("unitree_go2")
    model = robot.model
    trunk = model.body("trunk")
    assert trunk.id == robot.trunk == 1
    assert trunk.mass[0] == 6.921
    np.testing.assert_array_equal(trunk.inertia, [0.107027, 0.0980771, 0.0244531])
    np.testing.assert_array_equal(trunk.ipos, [0.021112, 0.0, -0.005366])
    quat = np.array([-0.000543471, 0.713435, -0.00173769, 0.700719])
    np.testing.assert_allclose(trunk.iquat, quat / np.linalg.norm(quat), atol=1e-12)
    calf = model.body("RR_calf")
    assert calf.mass[0] == 0.241352
    np.testing.assert_array_equal(calf.inertia, [0.0014901, 0.00146356, 5.31397e-05])
    np.testing.assert_array_equal(model.joint("FL_calf_joint").range, [-2.7227, -0.83776])
    np.testing.assert_array_equal(model.joint("RR_thigh_joint").range, [-4.5379, 0.5236])
    np.testing.assert_array_equal(model.actuator("FR_calf_joint").forcerange, [-45.43, 45.43])
    assert model.joint("FL_hip_joint").frictionloss[0] == 0.2
    np.testing.assert_array_equal(robot.nominal[:6], [0.1, 0.8, -1.5, -0.1, -0.8, 1.5])
    np.testing.assert_array_equal(robot.velocity_limits, [30.1, 30.1, 15.7] * 4)
    np.testing.assert_array_equal(model.site_pos[robot.imu_site], [-0.02557, 0.0, 0.04232])
    assert not robot.keep_nominal.any() and not robot.foot_types.any()


def test_mit_humanoid_numbers():
    robot = load_robot("mit_humanoid")
    model = robot.model
    assert model.body("trunk").mass[0] == 7.95405
    assert model.body("left_foot").mass[0] == 0.279583
    np.testing.assert_array_equal(model.joint("left_knee").range, [0.0, 3.0])
    np.testing.assert_array_equal(model.actuator("left_knee").forcerange, [-144.0, 144.0])
    np.testing.assert_array_equal(robot.nominal[:5], [0.0, 0.0, -0.4, 0.8, -0.4])
    np.testing.assert_array_equal(robot.velocity_limits[:5], [48.0, 48.0, 40.0, 20.0, 24.0])
    np.testing.assert_array_equal(robot.keep_nominal, [False] * 10 + [True] * 8)
    np.testing.assert_array_equal(robot.foot_types, [1, 1])
    np.testing.assert_array_equal(model.geom_size[robot.feet[0]], [0.099, 0.0178, 0.021])


def test_golem_numbers():
    robot = load_robot("golem")
    assert robot.model.body("trunk").mass[0] == 3.7
    np.testing.assert_array_equal(robot.model.jnt_range[robot.joints], [[-3.14, 3.14]] * 24)
    np.testing.assert_array_equal(robot.model.actuator_forcerange, [[-7.3, 7.3]] * 24)
    np.testing.assert_array_equal(robot.velocity_limits, [8.169998] * 24)


def test_compiling_keeps_the_inertias_of_the_file(robot):
    elements = re.findall(r'<body name="(\S+?)".*?<inertial ([^>]*)/>', robot.xml, flags=re.DOTALL)
    assert len(elements) == robot.num_bodies
    for name, text in elements:
        values = {
            key: np.array(value.split(), float) for key, value in re.findall(r'(\w+)="(.*?)"', text)
        }
        body = robot.model.body(name)
        np.testing.assert_array_equal(body.inertia, values["diaginertia"])
        np.testing.assert_array_equal(body.mass, values["mass"])
        np.testing.assert_array_equal(body.ipos, values["pos"])
        quat = values["quat"] / np.linalg.norm(values["quat"])
        np.testing.assert_allclose(body.iquat, quat, atol=1e-12)


def test_physics_settings(robot):
    model = robot.model
    assert (model.opt.timestep, model.opt.density, model.opt.viscosity) == (0.005, 1.2, 2e-5)
    assert model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    assert model.opt.solver == mujoco.mjtSolver.mjSOL_NEWTON
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
    assert not model.geom_contype.any() and not model.geom_conaffinity.any()
    assert model.npair == robot.num_feet
    assert set(model.pair_geom1) | set(model.pair_geom2) == {robot.floor, *robot.feet}
    np.testing.assert_array_equal(model.pair_dim, 3)
    np.testing.assert_array_equal(
        model.pair_friction, [[1, 1, 0.005, 0.0001, 0.0001]] * model.npair
    )
    assert model.nu == robot.num_actuators and not model.actuator_ctrllimited.any()


def test_index_order(robot):
    model = robot.model
    np.testing.assert_array_equal(robot.joints[robot.actuated], model.actuator_trnid[:, 0])
    joints = [model.joint(int(robot.joints[index])) for index in robot.actuated]
    assert [joint.name for joint in joints] == [model.actuator(i).name for i in range(model.nu)]
    np.testing.assert_array_equal(robot.qpos_index, [joint.qposadr[0] for joint in joints])
    np.testing.assert_array_equal(robot.qvel_index, [joint.dofadr[0] for joint in joints])
    np.testing.assert_array_equal(robot.nominal, robot.home[robot.qpos_index])
    np.testing.assert_array_equal(robot.nominal, model.key("home").ctrl)
    assert all(np.diff(robot.feet) > 0) and all(np.diff(robot.spheres) > 0)
    np.testing.assert_array_equal(robot.foot_bodies, model.geom_bodyid[robot.feet])
    np.testing.assert_array_equal(model.geom_group[robot.spheres], 5)
    lower, upper = model.jnt_range[robot.joints[robot.actuated]].T
    assert np.all((lower <= robot.nominal) & (robot.nominal <= upper))


def test_sensor_slices_agree_with_the_model(robot):
    model, data = robot.model, mujoco.MjData(robot.model)
    generator = np.random.default_rng(0)
    data.qpos[:] = robot.home
    data.qpos[robot.qpos_index] += generator.uniform(-0.2, 0.2, robot.num_actuators)
    data.qvel[:] = generator.normal(size=model.nv)
    data.ctrl[:] = robot.nominal
    mujoco.mj_forward(model, data)
    read = {block: data.sensordata[where] for block, where in robot.sensors.items()}
    assert [len(values) for values in read.values()] == [
        *(3, 3, 3, 4),
        3 * robot.num_feet,
        4 * robot.num_feet,
        3 * robot.num_feet,
        3 * robot.num_spheres,
        robot.num_actuators,
    ]
    assert sum(map(len, read.values())) == model.nsensordata
    rotation = data.site_xmat[robot.imu_site].reshape(3, 3)
    velocity = np.zeros(6)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_SITE, robot.imu_site, velocity, 1)
    close = dict(atol=1e-12, strict=True)
    np.testing.assert_allclose(read["imu_angular_velocity"], velocity[:3], **close)
    np.testing.assert_allclose(read["imu_linear_velocity"], velocity[3:], **close)
    np.testing.assert_allclose(read["imu_position"], data.site_xpos[robot.imu_site], **close)
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, read["imu_orientation"])
    np.testing.assert_allclose(matrix.reshape(3, 3), rotation, **close)
    np.testing.assert_allclose(
        read["foot_positions"].reshape(-1, 3), data.geom_xpos[robot.feet], **close
    )
    np.testing.assert_allclose(
        read["sphere_positions"].reshape(-1, 3), data.geom_xpos[robot.spheres], **close
    )
    np.testing.assert_allclose(read["actuator_forces"], data.actuator_force, **close)
    for foot, quat, speed in zip(
        robot.feet,
        read["foot_orientations"].reshape(-1, 4),
        read["foot_velocities"].reshape(-1, 3),
        strict=True,
    ):
        mujoco.mju_quat2Mat(matrix, quat)
        np.testing.assert_allclose(matrix, data.geom_xmat[foot], **close)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_GEOM, foot, velocity, 0)
        np.testing.assert_allclose(speed, velocity[3:], **close)


def test_home_puts_the_lowest_foot_point_on_the_floor(robot):
    data = mujoco.MjData(robot.model)
    data.qpos[:] = robot.home
    mujoco.mj_kinematics(robot.model, data)
    lowest = []
    for geom, kind in zip(robot.feet, robot.foot_types, strict=True):
        centre, size = data.geom_xpos[geom], robot.model.geom_size[geom]
        if kind == 0:
            lowest.append(centre[2] - size[0])
        else:
            corners = np.stack(np.meshgrid(*[(-1, 1)] * 3), axis=-1).reshape(-1, 3) * size
            lowest.append((centre + corners @ data.geom_xmat[geom].reshape(3, 3).T)[:, 2].min())
    assert abs(min(lowest)) < 1e-6
    assert robot.home[2] == pytest.approx(GOLDEN[robot.name]["home_height"], abs=1e-9)
    np.testing.assert_array_equal(robot.home[[0, 1, 3, 4, 5, 6]], [0, 0, 1, 0, 0, 0])


def test_feet_stop_at_the_floor(robot):
    data = mujoco.MjData(robot.model)
    mujoco.mj_resetDataKeyframe(robot.model, data, robot.model.key("home").id)
    for _ in range(40):
        mujoco.mj_step(robot.model, data)
    assert 0 < data.ncon
    assert all(abs(contact.dist) < 0.01 for contact in data.contact)
    # The paper's soft gains let a standing robot sink, but not fall within 0.2 s.
    assert data.qpos[2] > 0.8 * robot.home[2]


# A robot file of one's own. Each bad file differs from this one in one place.

OWN = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.005"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 0.05"/>
    <body name="trunk" pos="0 0 0.3">
      <freejoint/>
      <inertial pos="0 0 0" mass="2" diaginertia="0.02 0.02 0.02"/>
      <geom type="box" size="0.1 0.1 0.03" group="2"/>
      <geom type="sphere" size="0.08" group="5"/>
      <site name="imu"/>
      <body name="left" pos="0 0.1 0">
        <inertial pos="0 0 -0.1" mass="0.3" diaginertia="0.001 0.001 0.0002"/>
        <joint name="left_hip" axis="0 1 0" range="-1 1"/>
        <geom name="left_foot" type="sphere" size="0.02" pos="0 0 -0.28"/>
      </body>
      <body name="right" pos="0 -0.1 0">
        <inertial pos="0 0 -0.1" mass="0.3" diaginertia="0.001 0.001 0.0002"/>
        <joint name="right_hip" axis="0 1 0" range="-1 1"/>
        <geom name="right_foot" type="sphere" size="0.02" pos="0 0 -0.28"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position joint="right_hip" kp="20" kv="0.5" forcerange="-9 9"/>
    <position joint="left_hip" kp="20" kv="0.5" forcerange="-9 9"/>
  </actuator>
  <keyframe><key name="home" qpos="0 0 0.3 1 0 0 0 0.1 0.2"/></keyframe>
  <custom>
    <numeric name="action_scale" data="0.3"/>
    <numeric name="velocity_limits" data="10 11"/>
  </custom>
</mujoco>
"""

KEY = '<key name="home" qpos="0 0 0.3 1 0 0 0 0.1 0.2"/>'
RIGHT_HIP = '<joint name="right_hip" axis="0 1 0" range="-1 1"/>'
LEFT_HIP = RIGHT_HIP.replace("right", "left")
RIGHT_ACTUATOR = '<position joint="right_hip" kp="20" kv="0.5" forcerange="-9 9"/>'
ACTUATORS = re.search(r"<actuator>.*</actuator>", OWN, flags=re.DOTALL).group()


def own_robot(folder: Path, *changes: tuple[str, str]) -> Path:
    text = OWN
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = folder / "own.xml"
    path.write_text(text)
    return path


def test_sensors_and_pairs_are_added_to_a_plain_file(tmp_path):
    path = own_robot(tmp_path)
    robot = load_robot(str(path))
    assert robot.path == path and robot.inferred == ()
    assert (robot.name, robot.display_name, robot.morphology) == ("own", "Own", "biped")
    assert robot.design_dim == 9 + 13 * 3 + 11 * 2 + 3 * 2 + 3 * 2
    np.testing.assert_array_equal(robot.actuated, [1, 0])
    np.testing.assert_array_equal(robot.nominal, [0.2, 0.1])
    np.testing.assert_array_equal(robot.velocity_limits, [10, 11])
    assert not robot.keep_nominal.any()
    assert robot.num_spheres == 1 and robot.model.geom(int(robot.spheres[0])).name == "sphere_0"
    assert robot.model.npair == 2
    test_sensor_slices_agree_with_the_model(robot)
    np.testing.assert_array_equal(robot.qpos_index, [8, 7])


def test_sensors_in_another_order_are_replaced(tmp_path):
    sensors = '<sensor><gyro name="imu_angular_velocity" site="imu"/><clock name="mine"/></sensor>'
    robot = load_robot(own_robot(tmp_path, ("<keyframe>", sensors + "<keyframe>")))
    where = robot.sensors["imu_angular_velocity"]
    sensor = robot.model.sensor("imu_angular_velocity")
    assert (where.start, where.stop - where.start) == (sensor.adr[0], 3)
    assert robot.model.sensor("mine").dim[0] == 1


def test_unknown_name_suggests_and_lists():
    with pytest.raises(ValueError, match="unknown robot 'unitree_go3'.*Did you mean.*unitree_go2"):
        load_robot("unitree_go3")
    with pytest.raises(ValueError, match="Available robots: .*golem.*mit_humanoid"):
        load_robot("no such thing")
    with pytest.raises(TypeError, match="robot is 3; expected a path"):
        load_robot(3)


def test_missing_file(tmp_path):
    for path in (tmp_path / "none.xml", str(tmp_path / "none.xml")):
        with pytest.raises(FileNotFoundError, match="none.xml.*does not exist.*MJCF"):
            load_robot(path)


def test_files_that_are_no_robot_files(tmp_path):
    (tmp_path / "go.xml").write_text(OWN)
    for folder in (tmp_path, f"{tmp_path}/"):
        with pytest.raises(ValueError, match="is a folder: expected a file; .*go.xml"):
            load_robot(folder)
    (tmp_path / "empty.xml").write_text(" \n")
    with pytest.raises(ValueError, match="empty.xml is empty: expected an MJCF or URDF file"):
        load_robot(tmp_path / "empty.xml")
    (tmp_path / "binary.xml").write_bytes(b"<mujoco>\xff\xfe</mujoco>")
    with pytest.raises(ValueError, match="not UTF-8 text .byte 8 is 0xff.*save it as UTF-8"):
        load_robot(tmp_path / "binary.xml")


def test_xacro_templates_are_named(tmp_path):
    (tmp_path / "robot.urdf").write_text('<robot name="a"><xacro:include filename="b"/></robot>')
    with pytest.raises(ValueError, match="robot.urdf is a xacro template: .*expand it first"):
        load_robot(tmp_path / "robot.urdf")


def test_duplicate_names(tmp_path):
    path = own_robot(tmp_path, ('<body name="right"', '<body name="left"'))
    with pytest.raises(ValueError, match="repeated name 'left' in body.*used once per kind"):
        load_robot(path)


def test_missing_data_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("SHAPEBODY_DATA", str(tmp_path / "nowhere"))
    with pytest.raises(FileNotFoundError, match="nowhere.*SHAPEBODY_DATA"):
        robots()
    monkeypatch.setenv("SHAPEBODY_DATA", str(tmp_path))
    assert data_dir() == tmp_path and robots() == []


@pytest.mark.parametrize("text", [OWN[: len(OWN) // 2], "no xml", "<scene/>", "<mujoco>\0"])
def test_text_that_does_not_compile(tmp_path, text):
    path = tmp_path / "broken.xml"
    path.write_text(text)
    with pytest.raises(ValueError, match="broken.xml is not a valid MJCF file: MuJoCo reports"):
        load_robot(path)


BAD = {
    "no free joint": (
        [("<freejoint/>", ""), (KEY, '<key name="home"/>')],
        "no free joint: expected exactly one",
    ),
    "two free joints": (
        [
            ("</worldbody>", '<body name="ball"><freejoint/><geom size="1"/></body></worldbody>'),
            (KEY, ""),
        ],
        "2 free joints .*trunk.*ball.*expected exactly one",
    ),
    "trunk is not the first body": (
        [("<worldbody>", '<worldbody><body name="table"><geom size="1"/></body>')],
        "body 'table' is not part of the robot, whose trunk is 'trunk'",
    ),
    "loose body": (
        [("</worldbody>", '<body name="table"><geom size="1"/></body></worldbody>')],
        "body 'table' is not part of the robot",
    ),
    "ball joint": (
        [
            (RIGHT_HIP, '<joint name="right_hip" type="ball" range="0 1"/>'),
            (RIGHT_ACTUATOR, ""),
            (KEY, ""),
        ],
        "'right_hip' is a ball joint: expected hinge",
    ),
    "slide joint": (
        [(RIGHT_HIP, RIGHT_HIP.replace("axis", 'type="slide" axis'))],
        "'right_hip' is a slide joint: expected hinge",
    ),
    "no limits": (
        [(RIGHT_HIP, RIGHT_HIP.replace('range="-1 1"', ""))],
        "'right_hip' has no limits: expected range",
    ),
    "limits of all joints": (
        [('range="-1 1"', "")],
        "each of joints 'left_hip', 'right_hip' has no limits: expected range",
    ),
    "exchanged limits": (
        [(RIGHT_HIP, RIGHT_HIP.replace("-1 1", "1 -1"))],
        "joint 'right_hip' has range=\"1 -1\", which sets no limits: expected lower < upper",
    ),
    "limits that do not hold": (
        [(RIGHT_HIP, RIGHT_HIP.replace("range", 'limited="false" range'))],
        'joint \'right_hip\' has range="-1 1".*no limited="false"',
    ),
    "axis of no length": (
        [('axis="0 1 0"', 'axis="0 0 0"')],
        "axis too small .*left_hip.*Correct the reported element",
    ),
    "upside down": (
        [(KEY, KEY.replace("1 0 0 0", "0 1 0 0"))],
        "trunk 'trunk' is tilted by 180 degrees in \"home\": expected .*z up",
    ),
    "trunk pitched": (
        [(KEY, ""), ('<body name="trunk"', '<body name="trunk" quat="1 0 1 0"')],
        "trunk 'trunk' is tilted by 90 degrees in \"home\": expected .*z up; turn the trunk frame",
    ),
    "foot on the trunk": (
        [('<geom type="box"', '<geom name="foot_rest" type="box"')],
        "geom 'foot_rest' is rigidly on the trunk 'trunk'.*take the word out of these names",
    ),
    "nothing to drive": (
        [
            (ACTUATORS, ""),
            (RIGHT_HIP, ""),
            (LEFT_HIP, ""),
            (KEY, '<key name="home" qpos="0 0 0.3 1 0 0 0"/>'),
        ],
        "no hinge joints: expected at least one to drive",
    ),
    "massless body": (
        [('mass="0.3" diaginertia="0.001 0.001 0.0002"', 'mass="0" diaginertia="0 0 0"')],
        "each of bodies 'left', 'right' has mass and inertia 0 kg and 0 kg m²: expected at least",
    ),
    "closed loop": (
        [
            (
                "<keyframe>",
                '<equality><connect name="rod" body1="left" body2="right" anchor="0 0 0"/>'
                "</equality><keyframe>",
            )
        ],
        "1 equality constraints of type connect .'rod'.: expected none",
    ),
    "not a number": (
        [(KEY, KEY.replace("0.3 1", "nan 1"))],
        "key_qpos of 'home' is .*nan.*expected finite numbers",
    ),
    "actuator of a site": (
        [(RIGHT_ACTUATOR, '<general name="jet" site="imu"/>')],
        "actuator 'jet' does not drive one hinge joint",
    ),
    "two actuators on a joint": (
        [('joint="left_hip" kp', 'name="second" joint="right_hip" kp')],
        "'right_hip' and 'second' drive the same joint 'right_hip'",
    ),
    "no feet": (
        [
            ('<geom name="left_foot" type="sphere" size="0.02" pos="0 0 -0.28"/>', ""),
            ('<geom name="right_foot" type="sphere" size="0.02" pos="0 0 -0.28"/>', ""),
        ],
        'no geom has "foot" in its name, and no leg ends in a geom',
    ),
    "box in the sphere group": (
        [('size="0.08" group="5"', 'size="0.08" group="4"'), ('group="2"', 'group="5"')],
        "'sphere_0' of group 5 is not a sphere",
    ),
    "negative action scale": (
        [('name="action_scale" data="0.3"', 'name="action_scale" data="-0.3"')],
        r'"action_scale" is \[-0.3\]: expected one number',
    ),
    "an endless velocity limit": (
        [('data="10 11"', 'data="10 inf"')],
        r'"velocity_limits" is \[10. inf\]: expected 2 numbers',
    ),
    "an endless action scale": (
        [('name="action_scale" data="0.3"', 'name="action_scale" data="inf"')],
        r'"action_scale" is \[inf\]: expected one number',
    ),
    "damping that is no number": (
        [(RIGHT_HIP, RIGHT_HIP.replace("/>", ' damping="nan"/>'))],
        "dof_damping of '.*' is nan: expected finite numbers",
    ),
    "negative damping": (
        [(RIGHT_HIP, RIGHT_HIP.replace("/>", ' damping="-0.1"/>'))],
        "dof_damping of '.*' is -0.1: expected at least 0",
    ),
    "too few velocity limits": (
        [('data="10 11"', 'data="10"')],
        r'"velocity_limits" is \[10.\]: expected 2 numbers',
    ),
    "a foot that is a collision sphere": (
        [('name="left_foot"', 'name="left_foot" group="5"')],
        "geom 'left_foot' is both a foot and a collision sphere of group 5: expected one",
    ),
    "bad flags": (
        [("</custom>", '<numeric name="keep_nominal" data="0 2"/></custom>')],
        r'"keep_nominal" is \[0. 2.\]: expected 2 flags',
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_file_that_does_not_fit(tmp_path, case):
    changes, message = BAD[case]
    path = own_robot(tmp_path, *changes)
    with pytest.raises(ValueError, match=message) as error:
        load_robot(path)
    assert str(path) in str(error.value)


def test_files_of_another_kind(tmp_path):
    path = tmp_path / "page.xml"
    path.write_text("<html><body>404</body></html>")
    with pytest.raises(ValueError, match="model type: 'html'.*another kind of file") as error:
        load_robot(path)
    assert "cut off" not in str(error.value)
    path.write_text(OWN[:300])
    with pytest.raises(ValueError, match="complete XML file; it may be cut off"):
        load_robot(path)


def test_all_problems_are_listed_at_once(tmp_path):
    unlimited = RIGHT_HIP.replace('range="-1 1"', "")
    path = own_robot(tmp_path, (RIGHT_HIP, unlimited), ('data="10 11"', 'data="10"'))
    with pytest.raises(ValueError) as error:
        load_robot(path)
    assert str(error.value).count("\n  - ") == 2
