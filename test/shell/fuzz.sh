#!/bin/bash
# SPDX-License-Identifier: MIT
# Each parser 10 000 times under libFuzzer with AddressSanitizer and UndefinedBehaviorSanitizer. It
# gives way to the tests beside it, most of which wait for nodes with a time limit.
set -euo pipefail
source_dir=$(cd "$(dirname "${BASH_SOURCE[0]}")/../.." && pwd)
exec nice -n 10 "$source_dir/test/fuzz/run.sh" "${SLF_FUZZ_RUNS:-10000}" "$SLF_BUILD_DIR/fuzzer"
