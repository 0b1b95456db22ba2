#!/usr/bin/env python3
# SPDX-License-Identifier: MIT OR Apache-2.0
"""Films a console in Chromium, as README.md shows it: `make lab` in one terminal, this in another.

    film_console.py URL OUT.webp [SECONDS]

Needs Debian's chromium, chromium-driver and python3-pil.
"""

import base64
import io
import sys
import time

from chromium import Chromium
from PIL import Image

URL, OUT = sys.argv[1:3]
SECONDS = float(sys.argv[3]) if len(sys.argv) > 3 else 8.0
VIEW = {"width": 1600, "height": 900, "deviceScaleFactor": 1, "mobile": False}
SHOWN_WIDTH = 1120


def main():
    pictures, times = [], []
    with Chromium(["--window-size=1600,1000"]) as browser:
        browser.ask("POST", "/goog/cdp/execute", {"cmd": "Emulation.setDeviceMetricsOverride", "params": VIEW})
        browser.open(URL)
        begin = time.monotonic()
        while browser.run("return document.getElementById('live-body').classList.contains('none')") and time.monotonic() - begin < 60:
            time.sleep(0.2)
        print(f"a body turns {time.monotonic() - begin:.1f} s after the page was opened")
        begin = time.monotonic()
        while time.monotonic() - begin < SECONDS:
            png = base64.b64decode(browser.ask("GET", "/screenshot"))
            picture = Image.open(io.BytesIO(png)).convert("RGB")
            height = round(picture.height * SHOWN_WIDTH / picture.width)
            pictures.append(picture.resize((SHOWN_WIDTH, height), Image.LANCZOS))
            times.append(time.monotonic())
            # The nodes and the browser share this host's processors with the camera.
            time.sleep(0.2)
    each = [round(1000 * (b - a)) for a, b in zip(times, times[1:])] or [1000]
    each.append(each[-1])
    pictures[0].save(OUT, save_all=True, append_images=pictures[1:], duration=each, loop=0, quality=60, method=4)
    print(f"{OUT}: {len(pictures)} pictures, {sum(each) / 1000:.1f} s")


if __name__ == "__main__":
    main()
