# SPDX-License-Identifier: MIT OR Apache-2.0
"""Runs the readers of scripts/readers, which were made from docs/reference alone, and prints what they found as JSON.

    reference.py recording NODE         outcomes of a recording, with all clocks
    reference.py result RESULT          points of phase maps against the clouds beside them
    reference.py damaged FILE SCRATCH   of copies with one bit changed, how many are refused
    reference.py devices CALIBRATION    places on the sensor of fixed points, and lines of sight of fixed pixels
"""

import json
import re
import sys
import zlib
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2] / "scripts/readers"))
import phase_points
import read_calibration
import read_phases
import read_recording
import read_result
import table_points


def recording(node):
    """Frames with the table's time of their trigger, and gaps; the two together are all outcomes."""
    frames, gaps, table, metadata = [], [], {}, {}
    for name, fields, pixels in read_recording.records(node):
        if pixels is not None:
            clocks = [fields.block_id, fields.camera_time_ns, fields.host_time_ns]
            found = [*pixels.shape, zlib.crc32(pixels.tobytes())]
            frames.append([fields.frame_id, fields.trigger_index, *clocks, *found])
        elif name == "/gaps":
            gaps.append([fields["camera"], fields["trigger"], fields["cause"]])
        elif name == "/hsu/triggers":
            table[fields["index"]] = fields["hsu_time_ns"]
        elif name.startswith("fourdbody."):
            metadata[name] = fields
    header, verdict = (json.loads(metadata[f"fourdbody.{name}"]["json"]) for name in ("header", "verdict"))
    counted = {camera["camera"]: [camera["frames"], sum(camera["gaps"].values())] for camera in verdict["cameras"]}
    for camera in (camera["id"] for camera in header["cameras"]):
        own = [sum(outcome[0] == camera for outcome in outcomes) for outcomes in (frames, gaps)]
        assert own == counted[camera], f"{camera}: {own}, the verdict has {counted[camera]}"
    outcomes = sorted((outcome[0], outcome[1]) for outcome in frames + gaps)
    expected = [(camera["id"], trigger) for camera in header["cameras"] for trigger in range(verdict["triggers"])]
    assert outcomes == sorted(expected), "not one outcome for each camera and trigger"
    return {"frames": [[*frame, table.get(frame[1])] for frame in frames], "gaps": gaps, "status": verdict["status"]}


def ply(path):
    """The points of a cloud, by the properties of its header."""
    data = Path(path).read_bytes()
    start = data.index(b"end_header\n") + len(b"end_header\n")
    kinds = {"float": "<f4", "ushort": "<u2", "uchar": "u1"}
    names = re.findall(r"^property (\w+) (\w+)$", data[:start].decode(), re.M)
    return np.frombuffer(data, np.dtype([(name, kinds[kind]) for kind, name in names]), offset=start)


def result(directory):
    """By camera: pixels, points, and the largest differences from the clouds."""
    found = {}
    calibration = read_calibration.load(Path(directory) / "calibration.json")
    for trigger, _, frame, path in read_result.frames(directory):
        name = frame["camera"]
        _, u, v, phase, light, sigma = read_phases.read(path)
        points = phase_points.points(calibration, name, u, v, phase)
        by_table = table_points.points(calibration, name, u, v, phase)
        sigma_m = phase_points.uncertainties(calibration, name, u, v, phase, sigma)
        cloud = ply(Path(directory) / "clouds" / f"{name}_{trigger:06}.ply")
        assert len(cloud) == frame["points"]
        places = np.stack([cloud[axis] for axis in "xyz"], 1)
        pixels = v * 65536 + u
        at = np.searchsorted(pixels, cloud["v"].astype(int) * 65536 + cloud["u"])
        assert np.array_equal(u[at], cloud["u"]) and np.array_equal(v[at], cloud["v"]), "a point of no known pixel"
        _, camera, projector = next(pair for pair in read_calibration.pairs(calibration) if pair[0] == name)
        back = read_calibration.project(camera, points) - np.stack([u, v], -1)
        column = phase * calibration["pattern"]["period_px"] / (2 * np.pi) - 0.5
        panel = read_calibration.project(projector, points)[:, 0] - column
        found[name] = {
            "pixels": len(u),
            "points": len(cloud),
            "mm": 1e3 * float(np.linalg.norm(points[at] - places, axis=1).max()),
            "table_mm": 1e3 * float(np.linalg.norm(by_table[at] - places, axis=1).max()),
            "intensity": float(abs(light[at] / 255 - cloud["intensity"]).max()),
            "sigma": float(abs(sigma_m[at] / cloud["sigma"] - 1).max()),
            "back_px": float(max(np.nanmax(abs(back)), np.nanmax(abs(panel)))),
        }
    return found


READERS = {".mcap": read_recording.records, ".phase": read_phases.read, ".json": read_calibration.load}


def damaged(path, scratch):
    """Of a copy that is cut, and of eight with a bit changed in the first two thirds: how many are refused."""
    path, copy = Path(path), Path(scratch) / Path(path).name
    data, of = path.read_bytes(), copy.parent if path.suffix == ".mcap" else copy
    places = range(9, len(data) * 2 // 3, len(data) // 12)
    copies = [data[:-2]] + [data[:at] + bytes([data[at] ^ 1]) + data[at + 1:] for at in places]
    copy.write_bytes(data)
    list(READERS[path.suffix](of))
    refused = 0
    for content in copies:
        copy.write_bytes(content)
        try:
            list(READERS[path.suffix](of))
        except Exception:
            refused += 1
    copy.unlink()
    return {"refused": refused, "copies": len(copies)}


POINTS = [[x, y, z] for x in (-0.3, 0.2) for y in (-0.25, 0.1) for z in (0.5, 1.6)]
PIXELS = [[u, v] for u in (0, 700.25, 1919) for v in (0, 311.5, 1199)]


def devices(path):
    """Places on the sensor of fixed points, and directions of fixed pixels in the device's axes, of each camera."""
    pairs = read_calibration.pairs(read_calibration.load(path))
    return {
        name: {
            "points": POINTS,
            "pixels_of_points": read_calibration.project(camera, POINTS).tolist(),
            "pixels": PIXELS,
            "sights_of_pixels": read_calibration.sight(camera, *np.transpose(PIXELS)).T.tolist(),
        }
        for name, camera, _ in pairs
    }


commands = {"recording": recording, "result": result, "damaged": damaged, "devices": devices}
print(json.dumps(commands[sys.argv[1]](*sys.argv[2:])))
