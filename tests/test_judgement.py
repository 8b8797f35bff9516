"""What a report says about robots that load but do not stand, move or mean what they should."""

import copy
import dataclasses

import numpy as np
import pytest
from test_inference import FIXED, biped_urdf, edited_urdf, noted, quadruped
from test_robots import KEY, OWN, RIGHT_ACTUATOR, RIGHT_HIP, own_robot

from shapebody.robot.report import validate_robot
from shapebody.robot.robot import load_robot, robots
from shapebody.robot.standing import FLAT, hold, leg_drop, steady_armature

MOTOR = '<motor joint="{0}" ctrlrange="-6 6"/>'
LEGS = (("fl", 0.2, 0.1), ("fr", 0.2, -0.1), ("rl", -0.2, 0.1), ("rr", -0.2, -0.1))


def walker(folder, *, arm="", arm_motors="", turn="", knee="-2 1", mass=4, motors=MOTOR, ref=""):
    """Path of a quadruped with an arm of its own, drawn with straight legs."""
    legs = "".join(
        f"""
      <body name="{leg}_thigh" pos="{x} {y} 0" {turn}>
        <joint name="{leg}_hip" axis="0 1 0" range="-3 3" armature="0.01" {ref}/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.2" mass="0.4"/>
        <body name="{leg}_shin" pos="0 0 -0.2">
          <joint name="{leg}_knee" axis="0 1 0" range="{knee}" armature="0.01"/>
          <geom type="capsule" size="0.015" fromto="0 0 0 0 0 -0.18" mass="0.2"/>
          <geom name="{leg}_foot" type="sphere" size="0.02" pos="0 0 -0.2"/>
        </body>
      </body>"""
        for leg, x, y in LEGS
    )
    driven = [f"{leg}_{part}" for leg, *_ in LEGS for part in ("hip", "knee")]
    path = folder / "walker.xml"
    path.write_text(
        f"""<mujoco><compiler angle="radian"/><worldbody><body name="trunk" pos="0 0 0.42">
        <freejoint/><geom type="box" size="0.2 0.1 0.05" mass="{mass}"/>{legs}{arm}
        </body></worldbody>
        <actuator>{"".join(motors.format(joint) for joint in driven)}{arm_motors}</actuator>
        </mujoco>"""
    )
    return path


def light_arm(armature: str, mass: float = 0.15) -> dict[str, str]:
    """Two light links on the trunk with motors."""
    return dict(
        arm=f"""<body name="upper_arm" pos="0.2 0 0.1">
          <joint name="shoulder" axis="0 1 0" range="-1.5 1.5" {armature}/>
          <geom type="capsule" size="0.02" fromto="0 0 0 0.1 0 0" mass="{mass}"/>
          <body name="hand" pos="0.1 0 0">
            <joint name="wrist" axis="0 1 0" range="-1.5 1.5" {armature}/>
            <geom type="capsule" size="0.02" fromto="0 0 0 0.1 0 0" mass="{mass}"/>
          </body></body>""",
        arm_motors="".join(MOTOR.format(joint) for joint in ("shoulder", "wrist")),
    )


def warning(path, part: str) -> str:
    """The warning with this text; empty if there is none."""
    found = [text for text in validate_robot(path).warnings if part in text]
    assert len(found) <= 1
    return found[0] if found else ""


def changed(robot, **fields):
    """The robot with some fields of its model replaced."""
    model = copy.copy(robot.model)
    for name, value in fields.items():
        getattr(model, name)[:] = value
    return dataclasses.replace(robot, model=model)


# The standing test.


def named_joints(robot, text: str) -> set[str]:
    names = (robot.model.actuator(i).name for i in range(robot.num_actuators))
    return {name for name in names if f" {name} (" in text}


