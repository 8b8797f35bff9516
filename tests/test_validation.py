"""Validation: reports say what load_robot would raise, and what looks wrong; the command line."""

import numpy as np
import pytest
from test_inference import biped_urdf, quadruped
from test_robots import BAD, OWN, RIGHT_ACTUATOR, own_robot

import shapebody as sb
from shapebody.__main__ import main
from shapebody.robot.report import validate_robot
from shapebody.robot.robot import load_robot
from shapebody.robot.standing import hold


@pytest.fixture
def dog(tmp_path):
    return quadruped(tmp_path)


def test_a_shipped_robot_is_fine():
    report = sb.validate_robot("anymal_c")
    assert report.ok and report.problems == report.inferred == report.warnings == ()
    assert report.summary["design"] == f"d = {report.robot.design_dim} parameters"
    assert "can be used" in str(report) and "Problems" not in str(report)


def test_report_of_a_completed_file(dog):
    report = validate_robot(dog)
    assert report.ok and report.inferred == load_robot(dog).inferred
    text = str(report)
    assert repr(report) == text and max(map(len, text.splitlines())) < 200
    for part in ("12 hinges, 12 driven", "4: FL_foot (sphere)", "14.2 kg", "kp 21", "d = 358"):
        assert part in text, part
    assert f"Inferred ({len(report.inferred)})" in text


def test_written_file_is_complete(dog, tmp_path):
    report = validate_robot(dog)
    path = report.write(tmp_path / "new" / "complete.xml")
    again = validate_robot(path)
    assert again.ok and again.inferred == () and again.warnings == report.warnings
    assert "Completed from dog.xml" in path.read_text()
    assert [file.name for file in path.parent.iterdir()] == ["complete.xml"]
    np.testing.assert_array_equal(again.robot.home, report.robot.home)
    with pytest.raises(ValueError, match="dog.xml is the file itself.*another name"):
        report.write(dog)


@pytest.mark.parametrize("case", BAD)
def test_problems_are_the_errors_of_load_robot(tmp_path, case):
    changes, _ = BAD[case]
    path = own_robot(tmp_path, *changes)
    report = validate_robot(path)
    assert not report.ok and report.robot is None
    with pytest.raises(ValueError) as error:
        load_robot(path)
    assert all(problem in str(error.value) for problem in report.problems)
    assert f"Problems ({len(report.problems)})" in str(report)
    with pytest.raises(ValueError, match="no completed file to write"):
        report.write(tmp_path / "out.xml")
    assert not (tmp_path / "out.xml").exists()


def test_a_complete_keyframe_without_a_free_joint(tmp_path):
    # MuJoCo stops at the keyframe, whose numbers are right.
    (problem,) = validate_robot(own_robot(tmp_path, ("<freejoint/>", ""))).problems
    assert "expected 2, got 9" in problem and "the trunk lacks its <freejoint/>" in problem


def test_files_that_cannot_be_read(tmp_path):
    (tmp_path / "cut.xml").write_text(OWN[:300])
    (tmp_path / "empty.xml").write_text("")
    (tmp_path / "binary.xml").write_bytes(bytes(range(128, 160)))
    for name, message in (
        ("cut.xml", "not a valid MJCF file: MuJoCo reports"),
        ("empty.xml", "is empty"),
        ("binary.xml", "not UTF-8 text"),
        ("none.xml", "does not exist"),
        (".", "is a folder"),
    ):
        report = validate_robot(tmp_path / name)
        assert len(report.problems) == 1 and message in report.problems[0]
        assert not report.ok and "cannot be used yet" in str(report)
    assert "unknown robot" in validate_robot("no_such_robot").problems[0]
    with pytest.raises(TypeError):
        validate_robot(3)


def warned(path, text: str) -> bool:
    return any(text in warning for warning in validate_robot(path).warnings)


LIMITS = 'kp="20" kv="0.5" forcerange="-9 9"'


