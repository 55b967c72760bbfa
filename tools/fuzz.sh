#!/usr/bin/env bash
# Feeds mutated files to every parser, with other inputs in each round: tools/fuzz.sh --minutes N [options of pytest]
# OBJSLAM_FUZZ_LEAST=5000 gives every target at least so many inputs in each round, also the slow ones.
set -euo pipefail
if [[ ${1:-} != --minutes || ! ${2:-} =~ ^[0-9]+$ ]]; then
    echo "usage: tools/fuzz.sh --minutes N [options of pytest]" >&2
    exit 2
fi
end=$((SECONDS + 60 * $2))
shift 2
cd "$(dirname "${BASH_SOURCE[0]}")/.."
python=${PYTHON:-.venv/bin/python}
export OMP_NUM_THREADS=1 OBJSLAM_FUZZ_ROUNDS=${OBJSLAM_FUZZ_ROUNDS:-10} OBJSLAM_FUZZ_SEED=${OBJSLAM_FUZZ_SEED:-1}
while ((SECONDS < end)); do
    echo "seed $OBJSLAM_FUZZ_SEED"
    "$python" -m pytest -q -x tests/fuzz "$@"
    OBJSLAM_FUZZ_SEED=$((OBJSLAM_FUZZ_SEED + 1))
done