@pytest.mark.parametrize("name", robots())
def test_reports_name_the_joints_at_their_torque_limit(name):
    report = validate_robot(name)
    robot = report.robot
    held = hold(robot)
    assert report.ok and leg_drop(robot) > 1.5 * FLAT
    high = {robot.model.actuator(int(i)).name for i in np.flatnonzero(held.saturated > 0.1)}
    texts = [text for text in report.warnings if "in the standing test" in text]
    assert named_joints(robot, " ".join(texts)) >= high
    for text in texts:
        if "chatters" not in text:
            assert set() < named_joints(robot, text) <= high
    for i in np.flatnonzero(held.saturated > 0.1):
        limit = f"{robot.model.actuator_forcerange[i, 1]:.3g} N m"
        share = f"{held.saturated[i]:.0%} of the time at its limit of {limit}"
        assert any(share in text for text in texts)
    if held.reversing.max() > 0.1:  # the advice must be enough
        assert any("chatters" in text for text in texts)
        least = steady_armature(robot.model, robot.p_gain, robot.d_gain)
        armature = np.maximum(robot.model.dof_armature, least)
        armature[:6] = robot.model.dof_armature[:6]
        assert hold(changed(robot, dof_armature=armature)).reversing.max() < 0.02


def test_joints_too_weak_for_the_pose_are_named_with_share_and_limit(tmp_path):
    # Bent knees under the weight, with motors that give half of what that takes.
    pose = "0 0 0.42 1 0 0 0 " + "0.6 -1.2 " * 4
    path = walker(tmp_path, motors='<position joint="{0}" kp="200" kv="5" forcerange="-1 1"/>')
    key = f'<keyframe><key name="home" qpos="{pose}"/></keyframe></mujoco>'
    path.write_text(path.read_text().replace("</mujoco>", key))
    text = warning(path, "the torque is at its limit at")
    for leg, *_ in LEGS:
        assert f"{leg}_knee (" in text
    assert "of the time at its limit of 1 N m" in text and "raise forcerange" in text
    strong = path.read_text().replace("-1 1", "-60 60")
    path.write_text(strong)
    assert not warning(path, "in the standing test")


def test_chattering_joints_are_named_and_the_advice_is_enough(tmp_path):
    path = walker(tmp_path, **light_arm('armature="0.001"'))
    text = warning(path, "the torque chatters")
    robot = load_robot(path)
    assert named_joints(robot, text) == {"shoulder", "wrist"}
    assert "at its limit of 6 N m" in text and "too high for the little" in text
    advised = float(text.split('armature="')[1].split('"')[0])
    assert advised >= steady_armature(robot.model, robot.p_gain, robot.d_gain)
    path = walker(tmp_path, **light_arm(f'armature="{advised}"'))
    assert not warning(path, "in the standing test")


def test_unstable_joints_are_named(tmp_path):
    arm = light_arm("", mass=0.02)
    # A file with gains of its own keeps them, and its lack of armature.
    servo = '<position joint="{0}" kp="20" kv="0.5" forcerange="-60 60"/>'
    arm["arm_motors"] = servo.format("shoulder") + servo.format("wrist")
    path = walker(tmp_path, motors=servo, **arm)
    robot = load_robot(path)
    held = hold(robot)
    assert not held.finite
    text = warning(path, "becomes unstable")
    assert "shoulder, wrist (kp 20" in text and 'armature="' in text and "fl_hip" not in text


@pytest.mark.parametrize("mass", [0.02, 0.15])
def test_motors_without_armature_get_that_of_a_urdf(tmp_path, mass):
    path = walker(tmp_path, **light_arm("", mass=mass))
    report = validate_robot(path)
    assert hold(report.robot).finite
    assert noted(report, "no armature of joints shoulder, wrist: 0.01 kg m²")
    np.testing.assert_array_equal(report.robot.model.dof_armature[6:], 0.01)
    assert not warning(path, "in the standing test")
    # Also where there are no actuators at all, but never in place of an armature that is given.
    text = path.read_text()
    path.write_text(text[: text.index("<actuator>")] + "</mujoco>")
    np.testing.assert_array_equal(load_robot(path).model.dof_armature[6:], 0.01)
    path = walker(tmp_path, **light_arm('armature="0.004"'))
    assert not noted(load_robot(path), "no armature")
    np.testing.assert_array_equal(load_robot(path).model.dof_armature[-2:], 0.004)


