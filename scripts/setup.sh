#!/bin/sh
# Makes .venv with the project and the extras named in $1 ("" or "dev") at the versions of constraints.txt.
# Called by the Makefile, which decides when; needs only a Python of at least 3.11. PYTHON=... chooses another one.
set -eu
extras=${1:-}
venv=.venv

fail() {
    printf 'setup: %s\n' "$1" >&2
    exit 1
}

new_enough() {
    command -v "$1" >/dev/null 2>&1 && "$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1
}

find_python() {
    if [ -n "${PYTHON:-}" ]; then
        new_enough "$PYTHON" || fail "PYTHON=$PYTHON is not a Python of at least 3.11."
        printf '%s' "$PYTHON"
        return
    fi
    # 3.11 first: the versions in constraints.txt were chosen and tested with it.
    for name in python3.11 python3.12 python3.13 python3.14 python3 python; do
        if new_enough "$name"; then
            printf '%s' "$name"
            return
        fi
    done
    fail "no Python of at least 3.11 was found; install one, or name it: make PYTHON=/path/to/python ..."
}

# A .venv that was moved here, or whose Python has gone, does not start: it is made again.
if ! { "$venv/bin/python" -m pip --version && "$venv/bin/python" -c 'import os, sys
sys.exit(os.path.realpath(sys.prefix) != os.path.realpath(".venv"))'; } >/dev/null 2>&1; then
    python=$(find_python)
    printf 'setup: making %s with %s\n' "$venv" "$("$python" --version)"
    rm -rf "$venv"
    if "$python" -c 'import ensurepip, venv' >/dev/null 2>&1; then
        "$python" -m venv "$venv"
    elif "$python" -m pip --version >/dev/null 2>&1 && "$python" -m venv --without-pip "$venv" >/dev/null 2>&1; then
        # Some distributions leave ensurepip out; a pip of the same Python can install one into the new environment.
        "$python" -m pip --quiet --python "$venv/bin/python" install pip || fail "pip could not be put into $venv."
    else
        fail "$python cannot make virtual environments (no ensurepip); on Debian and Ubuntu: apt install python3-venv"
    fi
fi

printf 'setup: installing (a few minutes the first time)\n'
pip="$venv/bin/python -m pip --quiet --disable-pip-version-check install --constraint constraints.txt"
# The build backend is installed first and used from .venv, so that its version is a fixed one as well.
$pip hatchling editables
$pip --no-build-isolation --editable ".${extras:+[$extras]}"
