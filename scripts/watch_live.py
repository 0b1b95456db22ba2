#!/usr/bin/env python3
# SPDX-License-Identifier: MIT OR Apache-2.0
"""Looks at a console in Chromium and notes each picture of the live body that it draws.

    watch_live.py PORT SECONDS

Prints one JSON object: pictures drawn, their rate from the first to the last, the time from the arrival of the light's
frame at the node to the picture (median and P99, ms), cameras and points of the last. Needs Debian's chromium and
chromium-driver; standard library only.
"""

import json
import sys
import time

from chromium import Chromium

PORT, SECONDS = int(sys.argv[1]), float(sys.argv[2])
# Without motion the page draws when a frame set comes, and not sixty times a second.
ARGUMENTS = ["--window-size=1366,900", "--force-prefers-reduced-motion"]
WATCH = """
window.drawn = [];
const canvas = document.getElementById("live-canvas");
new MutationObserver(() => window.drawn.push([performance.now(), Number(canvas.dataset.light_to_screen_ms),
    Number(canvas.dataset.cameras), Number(canvas.dataset.points)])).observe(canvas, { attributeFilter: ["data-light_to_screen_ms"] });
"""


def main():
    with Chromium(ARGUMENTS) as browser:
        browser.open(f"http://127.0.0.1:{PORT}/")
        browser.run(WATCH)
        time.sleep(SECONDS)
        drawn = browser.run("return window.drawn")
    # The first ones come while tables are made and the shader is compiled.
    drawn = drawn[3:]
    ages = sorted(age for _, age, _, _ in drawn)
    span_s = (drawn[-1][0] - drawn[0][0]) / 1000 if len(drawn) > 1 else 0
    print(json.dumps({
        "pictures": len(drawn),
        "per_s": round((len(drawn) - 1) / span_s, 2) if span_s else 0.0,
        "median_ms": round(ages[len(ages) // 2], 1) if ages else None,
        "p99_ms": round(ages[min(len(ages) - 1, int(len(ages) * 0.99))], 1) if ages else None,
        "cameras": drawn[-1][2] if drawn else 0,
        "points": drawn[-1][3] if drawn else 0,
    }))


main()
