#!/usr/bin/env bash
# Start the ROS 2 nodes: three producers, the fusion and, with a log, the player. One Ctrl-C ends
# them all; a node that dies is started again. Works with pip alone; a sourced ROS is left as it is.
#
# slamfusion.sh [LOG [-o DIR] [--rate X | --lockstep]] [--params FILE] [--producers NAMES] [--page]
#               [-- ROS ARGUMENTS FOR EVERY NODE]
#
#   LOG               play a log or bag (also: --log LOG); at its end everything ends, and DIR has
#                     the fused map, those of the producers, and a report in which these are fused
#                     once more (fused_again); after Ctrl-C before its end the maps so far
#   -o DIR            default: out/live
#   --rate X          play X times as fast as recorded
#   --lockstep        play as fast as every producer can follow
#   --params FILE     a YAML file of parameters for all nodes, as launch_scripts/slamfusion.yaml
#   --producers NAMES which ones, by commas (also: --only); default: tinyslam,gmapping,graph
#   --page            show everything in the browser while it happens; the fusion logs the address
#
# A node that ends soon after its start is started again later each time, up to 30 s; one that has
# done so three times and never ran for longer cannot start at all, and everything ends.
# SLAMFUSION names the installed command to use; default: that of .venv, which is made.
set -euo pipefail
# What a parent ignores (SIGINT: any script, of what it starts in the background) bash can never trap:
# Ctrl-C would end the nodes, and this script would start them again.
if [ -r /proc/$$/status ] && [ -z "${SLAMFUSION_HEARS_SIGINT:-}" ]; then
    ignored="$(sed -n 's/^SigIgn:[^0-9a-f]*//p' /proc/$$/status)"
    if ((0x${ignored:-0} & 2)) && env --default-signal=INT true 2>/dev/null; then
        SLAMFUSION_HEARS_SIGINT=1 exec env --default-signal=INT bash "${BASH_SOURCE[0]}" "$@"
    fi
fi
unset SLAMFUSION_HEARS_SIGINT
# Ten processes with the Fast DDS profile for large maps.
LEAST_SHM_KB=327680
# shellcheck source=launch_scripts/setup.sh
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"

log="" out="out/live" producers="tinyslam,gmapping,graph" params="" page=""
pace=(-p "rate:=1.0")
while [ $# -gt 0 ]; do
    case "$1" in
        --log | -o | --rate | --params | --only | --producers)
            [ $# -ge 2 ] || die "$1 needs a value"
            case "$1" in
                --log) log="$2" ;;
                -o) out="$2" ;;
                --rate) pace=(-p "rate:=$2") ;;
                --params) params="$2" ;;
                --only | --producers) producers="$2" ;;
            esac
            shift 2
            ;;
        --page) page=yes && shift ;;
        --lockstep) pace=(-p lockstep:=true) && shift ;;
        -h | --help) sed -n '2,/^set /{/^set /d;s/^# \{0,1\}//;p;}' "${BASH_SOURCE[0]}" && exit 0 ;;
        --) shift && break ;;
        -*) die "unknown option $1; see --help" ;;
        *)
            [ -z "$log" ] || die "two logs, $log and $1; one is played at a time"
            log="$1" && shift
            ;;
    esac
done
[ -z "$log" ] || [ -e "$log" ] || die "$log: no such log"
[ -z "$params" ] || [ -f "$params" ] || die "$params: no such file"
changed_ns() { stat -c %.9Y "$1" | tr -d .; }
began=0
if [ -n "$log" ]; then
    # Before the log plays, not after it. What is older was not made by this run.
    mkdir -p "$out" 2>/dev/null || die "$out: cannot be made; name another folder with -o"
    probe="$(mktemp "$out/.probe.XXXXXX" 2>/dev/null)" ||
        die "$out: cannot be written to; name another folder with -o"
    began="$(changed_ns "$probe")"
    rm "$probe"
fi
is_new() { [ -f "$1" ] && [ "$(changed_ns "$1")" -ge "$began" ]; }

slamfusion="${SLAMFUSION:-}"
if [ -z "$slamfusion" ]; then
    make_venv "$root/.venv"
    if [ -n "${ROS_DISTRO:-}" ]; then
        install_into "$root/.venv" "report${page:+,page}" "$root/launch_scripts/constraints-jazzy.txt"
    else
        install_into "$root/.venv" "report,ros${page:+,page}"
    fi
    slamfusion="$root/.venv/bin/slamfusion"
fi

common=("$@")
[ -z "$params" ] || common+=(--params-file "$params")
listed="" maps="" nodes=1
producers="${producers//,/ }"
for name in $producers; do
    listed="${listed:+$listed,}$name"
    maps="${maps:+$maps,}$name/map"
    nodes=$((nodes + 1))
done
[ -n "$listed" ] || die "--producers names no producer"

# The nodes share the cores.
threads=$(($(nproc) / nodes))
export POCL_MAX_PTHREAD_COUNT="${POCL_MAX_PTHREAD_COUNT:-$((threads > 1 ? threads : 1))}"

# A fusion that is started again knows the page that was opened before.
if [ -n "$page" ]; then
    SLAMFUSION_PAGE_TOKEN="${SLAMFUSION_PAGE_TOKEN:-$(od -An -N18 -tx1 /dev/urandom | tr -d ' \n')}"
    export SLAMFUSION_PAGE_TOKEN
fi

# Maps go whole through shared memory, where that has room for all nodes and RViz.
free_kb="$(df -k --output=avail /dev/shm 2>/dev/null | tail -n 1 || true)"
if [ -z "${FASTRTPS_DEFAULT_PROFILES_FILE:-}${FASTDDS_BUILTIN_TRANSPORTS:-}" ] &&
    [ "${free_kb:-0}" -ge "$LEAST_SHM_KB" ]; then
    export FASTRTPS_DEFAULT_PROFILES_FILE="$root/launch_scripts/fastdds-large-maps.xml"
