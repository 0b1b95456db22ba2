#!/bin/bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# fuzz.sh SECONDS [TARGET...]: runs the fuzz targets, one after the other, and keeps what each came to in
# target/fuzz/summary.txt. Needs a nightly compiler; cargo-fuzz is installed into target/tools when missing.
# What is found lies in fuzz/artifacts; put it into fuzz/seeds once it is repaired, and the tests keep it.
set -euo pipefail
cd "$(dirname "$0")/.."
seconds=$1
shift
targets=("$@")
[ ${#targets[@]} -gt 0 ] || targets=(hsu_decoder hsu_unit gvcp recording config reconstruct)
export PATH=$PWD/target/tools/bin:$PATH
command -v cargo-fuzz >/dev/null || cargo install cargo-fuzz --locked --quiet --root target/tools
# A sanitizer makes this build large (1.8 GB) and slow; it does not share anything with ordinary builds.
build=$PWD/target/fuzz
cargo +nightly fuzz build --fuzz-dir fuzz --target-dir "$build"
bin=$(ls -d "$build"/*-linux-gnu/release | head -1)
failed=0
for target in "${targets[@]}"; do
    corpus=fuzz/corpus/$target
    mkdir -p "$corpus" "fuzz/artifacts/$target"
    nice "$bin/$target" "$corpus" "fuzz/seeds/$target" -max_total_time="$seconds" -max_len=65536 -timeout=20 \
        -rss_limit_mb=4096 -artifact_prefix="fuzz/artifacts/$target/" -print_final_stats=1 \
        >"$build/$target.log" 2>&1 || { failed=1; echo "$target: FOUND SOMETHING, see $build/$target.log"; }
    covered=$(grep -oE 'cov: [0-9]+ ft: [0-9]+ corp: [0-9]+' "$build/$target.log" | tail -1 || true)
    units=$(grep -oE 'number_of_executed_units: [0-9]+' "$build/$target.log" | grep -oE '[0-9]+' || true)
    echo "$target: executions ${units:-0}, $covered, $seconds s" | tee -a "$build/summary.txt"
done
exit $failed
