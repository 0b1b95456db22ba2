#!/bin/bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# What a new user does, in a clean Debian in a directory: install the package, configure it against the simulator, start the
# node under the unit's user, record a session and verify it. Needs root, `make deb` before, and 2 GB for a moment.
# The root is made by debootstrap and kept in target/debian-root for the next run (FRESH=1 makes it anew).
set -euo pipefail
cd "$(dirname "$0")/.."
root=$PWD/target/debian-root
package=$(ls -t target/debian/fourdbody_*.deb 2>/dev/null | head -1) || true
[ -n "$package" ] || { echo "error: no package in target/debian; run make deb" >&2; exit 1; }
[ "$(id -u)" -eq 0 ] || { echo "error: a Debian root is made by root only; run with sudo" >&2; exit 1; }
scripts/install-packages.sh debootstrap
step() { printf '\n== %s\n' "$*"; }

[ "${FRESH:-0}" = 0 ] || rm -rf "$root"
if [ ! -e "$root/.made" ]; then
    step "a clean Debian 12 in $root"
    rm -rf "$root"
    debootstrap --variant=minbase bookworm "$root" "${MIRROR:-http://deb.debian.org/debian}" >target/debian-root.log
    cp /etc/resolv.conf "$root/etc/resolv.conf"
    for file in /etc/apt/apt.conf.d/* /etc/apt/sources.list.d/*; do
        [ -e "$file" ] && cp "$file" "$root${file}"
    done
    [ -s /etc/apt/sources.list ] && cp /etc/apt/sources.list "$root/etc/apt/sources.list"
    touch "$root/.made"
fi
inside() { chroot "$root" env DEBIAN_FRONTEND=noninteractive LC_ALL=C.UTF-8 "$@"; }
exec_inside() { exec chroot "$root" env LC_ALL=C.UTF-8 "$@"; }
end() {
    jobs -p | xargs -r kill 2>/dev/null || true
    wait 2>/dev/null || true
    for at in dev/pts dev sys proc lab; do mountpoint -q "$root/$at" && umount -l "$root/$at"; done
    true
}
trap end EXIT
for at in proc sys dev dev/pts; do mkdir -p "$root/$at"; mount --bind "/$at" "$root/$at"; done

step "install: $(basename "$package")"
cp "$package" "$root/tmp/fourdbody.deb"
inside apt-get update -qq
inside apt-get purge -y -qq fourdbody >/dev/null 2>&1 || true
# What a run that did not come to its end has left there.
rm -rf "$root/var/lib/fourdbody" "$root/etc/fourdbody"
inside apt-get install -y -qq --no-install-recommends /tmp/fourdbody.deb >/dev/null
inside fourdbody --version
inside id fourdbody
inside stat -c '%A %U:%G %n' /etc/fourdbody /etc/fourdbody/node.toml /var/lib/fourdbody /var/lib/fourdbody/sessions
inside sh -c 'test -s /usr/share/man/man1/fourdbody-capture.1* && test -s /usr/share/bash-completion/completions/fourdbody'
for unit in fourdbody-node fourdbody-worker; do
    inside test -s "/lib/systemd/system/$unit.service" -o -s "/usr/lib/systemd/system/$unit.service"
done
inside fourdbody check-config /etc/fourdbody/node.toml /etc/fourdbody/worker.toml

step "the guide's own words: tokens for the service, and is this host fit"
# Only sudo is missing in a minimal Debian; the doctor's verdict is on a host without cards and HSU.
grep -E '^sudo -u fourdbody fourdbody token new' docs/guide/installing.md | sed 's/^sudo -u fourdbody //' >"$root/tmp/guide.sh"
inside setpriv --reuid=fourdbody --regid=fourdbody --init-groups sh -e /tmp/guide.sh
inside fourdbody token list --tokens /var/lib/fourdbody/tokens
doctor=$(grep -A1 '^sudo prlimit' docs/guide/installing.md | tr -d '\\\n' | sed 's/^sudo //')
# Some containers let even root raise no limit (no CAP_SYS_RESOURCE): then what the limits are for cannot be tried.
limits=yes
if ! prlimit --rtprio=70 --memlock=unlimited true 2>/dev/null; then
    limits=
    doctor=$(sed -E 's/prlimit( --[a-z]+=[a-z0-9]+)+ //' <<<"$doctor")
    echo "not tried: this place raises no limits, so the doctor's verdict on real-time priority and locked memory is left out"
fi
inside $doctor >"$root/tmp/doctor.txt" || true
cat "$root/tmp/doctor.txt"
grep -qE '^ok +packet socket' "$root/tmp/doctor.txt"
if [ -n "$limits" ] && grep -E '^(warning|failed) +(real-time priority|memory lock)' "$root/tmp/doctor.txt"; then
    echo "error: the guide's command for doctor has not the rights of the service" >&2
    exit 1
fi

step "an upgrade keeps the configuration"
echo "# mine" >>"$root/etc/fourdbody/rig.toml"
inside dpkg -i --force-confold /tmp/fourdbody.deb >/dev/null
grep -q '^# mine$' "$root/etc/fourdbody/rig.toml"

step "the simulated laboratory (outside), two nodes (inside, as the service's user)"
lab=target/debian-lab
rm -rf "$lab"
mkdir -p "$lab" "$root/lab"
target/release/fourdbody-sim run --rig config/rig.toml --run-dir "$lab" --sessions-dir /var/lib/fourdbody/sessions \
    --rate-hz 10 --first-address 127.0.78.11 --first-port 7601 >"$lab/lab.json" 2>"$lab/lab.log" &
for _ in $(seq 300); do grep -q '"ready":true' "$lab/lab.json" && break; sleep 0.1; done
nodes=$(grep -o '"urls":"[^"]*"' "$lab/lab.json" | cut -d'"' -f4)
for node in a b; do
    # What the operator edits: addresses and device of this place.
    sed -e "s|$PWD/$lab/||" -e "s|^rig = .*|rig = \"rig.toml\"|" -e '/^audit = /d' "$lab/node-$node.toml" >"$root/etc/fourdbody/node-$node.toml"
    device=$(readlink -f "$lab/hsu-$node")
    chmod 666 "$device"
    sed -i "s|^device = .*|device = \"$device\"|" "$root/etc/fourdbody/node-$node.toml"
    chown root:fourdbody "$root/etc/fourdbody/node-$node.toml" 2>/dev/null || inside chown root:fourdbody "/etc/fourdbody/node-$node.toml"
done
cp "$lab/rig.toml" "$root/etc/fourdbody/rig.toml"
inside fourdbody check-config /etc/fourdbody/node-a.toml /etc/fourdbody/node-b.toml
for node in a b; do
    # `exec`: what is killed at the end is the node itself, not a shell that waits for it.
    exec_inside setpriv --reuid fourdbody --regid fourdbody --init-groups \
        fourdbody node --config "/etc/fourdbody/node-$node.toml" 2>"$lab/node-$node.log" &
done
for _ in $(seq 300); do inside fourdbody status --nodes "$nodes" >/dev/null 2>&1 && break; sleep 0.1; done
inside fourdbody status --nodes "$nodes"

step "a session, verified from its files"
rm -rf "$root/var/lib/fourdbody/sessions/first"
inside fourdbody capture --nodes "$nodes" --triggers 20 --name first
inside fourdbody verify /var/lib/fourdbody/sessions/first
inside fourdbody report /var/lib/fourdbody/sessions/first --out /tmp/first.html
rm -rf "$root/var/lib/fourdbody/sessions/first"

step "remove and purge: recordings and nothing else stay"
inside apt-get purge -y -qq fourdbody >/dev/null
test -d "$root/var/lib/fourdbody/sessions"
test ! -e "$root/usr/bin/fourdbody"
echo "the package works in a clean Debian"
