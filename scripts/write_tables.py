#!/usr/bin/env python3
# SPDX-License-Identifier: MIT OR Apache-2.0
"""Writes the tables of README.md, docs/validation.md and docs/benchmarks.md from target/*/summary.json.

A table stands between `<!-- table: TARGET [KEY=VALUE...] -->` and `<!-- end -->`: `make TARGET KEY=VALUE...` leaves
the summary. A table whose summary is absent stays as it is. Every figure is rounded against us.

    scripts/write_tables.py                  # writes what has changed
    scripts/write_tables.py --check          # only says so: exit code 1
    scripts/write_tables.py --targets        # prints the `make` targets of all tables
    scripts/write_tables.py --target DIR     # summaries of another checkout
"""

import argparse
import json
import re
import subprocess
import sys
from decimal import ROUND_CEILING, ROUND_FLOOR, Decimal
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
DOCUMENTS = ["README.md", "docs/validation.md", "docs/benchmarks.md"]
BLOCK = re.compile(r"(<!-- table: ([^\n]*?) -->\n)(.*?)(<!-- end -->)", re.S)
# What the paper found, as in scripts/validate.sh.
PAPER = {
    "plane": "0.17, 0.22, 0.25, 0.23",
    "distance": "0.21, 0.27, 0.23, 0.23",
    "girth": "0.27, 0.38",
    "spacing": "1.5, 1.0",
}


def rounded(value, digits, rounding):
    return str(Decimal(value).quantize(Decimal(1).scaleb(-digits), rounding=rounding))


def most(value, digits):
    """What had better be small."""
    return rounded(value, digits, ROUND_CEILING)


def least(value, digits):
    """What had better be large."""
    return rounded(value, digits, ROUND_FLOOR)


def wrong(share):
    return most(100 * share, 3)


def complete(share):
    return least(100 * share, 2)


def table(head, rows):
    lines = [head, ["---"] * len(head), *rows]
    return "".join("| " + " | ".join(map(str, line)) + " |\n" for line in lines)


def poses(s):
    """A row a pose; where there are several markers, a figure of each."""
    kinds = [key[: -len("_frames")] for key in s if key.endswith("_frames")]

    def row(name, prefixes):
        def cell(key, show):
            return "; ".join(show(s[prefix + key]) for prefix in prefixes)

        shares = ["completeness_of_lit", "completeness_of_usable", "completeness_of_usable_whole_fringes"]
        distances = [cell(key, lambda v: most(v, 3)) for key in ("robust_mm", "p95_mm")]
        return [name, cell("wrong_order_share", wrong), *(cell(key, complete) for key in shares), *distances]

    names = (re.fullmatch(f"{kinds[0]}_(.+)_wrong_order_share", key) for key in s)
    rows = [row(name[1], [f"{kind}_{name[1]}_" for kind in kinds]) for name in names if name]
    if len(kinds) > 1:
        rows.append(row("**each marker**", [f"{kind}_" for kind in kinds]))
    rows.append(row(f"**all**, {s['frames']} frames", [""]))
    head = "pose" if len(kinds) == 1 else f"pose: {'; '.join(kinds)}"
    return table([head, "wrong %", "of lit %", "of usable %", "of whole fringes %", "robust mm", "p95 mm"], rows)


def geometry(s):
    """A row a rig."""
    head = ["rig", "points", "wrong %", "of whole fringes %", "robust mm"]
    rows = []
    for name, row in s["rows"].items():
        if row.get("robust_mm") is None:
            rows.append([name, 0, "", "", "refused"])
            continue
        percent = [most(row["wrong_percent"], 3), least(row["complete_percent"], 2)]
        rows.append([name, row["points"], *percent, most(row["robust_mm"], 3)])
    return table(head, rows)


