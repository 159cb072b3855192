#!/usr/bin/env bash
# Create .venv: this package (editable) and its test dependencies, as pinned in constraints.txt. Fast if up to date.
# Pass other extras of pyproject.toml, or none: bash scripts/setup.sh features,zero123; bash scripts/setup.sh ""
# PYTHON=python3.12 bash scripts/setup.sh chooses the interpreter.
set -euo pipefail
cd "$(dirname "$0")/.."
extras="${1-dev}"

fail() { echo "setup: $1" >&2; exit 1; }
new_enough() { "$1" -c 'import sys; sys.exit(sys.version_info < (3, 10))' 2>/dev/null; }

stamp=".venv/installed"  # holds the extras and a checksum of the files that define the packages
sum="$(cat pyproject.toml constraints.txt | cksum)"
found="$(cat "$stamp" 2>/dev/null || true)"
if [ "$found" = "$extras $sum" ] || { [ -z "$extras" ] && [ "${found#* }" = "$sum" ]; }; then
    .venv/bin/python -c '' 2>/dev/null && exit 0
fi

if [ -n "${PYTHON:-}" ]; then
    new_enough "$PYTHON" || fail "$PYTHON is not Python 3.10 or newer"
else
    for candidate in python3 python3.13 python3.12 python3.11 python3.10; do
        if new_enough "$candidate"; then PYTHON="$candidate"; break; fi
    done
    [ -n "${PYTHON:-}" ] || fail "no Python 3.10 or newer found; name one: PYTHON=/path/to/python bash scripts/setup.sh"
fi

if ! .venv/bin/python -c '' 2>/dev/null; then
    echo "setup: making .venv with $("$PYTHON" --version)"
    "$PYTHON" -m venv --clear .venv || fail "$PYTHON -m venv did not work (Debian and Ubuntu: apt install python3-venv)"
fi
echo "setup: installing the packages of constraints.txt (some minutes the first time)"
# Only a quarter of the 20,000 modules is ever used; Python compiles those at first import.
.venv/bin/python -m pip install -qq --disable-pip-version-check --no-compile -c constraints.txt -e ".${extras:+[$extras]}" \
    || fail "the packages could not be installed"
echo "$extras $sum" > "$stamp"
echo "setup: done"
