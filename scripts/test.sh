#!/usr/bin/env bash
# Everything a change is judged by, without a GPU. Arguments go to pytest: bash scripts/test.sh -k registry -n 0
set -euo pipefail
cd "$(dirname "$0")/.."
bash scripts/setup.sh
export PATH="$PWD/.venv/bin:$PATH"
export OMP_NUM_THREADS="${OMP_NUM_THREADS:-1}"  # two test processes, a thread each

echo "test: format";  ruff format --check --quiet .
echo "test: lint";    ruff check --quiet .
echo "test: types";   mypy --no-error-summary
run() { pytest --quiet -n 2 --dist loadfile -m "not slow and not gpu" "$@"; }
if [ $# -gt 0 ]; then
    echo "test: pytest"
    run "$@"
    exit
fi

# The mathematics and the doctests first: how much of it they cover is measured, which slows tests down by a third.
shopt -s nullglob
mathematics=(
    tests/test_{ambiguity,azimuth,ddim,descent,embedding,exact_prior,features,feed_forward,gauss_newton,geometry}*.py
    tests/test_{id_pose,ifusion,keyed_random,landscape,langevin,metrics,multiview,networks,objectives}*.py
    tests/test_{pair_energy,pairs,pose_graph,real_cameras,solver,starts,theory,tiny_prior,two_stage,view_sets}*.py
)
echo "test: mathematics"; run --cov --cov-report= lp_framework "${mathematics[@]}"
echo "test: coverage";    python scripts/mathematics_coverage.py
echo "test: the rest";    run tests plugins/*/tests "${mathematics[@]/#/--ignore=}"
