# SPDX-License-Identifier: MIT
# Installs the build and uses it without the source and the build folder.
set -euo pipefail
source "$SLF_SOURCE_DIR/test/shell/lib/install_space.sh"

# The Python step and the setup files of catkin know only the prefix of the configuration.
prefix=$(sed -n 's/^CMAKE_INSTALL_PREFIX:PATH=//p' "$SLF_BUILD_DIR/CMakeCache.txt")
case $prefix in
  "$SLF_BUILD_DIR"/*) ;;
  *)
    echo "not configured to install below the build folder, as scripts/test.sh does"
    exit 77
    ;;
esac
rm -rf "$prefix"
log=$SLF_BUILD_DIR/install_space.log
cmake --install "$SLF_BUILD_DIR" >"$log" 2>&1 || fail "cmake --install failed: $(tail -5 "$log")"
check_install_space "$prefix"
