#!/usr/bin/env bash
# Sets everything up, then simulates a drive, maps its objects and shows how well that went: tools/demo.sh [options of `objslam demo`]
# Writes demo_out in the current folder, or demo_boxes with --boxes.
set -euo pipefail
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd -P)
"$root/tools/setup.sh" run
exec "$root/.venv/bin/objslam" demo "$@"
