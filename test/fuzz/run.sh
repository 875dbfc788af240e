#!/bin/bash
# SPDX-License-Identifier: MIT
# Runs every fuzzer under AddressSanitizer and UndefinedBehaviorSanitizer (clang, libFuzzer).
#
#   test/fuzz/run.sh [EXECUTIONS] [BUILD_DIR] [NAME...]
#
# EXECUTIONS of each (default 1000000), BUILD_DIR (default build-fuzzer of the package; it keeps the
# corpora, so that a later run goes on), only the fuzzers named, inputs of at most SLF_FUZZ_LENGTH
# bytes (default 5000). Exit code 77: no clang with libFuzzer here. A finding is left as
# BUILD_DIR/findings/*, and fails.
set -euo pipefail
PATH=/usr/sbin:/usr/bin:/sbin:/bin
source_dir=$(cd "$(dirname "${BASH_SOURCE[0]}")/../.." && pwd)
executions=${1:-1000000}
build_dir=${2:-$source_dir/build-fuzzer}
shift $(($# < 2 ? $# : 2))
[[ $executions =~ ^[1-9][0-9]*$ ]] || { echo "run.sh: '$executions' is no number of executions" >&2; exit 2; }
jobs=${SLF_JOBS:-$(nproc)}

probe=$(mktemp -d)
trap 'rm -rf "$probe"' EXIT
echo 'extern "C" int LLVMFuzzerTestOneInput(const unsigned char*, unsigned long) { return 0; }' >"$probe/probe.cpp"
if ! clang++ -fsanitize=fuzzer,address,undefined "$probe/probe.cpp" -o "$probe/probe" 2>/dev/null; then
  echo "clang++ with libFuzzer is not installed"
  exit 77
fi

cmake -S "$source_dir" -B "$build_dir" -DCMAKE_CXX_COMPILER=clang++ -DSLF_SANITIZE=fuzzer \
  -DCMAKE_BUILD_TYPE=Release -DCMAKE_CXX_FLAGS_RELEASE=-O1 -DSLF_BUILD_SIMULATOR=OFF \
  -DPYTHON_EXECUTABLE=/usr/bin/python3 -DPython3_EXECUTABLE=/usr/bin/python3 >"$probe/cmake.log" 2>&1 ||
  { cat "$probe/cmake.log"; exit 1; }
targets=(fuzzers)
[ $# -eq 0 ] || targets=("${@/#/fuzz_}")
cmake --build "$build_dir" --target "${targets[@]}" -- -j"$jobs" >"$probe/build.log" 2>&1 ||
  { tail -50 "$probe/build.log"; exit 1; }

# Leaks of the libraries' own singletons are none of ours, and no single input shows one. Stacks of
# allocations would be kept for ever; a finding's input, run by itself, gives them.
export ASAN_OPTIONS=detect_leaks=0:detect_stack_use_after_return=1:malloc_context_size=0
export UBSAN_OPTIONS=print_stacktrace=1:halt_on_error=1
# A caller's libraries of the same names are not instrumented.
export LD_LIBRARY_PATH=$build_dir/devel/lib${LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH}
mkdir -p "$build_dir/findings"
fuzz() {
  local program=$1 name=$2
  local corpus=$build_dir/corpus/$name log=$build_dir/$name.log
  mkdir -p "$corpus"
  SLF_FUZZ_SEEDS=$corpus "$program" >/dev/null
  if ! "$program" -runs="$executions" -seed=1 -max_len="${SLF_FUZZ_LENGTH:-5000}" \
    -timeout=20 -rss_limit_mb=2048 -artifact_prefix="$build_dir/findings/$name-" "$corpus" >"$log" 2>&1; then
    tail -60 "$log"
    echo "fuzz_$name: a finding, see $log"
    return 1
  fi
  echo "fuzz_$name: $(grep -E '^Done ' "$log" | tail -1), no finding"
}
failed=0
for program in "$build_dir"/devel/lib/semantic_lidar_fusion/fuzz_* "$build_dir"/fuzz_*; do
  [ -x "$program" ] && [ -f "$program" ] || continue
  name=$(basename "$program")
  name=${name#fuzz_}
  [ $# -eq 0 ] || [[ " $* " == *" $name "* ]] || continue
  fuzz "$program" "$name" || failed=1
done
exit $failed
