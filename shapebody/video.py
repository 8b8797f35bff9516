"""Pictures and videos of robots.

MuJoCo renders them off screen through EGL, OSMesa or the system's own OpenGL, whichever works;
without any of them they are drawn (`drawing`), and one printed line says how to install OpenGL.
Pictures are uint8[height, width, 3], clips uint8[frames, height, width, 3].
"""

import base64
import contextlib
import copy
import functools
import importlib
import io
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from shapebody import drawing
from shapebody.checks import (
    refuse,
    require_array,
    require_flag,
    require_integer,
    require_list,
    require_number,
    require_output,
    require_text,
)
from shapebody.files import atomic_write

SHOWN_GROUPS = (0, 1, 2)
"""Geom groups in pictures; collision spheres are in group 5."""

_PROBE = """
import importlib, mujoco
context = importlib.import_module("mujoco.{name}").GLContext(16, 16)
context.make_current()
mujoco.MjrContext(mujoco.MjModel.from_xml_string("<mujoco/>"), 150).free()
context.free()
print("works")
"""

_NO_OPENGL = (
    "No OpenGL found, so robots are drawn instead of rendered. To install it: "
    "'apt-get install libegl1 libgl1-mesa-dri' (Debian, Ubuntu), "
    "'dnf install mesa-libEGL mesa-dri-drivers' (Fedora) or "
    "\"conda install -c conda-forge 'mesalib<25.1'\"; then restart the kernel."
)
_NO_FFMPEG = (
    "No ffmpeg found, so videos are animated GIFs. 'pip install imageio-ffmpeg' brings one along."
)


# OpenGL


@functools.cache
def find_opengl() -> str | None:
    """Name of the OpenGL interface that works here ("egl", "osmesa", "glfw", "cgl"), or None.

    Honours MUJOCO_GL ("off" forbids OpenGL). Each candidate is tried once in a process of its own,
    because a broken driver can end the process and a failed attempt cannot be taken back.
    """
    for name in _candidates():
        environment = {k: v for k, v in os.environ.items() if k != "PYOPENGL_PLATFORM"}
        environment["MUJOCO_GL"] = name
        try:
            probe = subprocess.run(
                [sys.executable, "-c", _PROBE.format(name=name)],
                env=environment,
                capture_output=True,
                text=True,
                timeout=60,
            )
        except (OSError, subprocess.TimeoutExpired):
            continue
        if "works" in probe.stdout:
            return name
    return None


def _candidates() -> list[str]:
    wish = os.environ.get("MUJOCO_GL", "").lower().strip()
    if wish in ("disable", "disabled", "off", "false", "0"):
        return []
    if wish in ("egl", "osmesa", "glfw", "cgl"):
        return [wish]
    if sys.platform == "darwin":
        return ["cgl", "glfw"]
    if sys.platform != "linux":
        return ["glfw"]
    display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    return ["egl", "osmesa"] + (["glfw"] if display else [])


