# SPDX-License-Identifier: MIT OR Apache-2.0
"""The scores of `make light` as a table, and as one flat JSON object: the worst of each row's seeds."""

import argparse
import json
from pathlib import Path

from summarize_poses import Sum, machine


def ratio(score):
    """Robust error of all points over their predicted uncertainty."""
    return [row["ratio"] for row in score.get("uncertainty", []) if row["by"] == "all"]


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--scores", type=Path, required=True)
    parser.add_argument("--commit", required=True)
    parser.add_argument("--table", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    rows = {}
    for path in sorted(args.scores.glob("*.json")):
        row, seed = path.name.removesuffix(".json").split(".")
        rows.setdefault(row, {})[int(seed)] = json.loads(path.read_text())
    summary = {"commit": args.commit, "machine": machine(), "seed": 1}
    lines = [
        "| row | runs | refused | wrong % | of whole fringes % | robust mm | p95 mm | error over prediction |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row, seeds in rows.items():
        figures, ratios, refused = [], [], 0
        for score in seeds.values():
            if score.get("refused") or score["directional"]["points"] == 0:
                refused += 1
                continue
            total = Sum()
            total.add(score["directional"])
            figures.append(total.figures())
            ratios += ratio(score)
        worst = {
            "wrong_share": max((f["wrong_order_share"] for f in figures), default=0.0),
            # What is refused has no wrong point, and is not complete.
            "complete": 0.0 if refused else min(f["completeness_of_usable_whole_fringes"] for f in figures),
            "robust_mm": max((f["robust_mm"] for f in figures), default=None),
            "p95_mm": max((f["p95_mm"] for f in figures), default=None),
            "uncertainty_ratio_least": min(ratios, default=None),
            "uncertainty_ratio_most": max(ratios, default=None),
        }
        for key, value in worst.items():
            summary[f"{row}_{key}"] = value
        summary[f"{row}_runs"], summary[f"{row}_refused"] = len(seeds), refused
        cells = ["" if value is None else value for value in worst.values()]
        wrong, complete, robust, p95, least, most = cells
        if figures:
            wrong, complete = f"{100 * wrong:.3f}", f"{100 * complete:.2f}"
            robust, p95 = f"{robust:.3f}", f"{p95:.3f}"
        spread = f"{least:.2f} to {most:.2f}" if ratios else ""
        lines.append(f"| {row} | {len(seeds)} | {refused} | {wrong} | {complete} | {robust} | {p95} | {spread} |")
    text = "\n".join(lines) + "\n"
    args.table.write_text(text)
    args.out.write_text(json.dumps(summary, indent=2) + "\n")
    print(text)


main()
