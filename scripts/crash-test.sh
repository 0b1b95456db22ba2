#!/bin/bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# Kills recorders and nodes at random moments, N times each (200 by default), recovers and verifies what they leave.
# Prints a line for each; FOURDBODY_SEED chooses other moments.
set -euo pipefail
cd "$(dirname "$0")/.."
FOURDBODY_CRASHES=${1:-200} cargo test --test it -- --nocapture crash::a_killed_recorder crash::node
