# SPDX-License-Identifier: MIT OR Apache-2.0
"""What `scripts/bench-reconstruct.sh` measured, as a table and as one flat JSON object."""

import argparse
import json
import os
import re
import statistics
from pathlib import Path


def machine():
    """Processor and number of cores."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return f"{(names or ['unknown processor'])[0]}, {os.cpu_count()} cores"


def runs_of(folder, kind, scene):
    paths = sorted(folder.glob(f"{kind}.{scene}.*.json"))
    return [json.loads(path.read_text()) for path in paths]


def per_frame(run, key="frame_ms"):
    return run["timings"][key] / max(run["timings"]["frames"], 1)


def median_and_least(summary, key, values):
    summary[key] = statistics.median(values)
    summary[f"{key}_least"] = min(values)


def slope_and_base(pairs):
    """Least squares of ms on million pixels: ms for each, and ms without any."""
    n = len(pairs)
    mean_x, mean_y = (sum(p[i] for p in pairs) / n for i in (0, 1))
    spread = sum((x - mean_x) ** 2 for x, _ in pairs)
    slope = sum((x - mean_x) * (y - mean_y) for x, y in pairs) / spread if spread > 0 else float("nan")
    return slope, mean_y - slope * mean_x


def points_per_frame(args, scene):
    made = json.loads((args.runs / f"{scene}.summary").read_text())
    frames = [frame for trigger in made["triggers"] for frame in trigger["frames"]]
    return sum(frame["points"] for frame in frames) / made["frames"]


def add_scene(summary, args, scene):
    """Time of one scene beside the number of its points; views without any (the back of a board) are frames, too."""
    runs = runs_of(args.runs, "one", scene)
    median_and_least(summary, f"{scene}_ms_per_frame_1_thread", [per_frame(run) for run in runs])
    summary[f"{scene}_points_per_frame"] = points_per_frame(args, scene)


def add_body(summary, args):
    """The keys that others rely on."""
    body = args.body
    runs = runs_of(args.runs, "one", body)
    score = json.loads((args.scores / f"{body}.json").read_text())["directional"]
    median_and_least(summary, "pipeline_ms_per_frame_1_thread", [per_frame(run) for run in runs])
    median_and_least(summary, "process_cpu_ms_per_frame_1_thread", [1e3 * sum(r["cpu_s"]) / r["timings"]["frames"] for r in runs])
    for stage in runs[0]["timings"]["stage_ms"]:
        values = [run["timings"]["stage_ms"].get(stage, 0.0) / run["timings"]["frames"] for run in runs]
        summary[f"stage_{stage}_ms"] = statistics.median(values)
    # Freeing memory, and what else lies between the stages.
    summary["stage_other_ms"] = statistics.median(per_frame(run) - per_frame(run, "total_ms") for run in runs)
    two = [run["timings"]["frames"] / (1e-3 * run["timings"]["wall_ms"]) for run in runs_of(args.runs, "two", body)]
    one = [run["timings"]["frames"] / (1e-3 * run["timings"]["wall_ms"]) for run in runs]
    summary["frames_per_s_2_threads"] = statistics.median(two)
    summary["frames_per_s_2_threads_most"] = max(two)
    summary["frames_per_s_1_thread"] = statistics.median(one)
    summary["scaling_2_threads"] = max(two) / max(one)
    # From nothing: what a preview of one instant waits for.
    for kind in ("first_1_thread", "first_2_threads"):
        median_and_least(summary, f"frame_set_{kind}_ms", [run["timings"]["wall_ms"] for run in runs_of(args.runs, kind, body)])
    for kind in ("portable", "avx2", "avx512"):
        values = [per_frame(run) for run in runs_of(args.runs, kind, body)]
        if values:
            median_and_least(summary, f"pipeline_{kind}_ms_per_frame_1_thread", values)
    summary["points_per_frame"] = points_per_frame(args, body)
    summary["body_robust_mm"] = score["robust_mm"]
    summary["body_p95_mm"] = score["p95_mm"]
    for figure in ("completeness_of_lit", "wrong_order_share"):
        summary[figure] = score[figure]
    for row in score["by_modulation"]:
        if row["min_modulation_dn"] == 4.0:
            summary["completeness_of_usable"] = row["completeness"]
            summary["completeness_of_usable_whole_fringes"] = row["whole_completeness"]


def word(text):
    return re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_")


def add_peers(summary, path):
    """Ratio of the others' time to ours on the part that both do, from the least times of the same run."""
    report = json.loads(path.read_text())
    summary["memory_copy_gb_per_s"] = report["memory_copy_gb_per_s"]
    for frame in report["frames"]:
        for part in ("demodulation", "unwrapping"):
            rows = frame[part]
            ours = next(row for name, row in rows.items() if name.startswith("fourdbody"))
            for name, row in rows.items():
                key = f"peer_{frame['scene']}_{part}_{word(name.split('(')[0])}"
                summary[f"{key}_ms"] = row["least_ms"]
                summary[f"{key}_time_to_ours"] = row["least_ms"] / ours["least_ms"]
                for figure in ("rms_rad", "robust_rad", "right_order_share"):
                    if figure in row:
                        summary[f"{key}_{figure}"] = row[figure]


def main():
    parser = argparse.ArgumentParser()
    for name in ("runs", "scores", "peers", "out"):
        parser.add_argument(f"--{name}", type=Path, required=True)
    parser.add_argument("--body", required=True)
    parser.add_argument("--commit", required=True)
    args = parser.parse_args()
    # As the bench looks for them.
    places = [Path("config/scenarios", folder, f"{args.body}.toml") for folder in ("poses", ".")]
    scenario = next(path for path in places if path.exists())
    seed = int(re.search(r"^seed = (\d+)", scenario.read_text(), re.M).group(1))
    summary = {"commit": args.commit, "machine": machine(), "seed": seed, "load_1_min": os.getloadavg()[0]}
    summary["repetitions"] = len(runs_of(args.runs, "one", args.body))
    add_body(summary, args)
    scenes = sorted(path.stem for path in args.runs.glob("*.summary"))
    for scene in scenes:
        add_scene(summary, args, scene)
    pairs = [(1e-6 * summary[f"{s}_points_per_frame"], summary[f"{s}_ms_per_frame_1_thread_least"]) for s in scenes]
    if len(pairs) > 1:
        summary["ms_per_million_points"], summary["ms_per_frame_without_points"] = slope_and_base(pairs)
    if args.peers.exists():
        add_peers(summary, args.peers)
    args.out.write_text(json.dumps(summary, indent=2) + "\n")
    for key, value in summary.items():
        print(f"{key:<72} {value:.4g}" if isinstance(value, float) else f"{key:<72} {value}")


main()
