#!/bin/bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# Measures every figure that README.md and docs state, target after target, and writes them there. The figures of speed need
# a machine that does nothing else. target/figures/minutes.json keeps how long each target took; the sum is printed.
# Settings: TARGETS (all: those that documents have a table of), KEEP_GOING=1 (a target that fails is named at the end).
set -euo pipefail
cd "$(dirname "$0")/.."
all=$(python3 scripts/write_tables.py --targets)
targets=${TARGETS:-$all}
out=target/figures
mkdir -p "$out"
: >"$out/minutes.tsv"
failed=()
# `make demo` makes the light that several others use.
while read -r target; do
    [ -n "$target" ] || continue
    printf -- '-- make %s\n' "$target"
    since=$SECONDS
    # A target has words: `poses BATTERY=bodies`.
    # shellcheck disable=SC2086
    if ! make $target >"$out/${target// /_}.log" 2>&1; then
        printf 'error: make %s failed: %s has what it printed\n' "$target" "$out/${target// /_}.log" >&2
        [ -n "${KEEP_GOING:-}" ] || exit 1
        failed+=("$target")
    fi
    printf '%s\t%s\n' "$target" "$(((SECONDS - since + 59) / 60))" | tee -a "$out/minutes.tsv"
done <<<"$targets"
python3 scripts/write_tables.py
printf 'measured in %s minutes\n' "$(((SECONDS + 59) / 60))"
[ ${#failed[@]} -eq 0 ] || { printf 'error: not measured: %s\n' "${failed[*]}" >&2; exit 1; }
