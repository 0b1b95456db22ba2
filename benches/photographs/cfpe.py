# SPDX-License-Identifier: MIT OR Apache-2.0
"""One photograph's wrapped phase against twelve: ours, OpenCV's and the Fourier methods', on photographs that others took.

PYTHONPATH=benches/peers python cfpe.py --data DIR... --ours EXAMPLE --out cfpe.json. DIR is a clone of github.com/yongleex/CFPE,
or has a folder per object with reference.npz (`mask`). Of each object there are twelve photographs (`*00h.bmp` to `*11h.bmp`,
frame k with the extra phase 2 pi k / 12). The score is modulo a constant and the sign. Their fringes are 21-22 px long, ours
are made for 5 to 24: each photograph is scored as it is, and with its columns averaged in pairs, which makes fringes of the
length that our instrument sees."""

import argparse
import json
import subprocess
import tempfile
from pathlib import Path

import cv2
import numpy as np

import methods

# Least modulation, grey values, of what counts as the object where nobody has drawn a mask.
DARK = 12.0


def ours(program, image, period):
    """The wrapped phase of all pixels that have one."""
    with tempfile.TemporaryDirectory() as folder:
        picture, maps = Path(folder) / "image.png", Path(folder) / "maps.npz"
        cv2.imwrite(str(picture), image)
        answer = subprocess.run([program, picture, maps, "--period", str(period)], capture_output=True, text=True)
        if answer.returncode != 0:
            print(f"fourdbody refuses a photograph: {answer.stderr.strip()}")
            return np.full(image.shape, np.nan)
        with np.load(maps) as file:
            return file["wrapped"].astype(float)


def objects(places):
    """Name, photographs and mask (`None` where nobody has drawn one) of each object."""
    found = {}
    for place in places:
        for folder in sorted(path.parent for path in place.glob("*/reference.npz")):
            with np.load(folder / "reference.npz") as file:
                found[folder.name] = sorted(folder.glob("*[01][0-9]h.bmp")), file["mask"]
        for first in sorted((place / "data/recordings/2").glob("*00h.bmp")):
            number = first.name[:2]
            steps = [first.with_name(f"{number}{k:02}h.bmp") for k in range(12)]
            # What somebody has drawn a mask for is in the other folder.
            if all(first.name not in [path.name for path in paths] for paths, _ in found.values()):
                found[f"cfpe_{number}"] = steps, None
    return found


def of_twelve(photographs):
    """Phase and modulation of one object by least squares over all steps."""
    steps = np.stack([cv2.imread(str(path), cv2.IMREAD_GRAYSCALE).astype(float) for path in photographs])
    turned = (steps * np.exp(-1j * methods.TAU * np.arange(12) / 12)[:, None, None]).mean(0)
    return np.angle(turned), 2 * np.abs(turned)


def halved(image):
    """Columns averaged in pairs."""
    pairs = image.reshape(image.shape[0], -1, 2).astype(np.uint16).sum(2)
    return ((pairs + 1) // 2).astype(np.uint8)


def halved_phase(phase):
    """Phase half-way between the columns of each pair."""
    return np.angle(np.exp(1j * phase[:, 0::2]) + np.exp(1j * phase[:, 1::2]))


def nominal_period(phase, mask):
    step = np.abs(methods.wrap(np.diff(phase, axis=1)))
    step = step[mask[:, 1:] & mask[:, :-1] & (step > 0.05)]
    return float(methods.TAU / np.median(step))


def score(image, phase, mask, inner, period, program):
    """Rows of figures by method."""
    found = {"fourdbody": ours(program, image, period)}
    for name, method in methods.DEMODULATIONS.items():
        found[name] = method(image, period)
    known = mask & np.isfinite(found["fourdbody"])
    rows = {}
    for name, wrapped in found.items():
        error = methods.phase_error(wrapped, phase, mask)
        rows[name] = methods.figures(error, mask)
        for key, where in (("where_ours", known), ("inner", inner)):
            rows[name][f"rms_{key}_rad"] = methods.figures(error, where)["rms_rad"]
            rows[name][f"robust_{key}_rad"] = methods.figures(error, where)["robust_rad"]
        rows[name]["inner_coverage"] = methods.figures(error, inner)["coverage"]
    return rows


def mean_rows(all_rows):
    """Root of the mean square of errors, mean of the rest, over photographs."""
    result = {}
    for name in all_rows[0]:
        keys = all_rows[0][name]
        values = {key: np.array([rows[name][key] for rows in all_rows]) for key in keys}
        square = lambda x: float(np.sqrt(np.mean(x**2)))
        result[name] = {k: square(v) if k.startswith("rms") else float(v.mean()) for k, v in values.items()}
    return result


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--data", type=Path, nargs="+", required=True)
    parser.add_argument("--ours", required=True)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    report = {}
    for object_name, (photographs, mask) in objects(args.data).items():
        phase, modulation = of_twelve(photographs)
        mask = modulation >= DARK if mask is None else mask
        for name, half in (("as it is", False), ("columns in pairs", True)):
            true = halved_phase(phase) if half else phase
            where = mask[:, 0::2] & mask[:, 1::2] if half else mask
            period = nominal_period(true, where)
            # More than a fringe away from where the mask ends: no method's window reaches out of it there.
            inner = cv2.erode(where.astype(np.uint8), np.ones((3, 2 * round(period) + 1))) > 0
            rows = []
            for k, path in enumerate(photographs):
                image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
                image = halved(image) if half else image
                shifted = methods.wrap(true + methods.TAU * k / 12)
                rows.append(score(image, shifted, where, inner, period, args.ours))
            mean = mean_rows(rows)
            report[f"{object_name}, {name}"] = {
                "photographs": len(rows), "period_px": period, "mask_px": int(where.sum()), "inner_px": int(inner.sum()),
                "methods": mean,
            }
            print(f"\n{object_name}, {name}: {len(rows)} photographs, period {period:.1f} px, {where.sum()} px of mask, {inner.sum()} inner")
            print(f"{'':<30} {'rms':>7} {'robust':>7} {'p95':>7} {'cover %':>8} | {'where ours: rms':>15} {'robust':>7} | {'inner: rms':>10} {'robust':>7} {'cover %':>8}")
            for method, row in mean.items():
                print(
                    f"{method:<30} {row['rms_rad']:>7.4f} {row['robust_rad']:>7.4f} {row['p95_rad']:>7.4f} {100 * row['coverage']:>8.2f} | "
                    f"{row['rms_where_ours_rad']:>15.4f} {row['robust_where_ours_rad']:>7.4f} | "
                    f"{row['rms_inner_rad']:>10.4f} "
                    f"{row['robust_inner_rad']:>7.4f} {100 * row['inner_coverage']:>8.2f}"
                )
    args.out.write_text(json.dumps(report, indent=2) + "\n")


main()
