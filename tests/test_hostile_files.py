"""Files that would crash, stop or fill this process: each ends in an error that names the file."""

import os
import re
import signal
import struct
import subprocess
import sys
import threading
import time
import zlib

import mujoco
import pytest
from test_inference import MESH, biped_urdf, quadruped
from test_robots import own_robot

import shapebody as sb
from shapebody.files import data_dir
from shapebody.robot import guard, importing, survey
from shapebody.robot.robot import load_robot, robots

PARTS = {"before": "", "attributes": "", "inside": "", "after": ""}
SMALL = (
    "<mujoco{attributes}>{before}<worldbody><body name='b'><freejoint/><geom size='1'/>{inside}"
    "</body></worldbody>{after}</mujoco>"
)


def read(path):
    guard.admit(path)
    return importing.read(path)


def small(folder, name="small.xml", **parts):
    """Path of a file with one body and what is put into it."""
    path = folder / name
    path.write_text(SMALL.format(**PARTS | parts))
    return path


def refusal(path, seconds=10.0) -> str:
    """The error of reading a file, which names it and comes soon."""
    start = time.perf_counter()
    with pytest.raises(ValueError) as error:
        read(path)
    assert time.perf_counter() - start < seconds
    assert str(path) in str(error.value)
    return str(error.value)


@pytest.fixture
def unsurveyed(monkeypatch):
    """What the survey of the text would refuse reaches the other process."""
    monkeypatch.setattr(guard, "files_of", lambda path: {str(path): str(time.time())})


def numbers(count, separator=" "):
    data = separator.join("1" * count)
    return {"after": f'<custom>\n<numeric name="n" data="{data}"/></custom>'}


def nested(tag, counts):
    inside = "<geom size='1'/>"
    for count in counts:
        inside = f'<{tag} count="{count}">{inside}</{tag}>'
    return {"inside": inside}


def asset(text):
    return {"before": f"<asset>{text}</asset>"}


