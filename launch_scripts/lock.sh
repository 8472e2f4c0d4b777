#!/usr/bin/env bash
# Write the lock files again, with the newest versions that fit: needs uv (`pip install uv`).
# They hold versions and hashes of what the two environments of the suite need, nothing else.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

# lock FILE PYTHON OPTIONS...: for that Python and newer ones, on every platform.
lock() {
    local file="$1" python="$2"
    shift 2
    uv pip compile pyproject.toml "$@" --universal --python-version "$python" --generate-hashes \
        --no-header --no-annotate --no-emit-index-url --upgrade --quiet -o "launch_scripts/$file"
}

lock lock.txt 3.11 --extra dev --extra ros # ROS has wheels from Python 3.11 on
lock lock-jazzy.txt 3.10 --extra test -c launch_scripts/constraints-jazzy.txt
