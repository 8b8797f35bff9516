import os
import subprocess
import sys

from shapebody import runtime


def run(program, **environment):
    done = subprocess.run(
        [sys.executable, "-c", program],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout, done.stderr


def test_cache_folder_follows_jax_setting(monkeypatch, tmp_path):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path))
    assert runtime.cache_folder() == tmp_path
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    assert "shapebody" in runtime.cache_folder().parts


def test_compiled_programs_are_kept_and_found_without_noise(tmp_path):
    program = (
        "import jax, jax.numpy as jnp; from shapebody.runtime import enable_compilation_cache; "
        "enable_compilation_cache(); "
        "jax.config.update('jax_persistent_cache_min_compile_time_secs', 0); "
        "print(jax.jit(lambda x: jnp.sin(x) @ x)(jnp.ones((3, 3))).sum())"
    )
    first = run(program, JAX_COMPILATION_CACHE_DIR=str(tmp_path / "new"))
    kept = {path.name for path in (tmp_path / "new").iterdir() if path.name.endswith("-cache")}
    assert kept
    assert run(program, JAX_COMPILATION_CACHE_DIR=str(tmp_path / "new")) == first
    assert first[1] == ""


def test_unwritable_cache_is_left_off(monkeypatch, tmp_path):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "file" / "below"))
    assert runtime.enable_compilation_cache() is None


def test_start_notebook_prints_one_line_of_versions():
    out, err = run("from shapebody import start_notebook; start_notebook()")
    assert out.count("\n") == 1 and "mujoco 3.17.0" in out and "jax 0." in out
    assert err == ""
