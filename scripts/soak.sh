#!/bin/bash
# SPDX-License-Identifier: MIT
# Plays a bag again and again through the nodelets and reports memory growth after a warm-up,
# threads, file descriptors, losses and latency. Exit code 0 only if every limit holds.
#
#   scripts/soak.sh MINUTES [options]
#   scripts/soak.sh --hostile MINUTES      good drives between attacks (test/hostile.py); of the
#                                          options only --build-dir
#     --bag FILE         the bag to loop (default: a simulated drive)
#     --rig FILE         its rig file (default: config/demo.yaml, the simulated drive's)
#     --scale S          image size of the simulated drive, 1 = 1920x1208 (default: 0.5)
#     --duration S       its length in seconds (default: 10)
#     --rate R           speed of playback (default: 1.0); 2 shows an overload, with --overload
#     --overload         scans may be dropped, as long as each is counted
#     --overrides TEXT   changes to the rig file, key=value separated by blanks
#     --warm-up MIN      minutes before the first sample (default: 2)
#     --growth-mb N      limit of the memory's growth (default: 20; also 2 %, --growth-percent)
#     --growth-percent N
#     --drift-ms N       limit of the latency's growth (default: 50)
#     --pairs-percent N  least share of scans to which each camera contributes (default: 99)
#     --build-dir DIR    the build of the package (default: build/ of the package)
#     --csv FILE         write the samples there as well
#     --help             this text
set -euo pipefail
PATH=/usr/sbin:/usr/bin:/sbin:/bin
source_dir=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)

usage() { sed -n '3,24s/^# \{0,1\}//p' "${BASH_SOURCE[0]}"; }
fail() {
  echo "soak.sh: $*" >&2
  exit 2
}

minutes="" bag="" rig=$source_dir/config/demo.yaml scale=0.5 duration=10 rate=1.0 warm_up=2
build_dir=$source_dir/build hostile=""
pass_on=()
while [ $# -gt 0 ]; do
  case $1 in
    --bag | --rig | --scale | --duration | --rate | --warm-up | --build-dir | --overrides | \
      --growth-mb | --growth-percent | --drift-ms | --pairs-percent | --csv)
      [ $# -ge 2 ] || fail "$1 needs a value"
      case $1 in
        --bag) bag=$2 ;;
        --rig) rig=$2 ;;
        --scale) scale=$2 ;;
        --duration) duration=$2 ;;
        --rate) rate=$2 ;;
        --warm-up) warm_up=$2 ;;
        --build-dir) build_dir=$2 ;;
        *) pass_on+=("$1" "$2") ;;
      esac
      shift
      ;;
    --overload) pass_on+=(--overload) ;;
    --hostile) hostile=yes ;;
    --help | -h) usage; exit 0 ;;
    -*) fail "unknown option '$1'; try --help" ;;
    *) [ -z "$minutes" ] || fail "MINUTES is given twice"; minutes=$1 ;;
  esac
  shift
done
[[ $minutes =~ ^[0-9]+(\.[0-9]+)?$ ]] || fail "MINUTES is '$minutes'; try --help"
[ -f "$build_dir/devel/setup.bash" ] || fail "no build in $build_dir; see CONTRIBUTING.md"

work=$(mktemp -d)
roscore_pid=""
end() {
  [ -z "$roscore_pid" ] || kill -INT "$roscore_pid" 2>/dev/null || true
  [ -z "$roscore_pid" ] || wait "$roscore_pid" 2>/dev/null || true
  rm -rf "$work"
}
trap end EXIT
trap 'exit 130' INT TERM

set +u
source "$build_dir/devel/setup.bash"
set -u
if [ -z "$bag" ] && [ -z "$hostile" ]; then
  bag=$work/drive.bag
  simulator=$build_dir/devel/lib/semantic_lidar_fusion/simulate_drive
  [ -x "$simulator" ] || fail "simulate_drive is not built; give --bag and --rig"
  "$simulator" --out "$bag" --duration "$duration" --scale "$scale" --seed 1 --quiet
fi

export ROS_IP=127.0.0.1 ROS_HOME=$work/ros_home ROSCONSOLE_STDOUT_LINE_BUFFERED=1
port=$(/usr/bin/python3 -c 'import socket; s = socket.socket(); s.bind(("127.0.0.1", 0)); print(s.getsockname()[1])')
export ROS_MASTER_URI=http://127.0.0.1:$port
roscore -p "$port" >"$work/roscore.log" 2>&1 &
roscore_pid=$!
sim_time=true
[ -z "$hostile" ] || sim_time=false
for _ in $(seq 200); do
  rosparam set /use_sim_time $sim_time 2>/dev/null && break
  sleep 0.1
done
if [ -n "$hostile" ]; then
  SLF_BIN_DIR=$build_dir/devel/lib/semantic_lidar_fusion \
    /usr/bin/python3 "$source_dir/test/hostile.py" --minutes "$minutes"
  exit
fi
/usr/bin/python3 "$source_dir/test/soak.py" "$bag" "$rig" --minutes "$minutes" \
  --warm-up "$warm_up" --rate "$rate" ${pass_on[@]+"${pass_on[@]}"}
