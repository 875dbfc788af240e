# SPDX-License-Identifier: MIT
# Installs the Python package with pip into an environment without ROS, and runs the notebook there.
# It compiles the core a second time and fetches packages, so it runs only when asked for.
set -euo pipefail
if [ "${SLF_TEST_WORKSPACE:-}" != 1 ]; then
  echo "it compiles the core again; scripts/test.sh --workspace runs it"
  exit 77
fi
fail() {
  echo "pip_install: $*"
  exit 1
}
if ! /usr/bin/python3 -c "import ensurepip" 2>/dev/null; then
  echo "python3-venv is not installed"
  exit 77
fi
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
/usr/bin/python3 -m venv "$folder/venv"
unset CMAKE_PREFIX_PATH ROS_PACKAGE_PATH PYTHONPATH LD_LIBRARY_PATH
CMAKE_BUILD_PARALLEL_LEVEL=${SLF_JOBS:-2} "$folder/venv/bin/pip" install --quiet \
  "$SLF_SOURCE_DIR" >"$folder/log" 2>&1 || fail "pip fails: $(tail -12 "$folder/log")"
cat >"$folder/run.py" <<'END'
import json
import sys

import matplotlib

matplotlib.use("Agg")
import semantic_lidar_fusion
from semantic_lidar_fusion.installation import package_file, version

assert semantic_lidar_fusion.__file__.startswith(sys.prefix), semantic_lidar_fusion.__file__
assert "rospy" not in sys.modules and version() != "unknown"
open(package_file("config/classes_usyd12.yaml")).close()
space = {}
for cell in json.load(open(sys.argv[1]))["cells"]:
    if cell["cell_type"] == "code":
        exec("".join(cell["source"]), space)
assert (space["fused"].status == 0).sum() > 1000
END
(cd "$folder" && env -i PATH=/usr/bin:/bin HOME="$folder" venv/bin/python run.py \
  "$SLF_SOURCE_DIR/docs/fuse_a_scan.ipynb") >"$folder/log" 2>&1 ||
  fail "does not run: $(tail -12 "$folder/log")"
echo "pip_install: the notebook runs in an environment without ROS"
