#!/usr/bin/env bash
# Fuse the three bundled maps, then simulate a drive and map it; reports go to out/demo.
set -euo pipefail
# shellcheck source=launch_scripts/setup.sh
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"

constraints=""
if [ -n "${ROS_DISTRO:-}" ]; then
    constraints="$root/launch_scripts/constraints-jazzy.txt"
fi
make_venv "$root/.venv"
install_into "$root/.venv" report "$constraints"

sample="$root/data/sample"
out="$root/out/demo"
"$root/.venv/bin/slamfusion" fuse \
    "$sample/map_a.yaml" "$sample/map_b.yaml" "$sample/map_c.yaml" \
    --truth "$sample/truth.yaml" --report "$out/report" -o "$out/fused" "$@"

"$root/.venv/bin/slamfusion" simulate office -o "$out/office"
"$root/.venv/bin/slamfusion" slam tinyslam "$out/office/office.log.gz" \
    --truth "$out/office/truth.tum" --truth-map "$out/office/truth.yaml" \
    --report "$out/tinyslam_report" -o "$out/tinyslam"

say "the report, to be opened in a browser: $out/report/report.html"
say "its pictures: $out/report/*.png"
say "the fused map: $out/fused.yaml"
say "the report of tinySLAM on the simulated drive: $out/tinyslam_report/report.html"
