# SPDX-License-Identifier: MIT OR Apache-2.0
# shellcheck shell=bash
# Sourced by the scripts that record in a simulated laboratory. They set `bin`, where the programs are, and `out`, where
# everything goes; what runs is ended when they end.

step() { printf '\n== %s\n' "$*"; }

# The processes of the laboratory that is open.
children=()
close_laboratory() {
    [ ${#children[@]} -gt 0 ] || return 0
    kill "${children[@]}" 2>/dev/null || true
    wait "${children[@]}" 2>/dev/null || true
    children=()
}
trap close_laboratory EXIT

# wait_for SECONDS COMMAND...: until the command succeeds.
wait_for() {
    local tries=$(($1 * 10))
    shift
    until "$@" >/dev/null 2>&1; do
        tries=$((tries - 1))
        [ $tries -gt 0 ] || { echo "error: waited in vain for: $*; see the logs in $out" >&2; exit 1; }
        sleep 0.1
    done
}

# open_laboratory DIR OPTIONS...: `fourdbody-sim run` with these options, and a node for each configuration file that it
# writes. Their logs lie in DIR, with all else that is theirs. Leaves the nodes' URLs in `nodes`.
open_laboratory() {
    local lab=$1 config
    shift
    rm -rf "$lab"
    mkdir -p "$lab"
    $bin/fourdbody-sim run --run-dir "$lab" "$@" >"$lab/lab.json" 2>"$lab/lab.log" &
    children+=($!)
    wait_for 60 grep -q '"ready":true' "$lab/lab.json"
    nodes=$(grep -o '"urls":"[^"]*"' "$lab/lab.json" | cut -d'"' -f4)
    for config in "$lab"/node-*.toml; do
        $bin/fourdbody node --config "$config" 2>"${config%.toml}.log" &
        children+=($!)
    done
    # Devices take a moment to answer; a capture before that is refused and leaves nothing.
    wait_for 60 $bin/fourdbody status --nodes "$nodes"
}

# record ANSWER OPTIONS...: one session of the open laboratory; what `capture --json` says goes to the file ANSWER. Frames
# that are missing (exit code 3) are no failure: each has a gap record, and what follows says what it rests on.
record() {
    local answer=$1 code=0
    shift
    $bin/fourdbody capture --nodes "$nodes" "$@" --json >"$answer" || code=$?
    [ $code -ne 3 ] || return 0
    [ $code -eq 0 ] || echo "error: capture failed with exit code $code; see the logs in $out" >&2
    return $code
}
