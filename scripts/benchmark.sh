#!/bin/bash
# SPDX-License-Identifier: MIT
# Installs what is missing, builds, runs every benchmark and prints one table of ratios to the peers
# that a user would take instead. Figures go to benchmark/*.json of the build folder.
#
#   scripts/benchmark.sh [options]
#     --only PART        stages (Google Benchmark), superpixels (beside fast-slic), rig (the whole
#                        rig in a nodelet manager) or offline (fuse_bag); default: all four
#     --rig SECONDS      play the rig for so long in each of its three rows (default: 60)
#     --repetitions N    of each stage (default: 9); medians count
#     --markdown         print the table as Markdown, for the README
#     --build-dir DIR    where to build (default: build/ of the package)
#     --jobs N           parallel compilations (default: processors, at most 8)
#     --no-install       do not look for missing dependencies
#     --help             this text
#
# Run it on an idle machine. fast-slic comes from PyPI into a virtual environment in the build folder
# (Python 3.7 to 3.11, a compiler; it is compiled there); without it those rows are left out. Labelled
# photographs come from the optional data (environment variable SLF_SHARED_DIR, else a folder `shared`
# beside the package's); the simulated streets are made once (some minutes).
set -euo pipefail
PATH=/usr/sbin:/usr/bin:/sbin:/bin
source_dir=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)

usage() { sed -n '3,21s/^# \{0,1\}//p' "${BASH_SOURCE[0]}"; }
fail() {
  echo "benchmark.sh: $*" >&2
  exit "${code:-1}"
}
step() { echo "== $*" >&2; }

only="stages superpixels rig offline" seconds=60 repetitions=9 style=text
build_dir=$source_dir/build install=1
jobs=$(nproc)
[ "$jobs" -le 8 ] || jobs=8
while [ $# -gt 0 ]; do
  case $1 in
    --only | --rig | --repetitions | --build-dir | --jobs)
      [ $# -ge 2 ] && [ -n "$2" ] || code=2 fail "$1 needs a value"
      case $1 in
        --only) only=$2 ;;
        --rig) seconds=$2 ;;
        --repetitions) repetitions=$2 ;;
        --build-dir) build_dir=$2 ;;
        --jobs) jobs=$2 ;;
      esac
      shift
      ;;
    --markdown) style=markdown ;;
    --no-install) install=0 ;;
    --help | -h) usage; exit 0 ;;
    *) code=2 fail "unknown option '$1'; try --help" ;;
  esac
  shift
