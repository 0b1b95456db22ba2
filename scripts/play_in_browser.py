#!/usr/bin/env python3
# SPDX-License-Identifier: MIT OR Apache-2.0
"""Opens a page that plays a session in Chromium, and notes what it costs.

    play_in_browser.py URL FRAME_SETS [SEEKS]

Prints one JSON object. `first_picture_ms`: from the begin of the navigation to the first picture. `early_seek_...`: by the
slider, to a random place, while the page is still being filled; `seek_...`: when all is there, each until the pixels are
read back. `browser_mib`: the most that all processes of the browser had at once (PSS), `renderer_mib` that of the page's,
`idle_mib` that of the browser without a page. Needs Debian's chromium and chromium-driver; standard library only.
"""

import json
import random
import sys
import threading
import time
from pathlib import Path

from chromium import Chromium

URL, FRAME_SETS = sys.argv[1], int(sys.argv[2])
SEEKS = int(sys.argv[3]) if len(sys.argv) > 3 else 50
PATIENCE_S = 1800
ARGUMENTS = ["--window-size=1366,900"]
SEEK = """
const [place, done] = arguments;
const root = document.getElementById("player");
const slider = root.querySelector("input[type=range]");
const gl = root.querySelector("canvas").getContext("webgl2");
const begin = performance.now();
delete root.dataset.drawn;
slider.value = String(place);
slider.dispatchEvent(new Event("input"));
const look = () => {
  if (!root.dataset.drawn) return setTimeout(look, 1);
  gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
  done(performance.now() - begin);
};
look();
"""


def processes(ancestor):
    """Process ids below `ancestor`, with their command lines."""
    parents = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            parents[int(stat.parent.name)] = int(stat.read_text().rsplit(")", 1)[1].split()[1])
        except OSError:
            pass
    below, grown = {ancestor}, True
    while grown:
        more = {pid for pid, parent in parents.items() if parent in below} - below
        below, grown = below | more, bool(more)
    return below - {ancestor}


def pss_mib(pid):
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith("Pss:")) / 1024
    except (OSError, StopIteration):
        return 0.0


def memory(driver):
    sizes = {pid: pss_mib(pid) for pid in processes(driver.pid)}
    return sum(sizes.values()), max(sizes.values(), default=0.0)


class Most(threading.Thread):
    """The most memory, as long as it runs."""

    def __init__(self, driver):
        super().__init__(daemon=True)
        self.driver, self.most, self.ended = driver, (0.0, 0.0), False

    def run(self):
        while not self.ended:
            self.most = tuple(map(max, self.most, memory(self.driver)))
            time.sleep(0.3)


def spread(name, times):
    times = sorted(times)
    return {f"{name}_median_ms": round(times[len(times) // 2], 1), f"{name}_most_ms": round(times[-1], 1)} if times else {}


def main():
    chance = random.Random(7)
    with Chromium(ARGUMENTS, PATIENCE_S, pageLoadStrategy="none") as browser:
        run, driver = browser.run, browser.driver
        browser.ask("POST", "/timeouts", {"script": PATIENCE_S * 1000})

        def wait(script):
            begin = time.monotonic()
            while not run(f"return Boolean({script})"):
                if time.monotonic() - begin > PATIENCE_S:
                    sys.exit(f"never: {script}")
                time.sleep(0.05)
            return time.monotonic() - begin

        def seek():
            place = chance.randrange(FRAME_SETS)
            return browser.ask("POST", "/execute/async", {"script": SEEK, "args": [place]})

        time.sleep(1)
        told = {"idle_mib": round(memory(driver)[0])}
        most = Most(driver)
        most.start()
        browser.open(URL)
        wait("document.getElementById('player')?.dataset.firstMs")
        told["first_picture_ms"] = float(run("return document.getElementById('player').dataset.firstMs"))
        # The frame sets of the report's page are its own; those of the console's are asked for.
        console = run("return location.protocol !== 'file:'")
        there = "document.getElementById('player').dataset.kept == " + str(FRAME_SETS) if console else "document.readyState === 'complete'"
        if console:
            told |= spread("early_seek", [seek() for _ in range(min(SEEKS, 20))])
        told["filled_s"] = round(wait(there), 1)
        told |= spread("seek", [seek() for _ in range(SEEKS)])
        speed = "const player = document.getElementById('player'); const [speed] = player.querySelectorAll('select');"
        run(speed + "speed.value = '1'; speed.dispatchEvent(new Event('change'))")
        seek_to_begin = "const slider = document.querySelector('#player input[type=range]'); slider.value = '0'; slider.dispatchEvent(new Event('input'));"
        run("window.seen = 0; new MutationObserver(() => window.seen++).observe(document.getElementById('player'), { attributeFilter: ['data-drawn'] });" + seek_to_begin)
        time.sleep(1)
        run("window.seen = 0; window.began = performance.now(); document.querySelector('.controls button').click()")
        wait("document.querySelector('.controls button').textContent === 'Play'")
        told["played_per_s"] = round(run("return 1000 * window.seen / (performance.now() - window.began)"), 1)
        most.ended = True
        most.join()
        told |= {"browser_mib": round(most.most[0]), "renderer_mib": round(most.most[1])}
    print(json.dumps(told))


main()
