"""What is written simulates in plain MuJoCo as the robot does in our environment.

`plain` uses MuJoCo alone, as anyone would who gets the file: load, reset to "home", step.
"""

import dataclasses
import re

import jax
import mujoco
import numpy as np
import pytest
from test_inference import biped_urdf, quadruped
from test_robots import OWN
from tiny import quick_compilation, tiny_agent

from shapebody import load_robot, robots, validate_robot
from shapebody.__main__ import main
from shapebody.agent.store import save_agent
from shapebody.design.export import balanced, ordered_ranges
from shapebody.design.space import DesignSpace
from shapebody.physics.mjx import MjxPhysics
from shapebody.physics.native import NativePhysics
from shapebody.robot.feet import foot_ids

SUBSTEPS = 4  # physics steps per control step
SECONDS = 2.0

LEG = """
    <body name="leg_{i}_thigh" pos="{x} {y} 0">
      <joint name="leg_{i}_hip" axis="0 1 0" range="-60 60" armature="0.01" {hip}/>
      <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.2" mass="0.4"/>
      <body name="leg_{i}_shin" pos="0 0 -0.2">
        <joint name="leg_{i}_knee" axis="0 1 0" range="-100 60" armature="0.01"/>
        {shin}
        <geom {name} {foot} pos="0 0 -0.2"/>
      </body>
    </body>"""
SHAPES = (
    'type="sphere" size="0.02"',
    'type="box" size="0.03 0.02 0.01"',
    'type="ellipsoid" size="0.03 0.02 0.015"',
    'type="capsule" size="0.02 0.01"',
)
DRIVES = (
    '<position joint="{0}" kp="30" kv="1" forcerange="-20 20"/>',
    '<position name="{0}" joint="{0}" kp="40" kv="1.3" ctrlrange="-2 2"/>',
    '<motor joint="{0}" ctrlrange="-9 9" gear="2"/>',
)
OPTIONS = (
    "",
    '<option timestep="0.002" integrator="implicitfast" gravity="0 0 -9.7"/>',
    '<option timestep="0.005" density="1.2"/><default><geom friction="0.3" solref="0.04 1"/>'
    '<pair solref="0.03 1" margin="0.001"/></default>',
)


def handmade(folder, seed: int):
    """Path of a random plain MJCF file: 2, 4 or 6 legs, feet, drives and poses of several kinds,
    with or without names, contacts, sensors and keyframes of its own."""
    rng = np.random.default_rng(seed)
    count = (4, 2, 6)[seed % 3]
    named = rng.random() < 0.5
    shin = '<geom type="capsule" size="0.015" fromto="0 0 0 0 0 -0.18" mass="0.2"/>'
    if rng.random() < 0.5:  # two moments that add up to the third, with many digits
        a, b = rng.uniform(1e-4, 1e-3, 2).tolist()
        shin += f'<inertial pos="0 0 -0.1" mass="0.3" diaginertia="{a!r} {b!r} {a + b!r}"/>'
    foot, drive = rng.choice(SHAPES), rng.choice(DRIVES)
    legs, joints, feet = "", [], []
    for i in range(count):
        x, y = 0.2 * (1 - 2 * i / max(1, count - 1)), 0.1 * (-1) ** i
        name = f'name="foot_{i}"' if named else ""
        hip = 'ref="10"' if seed % 4 == 3 else ""
        legs += LEG.format(i=i, x=x, y=y, hip=hip, shin=shin, name=name, foot=foot)
        joints += [f"leg_{i}_hip", f"leg_{i}_knee"]
        feet += [f"foot_{i}"]
    floor = contact = sensor = key = ""
    if rng.random() < 0.5:
        floor = '<geom name="floor" type="plane" size="0 0 1" contype="0" conaffinity="0"/>'
        if named:
            contact = f'<contact><pair geom1="{feet[0]}" geom2="floor" friction="0.7"/></contact>'
    if named:
        sensor = f'<sensor><framepos name="{feet[0]}_position" objtype="body" objname="trunk"/>'
        sensor += '<clock name="mine"/></sensor>'
    angles = rng.uniform(-0.2, 0.2, 2 * count).round(3)
    if rng.random() < 0.7:
        qpos = " ".join(map(str, [0, 0, 0.42, 1, 0, 0, 0, *angles]))
        zeros = " 0" * (2 * count - 1)
        moving = rng.choice(["", f'qvel="1 0 0 0 0 0 0{zeros}"', f'ctrl="1{zeros}" time="3"'])
        key = f'<keyframe><key name="home" qpos="{qpos}" {moving}/></keyframe>'
    path = folder / f"made_{seed}.xml"
    path.write_text(
        f'<mujoco model="m">{rng.choice(OPTIONS)}<worldbody>{floor}'
        '<body name="trunk" pos="0 0 0.42"><freejoint/>'
        f'<geom type="box" size="0.2 0.1 0.05" mass="4"/>{legs}</body></worldbody>'
        f"<actuator>{''.join(drive.format(joint) for joint in joints)}</actuator>"
        f"{contact}{sensor}{key}</mujoco>"
    )
    return path


