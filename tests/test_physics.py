import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import shapebody as sb
from shapebody.design.phi import MODEL_FIELDS
from shapebody.physics.native import NativePhysics
from shapebody.physics.protocol import home_sensordata, prepare

N = 8
STEPS = 25
# Enough iterations for both engines' solvers to converge: with fewer, their different line
# searches end at different points.
SOLVER = {"solver_iterations": 10, "line_search": 20}


@pytest.fixture(scope="module")
def robot():
    return sb.load_robot("unitree_go2")


@pytest.fixture(scope="module")
def space(robot):
    return sb.DesignSpace(robot)


@pytest.fixture(scope="module")
def designs(space):
    return np.stack([space.start(seed) for seed in range(N)])


@pytest.fixture(scope="module")
def embodiments(space, designs):
    return jax.device_get(jax.vmap(space)(designs))


@pytest.fixture(scope="module")
def controls(embodiments):
    noise = np.random.default_rng(0).normal(size=(STEPS, *embodiments.nominal.shape))
    return (embodiments.nominal + 0.2 * noise).astype(np.float32)


@pytest.fixture(scope="module")
def mjx_physics(robot):
    from shapebody.physics.mjx import MjxPhysics

    physics = MjxPhysics(robot, N, **SOLVER)
    return physics, jax.jit(physics.step)


@pytest.fixture
def native(robot, embodiments):
    return start(NativePhysics(robot, N, threads=2, **SOLVER), embodiments)


def start(physics, embodiments):
    ids = np.arange(physics.num_envs)
    physics.set_designs(ids, embodiments)
    physics.set_state(ids, physics.robot.home, np.zeros(physics.model.nv))
    return physics


def copies(readings):
    return [np.array(x) for x in readings]


# Agreement of the engines with each other and with plain MuJoCo.


def test_engines_agree(native, mjx_physics, embodiments, controls, robot):
    """Float32 and float64 part slowly: by rounding at first, then as contacts amplify it."""
    physics, step = mjx_physics
    state = physics.init(embodiments, robot.home, np.zeros(robot.model.nv))
    alive = np.ones(N, bool)
    for time, ctrl in enumerate(controls):
        qpos, qvel, sensordata, finite = copies(native.step(ctrl))
        state, *other = step(state, ctrl)
        other_qpos, other_qvel, other_sensordata, other_finite = copies(other)
        alive &= finite & other_finite
        # Contacts amplify: 25 steps cost three digits (measured: 2e-6, 1e-4 and 2e-5, 6e-4).
        position, other_units = (1e-5, 1e-3) if time < 5 else (2e-4, 1e-2)
        np.testing.assert_allclose(other_qpos[alive], qpos[alive], rtol=0, atol=position)
        np.testing.assert_allclose(other_qvel[alive], qvel[alive], rtol=0, atol=other_units)
        np.testing.assert_allclose(
            other_sensordata[alive], sensordata[alive], rtol=1e-4, atol=other_units
        )
    assert alive.sum() >= N - 2, f"only {alive.sum()} of {N} designs stayed finite"
    assert np.abs(qvel[alive]).max() > 0.5, "nothing moved"


def test_native_is_plain_mujoco(robot, space, designs, controls):
    """Bitwise equal to mj_step on the exported models, raw inertias included."""
    # One by one, as in the export: a batch of designs is rounded differently.
    embodiments = jax.tree.map(lambda *x: np.stack(x), *[space(f) for f in designs])
    physics = start(NativePhysics(robot, N, threads=2), embodiments)
    models = [space.to_model(f) for f in designs]
    for model in models:
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    data = [mujoco.MjData(model) for model in models]
    for one in data:
        one.qpos[:] = robot.home
    alive = np.ones(N, bool)
    for ctrl in controls[:10]:
        readings = physics.step(ctrl)
        alive &= readings.finite
        for i in np.flatnonzero(alive):
            data[i].ctrl[:] = ctrl[i]
            for _ in range(physics.substeps):
                mujoco.mj_step(models[i], data[i])
            np.testing.assert_array_equal(readings.qpos[i], data[i].qpos)
            np.testing.assert_array_equal(readings.qvel[i], data[i].qvel)
            np.testing.assert_array_equal(readings.sensordata[i], data[i].sensordata)
    assert alive.sum() >= N - 2


