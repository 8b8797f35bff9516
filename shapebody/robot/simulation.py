"""What plain MuJoCo needs to simulate a robot: sensors, contact pairs, the state "home"."""

import mujoco
import numpy as np

from shapebody.robot.entries import home_qpos
from shapebody.robot.feet import foot_ids
from shapebody.robot.spec_edits import COLLISION_GROUP, keep_inertias_writable

_OBJ, _SENSOR = mujoco.mjtObj, mujoco.mjtSensor


PAIR_FRICTION = (1.0, 1.0, 0.005, 0.0001, 0.0001)


def _layout(model: mujoco.MjModel) -> dict[str, list[tuple]]:
    """Block name -> sensors (name, type, object type, object name) in order."""
    feet = [model.geom(i).name for i in foot_ids(model)]
    spheres = [model.geom(i).name for i in np.flatnonzero(model.geom_group == COLLISION_GROUP)]
    actuators = [model.actuator(i).name for i in range(model.nu)]
    imu = {
        "imu_angular_velocity": _SENSOR.mjSENS_GYRO,
        "imu_linear_velocity": _SENSOR.mjSENS_VELOCIMETER,
        "imu_position": _SENSOR.mjSENS_FRAMEPOS,
        "imu_orientation": _SENSOR.mjSENS_FRAMEQUAT,
    }
    blocks = {name: [(name, kind, _OBJ.mjOBJ_SITE, "imu")] for name, kind in imu.items()}
    for block, suffix, kind, names, owner in (
        ("foot_positions", "position", _SENSOR.mjSENS_FRAMEPOS, feet, _OBJ.mjOBJ_GEOM),
        ("foot_orientations", "orientation", _SENSOR.mjSENS_FRAMEQUAT, feet, _OBJ.mjOBJ_GEOM),
        ("foot_velocities", "velocity", _SENSOR.mjSENS_FRAMELINVEL, feet, _OBJ.mjOBJ_GEOM),
        ("sphere_positions", "position", _SENSOR.mjSENS_FRAMEPOS, spheres, _OBJ.mjOBJ_GEOM),
        ("actuator_forces", "force", _SENSOR.mjSENS_ACTUATORFRC, actuators, _OBJ.mjOBJ_ACTUATOR),
    ):
        blocks[block] = [(f"{name}_{suffix}", kind, owner, name) for name in names]
    return blocks


def sensor_slices(model: mujoco.MjModel) -> dict[str, slice] | None:
    """Slice of sensordata of each block, or None if a block is missing or out of order."""
    slices = {}
    for block, sensors in _layout(model).items():
        ids = [mujoco.mj_name2id(model, _OBJ.mjOBJ_SENSOR, sensor[0]) for sensor in sensors]
        for index, (_, kind, owner, target) in zip(ids, sensors, strict=True):
            if (
                index < 0
                or model.sensor_type[index] != kind
                or model.sensor_objtype[index] != owner
                or model.sensor_objid[index] != mujoco.mj_name2id(model, owner, target)
                or model.sensor_refid[index] >= 0
            ):
                return None
        if ids and ids != list(range(ids[0], ids[0] + len(ids))):
            return None
        start = int(model.sensor_adr[ids[0]]) if ids else 0
        slices[block] = slice(start, start + int(sum(model.sensor_dim[i] for i in ids)))
    return slices


def add_what_simulates(spec: mujoco.MjSpec, model: mujoco.MjModel) -> bool:
    """Add to `spec` the missing sensors and foot-floor pairs, and let "home" be a state at rest
    whose targets are its joint positions. Returns whether anything was changed.

    With these the file simulates in plain MuJoCo as the robot does here.
    """
    return any([_add_sensors(spec, model), _add_pairs(spec, model), _rest_home(spec, model)])


def _add_sensors(spec: mujoco.MjSpec, model: mujoco.MjModel) -> bool:
    if sensor_slices(model) is not None:
        return False
    blocks = _layout(model)
    ours = {sensor[0] for sensors in blocks.values() for sensor in sensors}
    for sensor in [sensor for sensor in spec.sensors if sensor.name in ours]:
        spec.delete(sensor)
    for sensors in blocks.values():
        for name, kind, owner, target in sensors:
            spec.add_sensor(name=name, type=kind, objtype=owner, objname=target)
    return True


def _add_pairs(spec: mujoco.MjSpec, model: mujoco.MjModel) -> bool:
    floor = mujoco.mj_name2id(model, _OBJ.mjOBJ_GEOM, "floor")
    paired = {
        frozenset(pair)
        for pair in zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True)
    }
    missing = [foot for foot in foot_ids(model) if frozenset((floor, int(foot))) not in paired]
    for foot in missing:
        name = mujoco.mj_id2name(model, _OBJ.mjOBJ_GEOM, int(foot))
        spec.add_pair(geomname1="floor", geomname2=name, condim=3, friction=PAIR_FRICTION)
    return len(missing) > 0


def _rest_home(spec: mujoco.MjSpec, model: mujoco.MjModel) -> bool:
    index = mujoco.mj_name2id(model, _OBJ.mjOBJ_KEY, "home")
    targets = home_qpos(model)[model.jnt_qposadr[model.actuator_trnid[:, 0]]]
    if (
        np.array_equal(model.key_ctrl[index], targets)
        and not model.key_qvel[index].any()
        and model.key_time[index] == 0
    ):
        return False
    key = spec.key("home")
    key.time, key.qvel, key.ctrl = 0, np.zeros(model.nv), targets
    return True


def as_text(spec: mujoco.MjSpec, model: mujoco.MjModel) -> tuple[str, mujoco.MjModel]:
    """Text of `spec`, and the model that this text compiles to, to the last digit.

    `model` is the compiled form of `spec`.
    """
    keep_inertias_writable(spec, model)
    text = spec.to_xml()
    return text, mujoco.MjModel.from_xml_string(text)
