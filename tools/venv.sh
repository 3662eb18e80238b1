#!/usr/bin/env bash
# Make the folder .venv and install this checkout into it with the packages of constraints/NAME.txt.
set -euo pipefail
cd "$(dirname "$0")/.."
constraints=constraints/${1:?usage: tools/venv.sh all|test}.txt
venv=${VENV:-.venv}

make_venv() {
    "$python" -m venv "$venv"
}

# Debian keeps what venv needs in a package of its own.
install_venv_module() {
    local version
    version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
    echo "this Python cannot make a virtual environment yet: installing python$version-venv"
    tools/apt.sh "python$version-venv"
}

if ! "$venv/bin/python" -m pip --version >/dev/null 2>&1; then
    python=$(tools/python.sh)
    if ! make_venv >/dev/null 2>&1; then
        install_venv_module
        make_venv
    fi
fi
"$venv/bin/python" -m pip install --quiet --disable-pip-version-check \
    --require-hashes --requirement "$constraints"
# The build tools are among the constraints, with hashes: nothing unpinned is fetched.
"$venv/bin/python" -m pip install --quiet --disable-pip-version-check \
    --no-deps --no-build-isolation --editable .
