# SPDX-License-Identifier: MIT
# Every benchmark runs: one iteration of each row, whose times mean nothing.
set -euo pipefail

shopt -s nullglob
sources=("$SLF_SOURCE_DIR"/test/benchmark/benchmark_*.cpp)
[ ${#sources[@]} -gt 0 ] || { echo "no benchmark_*.cpp"; exit 1; }
grep -q '^benchmark_DIR:PATH=/' "$SLF_BUILD_DIR/CMakeCache.txt" || {
  echo "Google Benchmark 1.5.3 or later is not installed, or SLF_BUILD_BENCHMARKS is OFF"
  exit 77
}
for source in "${sources[@]}"; do
  name=$(basename "$source" .cpp)
  json=$SLF_BUILD_DIR/benchmark/smoke_$name.json
  mkdir -p "$(dirname "$json")"
  rm -f "$json"
  "$SLF_BIN_DIR/$name" --benchmark_min_time=1e-9 --benchmark_out="$json" \
    --benchmark_out_format=json >/dev/null
  /usr/bin/python3 - "$json" <<'PYTHON'
import json, sys
rows = json.load(open(sys.argv[1]))["benchmarks"]
bad = [row["name"] for row in rows if row.get("error_occurred") or row["iterations"] < 1]
assert rows, "no row"
assert not bad, "these rows failed: %s" % bad
PYTHON
  echo "$name: ran"
done
