#!/bin/bash
# SPDX-License-Identifier: MIT
# Each parser 10 000 times under libFuzzer with AddressSanitizer and UndefinedBehaviorSanitizer.
set -euo pipefail
source_dir=$(cd "$(dirname "${BASH_SOURCE[0]}")/../.." && pwd)
exec "$source_dir/test/fuzz/run.sh" "${SLF_FUZZ_RUNS:-10000}" "$SLF_BUILD_DIR/fuzzer"
