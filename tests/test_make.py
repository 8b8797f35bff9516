"""`make venv` in a small project, with an installer that copies: it makes, keeps and repairs."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PYTHON = os.path.realpath(sys.executable)
pytestmark = pytest.mark.skipif(not shutil.which("make"), reason="make is not installed")

# Stands in for uv, and for pip: "installs" a module per line of the lock file.
INSTALLER = """\
import os, re, sys, sysconfig
from pathlib import Path

arguments = sys.argv[1:]
with open("log", "a") as log:
    log.write(" ".join(arguments) + "\\n")
if arguments[0] == "venv":
    python = arguments[arguments.index("--python") + 1]
    os.execv(python, [python, "-m", "venv", "--without-pip", arguments[-1]])
(site,) = Path(".venv/lib").glob("python*/site-packages")

def install(name, files):
    folder = site / f"{name}-1.dist-info"
    if name == "shapebody" or not folder.exists():  # as in uv and pip
        folder.mkdir(exist_ok=True)
        for path, text in files.items():
            (site / path).parent.mkdir(exist_ok=True)
            (site / path).write_text(text)
        record = "".join(f"{path},," + chr(10) for path in files)
        (folder / "RECORD").write_text(record + f"{name}/__pycache__/gone.pyc,," + chr(10))

if "-e" in arguments:
    install("shapebody", {"shapebody.pth": os.getcwd()})
else:
    for name in re.findall("^([a-z]+)==", Path("environment.lock").read_text(), re.MULTILINE):
        files = {f"{name}/__init__.py": "__version__ = '1'", f"{name}/more.py": ""}
        install(name, files)
"""


@pytest.fixture
def project(tmp_path):
    folder = tmp_path / "a project"
    for name in (".ci", "shapebody", "tools"):
        (folder / name).mkdir(parents=True)
    for name in ("Makefile", ".ci/make_venv.sh", ".ci/check_venv.py", "pyproject.toml"):
        shutil.copy(ROOT / name, folder / name)
    (folder / "environment.lock").write_text("jax==1\nmujoco==1\nruff==1\n")
    (folder / "shapebody" / "__init__.py").write_text("__version__ = '1'")
    (folder / "installer.py").write_text(INSTALLER)
    write_tool(folder / "tools" / "uv", f'exec "{PYTHON}" installer.py "$@"')
    return folder


def write_tool(path, line):
    path.write_text(f"#!/bin/sh\n{line}\n")
    path.chmod(0o755)


def make(project, *arguments, **environment) -> tuple[str, str]:
    """Output of `make venv`, and what the installer was asked to do."""
    (project / "log").write_text("")
    path = os.pathsep.join([str(project / "tools"), os.path.dirname(PYTHON), "/usr/bin", "/bin"])
    environment = {"PATH": path, "HOME": str(project), **environment}
    done = subprocess.run(
        ["make", "venv", *arguments], cwd=project, env=environment, capture_output=True, text=True
    )
    output = done.stdout + done.stderr
    if done.returncode == 0:
        works = "import jax, jax.more, mujoco, ruff, shapebody"
        subprocess.run([project / ".venv" / "bin" / "python", "-Ic", works], check=True)
    return output, (project / "log").read_text()


def test_the_environment_is_kept_or_repaired(project):
    site = project / ".venv" / "lib" / f"python3.{sys.version_info[1]}" / "site-packages"
    output, log = make(project, PYTHON=PYTHON)
    assert "shapebody 1 with jax 1 and mujoco 1" in output and "venv" in log
    assert make(project) == ("", "")
    (project / ".venv" / ".complete").write_text("")  # one of an earlier version
    assert make(project) == ("", "")
    # Another lock file.
    os.utime(project / "environment.lock", (2**32, 2**32))
    output, log = make(project)
    assert "pip install" in log and "uv venv" not in log
    os.utime(project / "environment.lock", (2**30, 2**30))
    assert make(project) == ("", "")
    (site / "own.py").write_text("")  # added by hand
    # A package is gone, in several ways; what else is there stays.
    for lose in (
        lambda: shutil.rmtree(site / "jax"),
        lambda: (site / "jax" / "more.py").unlink(),
        lambda: [shutil.rmtree(site / name) for name in ("jax", "jax-1.dist-info")],
        lambda: (site / "jax-1.dist-info" / "RECORD").unlink(),
    ):
        lose()
        output, log = make(project)
        assert "lacks (parts of) jax;" in output and not log.startswith("venv")
        assert (site / "own.py").exists()
        assert make(project) == ("", "")
    # The interpreter is gone, or broken.
    for python in (None, "/nowhere/python", "exit 1"):
        for link in (project / ".venv" / "bin").glob("python*"):
            link.unlink()
        link = project / ".venv" / "bin" / "python"
        if python == "exit 1":
            write_tool(link, python)
        elif python:
            link.symlink_to(python)
        output, log = make(project, PYTHON=PYTHON)
        assert log.startswith("venv")
        assert make(project) == ("", "")
    # The project moves: the package would be that of another folder, or none.
    moved = project.rename(project.with_name("moved"))
    output, log = make(moved)
    assert "shapebody" in output and "pip install" in log
    assert make(moved) == ("", "")


@pytest.mark.parametrize("name", ['it\'s "my" python', "`touch hacked`", "; touch hacked;", "$x"])
def test_names_of_the_interpreter(project, name):
    write_tool(project / "tools" / name, f'exec "{PYTHON}" "$@"')
    python = str(project / "tools" / name)
    output, log = make(project, PYTHON=python)
    assert f"--python {python} .venv" in log and "with jax 1" in output
    missing = str(project / name)
    shutil.rmtree(project / ".venv")
    argument = f"PYTHON={missing.replace('$', '$$')}"
    for output, log in (make(project, PYTHON=missing), make(project, argument)):
        assert f"make: PYTHON={missing} does not exist" in output and log == ""
    assert not (project / "hacked").exists()
