#!/bin/bash
# SPDX-License-Identifier: MIT
# Installs what is missing, builds, fuses a drive offline and prints where the pictures are.
#
#   scripts/demo.sh [options]
#     --drive DIR        a KITTI raw drive (DATE/DATE_drive_NNNN_sync beside its calibration files)
#     --model FILE       an ONNX network for which config/models/ has a description of that name
#     --output DIR       where bags and pictures go (default: demo/ of the build folder)
#     --build-dir DIR    where to build (default: build/ of the package)
#     --jobs N           parallel compilations (default: processors, at most 8)
#     --no-install       do not look for missing dependencies
#     --help             this text
#
# Without --drive and --model it takes the drive and the network of the optional data (environment
# variable SLF_SHARED_DIR, else a folder `shared` beside the package's).
set -euo pipefail
PATH=/usr/sbin:/usr/bin:/sbin:/bin
source_dir=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
package=semantic_lidar_fusion

usage() { sed -n '3,15s/^# \{0,1\}//p' "${BASH_SOURCE[0]}"; }
fail() {
  echo "demo.sh: $*" >&2
  exit "${code:-1}"
}
step() { echo "== $*"; }

shared_dir=${SLF_SHARED_DIR:-$source_dir/../shared}
drive=$shared_dir/data/kitti_drive
network=$shared_dir/models/espnetv2_city20_1024x512.onnx
build_dir=$source_dir/build output="" install=1
jobs=$(nproc)
[ "$jobs" -le 8 ] || jobs=8
while [ $# -gt 0 ]; do
  case $1 in
    --drive | --model | --output | --build-dir | --jobs)
      [ $# -ge 2 ] && [ -n "$2" ] || code=2 fail "$1 needs a value"
      case $1 in
        --drive) drive=$2 ;;
        --model) network=$2 ;;
        --output) output=$2 ;;
        --build-dir) build_dir=$2 ;;
        --jobs) jobs=$2 ;;
      esac
      shift
      ;;
    --no-install) install=0 ;;
    --help | -h) usage; exit 0 ;;
    *) code=2 fail "unknown option '$1'; try --help" ;;
  esac
  shift
done
[[ $jobs =~ ^[1-9][0-9]*$ ]] || code=2 fail "--jobs is '$jobs'; it must be a positive number"
[ -d "$drive" ] || fail "no KITTI raw drive at $drive; give one with --drive DIR"
[ -f "$network" ] || fail "no network at $network; give one with --model FILE.onnx"

# The description of the network (input size, means, classes) that names this file.
description=$(grep -lxF "file: $(basename "$network")" "$source_dir"/config/models/*.yaml | head -1) ||
  fail "no description in config/models/ has the line 'file: $(basename "$network")'"

mkdir -p "$build_dir"
build_dir=$(cd "$build_dir" && pwd)
drive=$(cd "$drive" && pwd)
network=$(cd "$(dirname "$network")" && pwd)/$(basename "$network")
mkdir -p "${output:=$build_dir/demo}/pictures"
output=$(cd "$output" && pwd)

if [ "$install" = 1 ]; then
  step "dependencies"
  bash "$source_dir/scripts/install_dependencies.sh" --no-testing || fail "the dependencies are not installed"
fi

step "build (log: $output/build.log)"
unset CMAKE_PREFIX_PATH ROS_PACKAGE_PATH PYTHONPATH LD_LIBRARY_PATH
if [ -f /opt/ros/noetic/setup.bash ]; then
  set +u
  source /opt/ros/noetic/setup.bash
  set -u
fi
export LC_ALL=C.UTF-8 ROS_IP=127.0.0.1
(
  cd "$build_dir"
  cmake "$source_dir" -DCMAKE_BUILD_TYPE=Release -DPYTHON_EXECUTABLE=/usr/bin/python3 \
    -DPython3_EXECUTABLE=/usr/bin/python3 -DCMAKE_INSTALL_PREFIX="$build_dir/install"
  cmake --build . -- -j"$jobs"
  cmake --install .
) >"$output/build.log" 2>&1 || fail "the build failed: $(tail -5 "$output/build.log")"
set +u
source "$build_dir/install/setup.bash"
set -u

step "import $drive"
sed "s|^file: .*|file: $network|" "$description" >"$output/model.yaml"
rm -f "$output"/{drive,fused}.bag
rosrun $package import_dataset.py kitti "$drive" "$output/drive.bag" \
  --rig-out "$output/rig.yaml" --model "$output/model.yaml" </dev/null ||
  fail "the drive was not imported"

step "fuse"
rosrun $package fuse_bag "$output/drive.bag" "$output/fused.bag" --rig "$output/rig.yaml" --all \
  </dev/null || fail "the bag was not fused"

step "pictures"
/usr/bin/python3 - "$output/fused.bag" "$output/pictures" <<'PYTHON'
import os
import sys

import cv2
import numpy as np
import rosbag

count = {}
with rosbag.Bag(sys.argv[1]) as bag:
    for topic, message, _ in bag.read_messages():
        if not topic.endswith("_overlay"):
            continue
        channels = {"bgr8": 3, "rgb8": 3, "mono8": 1}[message.encoding]
        rows = np.frombuffer(message.data, np.uint8).reshape(message.height, message.step)
        image = rows[:, : message.width * channels].reshape(message.height, message.width, channels)
        if message.encoding == "rgb8":
            image = image[:, :, ::-1]
        number = count[topic] = count.get(topic, -1) + 1
        name = "%s_%04d.png" % (topic.strip("/").replace("/", "_"), number)
        if not cv2.imwrite(os.path.join(sys.argv[2], name), image):
            sys.exit("cannot write %s" % os.path.join(sys.argv[2], name))
if not count:
    sys.exit("no overlay in %s" % sys.argv[1])
for topic in sorted(count):
    print("%4d of %s" % (count[topic] + 1, topic))
PYTHON

cat <<EOT
== done
semantic clouds  $output/fused.bag (topic /points_semantic)
pictures         $output/pictures/*.png
rig file         $output/rig.yaml
EOT
