import base64
import io
import subprocess
import sys

import mujoco
import numpy as np
import pytest
from PIL import Image
from walker import WALKER

from shapebody.robot.geometry import standing_pose
from shapebody.show import opengl, render, video


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_string(WALKER)


@pytest.fixture(params=["opengl", "drawn"])
def backend(request, monkeypatch):
    """Each test once as this machine renders, once with OpenGL forbidden."""
    if request.param == "drawn":
        monkeypatch.setenv("MUJOCO_GL", "off")
        opengl.find_opengl.cache_clear()
        yield None
        monkeypatch.undo()
        opengl.find_opengl.cache_clear()
    else:
        if opengl.find_opengl() is None:
            pytest.skip("no OpenGL on this machine")
        yield opengl.find_opengl()


def redness(pictures):
    red, green = pictures[..., 0].astype(int), pictures[..., 1].astype(int)
    return (red > 30) & (red > 2 * green)


def test_frame_shows_the_robot(model, backend):
    picture = render.render_frame(model, height=120, width=160)
    assert picture.shape == (120, 160, 3) and picture.dtype == np.uint8
    assert redness(picture).mean() > 0.02


def test_collision_spheres_are_hidden(model, backend):
    def share_of_green(**options):
        picture = render.render_frame(model, height=120, width=160, distance=2.0, **options)
        return ((picture[..., 1] > 90) & (picture[..., 0] < 60)).mean()

    assert share_of_green() == 0
    assert share_of_green(spheres=True) > 0.05


def test_rollout_has_the_right_number_of_frames(model, backend):
    qpos = np.tile(model.qpos0, (50, 1))
    qpos[:, 0] = np.linspace(0, 3, 50)
    frames = video.render_rollout(model, qpos, fps=10, height=60, width=80)
    assert frames.shape == (10, 60, 80, 3) and frames.dtype == np.uint8
    assert redness(frames).sum((1, 2)).min() > 5  # the camera keeps the robot in view


def test_pictures_leave_the_model_alone(model, backend):
    before = model.vis.quality.offsamples, model.vis.global_.offheight
    render.render_frame(model, height=800, width=900)
    assert (model.vis.quality.offsamples, model.vis.global_.offheight) == before


def test_body_grid(model, backend):
    grid = video.body_grid([model] * 3, labels=list("abc"), columns=2, height=60, width=80)
    assert grid.shape == (2 * (60 + 26), 160, 3)


def test_drawing_says_once_how_to_get_opengl(model, monkeypatch, capsys):
    monkeypatch.setattr(render, "find_opengl", lambda: None)
    opengl.say_once.cache_clear()
    render.render_frame(model, height=40, width=40)
    render.render_frame(model, height=40, width=40)
    said = capsys.readouterr().out
    assert said.count("\n") == 1 and "apt-get install libegl1" in said


def test_opengl_that_fails_late_is_replaced_by_drawing(model, monkeypatch, capsys):
    monkeypatch.setattr(render, "find_opengl", lambda: "no_such_interface")
    assert render.render_frame(model, height=40, width=40).shape == (40, 40, 3)
    assert "no_such_interface" in capsys.readouterr().out


def test_opengl_is_found_after_mujoco_was_imported():
    if opengl.find_opengl() is None:
        pytest.skip("no OpenGL on this machine")
    program = (
        "import mujoco; from shapebody.show import render; "
        "model = mujoco.MjModel.from_xml_string('<mujoco><worldbody><body><freejoint/>"
        '<geom size=".1"/></body></worldbody></mujoco>\'); '
        "print(render.render_frame(model, height=32, width=32).shape)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout.strip() == "(32, 32, 3)" and done.stderr == ""


def test_standing_pose_touches_the_floor(model):
    # Foot centre 0.3 below the trunk, radius 0.04.
    assert standing_pose(model)[2] == pytest.approx(0.34)


def test_standing_pose_is_the_home_keyframe():
    def knee(keys):
        keys = "".join(f"<key {name} qpos='0 0 1 1 0 0 0 {angle}'/>" for name, angle in keys)
        text = WALKER.replace("</mujoco>", f"<keyframe>{keys}</keyframe></mujoco>")
        return standing_pose(mujoco.MjModel.from_xml_string(text))[7]

    assert knee([("name='crouch'", 0.9), ("name='home'", 0.2)]) == 0.2
    assert knee([("name='crouch'", 0.9), ("", 0.2)]) == 0.9


def clip(frames=8, height=32, width=48):
    rng = np.random.default_rng(0)
    return rng.integers(0, 255, (frames, height, width, 3), dtype=np.uint8)


def test_video_is_mp4():
    kind, data = video.encode_video(clip(width=47), fps=10)
    assert kind == "video/mp4" and data[4:8] == b"ftyp"
    assert video.video_html(clip()).startswith("<video ")


def test_video_without_ffmpeg_is_a_gif(monkeypatch, tmp_path, capsys):
    import imageio_ffmpeg

    def missing():
        raise RuntimeError("no ffmpeg")

    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", missing)
    monkeypatch.setattr(video.shutil, "which", lambda name: None)
    opengl.say_once.cache_clear()
    kind, data = video.encode_video(clip())
    assert kind == "image/gif" and data[:3] == b"GIF"
    page = video.video_html(clip())
    assert page.startswith("<img ")
    assert base64.b64decode(page.split("base64,")[1].split('"')[0]) == data
    assert video.save_video(tmp_path / "walk.mp4", clip()) == tmp_path / "walk.gif"
    assert "imageio-ffmpeg" in capsys.readouterr().out


def test_side_by_side_holds_the_last_frame():
    long, short = clip(8), clip(3)
    both = video.side_by_side(long, short, labels=["long", "short"])
    assert both.shape == (8, 32 + 26, 96, 3)
    assert np.array_equal(both[7, 26:, 48:], short[2])


def test_film_strip():
    frames = clip(9)
    strip = video.film_strip(frames, 3)
    assert np.array_equal(strip, np.concatenate([frames[0], frames[4], frames[8]], axis=1))


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda m: render.render_frame(m, np.zeros(3)), r"shape \[3\], expected \[8\]"),
        (lambda m: video.render_rollout(m, np.zeros(8)), r"expected \[T, 8\]"),
        (lambda m: video.render_rollout(m, np.zeros((0, 8))), "no rows"),
        (lambda m: video.render_rollout(m, np.full((2, 8), np.nan)), "not finite"),
        (lambda m: video.side_by_side(clip(), clip(height=20)), "one height"),
        (lambda m: video.side_by_side(clip(), labels=["a", "b"]), "2 labels for 1"),
        (lambda m: video.encode_video(np.zeros((3, 4, 4, 3))), "expected uint8"),
        (lambda m: video.body_grid([]), "at least one"),
    ],
)
def test_wrong_input_is_named(model, call, message):
    with pytest.raises(ValueError, match=message):
        call(model)


def test_something_without_a_model_is_refused():
    with pytest.raises(TypeError, match="to_model"):
        render.render_frame(np.zeros(3))


def test_fewer_colours_take_fewer_bytes(monkeypatch):
    shown = []
    monkeypatch.setattr("IPython.display.display", shown.append)
    noise = np.random.default_rng(0).integers(0, 256, (40, 60, 3)).astype(np.uint8)
    video.show_image(noise)
    video.show_image(noise, colours=16)
    every, few = (Image.open(io.BytesIO(picture.data)) for picture in shown)
    assert np.array_equal(np.asarray(every), noise)
    assert few.size == every.size and len(few.getcolors()) <= 16
    assert len(shown[1].data) < len(shown[0].data) / 2
