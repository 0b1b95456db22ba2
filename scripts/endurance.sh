#!/bin/bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# Endurance against the simulated laboratory: CYCLES arm/stop cycles in one node process without growth of memory,
# threads or descriptors, and one session of TRIGGERS triggers, beyond the wrap of 16-bit block ids.
set -euo pipefail
cd "$(dirname "$0")/.."
FOURDBODY_CYCLES=${CYCLES:-1000} FOURDBODY_TRIGGERS=${TRIGGERS:-66000} \
    cargo test --release --test it -- --nocapture endurance
