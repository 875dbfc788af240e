#!/bin/bash
# SPDX-License-Identifier: MIT
# Installs what is missing, builds, simulates a drive of known truth, plays its bag through the
# nodelets, makes the paper's table for it, draws the paper's figures, and prints table and files.
#
#   scripts/demo.sh [options]
#     --duration S       of the simulated drive (default: 2)
#     --scale F          size of its images, of 1920 x 1208 (default: 0.5)
#     --rate F           speed of playback; 1 = as on the vehicle (default: 0.5)
#     --drive DIR        a KITTI raw drive instead (DATE/DATE_drive_NNNN_sync beside its calibration
#                        files): imports it, runs the network of --model, fuses it offline
#     --calibration DIR  a folder of ACFR's camera-lidar calibration tool instead (images, pcd,
#                        camera_info.yaml, calibration runs; or its compact form, whose board needs
#                        no network): imports its poses, fuses them offline
#     --model FILE       an ONNX network for which config/models/ has a description of that name
#     --output DIR       where bags, tables and pictures go (default: demo/ of the build folder)
#     --build-dir DIR    where to build (default: build/ of the package)
#     --jobs N           parallel compilations (default: processors, at most 8)
#     --no-install       do not look for missing dependencies
#     --no-build         use what is built
#     --help             this text
set -euo pipefail
PATH=/usr/sbin:/usr/bin:/sbin:/bin
source_dir=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
package=semantic_lidar_fusion

usage() { sed -n '3,22s/^# \{0,1\}//p' "${BASH_SOURCE[0]}"; }
fail() {
  echo "demo.sh: $*" >&2
  exit "${code:-1}"
}
step() { printf '\n== %3d s  %s\n' "$SECONDS" "$*"; }
# Runs a command with its output in a file; shows the end of that if it fails.
logged() {
  local log=$1
  shift
  "$@" >"$log" 2>&1 </dev/null || {
    tail -15 "$log" >&2
    fail "'$(basename "$1")' failed; all it said is in $log"
  }
}

duration=2 scale=0.5 rate=0.5 drive="" calibration="" network=""
build_dir=$source_dir/build output="" install=1 build=1
jobs=$(nproc)
[ "$jobs" -le 8 ] || jobs=8
while [ $# -gt 0 ]; do
  case $1 in
    --duration | --scale | --rate | --drive | --calibration | --model | --output | --build-dir | --jobs)
      [ $# -ge 2 ] && [ -n "$2" ] || code=2 fail "$1 needs a value"
      case $1 in
        --duration) duration=$2 ;;
        --scale) scale=$2 ;;
        --rate) rate=$2 ;;
        --drive) drive=$2 ;;
        --calibration) calibration=$2 ;;
        --model) network=$2 ;;
        --output) output=$2 ;;
        --build-dir) build_dir=$2 ;;
        --jobs) jobs=$2 ;;
      esac
      shift
      ;;
    --no-install) install=0 ;;
    --no-build) build=0 ;;
    --help | -h) usage; exit 0 ;;
    *) code=2 fail "unknown option '$1'; try --help" ;;
  esac
  shift
done
[[ $jobs =~ ^[1-9][0-9]*$ ]] || code=2 fail "--jobs is '$jobs'; it must be a positive number"
for name in duration scale rate; do
  [[ ${!name} =~ ^[0-9]*\.?[0-9]+$ ]] || code=2 fail "--$name is '${!name}'; it must be a number"