# The nominal pose.


@pytest.mark.parametrize("turn", ['euler="0 1.5708 0"', 'euler="0 -1.5 0"', 'euler="1.52 0 0"'])
def test_a_pose_that_lies_flat(tmp_path, turn):
    path = walker(tmp_path, turn=turn)
    text = warning(path, 'it lies flat in "home"')
    assert "of their length" in text and "keyframe" in text
    assert not warning(path, "are the units") and not warning(path, "falls out of")
    assert not warning(walker(tmp_path), "lies flat")


def test_the_pose_of_joints_with_a_ref(tmp_path):
    path = walker(tmp_path, ref='ref="0.3"')
    (note,) = [note for note in load_robot(path).inferred if 'no keyframe "home"' in note]
    assert "joints at their ref: fl_hip, fr_hip, rl_hip, rr_hip at 0.3 rad, the others" in note
    assert "all joints at zero" not in note
    np.testing.assert_allclose(load_robot(path).nominal, [0.3, 0] * 4)
    (note,) = [n for n in load_robot(walker(tmp_path)).inferred if 'no keyframe "home"' in n]
    assert "all joints at zero" in note


@pytest.mark.parametrize("mass", [75, 127, 200])
def test_a_heavy_robot_with_low_gains(tmp_path, mass):
    total = mass + 4 * 0.6
    total += 4 * 1000 * 4 / 3 * np.pi * 0.02**3  # feet
    path = walker(tmp_path, mass=mass)
    assert noted(load_robot(path), f"1.5 N m/rad per kg would be {1.5 * total:.0f}")
    text = warning(path, "is low for")
    assert bool(text) == (mass > 107)
    if text:
        assert f"kp 80 N m/rad is low for {total:.3g} kg" in text
        usual = f'kp="{1.5 * total:.0f}" kv='
        assert usual in text
    light = walker(tmp_path, mass=30)
    assert not noted(load_robot(light), "per kg would be") and not warning(light, "is low for")


# URDF.


WORLD = '<link name="{0}"/>' + FIXED.format(parent="{0}", child="base_link", xyz="0 0 1")
BASE = '<link name="base_link"/>'


@pytest.mark.parametrize("name", ["world", "World", "world_link", "ground"])
def test_a_base_that_is_fixed_to_the_world(tmp_path, name):
    report = validate_robot(edited_urdf(tmp_path, (BASE, BASE + WORLD.format(name))))
    (problem,) = report.problems
    assert f"it fixes the base 'base_link' to the world (link '{name}', joint" in problem
    assert "remove that link and that joint" in problem
    for other in ("worldwide", "base_footprint"):
        assert validate_robot(edited_urdf(tmp_path, (BASE, BASE + WORLD.format(other)))).ok
    floating = WORLD.format(name).replace('type="fixed"', 'type="floating"')
    report = validate_robot(edited_urdf(tmp_path, (BASE, BASE + floating)))
    assert not any("to the world" in problem for problem in report.problems)


def test_an_mjcf_without_a_free_joint_is_fixed_to_the_world(tmp_path):
    path = own_robot(tmp_path, ("<freejoint/>", ""), (KEY, '<key name="home"/>'))
    (problem,) = validate_robot(path).problems
    assert "the file fixes the base 'trunk' to the world" in problem and "<freejoint/>" in problem


def test_a_base_that_joints_hold(tmp_path):
    held = '<joint name="rail" axis="0 1 0" range="-1 1"/>'
    path = own_robot(tmp_path, ("<freejoint/>", held), (KEY, '<key name="home"/>'))
    (problem,) = validate_robot(path).problems
    assert "ties the base 'trunk' to the world by joint 'rail'" in problem


