#!/bin/bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# make-venv.sh DIR PACKAGE...: a Python environment with the packages that tests use as independent readers.
# Where PyPI cannot be reached the tests that need it say so and are skipped.
set -uo pipefail
dir=$1
shift
[ -x "$dir/bin/python" ] || /usr/bin/python3 -m venv "$dir" || exit 0
"$dir/bin/python" - "$@" <<'P' && exit 0
import sys
from importlib.metadata import PackageNotFoundError, version
try:
    present = all(version(name) == number for name, number in (w.split("==") for w in sys.argv[1:]))
except PackageNotFoundError:
    present = False
sys.exit(not present)
P
echo "installing from PyPI: $*"
"$dir/bin/python" -m pip install --quiet --disable-pip-version-check "$@" || echo "PyPI not reached: tests that need $* will be skipped"
exit 0
