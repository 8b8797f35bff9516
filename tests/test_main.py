"""The command line: what reaches the functions behind it, and what is said of errors."""

import dataclasses
import re
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from tiny import tiny_agent, tiny_robot

from shapebody.__main__ import main
from shapebody.agent.agent import Agent
from shapebody.agent.store import load_agent, save_agent
from shapebody.networks.config import CriticConfig
from shapebody.robot.robot import load_robot
from shapebody.training.config import TrainConfig


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Paths of a robot's file and of the folder of an agent for it."""
    folder = tmp_path_factory.mktemp("robot")
    agent = replace(tiny_agent(tiny_robot(folder)), metadata={"scale": "smoke"})
    return str(folder / "legs_2.xml"), str(save_agent(agent, folder / "agent"))


def test_a_missing_optional_package_is_one_line(files, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "botorch", None)
    robot, agent = files
    assert main(["design", robot, "--agent", agent, "--method", "bo"]) == 1
    error = capsys.readouterr().err
    assert error.startswith("shapebody: method 'bo' needs") and error.count("\n") == 1


def test_options_of_training(files, monkeypatch):
    robot, agent = files
    monkeypatch.setenv("XLA_FLAGS", "")  # which `main` sets
    calls = []

    def called(*unnamed, **given):
        calls.append((unnamed, given))
        return unnamed[0] if isinstance(unnamed[0], Agent) else None

    for name in ("train.train", "train.continue_run", "train.anneal"):
        monkeypatch.setattr(f"shapebody.training.{name}", called)
    monkeypatch.setattr("shapebody.training.policy_evaluation.train_critic", called)
    options = ["--engine", "mjx", "--hours", "2"]
    settings = ["--epochs", "5", "--policy.key-widths", "8", "32", "--task.action-delay", "1"]
    assert main(["train", robot, "--replace", "--steps", "9", *options, *settings]) == 0
    assert main(["continue", "any", "--state-only", *options]) == 0
    assert main(["anneal", "any", "--replace"]) == 0
    assert main(["policy-evaluation", agent, "--critic.heads", "2", *options]) == 0
    ((config,), given), continued, annealed, critic = calls
    assert (config.name, config.robots, config.scale) == ("legs_2", (robot,), "reduced")
    assert (config.epochs, config.policy.key_widths, config.task.action_delay) == (5, (8, 32), 1)
    common = dict(max_seconds=7200, engine="mjx")
    assert given == common | dict(max_steps=9, replace=True, state_only=False)
    assert continued == (
        ("any",),
        common | dict(max_steps=None, replace=False, state_only=True),
    )
    assert annealed == (
        ("any", 1_640_000),
        dict(max_seconds=None, engine="auto", replace=True),
    )
    assert critic[0][1] == CriticConfig.sharp(heads=2)
    assert critic[1] == common | dict(folder=Path(agent), task_of="evaluation")


def test_help_explains_every_setting(capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["train", "--help"])
    assert stopped.value.code == 0
    text = " ".join(capsys.readouterr().out.replace("│", " ").split())
    for field in dataclasses.fields(TrainConfig):
        assert f"--{field.name.replace('_', '-')}" in text
    assert "Discount factor γ per control step" in text and "--task.horizon INT" in text
    assert main([]) == 2 and "validate" in capsys.readouterr().err
    assert main(["--help"]) == 0 and "validate" in capsys.readouterr().out


def test_design_looks_at_its_output_before_it_searches(files, monkeypatch, tmp_path, capsys):
    robot, agent = files

    def never(*arguments, **options):
        raise AssertionError("searched")

    monkeypatch.setattr("shapebody.optimizers.search.search", never)
    assert main(["design", robot, "--agent", agent, "--out", robot]) == 1
    assert "the file of the robot itself" in capsys.readouterr().err
    assert main(["design", robot, "--agent", agent, "--out", str(tmp_path)]) == 1
    assert "a folder" in capsys.readouterr().err


@pytest.mark.parametrize(
    "option, value", [("--start", "-1"), ("--trust-region", "-2.0"), ("--iterations", "0")]
)
def test_errors_name_the_option(files, capsys, option, value):
    robot, agent = files
    assert main(["design", robot, "--agent", agent, option, value]) == 1
    assert capsys.readouterr().err.startswith(f"shapebody: {option} is {value}; expected ")
    assert main(["design", robot, "--agent", agent, "--freeze", "Size"]) == 1
    assert "did you mean size" in capsys.readouterr().err


def test_an_unknown_robot_is_refused_before_anything_is_announced(capsys):
    assert main(["train", "unitree_go22"]) == 1
    captured = capsys.readouterr()
    assert not captured.out and "Did you mean 'unitree_go2'" in captured.err


def test_design_shows_the_body_and_what_changed_most(files, tmp_path, capsys):
    robot, agent = files
    out = tmp_path / "new folder" / "body.xml"
    options = ["--method", "random", "--freeze", "none", "--out", str(out)]
    assert main(["design", robot, "--agent", agent, *options]) == 0
    text = capsys.readouterr().out
    assert "frozen: nothing" in text and f"made the folder {out.parent}" in text
    assert re.search(r"  mass +\d\S* -> \d\S* kg\n", text) and out.exists()
    changed = re.findall(r"  (?:\S.*\S) +(0\.\d{3})\n", text)
    assert len(changed) == 8 and changed == sorted(changed, reverse=True)


def test_another_file_of_the_robot_is_named(files, tmp_path, capsys):
    robot, agent = files
    own = load_agent(agent)
    phases = [{"robots": {"legs_2": load_robot(robot).hash}}]
    own = replace(own, metadata=own.metadata | {"phases": phases})
    folder = str(save_agent(own, tmp_path / "agent"))
    changed = tmp_path / "legs_2.xml"
    changed.write_text(Path(robot).read_text().replace('mass="2"', 'mass="2.1"'))
    options = ["--agent", folder, "--method", "random"]
    assert main(["design", robot, *options]) == 0
    assert not capsys.readouterr().err
    assert main(["design", str(changed), *options]) == 0
    assert "the file of robot legs_2 is not the one" in capsys.readouterr().err


def test_a_robot_that_the_agent_never_saw_is_named(files, tmp_path, capsys):
    robot, agent = files
    other = tmp_path / "other.xml"
    other.write_text(Path(robot).read_text())
    assert main(["design", str(other), "--agent", agent, "--method", "random"]) == 0
    assert "was trained on legs_2, not on other" in capsys.readouterr().err


def test_evaluate_tells_of_broken_episodes(files, capsys):
    robot, agent = files
    assert main(["evaluate", agent, "--robot", robot, "--episodes", "2"]) == 0
    out = capsys.readouterr().out
    assert "return" in out and "of 2 episodes not finite" in out


def test_an_interrupt_is_no_traceback(monkeypatch, capsys):
    def interrupt(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setenv("XLA_FLAGS", "")
    monkeypatch.setattr("shapebody.training.train.anneal", interrupt)
    assert main(["anneal", "any"]) == 130
    assert capsys.readouterr().err == "shapebody: interrupted\n"