def drift(s):
    """A row a change; for each scene what it is called, and the robust error before and after the correction."""
    def mm(score):
        if score is None:
            return "not written"
        return "refused" if score["robust_mm"] is None else most(score["robust_mm"], 3)

    scenes = s["scenes"]
    head = ["calibration", *(f"{name}: called; robust mm before, after" for name in scenes)]
    rows = []
    for change in next(iter(scenes.values())):
        found = [scene[change] for scene in scenes.values()]
        rows.append([change, *(f"{x['called']}; {mm(x['before'])}, {mm(x['after'])}" for x in found)])
    alarms = s["alarms"]
    text = (f"\nOf {alarms['frame_sets']} frame sets with noise and the true calibration {alarms['with_a_move']} are "
            f"explained by a move;\n`calibration check` ends with exit code 4 on {alarms['exit_4']}.\n")
    return table(head, rows) + text


def noise(s):
    """A column a pose, as it is and over the seeds of the noise."""
    names = [re.fullmatch(r"(.+)_wrong_order_share_plain", key) for key in s]
    names = [name[1] for name in names if name]
    rows = []
    for what, key, show in (
        ("wrong %", "wrong_order_share", wrong),
        ("of whole fringes %", "completeness_of_usable_whole_fringes", complete),
    ):
        plain, low, high = ([show(s[f"{name}_{key}_{end}"]) for name in names] for end in ("plain", "least", "most"))
        rows += [[what, *plain], ["with noise", *(f"{a} to {b}" for a, b in zip(low, high))]]
    return table(["", *(name.removeprefix("poses_").replace("_", " ") for name in names)], rows)


def light(s):
    """A row a scenario: the worst of its runs."""
    rows = []
    for name in (re.fullmatch(r"(.+)_runs", key) for key in s):
        if not name:
            continue
        row = name[1]
        refused = f"{s[f'{row}_refused']} of {s[f'{row}_runs']}"
        if s[f"{row}_robust_mm"] is None:
            rows.append([row, refused, "", "", "", "", ""])
            continue
        shares = [wrong(s[f"{row}_wrong_share"]), complete(s[f"{row}_complete"])]
        distances = [most(s[f"{row}_{key}"], 3) for key in ("robust_mm", "p95_mm")]
        ratios = [most(s[f"{row}_uncertainty_ratio_{end}"], 2) for end in ("least", "most")]
        rows.append([row, refused, *shares, *distances, " to ".join(ratios)])
    head = ["row", "refused", "wrong %", "of whole fringes %", "robust mm", "p95 mm", "error over prediction"]
    return table(head, rows)


def real(s):
    """A row an object: clouds of single photographs where there are two cameras, else phases."""
    rows = []
    for name in (re.fullmatch(r"(.+)_photographs_refused", key) for key in s):
        if not name:
            continue
        row = name[1]
        # Where every photograph is refused there is nothing to compare.
        worst = lambda key, digits: most(s[key], digits) if s.get(key) is not None else "-"
        both = [worst(f"{row}_{key}_robust", 2) for key in ("left_to_right_mm", "left_to_right_reference_mm")]
        phase = worst(f"{row}_phase_rad_robust", 3)
        refused = f"{s[f'{row}_photographs_refused']} of {s[f'{row}_photographs']}"
        shares = [wrong(s[f"{row}_wrong_order_share"]), complete(s[f"{row}_complete"])] if s[f"{row}_points"] else ["-", "-"]
        rows.append([row.replace("_", " "), refused, *shares, phase, *both])
    head = ["object", "refused", "wrong %", "of the reference %", "phase rad", "left to right mm", "the reference's mm"]
    text = table(head, rows) if rows else ""
    rows = []
    for name in (re.fullmatch(r"one_of_twelve_(.+)_fourdbody_rms_rad", key) for key in s):
        if not name:
            continue
        methods = [f"one_of_twelve_{name[1]}_{method}" for method in ("fourdbody", "scipy_fourier_of_rows")]
        errors = [
            most(s[f"{method}_{kind}_where_ours_rad"], 3) for kind in ("rms", "robust") for method in methods
        ]
        rows.append([name[1].replace("_", " "), complete(s[f"{methods[0]}_coverage"]), *errors])
    head = ["one of twelve", "of the mask %", "rms rad", "Fourier's", "robust rad", "Fourier's"]
    return text + ("\n" if text and rows else "") + (table(head, rows) if rows else "")


