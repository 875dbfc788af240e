#!/bin/bash
# SPDX-License-Identifier: MIT
# Installs the Debian or Ubuntu packages that building, testing and the demonstration need.
# Uses sudo when not root, and only when something is missing; does nothing twice.
#
#   scripts/install_dependencies.sh [options]
#     --no-testing       leave out what only tests and benchmarks use
#     --rviz             also RViz and rqt_reconfigure, as far as the release has them
#     --help             this text
set -euo pipefail
PATH=/usr/sbin:/usr/bin:/sbin:/bin

source_dir=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
formatters=$source_dir/test/lint/formatters.txt

testing=1 rviz=0
for option in "$@"; do
  case $option in
    --no-testing) testing=0 ;;
    --rviz) rviz=1 ;;
    --help | -h) sed -n '3,9s/^# \{0,1\}//p' "$0"; exit 0 ;;
    *) echo "install_dependencies: unknown option '$option'; try --help" >&2; exit 2 ;;
  esac
done

# name on Debian (ROS in the distribution itself)
debian_ros="catkin libroscpp-dev libnodelet-dev libnodeletlib-dev libnodeletlib-tools pluginlib-dev
  libcv-bridge-dev libtf2-dev libtf2-ros-dev libtf2-eigen-dev libtf2-msgs-dev
  libdiagnostic-updater-dev libdynamic-reconfigure-config-init-mutex-dev libstd-srvs-dev
  python3-dynamic-reconfigure libsensor-msgs-dev libnav-msgs-dev
  libstd-msgs-dev libgeometry-msgs-dev libdiagnostic-msgs-dev
  librosbag-storage-dev librostest-dev python3-catkin-pkg python3-roslaunch python3-rosbag
  python3-rospy python3-cv-bridge python3-tf2-ros python3-tf2-msgs python3-sensor-msgs
  python3-nav-msgs python3-std-msgs python3-std-srvs python3-geometry-msgs python3-diagnostic-msgs
  python3-rostopic python3-rosnode python3-rosparam python3-rostest python3-rosunit rosbash
  rospack-tools tf2-tools"
# name on Ubuntu 20.04 with the ROS Noetic repository
noetic_ros="ros-noetic-catkin ros-noetic-roscpp ros-noetic-nodelet ros-noetic-pluginlib
  ros-noetic-cv-bridge ros-noetic-tf2 ros-noetic-tf2-ros ros-noetic-tf2-eigen ros-noetic-tf2-msgs
  ros-noetic-diagnostic-updater ros-noetic-dynamic-reconfigure ros-noetic-sensor-msgs
  ros-noetic-nav-msgs ros-noetic-std-msgs ros-noetic-std-srvs ros-noetic-geometry-msgs
  ros-noetic-diagnostic-msgs
  ros-noetic-rosbag ros-noetic-rosbag-storage ros-noetic-roslaunch
  ros-noetic-rospy ros-noetic-rostopic ros-noetic-rosnode ros-noetic-rosparam ros-noetic-rostest
  ros-noetic-rosunit ros-noetic-rosbash ros-noetic-tf2-tools"
common="build-essential cmake libeigen3-dev libopencv-dev libyaml-cpp-dev libgtest-dev
  python3-matplotlib python3-numpy python3-opencv python3-pytest python3-scipy python3-setuptools
  python3-tqdm python3-yaml"
# Each of these only adds something: fast JPEG, the simulator, the map's bindings, export and
# clusters, ...
optional="libturbojpeg0-dev libembree-dev liboctomap-dev pybind11-dev python3-dev python3-dask
  python3-distributed"
if [ -d /opt/ros/noetic ]; then
  optional="$optional ros-noetic-map-msgs"
else
  optional="$optional python3-map-msgs"
fi
# ... oracles and peers in tests and benchmarks, the format checks, the fuzzers.
if [ "$testing" = 1 ]; then
  optional="$optional libopencv-contrib-dev libbenchmark-dev pcl-tools octomap-tools clang
    mypy python3-venv catkin-lint"
  if [ -d /opt/ros/noetic ]; then
    optional="$optional ros-noetic-pcl-ros"
  else
    optional="$optional libpcl-ros-dev"
  fi
fi

if [ "$rviz" = 1 ]; then
  if [ -d /opt/ros/noetic ]; then
    optional="$optional ros-noetic-rviz ros-noetic-rqt-reconfigure"
  else
    optional="$optional rviz"
  fi
fi

# Of what follows the release's own versions, known only when the package lists are there: the
# sanitizers' and fuzzers' runtime of its clang, and a formatter where it is the version in which
# this package's files are kept.
candidate() { apt-cache policy "$1" 2>/dev/null | sed -n 's/^ *Candidate: \([0-9]*:\)\?//p'; }
versioned() {
  [ "$testing" = 1 ] || return 0
  local clang name version
  clang=$(candidate clang)
  [ -z "$clang" ] || echo "libclang-rt-${clang%%.*}-dev"
  while IFS='=' read -r name _ version; do
    case $(candidate "$name") in "${version%%.*}".*) echo "$name" ;; esac
  done <"$formatters"
}

