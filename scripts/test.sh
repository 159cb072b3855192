#!/usr/bin/env bash
# Run all checks of a change, without a GPU. Arguments are passed to pytest: bash scripts/test.sh -k registry -n 0
set -euo pipefail
cd "$(dirname "$0")/.."
bash scripts/setup.sh
export PATH="$PWD/.venv/bin:$PATH"
export OMP_NUM_THREADS="${OMP_NUM_THREADS:-1}"  # two test processes, one thread each

echo "test: format"; ruff format --check --quiet .
echo "test: lint";   ruff check --quiet .
echo "test: types and tests"  # mypy runs in parallel because it uses only one core
mypy --no-error-summary & types=$!
pytest --quiet -n 2 --dist worksteal -m "not slow and not gpu" "$@"
wait $types
