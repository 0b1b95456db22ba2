#!/usr/bin/env python3
# SPDX-License-Identifier: MIT OR Apache-2.0
"""Films a console in Chromium, as README.md shows it: `make lab` in one terminal, this in another.

    film_console.py URL OUT.webp [SECONDS] [record]

With `record` it presses Record once the pictures are live. Needs Debian's chromium, chromium-driver and python3-pil.
"""

import base64
import io
import json
import subprocess
import sys
import time
import urllib.request

from PIL import Image

URL, OUT = sys.argv[1:3]
SECONDS = float(sys.argv[3]) if len(sys.argv) > 3 else 8.0
RECORD = "record" in sys.argv[3:]
TOLD = "ChromeDriver was started successfully on port "
ARGUMENTS = ["--headless=new", "--no-sandbox", "--enable-unsafe-swiftshader", "--window-size=1600,1000", "--accept-lang=en-US"]
VIEW = {"width": 1600, "height": 900, "deviceScaleFactor": 1, "mobile": False}
SHOWN_WIDTH = 1120


def ask(base, method, path, body=None):
    data = None if body is None else json.dumps(body).encode()
    request = urllib.request.Request(base + path, data, {"content-type": "application/json"}, method=method)
    with urllib.request.urlopen(request, timeout=60) as answer:
        return json.load(answer)["value"]


def main():
    driver = subprocess.Popen(["chromedriver", "--port=0"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    pictures, times = [], []
    try:
        port = next(line.strip()[len(TOLD):].rstrip(".") for line in driver.stdout if line.startswith(TOLD))
        base = f"http://127.0.0.1:{port}"
        wanted = {"capabilities": {"alwaysMatch": {"goog:chromeOptions": {"args": ARGUMENTS}}}}
        base += "/session/" + ask(base, "POST", "/session", wanted)["sessionId"]
        run = lambda script: ask(base, "POST", "/execute/sync", {"script": script, "args": []})
        ask(base, "POST", "/goog/cdp/execute", {"cmd": "Emulation.setDeviceMetricsOverride", "params": VIEW})
        ask(base, "POST", "/url", {"url": URL})
        begin = time.monotonic()
        while run("return document.getElementById('live-body').className") != "" and time.monotonic() - begin < 60:
            time.sleep(0.2)
        print(f"a body turns {time.monotonic() - begin:.1f} s after the page was opened")
        if RECORD:
            run("document.getElementById('start').click()")
        begin = time.monotonic()
        while time.monotonic() - begin < SECONDS:
            png = base64.b64decode(ask(base, "GET", "/screenshot"))
            picture = Image.open(io.BytesIO(png)).convert("RGB")
            height = round(picture.height * SHOWN_WIDTH / picture.width)
            pictures.append(picture.resize((SHOWN_WIDTH, height), Image.LANCZOS))
            times.append(time.monotonic())
            # The nodes and the browser share this host's processors with the camera.
            time.sleep(0.2)
        ask(base, "DELETE", "")
    finally:
        driver.kill()
    each = [round(1000 * (b - a)) for a, b in zip(times, times[1:])] or [1000]
    each.append(each[-1])
    pictures[0].save(OUT, save_all=True, append_images=pictures[1:], duration=each, loop=0, quality=60, method=4)
    print(f"{OUT}: {len(pictures)} pictures, {sum(each) / 1000:.1f} s")


if __name__ == "__main__":
    main()
