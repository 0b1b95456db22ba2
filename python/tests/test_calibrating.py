# SPDX-License-Identifier: MIT OR Apache-2.0
"""`calibrate` and `calibration_check` against the commands of the program, on photographs of the board.

FOURDBODY_DEMO is what `make demo` wrote, FOURDBODY_BOARD has rendered photographs, FOURDBODY_PROGRAM is the program.
"""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import fourdbody as fb
import numpy as np
import pytest

DEMO, BOARD = Path(os.environ["FOURDBODY_DEMO"]), Path(os.environ["FOURDBODY_BOARD"])
PHOTOGRAPHS = (BOARD / "images", BOARD / "rig.toml", BOARD / "board.toml")


def command(*arguments):
    ran = subprocess.run([os.environ["FOURDBODY_PROGRAM"], *map(str, arguments), "--json"], capture_output=True, text=True)
    return ran.returncode, json.loads(ran.stdout), ran.stderr


def test_a_calibration_is_that_of_the_command(tmp_path):
    images, rig, board = PHOTOGRAPHS
    theirs, ours, seen = tmp_path / "theirs.json", tmp_path / "ours.json", []
    code, said, _ = command("calibrate", "--session", images, "--rig", rig, "--board", board, "--out", theirs)
    made = fb.calibrate(images, rig, board, ours, report=tmp_path / "report", progress=lambda *at: seen.append(at))
    assert code == 0 and ours.read_bytes() == theirs.read_bytes()
    same = {"quality", "findings", "advice", "unreadable"}
    assert {key: made[key] for key in same} == {key: said[key] for key in same}
    assert made["calibration"] == str(ours) and Path(made["report"]).read_text().startswith("<!DOCTYPE html>")
    assert seen == sorted(seen) and seen[-1][0] == seen[-1][1] > 100
    # As the simulator's rig really is, up to where it stands in the world.
    true = fb.Calibration(BOARD / "calibration.json").content()["heads"][0]["cameras"][0]["device"]["lens"]
    found = fb.Calibration(ours).content()["heads"][0]["cameras"][0]["device"]["lens"]
    assert abs(found["fx"] / true["fx"] - 1) < 1e-3


def turned(path):
    """The demo's calibration, by which its first camera stands a hundredth of a degree off about its y axis."""
    stated = fb.Calibration(DEMO / "frames/calibration.json").content()
    pose = stated["heads"][0]["cameras"][0]["device"]["world_from_device"]
    c, s = np.cos(np.deg2rad(0.01)), np.sin(np.deg2rad(0.01))
    pose["rotation"] = (np.array(pose["rotation"]) @ [[c, 0, s], [0, 1, 0], [-s, 0, c]]).tolist()
    fb.Calibration(stated).save(path)
    return path


def test_a_check_is_that_of_the_command_and_finds_what_has_turned(tmp_path):
    stated = turned(tmp_path / "turned.json")
    session, corrected = DEMO / "sessions/demo", tmp_path / "corrected.json"
    code, said, _ = command("calibration", "check", session, "--calibration", stated, "--frame-sets", 2)
    found = fb.calibration_check(fb.Session(session), stated, frame_sets=2, corrected=corrected, history=tmp_path / "history")
    assert {key: found[key] for key in said} == said and found["stands"] == (code == 0)
    camera = found["drift"]["devices"][0]
    assert camera["device"] == "camera h0_up" and abs(camera["turn_deg"][1] + 0.01) < 0.003
    assert fb.calibration_check(session, corrected, frame_sets=2)["stands"] and found["not_corrected"] is None
    (line,) = (tmp_path / "history/calibration-history.jsonl").read_text().splitlines()
    assert json.loads(line)["verdict"] == found["verdict"]


@pytest.mark.parametrize("call", [
    f"fb.calibrate(*{tuple(map(str, PHOTOGRAPHS))!r}, 'out.json', progress=print)",
    f"fb.calibration_check({str(DEMO / 'sessions/demo')!r}, {str(DEMO / 'frames/calibration.json')!r}, progress=print)",
])
def test_ctrl_c_ends_both_and_nothing_is_written(call, tmp_path):
    # A shell that runs these tests in the background has Ctrl-C ignored.
    heard = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    program = f"{heard}\nimport functools, fourdbody as fb; print = functools.partial(print, flush=True)\n{call}"
    child = subprocess.Popen([sys.executable, "-c", program], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert child.stdout.readline()
    child.send_signal(signal.SIGINT)
    _, said = child.communicate(timeout=120)
    assert child.returncode != 0 and "KeyboardInterrupt" in said and not list(tmp_path.iterdir())


def test_what_progress_raises_is_raised(tmp_path):
    def refuse(done, of):
        raise RuntimeError("enough")

    with pytest.raises(RuntimeError, match="enough"):
        fb.calibrate(*PHOTOGRAPHS, tmp_path / "out.json", progress=refuse)
    assert not (tmp_path / "out.json").exists()


def test_mistakes_have_the_commands_words_and_codes(tmp_path):
    images, rig, board = PHOTOGRAPHS
    with pytest.raises(fb.Error, match="nothing.toml") as none:
        fb.calibrate(images, tmp_path / "nothing.toml", board, tmp_path / "out.json")
    assert none.value.code == 2
    with pytest.raises(fb.Error) as dark:
        fb.calibrate(DEMO / "sessions/demo", DEMO / "frames/rig.toml", board, tmp_path / "out.json")
    assert dark.value.code == 1 and not (tmp_path / "out.json").exists()
    with pytest.raises(fb.Error) as none:
        fb.calibration_check(tmp_path / "nothing", DEMO / "frames/calibration.json")
    assert none.value.code == 2
    with pytest.raises(ValueError, match="frame sets"):
        fb.calibration_check(images, DEMO / "frames/calibration.json", frame_sets=0)
    with pytest.raises(ValueError, match="above 0"):
        fb.calibration_check(images, DEMO / "frames/calibration.json", most_mm=float("nan"))
