#!/usr/bin/env bash
# Install those of the given Debian packages that are missing; without root only say how.
set -euo pipefail
export DEBIAN_FRONTEND=noninteractive

is_missing() {
    [ "$(dpkg-query --show --showformat '${db:Status-Status}' "$1" 2>/dev/null)" != installed ]
}

install() {
    apt-get install --yes --quiet --no-install-recommends "$@" </dev/null
}

command -v dpkg-query >/dev/null || { echo "not a Debian system: install yourself: $*" >&2; exit 3; }
missing=()
for package in "$@"; do
    is_missing "$package" && missing+=("$package")
done
[ ${#missing[@]} -eq 0 ] && exit 0
if [ "$(id -u)" -ne 0 ]; then
    echo "missing Debian packages; to install them:" >&2
    echo "  sudo apt-get install --no-install-recommends ${missing[*]}" >&2
    exit 3
fi
install "${missing[@]}" || { apt-get update --quiet </dev/null && install "${missing[@]}"; }
