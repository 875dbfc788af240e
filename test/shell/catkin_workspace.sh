# SPDX-License-Identifier: MIT
# Builds the package in a catkin workspace without a warning, installs it and uses the result.
# It compiles everything a second time, so it runs only when asked for.
set -euo pipefail
if [ "${SLF_TEST_WORKSPACE:-}" != 1 ]; then
  echo "it compiles everything again; scripts/test.sh --workspace runs it"
  exit 77
fi
source "$SLF_SOURCE_DIR/test/shell/lib/install_space.sh"

workspace=$SLF_BUILD_DIR/workspace
rm -rf "$workspace"
mkdir -p "$workspace/src"
ln -s "$SLF_SOURCE_DIR" "$workspace/src/$package"
log=$SLF_BUILD_DIR/catkin_workspace.log
# The devel space of the surrounding build must not serve here. A debug build also compiles what a
# release build leaves out, and each file by itself shows what it does not include.
(
  unset CMAKE_PREFIX_PATH ROS_PACKAGE_PATH PYTHONPATH LD_LIBRARY_PATH
  set +u
  [ ! -f /opt/ros/noetic/setup.bash ] || source /opt/ros/noetic/setup.bash
  catkin_make -C "$workspace" -j"${SLF_JOBS:-2}" install -DCMAKE_BUILD_TYPE=Debug \
    -DCMAKE_UNITY_BUILD=OFF -DCATKIN_ENABLE_TESTING=OFF -DPYTHON_EXECUTABLE=/usr/bin/python3 \
    -DPython3_EXECUTABLE=/usr/bin/python3
) >"$log" 2>&1 ||
  fail "catkin_make failed: $(tail -15 "$log")"
warnings=$(grep -E '(^|[^-])\bwarning:|CMake Warning' "$log" || true)
[ -z "$warnings" ] || fail "catkin_make warns: $warnings"
check_install_space "$workspace/install"
rm -rf "$workspace"
