#!/usr/bin/env bash
# Lint, type check, and run the tests: under the Jazzy constraints (NumPy 1.26), then under NumPy 2.
# --full adds the tests that are too long for every run; other options go to pytest: --cov measures
# coverage, which takes longer.
set -euo pipefail
# shellcheck source=launch_scripts/setup.sh
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"
cd "$root"

venv="$root/.venv"
jazzy="$root/.venv-jazzy"
constraints="$root/launch_scripts/constraints-jazzy.txt"

# Four test processes, since those with nodes mostly wait, and PoCL threads that share the cores;
# one for each core in the leg without nodes, for each reads all tests anew.
cores="$(nproc)"
workers=$((cores < 2 ? 1 : 4))
threads=$((cores < workers ? 1 : cores / workers))
export POCL_MAX_PTHREAD_COUNT="${POCL_MAX_PTHREAD_COUNT:-$threads}"
# Hundreds of tests start a command, which would compile the whole package each time.
unset PYTHONDONTWRITEBYTECODE

install_all() {
    make_venv "$venv"
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
    make_venv "$jazzy"
    install_into "$jazzy" test "$constraints" "$root/launch_scripts/lock-jazzy.txt"
    if ! command -v chromium >/dev/null && ! command -v google-chrome >/dev/null; then
        if can_install_packages && apt_install chromium; then
            return
        fi
        say "no chromium: the tests of the live page fail without it"
    fi
}

failed=()

# check NAME COMMAND...: run it and remember whether it failed.
check() {
    local name="$1"
    shift
    say "$name"
    "$@" || failed+=("$name")
}

# The suite runs in parallel where test processes do not fight over one core.
suite() {
    local python="$1/bin/python" processes="$2"
    shift 2
    # In the order of tests/conftest.py, not by the number of tests in a file.
    "$python" -m pytest -n "$processes" --dist loadfile --no-loadscope-reorder "$@"
}

install_all
check "ruff check" "$venv/bin/ruff" check .
check "ruff format" "$venv/bin/ruff" format --check .
# mypy takes one core; on another one the modules of the tests are compiled meanwhile, once for both
# legs and all their processes.
"$jazzy/bin/python" -m pytest --collect-only -q >/dev/null 2>&1 &
check "mypy" "$venv/bin/mypy"
wait "$!" || say "the tests cannot all be collected, as will be said below"
# The Jazzy leg is about NumPy and OpenCV: few sets of parameters of each test, and few examples.
# Recorded maps are looked at once, in the last leg.
check "tests under the Jazzy constraints" \
    suite "$jazzy" "$((workers < cores ? workers : cores))" -m "jazzy or not (ros or datasets or once)" -p no:cacheprovider \
    --few-each --hypothesis-profile=brief "$@"
if [ ${#failed[@]} -gt 0 ]; then
    say "failed so far: ${failed[*]}"
fi
check "tests" suite "$venv" "$workers" "$@"
[ ${#failed[@]} -eq 0 ]