MADE = tuple(range(12))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("export")


@pytest.fixture(scope="module")
def brought(folder):
    """Robots of files that lack this and that."""
    own = folder / "own.xml"
    own.write_text(OWN)
    made = [handmade(folder, seed) for seed in MADE]
    return [load_robot(path) for path in (*made, own, biped_urdf(folder), quadruped(folder))]


def plain(text: str, seconds: float = SECONDS, lift: float = 0.0):
    """Model, and (control steps, nq) positions in plain MuJoCo from the home keyframe on."""
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    data.qpos[2] += lift
    positions = []
    for _ in range(round(seconds / model.opt.timestep / SUBSTEPS)):
        mujoco.mj_step(model, data, SUBSTEPS)
        positions.append(data.qpos.copy())
    return model, np.array(positions)


def ours(robot, embodiment=None, home=None, seconds=SECONDS, lift=0.0, recompute=False):
    """The same of our environment's physics, for the robot itself or one of its designs."""
    physics = NativePhysics(robot, 1, threads=1, substeps=SUBSTEPS)
    home, targets = (robot.home if home is None else home).copy(), robot.nominal
    if embodiment is not None:
        targets = np.asarray(embodiment.nominal, np.float64)
        physics.set_designs(np.arange(1), jax.tree.map(lambda x: np.asarray(x)[None], embodiment))
    if recompute:  # the constants that compiling a file derives from the design
        physics._batch.set_const(np.arange(1))
    home[2] += lift
    physics.set_state(np.arange(1), home, np.zeros(robot.model.nv))
    positions = []
    for _ in range(round(seconds / robot.model.opt.timestep / SUBSTEPS)):
        readings = physics.step(targets[None])
        assert readings.finite[0]
        positions.append(readings.qpos[0].copy())
    return np.array(positions)


def assert_complete(model, robot):
    """Contacts between every foot and the floor and nothing else, sensors, a home at rest."""
    floor, feet = model.geom("floor").id, foot_ids(model)
    pairs = {tuple(sorted(p)) for p in zip(model.pair_geom1, model.pair_geom2, strict=True)}
    assert pairs == {(min(floor, f), max(floor, f)) for f in feet} and len(pairs) == model.npair
    assert robot.num_feet == len(feet) > 0
    assert not model.geom_contype.any() and not model.geom_conaffinity.any()
    for field in ("type", "objtype", "objid", "adr", "dim"):
        name = f"sensor_{field}"
        np.testing.assert_array_equal(getattr(model, name), getattr(robot.model, name))
    for field in ("friction", "solref", "solimp", "margin", "gap"):
        name = f"pair_{field}"
        np.testing.assert_array_equal(getattr(model, name), getattr(robot.model, name))
    np.testing.assert_array_equal(model.pair_dim, robot.model.pair_dim)
    assert (
        model.sensor("imu_angular_velocity").adr[0] == robot.sensors["imu_angular_velocity"].start
    )
    key = model.key("home")
    driven = model.jnt_qposadr[model.actuator_trnid[:, 0]]
    np.testing.assert_array_equal(key.ctrl, key.qpos[driven])
    assert not key.qvel.any() and key.time[0] == 0
    for name in ("timestep", "gravity", "density", "viscosity", "integrator", "iterations"):
        np.testing.assert_array_equal(getattr(model.opt, name), getattr(robot.model.opt, name))


