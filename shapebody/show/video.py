"""Pictures and videos of robots.

MuJoCo renders them off screen through EGL, OSMesa or the system's own OpenGL, whichever works;
without any of them they are drawn (`software_renderer`), and one printed line says how to install
OpenGL. Pictures are uint8[height, width, 3], clips uint8[frames, height, width, 3].
"""

import base64
import contextlib
import io
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from shapebody.arguments import (
    refuse,
    require_array,
    require_integer,
    require_list,
    require_number,
    require_output,
    require_text,
)
from shapebody.files import atomic_write
from shapebody.robot.geometry import standing_pose
from shapebody.show.opengl import say_once
from shapebody.show.render import (
    Renderer,
    model_of,
    require_camera,
    require_qpos,
    require_size,
)

_NO_FFMPEG = (
    "No ffmpeg found, so videos are animated GIFs. 'pip install imageio-ffmpeg' brings one along."
)


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
    model = model_of(body)
    qpos = require_qpos(model, qpos, 2)
    if len(qpos) == 0:
        raise ValueError("qpos holds no rows, so there is nothing to show")
    require_number("fps", fps, 0.01, 1000)
    require_number("step_seconds", step_seconds, 1e-6, 1000)
    require_size(height, width)
    require_camera(distance, azimuth, elevation)
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
        say_once(_NO_FFMPEG)
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
    """The array; ValueError unless it is a picture or a clip."""
    frames = require_array(name, frames, finite=False)
    right = frames.ndim in (3, 4) and frames.shape[-1] == 3 and frames.dtype == np.uint8
    if not right or 0 in frames.shape:
        raise refuse(name, frames, "uint8[height, width, 3], or a clip uint8[T, height, width, 3]")
    return frames


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


SHOWN = ((), (3,), (4,))
"""Last axis of a picture that can be shown: grey, colours, colours with opacity."""


def show_image(picture: np.ndarray, width: int | None = None, colours: int | None = None) -> None:
    """Show a picture in the notebook, as a PNG that also appears where scripts are not run.

    width: in pixels of the page. colours: at most so many (2 to 256), for a file several times
    smaller.
    """
    from IPython.display import Image as Shown
    from IPython.display import display

    picture = require_array("picture", picture, finite=False)
    if picture.dtype != np.uint8 or picture.ndim not in (2, 3) or picture.shape[2:] not in SHOWN:
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
    models = [model_of(body, "an entry of bodies") for body in bodies]
    if not models:
        raise ValueError("bodies is empty; expected at least one body")
    if labels is not None:
        labels = _labels(labels, len(models), "bodies")
    if columns is not None:
        require_integer("columns", columns, 1)
    require_size(height, width)
    require_camera(None, azimuth, elevation)
    poses = [standing_pose(m) for m in models] if qpos is None else require_list("qpos", qpos)
    if len(poses) != len(models):
        raise ValueError(f"{len(poses)} qpos for {len(models)} bodies; give one per body")
    poses = [require_qpos(model, pose, 1) for model, pose in zip(models, poses, strict=True)]
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


def _labels(labels, count: int, of: str) -> list[str]:
    labels = require_list("labels", labels)
    if len(labels) != count:
        raise ValueError(f"{len(labels)} labels for {count} {of}; give one each")
    return [require_text("a label", label) for label in labels]