def test_native_is_a_compiled_model(robot, space, controls):
    """A design written field by field behaves as if MuJoCo had compiled it.

    Near the reference, where the compiler accepts the inertias.
    """
    f = (0.02 * space.start(2)).astype(np.float32)
    model = mujoco.MjModel.from_xml_string(space.to_mjcf(f))
    physics = start(NativePhysics(robot, 1), jax.device_get(jax.vmap(space)(f[None])))
    physics._batch.set_const(np.array([0]))
    data = mujoco.MjData(model)
    data.qpos[:] = robot.home
    for ctrl in controls[:10, :1]:
        readings = physics.step(ctrl)
        data.ctrl[:] = ctrl[0]
        for _ in range(physics.substeps):
            mujoco.mj_step(model, data)
        np.testing.assert_allclose(readings.qpos[0], data.qpos, rtol=0, atol=1e-5)
        np.testing.assert_allclose(readings.sensordata[0], data.sensordata, rtol=1e-4, atol=1e-3)


def test_box_contacts_are_those_of_c():
    from mujoco import mjx
    from mujoco.mjx._src import collision_driver

    from shapebody.physics.mjx import _box_contacts_as_in_c

    model = mujoco.MjModel.from_xml_string("""
        <mujoco><worldbody><geom name="floor" type="plane" size="0 0 1"/>
        <body><freejoint/><geom name="foot" type="box" size="0.1 0.05 0.02" mass="1"/></body>
        </worldbody><contact><pair geom1="floor" geom2="foot"/></contact></mujoco>""")
    data, device = mujoco.MjData(model), mjx.put_model(model)

    @jax.jit
    def contacts(qpos):
        moved = mjx.kinematics(device, mjx.make_data(model).replace(qpos=qpos))
        with _box_contacts_as_in_c():
            contact = collision_driver.collision(device, moved)._impl.contact
        return contact.dist, contact.pos, contact.frame

    rng = np.random.default_rng(0)
    for _ in range(20):
        data.qpos[:] = [0, 0, rng.uniform(0, 0.1), *rng.normal(size=4)]
        mujoco.mj_normalizeQuat(model, data.qpos)
        mujoco.mj_forward(model, data)
        dist, pos, frame = copies(contacts(jnp.asarray(data.qpos)))
        assert dist.shape == (4,)
        touching = np.flatnonzero(dist < 0)
        touching = touching[np.argsort(dist[touching])]
        order = np.argsort(data.contact.dist)
        np.testing.assert_allclose(dist[touching], data.contact.dist[order], atol=1e-6)
        np.testing.assert_allclose(pos[touching], data.contact.pos[order], atol=1e-6)
        np.testing.assert_allclose(
            frame[touching].reshape(-1, 9), data.contact.frame[order], atol=1e-6
        )


# State.


def test_restore_is_exact(native, robot, embodiments, controls):
    for ctrl in controls[:5]:
        native.step(ctrl)
    saved = native.state()
    expected = [copies(native.step(ctrl)) for ctrl in controls[5:10]]

    other = NativePhysics(robot, N, threads=1, **SOLVER)
    other.set_designs(np.arange(N), embodiments)
    other.restore(saved)
    for ctrl, readings in zip(controls[5:10], expected, strict=True):
        for one, two in zip(copies(other.step(ctrl)), readings, strict=True):
            np.testing.assert_array_equal(one, two)
    assert np.all(other.time == native.time) and saved["time"][0] == pytest.approx(5 * 0.02)


def test_live_arrays_are_the_state(native, controls):
    native.qvel[:, 2] = 1.0
    height = native.qpos[:, 2].copy()
    readings = native.step(controls[0])
    assert np.all(readings.qpos[:, 2] > height)
    assert readings.qpos is native.qpos and readings.qpos.dtype == np.float64
    qvel = np.zeros_like(native.qvel)
    one = copies(native.step(controls[1], qpos=np.tile(native.robot.home, (N, 1)), qvel=qvel))
    assert np.all(np.abs(one[0] - native.robot.home) < 0.5)


def test_designs_of_some_simulations(native, robot, embodiments, controls):
    """Only the named simulations change, in any order of the ids."""
    before = [native.get_model(i) for i in range(N)]
    ids = np.array([5, 2])
    native.set_designs(ids, jax.tree.map(lambda x: x[:2], embodiments))
    for i in range(N):
        source = {5: 0, 2: 1}.get(i, i)
        for name in MODEL_FIELDS:
            expected = getattr(embodiments, name)[source].astype(float)
            np.testing.assert_array_equal(getattr(native.get_model(i), name), expected)
            if source == i:
                np.testing.assert_array_equal(getattr(before[i], name), expected)


