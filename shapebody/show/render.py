"""Pictures of robots in their poses."""

import copy
import importlib

import mujoco
import numpy as np

from shapebody.arguments import (
    refuse,
    require_array,
    require_flag,
    require_integer,
    require_number,
)
from shapebody.robot.geometry import SHOWN_GROUPS, standing_pose
from shapebody.show import software_renderer
from shapebody.show.opengl import NO_OPENGL, find_opengl, say_once


class Renderer:
    """Pictures of one model. A context manager, because a renderer left open holds OpenGL state.

    spheres: also show the collision spheres. smooth: four samples per pixel, for stills.
    opengl: False draws without OpenGL, even where there is one.

    >>> with Renderer(model, height=240, width=320) as renderer:
    ...     picture = renderer.picture(qpos)
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        height: int = 360,
        width: int = 480,
        spheres: bool = False,
        smooth: bool = False,
        opengl: bool = True,
    ):
        model = model_of(model)
        require_size(height, width)
        for name, value in (("spheres", spheres), ("smooth", smooth), ("opengl", opengl)):
            require_flag(name, value)
        self.height, self.width = height, width
        self._detail = 2 if smooth else 1
        rows, columns = self._detail * height, self._detail * width
        # Multisampling makes software rendering several times slower; it is fixed at this point.
        self.model = drawn = copy.deepcopy(model)
        drawn.vis.quality.offsamples = 0
        drawn.vis.global_.offheight = max(rows, drawn.vis.global_.offheight)
        drawn.vis.global_.offwidth = max(columns, drawn.vis.global_.offwidth)
        self.data = mujoco.MjData(drawn)
        groups = (*SHOWN_GROUPS, 5) if spheres else SHOWN_GROUPS
        self.geoms = np.flatnonzero(
            np.isin(drawn.geom_group, groups) & (drawn.geom_type != mujoco.mjtGeom.mjGEOM_PLANE)
        )
        self._context = self._pixels = None
        interface = find_opengl() if opengl else None
        if interface:
            try:
                self._open(interface, groups, rows, columns)
            except Exception as error:  # the kinds differ by interface, and a drawing is enough
                say_once(f"OpenGL ({interface}) failed with {error!r}: robots are drawn instead.")
                self._context = self._pixels = None
        elif opengl:
            say_once(NO_OPENGL)

    def _open(self, name, groups, rows, columns):
        self._context = importlib.import_module(f"mujoco.{name}").GLContext(columns, rows)
        self._context.make_current()
        self._pixels = mujoco.MjrContext(self.model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._pixels)
        self._scene = mujoco.MjvScene(self.model, maxgeom=2 * self.model.ngeom + 200)
        for flag in ("SHADOW", "REFLECTION", "HAZE"):
            self._scene.flags[getattr(mujoco.mjtRndFlag, f"mjRND_{flag}")] = False
        self._option = mujoco.MjvOption()
        self._option.geomgroup[:] = np.isin(np.arange(len(self._option.geomgroup)), groups)
        self._option.sitegroup[:] = 0
        self._option.jointgroup[:] = 0
        self._option.actuatorgroup[:] = 0
        self._camera = mujoco.MjvCamera()
        self._rectangle = mujoco.MjrRect(0, 0, columns, rows)

    def _add_bones(self):
        radius = software_renderer.bone_radius(self.model)
        capsule = mujoco.mjtGeom.mjGEOM_CAPSULE
        colour = np.array(software_renderer.BONE_COLOUR, np.float32)
        for start, end in zip(*software_renderer.bones(self.model, self.data), strict=True):
            rod = self._scene.geoms[self._scene.ngeom]
            mujoco.mjv_initGeom(rod, capsule, np.zeros(3), np.zeros(3), np.zeros(9), colour)
            mujoco.mjv_connector(rod, capsule, radius, start, end)
            self._scene.ngeom += 1

    def close(self) -> None:
        """Free the OpenGL context. May be called twice."""
        if self._pixels is not None:
            self._context.make_current()
            self._pixels.free()
            self._context.free()
        self._context = self._pixels = None

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def place(self, qpos) -> None:
        """Forward kinematics at `qpos`[nq]."""
        qpos = require_qpos(self.model, qpos, 1)
        self.data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)

    def distance(self, lookat, azimuth: float = 130.0, elevation: float = -18.0) -> float:
        """Smallest camera distance in m from `lookat` that shows every visible geom."""
        lookat = require_array("lookat", lookat, (3,))
        require_camera(1.0, azimuth, elevation)
        if len(self.geoms) == 0:
            return 2 * float(self.model.stat.extent)
        right, up, forward = software_renderer.view_axes(azimuth, elevation)
        offset = self.data.geom_xpos[self.geoms] - lookat
        reach = self.model.geom_rbound[self.geoms]
        slope = np.tan(np.radians(self.model.vis.global_.fovy) / 2)
        sideways = (np.abs(offset @ right) + reach) / (slope * self.width / self.height)
        vertical = (np.abs(offset @ up) + reach) / slope
        return float(np.max(np.maximum(sideways, vertical) - offset @ forward))

    def centre(self) -> np.ndarray:
        """float64[3], middle of the box around all visible geoms; the trunk if there is none."""
        if len(self.geoms) == 0:
            return self.data.xpos[1].copy()
        place, reach = self.data.geom_xpos[self.geoms], self.model.geom_rbound[self.geoms, None]
        return ((place - reach).min(0) + (place + reach).max(0)) / 2

    def picture(
        self, qpos, lookat=None, distance=None, azimuth: float = 130.0, elevation: float = -18.0
    ) -> np.ndarray:
        """uint8[height, width, 3] at `qpos`[nq].

        lookat: point (3) in m at the centre of the picture, the middle of the robot if None.
        distance: of the camera from it in m; if None, so that the robot fills the picture. Angles
        in degrees.
        """
        require_camera(distance, azimuth, elevation)
        self.place(qpos)
        lookat = self.centre() if lookat is None else require_array("lookat", lookat, (3,))
        if distance is None:
            distance = 1.03 * self.distance(lookat, azimuth, elevation)
        if self._pixels is None:
            return software_renderer.draw(
                self.model,
                self.data,
                self.geoms,
                lookat,
                distance,
                azimuth,
                elevation,
                self.height,
                self.width,
            )
        self._context.make_current()
        self._camera.lookat[:] = lookat
        self._camera.distance = distance
        self._camera.azimuth = azimuth
        self._camera.elevation = elevation
        mujoco.mjv_updateScene(
            self.model,
            self.data,
            self._option,
            None,
            self._camera,
            mujoco.mjtCatBit.mjCAT_ALL.value,
            self._scene,
        )
        self._add_bones()
        mujoco.mjr_render(self._rectangle, self._scene, self._pixels)
        rows, columns = self._rectangle.height, self._rectangle.width
        flipped = np.empty((rows, columns, 3), np.uint8)
        mujoco.mjr_readPixels(flipped, None, self._rectangle, self._pixels)
        fine = flipped[::-1].reshape(self.height, self._detail, self.width, self._detail, 3)
        return fine[:, 0, :, 0].copy() if self._detail == 1 else fine.mean((1, 3)).astype(np.uint8)


def model_of(body, name: str = "body") -> mujoco.MjModel:
    """The model of a Robot, or the model itself; TypeError for anything else."""
    model = getattr(body, "model", body)
    if not isinstance(model, mujoco.MjModel):
        expected = "a mujoco.MjModel or a Robot; for a design, space.to_model(f)"
        raise refuse(name, body, expected, kind=TypeError)
    return model


MOST_PIXELS = 8192
"""Largest height and width of a picture."""


def require_size(height, width) -> None:
    """ValueError if there can be no picture of that size."""
    require_integer("height", height, 16, MOST_PIXELS)
    require_integer("width", width, 16, MOST_PIXELS)


def require_camera(distance, azimuth, elevation) -> None:
    """ValueError unless distance (m, or None) is positive, and the angles (degrees) are numbers."""
    if distance is not None:
        require_number("distance", distance, above=0)
    require_number("azimuth", azimuth)
    require_number("elevation", elevation)


def require_qpos(model, qpos, ndim: int) -> np.ndarray:
    """One pose float64[nq], or with `ndim` 2 a trajectory [T, nq]; ValueError for anything else."""
    qpos = require_array("qpos", qpos, finite=False).astype(float)
    expected = f"[{'T, ' if ndim == 2 else ''}{model.nq}]"
    if qpos.ndim != ndim or qpos.shape[-1] != model.nq:
        raise ValueError(f"qpos has shape {list(qpos.shape)}, expected {expected}")
    if not np.isfinite(qpos).all():
        raise ValueError("qpos holds values that are not finite; cut the trajectory before them")
    return qpos


def render_frame(body, qpos=None, *, height=360, width=480, spheres=False, **camera) -> np.ndarray:
    """Picture uint8[height, width, 3] of a Robot or MjModel.

    qpos: [nq], the standing pose if None. spheres: also show the collision spheres. Further
    keywords go to `Renderer.picture` (lookat, distance in m, azimuth, elevation in degrees).
    Raises ValueError for a qpos of the wrong length, TypeError for something without a model.
    """
    model = model_of(body)
    unknown = camera.keys() - {"lookat", "distance", "azimuth", "elevation"}
    if unknown:
        raise TypeError(
            f"render_frame has no argument {min(unknown)!r}; expected lookat, distance, azimuth or "
            "elevation"
        )
    qpos = standing_pose(model) if qpos is None else require_qpos(model, qpos, 1)
    with Renderer(model, height, width, spheres, smooth=True) as renderer:
        return renderer.picture(qpos, **camera)
