#!/bin/bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# All tests of the workspace. Those with nodes, cameras and clocks mostly wait, and need a processor at once when they do
# not. Those that only compute run beside them, with the time that these leave, and are told at the end. One runs before
# all others, alone: with a fault every dozen triggers each must be named, and a host that is busy gives some frames up.
set -uo pipefail
cd "$(dirname "$0")/.."
# Modules of tests/it without any clock; whatever is not named here is taken to have one.
computing=(analytic_scene:: back_end:: bad_frames:: bad_photographs:: board_to_plane:: calibrate_command::
    calibration_check:: calibration_uncertainty:: crossing_limbs:: export:: frame_set:: merging:: player:: reference:: result_files:: reused::
    shared_calibration:: shared_exposure:: shared_scene:: simd_paths:: validate_commands:: witness::)
alone=faults::every_injected_fault_is_accounted_for_and_nothing_else_is_missing
cargo=${CARGO:-cargo}
log=target/test-computing.log
# What runs in the background does not hear of Ctrl-C by itself.
trap 'trap - INT TERM; kill 0' INT TERM
# A test that hangs is named by the line that says how long it has been running, and ends the run.
bounded() { timeout --foreground 40m "$@"; }

"$cargo" test --workspace --tests --no-run || exit
# What a compute node has is the program without Aravis: the tests give it to the tasks of their Slurm. With an example of the
# same workspace Cargo chooses the same features for all other crates, and compiles none of them again.
"$cargo" build --workspace --no-default-features --bin fourdbody --example manual || exit
install -D target/debug/fourdbody target/compute-node/fourdbody
export FOURDBODY_COMPUTE_NODE=$PWD/target/compute-node/fourdbody
bounded "$cargo" test -p fourdbody --test it -- --exact "$alone"
first=$?

(
    bounded nice -n 19 "$cargo" test --workspace --lib && bounded nice -n 19 "$cargo" test --workspace --test it -- "${computing[@]}"
) >"$log" 2>&1 &
bounded "$cargo" test --workspace --test it --test makes -- --skip="$alone" "${computing[@]/#/--skip=}"
waiting=$?
wait $!
computed=$?
echo "-- the tests that compute ($log)"
cat "$log"
[ $first -eq 0 ] && [ $waiting -eq 0 ] && [ $computed -eq 0 ]
