#!/usr/bin/env bash
# Feeds mutated files to every parser, with other inputs in each round: tools/fuzz.sh --minutes N [options of pytest]
# The table at the end of a round has the sums of all rounds: inputs, CPU seconds, and the slowest input of each target.
#   OBJSLAM_FUZZ_LEAST=5000     gives every target at least so many inputs in each round, also the slow ones
#   OBJSLAM_FUZZ_ROUNDS=100     gives every target so many times the inputs of the suite in each round (10)
#   OBJSLAM_FUZZ_SEED=7         begins with these inputs (1)
#   OBJSLAM_FUZZ_TABLE=FILE     adds to the sums of earlier calls, so that a long run can be done in parts: -k NAME
#   OBJSLAM_FUZZ_SECONDS=5      the most CPU seconds that an input may take (5)
set -euo pipefail
if [[ ${1:-} != --minutes || ! ${2:-} =~ ^[0-9]+$ ]]; then
    sed -n '2,8s/^# \?//p' "$0" >&2
    exit 2
fi
end=$((SECONDS + 60 * $2))
shift 2
cd "$(dirname "${BASH_SOURCE[0]}")/.."
python=${PYTHON:-.venv/bin/python}
export OMP_NUM_THREADS=1 OBJSLAM_FUZZ_ROUNDS=${OBJSLAM_FUZZ_ROUNDS:-10} OBJSLAM_FUZZ_SEED=${OBJSLAM_FUZZ_SEED:-1}
export OBJSLAM_FUZZ_SECONDS=${OBJSLAM_FUZZ_SECONDS:-5} OBJSLAM_FUZZ_TABLE=${OBJSLAM_FUZZ_TABLE:-}
export OPENCV_LOG_LEVEL=SILENT # as the commands do
if [[ ! $OBJSLAM_FUZZ_TABLE ]]; then
    OBJSLAM_FUZZ_TABLE=$(mktemp)
    trap 'rm -f "$OBJSLAM_FUZZ_TABLE"' EXIT
fi
while ((SECONDS < end)); do
    echo "seed $OBJSLAM_FUZZ_SEED"
    "$python" -m pytest -q -x tests/fuzz "$@"
    OBJSLAM_FUZZ_SEED=$((OBJSLAM_FUZZ_SEED + 1))
done
