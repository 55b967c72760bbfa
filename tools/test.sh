#!/usr/bin/env bash
# Sets everything up, then runs every check: lint, format, types, tests. tools/test.sh [options of pytest]
set -euo pipefail
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd -P)
"$root/tools/setup.sh" dev
cd "$root"
export OMP_NUM_THREADS=1 # the test processes share the cores already
# Arrays below 32 MB reuse memory that the process keeps. By default, glibc gives much of it back to the kernel and asks for it
# again, and each page is then filled with zeros: a twentieth of the CPU time of the tests.
export MALLOC_MMAP_THRESHOLD_=33554432 MALLOC_TRIM_THRESHOLD_=1073741824
unset PYTHONPATH         # a sourced ROS would bring its own pytest plugins
unset PYTHONDONTWRITEBYTECODE # each process that the tests start would compile objslam again, 0.3 s
.venv/bin/ruff check --quiet
.venv/bin/ruff format --check --quiet
# Without its cache, mypy takes a minute of one core, and so it runs beside the tests. What it finds is said at the end.
found=$(mktemp)
.venv/bin/mypy --no-error-summary >"$found" 2>&1 &
mypy=$!
trap 'kill "$mypy" 2>/dev/null || true; rm -f "$found"' EXIT
failed=0
.venv/bin/pytest -q -n 2 --dist worksteal "$@" || failed=$?
[ "$failed" != 2 ] || exit 2 # Somebody interrupted the tests, and need not wait for mypy.
wait "$mypy" || failed=1
cat "$found"
exit "$failed"
