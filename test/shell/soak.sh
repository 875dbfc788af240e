#!/bin/bash
# SPDX-License-Identifier: MIT
# A short soak: the figures that need no half hour. Slower than life, as a busy machine needs it;
# instrumented code needs SLF_SOAK_RATE and SLF_SOAK_MINUTES of its own.
set -euo pipefail
source_dir=$(cd "$(dirname "${BASH_SOURCE[0]}")/../.." && pwd)
if [ ! -x "$SLF_BIN_DIR/simulate_drive" ]; then
  echo "simulate_drive is not built (Embree is absent)"
  exit 77
fi
exec "$source_dir/scripts/soak.sh" "${SLF_SOAK_MINUTES:-0.8}" --warm-up 0.4 --scale 0.25 --duration 2 \
  --rate "${SLF_SOAK_RATE:-0.25}" --growth-mb 40 --growth-percent 25 --drift-ms 500 --pairs-percent 90 \
  --build-dir "$SLF_BUILD_DIR"
