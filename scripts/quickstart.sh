#!/usr/bin/env bash
# The whole workflow from scratch: install, estimate the pose between two pictures, render the embedded objects, train a
# score model, and evaluate it with and without the second stage.
# Existing outputs are reused; arguments are passed to the training, e.g. `model=energy`.
set -euo pipefail
cd "$(dirname "$0")/.."
bash scripts/setup.sh ""  # without the test dependencies
python=.venv/bin/python
# The first command compiles PyTorch's bytecode first; meanwhile another core compiles the modules that it imports next.
$python -c "import hydra.main, scipy.signal, scipy.spatial, trimesh, plotly.offline, matplotlib.pyplot" &
echo "quickstart: estimating where the camera went between two pictures of a can that the model has never met"
$python -m lp_framework estimate "images=[docs/pictures/example_0.png,docs/pictures/example_1.png]" \
    hydra.run.dir=runs/quickstart_estimate
echo
run="runs/quickstart"
if [ -f "$run/training.json" ] && [ $# -eq 0 ]; then
    echo "quickstart: $run contains a trained model; delete the folder to train again"
elif [ -f "$run/checkpoints/last.ckpt" ] && [ $# -eq 0 ]; then
    echo "quickstart: going on with the training in $run"
    $python -m lp_framework train "resume=$run"
else
    echo "quickstart: rendering the embedded objects and training (about 5 minutes on 2 cores)"
    rm -rf "$run"
    $python -m lp_framework train "hydra.run.dir=$run" logger=csv "$@"
fi
echo
echo "quickstart: evaluating both stages, the second one on the prior that ships, and the first one alone"
first="$run/eval_first_stage"  # runs in parallel on another core
mkdir -p "$first"
OMP_NUM_THREADS=1 $python -m lp_framework eval "checkpoint=$run" solver.gamma=0 pictures=false "hydra.run.dir=$first" \
    > "$first/printed.txt" &
$python -m lp_framework eval "checkpoint=$run" solver=two_stage solver.gamma=0 "hydra.run.dir=$run/eval_two_stage"
wait $!
echo
echo "quickstart: the first stage alone"
cat "$first/printed.txt"
