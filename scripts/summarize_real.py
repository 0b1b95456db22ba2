# SPDX-License-Identifier: MIT OR Apache-2.0
"""What `make real` found, as a table and as one flat JSON object. Without any photographs there is nothing to say: exit 1."""

import argparse
import json
import re
import sys
from pathlib import Path

from summarize_poses import machine
from write_tables import real


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--commit", required=True)
    args = parser.parse_args()
    summary = {"commit": args.commit, "machine": machine(), "seed": 0}
    sets = {name: args.out / f"{name}.json" for name in ("bsc", "cfpe")}
    found = {name: json.loads(path.read_text()) for name, path in sets.items() if path.exists()}
    if not found:
        sys.exit("error: expected at least one set of photographs, found none: see the lines above")
    for name, row in found.get("bsc", {}).items():
        for key, value in row.items():
            figures = value if isinstance(value, dict) else {"": value}
            for figure, number in figures.items():
                summary[f"{name}_{key}_{figure}".rstrip("_")] = number
    for name, row in found.get("cfpe", {}).items():
        for method, figures in row["methods"].items():
            for figure in ("rms_rad", "robust_rad", "coverage", "rms_where_ours_rad", "robust_where_ours_rad"):
                word = re.sub(r"\W+", "_", f"{name}_{method}").lower()
                summary[f"one_of_twelve_{word}_{figure}"] = figures[figure]
    (args.out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    text = real(summary)
    (args.out / "table.md").write_text(text)
    print(text)


main()
