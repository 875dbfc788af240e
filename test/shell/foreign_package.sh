# SPDX-License-Identifier: MIT
# Builds a small package of somebody else's against the install space, and runs it.
set -euo pipefail
prefix=$(sed -n 's/^CMAKE_INSTALL_PREFIX:PATH=//p' "$SLF_BUILD_DIR/CMakeCache.txt")
case $prefix in
  "$SLF_BUILD_DIR"/*) ;;
  *)
    echo "not configured to install below the build folder, as scripts/test.sh does"
    exit 77
    ;;
esac
fail() {
  echo "foreign_package: $*"
  exit 1
}
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
# A space of its own: another test installs and uses the configured one meanwhile.
space=$folder/space
DESTDIR=$folder/staged cmake --install "$SLF_BUILD_DIR" >"$folder/install.log" 2>&1 ||
  fail "cmake --install failed: $(tail -5 "$folder/install.log")"
mv "$folder/staged$prefix" "$space"
cp -r "$SLF_SOURCE_DIR/test/support/foreign_package" "$folder/source"
compiler=$(sed -n 's/^CMAKE_CXX_COMPILER:[A-Z]*=//p' "$SLF_BUILD_DIR/CMakeCache.txt")
flags=$(sed -n 's/^SLF_SANITIZE:[A-Z]*=//p' "$SLF_BUILD_DIR/CMakeCache.txt")
if [ -n "$flags" ]; then
  echo "a foreign program does not load an instrumented library"
  exit 77
fi
# The environment knows the system alone: what the package needs comes from its configuration.
env -i PATH=/usr/bin:/bin HOME="$folder" cmake -S "$folder/source" -B "$folder/build" \
  -DCMAKE_PREFIX_PATH="$space" -DCMAKE_CXX_COMPILER="$compiler" >"$folder/log" 2>&1 ||
  fail "does not configure: $(tail -12 "$folder/log")"
env -i PATH=/usr/bin:/bin HOME="$folder" cmake --build "$folder/build" >"$folder/log" 2>&1 ||
  fail "does not build: $(tail -12 "$folder/log")"
said=$("$folder/build/foreign") || fail "does not run: $said"
[ "$said" = "2 points, t_ref 1.05 s" ] || fail "says '$said'"
echo "foreign_package: a package that finds semantic_lidar_fusion builds and runs"
