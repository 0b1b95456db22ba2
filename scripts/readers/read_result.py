# SPDX-License-Identifier: MIT OR Apache-2.0
"""What `fourdbody reconstruct` left in a directory, by docs/reference/summary.md: `read_result.py RESULT`."""
import hashlib
import json
import re
import sys
from pathlib import Path
import numpy as np
import read_calibration
import read_phases

def geometry_sha256(path):
    """The digest of cameras, projectors and pattern that phase maps state, from the text of a calibration."""
    text = re.sub(r'("(?:[^"\\]|\\.)*")|\s+', r"\1", Path(path).read_text(encoding="utf-8"))
    start = {name: text.index(f'"{name}":') + len(name) + 3 for name in ("heads", "pattern")}
    part = {name: text[at:json.JSONDecoder().raw_decode(text, at)[1]] for name, at in start.items()}
    return hashlib.sha256(f'{{"heads":{part["heads"]},"pattern":{part["pattern"]}}}'.encode()).hexdigest()

def parameters(key):
    """The digest that all files of a result state."""
    margin = float(np.float32(key["margin"]))
    parts = key["algorithm"], key["calibration_sha256"], key["method"], margin, key["bin_rows"], key["uncertainty"]
    return hashlib.sha256(json.dumps(parts, separators=(",", ":")).encode()).hexdigest()[:32]

def frames(result):
    """Trigger, time (ns; None where it is not known), camera's entry, and path of the map or None, of each frame."""
    result = Path(result)
    key, summary = (json.loads((result / name).read_text()) for name in ("reconstruct.json", "summary.json"))
    stated = parameters(key)
    if (summary["session"], summary["parameters"]) != (key["session"], stated):
        raise ValueError(f"{result}: summary.json and reconstruct.json are of two results")
    read_calibration.load(result / "calibration.json")
    geometry = geometry_sha256(result / "calibration.json")
    for entry in summary["triggers"]:
        trigger = entry["trigger"]
        for frame in entry["frames"]:
            path = result / "phases" / f"{frame['camera']}_{trigger:06}.phase"
            if frame["outcome"] not in ("cloud", "refused") or "phase" not in key["format"].split(","):
                yield trigger, entry.get("time_ns"), frame, None
                continue
            statement = read_phases.read(path)[0]["statement"]
            found = [statement[name] for name in ("trigger", "camera", "time_ns", "points", "geometry_sha256")]
            if found != [trigger, frame["camera"], entry.get("time_ns"), frame["points"], geometry]:
                raise ValueError(f"{path}: it is of {found}, expected those of summary.json")
            if not {f"session {key['session']['id']}", f"parameters {stated}"} <= set(statement["comments"]):
                raise ValueError(f"{path}: of another result")
            yield trigger, entry.get("time_ns"), frame, path

if __name__ == "__main__":
    for trigger, time_ns, frame, path in frames(sys.argv[1]):
        print(trigger, time_ns, frame["camera"], frame["outcome"], frame["points"], frame.get("reason", path))