@pytest.mark.parametrize("beside", ['mocap="true"', 'pos="1 0 1"'])
def test_what_is_beside_the_robot_is_named(tmp_path, beside):
    body = f'<worldbody><body name="ball" {beside}><geom size="0.1"/></body>'
    (problem,) = validate_robot(own_robot(tmp_path, ("<worldbody>", body))).problems
    assert "body 'ball' is not part of the robot, whose trunk is 'trunk'" in problem
    free = body.replace("<geom", "<freejoint/><geom").replace(' mocap="true"', "")
    path = own_robot(tmp_path, ("<worldbody>", free), (KEY, '<key name="home"/>'))
    several, loose = validate_robot(path).problems
    assert "2 free joints" in several and "body 'ball' is not part" in loose


def test_a_file_without_bodies(tmp_path):
    path = tmp_path / "empty.xml"
    path.write_text("<mujoco/>")
    assert "no bodies" in validate_robot(path).problems[0]


def test_an_arm_that_stands_up_is_called_one(tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text(
        """<mujoco><worldbody><body name="base"><freejoint/><geom size="0.1"/>
        <body><joint axis="0 1 0" range="-60 60"/><geom size="0.03" pos="0 0 0.5"/></body>
        </body></worldbody></mujoco>"""
    )
    (problem,) = validate_robot(path).problems
    assert "below the lowest foot" in problem and "is an arm" in problem


# Numbers that can be used but hardly are meant.


@pytest.mark.parametrize(
    ("old", "new", "part"),
    [
        (" range", ' frictionloss="7" range', "friction and damping take more torque"),
        (" range", ' damping="1e6" range', "friction and damping take more torque"),
        ("<worldbody>", '<option wind="9 0 0" density="1.2"/><worldbody>', "wind is [9. 0. 0.]"),
        ('name="trunk"', 'name="trunk" gravcomp="1"', "compensated at bodies trunk"),
        ('range="-3 3"', 'range="-180 180"', "are they in degrees?"),
        ('<compiler angle="radian"/>', "", "Are they in radians"),
    ],
)
def test_what_is_hardly_meant_is_asked(tmp_path, old, new, part):
    path = walker(tmp_path)
    assert not warning(path, part)
    path.write_text(path.read_text().replace(old, new))
    assert warning(path, part)


def test_limits_without_gravity_are_those_on_earth(tmp_path):
    path = walker(tmp_path, motors='<motor joint="{0}"/>')
    limits = load_robot(path).model.actuator_forcerange.copy()
    path.write_text(path.read_text().replace("<worldbody>", '<option gravity="0 0 0"/><worldbody>'))
    np.testing.assert_allclose(load_robot(path).model.actuator_forcerange, limits)
    assert warning(path, "gravity is") and not warning(path, "a placeholder?")


def test_what_chatters_is_not_called_usual(tmp_path):
    path = walker(tmp_path, motors='<position joint="{0}" kp="30" kv="1" forcerange="-20 20"/>')
    path.write_text(path.read_text().replace('armature="0.01"', ""))
    assert warning(path, "chatters")
    fall = warning(path, "falls out of its nominal pose")
    assert "chatter" in fall and "usual" not in fall


LIMIT = 'effort="60" velocity="12"'


@pytest.mark.parametrize(
    ("limit", "what", "instead"),
    [
        ('effort="-1" velocity="12"', "effort of each of joints {} is -1,", "length of a leg"),
        ('effort="0" velocity="12"', "effort of each of joints {} is 0,", "length of a leg"),
        ('velocity="12"', "effort of each of joints {} is missing,", "length of a leg"),
        ('effort="60" velocity="0"', "velocity of each of joints {} is 0,", "15 rad/s is used"),
        ('effort="60" velocity="-1"', "velocity of each of joints {} is -1,", "15 rad/s is used"),
        ('effort="60"', "velocity of each of joints {} is missing,", "15 rad/s is used"),
    ],
)
@pytest.mark.parametrize("joints", ["left_knee, right_knee", None])
def test_limits_that_mean_nothing_are_told(tmp_path, joints, limit, what, instead):
    path = biped_urdf(tmp_path)
    lines = path.read_text().splitlines()
    start = None
    for index, line in enumerate(lines):
        start = line if "<joint" in line else start
        if joints is None or any(f'"{joint}"' in str(start) for joint in joints.split(", ")):
            lines[index] = line.replace(LIMIT, limit)
    path.write_text("\n".join(lines))
    report = validate_robot(path)
    assert report.ok, report
    names = joints or "shoulder, left_hip, left_knee, right_hip, right_knee"
    (note,) = [note for note in report.inferred if what.format(names) in note]
    assert instead in note
    assert not noted(report, "no velocity limits")
    robot = report.robot
    changes = [robot.model.actuator(i).name in names for i in range(robot.num_actuators)]
    speeds = np.where(changes, 15, 12) if "velocity of" in what else 12
    np.testing.assert_array_equal(robot.velocity_limits, speeds)
    if "effort of" in what:
        guess = f"no torque limits of joints {names}: "
        (note,) = [note for note in report.inferred if guess in note]
        value = float(note.split(guess)[1].split()[0])
        torques = np.where(changes, value, 60)
        np.testing.assert_allclose(robot.model.actuator_forcerange[:, 1], torques)
        assert value > 20


@pytest.mark.parametrize("value", ["inf", "nan", "1e39", "${strong}", ""])
def test_efforts_that_are_no_numbers(tmp_path, value):
    (problem,) = validate_robot(
        edited_urdf(tmp_path, ('effort="60"', f'effort="{value}"'))
    ).problems
    assert "effort of joints 'shoulder', 'left_hip'" in problem and repr(value) in problem


GOOD = 'ixx="0.02" iyy="0.02" izz="0.01" ixy="0" ixz="0" iyz="0"'
INERTIAS = {
    "product too large": GOOD.replace('ixy="0"', 'ixy="0.05"'),
    "negative": GOOD.replace('izz="0.01"', 'izz="-0.01"'),
    "all the same": 'ixx="1e-3" iyy="1e-3" izz="1e-3" ixy="1e-3" ixz="1e-3" iyz="1e-3"',
    "of a line": 'ixx="0.02" iyy="0.02" izz="0" ixy="0" ixz="0" iyz="0"',
}


@pytest.mark.parametrize("case", INERTIAS)
def test_inertias_that_no_body_has(tmp_path, case):
    (problem,) = validate_robot(edited_urdf(tmp_path, (GOOD, INERTIAS[case]))).problems
    assert "is not positive definite" in problem and "'left_shank' (its smallest" in problem
    # Merged into a link that has one, it is no obstacle.
    mass = f'<inertial><mass value="0.1"/><inertia {INERTIAS[case]}/></inertial>'
    changes = ('<link name="imu_link"/>', f'<link name="imu_link">{mass}</link>')
    report = validate_robot(edited_urdf(tmp_path, changes))
    assert report.ok and noted(report, "inertia of link 'imu_link' (its smallest principal")


@pytest.mark.parametrize("least", ["0.003", "0.0099"])
def test_inertias_that_are_replaced_are_told(tmp_path, least):
    uneven = f'ixx="0.02" iyy="0.01" izz="{least}" ixy="0" ixz="0" iyz="0"'
    report = validate_robot(edited_urdf(tmp_path, (GOOD, uneven)))
    assert report.ok
    (note,) = [note for note in report.inferred if "above the sum of the others" in note]
    mean = (0.03 + float(least)) / 3
    assert f"'left_shank' ({float(least):.3g}, 0.01, 0.02, now {mean:.3g})" in note
    inertia = report.robot.model.body("left_shank").inertia
    assert np.ptp(inertia) < 1e-6 and inertia[0] >= mean - 1e-6
    even = uneven.replace("0.02", "0.0129")
    assert not noted(validate_robot(edited_urdf(tmp_path, (GOOD, even))), "above the sum")


@pytest.mark.parametrize("value", ["nan", "1e39", "inf"])
@pytest.mark.parametrize(
    ("old", "attribute"),
    [
        ('mass value="15"', "value of <mass> in 'torso'"),
        ('ixx="0.02"', "ixx of <inertia> in 'torso'"),
        ('xyz="0 0.2 0.4"', "xyz of <origin> in 'shoulder'"),
        ('lower="-1"', "lower of <limit> in 'shoulder'"),
        ('size="0.2 0.08 0.02"', "size of <box> in 'left_foot'"),
        ('damping="0.1"', "damping of <dynamics> in 'shoulder'"),
    ],
)
def test_numbers_of_a_urdf_are_finite(tmp_path, old, attribute, value):
    name, given = old.split('"')[0], old.split('"')[1]
    new = f'{name}"{" ".join([*given.split()[:-1], value])}"'
    (problem,) = validate_robot(edited_urdf(tmp_path, (old, new))).problems
    assert "expected finite numbers" in problem and attribute in problem and value in problem


# MJCF.


@pytest.mark.parametrize("levels", [1, 2])
def test_a_nested_free_joint(tmp_path, levels):
    text = OWN.replace('<body name="trunk"', '<body name="stand"><body name="trunk"')
    text = text.replace("</worldbody>", "</body></worldbody>")
    if levels == 2:
        text = text.replace('name="stand"', 'name="hall"><body name="stand"')
        text = text.replace("</worldbody>", "</body></worldbody>")
    path = tmp_path / "nested.xml"
    path.write_text(text)
    (problem,) = validate_robot(path).problems
    assert "<freejoint/> belongs to a body directly in <worldbody>" in problem
    assert "'trunk'" in problem and "revolute" not in problem and "link" not in problem


@pytest.mark.parametrize("limits", ["-10 -5", "5 10", "-10 0", "10 -10"])
@pytest.mark.parametrize(
    ("old", "new", "name"),
    [
        ('forcerange="-9 9"', 'forcerange="{}"', "forcerange of .*actuators? 'right_hip'"),
        (RIGHT_HIP, RIGHT_HIP[:-2] + ' actuatorfrcrange="{}"/>', "frcrange of joint 'right_hip'"),
        (RIGHT_ACTUATOR, '<motor joint="right_hip" ctrlrange="{}"/>', "ctrlrange of actuator"),
    ],
)
def test_ranges_of_torque_without_zero(tmp_path, old, new, name, limits):
    if limits == "10 -10" and "motor" in new:
        limits = "7 9"  # MuJoCo itself refuses the other
    with pytest.raises(ValueError, match=f'{name}.* is "{limits}": expected .*contains 0') as error:
        load_robot(own_robot(tmp_path, (old, new.format(limits))))
    assert str(tmp_path) in str(error.value)


def test_motors_of_one_direction_are_told(tmp_path):
    path = own_robot(tmp_path, (RIGHT_ACTUATOR, RIGHT_ACTUATOR.replace("-9 9", "0 9")))
    report = validate_robot(path)
    assert report.ok and noted(report, "torque limits of right_hip are of one direction")


NUMBERS = {  # place in the file -> element with a number, and what the message says
    "gravity": ("<option ", '<option gravity="0 0 {}" ', "gravity of <option>"),
    "wind": ("<option ", '<option wind="{} 0 0" ', "wind of <option>"),
    "o_solref": ("<option ", '<option o_solref="0.02 {}" ', "o_solref of <option>"),
    "solref": ('type="plane"', 'type="plane" solref="{} 1"', "geom_solref of 'floor'"),
    "solimp": ('type="plane"', 'type="plane" solimp="0.9 {}"', "geom_solimp of 'floor'"),
    "friction": ('name="left_foot"', 'name="left_foot" friction="{}"', "friction of 'left_foot'"),
    "solreflimit": (RIGHT_HIP, RIGHT_HIP[:-2] + ' solreflimit="{} 1"/>', "solref of 'right_hip'"),
    "springref": (RIGHT_HIP, RIGHT_HIP[:-2] + ' springref="{}"/>', "springref of 'right_hip'"),
    "ref": (RIGHT_HIP, RIGHT_HIP[:-2] + ' ref="{}"/>', "ref of 'right_hip'"),
    "margin": (RIGHT_HIP, RIGHT_HIP[:-2] + ' margin="{}"/>', "jnt_margin of 'right_hip'"),
    "axis": (RIGHT_HIP, RIGHT_HIP.replace("0 1 0", "0 {} 0"), "right_hip'"),
    "gear": (RIGHT_ACTUATOR, RIGHT_ACTUATOR[:-2] + ' gear="{}"/>', "gear of 'right_hip'"),
    "kv": (RIGHT_ACTUATOR, RIGHT_ACTUATOR.replace("0.5", "{}"), "'right_hip'"),
    "velocity": ('qpos="0 0 0.3', 'qvel="0 0 0 0 0 0 0 {}" qpos="0 0 0.3', "key_qvel of 'home'"),
    "numeric": ("<custom>", '<custom><numeric name="x" data="{}"/>', "custom numeric 'x'"),
    "mass": ('mass="2"', 'mass="{}"', "'trunk'"),
    "inertia": ("0.02 0.02 0.02", "0.02 0.02 {}", "'trunk'"),
    "unused mass": ('type="plane"', 'type="plane" mass="{}"', "mass of <geom> in 'floor'"),
    "default": ("<default>", '<default><geom solmix="{}"/>', "geom_solmix of 'floor'"),
    "colour": ('group="2"', 'group="2" rgba="{} 1 1 1"', "rgba"),
    "own numeric": ('data="10 11"', 'data="10 {}"', '"velocity_limits" is'),
}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("value", ["nan", "1e39", "-inf"])
@pytest.mark.parametrize("case", NUMBERS)
def test_numbers_are_finite_in_float32(tmp_path, case, value):
    old, new, message = NUMBERS[case]
    if case == "default":
        new = new.replace("/>", ' contype="0" conaffinity="0"/>')
        old = '<default><geom contype="0" conaffinity="0"/>'
    path = own_robot(tmp_path, (old, new.format(value)))
    with pytest.raises(ValueError) as error:
        load_robot(path)
    text = str(error.value)
    assert str(path) in text and message in text
    shown = text.replace("1.e+39", "1e39").replace("1e+39", "1e39")
    # MuJoCo makes a vector of length 1 of an axis.
    assert value.lstrip("-") in shown or (case == "axis" and "nan" in shown)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("<worldbody>", '<option viscosity="-1"/><worldbody>', "viscosity of <option> is -1"),
        ("<worldbody>", '<option density="-1"/><worldbody>', "density of <option> is -1"),
        (RIGHT_HIP, RIGHT_HIP[:-2] + ' armature="-1"/>', "dof_armature of 'right_hip' is -1"),
    ],
)
@pytest.mark.filterwarnings("ignore")
def test_numbers_below_zero_are_told_alone(tmp_path, old, new, message):
    (problem,) = validate_robot(own_robot(tmp_path, (old, new))).problems
    assert message in problem and "at least 0" in problem