def demo(s):
    distances = ["merged_robust_mm", "merged_p95_mm", "merged_rms_mm", "merged_rms_right_order_mm"]
    return table(
        ["what", "found"],
        [
            ["frames recorded", f"{s['frames_recorded']} of {s['frames_expected']}, {s['gaps']} gaps"],
            ["points of a merged cloud", s["merged_points"]],
            ["wrong, of the merged points", f"{wrong(s['wrong_order_share'])} %"],
            ["robust, p95, RMS, RMS of right orders", ", ".join(most(s[key], 3) for key in distances) + " mm"],
            ["of the lit pixels, directional clouds", f"{complete(s['completeness_of_lit'])} %"],
        ],
    )


def validate(s):
    speeds = ("0rpm", "4rpm", "9rpm", "14rpm")

    def figures(digits, *keys):
        return ", ".join(most(s[key], digits) for key in keys)

    return table(
        ["what", "mm", "paper"],
        [
            ["plane, RMS at 0, 4, 9, 14 rpm", figures(4, *(f"plane_rms_mm_{v}" for v in speeds)), PAPER["plane"]],
            ["distance of marks, RMS at the same", figures(4, *(f"distance_rms_mm_{v}" for v in speeds)), PAPER["distance"]],
            ["girths, mean and most", figures(3, "girth_mean_mm", "girth_max_mm"), PAPER["girth"]],
            ["point spacing, one cloud and merged", figures(3, "spacing_cloud_mm", "spacing_merged_mm"), PAPER["spacing"]],
            ["calibration against the true rig, RMS and most", figures(4, "calibration_rms_mm", "calibration_max_mm"), ""],
        ],
    )


def bench_ingest(s):
    rows = []
    for name, end in (("node", ""), ("plain buffered `mcap`", "_buffered_mcap")):
        if f"frames_recorded{end}" in s:
            costs = ["node_cpu_cores", "node_cpu_s_per_gb", "simulator_cpu_cores", "write_p99_ms", "write_max_ms"]
            costs = [most(s[key + end], 3) if s.get(key + end) is not None else "" for key in costs]
            counts = [s[f"frames_recorded{end}"], s[f"gaps{end}"], *costs, s.get(f"ring_high_water_frames{end}", "")]
            rows.append([name, *counts])
    head = [f"{s['duration_s']} s at {s['trigger_rate_hz']} Hz", f"of {s['frames_expected']} frames", "gaps", "cores"]
    return table([*head, "s/GB", "simulator's cores", "write p99 ms", "most ms", "waiting at most"], rows)


def bench_reconstruct(s):
    rows = [["**a frame, one thread**", f"**{most(s['pipeline_ms_per_frame_1_thread'], 1)}**"]]
    for kind in ("portable", "avx2", "avx512"):
        key = f"pipeline_{kind}_ms_per_frame_1_thread"
        rows += [[f"the same, {kind}", most(s[key], 1)]] if key in s else []
    stages = [(s[key], key[len("stage_") : -len("_ms")]) for key in s if re.fullmatch("stage_.*_ms", key)]
    stages.sort(reverse=True)
    for name, of in (("stages of 1 ms and more", lambda ms: ms >= 1), ("other stages", lambda ms: ms < 1)):
        rows.append([name, ", ".join(f"{stage} {most(ms, 2)}" for ms, stage in stages if of(ms))])
    return table(["part", "ms a frame"], rows)


def bench_worker(s):
    rows = []
    for threads in (1, 2):
        end = f"_{threads}_threads"
        bare = s[f"bare_frame_sets_per_hour_per_core{end}"], s[f"bare_peak_memory_mib{end}"]
        rows.append([threads, "nothing", least(bare[0], 0), "", most(bare[1], 0)])
        for form in ("phase", "ply"):
            if f"worker_{form}_lost_percent{end}" in s:
                rate, lost, memory = (
                    s[f"worker_{form}_{key}{end}"]
                    for key in ("frame_sets_per_hour_per_core", "lost_percent", "peak_memory_mib")
                )
                rows.append([threads, form, least(rate, 0), most(lost, 1), most(memory, 0)])
    return table(["threads", "written", "frame sets an hour and core", "lost %", "most memory MiB"], rows)