fi

# name -> process; when it is to be started again; how often it has ended before its start was over
# or soon after, one time after the other; whether it has ever run for longer
declare -A pid due quick has_run
GRACE_S=10 SOON_S=10 MOST_QUICK=3 LONGEST_PAUSE_S=30
# Kernels that were never compiled on this machine take their time.
START_TIMEOUT_S=300

start() {
    local name="$1"
    # The last one to say it is right: a parameter file may name other inputs, but no other log.
    local arguments=(${common[@]+"${common[@]}"})
    case "$name" in
        fusion)
            arguments=(-p "inputs:=[$maps]" -p "state_path:=$session/fusion"
                ${page:+-p page:=true} ${common[@]+"${common[@]}"})
            ;;
        player)
            arguments+=(-p "file:=$log" -p "wait_for:=[$listed]" -p "maps:=[$maps,fused/map]"
                -p "save:=$out" -p "start_timeout_s:=$START_TIMEOUT_S.0" "${pace[@]}")
            ;;
    esac
    rm -f "$session/started-$name"
    SLAMFUSION_STARTED="$session/started-$name" "$slamfusion" node "$name" --ros-args ${arguments[@]+"${arguments[@]}"} &
    pid[$name]=$!
}

# A fusion that is started again goes on in its frame; the next session begins another one, unless
# a parameter file names a state_path.
session="$(mktemp -d)"
# What holds for all nodes, one of them says.
export SLAMFUSION_SESSION="$session"

stop_all() {
    trap '' INT TERM HUP
    local name until
    for name in "${!pid[@]}"; do
        kill -TERM "${pid[$name]}" 2>/dev/null || true
    done
    until=$((SECONDS + GRACE_S))
    for name in "${!pid[@]}"; do
        while kill -0 "${pid[$name]}" 2>/dev/null && [ "$SECONDS" -lt "$until" ]; do
            sleep 0.1
        done
        if kill -0 "${pid[$name]}" 2>/dev/null; then
            say "$name has not ended in $GRACE_S s; it is killed"
            kill -KILL "${pid[$name]}" 2>/dev/null || true
        fi
        wait "${pid[$name]}" 2>/dev/null || true
    done
    pid=()
}

stop_early() {
    say "stopping every node"
    stop_all
    # The player has saved what there was.
    if [ -n "$log" ] && is_new "$out/fused.yaml"; then
        say "stopped before the end of the log; the fused map so far: $out/fused.yaml"
    fi
    exit 0
}
trap stop_early INT TERM HUP
trap 'stop_all; rm -rf "$session"' EXIT

for name in $producers fusion; do
    start "$name"
done
[ -z "$log" ] || start player
say "running: $producers fusion${log:+ player}; Ctrl-C ends them all"

# Note that a node has ended, and when it is to be started again.
take_end() {
    local name="$1" code="$2" ran=0 pause=0 mark="$session/started-$1"
    [ ! -e "$mark" ] || ran=$(($(date +%s) - $(stat -c %Y "$mark")))
    unset "pid[$name]"
    if [ "$ran" -ge "$SOON_S" ]; then
        quick[$name]=0 has_run[$name]=yes
    else
        quick[$name]=$((${quick[$name]:-0} + 1))
        if [ "${quick[$name]}" -ge "$MOST_QUICK" ] && [ -z "${has_run[$name]:-}" ]; then
            die "$name has ended with $code $MOST_QUICK times in a row soon after its start"
        fi
        pause=$((quick[$name] > 5 ? LONGEST_PAUSE_S : 2 ** (quick[$name] - 1)))
    fi
    due[$name]=$((SECONDS + pause))
    local when=""
    [ "$pause" = 0 ] || when=", in $pause s"
    local how="with an empty map"
    [ "$name" != fusion ] || how="in its frame"
    say "$name has ended with $code; it is started again, $how$when"
}

is_over=""
while [ -z "$is_over" ]; do
    sleep 0.3
    for name in "${!due[@]}"; do
        [ "$SECONDS" -ge "${due[$name]}" ] || continue
        unset "due[$name]"
        start "$name"
    done
    for name in "${!pid[@]}"; do
        kill -0 "${pid[$name]}" 2>/dev/null && continue
        code=0
        wait "${pid[$name]}" || code=$?
        if [ "$name" = player ]; then
            unset "pid[player]"
            [ "$code" = 0 ] || die "the player has ended with $code"
            is_over=yes
            break
        fi
        take_end "$name" "$code"
    done
done

stop_all
trap 'say "stopping"; stop_all; exit 0' INT TERM HUP
is_new "$out/fused.yaml" || die "nothing was fused; see what the nodes said above"
say "the fused map: $out/fused.yaml"
saved=()
for name in $producers; do
    ! is_new "$out/$name.yaml" || saved+=("$out/$name.yaml")
done
# What the commands print would name their own map; the report has it too.
report() {
    "$slamfusion" "$@" --report "$out/report" >/dev/null &
    pid=([report]=$!)
    wait "${pid[report]}"
}

if [ ${#saved[@]} -ge 2 ]; then
    # What the last maps give when they are fused once more, with the table and the pictures. Live
    # they were followed from their beginnings; without that they may be too different.
    if ! report fuse "${saved[@]}" -o "$out/fused_again"; then
        say "the last maps alone do not show how they lie; they are compared with the fused map"
        report evaluate "${saved[@]}" --truth "$out/fused.yaml" ||
            die "no report of the saved maps"
    fi
    say "the report, to be opened in a browser: $out/report/report.html"
fi
