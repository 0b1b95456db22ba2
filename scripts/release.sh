#!/bin/bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# The files of a release: the Debian package, with SHA256SUMS beside it. Refuses what nobody could make again from the
# commit, and documents whose figures are of another version.
set -euo pipefail
cd "$(dirname "$0")/.."
fail() { printf 'error: %s\n' "$*" >&2; exit 1; }
clean() {
    local changed
    changed=$(git status --porcelain)
    [ -z "$changed" ] || fail "expected a clean tree, found changes; commit or remove them:"$'\n'"$changed"
}

clean
version=$(sed -n '/^\[workspace.package\]/,/^\[/s/^version = "\(.*\)"/\1/p' Cargo.toml)
[ -n "$version" ] || fail "expected a version in [workspace.package] of Cargo.toml, found none"
FOURDBODY_RELEASE=1 "${CARGO:-cargo}" test -p fourdbody --test it documents:: ||
    fail "expected documents of this version, found others (above); \`make figures\` measures them"
make deb
# Cargo.lock, for instance.
clean

package=fourdbody_$version-1_$(dpkg --print-architecture).deb
[ -s "target/debian/$package" ] || fail "expected target/debian/$package of \`make deb\`, found none"
cd target/debian
sha256sum "$package" >SHA256SUMS
sha256sum --check --quiet SHA256SUMS
echo "fourdbody $version, commit $(git rev-parse HEAD):"
echo "  $PWD/$package ($(stat -c %s "$package") bytes)"
echo "  $PWD/SHA256SUMS: $(cut -d' ' -f1 SHA256SUMS)"
echo "check a copy with: sha256sum -c SHA256SUMS"
