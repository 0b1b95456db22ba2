#!/bin/bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# A node that records four cameras at full rate, measured; figures in target/bench-ingest/summary.json.
# Settings: RATE_HZ (120), DURATION (20 s), LONG=1 or a number of seconds (1: 300), NODE_ONLY=1.
set -euo pipefail
cd "$(dirname "$0")/.."
out=target/bench-ingest
rate_hz=${RATE_HZ:-120}
duration=${DURATION:-20}
long=${LONG:-}
[ "$long" != 1 ] || long=300

# A train of 20 s at full rate is 22 GB; with dropped segments a few of 2 GiB are on disk at a time.
mkdir -p "$out"
seconds=$duration
[ -z "$long" ] || seconds=40
need_gb=$(awk "BEGIN { printf \"%d\", 4 * 2.304e-3 * $rate_hz * $seconds * 1.03 + 2 }")
free_gb=$(($(df --output=avail -B1000000000 "$out" | tail -1)))
if [ "$free_gb" -lt "$need_gb" ]; then
    echo "error: $out needs $need_gb GB for a moment and has $free_gb GB free; free some, or set DURATION" >&2
    exit 2
fi

# Where loopback cuts long UDP sends before its receivers, the simulated cameras send seven packets at a time,
# which costs a third less (docs/design/experiments.md). Only for the time of the bench, and only as root.
if [ "$(id -u)" -eq 0 ] && ethtool -k lo | grep -q '^tx-udp-segmentation: on'; then
    segmentation=on
    ethtool -K lo tx-udp-segmentation off
fi

# A file system mounted with `discard` tells the disk about every removed segment within the next commit, and all
# writers wait for that: 0.4 s for 2 GiB here, longer than 64 buffers last. Captures remove nothing; this bench does.
mount_point=$(findmnt -n -o TARGET --target "$out")
if [ -n "$long" ] && [ "$(id -u)" -eq 0 ] && findmnt -n -o OPTIONS --target "$out" | grep -qw discard; then
    echo "remounting $mount_point without discard for the time of the bench"
    discards=on
    mount -o remount,nodiscard "$mount_point"
fi
restore() {
    [ -z "${segmentation:-}" ] || ethtool -K lo tx-udp-segmentation on
    [ -z "${discards:-}" ] || mount -o remount,discard "$mount_point"
}
trap restore EXIT

arguments=(--out "$out" --rate-hz "$rate_hz" --duration "$duration" --commit "$(git rev-parse HEAD)")
[ -z "$long" ] || arguments+=(--long "$long")
[ -z "${NODE_ONLY:-}" ] || arguments+=(--node-only)
target/release/fourdbody-sim bench-ingest "${arguments[@]}"
