#!/bin/bash
# SPDX-License-Identifier: MIT OR Apache-2.0
# Programs and readers that are not ours, against the simulated camera and our files. What the tests do not do
# because building it takes minutes: viva-camctl, a second implementation of GigE Vision. Leaves its figures in
# target/third-party/summary.json.
#
# The benchmark of viva-camctl takes its packet size from the interface's MTU, which is 65536 on the loopback: it
# runs in a network namespace of its own whose loopback has jumbo frames, as a camera's network has. That needs
# root; without it this part is skipped, and says so.
set -euo pipefail
cd "$(dirname "$0")/.."
out=$PWD/target/third-party
version=0.11.0
mkdir -p "$out"
rm -f "$out"/*

scripts/install-packages.sh aravis-tools aravis-tools-cli python3-venv tshark iproute2
scripts/make-venv.sh tests/.venv mcap==1.6.0 mcap-protobuf-support==0.5.3
scripts/install-tool.sh viva-camctl $version
cargo build --quiet --release -p fourdbody-simulator
sim=$PWD/target/release/fourdbody-sim
camctl=$PWD/target/tools/bin/viva-camctl
export NO_COLOR=1

cat >"$out/session.sh" <<SESSION
set -eu
$sim cameras --count 2 --first 127.0.136.11 --width 640 --height 480 --lose-one-in 500 --duration 60 >"$out/sim.log" 2>&1 &
sim=\$!
trap 'kill \$sim 2>/dev/null || true' EXIT
sleep 1
a="--ip 127.0.136.11" b="--ip 127.0.136.12"
set -x
$camctl --json list \$a >"$out/list.json" 2>"$out/list.log"
$camctl features \$a >"$out/features.txt" 2>"$out/features.log"
$camctl xml \$a >"$out/camera.xml" 2>"$out/xml.log"
$camctl set \$a --name ExposureTime --value 2500 >"$out/set.log" 2>&1
$camctl get \$a --name ExposureTime >"$out/get.txt" 2>"$out/get.log"
$camctl stream \$a --iface lo --duration-s 5 --save 0 >"$out/stream.txt" 2>"$out/stream.log"
[ -z "\${BENCH:-}" ] || $camctl bench \$b --iface lo --duration-s 10 --json-out "$out/bench.json" >"$out/bench.txt" 2>&1
SESSION
if [ "$(id -u)" -eq 0 ] && unshare -n -m true 2>/dev/null; then
    # sysfs shows the interfaces of the namespace that it was mounted in.
    BENCH=1 unshare -n -m bash -c "mount -t sysfs sysfs /sys; ip link set lo up mtu 9000; bash '$out/session.sh'"
else
    echo "skipped: viva-camctl bench needs root, for a loopback of its own with an MTU of 9000"
    bash "$out/session.sh"
fi

sequences=()
for file in target/demo/clouds/sequence.mcap; do
    [ -e "$file" ] && sequences+=("$file") || echo "skipped: $file is not there (make demo)"
done
tests/.venv/bin/python - "$out" "$(git rev-parse HEAD)" "$(uname -m -r)" "$version" "${sequences[@]}" <<'P'
import json, re, subprocess, sys
from pathlib import Path

out, commit, machine, version, *sequences = sys.argv[1:]
out = Path(out)
camera = json.loads((out / "list.json").read_text())[0]
assert (camera["model"], camera["ip"]) == ("Sim23M", "127.0.136.11"), camera
features = (out / "features.txt").read_text()
assert "Sim23M" in features and "TriggerSource = Line0" in features, features
assert (out / "get.txt").read_text().strip() == "2500"
stream = re.search(r"Summary:.* complete=(\d+) incomplete=(\d+) missed=(\d+) .*resend=(\d+)/(\d+)/(\d+)", (out / "stream.txt").read_text() + (out / "stream.log").read_text())
complete, incomplete, missed, asked, resent, unavailable = map(int, stream.groups())
assert complete > 100 and incomplete == missed == unavailable == 0 and 0 < asked == resent, stream.group(0)
summary = {
    "commit": commit, "machine": machine, "seed": 0, "viva_camctl": version,
    "features": sum(" = " in line or "Command" in line for line in features.splitlines()),
    "stream_frames": complete, "stream_frames_incomplete": incomplete, "stream_packets_resent": resent,
}
if (out / "bench.json").exists():
    bench = json.loads((out / "bench.json").read_text())
    assert bench["frames_complete"] > 250 and bench["frames_incomplete"] == bench["frames_missed"] == 0, bench
    assert bench["packets_missing"] == 0 < bench["resend_requested"] == bench["resend_recovered"], bench
    summary |= {f"bench_{key}": bench[key] for key in ("duration_s", "frames_complete", "frames_incomplete", "resend_recovered")}
for path in sequences:
    found = json.loads(subprocess.check_output([sys.executable, "tests/it/third_party_sequence.py", path]))
    assert found["messages"] > 0 and min(found["points"]) > 100_000, found
    summary |= {"sequence_clouds": found["messages"], "sequence_points_min": min(found["points"])}
(out / "summary.json").write_text(json.dumps(summary, indent=1) + "\n")
print(json.dumps(summary, indent=1))
P