@functools.cache
def _say(message: str) -> None:
    print(message)


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
        model = _model_of(model)
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
                _say(f"OpenGL ({interface}) failed with {error!r}, so robots are drawn instead.")
                self._context = self._pixels = None
        elif opengl:
            _say(_NO_OPENGL)

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
        radius = drawing.bone_radius(self.model)
        capsule = mujoco.mjtGeom.mjGEOM_CAPSULE
        colour = np.array(drawing.BONE_COLOUR, np.float32)
        for start, end in zip(*drawing.bones(self.model, self.data), strict=True):
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
        qpos = _check_qpos(self.model, qpos, 1)
        self.data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)

    def distance(self, lookat, azimuth: float = 130.0, elevation: float = -18.0) -> float:
        """Smallest camera distance in m from `lookat` that shows every visible geom."""
        lookat = require_array("lookat", lookat, (3,))
        _require_camera(1.0, azimuth, elevation)
        if len(self.geoms) == 0:
            return 2 * float(self.model.stat.extent)
        right, up, forward = drawing.view_axes(azimuth, elevation)
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
        _require_camera(distance, azimuth, elevation)
        self.place(qpos)
        lookat = self.centre() if lookat is None else require_array("lookat", lookat, (3,))
        if distance is None:
            distance = 1.03 * self.distance(lookat, azimuth, elevation)
        if self._pixels is None:
            return drawing.draw(
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


def _model_of(body, name: str = "body") -> mujoco.MjModel:
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


def _require_camera(distance, azimuth, elevation) -> None:
    if distance is not None:
        require_number("distance", distance, above=0)
    require_number("azimuth", azimuth)
    require_number("elevation", elevation)


def _check_qpos(model, qpos, ndim):
    qpos = require_array("qpos", qpos, finite=False).astype(float)
    expected = f"[{'T, ' if ndim == 2 else ''}{model.nq}]"
    if qpos.ndim != ndim or qpos.shape[-1] != model.nq:
        raise ValueError(f"qpos has shape {list(qpos.shape)}, expected {expected}")
    if not np.isfinite(qpos).all():
        raise ValueError("qpos holds values that are not finite; cut the trajectory before them")
    return qpos


def standing_pose(model: mujoco.MjModel) -> np.ndarray:
    """float64[nq], the keyframe "home", moved up or down until the robot touches z = 0.

    Without one of that name it is the first keyframe, and without any keyframe qpos0. A design has
    other link lengths than the reference, so its own height differs.
    """
    model = _model_of(model)
    home = max(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, "home"), 0)
    qpos = (model.key_qpos[home] if model.nkey else model.qpos0).copy()
    if not (model.njnt and model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE):
        return qpos
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    solid = np.isin(model.geom_group, SHOWN_GROUPS)
    lowest = [_lowest_point(model, data, geom) for geom in np.flatnonzero(solid)]
    qpos[2] -= min((z for z in lowest if z is not None), default=0.0)
    return qpos


def _lowest_point(model, data, geom):
    kind, size = model.geom_type[geom], model.geom_size[geom]
    types = mujoco.mjtGeom
    down = data.geom_xmat[geom].reshape(3, 3)[2]
    if kind == types.mjGEOM_SPHERE:
        reach = size[0]
    elif kind == types.mjGEOM_CAPSULE:
        reach = size[0] + size[1] * abs(down[2])
    elif kind == types.mjGEOM_CYLINDER:
        reach = size[0] * np.hypot(down[0], down[1]) + size[1] * abs(down[2])
    elif kind == types.mjGEOM_ELLIPSOID:
        reach = np.linalg.norm(size * down)
    elif kind == types.mjGEOM_BOX:
        reach = np.abs(size * down).sum()
    else:
        return None
    return data.geom_xpos[geom, 2] - reach


# Pictures and clips


def render_frame(body, qpos=None, *, height=360, width=480, spheres=False, **camera) -> np.ndarray:
    """Picture uint8[height, width, 3] of a Robot or MjModel.

    qpos: [nq], the standing pose if None. spheres: also show the collision spheres. Further
    keywords go to `Renderer.picture` (lookat, distance in m, azimuth, elevation in degrees).
    Raises ValueError for a qpos of the wrong length, TypeError for something without a model.
    """
    model = _model_of(body)
    unknown = camera.keys() - {"lookat", "distance", "azimuth", "elevation"}
    if unknown:
        raise TypeError(
            f"render_frame has no argument {min(unknown)!r}; expected lookat, distance, azimuth or "
            "elevation"
        )
    qpos = standing_pose(model) if qpos is None else _check_qpos(model, qpos, 1)
    with Renderer(model, height, width, spheres, smooth=True) as renderer:
        return renderer.picture(qpos, **camera)


