#!/usr/bin/env bash
# Lint, type check, and run the tests: under NumPy 2, and before it those under the Jazzy constraints
# (NumPy 1.26) to which it matters.
# --full adds the tests that are too long for every run; other options go to pytest: --cov measures
# coverage, which takes longer.
set -euo pipefail
# shellcheck source=launch_scripts/setup.sh
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"
cd "$root"

venv="$root/.venv"
jazzy="$root/.venv-jazzy"
constraints="$root/launch_scripts/constraints-jazzy.txt"

# A test process for each core, one more for the tests with nodes, which mostly wait, and one PoCL
# thread in each. Each process takes some 20 s of processor time to collect and load what it needs.
cores="$(nproc)"
workers=$(((cores < 8 ? cores : 8) + 1))
export POCL_MAX_PTHREAD_COUNT="${POCL_MAX_PTHREAD_COUNT:-1}"
# Hundreds of tests start a command, which would compile the whole package each time.
unset PYTHONDONTWRITEBYTECODE
# pip compiles nothing ahead (a false value says so): what is imported is a small part of it.
export PIP_NO_COMPILE=0

install_all() {
    make_venv "$venv"
    [ -x "$venv/bin/uv" ] || "$venv/bin/python" -m pip install -qq uv || say "no uv: pip takes longer"
    make_venv "$jazzy" --without-pip
    install_into "$jazzy" test "$constraints" "$root/launch_scripts/lock-jazzy.txt" &
    local of_jazzy=$!
    if [ -n "${ROS_DISTRO:-}" ]; then
        say "ROS_DISTRO is set: its rclpy is used, the ros extra is not installed"
        install_into "$venv" dev "$constraints"
    elif ! install_into "$venv" dev,ros "" "$root/launch_scripts/lock.txt"; then
        say "the ros extra does not install on $("$venv/bin/python" --version); going without it"
        install_into "$venv" dev
    fi
    if "$venv/bin/python" -c 'import rclpy' >/dev/null 2>&1; then
        "$root/launch_scripts/build_messages.sh" "$venv/bin/python" ||
            say "no tf2_msgs, no map_msgs: the tests of /tf and of map updates are skipped"
    fi
    wait "$of_jazzy" || die "the environment of the Jazzy constraints cannot be made"
    if ! command -v chromium >/dev/null && ! command -v google-chrome >/dev/null; then
        if can_install_packages && apt_install chromium; then
            return
        fi
        say "no chromium: the tests of the live page fail without it"
    fi
}

# What older NumPy, SciPy, OpenCV, Pillow, click and pandas could break: arrays and their kernels,
# files, pictures, statistics, settings, and the main job from end to end.
jazzy_tests=(tests/kernels tests/io tests/vote tests/report tests/evaluation tests/pose_graph
    tests/jobs/test_run.py tests/slam/gmapping/test_proposal.py tests/sim/test_sample.py
    tests/test_*.py)

failed=()

# check NAME COMMAND...: run it and remember whether it failed.
check() {
    local name="$1"
    shift
    say "$name"
    "$@" || failed+=("$name")
}

# Types, and few sets of parameters and examples of the tests to which the Jazzy constraints matter;
# what is looked at once is in the other leg.
types_and_jazzy() {
    failed=()
    check "mypy" "$venv/bin/mypy"
    check "tests under the Jazzy constraints" \
        "$jazzy/bin/python" -m pytest -m "jazzy or not (ros or datasets or once)" \
        -p no:cacheprovider --few-each --hypothesis-profile=brief "${jazzy_tests[@]}" "$@"
    [ ${#failed[@]} -eq 0 ]
}

# finish PID LOG: wait for what runs in the background, show what it said, and end as it did.
finish() {
    local code=0
    wait "$1" || code=$?
    cat "$2"
    return "$code"
}

install_all
check "ruff check" "$venv/bin/ruff" check .
check "ruff format" "$venv/bin/ruff" format --check .
log="$(mktemp)"
trap 'rm -f "$log"' EXIT
types_and_jazzy "$@" >"$log" 2>&1 &
# In the order of tests/conftest.py, not by the number of tests in a file.
check "tests" "$venv/bin/python" -m pytest -n "$workers" --dist loadfile --no-loadscope-reorder "$@"
check "types and tests under the Jazzy constraints" finish "$!" "$log"
[ ${#failed[@]} -eq 0 ] || die "failed: ${failed[*]}"
