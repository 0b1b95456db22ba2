#!/bin/bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# The Python package as a wheel in target/wheels, and with TEST=1 its tests on what `make demo` wrote, against other readers.
# Settings: PYTHONS (the interpreters that it is tested with: python3, and those of 3.10 and 3.13 where they are), TEST.
set -euo pipefail
cd "$(dirname "$0")/.."
scripts/make-venv.sh target/maturin maturin==1.16.0
[ -x target/maturin/bin/maturin ] || { echo "error: expected maturin from PyPI, which could not be installed" >&2; exit 1; }
rm -rf target/wheels
# Its own folder: Python is no part of the other programs, and their crates have other features.
CARGO_TARGET_DIR=target/python target/maturin/bin/maturin build --release --locked -m python/Cargo.toml -o target/wheels
ls -l target/wheels
[ -n "${TEST:-}" ] || exit 0
CARGO_TARGET_DIR=target/python cargo clippy --release --locked --manifest-path python/Cargo.toml -- -D warnings
wheel=$PWD/$(ls target/wheels/*.whl)
# Photographs of the board, at half size: what is calibrated from.
board=target/board
target/release/fourdbody-sim render --scenario config/scenarios/board.toml --size-divisor 2 --out "$board"
[ -d "$board/images" ] || target/release/fourdbody-sim export-png --frames "$board" --out "$board/images"
cp config/board.toml "$board"
export FOURDBODY_DEMO=$PWD/target/demo FOURDBODY_BOARD=$PWD/$board FOURDBODY_OUT=$PWD/target/notebooks
export FOURDBODY_PROGRAM=$PWD/target/release/fourdbody
# run_tests PYTHON PACKAGES...: the tests, in an environment of its own; what is there has the wheel of another build.
run_tests() {
    local venv
    venv=target/python-test/$("$1" -c 'import sys; print("%d.%d" % sys.version_info[:2])')-$2
    rm -rf "$venv"
    "$1" -m venv "$venv"
    "$venv/bin/pip" install --quiet --disable-pip-version-check "$wheel" pytest==9.2.0 "${@:4}"
    printf -- '-- %s: %s\n' "$("$1" --version)" "$3"
    "$venv/bin/python" -m pytest -q -p no:cacheprovider python/tests/$3
}
for python in ${PYTHONS:-python3 python3.10 python3.13}; do
    "$python" --version >/dev/null 2>&1 || continue
    run_tests "$python" package "" mcap==1.6.0 mcap-protobuf-support==0.5.3 plyfile==1.1.5 opencv-python-headless==5.0.0.93 \
        "rerun-sdk==0.41.0; python_version >= '3.11'" "rerun-sdk==0.39.0; python_version < '3.11'" mypy==2.4.1
done
# MediaPipe brings the weights of its pose estimator along, up to this version, for Python 3.9 to 3.12, and wants an older NumPy.
run_tests python3 notebooks test_notebooks.py nbclient==0.11.0 ipykernel==7.4.0 matplotlib==3.11.2 mediapipe==0.10.21
