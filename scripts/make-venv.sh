#!/bin/bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# make-venv.sh DIR PACKAGE==VERSION...: a Python environment with the packages that tests use as independent readers.
# It is made once per user, in FOURDBODY_CACHE (~/.cache/fourdbody), so that the next clone finds it; DIR is a link to it.
# Where PyPI cannot be reached the tests that need it say so and are skipped.
set -uo pipefail
dir=$1
shift
complete() {
    [ -x "$dir/bin/python" ] && "$dir/bin/python" - "$@" <<'P'
import sys
from importlib.metadata import PackageNotFoundError, version
try:
    present = all(version(name) == number for name, number in (w.split("==") for w in sys.argv[1:]))
except PackageNotFoundError:
    present = False
sys.exit(not present)
P
}
complete "$@" && exit 0
cache=${FOURDBODY_CACHE:-${XDG_CACHE_HOME:-$HOME/.cache}/fourdbody}/python-$(sha256sum <<<"$*" | head -c 12)
mkdir -p "$cache" "$(dirname "$dir")" && rm -rf "$dir" && ln -s "$cache" "$dir" || exit 0
exec 9>"$cache.lock"
flock 9
complete "$@" && exit 0
echo "installing from PyPI into $cache: $*"
/usr/bin/python3 -m venv "$cache" || exit 0
"$dir/bin/python" -m pip install --quiet --disable-pip-version-check "$@" ||
    echo "PyPI not reached: tests that need $* will be skipped"
exit 0
