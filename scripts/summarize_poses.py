# SPDX-License-Identifier: MIT OR Apache-2.0
"""The scores of all poses as one table, and as one flat JSON object."""

import argparse
import json
import os
from pathlib import Path


def machine():
    """Processor and number of cores."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return f"{(names or ['unknown processor'])[0]}, {os.cpu_count()} cores"


class Sum:
    """Scores of several poses, added up by their counts. Quantiles cannot be added: the largest stands for all."""

    def __init__(self):
        self.points = self.wrong = self.lit = self.right = 0.0
        self.robust, self.p95 = [], []
        self.classes = {}

    def add(self, score):
        self.points += score["points"]
        self.wrong += score["wrong_order_share"] * score["points"]
        self.lit += score["lit_px"]
        self.right += score["completeness_of_lit"] * score["lit_px"]
        for values, key in ((self.robust, "robust_mm"), (self.p95, "p95_mm")):
            if score[key] is not None:
                values.append(score[key])
        for row in score["by_modulation"]:
            sums = self.classes.setdefault(row["min_modulation_dn"], [0.0] * 6)
            for i, prefix in ((0, ""), (3, "whole_")):
                pixels = row[prefix + "share_of_lit"] * score["lit_px"]
                right = row[prefix + "completeness"] * pixels
                share = row[prefix + "wrong_share"]
                sums[i] += pixels
                sums[i + 1] += right
                sums[i + 2] += right * share / (1.0 - share) if share < 1.0 else 0.0

    def figures(self):
        """Share of wrong points, of lit pixels and of usable pixels that have a right point."""
        usable = self.classes[USABLE_DN]
        return {
            "wrong_order_share": self.wrong / max(self.points, 1),
            "completeness_of_lit": self.right / max(self.lit, 1),
            "completeness_of_usable": usable[1] / max(usable[0], 1),
            "completeness_of_usable_whole_fringes": usable[4] / max(usable[3], 1),
            "robust_mm": max(self.robust, default=float("nan")),
            "p95_mm": max(self.p95, default=float("nan")),
        }

    def curve(self):
        """By modulation: bound, share of lit, complete, wrong; the same of whole fringes."""
        for bound, (n, right, wrong, n_whole, right_whole, wrong_whole) in sorted(self.classes.items()):
            yield bound, [
                n / max(self.lit, 1), right / max(n, 1), wrong / max(right + wrong, 1),
                n_whole / max(self.lit, 1), right_whole / max(n_whole, 1),
                wrong_whole / max(right_whole + wrong_whole, 1),
            ]


# `USABLE_DN` of crates/calibrate/src/validate/light.rs.
USABLE_DN = 4.0


def row(name, frames, total):
    f = total.figures()
    return (
        f"| {name} | {frames} | {total.points:.0f} | {100 * f['wrong_order_share']:.3f} "
        f"| {100 * f['completeness_of_lit']:.2f} | {100 * f['completeness_of_usable']:.2f} "
        f"| {100 * f['completeness_of_usable_whole_fringes']:.2f} | {f['robust_mm']:.3f} | {f['p95_mm']:.3f} |"
    )


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--scores", type=Path, required=True)
    parser.add_argument("--scenarios", type=Path, required=True)
    parser.add_argument("--method", required=True)
    parser.add_argument("--commit", required=True)
    parser.add_argument("--table", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    lines = [
        "| pose | frames | points | wrong % | of lit % | of usable % | of usable, whole fringe % | robust mm | p95 mm |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    summary = {"commit": args.commit, "machine": machine(), "method": args.method, "usable_modulation_dn": USABLE_DN}
    everything, all_frames = Sum(), 0
    kinds = sorted({path.name.split(".")[0] for path in args.scores.glob("*.json")})
    seeds = []
    for kind in kinds:
        total, frames = Sum(), 0
        for path in sorted(args.scores.glob(f"{kind}.*.json")):
            pose = path.name.split(".")[1]
            score = json.loads(path.read_text())
            scenario = (args.scenarios / f"{pose}.toml").read_text().splitlines()
            values = {line.split("=")[0].strip(): line.split("=")[1] for line in scenario if "=" in line}
            seeds.append(int(values["seed"]))
            count = int(values["instants"]) * len(score["cameras"])
            one = Sum()
            for sums in (one, total, everything):
                sums.add(score["directional"])
            frames += count
            lines.append(row(f"{pose}, {kind}", count, one))
            for key, value in one.figures().items():
                summary[f"{kind}_{pose}_{key}"] = value
        lines.append(row(f"**{kind}**", frames, total))
        summary[f"{kind}_frames"] = frames
        for key, value in total.figures().items():
            summary[f"{kind}_{key}"] = value
        all_frames += frames
    lines.append(row("**all**", all_frames, everything))
    summary["frames"] = all_frames
    summary["points"] = round(everything.points)
    summary["seed"] = min(seeds)
    summary.update(everything.figures())
    lines += [
        "",
        "| modulation at least | of lit % | complete % | wrong % | whole fringe: of lit % | complete % | wrong % |",
        "|---|---|---|---|---|---|---|",
    ]
    for bound, values in everything.curve():
        a, b, c, d, e, f = (100 * value for value in values)
        lines.append(f"| {bound:g} DN | {a:.2f} | {b:.2f} | {c:.3f} | {d:.2f} | {e:.2f} | {f:.3f} |")
        summary[f"completeness_from_{bound:g}_dn"] = values[1]
        summary[f"wrong_order_share_from_{bound:g}_dn"] = values[2]
    text = "\n".join(lines) + "\n"
    args.table.write_text(text)
    args.out.write_text(json.dumps(summary, indent=2) + "\n")
    print(text)


if __name__ == "__main__":
    main()
