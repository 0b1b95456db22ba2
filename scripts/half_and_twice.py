#!/usr/bin/env python3
# SPDX-License-Identifier: MIT OR Apache-2.0
"""What half and twice of each constant of the fringe orders does: a table, and one flat JSON object.

Builds the program once for each, in a copy of the sources below target/half_and_twice, and scores it on light that
`scripts/poses.sh` has left. Two minutes a constant and two cores: name some with --only.
"""

import argparse
import json
import os
import re
import shutil
import subprocess
from pathlib import Path

from summarize_poses import Sum, machine

ROOT = Path(__file__).resolve().parent.parent
WHERE = ROOT / "target/half_and_twice"
SOURCES = "crates/reconstruct/src/fringe_order"

# Name in docs/design/fringe-order.md: file, and what stands before its numbers (all of these are changed together).
CONSTANTS = {
    "INNER_RAD": ("patches.rs", r"const INNER_RAD: f32 = "),
    "STEP_RAD": ("links.rs", r"const STEP_RAD: f32 = "),
    "PLANES": ("links.rs", r"const PLANES: f32 = "),
    "PAIR": ("links.rs", r"const PAIR: f32 = "),
    "PAIR_RAD": ("links.rs", r"const PAIR_RAD: f32 = "),
    "widths": ("evidence.rs", r"width_rad: "),
    "shares": ("evidence.rs", r"share: (?=\d)"),
    "past": ("evidence.rs", r"past: (?=\d)"),
    "before": ("evidence.rs", r"before: (?=\d)"),
    "EVIDENCE": ("evidence.rs", r"const EVIDENCE: f32 = "),
    "MARKER": ("inference.rs", r"const MARKER: f32 = "),
    "MARKER_MOST": ("inference.rs", r"const MARKER_MOST: f32 = "),
    "WIDER": ("evidence.rs", r"const WIDER: f32 = "),
    "DIM": ("evidence.rs", r"const DIM: f32 = "),
    "LEAST_PX": ("evidence.rs", r"const LEAST_PX: u32 = "),
    "SAMPLE": ("evidence.rs", r"const SAMPLE: u32 = "),
    "KEEP": ("evidence.rs", r"const KEEP: f32 = "),
    "SURE": ("evidence.rs", r"const SURE: f32 = "),
    "SWEEPS": ("mod.rs", r"const SWEEPS: usize = "),
    "STRONG": ("squares.rs", r"const STRONG: f32 = "),
    "CONTRADICTION_RAD": ("same_head.rs", r"const CONTRADICTION_RAD: f32 = "),
    "ENOUGH": ("witness.rs", r"const ENOUGH: f32 = "),
    "BEYOND_GAP_RAD": ("witness.rs", r"const BEYOND_GAP_RAD: f32 = "),
    "CERTAIN": ("mod.rs", r"const CERTAIN: f32 = "),
    "MARGIN": ("mod.rs", r"const MARGIN: f32 = "),
}


def run(*command, **options):
    return subprocess.run([str(word) for word in command], check=True, capture_output=True, text=True, **options)


def changed(text, before, factor):
    """The text with all numbers behind `before` times the factor; whole ones stay whole, and are at least 1."""

    def times(found):
        number = found.group(2)
        value = float(number) * factor
        return found.group(1) + (f"{value:.6g}" if "." in number and value % 1 else f"{value:.1f}" if "." in number
                                 else str(max(1, round(value))))

    text, count = re.subn(rf"({before})(\d+(?:\.\d+)?)", times, text)
    assert count, f"{before} is not there any more"
    return text


def build():
    options = {"CARGO_TARGET_DIR": str(WHERE / "build"), "CARGO_PROFILE_RELEASE_DEBUG": "0"}
    run("cargo", "build", "--release", "-p", "fourdbody", "--bin", "fourdbody", "--no-default-features",
        cwd=WHERE / "sources", env=os.environ | options)


def score(lights):
    total = Sum()
    program, out = WHERE / "build/release/fourdbody", WHERE / "result"
    for light in lights:
        shutil.rmtree(out, ignore_errors=True)
        images = WHERE / "images" / light.parent.name
        command = [program, "reconstruct", images, "--calibration", light / "calibration.json", "--out", out]
        code = subprocess.run([str(word) for word in command], capture_output=True).returncode
        assert code in (0, 3, 4), f"reconstruct ended with {code}"
        told = run(program, "validate", "truth", "--clouds", out, "--truth", light / "truth", "--images", images, "--json")
        total.add(json.loads(told.stdout)["directional"])
    figures = total.figures()
    return figures["wrong_order_share"], figures["completeness_of_usable_whole_fringes"]


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="*", default=list(CONSTANTS), choices=list(CONSTANTS), metavar="NAME")
    parser.add_argument("--lights", nargs="*", type=Path, default=sorted((ROOT / "target/poses/zero_mean").glob("*/light")))
    args = parser.parse_args()
    assert args.lights, "no light: run scripts/poses.sh first"
    sources = WHERE / "sources"
    shutil.rmtree(sources, ignore_errors=True)
    files = run("git", "ls-files", cwd=ROOT).stdout.split()
    for file in files:
        if (ROOT / file).is_file():
            (sources / file).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / file, sources / file)
    for light in args.lights:
        images = WHERE / "images" / light.parent.name
        run(ROOT / "target/release/fourdbody-sim", "export-png", "--frames", light, "--out", images)
    build()
    plain = score(args.lights)
    commit = run("git", "rev-parse", "HEAD", cwd=ROOT).stdout.strip()
    summary = {"commit": commit, "machine": machine(), "wrong_share": plain[0], "complete": plain[1]}
    lines = ["| constant | half: wrong, complete % | twice: wrong, complete % |", "|---|---|---|",
             f"| as they are | {100 * plain[0]:.3f}, {100 * plain[1]:.2f} | |"]
    for name in args.only:
        file, before = CONSTANTS[name]
        path = sources / SOURCES / file
        text = path.read_text()
        cells = []
        for word, factor in (("half", 0.5), ("twice", 2.0)):
            path.write_text(changed(text, before, factor))
            build()
            wrong, complete = score(args.lights)
            summary[f"{name.lower()}_{word}_wrong_share"], summary[f"{name.lower()}_{word}_complete"] = wrong, complete
            cells.append(f"{100 * wrong:.3f}, {100 * complete:.2f}")
        path.write_text(text)
        lines.append(f"| `{name}` | {cells[0]} | {cells[1]} |")
        print(lines[-1], flush=True)
        (WHERE / "table.md").write_text("\n".join(lines) + "\n")
        (WHERE / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    print("\n".join(lines))


main()