def test_only_running_simulations_move(native, robot, embodiments, controls):
    alone = start(NativePhysics(robot, N, threads=2, **SOLVER), embodiments)
    running = np.arange(N) % 3 == 0
    native.step(controls[0]), alone.step(controls[0])
    before = native.state()
    for ctrl in controls[1:5]:
        expected = copies(alone.step(ctrl))
        readings = copies(native.step(ctrl, running=running))
        for one, two in zip(readings, expected, strict=True):
            np.testing.assert_array_equal(one[running], two[running])
    for name in ("qpos", "qvel", "time"):
        np.testing.assert_array_equal(native.state()[name][~running], before[name][~running])
    assert readings[-1].all()


@pytest.mark.parametrize("value", [1e39, np.nan])
def test_sensor_values_beyond_single_precision_are_failures(
    native, robot, controls, value, monkeypatch
):
    sensordata = np.array(native.step(controls[0]).sensordata)
    sensordata[3, -1] = value
    monkeypatch.setattr(native, "_sensordata", sensordata)
    readings = native.step(controls[1], running=np.zeros(N, bool))
    np.testing.assert_array_equal(np.flatnonzero(~readings.finite), [3])
    np.testing.assert_array_equal(readings.sensordata[3], home_sensordata(robot, prepare(robot)))