done
for number in "--jobs $jobs" "--repetitions $repetitions" "--rig $seconds"; do
  [[ ${number#* } =~ ^[1-9][0-9]*$ ]] ||
    code=2 fail "${number% *} is '${number#* }'; it must be a positive number"
done
[ "$seconds" -ge 5 ] || code=2 fail "--rig is '$seconds'; it must be at least 5 seconds"
for part in $only; do
  case $part in
    stages | superpixels | rig | offline) ;;
    *) code=2 fail "--only is '$part'; it must be stages, superpixels, rig or offline" ;;
  esac
done
wanted() { [[ " $only " == *" $1 "* ]]; }

mkdir -p "$build_dir/benchmark"
build_dir=$(cd "$build_dir" && pwd)
out=$build_dir/benchmark
bin=$build_dir/devel/lib/semantic_lidar_fusion
if [ "$install" = 1 ]; then
  step "dependencies"
  bash "$source_dir/scripts/install_dependencies.sh" >&2 || fail "the dependencies are not installed"
fi

step "build (log: $out/build.log)"
unset CMAKE_PREFIX_PATH ROS_PACKAGE_PATH PYTHONPATH LD_LIBRARY_PATH ROS_MASTER_URI ROS_NAMESPACE
if [ -f /opt/ros/noetic/setup.bash ]; then
  set +u
  source /opt/ros/noetic/setup.bash
  set -u
fi
export LC_ALL=C.UTF-8 ROS_IP=127.0.0.1 OMP_NUM_THREADS=1 ROS_HOME=$out/ros_home
cd "$build_dir"
{
  cmake "$source_dir" -DCMAKE_BUILD_TYPE=Release -DSLF_BUILD_BENCHMARKS=ON \
    -DPYTHON_EXECUTABLE=/usr/bin/python3 -DPython3_EXECUTABLE=/usr/bin/python3 \
    -DCATKIN_ENABLE_TESTING=ON &&
    cmake --build . -- -j"$jobs" && cmake --build . --target benchmarks -- -j"$jobs"
} >"$out/build.log" 2>&1 || fail "the build failed: $(tail -3 "$out/build.log")"
set +u
source "$build_dir/devel/setup.bash"
set -u

# $1: bag, the rest: options of simulate_drive. Made once.
simulated() {
  local bag=$out/$1
  shift
  [ ! -f "$bag" ] || return 0
  [ -x "$bin/simulate_drive" ] || return 1
  step "simulating $(basename "$bag"), once"
  "$bin/simulate_drive" --out "$bag" --quiet --threads "$jobs" "$@" >&2
}
load_before=$(cut -d' ' -f1-3 /proc/loadavg)

if wanted stages; then
  rm -f "$out"/stage_*.json
  for source in "$source_dir"/test/benchmark/benchmark_*.cpp; do
    name=$(basename "$source" .cpp)
    step "$name"
    interleave=--benchmark_enable_random_interleaving=true
    "$bin/$name" $interleave --benchmark_list_tests >/dev/null 2>&1 || interleave=""
    "$bin/$name" $interleave --benchmark_repetitions="$repetitions" --benchmark_min_time=0.05 \
      --benchmark_out="$out/stage_$name.json" --benchmark_out_format=json >"$out/$name.log" 2>&1 ||
      fail "$name failed: $(tail -3 "$out/$name.log")"
  done
fi

# Sets python to an interpreter that has fast-slic, or says why there is none.
prepare_fast_slic() {
  local venv=$out/venv log=$out/fast_slic.log
  python=$venv/bin/python
  ! "$python" -c 'import fast_slic.avx2' 2>/dev/null || return 0
  grep -qw avx2 /proc/cpuinfo || { step "no fast-slic: this processor has no AVX2"; return 1; }
  /usr/bin/python3 -c 'import sys; sys.exit(not (3, 7) <= sys.version_info[:2] <= (3, 11))' ||
    { step "no fast-slic: its version 0.4 needs Python 3.7 to 3.11"; return 1; }
  step "installing fast-slic (log: $log)"
  {
    rm -rf "$venv" && /usr/bin/python3 -m venv --system-site-packages "$venv" &&
      "$python" -m pip install "cython<3" "setuptools<60" wheel &&
      CFLAGS=-O3 "$python" -m pip install --no-build-isolation --no-deps fast-slic==0.4.0
  } >"$log" 2>&1 ||
    { step "no fast-slic: it cannot be installed: $(tail -1 "$log")"; return 1; }
}

if wanted superpixels; then
  rm -f "$out/superpixels.json"
  photographs=${SLF_SHARED_DIR:-$source_dir/../shared}/data/camvid
  sets=()
  if [ -d "$photographs" ]; then
    sets+=(--images "$photographs")
  else
    step "no photographs at $photographs"
  fi
  if simulated street.bag --images all --width 960 --duration 1 --seed 7; then
    sets+=(--street "$out/street.bag")
  else
    step "no street: simulate_drive is not built"
  fi
  if [ ${#sets[@]} -gt 0 ] && prepare_fast_slic; then
    step "superpixels beside fast-slic (log: $out/superpixels.log)"
    "$python" "$source_dir/test/benchmark/compare_fast_slic.py" --server "$bin/superpixel_server" \
      "${sets[@]}" --json "$out/superpixels.json" >"$out/superpixels.log" ||
      fail "compare_fast_slic.py failed"
    cat "$out/superpixels.log" >&2
  fi
fi

if wanted rig; then
  rm -f "$out/rig.json"
  if simulated rig.bag --scale 1 --duration 3; then
    step "the whole rig, three times $seconds s"
    /usr/bin/python3 "$source_dir/test/benchmark/benchmark_rig.py" --bin-dir "$bin" \
      --bag "$out/rig.bag" --rig "$source_dir/config/demo.yaml" --seconds "$seconds" \
      --json "$out/rig.json" >&2 || fail "benchmark_rig.py failed"
  else
    step "no rig: simulate_drive is not built"
  fi
fi

if wanted offline; then
  rm -f "$out/offline.json"
  if simulated rig.bag --scale 1 --duration 3 && simulated half.bag --width 960 --duration 3; then
    step "fuse_bag beside a plain chain"
    /usr/bin/python3 "$source_dir/test/benchmark/benchmark_fuse_bag.py" --fuse-bag "$bin/fuse_bag" \
      --rig "$source_dir/config/demo.yaml" --json "$out/offline.json" \
      "1920x1208=$out/rig.bag" "960x604=$out/half.bag" >&2 || fail "benchmark_fuse_bag.py failed"
  else
    step "no fuse_bag: simulate_drive is not built"
  fi
fi

/usr/bin/python3 "$source_dir/test/benchmark/summarize.py" "$out" --style "$style" \
  --load-before "$load_before"