def bench_live(s):
    rows = []
    for end in ("", "_full_rate"):
        rows.append([
            f"{s[f'cameras{end}']} cameras at {s[f'trigger_rate_hz{end}']} Hz",
            least(s[f"live_frame_sets_per_s{end}"], 1),
            most(s[f"light_to_screen_median_ms{end}"], 0),
            most(s[f"light_to_screen_p99_ms{end}"], 0),
            s[f"frames_recorded{end}"],
            s[f"frames_lost{end}"],
            most(s[f"node_cpu_cores{end}"], 2),
        ])
    end = "_full_rate_alone"
    rows.append([
        "the same, without a viewer", "", "", "", s[f"frames_recorded{end}"], s[f"frames_lost{end}"], most(s[f"node_cpu_cores{end}"], 2),
    ])
    return table(["", "frame sets a second", "light to screen ms", "P99 ms", "frames recorded", "lost", "nodes' cores"], rows)


def bench_before_record(s):
    row = [
        f"{s['before_s']} s at {s['trigger_rate_hz']} Hz", s["held_frame_sets"], s["held_mib"], s["after_mib"], s["triggers"],
        ", ".join(str(lost) for lost in s["frames_lost_of_each"]),
    ]
    return table(["", "frame sets held", "node's memory MiB", "after the session MiB", "triggers recorded", "frames lost, run by run"], [row])


def bench_play(s):
    rows = []
    for kind, name in (("page", "`report --play`, a file"), ("console", "the console's player")):
        of = lambda key: s.get(f"{kind}_{key}")
        early = f"{most(of('early_seek_median_ms'), 0)}, {most(of('early_seek_most_ms'), 0)}" if of("early_seek_median_ms") else "-"
        rows.append([
            name,
            most(of("browser_mib"), 0),
            most(of("renderer_mib"), 0),
            most(of("first_picture_ms") / 1000, 2),
            f"{most(of('seek_median_ms'), 0)}, {most(of('seek_most_ms'), 0)}",
            early,
            most(of("filled_s"), 0),
            least(of("played_per_s"), 1),
        ])
    head = ["", "browser MiB", "its page MiB", "first picture s", "seek ms, most", "not yet there ms, most", "all there s", "pictures a second at 1/1"]
    return table([f"{s['frame_sets']} frame sets", *head[1:]], rows)


def short(summaries, present):
    """README: a row whose summary is absent stays as it is."""
    rows = [
        ("wrong fringe orders, moving mannequins", "poses", lambda s: f"{wrong(s['wrong_order_share'])} % of the points"),
        (
            "well-lit pixels away from edges that become a point",
            "poses",
            lambda s: f"{complete(s['completeness_of_usable_whole_fringes'])} %",
        ),
        (
            "distance to the body: robust; 95th percentile",
            "poses",
            lambda s: f"{most(s['robust_mm'], 3)}; {most(s['p95_mm'], 3)} mm",
        ),
        (
            "a node at 4 x 120 Hz to disk for 20 s",
            "bench-ingest",
            lambda s: f"{s['frames_recorded']} of {s['frames_expected']} frames",
        ),
        (
            "a frame to its cloud, one thread with AVX2",
            "bench-reconstruct",
            lambda s: f"{most(s['pipeline_avx2_ms_per_frame_1_thread'], 1)} ms",
        ),
    ]
    found = dict(re.findall(r"^\| (.+?) \| (.+?) \|", present, re.M))
    cells, versions = [], {}
    for name, target, show in rows:
        summary = summaries(target)
        text = found.get(name, "") if summary is None else show(summary)
        constant = WRITERS[target][1]
        if summary is not None:
            versions[constant] = measured_with(constant, summary["commit"])
        cells.append([name, text, f"`make {target}`"])
    of = {constant: line for constant, line in zip(VERSIONS, re.findall(r"Measured with [^.]*\.", present))} | versions
    lines = "\n".join(of[constant] for constant in VERSIONS if constant in of)
    return table(["in short", "found", "by"], cells) + (f"\n{lines}\n" if lines else "")


