#!/usr/bin/env bash
# Run the tests that have just failed once more, with nothing beside them, after pytest ended with
# the status $1. Who passes now is named: it is unsteady, a defect of the test or of what it tests.
# More than a few failures are no accident, and nothing is repeated.
set -euo pipefail
cd "$(dirname "$0")/.."
python=${VENV:-.venv}/bin/python
most=5

[ "$1" -eq 1 ] || exit "$1"  # interrupted, wrong usage, or the run itself broke
mapfile -t failed < <("$python" - <<'PYTHON'
import json
from pathlib import Path

cache = Path(".pytest_cache/v/cache/lastfailed")
print(*(json.loads(cache.read_text()) if cache.exists() else ()), sep="\n")
PYTHON
)
[ -n "${failed[0]:-}" ] && [ "${#failed[@]}" -le "$most" ] || exit 1
echo "again, with nothing beside them: ${#failed[@]}"
"$python" -m pytest "${failed[@]}"
printf 'unsteady, to be mended: %s\n' "${failed[@]}"
