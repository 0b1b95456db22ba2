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
wheel=$(ls target/wheels/*.whl)
for python in ${PYTHONS:-python3 python3.10 python3.13}; do
    "$python" --version >/dev/null 2>&1 || continue
    # What is there has the wheel of another build.
    venv=target/python-test/$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
    rm -rf "$venv"
    "$python" -m venv "$venv"
    "$venv/bin/pip" install --quiet --disable-pip-version-check "$wheel" pytest==9.2.0 mcap==1.6.0 mcap-protobuf-support==0.5.3 \
        plyfile==1.1.5 opencv-python-headless==5.0.0.93
    printf -- '-- %s\n' "$("$python" --version)"
    FOURDBODY_DEMO=$PWD/target/demo "$venv/bin/python" -m pytest -q -p no:cacheprovider python/tests
done
