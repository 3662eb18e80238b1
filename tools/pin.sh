#!/usr/bin/env bash
# Write the constraints files anew: exact versions with the hashes of all their wheels.
#
# Run it with Python 3.11, the oldest we serve: what it resolves must install on 3.11 to 3.13.
# The hashes cover every wheel of a version, so one file serves x86_64 and aarch64.
# The index is pip's own setting and is not written down. Takes some minutes.
set -euo pipefail
cd "$(dirname "$0")/.."

python=${1:?usage: tools/pin.sh PYTHON_3.11 [pip-compile options, such as --upgrade]}
shift
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
"$python" -m venv "$scratch/venv"
"$scratch/venv/bin/pip" install --quiet pip-tools

compile() {  # NAME EXTRA_OPTION...
    local target=constraints/$1.txt
    shift
    "$scratch/venv/bin/pip-compile" --quiet --generate-hashes --allow-unsafe --strip-extras \
        --all-build-deps --no-header --no-annotate --no-emit-options \
        --no-emit-index-url --no-emit-trusted-host --no-emit-find-links \
        --output-file "$target" "$@" pyproject.toml
    # An extra that names other extras of ours appears as this folder: not a package to install.
    # There is no wheel of CycloneDDS for aarch64; pip-compile drops markers within our extras.
    sed -i -e '/^#/d' -e '/^amberbox @/d' -e '/^$/d' \
        -e 's/^\(cyclonedds==[^ ]*\) [^;]*$/\1 ; platform_machine == "x86_64" \\/' "$target"
}

compile all --extra all "$@"
compile test --extra all --extra test --constraint constraints/all.txt "$@"
compile bench --extra bench --constraint constraints/test.txt "$@"
