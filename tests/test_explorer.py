import base64
import gzip
import html
import json
import re

import mujoco
import numpy as np
import pytest
from walker import WALKER

from shapebody.design.space import DesignSpace
from shapebody.show import scene as show_scene


class Space(DesignSpace):
    """One parameter, the length of the leg."""

    dim = 1

    def __init__(self):
        pass

    reference = np.zeros(1, np.float32)

    def to_model(self, f):
        leg = 0.3 + 0.1 * float(f[0])
        return mujoco.MjModel.from_xml_string(WALKER.replace("-0.3", f"{-leg:.4f}"))


def commands(scene, kind):
    return [command for command in scene.commands if command["type"] == kind]


def test_scene_is_one_page_without_a_server():
    page = show_scene.show_design(Space()).static_html()
    assert "MeshCat.Viewer" in page and "@commands@" not in page
    assert 5e5 < len(page) < 1.2e6


def test_scene_is_the_same_every_time():
    assert (
        show_scene.show_design(Space()).static_html()
        == show_scene.show_design(Space()).static_html()
    )


def test_capsules_are_a_shaft_and_two_balls():
    paths = {command["path"] for command in commands(show_scene.show_design(Space()), "set_object")}
    capsule = 4  # floor, box, ellipsoid, hidden sphere, capsule
    assert {f"/robot/geom_{capsule}{role}" for role in ("_shaft", "_top", "_bottom")} <= paths
    assert not any(path.startswith("/robot/geom_3") for path in paths)
    shown = commands(show_scene.show_design(Space(), spheres=True), "set_object")
    assert "/robot/geom_3" in {command["path"] for command in shown}


def test_foot_is_where_mujoco_puts_it():
    scene = show_scene.show_design(Space(), np.array([1.0]))
    foot = next(c for c in commands(scene, "set_transform") if c["path"] == "/robot/geom_6")
    matrix = np.reshape(foot["matrix"], (4, 4)).T
    assert matrix[:3, 3] == pytest.approx([0.1, 0, 0.04], abs=1e-4)
    assert matrix[:3, :3] == pytest.approx(0.04 * np.eye(3), abs=1e-4)


def test_floor_is_an_opaque_plate_just_below_the_feet():
    scene = show_scene.show_design(Space())
    floor = next(c for c in commands(scene, "set_object") if c["path"] == "/floor")
    (material,) = floor["object"]["materials"]
    assert material["type"] == "MeshBasicMaterial"  # its colour does not depend on the lights
    assert material["opacity"] == 1 and not material["transparent"]
    background = [c["value"] for c in scene.commands if c.get("property") == "bottom_color"]
    shades = [material["color"] >> 16 & 255, 255 * background[0][0]]
    assert shades[0] < shades[1] - 20
    place = next(c for c in commands(scene, "set_transform") if c["path"] == "/floor")
    matrix = np.reshape(place["matrix"], (4, 4)).T
    assert -0.01 < matrix[2, 3] + matrix[2, 2] < 0  # its top
    assert matrix[0, 0] >= 5 and matrix[1, 1] >= 5


def test_animation_moves_only_what_changes():
    scene = show_scene.animate_designs(Space(), np.linspace(0, 1, 11)[:, None], frames=5)
    (animation,) = commands(scene, "set_animation")
    tracks = {clip["path"]: clip["clip"]["tracks"] for clip in animation["animations"]}
    foot = {track["name"]: track["keys"] for track in tracks["/robot/geom_6"]}
    assert list(foot) == [".position"] and len(foot[".position"]) == 5
    assert {track["name"] for track in tracks["/robot/geom_4_shaft"]} == {".position", ".scale"}
    json.dumps(scene.commands, allow_nan=False)


def test_notebook_shows_it_in_a_frame(tmp_path):
    scene = show_scene.show_design(Space())
    shown = scene._repr_html_()
    assert shown.startswith("<iframe srcdoc=")
    assert shown == scene._repr_html_()
    assert len(shown) < 0.4 * len(scene.static_html())
    packed = re.search(r'atob\("([^"]+)"\)', html.unescape(shown)).group(1)
    assert gzip.decompress(base64.b64decode(packed)).decode() == scene.static_html()
    assert scene.save(tmp_path / "robot.html").read_text() == scene.static_html()


def test_trajectory_of_several_starts_is_refused():
    with pytest.raises(ValueError, match="designs of one start"):
        show_scene.animate_designs(Space(), np.zeros((3, 4, 1)))
