# SPDX-License-Identifier: MIT
# check_install_space SPACE: uses the install space SPACE from outside, with a clean environment that
# knows the system and SPACE alone; ends the script with a sentence if anything is amiss.
# Needs SLF_SOURCE_DIR, SLF_BUILD_DIR, SLF_BIN_DIR.
package=semantic_lidar_fusion

fail() {
  echo "$(basename "$0" .sh): $*"
  exit 1
}

run_installed() {
  mkdir -p "$SLF_BUILD_DIR/ros_home/install_check"
  # The setup file reads the positional parameters: it gets none.
  (cd / && env -i PATH=/usr/bin:/bin HOME="$SLF_BUILD_DIR" LC_ALL=C.UTF-8 PYTHONDONTWRITEBYTECODE=1 \
    ROS_HOME="$SLF_BUILD_DIR/ros_home/install_check" \
    bash -c 'command=("$@"); set --; source "$0/setup.bash" && exec "${command[@]}"' "$space" "$@")
}

check_install_space() {
  space=$1
  local lib=$space/lib share=$space/share/$package
  local count=0 top file linked found plugins description library name help source launch args
  [ -f "$share/package.xml" ] || fail "no package.xml"
  [ -f "$share/cmake/${package}Config.cmake" ] || fail "no CMake configuration for other packages"
  [ -d "$space/include/$package" ] || fail "no headers"
  for top in launch config; do
    [ ! -d "$SLF_SOURCE_DIR/$top" ] || diff -r "$SLF_SOURCE_DIR/$top" "$share/$top" ||
      fail "$top/ is not installed as it is"
  done

  # Every library is found, and nothing that is installed points back to the build.
  shopt -s nullglob
  for file in "$lib"/lib$package*.so "$lib/$package"/*; do
    [ "$(head -c 4 "$file" | tr -d '\0')" = $'\x7fELF' ] || continue
    linked=$(env -u LD_LIBRARY_PATH ldd "$file")
    ! grep -q 'not found' <<<"$linked" || fail "$file: $(grep 'not found' <<<"$linked")"
    ! grep -qF "$SLF_BUILD_DIR/devel" <<<"$linked" || fail "$file uses the build folder"
  done

  found=$(run_installed rospack find $package) || fail "rospack does not find the package: $found"
  [ "$found" = "$share" ] || fail "rospack finds $found"
  if [ -f "$SLF_SOURCE_DIR/nodelets/nodelet_plugins.xml" ]; then
    plugins=$(run_installed rospack plugins --attrib=plugin nodelet)
    description=$(sed -n "s/^$package //p" <<<"$plugins")
    [ "$description" = "$share/nodelets/nodelet_plugins.xml" ] && [ -f "$description" ] ||
      fail "the plugin description is not exported: '$description'"
    while read -r library; do
      # A name without a folder: where libraries lie differs between catkin and Debian.
      [ -f "$lib/$library.so" ] || fail "the plugin description names $library, which is absent"
    done < <(sed -n 's/.*<library path="\([^"]*\)".*/\1/p' "$description")
  fi
  if [ -f "$SLF_SOURCE_DIR/scripts/$package/__init__.py" ]; then
    file=$(run_installed python3 -c "import $package; print($package.__file__)") ||
      fail "import failed"
    case $file in "$space"/*) ;; *) fail "Python imports $file" ;; esac
  fi
  for source in "$SLF_SOURCE_DIR"/scripts/*.py "$SLF_BIN_DIR"/fuse_bag \
    "$SLF_BIN_DIR"/simulate_drive; do
    [ -e "$source" ] || continue
    name=$(basename "$source")
    help=$(run_installed rosrun $package "$name" --help 2>&1) ||
      fail "rosrun $package $name --help: $help"
    [ -n "$help" ] || fail "$name --help prints nothing"
    count=$((count + 1))
  done
  for launch in "$share"/launch/*.launch; do
    args=$(run_installed roslaunch --ros-args $package "$(basename "$launch")" 2>&1) ||
      fail "roslaunch --ros-args $(basename "$launch"): $args"
  done
  echo "$(basename "$0" .sh): $count commands answered from the install space"
}
