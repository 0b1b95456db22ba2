# SPDX-License-Identifier: MIT OR Apache-2.0
"""Our phase beside other programs', on the same rendered frames in the same run: error against the truth, and time.

python compare.py --scene DIR:CAMERA:INDEX [--scene ...] --ours EXAMPLE --out compare.json: DIR/light holds what
`fourdbody-sim render` wrote, DIR/images its photographs (`scripts/bench-reconstruct.sh`)."""

import argparse
import json
import subprocess
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
import scipy
import skimage

import methods


def truth_of(path, shape):
    """Absolute phase and lit pixels of the whole frame."""
    with np.load(path) as file:
        v0, v1, u0, u1 = file["crop"]
        phase, lit = np.full(shape, np.nan), np.zeros(shape, bool)
        phase[v0:v1, u0:u1], lit[v0:v1, u0:u1] = file["phase"], file["lit"]
    return phase, lit & np.isfinite(phase)


def local_period(phase, lit):
    """Median period along the rows, px."""
    with np.errstate(invalid="ignore"):
        step = np.abs(np.diff(phase, axis=1))
    step = step[lit[:, 1:] & lit[:, :-1] & (step < 2.0)]
    return float(methods.TAU / np.median(step))


def sum_ms(stages, names):
    return {key: sum(stages[name][key] for name in names) for key in ("median_ms", "least_ms")}


def one(scene, camera, index, ours):
    """All methods on one frame."""
    image_path = scene / "images" / camera / f"{index:06d}.png"
    image = cv2.imread(str(image_path), cv2.IMREAD_GRAYSCALE)
    phase, lit = truth_of(scene / "light/truth" / f"{camera}_{index:06d}.npz", image.shape)
    period = local_period(phase, lit)
    with tempfile.TemporaryDirectory() as folder:
        maps = Path(folder) / "maps.npz"
        command = [ours, image_path, maps, "--calibration", scene / "light/calibration.json", camera]
        answer = json.loads(subprocess.run(command, check=True, capture_output=True).stdout)
        with np.load(maps) as file:
            wrapped, absolute = file["wrapped"].astype(float), file["absolute"].astype(float)
    stages = answer["stages"]
    # What leads to the wrapped phase; the marker's means are part of it.
    first = ["mask", "period", "marker", "phase"]
    report = {"scene": scene.name, "camera": camera, "index": index, "period_px": period, "lit_px": int(lit.sum())}
    known = lit & np.isfinite(wrapped)
    demodulations = {"fourdbody (mask to wrapped phase)": (wrapped, sum_ms(stages, first))}
    for name, method in methods.DEMODULATIONS.items():
        demodulations[name] = methods.timed(lambda method=method: method(image, period))
    report["demodulation"] = {}
    for name, (found, times) in demodulations.items():
        error = methods.phase_error(found, phase, lit)
        row = methods.figures(error, lit) | times
        row["rms_where_ours_rad"] = methods.figures(error, known)["rms_rad"]
        row["robust_where_ours_rad"] = methods.figures(error, known)["robust_rad"]
        report["demodulation"][name] = row
    ours_row = {"right_order_share": order_absolute(absolute, phase, known), "absolute": True}
    report["unwrapping"] = {"fourdbody (unwrap, one camera alone)": ours_row | sum_ms(stages, ["unwrap"])}
    valid = np.isfinite(wrapped)
    for name, method in methods.UNWRAPPINGS.items():
        found, times = methods.timed(lambda method=method: method(wrapped, valid), 3)
        share = methods.order_share(found, phase, known)
        report["unwrapping"][name] = {"right_order_share": share, "absolute": False} | times
    report["ours_whole_frame"] = sum_ms(stages, list(stages))
    return report


def order_absolute(absolute, true, where):
    """Share of `where` that has a phase within half a period of the truth."""
    return float((np.abs(absolute - true)[where] < np.pi).mean())


def copy_rate():
    """Bytes copied a second by one thread, GB: 256 MiB, least of five."""
    source = np.ones(1 << 28, np.uint8)
    target = np.empty_like(source)
    times = []
    for _ in range(5):
        began = time.perf_counter()
        np.copyto(target, source)
        times.append(time.perf_counter() - began)
    return source.size / min(times) / 1e9


def show(report):
    print(f"\n{report['scene']} {report['camera']}: {report['lit_px']} lit pixels, period {report['period_px']:.1f} px")
    print(f"{'wrapped phase':<36} {'ms':>8} {'least':>8} {'rms rad':>8} {'robust':>8} {'p95':>8} {'cover %':>8} {'rms where ours':>15}")
    for name, row in report["demodulation"].items():
        print(
            f"{name:<36} {row['median_ms']:>8.1f} {row['least_ms']:>8.1f} {row['rms_rad']:>8.4f} {row['robust_rad']:>8.4f} "
            f"{row['p95_rad']:>8.4f} {100 * row['coverage']:>8.2f} {row['rms_where_ours_rad']:>15.4f}"
        )
    print(f"{'unwrapping of our wrapped phase':<36} {'ms':>8} {'least':>8} {'right order %':>14}")
    for name, row in report["unwrapping"].items():
        kind = "absolute" if row["absolute"] else "best offset"
        share = 100 * row["right_order_share"]
        print(f"{name:<36} {row['median_ms']:>8.1f} {row['least_ms']:>8.1f} {share:>14.2f} ({kind})")


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--scene", action="append", required=True, metavar="DIR:CAMERA:INDEX")
    parser.add_argument("--ours", required=True)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    versions = {"numpy": np.__version__, "scipy": scipy.__version__, "scikit-image": skimage.__version__}
    versions["opencv-contrib"] = cv2.__version__
    frames = []
    for scene in args.scene:
        folder, camera, index = scene.rsplit(":", 2)
        frames.append(one(Path(folder), camera, int(index), args.ours))
        show(frames[-1])
    report = {"versions": versions, "memory_copy_gb_per_s": copy_rate(), "frames": frames}
    args.out.write_text(json.dumps(report, indent=2) + "\n")


main()
