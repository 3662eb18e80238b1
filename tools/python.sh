#!/usr/bin/env bash
# Print the path of a Python that Amberbox runs on (3.11 or newer); say what to do without one.
set -euo pipefail

new_enough() {
    "$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null
}

for candidate in ${PYTHON:-} python3 python3.13 python3.12 python3.11; do
    if path=$(command -v "$candidate") && new_enough "$path"; then
        echo "$path"
        exit 0
    fi
done
echo "Amberbox needs Python 3.11 or newer, found: $(python3 --version 2>&1 || true)" >&2
echo "hint: apt-get install python3.11 python3.11-venv, or set PYTHON=/path/to/python" >&2
exit 2
