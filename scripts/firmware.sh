#!/bin/bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# The HSU's firmware for a Raspberry Pi Pico, as ELF and UF2 in target/firmware, and its bench in emulated time.
# Compiler and emulator are its own (FOURDBODY_CACHE, target/firmware): nothing of the system is replaced. What cannot be
# fetched is named, and what needs it is skipped. Settings: TRIGGERS of the train.
set -euo pipefail
cd "$(dirname "$0")/.."
rust=1.95.0
out=target/firmware
export RUSTUP_HOME=${FOURDBODY_CACHE:-${XDG_CACHE_HOME:-$HOME/.cache}/fourdbody}/rust-pico
export RUSTUP_TOOLCHAIN=$rust
# These would replace what firmware/.cargo/config.toml says.
unset RUSTFLAGS CARGO_BUILD_TARGET CARGO_ENCODED_RUSTFLAGS
mkdir -p "$RUSTUP_HOME" "$out/bench"
skip() {
    echo "skipped: $1"
    exit 0
}
command -v rustup >/dev/null || skip "the firmware; its compiler comes by rustup, which is not installed"
# Of two that build at once the second waits.
exec 9>"$RUSTUP_HOME/lock"
flock 9
if ! ls -d "$RUSTUP_HOME/toolchains/$rust"*/lib/rustlib/thumbv6m-none-eabi >/dev/null 2>&1; then
    echo "installing Rust $rust for the Pico's processor into $RUSTUP_HOME"
    timeout 900 rustup --quiet toolchain install "$rust" --profile minimal --component clippy --target thumbv6m-none-eabi \
        --no-self-update >"$out/rustup.log" 2>&1 ||
        skip "the firmware; static.rust-lang.org, which has its compiler, is not reached ($out/rustup.log)"
fi
flock -u 9
build() { (cd firmware && rustup run "$rust" cargo "$1" --release --locked --quiet --target-dir "../$out/build" "${@:2}"); }
build clippy -- -D warnings
build build
cp "$out/build/thumbv6m-none-eabi/release/hsu-firmware" "$out/hsu-firmware.elf"
python3 firmware/uf2.py "$out/hsu-firmware.elf" "$out/hsu-firmware.uf2"
ls -l "$out"/hsu-firmware.*

command -v npm >/dev/null || skip "the bench; its emulator comes by npm, which is not installed"
cp firmware/bench/*.mjs firmware/bench/*.json "$out/bench/"
(cd "$out/bench" && timeout 300 npm ci --silent --no-audit --no-fund >npm.log 2>&1) ||
    skip "the bench; registry.npmjs.org, which has its emulator, is not reached ($out/bench/npm.log)"
version=$(sed -n '/^\[workspace.package\]/,/^version/s/^version = "\(.*\)"/\1/p' Cargo.toml)
node "$out/bench/bench.mjs" "$out/hsu-firmware" "$out/summary.json" "${TRIGGERS:-1000}" "$version" "$(git rev-parse HEAD)"
