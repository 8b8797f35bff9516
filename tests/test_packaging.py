import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import shapebody

ROOT = Path(__file__).resolve().parent.parent
LOCK = (ROOT / "environment.lock").read_text()


def locked_packages():
    """Name, version and number of hashes of every requirement."""
    requirements = re.split(r"\n(?=[a-z0-9])", re.sub(r"^#.*\n", "", LOCK, flags=re.MULTILINE))
    for requirement in requirements:
        match = re.match(r"([a-z0-9._-]+)==([^ ;\\]+)", requirement)
        assert match, f"not pinned: {requirement[:80]!r}"
        yield match[1], match[2], len(re.findall(r"--hash=sha256:[0-9a-f]{64}", requirement))


def test_every_locked_package_has_hashes():
    packages = list(locked_packages())
    assert len(packages) > 100
    assert [name for name, _, hashes in packages if hashes == 0] == []


def test_lock_has_no_torch_and_no_address():
    assert not {"torch", "botorch", "gpytorch"} & {name for name, _, _ in locked_packages()}
    without_comments = re.sub(r"^#.*$", "", LOCK, flags=re.MULTILINE)
    for word in ("://", "--index-url", "--extra-index", "--find-links", "--trusted-host", "@ "):
        assert word not in without_comments


def test_lock_covers_the_dependencies():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = project["dependencies"] + project["optional-dependencies"]["dev"]
    names = {re.match(r"[A-Za-z0-9._-]+", line)[0].replace("_", "-").lower() for line in wanted}
    assert names <= {name for name, _, _ in locked_packages()}


def test_mujoco_and_mjx_are_of_one_version():
    versions = {name: version for name, version, _ in locked_packages()}
    assert versions["mujoco"] == versions["mujoco-mjx"] == "3.17.0"


def test_import_is_light_and_starts_no_backend():
    program = (
        "import sys, shapebody; "
        "assert not {'jax', 'mujoco', 'numpy', 'matplotlib'} & set(sys.modules); "
        "dir(shapebody); "
        "assert 'jax' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


def test_unknown_names_are_refused():
    with pytest.raises(AttributeError, match="load_robto"):
        shapebody.load_robto  # noqa: B018
    with pytest.raises(ImportError):
        from shapebody import nothing_of_that_name  # noqa: F401


def test_dir_lists_the_public_names():
    assert set(shapebody.__all__) <= set(dir(shapebody))


def test_readme_states_the_measured_speeds():
    readme = (ROOT / "README.md").read_text()
    rows = json.loads((ROOT / "benchmarks" / "results.json").read_text())["rows"]
    for label, digits in (
        ("C engine alone", 0),
        ("environment, C engine", 0),
        ("environment, MJX on cpu, 64 at once", 0),
        ("training, reduced", 0),
        ("VGDS, one design", 2),
        ("VGDS, ten designs", 2),
        ("cem, ten designs", 1),
        ("turbo, ten designs", 1),
        ("gc-pfo, ten designs", 1),
        ("bo, ten designs", 0),
    ):
        text = f" {rows[label]['value']:,.{digits}f} "
        assert text in readme, f"README.md should have{text}for {label!r}"
    # Rows of one table were measured with one commit, on one day.
    for labels in (
        ("C engine alone", "environment, C engine", "training, reduced", "VGDS, ten designs"),
        ("cem, ten designs", "turbo, ten designs", "gc-pfo, ten designs", "bo, ten designs"),
    ):
        assert len({rows[label]["commit"] for label in labels}) == 1
    for label in ("cma-es", "pso", "de", "ars"):
        likewise = rows[f"{label}, ten designs"]["value"] / rows["cem, ten designs"]["value"]
        assert 0.8 < likewise < 1.25, label
