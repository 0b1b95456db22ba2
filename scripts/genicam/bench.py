# SPDX-License-Identifier: MIT OR Apache-2.0
"""bench.py DESCRIPTION WIDTH HEIGHT: prepares a camera behind it, and judges its memory; JSON by lines.

First {"bootstrap": [[address, word]]} comes in, and the camera goes out: facts, memory, and what may be left over. Then for
each {"bootstrap", "memory": [[address, [selectors], word]], "asked": {...}} goes out what is found and what is wrong; with
"leave", after somebody has left that.
"""
import json
import sys

import facts
import judge
import left_over
from description import Description, kind
from prepare import Preparation

ALL = "everything at once"


def words(memory):
    return [[at, list(behind), word] for (at, behind), word in memory.words.items() if at not in memory.fixed]


def line_of(camera):
    """The line that the wire is put to: the first one, by its name."""
    entries = camera.entries("TriggerSource")
    lines = [e for e in entries if e in ("Line0", "Line1")] or [e for e in entries if e.startswith(("Line", "Ext", "In", "Trig"))]
    return lines[0] if lines else None


def main():
    camera = Description(sys.argv[1])
    size = int(sys.argv[2]), int(sys.argv[3])
    memory = camera.memory
    for at, word in json.loads(sys.stdin.readline())["bootstrap"]:
        memory.words[(at, ())] = word
        memory.fixed.add(at)
    preparation = Preparation(camera, size)
    preparation.run()
    known = facts.of(camera, preparation.features)
    memory.banks = {at: by for at, by in known["banks"]}
    camera.forget()
    new, left = dict(memory.words), []
    line = line_of(camera)
    for name, settings in left_over.WAYS:
        if left_over.leave(camera, settings):
            left.append({"name": name, "memory": words(memory)})
        memory.words = dict(new)
        camera.forget()
    if [left_over.leave(camera, settings) for _, settings in left_over.WAYS].count(True) > 1:
        left.append({"name": ALL, "memory": words(memory)})
    memory.words = dict(new)
    camera.forget()
    names = ("ModelName", "VendorName", "StandardNameSpace")
    about = {name: camera.root.get(name) for name in names} | {"kind": kind(camera)}
    start = judge.judge(camera, asked_nothing(line, size))["found"]
    answer({"about": about, "facts": known, "memory": words(memory), "left": left, "line": line, "start": start})
    for text in sys.stdin:
        request = json.loads(text)
        memory.words = {(at, tuple(behind)): word for at, behind, word in request["memory"]}
        memory.words.update({(at, ()): word for at, word in request["bootstrap"]})
        camera.forget()
        if "leave" in request:
            wanted = [settings for name, settings in left_over.WAYS if request["leave"] in (name, ALL)]
            [left_over.leave(camera, settings) for settings in wanted]
        answer(judge.judge(camera, request["asked"]))


def asked_nothing(line, size):
    return {"line": line, "edges": [], "exposure_us": 0, "tolerance_us": 0, "size": size, "packet": None}


def answer(value):
    print(json.dumps(value, default=str), flush=True)


if __name__ == "__main__":
    main()
