# SPDX-License-Identifier: MIT OR Apache-2.0
"""A headless Chromium, driven over WebDriver (W3C) by Debian's chromium-driver; standard library only."""

import json
import subprocess
import urllib.request

TOLD = "ChromeDriver was started successfully on port "
# Scripts compare English words, whatever the machine speaks.
ARGUMENTS = ["--headless=new", "--no-sandbox", "--enable-unsafe-swiftshader", "--accept-lang=en-US"]


class Chromium:
    """One page; the driver takes the browser with it when the `with` block ends."""

    def __init__(self, arguments, patience_s=60, **capabilities):
        self.patience_s = patience_s
        self.driver = subprocess.Popen(["chromedriver", "--port=0"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        try:
            port = next(line.strip()[len(TOLD):].rstrip(".") for line in self.driver.stdout if line.startswith(TOLD))
            self.base = f"http://127.0.0.1:{port}"
            options = {"goog:chromeOptions": {"args": ARGUMENTS + arguments}, **capabilities}
            self.base += "/session/" + self.ask("POST", "/session", {"capabilities": {"alwaysMatch": options}})["sessionId"]
        except BaseException:
            self.driver.kill()
            raise

    def __enter__(self):
        return self

    def __exit__(self, *_):
        try:
            self.ask("DELETE", "")
        finally:
            self.driver.kill()

    def ask(self, method, path, body=None):
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(self.base + path, data, {"content-type": "application/json"}, method=method)
        with urllib.request.urlopen(request, timeout=self.patience_s) as answer:
            return json.load(answer)["value"]

    def open(self, url):
        self.ask("POST", "/url", {"url": url})

    def run(self, script):
        """What a script in the page returns."""
        return self.ask("POST", "/execute/sync", {"script": script, "args": []})
