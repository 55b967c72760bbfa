#!/usr/bin/env bash
# Sets everything up, then runs every check: lint, format, types, tests. tools/test.sh [options of pytest]
set -euo pipefail
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd -P)
"$root/tools/setup.sh" dev
cd "$root"
export OMP_NUM_THREADS=1 # the test processes share the cores already
unset PYTHONPATH         # a sourced ROS would bring its own pytest plugins
unset PYTHONDONTWRITEBYTECODE # each process that the tests start would compile objslam again, 0.3 s
.venv/bin/ruff check --quiet
.venv/bin/ruff format --check --quiet
.venv/bin/mypy --no-error-summary
exec .venv/bin/pytest -q -n 2 --dist worksteal "$@"