def assert_same_motion(robot):
    """The file holds the very numbers of the robot's model, so the motions are equal. Only the
    order of sums may differ, since our engine does without MuJoCo's shortcuts for equal frames:
    in two seconds a rounding error of 1e-16 cannot grow to a nanometre without an impact.
    """
    model, positions = plain(robot.xml)
    assert_complete(model, robot)
    expected = ours(robot)
    np.testing.assert_allclose(positions[0], expected[0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(positions, expected, rtol=0, atol=1e-6)
    return positions


@pytest.mark.parametrize("name", robots())
def test_shipped_robots(name):
    robot = load_robot(name)
    assert robot.xml == robot.path.read_text()
    assert_same_motion(robot)


def test_brought_robots(brought):
    for robot in brought:
        assert_same_motion(robot)


def test_the_floor_holds_a_brought_robot(folder):
    """Handmade file 0 stands: the trunk stays within a tenth of its height, and no foot sinks."""
    robot = load_robot(handmade(folder, 0))
    model, positions = plain(robot.xml)
    assert positions[-1, 2] > 0.9 * robot.home[2]
    without = re.sub(r"<contact>.*?</contact>", "", robot.xml, flags=re.DOTALL)
    assert plain(without)[1][-1, 2] < -15  # it is the contacts that hold it


def same_robot(a, b):
    assert a.hash == b.hash and a.xml == b.xml and b.inferred == ()
    for name in ("joints", "actuated", "feet", "foot_types", "home", "nominal", "keep_nominal"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
    assert a.sensors == b.sensors and (a.p_gain, a.d_gain) == (b.p_gain, b.d_gain)
    sizes = [np.zeros(mujoco.mj_sizeModel(m), np.uint8) for m in (a.model, b.model)]
    for model, buffer in zip((a.model, b.model), sizes, strict=True):
        mujoco.mj_saveModel(model, None, buffer)
    assert np.array_equal(*sizes)


def test_an_exported_robot_is_the_same_robot(brought, tmp_path):
    for robot in brought:
        path = tmp_path / f"{robot.name}.xml"
        path.write_text(robot.xml)
        same_robot(robot, load_robot(path))


def test_the_written_file_is_written_again_as_it_is(brought, tmp_path):
    for robot in brought:
        first = validate_robot(robot.path).write(tmp_path / "first.xml")
        assert main(["validate", str(first), "--out", str(tmp_path / "second.xml")]) == 0
        assert (tmp_path / "second.xml").read_bytes() == first.read_bytes()
        assert_complete(mujoco.MjModel.from_xml_path(str(first)), robot)


def test_a_file_of_ones_own_is_not_overwritten(tmp_path):
    """Nothing is inferred for it, yet the completed text is another one."""
    path = tmp_path / "own.xml"
    path.write_text(OWN)
    report = validate_robot(path)
    assert report.inferred == ()
    with pytest.raises(ValueError, match="own.xml is the file itself"):
        report.write(path)
    assert path.read_text() == OWN
    written = report.write(tmp_path / "other.xml")
    assert validate_robot(written).write(written) == written


def test_names_of_files_cannot_end_the_comment(tmp_path):
    path = tmp_path / "my--robot-->.xml"
    path.write_text(OWN.replace("_foot", ""))
    robot = load_robot(validate_robot(path).write(tmp_path / "out.xml"))
    assert "Completed from my- -robot- ->" in robot.xml and robot.num_feet == 2


# Designs.

SHIPPED = ("unitree_go2", "custom_hexapod", "bolt", "nao_v5")  # spheres and boxes, 2 to 6 feet


@pytest.fixture(scope="module")
def designs(brought):
    """(robot, body, text) of random designs, two of each robot: near the reference, and in the
    whole space."""
    made = []
    for robot in (*map(load_robot, SHIPPED), *brought[:3], *brought[-3:]):
        with quick_compilation():
            space = DesignSpace(robot)
            for reach in (0.2, 1.0):
                f = np.random.default_rng(space.dim).uniform(-reach, reach, space.dim)
                body = jax.device_get(space(f.astype(np.float32)))
                made.append((robot, body, space.to_mjcf(f.astype(np.float32))))
    return made


def as_written(robot, body):
    """The body with what its file says in a comment that MJCF cannot hold."""
    ranges = np.array(body.jnt_range, np.float64)
    ranges[robot.joints] = ordered_ranges(ranges[robot.joints])
    inertia = balanced(np.asarray(body.body_inertia, np.float64))
    return dataclasses.replace(body, body_inertia=inertia, jnt_range=ranges)


def test_designs(designs):
    """Numbers agree to what the text's digits leave, and so do motions, until a fall amplifies it.

    Exactly at touch, rounding decides which foot the floor pushes first, and with a contact margin
    of 1 mm so it does 1 mm above: both start 2 mm above the floor.
    """
    for index, (robot, body, text) in enumerate(designs):
        model, positions = plain(text, lift=0.002)
        assert_complete(model, robot)
        home = model.key("home").qpos
        expected = ours(robot, as_written(robot, body), home, lift=0.002, recompute=True)
        np.testing.assert_allclose(positions[0], expected[0], rtol=0, atol=1e-7)
        until = len(positions) if index % 2 == 0 else 10  # the near ones do not tumble
        np.testing.assert_allclose(positions[:until], expected[:until], rtol=0, atol=1e-4)


def test_designs_stay_where_the_environment_has_them(designs):
    """Without the concessions to MJCF: inertias as they are, constants of the reference.

    Near the reference these shift a joint by millirads in the first control step, and the trunk's
    height within two seconds by less than a fifth, while robots sink or fall by as much as half.
    """
    for robot, body, text in designs[::2]:
        model, positions = plain(text)
        expected = ours(robot, body, model.key("home").qpos)
        np.testing.assert_allclose(positions[0], expected[0], rtol=0, atol=0.005)
        shift = np.abs(positions[:, 2] - expected[:, 2]).max()
        assert shift < 0.2 * model.key("home").qpos[2], robot.name


def test_an_exported_design_is_a_robot_with_the_same_text(designs, tmp_path):
    for robot, body, text in designs:
        path = tmp_path / f"{robot.name}.xml"
        path.write_text(text, encoding="utf-8")
        design = load_robot(path)
        assert design.xml == text and design.inferred == ()
        assert_same_motion(design)
        np.testing.assert_allclose(design.home[7:][design.qpos_index - 7], body.nominal, rtol=1e-6)


def test_one_step_of_mjx(brought, folder):
    """A control step of MJX, in single precision with an ample number of iterations."""
    robot = load_robot(folder / "own.xml")
    _, positions = plain(robot.xml, seconds=0.02)
    with quick_compilation():
        space = DesignSpace(robot)
        bodies = jax.tree.map(lambda x: np.asarray(x)[None], space(space.reference))
        physics = MjxPhysics(robot, 1, solver_iterations=20, line_search=20)
        state = physics.init(bodies, robot.home, np.zeros(robot.model.nv))
        _, qpos, *_, finite = jax.jit(physics.step)(state, robot.nominal[None])
    assert finite[0]
    np.testing.assert_allclose(qpos[0], positions[0], rtol=0, atol=1e-5)


def test_command_line_of_a_design(brought, folder, monkeypatch, capsys):
    """`design --out` writes the text of the found design."""
    monkeypatch.chdir(folder)
    save_agent(tiny_agent(load_robot("own.xml")), folder / "agent")
    options = ["--agent", str(folder / "agent"), "--method", "random", "--out", "found.xml"]
    with quick_compilation():
        assert main(["design", "own.xml", *options]) == 0
    found = load_robot("found.xml")
    assert_complete(plain(found.xml, seconds=0.02)[0], found)
    assert found.inferred == () and "wrote" in capsys.readouterr().out
