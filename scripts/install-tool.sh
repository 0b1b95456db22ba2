#!/bin/bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# install-tool.sh NAME VERSION [OPTION OF CARGO INSTALL...]: a program from crates.io, as target/tools/bin/NAME.
# It is built once per user, in FOURDBODY_CACHE (~/.cache/fourdbody), so that the next clone finds it.
set -euo pipefail
name=$1 version=$2
shift 2
cache=${FOURDBODY_CACHE:-${XDG_CACHE_HOME:-$HOME/.cache}/fourdbody}/$name-$version
if [ ! -x "$cache/bin/$name" ]; then
    echo "building $name $version into $cache"
    mkdir -p "$cache"
    # Of two that build at once the second waits, and finds it. What is half built has no name yet.
    exec 9>"$cache/lock"
    flock 9
    [ -x "$cache/bin/$name" ] ||
        "${CARGO:-cargo}" install --quiet --locked --root "$cache" --target-dir "$cache/build" "$name@$version" "$@"
    rm -rf "$cache/build"
fi
mkdir -p target/tools/bin
ln -sf "$cache/bin/$name" "target/tools/bin/$name"
