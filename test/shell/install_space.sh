# SPDX-License-Identifier: MIT
# Installs the build and uses it from outside: everything that is installed must be found, load
# and run without the source and the build folder.
set -euo pipefail
package=semantic_lidar_fusion
install_dir=$SLF_BUILD_DIR/install_check
fail() {
  echo "install_space: $*"
  exit 1
}

# The Python step of catkin knows only the prefix of the configuration, so DESTDIR leads it away.
rm -rf "$install_dir"
prefix=$(sed -n 's/^CMAKE_INSTALL_PREFIX:PATH=//p' "$SLF_BUILD_DIR/CMakeCache.txt")
DESTDIR=$install_dir cmake --install "$SLF_BUILD_DIR" >"$SLF_BUILD_DIR/install_check.log" 2>&1 ||
  fail "cmake --install failed: $(tail -5 "$SLF_BUILD_DIR/install_check.log")"
space=$install_dir$prefix
lib=$space/lib
share=$space/share/$package

[ -f "$share/package.xml" ] || fail "no package.xml"
[ -f "$share/cmake/${package}Config.cmake" ] || fail "no CMake configuration for other packages"
for folder in include/$package; do
  [ -d "$space/$folder" ] || fail "no $folder"
done
for top in launch config; do
  [ ! -d "$SLF_SOURCE_DIR/$top" ] || diff -r "$SLF_SOURCE_DIR/$top" "$share/$top" ||
    fail "$top/ is not installed as it is"
done

# Nothing installed points back to the build, and every library is found. Instrumented builds
# resolve the sanitizer's library only when started.
shopt -s nullglob
for file in "$lib"/lib$package*.so "$lib/$package"/*; do
  [ "$(head -c 4 "$file" | tr -d '\0')" = $'\x7fELF' ] || continue
  linked=$(env -u LD_LIBRARY_PATH ldd "$file")
  ! grep -q 'not found' <<<"$linked" || fail "$file: $(grep 'not found' <<<"$linked")"
  ! grep -qF "$SLF_BUILD_DIR/devel" <<<"$linked" || fail "$file uses the build folder"
done

# A clean environment that knows the system and this install space alone.
run() {
  (cd / && env -i PATH="$lib/$package:/usr/bin:/bin" HOME="$SLF_BUILD_DIR" LC_ALL=C.UTF-8 \
    PYTHONDONTWRITEBYTECODE=1 \
    ROS_HOME="$SLF_BUILD_DIR/ros_home/install_check" ROS_PACKAGE_PATH="$space/share:/usr/share" \
    CMAKE_PREFIX_PATH="$space" LD_LIBRARY_PATH="$lib" PYTHONPATH="$python_path" \
    ${ROS_SETUP:+bash -c "source $ROS_SETUP --extend && exec \"\$@\"" --} "$@")
}
python_path=$(find "$space" -type d -path "*/$package" -path '*-packages/*' -printf '%h\n' | head -1)
ROS_SETUP=""
[ ! -f /opt/ros/noetic/setup.bash ] || ROS_SETUP=/opt/ros/noetic/setup.bash

found=$(run rospack find $package) || fail "rospack does not find the package: $found"
[ "$found" = "$share" ] || fail "rospack finds $found"
if [ -f "$SLF_SOURCE_DIR/nodelets/nodelet_plugins.xml" ]; then
  plugins=$(run rospack plugins --attrib=plugin nodelet)
  description=$(sed -n "s/^$package //p" <<<"$plugins")
  [ "$description" = "$share/nodelets/nodelet_plugins.xml" ] && [ -f "$description" ] ||
    fail "the plugin description is not exported: '$description'"
  while read -r library; do
    [ -f "$space/$library.so" ] || fail "the plugin description names $library, which is absent"
  done < <(sed -n 's/.*<library path="\([^"]*\)".*/\1/p' "$description")
fi
if [ -f "$SLF_SOURCE_DIR/scripts/$package/__init__.py" ]; then
  file=$(run python3 -c "import $package; print($package.__file__)") || fail "import failed"
  case $file in "$space"/*) ;; *) fail "Python imports $file" ;; esac
fi
count=0
for source in "$SLF_SOURCE_DIR"/scripts/*.py "$SLF_BIN_DIR"/fuse_bag "$SLF_BIN_DIR"/simulate_drive; do
  [ -e "$source" ] || continue
  name=$(basename "$source")
  help=$(run rosrun $package "$name" --help 2>&1) || fail "rosrun $package $name --help: $help"
  [ -n "$help" ] || fail "$name --help prints nothing"
  count=$((count + 1))
done
for launch in "$share"/launch/*.launch; do
  args=$(run roslaunch --ros-args $package "$(basename "$launch")" 2>&1) ||
    fail "roslaunch --ros-args $(basename "$launch"): $args"
done
rm -rf "$install_dir"
echo "install_space: $count commands answered from the install space"