done
[ -z "$drive" ] || [ -z "$calibration" ] || code=2 fail "--drive and --calibration exclude each other"
recorded=$drive$calibration
[ -n "$recorded" ] || [ -z "$network" ] || code=2 fail "--model is for --drive and --calibration"
[ -z "$drive" ] || [ -n "$network" ] || code=2 fail "--drive needs --model FILE.onnx"
[ -z "$recorded" ] || [ -d "$recorded" ] || fail "no folder at $recorded"
[ -z "$recorded" ] || recorded=$(cd "$recorded" && pwd)
if [ -n "$network" ]; then
  [ -f "$network" ] || fail "no network at $network"
  # The description of the network (input size, means, classes) that names this file.
  description=$(grep -lxF "file: $(basename "$network")" "$source_dir"/config/models/*.yaml | head -1) ||
    fail "no description in config/models/ has the line 'file: $(basename "$network")'"
  network=$(cd "$(dirname "$network")" && pwd)/$(basename "$network")
fi

mkdir -p "$build_dir"
build_dir=$(cd "$build_dir" && pwd)
mkdir -p "${output:=$build_dir/demo}"
output=$(cd "$output" && pwd)

if [ "$install" = 1 ]; then
  step "dependencies"
  bash "$source_dir/scripts/install_dependencies.sh" --no-testing || fail "the dependencies are not installed"
fi

# Nothing of another workspace may serve here in place of what is built.
unset CMAKE_PREFIX_PATH ROS_PACKAGE_PATH PYTHONPATH LD_LIBRARY_PATH ROS_MASTER_URI ROS_NAMESPACE
if [ -f /opt/ros/noetic/setup.bash ]; then
  set +u
  source /opt/ros/noetic/setup.bash
  set -u
fi
export LC_ALL=C.UTF-8 ROS_IP=127.0.0.1 ROS_HOME=$output/ros ROSCONSOLE_STDOUT_LINE_BUFFERED=1
mkdir -p "$ROS_HOME/${package}"

if [ "$build" = 1 ]; then
  step "build (log: $output/build.log)"
  (
    cd "$build_dir"
    cmake "$source_dir" -DCMAKE_BUILD_TYPE=Release -DPYTHON_EXECUTABLE=/usr/bin/python3 \
      -DPython3_EXECUTABLE=/usr/bin/python3 -DCMAKE_INSTALL_PREFIX="$build_dir/install"
    cmake --build . -- -j"$jobs"
    cmake --install .
  ) >"$output/build.log" 2>&1 || fail "the build failed: $(tail -5 "$output/build.log")"
fi
[ -f "$build_dir/install/setup.bash" ] || fail "nothing is built in $build_dir; leave --no-build away"
set +u
source "$build_dir/install/setup.bash"
set -u
rm -rf "$output"/{tables,figures} "$output"/{drive,live,fused}.bag

if [ -n "$recorded" ]; then
  step "import $recorded"
  rig=$output/rig.yaml
  scores=()
  if [ -n "$network" ]; then
    sed "s|^file: .*|file: $network|" "$description" >"$output/model.yaml"
    scores=(--model "$output/model.yaml")
  else
    scores=(--scores onehot --score-stride 4)  # the board's own labels
  fi
  dataset=kitti
  [ -z "$calibration" ] || dataset=acfr_calibration
  logged "$output/import.log" rosrun $package import_dataset.py $dataset "$recorded" "$output/drive.bag" \
    --rig-out "$rig" "${scores[@]}"
  if [ -n "$calibration" ] && [ -z "$network" ]; then
    step "offline in three configurations, and the tables"
    logged "$output/evaluate.log" rosrun $package evaluate.py "$output/drive.bag" --rig "$rig" --out "$output/tables"
  fi
else
  rig=$source_dir/config/demo.yaml
  simulator=$build_dir/install/lib/$package/simulate_drive
  [ -x "$simulator" ] || fail "the simulator is not built: install libembree-dev and try again"
  step "simulate a drive of $duration s, images at $scale of 1920 x 1208"
  logged "$output/simulate.log" "$simulator" --out "$output/drive.bag" --duration "$duration" --scale "$scale" \
    --threads "$jobs" --force
  step "replay through the nodelets at $rate of real time (log: $output/replay.log)"
  logged "$output/replay.log" roslaunch $package replay.launch bag:="$output/drive.bag" rig:="$rig" \
    rate:="$rate" record:="$output/live.bag" exit:=true
  step "offline in three configurations, and the tables"
  logged "$output/evaluate.log" rosrun $package evaluate.py "$output/drive.bag" --rig "$rig" \
    --out "$output/tables" --live "$output/live.bag"
fi

step "fuse offline with everything in between"
logged "$output/fuse.log" rosrun $package fuse_bag "$output/drive.bag" "$output/fused.bag" --rig "$rig" --all

step "draw the paper's figures"
logged "$output/figures.log" rosrun $package make_figures.py "$output/fused.bag" --source "$output/drive.bag" \
  --rig "$rig" --out "$output/figures"

step "done"
if [ -f "$output/tables/report.md" ]; then
  sed '1d' "$output/tables/report.md"
  echo
fi
cat <<EOT
drive            $output/drive.bag
semantic clouds  $output/fused.bag (topic /points_semantic)
pictures         $(cd "$output" && find tables figures -name '*.png' 2>/dev/null | sort | sed "s|^|$output/|" | paste -sd ' ' - | sed 's| |\n                 |g')
EOT
