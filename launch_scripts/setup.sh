# Sourced by the scripts beside it: finds a Python, makes a venv once, installs what is new.
# shellcheck shell=bash

root="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
export PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_ROOT_USER_ACTION=ignore

say() { printf '== %s\n' "$*" >&2; }

die() {
    printf 'error: %s\n' "$*" >&2
    exit 1
}

can_install_packages() { [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; }

apt_install() {
    say "apt-get install $*"
    { apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq "$@"; } >/dev/null
}

# Print a Python from 3.10 to 3.13 that starts; $PYTHON is asked first.
find_python() {
    local name
    for name in ${PYTHON:+"$PYTHON"} python3.12 python3.11 python3.13 python3.10 python3 python; do
        if "$name" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))' \
            >/dev/null 2>&1; then
            command -v "$name"
            return
        fi
    done
    die "no Python from 3.10 to 3.13 found; install one or set PYTHON to it"
}

# make_venv FOLDER [OPTIONS]: create it unless it is there and works.
make_venv() {
    local venv="$1" python
    local options=("${@:2}")
    if "$venv/bin/python" -c '' >/dev/null 2>&1; then
        return
    fi
    python="$(find_python)"
    if ! "$python" -c 'import ensurepip, venv' >/dev/null 2>&1; then
        can_install_packages || die "$python cannot make a venv; install python3-venv"
        apt_install python3-venv
    fi
    say "making $venv with $("$python" --version)"
    if [ -n "${ROS_DISTRO:-}" ]; then
        options+=(--system-site-packages) # a sourced ROS brings its own rclpy
    fi
    "$python" -m venv --clear ${options[@]+"${options[@]}"} "$venv"
}

# pip_install FOLDER WORDS...: install with uv where .venv has it, in a tenth of pip's processor time;
# where it has none, or that fails, with pip, which says why it fails.
pip_install() {
    local python="$1/bin/python"
    shift
    "$root/.venv/bin/uv" pip install -q --python "$python" "$@" 2>/dev/null && return
    "$python" -m pip --version >/dev/null 2>&1 || "$python" -m ensurepip >/dev/null
    "$python" -m pip install -qq "$@"
}

# install_into FOLDER EXTRAS [CONSTRAINTS [LOCK]]: install the project unless nothing has changed.
# What it needs is taken from the lock, versions and hashes, where that fits this machine. The lock
# names everything, and pip's own look at what packages need fails on their extras.
install_into() {
    local venv="$1" extras="$2" constraints="${3:-}" lock="${4:-}" stamp wanted reason
    local options=(${constraints:+-c "$constraints"})
    stamp="$venv/.installed-$extras"
    wanted="$(cat "$root/pyproject.toml" ${constraints:+"$constraints"} ${lock:+"$lock"} | sha256sum)"
    if [ -f "$stamp" ] && [ "$(cat "$stamp")" = "$wanted" ]; then
        return
    fi
    say "installing slamfusion[$extras] into $venv"
    if [ -n "$lock" ]; then
        if reason="$(pip_install "$venv" --no-deps --require-hashes -r "$lock" 2>&1)"; then
            options=(--no-deps)
        else
            say "$(basename "$lock") does not fit $("$venv/bin/python" --version) here: pip chooses versions"
            printf '%s\n' "$reason" | tail -n 3 >&2
        fi
    fi
    pip_install "$venv" ${options[@]+"${options[@]}"} -e "$root[$extras]" || return
    printf '%s\n' "$wanted" >"$stamp"
}
