#!/bin/bash
# SPDX-License-Identifier: MIT
# Installs what is missing, builds everything and runs every test. The last line is
# `N passed, N failed`; the exit code is 0 only if nothing failed.
#
#   scripts/test.sh [options]
#     --build-dir DIR    where to build (default: build/ of the package; build-KIND with --sanitize)
#     --filter REGEX     only the tests whose ctest name matches
#     --sanitize KIND    instrument this package's code: address, thread or undefined
#     --workspace        also build and install in a catkin workspace (compiles everything again)
#     --jobs N           parallel compilations and tests (default: processors, at most 8)
#     --install-only     stop after installing the dependencies
#     --no-install       do not look for missing dependencies
#     --help             this text
set -euo pipefail
PATH=/usr/sbin:/usr/bin:/sbin:/bin
source_dir=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)

usage() { sed -n '3,15s/^# \{0,1\}//p' "${BASH_SOURCE[0]}"; }
fail() {
  echo "test.sh: $*" >&2
  exit 2
}
# A failure before any test ran ends with the same last line.
broken() {
  echo "test.sh: $*" >&2
  echo "0 passed, 1 failed"
  exit 1
}
needs_value() { [ $# -ge 2 ] && [ -n "$2" ] || fail "$1 needs a value"; }

build_dir="" filter="" sanitize="" install=1 install_only=0 workspace=0
jobs=$(nproc)
[ "$jobs" -le 8 ] || jobs=8
while [ $# -gt 0 ]; do
  case $1 in
    --build-dir) needs_value "$@"; build_dir=$2; shift ;;
    --filter) needs_value "$@"; filter=$2; shift ;;
    --sanitize) needs_value "$@"; sanitize=$2; shift ;;
    --jobs) needs_value "$@"; jobs=$2; shift ;;
    --workspace) workspace=1 ;;
    --install-only) install_only=1 ;;
    --no-install) install=0 ;;
    --help | -h) usage; exit 0 ;;
    *) fail "unknown option '$1'; try --help" ;;
  esac
  shift
done
case $sanitize in
  "" | address | thread | undefined) ;;
  *) fail "--sanitize is '$sanitize'; it must be address, thread or undefined" ;;
esac
[[ $jobs =~ ^[1-9][0-9]*$ ]] || fail "--jobs is '$jobs'; it must be a positive number"
[ -n "$build_dir" ] || build_dir=$source_dir/build${sanitize:+-$sanitize}
mkdir -p "$build_dir"
build_dir=$(cd "$build_dir" && pwd)

if [ "$install" = 1 ]; then
  bash "$source_dir/scripts/install_dependencies.sh" || broken "the dependencies are not installed"
fi
[ "$install_only" = 0 ] || exit 0

# Nothing of another workspace may serve here in place of what is built.
unset CMAKE_PREFIX_PATH ROS_PACKAGE_PATH PYTHONPATH LD_LIBRARY_PATH ROS_MASTER_URI ROS_NAMESPACE
if [ -f /opt/ros/noetic/setup.bash ]; then
  set +u
  source /opt/ros/noetic/setup.bash
  set -u
fi
export LC_ALL=C.UTF-8 ROS_IP=127.0.0.1

# A stock nodelet executable needs the sanitizer's library before everything else; the test files
# take it as launch-prefix="$(optenv SLF_LAUNCH_PREFIX)".
unset SLF_LAUNCH_PREFIX
case $sanitize in
  address)
    export ASAN_OPTIONS=detect_stack_use_after_return=1:strict_string_checks=1:exitcode=66
    export SLF_LAUNCH_PREFIX="env LD_PRELOAD=$(g++ -print-file-name=libasan.so)"
    ;;
  thread)
    export TSAN_OPTIONS=ignore_noninstrumented_modules=1:exitcode=66
    TSAN_OPTIONS+=:suppressions=$source_dir/test/gate/tsan.supp
    export SLF_LAUNCH_PREFIX="env LD_PRELOAD=$(g++ -print-file-name=libtsan.so)"
    ;;
  undefined)
    export UBSAN_OPTIONS=print_stacktrace=1:halt_on_error=1
    ;;
esac
# Instrumented code is slower: so is what it is fed.
if [ -n "$sanitize" ]; then
  export SLF_SOAK_RATE=${SLF_SOAK_RATE:-0.05} SLF_SOAK_MINUTES=${SLF_SOAK_MINUTES:-1.6}
  export SLF_REPLAY_RATE=${SLF_REPLAY_RATE:-0.05}
fi

# Both names of the interpreter: ament, which newer pluginlib pulls in, reads only the second.
cd "$build_dir"
cmake "$source_dir" -DCMAKE_BUILD_TYPE=Release -DSLF_WERROR=ON -DSLF_SANITIZE="$sanitize" \
  -DPYTHON_EXECUTABLE=/usr/bin/python3 -DPython3_EXECUTABLE=/usr/bin/python3 \
  -DCMAKE_INSTALL_PREFIX="$build_dir/install" -DCATKIN_ENABLE_TESTING=ON || broken "the configuration failed"
cmake --build . -- -j"$jobs" || broken "the build failed"
cmake --build . --target tests -- -j"$jobs" || broken "the build of the tests failed"

export SLF_TEST_WORKSPACE=$workspace SLF_JOBS=$jobs
rm -rf test_results ros_home Testing
# rospack complains on stderr if the parent of its cache is absent.
cut -f1 expected_tests.txt | while read -r name; do mkdir -p "ros_home/$name"; done
# One more than there are processors: half of the tests wait for nodes.
ctest --output-on-failure -j$((jobs + 1)) ${filter:+-R "$filter"} </dev/null || true
exec /usr/bin/python3 "$source_dir/test/gate/gate.py" "$build_dir" ${filter:+--filter "$filter"}
