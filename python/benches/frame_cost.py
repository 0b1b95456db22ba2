# SPDX-License-Identifier: MIT OR Apache-2.0
"""What a frame costs, beside the program: python python/benches/frame_cost.py PROGRAM SESSION CALIBRATION RESULT

In milliseconds of processor time, the least of some rounds: other work on the machine adds to it, nothing takes from it.
"""

import os
import subprocess
import sys
import tempfile

import fourdbody as fb

ROUNDS = 4
# A session costs as much for its tables as for some frames: only what more triggers cost more counts.
FEW, MANY = 4, 16


def spent_ms():
    """Processor time of this process and of those that it has run."""
    return sum(os.times()[:4]) * 1e3


def cost_ms(work, repeat=1):
    """The least of some rounds after the first, which fills buffers; the clock has steps of 10 ms."""
    costs = []
    for _ in range(1 + ROUNDS):
        began = spent_ms()
        for _ in range(repeat):
            work()
        costs.append((spent_ms() - began) / repeat)
    return min(costs[1:])


program, session_path, calibration_path, result_path = sys.argv[1:]
session, calibration, result = fb.Session(session_path), fb.Calibration(calibration_path), fb.Result(result_path)
camera, trigger = session.cameras[0], result.triggers[0]
images = {camera: session.frame(trigger, camera) for camera in session.cameras}
reconstructor = fb.Reconstructor(calibration)


def by_package(triggers):
    with tempfile.TemporaryDirectory() as out:
        fb.reconstruct(session, calibration, out, triggers=triggers)


def by_program(triggers):
    with tempfile.TemporaryDirectory() as out:
        subprocess.run([program, "reconstruct", session_path, "--calibration", calibration_path, "--out", out,
                        "--triggers", f"{triggers.start}..{triggers.stop}"], check=True, capture_output=True)


def of_a_frame(by):
    few, many = (cost_ms(lambda: by(session.range[:count])) for count in (FEW, MANY))
    return (many - few) / (MANY - FEW) / len(session.cameras)


for what, milliseconds in {
    "photograph to phase map, files, package": of_a_frame(by_package),
    "photograph to phase map, files, program": of_a_frame(by_program),
    "photograph to points, in memory": cost_ms(lambda: reconstructor(images), 3) / len(images),
    "stored phase map to points": cost_ms(lambda: result.cloud(trigger, camera), 50),
    "stored phase maps of all cameras to a merged cloud": cost_ms(lambda: result.cloud(trigger), 5),
    "frame read": cost_ms(lambda: session.frame(trigger, camera), 200),
}.items():
    print(f"{what:50} {milliseconds:7.1f} ms")
