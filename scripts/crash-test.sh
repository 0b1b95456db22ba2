#!/bin/bash
# Kills a recording node N times at random moments (200 by default), recovers and verifies every recording.
set -euo pipefail
cd "$(dirname "$0")/.."
FOURDBODY_CRASHES=${1:-200} cargo test --release --test it -- --nocapture a_killed_node_loses_no_more_than_stated
