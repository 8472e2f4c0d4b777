#!/usr/bin/env bash
# Simulate a robot that drives over a cable, map the drive with three SLAMs side by side, and draw
# the map at their fused path; maps and report go to out/demo. Options go to `slamfusion run`.
# demo.sh --page: the same drive live, with nodes, to be watched in the browser.
set -euo pipefail
# shellcheck source=launch_scripts/setup.sh
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"

constraints=""
if [ -n "${ROS_DISTRO:-}" ]; then
    constraints="$root/launch_scripts/constraints-jazzy.txt"
fi
make_venv "$root/.venv"
install_into "$root/.venv" report "$constraints"

out="$root/out/demo"
say "simulating the drive of Fernandes and Alexandre: turn, 5 m over an obstacle, turn"
"$root/.venv/bin/slamfusion" simulate f16 --lidar rplidar --obstacle --seed 1 -o "$out/drive"

if [ "${1:-}" = --page ]; then
    shift
    exec "$root/launch_scripts/slamfusion.sh" "$out/drive/f16.log.gz" --page -o "$out/live" "$@"
fi

say "three SLAMs on it side by side, and the map drawn from all scans at their fused path"
"$root/.venv/bin/slamfusion" run "$out/drive/f16.log.gz" \
    --truth "$out/drive/truth.yaml" --truth-trajectory "$out/drive/truth.tum" \
    -o "$out" "$@"

say "the column 'map error' of the table: the smaller, the nearer to the true map"
say "the report, to be opened in a browser: $out/report/report.html"
say "the fused map: $out/fused.yaml; the true one: $out/drive/truth.yaml"
say "the same live in the browser: launch_scripts/demo.sh --page"