def git(*words):
    return subprocess.run(["git", "-C", str(ROOT), *words], capture_output=True, text=True, check=False)


def number(name, commit):
    """The value of a constant in a commit's code; none where git does not know the commit or the constant."""
    found = git("grep", "-hoE", f"pub const {name}: u32 = [0-9]+", commit, "--", "src", "crates", ":!*/paper").stdout
    return found.rsplit(" ", 1)[-1].strip() or None


# What decides figures, by its constant in the code; tests/it/documents.rs compares these with what documents say.
VERSIONS = {"ALGORITHM": "algorithm", "INGEST": "way to the disk"}


def measured_with(constant, commit):
    """The line of a table that says which version it is of."""
    return f"Measured with {VERSIONS[constant]} {number(constant, commit) or 'unknown'}."


# By target, with the constant that decides its figures.
WRITERS = {
    "poses": (poses, "ALGORITHM"),
    "geometry": (geometry, "ALGORITHM"),
    "drift": (drift, "ALGORITHM"),
    "light": (light, "ALGORITHM"),
    "noise": (noise, "ALGORITHM"),
    "real": (real, "ALGORITHM"),
    "demo": (demo, "ALGORITHM"),
    "validate": (validate, "ALGORITHM"),
    "bench-ingest": (bench_ingest, "INGEST"),
    "bench-reconstruct": (bench_reconstruct, "ALGORITHM"),
    "bench-worker": (bench_worker, "ALGORITHM"),
    "bench-live": (bench_live, "ALGORITHM"),
    "bench-before-record": (bench_before_record, "INGEST"),
    "bench-play": (bench_play, "ALGORITHM"),
}


def targets():
    """What `make` measures for the documents, each once; the demo first, as others use its light."""
    blocks = [block[2] for document in DOCUMENTS for block in BLOCK.finditer((ROOT / document).read_text())]
    found = dict.fromkeys(block for block in blocks if block != "short")
    return sorted(found, key=lambda target: target != "demo")


def write(words, present, target_dir):
    """The text of a block, or `None` where it stays."""

    def summary(folder):
        path = target_dir / folder / "summary.json"
        figures = json.loads(path.read_text(), parse_float=Decimal) if path.exists() else None
        # Runs of another method, rate or duration are somebody's experiment.
        usual = {"trigger_rate_hz": 120, "duration_s": 20} if folder == "bench-ingest" else {"method": "joint"}
        odd = figures and any(figures.get(key, value) != value for key, value in usual.items())
        return None if odd else figures

    if words == ["short"]:
        return short(summary, present)
    settings = dict(word.split("=", 1) for word in words if "=" in word)
    name = " ".join(word for word in words if "=" not in word)  # one word, or unknown
    if name not in WRITERS:
        sys.exit(f"error: expected a table of {', '.join(WRITERS)} or short, found {name!r}: add it to {__file__}")
    # scripts/poses.sh names its folder after the battery.
    figures = summary(settings.get("BATTERY", name))
    if figures is None:
        return None
    writer, constant = WRITERS[name]
    try:
        return f"{writer(figures)}\n{measured_with(constant, figures['commit'])}\n"
    except KeyError as missing:
        sys.exit(f"error: {target_dir}/{name}: expected {missing} in its summary: run `make {name}` again")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing; exit code 1 where a table would change")
    parser.add_argument("--targets", action="store_true", help="print what `make` measures for them, and write nothing")
    parser.add_argument("--target", type=Path, default=ROOT / "target", help="where the summaries are")
    args = parser.parse_args()
    if args.targets:
        print("\n".join(targets()))
        return
    changed = []
    for document in DOCUMENTS:
        path = ROOT / document

        def replaced(block):
            text = write(block[2].split(), block[3], args.target)
            if text is not None and text != block[3]:
                changed.append(f"{document}: {block[2]}")
            return block[1] + (block[3] if text is None else text) + block[4]

        before = path.read_text()
        after = BLOCK.sub(replaced, before)
        if not args.check and after != before:
            path.write_text(after)
    print("\n".join(changed) or "every table is as its summary says, or has none")
    sys.exit(1 if args.check and changed else 0)


if __name__ == "__main__":
    main()