def test_warnings(tmp_path):
    path = own_robot(tmp_path)
    fine = validate_robot(path)
    assert fine.ok and fine.inferred == ()
    for change, message in (
        ((LIMITS, LIMITS.replace("9", "0.01")), "weight on all feet: right_hip (limit 0.01 N m"),
        ((LIMITS, LIMITS.replace("9", "9000")), "a placeholder? Correct forcerange"),
        ((LIMITS, LIMITS.replace("0.5", "0")), "the D gain (kv) is 0"),
        ((LIMITS, LIMITS.replace("20", "2e6").replace("9", "1e5")), "becomes unstable within 1 s"),
        (('range="-1 1"', 'range="-0.3 0.3"'), "ranges below 0.8 rad"),
        (("0 0 0 0.1 0.2", "0 0 0 0.1 1.2"), '"home" is outside the joint limits at right_hip'),
        (("0 0 0 0.1 0.2", "0 0 0 0.1 0.99"), '"home" is in the outer 5 % of the range at right'),
        (('mass="2"', 'mass="2000"'), "are the units kg and m?"),
        (("<option ", '<option gravity="0 -9.81 0" '), "gravity is"),
        (('size="0.08" group="5"', 'size="0.08" group="4"'), "no collision spheres"),
        (("0.3 1 0 0 0", "0.3 0.97 0 0.24 0"), "the trunk is tilted by 28 degrees"),
        (('name="left_foot"', 'name="left_tip"'), "no foot, and only feet touch"),
        (('name="left_foot"', 'name="left_tip"'), "(left_tip)"),
        (('name="left_foot"', 'name="left_tip"'), "1 foot (right_foot): expected two or more"),
    ):
        assert not any(message in warning for warning in fine.warnings)
        assert warned(own_robot(tmp_path, change), message), message


def test_equal_findings_are_one_warning(tmp_path):
    weak = validate_robot(own_robot(tmp_path, (LIMITS, LIMITS.replace("9", "0.01"))))
    (message,) = [warning for warning in weak.warnings if "too weak" in warning]
    assert "right_hip" in message and "left_hip" in message


def test_legs_without_motors(tmp_path):
    text = own_robot(tmp_path, (f"    {RIGHT_ACTUATOR}\n", ""), ("10 11", "10")).read_text()
    path = tmp_path / "half.xml"
    path.write_text(text)
    assert warned(path, "joints right_hip carry a foot but no actuator drives them")


def test_a_trunk_that_falls_through_the_floor_is_not_usual(tmp_path):
    report = validate_robot("talos")
    (fall,) = [warning for warning in report.warnings if "falls out of" in warning]
    assert "sinks by 1" in fall and "usual" not in fall and "went through" in fall
    (fall,) = [w for w in validate_robot("unitree_go2").warnings if "falls out of" in w]
    assert "usual" in fall


def test_faults_of_the_package_are_reported_too(tmp_path, monkeypatch):
    def fails(path):
        raise IndexError("list index out of range")

    monkeypatch.setattr("shapebody.robot.report.examine", fails)
    (problem,) = validate_robot(own_robot(tmp_path)).problems
    assert "a fault of shapebody" in problem and "IndexError: list index" in problem


def test_holding_the_nominal_pose(tmp_path):
    stands = hold(load_robot("anymal_c"))
    assert stands.finite and stands.sunk < 0.2 and stands.tilt < 0.1 and stands.touching.all()
    falls = hold(load_robot("unitree_go2"))  # with the paper's soft gains
    assert falls.finite and falls.sunk > 0.35
    wild = (LIMITS, LIMITS.replace("20", "2e6").replace("9", "1e5"))
    assert not hold(load_robot(own_robot(tmp_path, wild))).finite
    weak = own_robot(tmp_path, (LIMITS, LIMITS.replace("9", "0.01")))
    held = hold(load_robot(weak))
    assert held.sunk > 0.35 and held.saturated.max() > 0.5
    assert warned(weak, "it falls out of its nominal pose")


def test_command_line(dog, tmp_path, capsys):
    out = tmp_path / "complete.xml"
    assert main(["validate", str(dog), "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "can be used" in printed and f"wrote {out}" in printed
    assert main(["validate", str(out)]) == 0
    assert "Inferred" not in capsys.readouterr().out
    urdf = biped_urdf(tmp_path, inertia=False)
    assert main(["validate", str(urdf), "--out", str(tmp_path / "no.xml")]) == 1
    captured = capsys.readouterr()
    assert "body 'left_shank' has mass and inertia 0 kg" in captured.out
    assert "correct them first" in captured.err and not (tmp_path / "no.xml").exists()
    assert main(["validate", str(tmp_path / "none.xml")]) == 1