@pytest.mark.parametrize("index", [2, 7])
def test_a_home_of_no_robot(tmp_path, index):
    robot = load_robot(walker(tmp_path))
    qpos = robot.home.copy()
    qpos[index] = 1e30
    path = walker(tmp_path)
    key = f'<keyframe><key name="home" qpos="{" ".join(map(str, qpos))}"/></keyframe></mujoco>'
    path.write_text(path.read_text().replace("</mujoco>", key))
    (problem,) = validate_robot(path).problems
    assert f"qpos of keyframe 'home' has 1e+30 (number {index + 1})" in problem


def test_large_numbers_and_names_like_numbers_are_fine(tmp_path):
    path = own_robot(tmp_path, ("<custom>", '<custom><numeric name="x" data="3e38 -3e38"/>'))
    assert load_robot(path).inferred == ()
    path.write_text(path.read_text().replace("right_hip", "nan"))
    assert load_robot(path).model.joint("nan").id >= 0


def test_reports_of_a_plain_file_stay_as_they_were(tmp_path):
    """What is in order gets none of these remarks."""
    for path in (quadruped(tmp_path), biped_urdf(tmp_path), own_robot(tmp_path)):
        report = validate_robot(path)
        texts = " ".join((*report.warnings, *report.inferred, *report.problems))
        for part in (
            "chatter",
            "at its limit",
            "lies flat",
            "is low for",
            "definite",
            "armature of",
        ):
            assert part not in texts, (path.name, part)
