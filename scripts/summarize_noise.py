# SPDX-License-Identifier: MIT OR Apache-2.0
"""How far wrong orders and completeness move with the seed of a little noise: a table, and one flat JSON object."""

import argparse
import json
import sys
from pathlib import Path

from summarize_poses import Sum, machine

# A pose whose completeness moves by more is a defect, points of a per cent.
MOST = 2.0


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--scores", type=Path, required=True)
    parser.add_argument("--noise-dn", type=float, required=True)
    parser.add_argument("--commit", required=True)
    parser.add_argument("--table", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    poses = {}
    for path in sorted(args.scores.glob("*.json")):
        battery, pose, seed = path.name.removesuffix(".json").split(".")
        total = Sum()
        total.add(json.loads(path.read_text())["directional"])
        poses.setdefault((battery, pose), {})[int(seed)] = total.figures()
    summary = {"commit": args.commit, "machine": machine(), "noise_dn": args.noise_dn}
    summary["seed"] = min(seed for seeds in poses.values() for seed in seeds if seed)
    lines = [
        "| pose | wrong %: as it is | with noise, least to most | complete %: as it is | with noise, least to most |",
        "|---|---|---|---|---|",
    ]
    moved = 0.0
    for (battery, pose), seeds in poses.items():
        cells = []
        for key in ("wrong_order_share", "completeness_of_usable_whole_fringes"):
            digits = 3 if key.startswith("wrong") else 2
            noisy = [100 * figures[key] for seed, figures in seeds.items() if seed]
            plain = 100 * seeds[0][key]
            cells += [f"{plain:.{digits}f}", f"{min(noisy):.{digits}f} to {max(noisy):.{digits}f}"]
            for name, value in (("plain", plain), ("least", min(noisy)), ("most", max(noisy))):
                summary[f"{battery}_{pose}_{key}_{name}"] = value / 100
        spread = max(plain, *noisy) - min(plain, *noisy)
        moved = max(moved, spread)
        lines.append(f"| {pose} | " + " | ".join(cells) + " |")
    summary["completeness_moves_most"] = moved / 100
    text = "\n".join(lines) + "\n"
    args.table.write_text(text)
    args.out.write_text(json.dumps(summary, indent=2) + "\n")
    print(text)
    if moved > MOST:
        print(f"error: completeness moves by {moved:.2f} points with the noise, {MOST} are allowed", file=sys.stderr)
        sys.exit(4)


main()
