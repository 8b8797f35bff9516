#!/bin/sh
# make_venv.sh FOLDER: a virtual environment with exactly environment.lock and this package, editable.
# Does nothing if it is there, complete and not older than environment.lock; else makes or repairs it.
# Uses uv when it is on the PATH, otherwise plain venv and pip. PYTHON chooses the interpreter.
set -eu
venv=$1
stamp=$venv/.complete

if [ -f "$stamp" ] && [ -x "$venv/bin/python" ] &&
    [ -z "$(find environment.lock pyproject.toml -newer "$stamp")" ] &&
    "$venv/bin/python" -I .ci/check_venv.py "$stamp"; then
    exit 0
fi
rm -f "$stamp"

fits() {
    "$1" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 14))' 2>/dev/null
}

fail() {
    echo "make: $1" >&2
    exit 1
}

install_hint='Install one, for example with "apt-get install python3.12 python3.12-venv",
"brew install python@3.12", "conda create -n py312 python=3.12" or "uv python install 3.12",
and run make again (PYTHON=/path/to/python3.12 names it where it is not found).'

found=""
if [ -n "${PYTHON:-}" ]; then
    command -v -- "$PYTHON" >/dev/null || fail "PYTHON=$PYTHON does not exist."
    fits "$PYTHON" || fail "PYTHON=$PYTHON is $("$PYTHON" -V 2>&1); shapebody needs 3.11, 3.12 or 3.13.
$install_hint"
    found=$PYTHON
else
    for name in python3.11 python3.12 python3.13 python3 python; do
        if fits "$name"; then
            found=$name
            break
        fi
    done
fi

if command -v uv >/dev/null; then
    uv=uv
else
    uv=""
    [ -n "$found" ] || fail "no Python 3.11, 3.12 or 3.13 found (python3 is $(python3 -V 2>&1 || true)).
$install_hint"
    "$found" -c 'import venv, ensurepip' 2>/dev/null || fail "$found ($("$found" -V)) lacks its venv module.
Install it, on Debian or Ubuntu with
    apt-get install python3-venv        (or python3.12-venv, ... for another version)
and run make again."
fi

# A complete environment of a fitting Python is kept, with whatever was added to it by hand.
if ! fits "$venv/bin/python"; then
    rm -rf "$venv"
    if [ -n "$uv" ]; then
        uv venv --quiet --seed --python "${found:->=3.11,<3.14}" "$venv"
    else
        "$found" -m venv "$venv"
    fi
fi

echo "Installing $(grep -c '^[a-z].*==' environment.lock) packages into $venv (one to three minutes) ..."
if [ -n "$uv" ]; then
    uv pip install --python "$venv/bin/python" --require-hashes -r environment.lock
    uv pip install --python "$venv/bin/python" --quiet --no-deps --no-build-isolation -e .
else
    quiet=""
    [ -z "${CI:-}" ] || quiet="--quiet"
    "$venv/bin/python" -m pip --version >/dev/null 2>&1 || "$venv/bin/python" -m ensurepip
    "$venv/bin/python" -m pip install $quiet --disable-pip-version-check --require-hashes \
        -r environment.lock
    "$venv/bin/python" -m pip install --quiet --disable-pip-version-check --no-deps \
        --no-build-isolation -e .
fi
"$venv/bin/python" -c 'import jax, mujoco, shapebody; print(
    f"shapebody {shapebody.__version__} with jax {jax.__version__} and mujoco {mujoco.__version__}")'
"$venv/bin/python" -I .ci/check_venv.py "$stamp" --write