installed() { [ "$(dpkg-query -W -f='${db:Status-Status}' "$1" 2>/dev/null)" = installed ]; }
offered() { apt-cache show "$1" >/dev/null 2>&1; }
say() { echo "install_dependencies: $*"; }

if ! command -v apt-get >/dev/null; then
  say "no apt-get here; install the dependencies of package.xml by hand" >&2
  exit 1
fi

if [ -d /opt/ros/noetic ]; then
  required="$common $noetic_ros"
else
  required="$common $debian_ros"
fi

missing_of() {
  local package
  for package in "$@"; do
    installed "$package" || echo "$package"
  done
}
# ROS reaches its own nodes by that name; a folder made by debootstrap lacks the file.
if ! getent ahosts localhost >/dev/null; then
  if [ ! -e /etc/hosts ] && [ "$(id -u)" -eq 0 ]; then
    say "writing /etc/hosts, which is absent: localhost must have an address"
    printf '127.0.0.1\tlocalhost\n' >/etc/hosts
  else
    say "localhost has no address: ROS needs the line '127.0.0.1 localhost' in /etc/hosts" >&2
    exit 1
  fi
fi

# Formatters that the release has in other versions come from PyPI, into a folder of their own.
has_formatter() {
  local tool
  for tool in "$source_dir/.tools/bin/$1" "$1"; do
    ! "$tool" --version 2>/dev/null | grep -q "[ v]${2%%.*}\." || return 0
  done
  return 1
}
finish() {
  local name version wanted=""
  while IFS='=' read -r name _ version; do
    has_formatter "$name" "$version" || wanted="$wanted $name==$version"
  done <"$formatters"
  if [ "$testing" = 1 ] && [ -n "$wanted" ] && installed python3-venv; then
    say "installing$wanted into .tools"
    if ! { python3 -m venv "$source_dir/.tools" &&
      "$source_dir/.tools/bin/pip" install --quiet $wanted; } >/dev/null 2>&1; then
      say "going on without$wanted"
    fi
  fi
  # What reads bags of ROS 2, for the test of import_dataset.py; Debian has no package of it.
  if [ "$testing" = 1 ] && [ ! -e "$source_dir/.tools/python/rosbags" ] &&
    installed python3-venv && python3 -c 'import sys; sys.exit(sys.version_info < (3, 10))'; then
    say "installing rosbags into .tools"
    { [ -e "$source_dir/.tools/bin/pip" ] || python3 -m venv "$source_dir/.tools"; } >/dev/null 2>&1
    if ! "$source_dir/.tools/bin/pip" install --quiet --target "$source_dir/.tools/python" rosbags \
      >/dev/null 2>&1; then
      say "going on without rosbags"
    fi
  fi
  say "$1"
  exit 0
}

missing=$(missing_of $required)
extra=$(missing_of $optional $(versioned))
[ -n "$missing$extra" ] || finish "nothing is missing"

as_root() { "$@"; }
if [ "$(id -u)" -ne 0 ]; then
  if command -v sudo >/dev/null; then
    as_root() { sudo "$@"; }
  elif [ -n "$missing" ]; then
    say "not root and no sudo; missing:" $missing >&2
    exit 1
  else
    say "not root and no sudo; going on without" $extra
    exit 0
  fi
fi
apt() {
  as_root env DEBIAN_FRONTEND=noninteractive apt-get -q -o DPkg::Lock::Timeout=300 \
    -o Acquire::Retries=3 "$@" </dev/null >/dev/null
}

# A release without an optional package is not asked for it again while its lists are there.
offered_of() {
  local package
  for package in "$@"; do
    ! offered "$package" || echo "$package"
  done
}
lists() { ls /var/lib/apt/lists/*Packages* 2>/dev/null; }
if [ -z "$missing" ] && [ -n "$(lists)" ] && [ -z "$(offered_of $extra)" ]; then
  finish "nothing is missing that this release has"
fi

say "updating the package lists"
if ! apt update; then
  [ -z "$missing" ] || exit 1
  say "going on without" $extra
  exit 0
fi
if [ -n "$missing" ]; then
  for package in $missing; do
    offered "$package" && continue
    say "this release does not offer $package; on Ubuntu 20.04 set up the ROS Noetic repository" \
      "and install ros-noetic-ros-base first" >&2
    exit 1
  done
  say "installing" $missing
  apt install -y --no-install-recommends $missing
fi
extra=$(offered_of $(missing_of $optional $(versioned)))
if [ -n "$extra" ]; then
  say "installing" $extra
  apt install -y --no-install-recommends $extra || say "going on without" $extra
fi
finish "done"