REFUSED = {
    "501 numbers": (numbers(501), "line 2 .* holds 501 numbers: expected at most 500"),
    "501 numbers by entities": (numbers(501, "&#32;"), "holds 501 numbers"),
    "5,000 numbers": (numbers(5_000), "holds 5,000 numbers"),
    "a replicate": (nested("replicate", [10**9]), "elements.*expected at most 20,000"),
    "product of replicates": (nested("replicate", [150, 150]), "22,656 elements"),
    "replicate, infinite": (nested("replicate", ["1e999"]), "elements.*expected at most"),
    "geoms": ({"inside": "<geom size='1'/>" * 20_000}, "20,001 elements"),
    "flexcomp": (
        {"inside": '<flexcomp name="f" type="grid" count="30 30 30" spacing="1 1 1"/>'},
        "27,005 elements",
    ),
    "composite": (
        {"inside": '<composite type="cable" count="501 1 1"><geom size="1"/></composite>'},
        "501 joints",
    ),
    "joints": ({"inside": "<body><joint/><geom size='1'/></body>" * 501}, "501 joints"),
    "depth": ({"inside": "<body>" * 490 + "</body>" * 490}, "inside 480 others"),
    "attributes": (
        {"attributes": "".join(f' a{i}="1"' for i in range(50_000))},
        "50,000 attributes: expected at most 200",
    ),
    "hfield": (asset('<hfield name="h" nrow="9000" ncol="9000" size="1 1 1 1"/>'), "81,000,000"),
    "texture": (
        asset('<texture name="t" builtin="flat" width="9000"/>'),
        "486,000,000 pixels of textures",
    ),
    "textures": (
        asset('<texture type="2d" builtin="flat" width="4096" height="4096"/>' * 5),
        "83,886,080 pixels",
    ),
    "builtin mesh": (asset('<mesh name="m" builtin="cone" params="1000000 1"/>'), "params="),
    "nuser": ({"before": '<size nuser_geom="100000000"/>'}, "nuser_geom='100000000'"),
    "nkey": ({"before": '<size nkey="1e9"/>'}, "nkey="),
    "memory": ({"before": '<size memory="100G"/>'}, "memory='100G'"),
    "njmax": ({"before": '<size njmax="2000000000"/>'}, "njmax="),
    "iterations": ({"before": '<option iterations="2000000000"/>'}, "iterations="),
    "timestep": ({"before": '<option timestep="1e-12"/>'}, "timestep 1e-12"),
    "plugin": ({"before": '<extension><plugin plugin="mujoco.pid"/></extension>'}, "plugin"),
    "open comment": ({"after": "<!-- a -->\n<!-- b"}, "line 2, has a comment that never ends"),
    "a device as mesh": (asset('<mesh name="m" file="/dev/zero"/>'), "/dev/zero.* a device"),
    "a device as include": ({"before": '<include file="/dev/zero"/>'}, "/dev/zero.* a device"),
    "user numbers": (
        {"inside": f'<geom size="1" user="{"1 " * 101}"/>'},
        "101 user numbers: expected at most 100",
    ),
    "user sensor": ({"after": '<sensor><user dim="2000000000"/></sensor>'}, "dim='2000000000'"),
    "contact sensor": ({"after": '<sensor><contact num="1e9"/></sensor>'}, "num="),
    "samples": ({"after": '<sensor><clock nsample="9e9"/></sensor>'}, "nsample="),
    "rays": (
        {
            "inside": '<camera name="c" resolution="4000 4000"/>',
            "after": '<sensor><rangefinder camera="c"/></sensor>',
        },
        "16,000,000 rays of range finders",
    ),
    "folders": (asset(f'<mesh name="m" file="{"a/" * 500}"/>'), "in 500 folders"),
    "a long file name": (asset(f'<mesh name="m" file="{"a/" * 9_999}"/>'), "19,998 characters"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_no_robot_needs_is_refused(tmp_path, case):
    parts, message = REFUSED[case]
    text = refusal(small(tmp_path, **parts))
    assert pytest.raises(ValueError, match=message).matches(ValueError(text)), text
    assert sb.validate_robot(small(tmp_path, **parts)).problems == (text,)


@pytest.mark.parametrize(
    "text",
    [
        "<!--" * 100_000,
        "<robot " * 60_000,
        "<robot " * 19_000,
        "<a" + " " * 1_000_000,
        "<a b='" * 100_000,
        "<robot>" + "<!-- -->" * 50_000,
        "<![CDATA[" * 100_000,
        "<mujoco>" * 400,
        "&" * 1_000_000,
        '<!DOCTYPE robot [<!ENTITY a "aaaa">]><robot name="&a;"/>',
        "<mujoco><!" + "!" * 1_000_000,
    ],
)
@pytest.mark.parametrize("name", ["robot.xml", "robot.urdf"])
def test_patterns_take_no_time(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    refusal(tmp_path / name)


@pytest.mark.parametrize("kind", ["include", "model"])
@pytest.mark.parametrize("length", [1, 2, 3])
def test_files_that_lead_back_to_themselves(tmp_path, kind, length):
    for i in range(length):
        file = f"{(i + 1) % length}.xml"
        parts = {"before": f'<include file="{file}"/>'}
        if kind == "model":
            parts = asset(f'<model name="m" file="{file}"/>')
            parts["inside"] = '<attach model="m" body="b" prefix="p"/>'
        small(tmp_path, f"{i}.xml", **parts)
    assert "leads back to itself" in refusal(tmp_path / "0.xml")


def test_attached_models_multiply(tmp_path):
    text = (
        '<mujoco><asset><model name="m" file="{}.xml"/></asset><worldbody><body name="b">{}</body>'
        "</worldbody></mujoco>"
    )
    small(tmp_path, "0.xml", inside="<geom size='1'/>" * 10)
    (tmp_path / "0.xml").write_text((tmp_path / "0.xml").read_text().replace("<freejoint/>", ""))
    for i in range(1, 12):
        twice = "".join(f'<attach model="m" body="b" prefix="{side}"/>' for side in "lr")
        (tmp_path / f"{i}.xml").write_text(text.format(i - 1, twice))
    read(tmp_path / "2.xml")
    assert "elements" in refusal(tmp_path / "11.xml")


def test_repeated_includes_multiply(tmp_path):
    (tmp_path / "many.xml").write_text("<mujocoinclude>" + "<geom size='1'/>" * 300)
    repeated = '<replicate count="300"><include file="many.xml"/></replicate>'
    assert "elements" in refusal(small(tmp_path, inside=repeated))


def test_an_honest_include(tmp_path):
    (tmp_path / "part.xml").write_text("<mujoco><option timestep='0.004'/></mujoco>")
    model = read(small(tmp_path, before='<include file="part.xml"/>'))[2]
    assert model.opt.timestep == 0.004
    # The answer is not kept when an included file changes.
    (tmp_path / "part.xml").write_text("<mujoco><option timestep='1e-9'/></mujoco>")
    assert "part.xml has timestep 1e-09" in refusal(tmp_path / "small.xml")


def test_pipes_are_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe.xml")
    os.mkfifo(tmp_path / "pipe.stl")
    for parts in (
        {"before": '<include file="pipe.xml"/>'},
        asset('<model name="m" file="pipe.xml"/>'),
        asset('<mesh name="m" file="pipe.stl"/>'),
        asset('<texture name="m" type="2d" file="pipe.stl"/>'),
    ):
        assert "is a pipe or a device" in refusal(small(tmp_path, **parts))
    refusal(tmp_path / "pipe.xml")
    mesh = MESH.format("x").replace("package://walker/meshes/x.dae", "pipe.stl")
    assert "is a pipe or a device" in refusal(biped_urdf(tmp_path, sole=mesh))


def test_sizes_of_files(tmp_path, monkeypatch):
    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 60_000, 60_000, 8, 2, 0, 0, 0))
    (tmp_path / "bomb.png").write_bytes(b"\x89PNG\r\n\x1a\n" + header)
    image = small(tmp_path, **asset('<texture name="t" type="2d" file="bomb.png"/>'))
    assert "3,600,000,000 pixels" in refusal(image)
    with open(tmp_path / "large.stl", "wb") as file:
        file.truncate(2**30)  # takes no place on the disk
    mesh = asset('<mesh name="m" file="large.stl"/>')
    assert "1,073,741,824 bytes of meshes" in refusal(small(tmp_path, **mesh))
    (tmp_path / "folder").mkdir()
    (tmp_path / "large.stl").rename(tmp_path / "folder" / "large.stl")
    mesh["before"] += '<compiler meshdir="folder"/>'
    assert "1,073,741,824 bytes of meshes" in refusal(small(tmp_path, **mesh))
    (tmp_path / "folder" / "large.stl").rename(tmp_path / "large.xml")
    assert "1,073,741,824 bytes of text" in refusal(tmp_path / "large.xml")


def star(joints):
    """A URDF with one leg per joint."""
    link = (
        '<link name="l{}"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" '
        'ixz="0" iyz="0"/></inertial></link>'
    )
    joint = (
        '<joint name="j{0}" type="{1}"><parent link="l0"/><child link="l{0}"/><axis xyz="0 1 0"/>'
        '<limit lower="-1" upper="1" effort="9" velocity="{0}"/></joint>'
    )
    kinds = ["revolute"] * joints + ["fixed"] * 20
    parts = [link.format(i) for i in range(len(kinds) + 1)]
    parts += [joint.format(i, kind) for i, kind in enumerate(kinds, start=1)]
    return f'<robot name="star">{"".join(parts)}</robot>'


def test_as_many_joints_as_can_be_written(tmp_path):
    path = tmp_path / "star.urdf"
    path.write_text(star(501))
    assert "501 joints" in refusal(path)
    path.write_text(star(500))
    spec = read(path)[1]
    # What is written can be read again: in this process, so it must not crash.
    again = mujoco.MjSpec.from_string(spec.to_xml())
    assert len(again.numeric("velocity_limits").data) == 500


def test_joints_and_depth_of_what_was_compiled(tmp_path):
    def model(text):
        return mujoco.MjSpec.from_string(SMALL.format(**PARTS | {"inside": text})).compile()

    hinge = "<body><joint/><geom size='1'/>"
    importing.require_writable(tmp_path, model(f"{hinge}</body>" * 500))
    with pytest.raises(ValueError, match="501 joints"):
        importing.require_writable(tmp_path, model(f"{hinge}</body>" * 501))
    importing.require_writable(tmp_path, model("<body>" * 470 + "</body>" * 470))
    with pytest.raises(ValueError, match="chain of 486 bodies"):
        importing.require_writable(tmp_path, model("<body>" * 485 + "</body>" * 485))


def test_every_shipped_robot_would_pass():
    folder = data_dir() / "robots"
    for name in robots():
        assert survey.files_of(folder / f"{name}.xml")


@pytest.mark.parametrize("name", ["attach", "numbers"])
def test_a_crash_of_the_reader_is_an_error(tmp_path, unsurveyed, name):
    attach = asset('<model name="m" file="small.xml"/>')
    attach["inside"] = '<attach model="m" body="b" prefix="p"/>'
    parts, cause = {"attach": (attach, "SIGSEGV"), "numbers": (numbers(501), "SIGABRT")}[name]
    assert f"reader crash ({cause})" in refusal(small(tmp_path, **parts), seconds=20)
    load_robot(own_robot(tmp_path))


def test_a_reader_that_does_not_end(tmp_path, unsurveyed, monkeypatch):
    load_robot(own_robot(tmp_path))  # the other process is there
    monkeypatch.setattr(guard, "SECONDS", 1)
    path = small(tmp_path, **nested("replicate", [10**9]))
    assert "cannot be read within 1 s" in refusal(path, seconds=10)
    monkeypatch.undo()
    # Ctrl-C stops the waiting.
    monkeypatch.setattr(guard, "files_of", lambda path: {})
    timer = threading.Timer(1, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        read(path)
    load_robot(own_robot(tmp_path))


def test_memory_is_limited(tmp_path, unsurveyed):
    path = small(tmp_path, before='<size nuser_body="2000000000"/>')
    assert "memory" in refusal(path, seconds=20)
    program = f"import shapebody.robot.guard as g; g.limit_memory(); bytearray({2 * guard.MEMORY})"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert "MemoryError" in done.stderr


PROGRAM = """
import os
from shapebody.robot import guard, importing
from pathlib import Path

def read(path):
    guard.admit(path)
    return importing.read(path)

survey, guard.files_of = guard.files_of, lambda path: {}
try:
    read(Path("bad.xml"))
except ValueError as error:
    assert "bad.xml makes MuJoCo's reader crash" in str(error), error

guard.files_of = survey
read(Path("good.xml"))
other = guard.reader.process.pid
read(Path("good.xml"))
assert guard.reader.process.pid == other
child = os.fork()
if child == 0:
    read(Path("good.xml"))
    Path("good.xml").write_text(Path("good.xml").read_text() + "  ")
    read(Path("good.xml"))
    os._exit(0 if guard.reader.process.pid != other else 1)

assert os.waitpid(child, 0)[1] == 0
read(Path("good.xml"))
assert guard.reader.process.pid == other
print("other process", other)
"""


@pytest.mark.parametrize("way", ["-c", "-i"])
def test_other_ways_to_run_python(tmp_path, way):
    small(tmp_path, "bad.xml", **numbers(501))
    small(tmp_path, "good.xml")
    arguments = {"-c": ["-c", PROGRAM], "-i": ["-i"]}[way]
    done = subprocess.run(
        [sys.executable, *arguments],
        input=PROGRAM if way == "-i" else "",
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        capture_output=True,
        text=True,
        timeout=60,
    )
    found = re.search(r"other process (\d+)", done.stdout)
    assert found, f"{done.stdout}\n{done.stderr}"
    until = time.monotonic() + 10
    with pytest.raises(ProcessLookupError):  # it ends with the program
        while time.monotonic() < until:
            os.kill(int(found.group(1)), 0)
            time.sleep(0.05)


def test_without_another_process(tmp_path, monkeypatch):
    monkeypatch.setattr(guard, "reader", guard.Reader())
    monkeypatch.setattr(sys, "executable", str(tmp_path / "none"))
    with pytest.warns(UserWarning, match="without protection"):
        load_robot(own_robot(tmp_path))


def test_the_same_content_is_read_elsewhere_once(tmp_path, monkeypatch):
    path = quadruped(tmp_path)
    load_robot(path)
    judged = []
    monkeypatch.setattr(guard.reader, "judge", lambda path: (judged.append(path) or "", True))
    load_robot(path)
    load_robot("anymal_c")
    assert judged == []
    with open(tmp_path / "assets" / "hip.obj", "a") as file:
        file.write("# changed\n")
    load_robot(path)
    assert judged == [path]