def test_mjx_reset(mjx_physics, embodiments, controls, robot):
    physics, step = mjx_physics
    state = physics.init(embodiments, robot.home, np.zeros(robot.model.nv))
    state, *_ = step(state, controls[0])
    mask = np.arange(N) % 2 == 0
    swapped = jax.tree.map(lambda x: x[::-1], embodiments)
    fresh = physics.reset(state, mask, swapped, robot.home, np.ones((N, robot.model.nv)))
    np.testing.assert_array_equal(fresh.qpos[~mask], state.qpos[~mask])
    np.testing.assert_array_equal(fresh.qacc_warmstart[~mask], state.qacc_warmstart[~mask])
    np.testing.assert_array_equal(fresh.qpos[mask], np.float32(np.tile(robot.home, (N // 2, 1))))
    assert np.all(fresh.qvel[mask] == 1) and not np.any(fresh.qacc_warmstart[mask])
    mass = fresh.design["body_mass"]
    np.testing.assert_array_equal(mass[mask], swapped.body_mass[mask])
    np.testing.assert_array_equal(mass[~mask], embodiments.body_mass[~mask])
    moved = physics.with_velocity(fresh, 2 * physics.velocity(fresh))
    np.testing.assert_array_equal(moved.qvel, 2 * fresh.qvel)


# Failures.

FAILURES = {
    "huge velocity": ("qvel", 7, 1e12),
    "fast": ("qvel", slice(6, 12), 1e7),
    "nan position": ("qpos", 9, np.nan),
    "infinite velocity": ("qvel", 0, np.inf),
    "nan control": ("ctrl", 3, np.nan),
    "huge control": ("ctrl", 3, 1e20),
}


@pytest.mark.parametrize("failure", FAILURES)
def test_native_failure_is_contained(
    failure, robot, embodiments, controls, capfd, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    engines = [start(NativePhysics(robot, N, threads=2, **SOLVER), embodiments) for _ in range(2)]
    field, index, value = FAILURES[failure]
    ctrl = controls[0].astype(float)
    if field == "ctrl":
        ctrl[3, index] = value
    else:
        getattr(engines[0], field)[3, index] = value
    broken, sound = copies(engines[0].step(ctrl)), copies(engines[1].step(controls[0]))
    others = np.arange(N) != 3
    np.testing.assert_array_equal(broken[3], others)
    np.testing.assert_array_equal(broken[0][3], robot.home)
    assert not broken[1][3].any()
    model = prepare(robot)
    np.testing.assert_array_equal(broken[2][3], home_sensordata(robot, model))
    for one, two in zip(broken, sound, strict=True):
        np.testing.assert_array_equal(one[others], two[others])
    again = copies(engines[0].step(controls[1]))
    assert again[3].all(), "the failed simulation goes on from the home pose"
    np.testing.assert_array_equal(again[0][others], copies(engines[1].step(controls[1]))[0][others])
    printed = capfd.readouterr()
    assert printed.out == "" and printed.err == ""
    assert list(tmp_path.iterdir()) == [], "MuJoCo wrote a log"


def test_log_is_restored(native, controls, capfd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    native.step(controls[0])
    data = mujoco.MjData(native.model)
    data.qvel[:] = np.nan
    mujoco.mj_step(native.model, data)
    assert "unstable" in capfd.readouterr().err


def test_native_error_is_contained(native, controls, monkeypatch):
    from mujoco.batch import SimulationError

    step = native._batch.step

    def raising(**options):
        step(**options)
        raise SimulationError(np.array([1, 4]), "out of memory")

    monkeypatch.setattr(native._batch, "step", raising)
    readings = native.step(controls[0])
    np.testing.assert_array_equal(np.flatnonzero(~readings.finite), [1, 4])
    np.testing.assert_array_equal(readings.qpos[4], native.robot.home)


def test_mjx_sensor_values_that_are_not_finite_are_failures(
    mjx_physics, embodiments, controls, robot, monkeypatch
):
    from mujoco import mjx

    physics, _ = mjx_physics
    state = physics.init(embodiments, robot.home, np.zeros(robot.model.nv))
    step = mjx.step

    def broken(model, data):
        data = step(model, data)
        bad = jnp.where(data.qpos[2] > 0, jnp.inf, data.sensordata[-1])
        return data.replace(sensordata=data.sensordata.at[-1].set(bad))

    monkeypatch.setattr(mjx, "step", broken)
    _, *readings = physics.step(state, controls[0])
    assert not readings[3].any() and np.isfinite(readings[2]).all()


@pytest.mark.parametrize("failure", FAILURES)
def test_mjx_failure_is_contained(failure, mjx_physics, embodiments, controls, robot):
    physics, step = mjx_physics
    state = physics.init(embodiments, robot.home, np.zeros(robot.model.nv))
    field, index, value = FAILURES[failure]
    ctrl, broken = jnp.asarray(controls[0]), state
    if field == "ctrl":
        ctrl = ctrl.at[3, index].set(value)
    else:
        values = getattr(state, field).at[3, index].set(value)
        broken = dataclasses.replace(state, **{field: values})
    after, *readings = step(broken, ctrl)
    readings, sound = copies(readings), copies(step(state, controls[0])[1:])
    others = np.arange(N) != 3
    np.testing.assert_array_equal(readings[3], others)
    np.testing.assert_array_equal(readings[0][3], robot.home.astype(np.float32))
    assert all(np.isfinite(x).all() for x in readings)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(after))
    for one, two in zip(readings, sound, strict=True):
        np.testing.assert_array_equal(one[others], two[others])


# Constants and options.

# What MuJoCo derives from a design; of these, only the bounding radius is also given by it.
DERIVED = {
    "actuator_acc0", "body_invweight0", "body_subtreemass", "cam_mat0", "cam_pos0", "cam_poscom0",
    "dof_M0", "dof_invweight0", "dof_length", "geom_aabb", "geom_rbound", "geom_sameframe",
    "light_dir0", "light_pos0", "light_poscom0",
}  # fmt: skip


def test_derived_constants_stay_those_of_the_reference(robot, embodiments):
    physics = NativePhysics(robot, N)
    physics.set_designs(np.array([6, 1]), jax.tree.map(lambda x: x[:2], embodiments))
    one = physics.get_model(6)
    physics._batch.set_const(np.array([6]))
    two = physics.get_model(6)
    different = set()
    for name in dir(one):
        value = getattr(one, name) if not name.startswith("_") else None
        if isinstance(value, np.ndarray) and not np.array_equal(value, getattr(two, name)):
            different.add(name)
    assert {"body_invweight0", "body_subtreemass", "dof_invweight0"} <= different <= DERIVED
    for name in DERIVED - {"geom_rbound", "geom_sameframe"}:
        np.testing.assert_array_equal(getattr(one, name), getattr(robot.model, name))
    np.testing.assert_allclose(one.geom_rbound, two.geom_rbound, atol=1e-6)
    assert two.body_subtreemass[1] == pytest.approx(embodiments.body_mass[0].sum())


def test_reference_is_the_robot(robot, space, controls):
    """Without set_designs the engine runs the reference; f = 0 is the same up to float32."""
    plain = NativePhysics(robot, 1)
    written = start(NativePhysics(robot, 1), jax.device_get(jax.vmap(space)(space.reference[None])))
    ctrl = np.tile(robot.nominal, (1, 1))
    np.testing.assert_array_equal(plain.qpos[0], robot.home)
    for _ in range(5):
        one, two = plain.step(ctrl), written.step(ctrl)
    np.testing.assert_allclose(one.qpos, two.qpos, atol=1e-5)
    np.testing.assert_allclose(one.sensordata, two.sensordata, atol=1e-3)


def test_solver_options(robot):
    physics = NativePhysics(robot, 1, solver_iterations=3, line_search=5, substeps=2)
    assert (physics.model.opt.iterations, physics.model.opt.ls_iterations) == (3, 5)
    physics.step(robot.nominal[None])
    assert physics.time[0] == pytest.approx(2 * robot.model.opt.timestep)


# Clear errors.


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda p, e: p.set_designs(np.arange(3), e), "3 designs of unitree_go2 need"),
        (lambda p, e: p.set_designs(np.arange(N) + 1, e), "0 to 7"),
        (lambda p, e: p.set_designs(np.ones(N, bool), e), "flatnonzero"),
        (lambda p, e: p.set_state(np.array([[0]]), p.robot.home, np.zeros(18)), "vector"),
        (lambda p, e: p.set_state(np.array([0]), np.zeros(18), np.zeros(18)), "qpos has shape"),
        (
            lambda p, e: p.set_state(np.array([0]), p.robot.home, np.zeros((2, 18))),
            "qvel has shape",
        ),
        (lambda p, e: p.step(np.zeros((N, 11))), r"ctrl has shape \(8, 11\)"),
        (lambda p, e: p.step(np.zeros((N, 12)), qvel=np.zeros(18)), "qvel has shape"),
        (
            lambda p, e: p.step(np.ones((N, 12)), running=np.ones(3, bool)),
            r"running has shape \(3,\)",
        ),
        (lambda p, e: p.restore({"qpos": p.qpos}), "lacks qvel"),
        (lambda p, e: p.restore(p.state() | {"time": np.zeros(3)}), "time has shape"),
        (lambda p, e: p.get_model(N), "0 to 7"),
    ],
)
def test_native_errors(native, embodiments, call, message):
    before = native.state()
    with pytest.raises(ValueError, match=message):
        call(native, embodiments)
    for name, value in native.state().items():
        np.testing.assert_array_equal(value, before[name])


def test_constructor_errors(robot):
    from shapebody.physics.mjx import MjxPhysics

    with pytest.raises(ValueError, match="threads"):
        NativePhysics(robot, 1, threads=-1)
    for options in ({"num_envs": 0}, {"substeps": 0}, {"line_search": 1.5}):
        with pytest.raises(ValueError, match=next(iter(options))):
            NativePhysics(robot, **({"num_envs": 1} | options))
        with pytest.raises(ValueError, match=next(iter(options))):
            MjxPhysics(robot, **({"num_envs": 1} | options))


def test_mjx_errors(mjx_physics, embodiments, robot):
    physics, _ = mjx_physics
    state = physics.init(embodiments, robot.home, np.zeros(robot.model.nv))
    few = jax.tree.map(lambda x: x[:3], embodiments)
    with pytest.raises(ValueError, match="8 designs of unitree_go2 need"):
        physics.init(few, robot.home, np.zeros(robot.model.nv))
    with pytest.raises(ValueError, match="qpos has shape"):
        physics.init(embodiments, robot.home[1:], np.zeros(robot.model.nv))
    with pytest.raises(ValueError, match="ctrl has shape"):
        physics.step(state, jnp.zeros((N, 11)))
    with pytest.raises(ValueError, match="mask is .*; expected an array of True and False"):
        physics.reset(state, np.arange(N), embodiments, robot.home, np.zeros(robot.model.nv))


def test_single_rigid_body_is_refused():
    model = mujoco.MjModel.from_xml_string("""
        <mujoco><worldbody><body name="block"><freejoint/><geom size="0.1"/></body></worldbody>
        </mujoco>""")
    with pytest.raises(ValueError, match="'block' is a single rigid body"):
        prepare(dataclasses.replace(sb.load_robot("unitree_go2"), name="ball", model=model))