def render_rollout(
    body,
    qpos,
    *,
    fps: float = 25.0,
    step_seconds: float = 0.02,
    height: int = 360,
    width: int = 480,
    distance: float | None = None,
    azimuth: float = 130.0,
    elevation: float = -18.0,
    spheres: bool = False,
) -> np.ndarray:
    """Clip uint8[frames, height, width, 3] of a trajectory `qpos`[T, nq], in real time at `fps`.

    step_seconds: time between rows of `qpos` (control step, 0.02 s). The camera follows the trunk
    horizontally; give `distance` in m to compare robots at one scale.
    """
    model = _model_of(body)
    qpos = _check_qpos(model, qpos, 2)
    if len(qpos) == 0:
        raise ValueError("qpos holds no rows, so there is nothing to show")
    require_number("fps", fps, 0.01, 1000)
    require_number("step_seconds", step_seconds, 1e-6, 1000)
    require_size(height, width)
    _require_camera(distance, azimuth, elevation)
    frames = max(1, round(len(qpos) * step_seconds * fps))
    if frames > 100_000:
        raise ValueError(f"fps is {fps}, which makes {frames:,} pictures; expected at most 100,000")
    rows = np.minimum((np.arange(frames) / (fps * step_seconds)).astype(int), len(qpos) - 1)
    with Renderer(model, height, width, spheres) as renderer:
        trunk = np.empty((len(rows), 3))
        for i, row in enumerate(rows):
            renderer.place(qpos[row])
            trunk[i] = renderer.data.xpos[1]
        lookat = np.column_stack([_smooth(trunk[:, :2], round(0.6 * fps)), trunk[:, 2]])
        lookat[:, 2] = 0.75 * np.median(trunk[:, 2])
        if distance is None:
            distance = 0.0
            for i in range(0, len(rows), max(1, len(rows) // 20)):
                renderer.place(qpos[rows[i]])
                distance = max(distance, renderer.distance(lookat[i], azimuth, elevation))
        return np.stack(
            [
                renderer.picture(qpos[row], target, distance, azimuth, elevation)
                for row, target in zip(rows, lookat, strict=True)
            ]
        )


def _smooth(values, window):
    """Moving average along the first axis with repeated ends."""
    half = min(window // 2, len(values) - 1)
    padded = np.pad(values, ((half, half), (0, 0)), mode="edge")
    total = np.cumsum(np.pad(padded, ((1, 0), (0, 0))), axis=0)
    return (total[2 * half + 1 :] - total[: len(total) - 2 * half - 1]) / (2 * half + 1)


def side_by_side(*clips: np.ndarray, labels: Sequence[str] | None = None) -> np.ndarray:
    """Clips (or pictures) of one height next to each other; short ones hold their last frame."""
    if not clips:
        raise ValueError("side_by_side needs at least one clip")
    if labels is not None:
        labels = _labels(labels, len(clips), "clips")
    clips = [_pictures("a clip", clip) for clip in clips]
    shapes = {clip.shape[-3] for clip in clips}
    if len(shapes) > 1 or len({clip.ndim for clip in clips}) > 1:
        raise ValueError(
            f"clips of shapes {[clip.shape for clip in clips]} do not fit; "
            "render all with one height, and do not mix pictures and clips"
        )
    if labels is not None:
        clips = [with_label(clip, text) for clip, text in zip(clips, labels, strict=True)]
    if clips[0].ndim == 4:
        longest = max(len(clip) for clip in clips)
        clips = [
            np.concatenate([clip, np.repeat(clip[-1:], longest - len(clip), axis=0)])
            for clip in clips
        ]
    return np.concatenate(clips, axis=-2)


def with_label(frames: np.ndarray, text: str) -> np.ndarray:
    """The picture or clip with a bar of text above it."""
    frames = _pictures("frames", frames)
    require_text("text", text)
    width = frames.shape[-2]
    bar_height = 26
    bar = Image.new("RGB", (width, bar_height), "white")
    ImageDraw.Draw(bar).text(
        (width / 2, bar_height / 2),
        text,
        fill=(40, 40, 40),
        anchor="mm",
        font=ImageFont.load_default(size=15),
    )
    bar = np.broadcast_to(np.asarray(bar), (*frames.shape[:-3], bar_height, width, 3))
    return np.concatenate([bar, frames], axis=-3)


def film_strip(frames: np.ndarray, count: int = 6) -> np.ndarray:
    """One picture of `count` frames, evenly spread over the clip, left to right."""
    frames = _check_frames(frames)
    require_integer("count", count, 1, 1000)
    rows = np.linspace(0, len(frames) - 1, count).round().astype(int)
    return np.concatenate([frames[row] for row in rows], axis=1)


def body_grid(
    bodies: Sequence,
    qpos: Sequence | None = None,
    *,
    labels: Sequence[str] | None = None,
    columns: int | None = None,
    height: int = 200,
    width: int = 240,
    azimuth: float = 130.0,
    elevation: float = -14.0,
) -> np.ndarray:
    """One picture of several Robots or MjModels, all at the same scale, in rows of `columns`.

    qpos: one [nq] per body, the standing poses if None.
    """
    bodies = require_list("bodies", bodies, 10_000)
    models = [_model_of(body, "an entry of bodies") for body in bodies]
    if not models:
        raise ValueError("bodies is empty; expected at least one body")
    if labels is not None:
        labels = _labels(labels, len(models), "bodies")
    if columns is not None:
        require_integer("columns", columns, 1)
    require_size(height, width)
    _require_camera(None, azimuth, elevation)
    poses = [standing_pose(m) for m in models] if qpos is None else require_list("qpos", qpos)
    if len(poses) != len(models):
        raise ValueError(f"{len(poses)} qpos for {len(models)} bodies; give one per body")
    poses = [_check_qpos(model, pose, 1) for model, pose in zip(models, poses, strict=True)]
    columns = min(columns or 5, len(models))
    with contextlib.ExitStack() as stack:
        renderers = [
            stack.enter_context(Renderer(model, height, width, smooth=True)) for model in models
        ]
        for renderer, pose in zip(renderers, poses, strict=True):
            renderer.place(pose)
        lookats = np.array([renderer.centre() for renderer in renderers])
        lookats[:, 2] = lookats[:, 2].max()
        distance = 1.03 * max(
            renderer.distance(lookat, azimuth, elevation)
            for renderer, lookat in zip(renderers, lookats, strict=True)
        )
        cells = [
            renderer.picture(pose, lookat, distance, azimuth, elevation)
            for renderer, pose, lookat in zip(renderers, poses, lookats, strict=True)
        ]
    if labels is not None:
        cells = [with_label(cell, text) for cell, text in zip(cells, labels, strict=True)]
    blank = np.full_like(cells[0], 255)
    cells += [blank] * (-len(cells) % columns)
    return np.concatenate(
        [np.concatenate(cells[i : i + columns], axis=1) for i in range(0, len(cells), columns)]
    )


# Showing and saving


def ffmpeg() -> str | None:
    """Path of an ffmpeg program: the one of imageio-ffmpeg, else the system's, else None."""
    try:
        import imageio_ffmpeg

        return imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError):
        return shutil.which("ffmpeg")


def encode_video(frames: np.ndarray, fps: float = 25.0) -> tuple[str, bytes]:
    """Media type and bytes of a clip: H.264 in MP4, or an animated GIF where ffmpeg is missing."""
    frames = _check_frames(frames)
    require_number("fps", fps, 0.01, 1000)
    program = ffmpeg()
    if program is None:
        _say(_NO_FFMPEG)
        return "image/gif", _encode_gif(frames, fps)
    import mediapy

    mediapy.set_ffmpeg(program)
    # Browsers play only subsampled colour, which needs even sizes.
    even = frames[:, : frames.shape[1] // 2 * 2, : frames.shape[2] // 2 * 2]
    return "video/mp4", mediapy.compress_video(
        even,
        fps=fps,
        codec="h264",
        ffmpeg_args="-crf 27 -preset medium -threads 2 -movflags +faststart",
    )


def _encode_gif(frames, fps):
    every = max(1, round(fps / 12.5))
    shrink = max(1.0, frames.shape[2] / 360)
    size = round(frames.shape[2] / shrink), round(frames.shape[1] / shrink)
    pictures = [Image.fromarray(f).resize(size).quantize(96) for f in frames[::every]]
    buffer = io.BytesIO()
    pictures[0].save(
        buffer,
        format="GIF",
        save_all=True,
        append_images=pictures[1:],
        duration=round(1000 * every / fps),
        loop=0,
    )
    return buffer.getvalue()


def _check_frames(frames):
    frames = _pictures("frames", frames)
    if frames.ndim != 4 or len(frames) == 0:
        raise ValueError(
            f"frames are {frames.dtype}{list(frames.shape)}, expected uint8[T, height, width, 3]"
        )
    return frames


def _pictures(name, frames) -> np.ndarray:
    """A picture or a clip; ValueError if it is none."""
    frames = require_array(name, frames, finite=False)
    right = frames.ndim in (3, 4) and frames.shape[-1] == 3 and frames.dtype == np.uint8
    if not right or 0 in frames.shape:
        raise refuse(name, frames, "uint8[height, width, 3], or a clip uint8[T, height, width, 3]")
    return frames


def _labels(labels, count: int, of: str) -> list[str]:
    labels = require_list("labels", labels)
    if len(labels) != count:
        raise ValueError(f"{len(labels)} labels for {count} {of}; give one each")
    return [require_text("a label", label) for label in labels]


def video_html(frames: np.ndarray, fps: float = 25.0, width: int | None = None) -> str:
    """HTML of a clip with the data inside, so that it plays without any other file."""
    _require_width(width)
    kind, data = encode_video(frames, fps)
    source = f"data:{kind};base64,{base64.b64encode(data).decode()}"
    width = width or np.shape(frames)[2]
    if kind.startswith("video"):
        return f'<video controls loop autoplay muted playsinline width="{width}" src="{source}">'
    return f'<img width="{width}" src="{source}">'


def _require_width(width) -> None:
    if width is not None:
        require_integer("width", width, 1, 100_000)


def show_video(frames: np.ndarray, fps: float = 25.0, width: int | None = None) -> None:
    """Play a clip in the notebook. `width` in pixels of the page."""
    from IPython.display import HTML, display

    display(HTML(video_html(frames, fps, width)))


def show_image(picture: np.ndarray, width: int | None = None, colours: int | None = None) -> None:
    """Show a picture in the notebook, as a PNG that also appears where scripts are not run.

    width: in pixels of the page. colours: at most so many (2 to 256), for a file several times
    smaller.
    """
    from IPython.display import Image as Shown
    from IPython.display import display

    picture = require_array("picture", picture, finite=False)
    if (
        picture.dtype != np.uint8
        or picture.ndim not in (2, 3)
        or picture.shape[2:]
        not in (
            (),
            (3,),
            (4,),
        )
    ):
        raise refuse("picture", picture, "uint8[height, width, 3]")
    _require_width(width)
    image = Image.fromarray(picture)
    if colours is not None:
        require_integer("colours", colours, 2, 256)
        image = image.quantize(colours, Image.Quantize.FASTOCTREE)  # keeps rare bright colours
    buffer = io.BytesIO()
    image.save(buffer, format="PNG", optimize=True)
    display(Shown(buffer.getvalue(), width=width))


def save_video(path: str | Path, frames: np.ndarray, fps: float = 25.0) -> Path:
    """Write a clip; the suffix becomes .gif where ffmpeg is missing. Returns the path written."""
    path = require_output("path", path)
    kind, data = encode_video(frames, fps)
    path = path.with_suffix(".mp4" if kind == "video/mp4" else ".gif")
    return atomic_write(path, data)
