# SPDX-License-Identifier: MIT OR Apache-2.0
"""The package against other readers of the same files: `mcap` for recordings, `plyfile` for clouds, OpenCV for lenses.

FOURDBODY_DEMO is the directory that `make demo` wrote.
"""

import os
import resource
import signal
import subprocess
import sys
import zlib
from pathlib import Path

import fourdbody as fb
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from plyfile import PlyData

DEMO = Path(os.environ["FOURDBODY_DEMO"])
SESSION = DEMO / "sessions/demo"


@pytest.fixture(scope="module")
def session():
    return fb.Session(SESSION)


@pytest.fixture(scope="module")
def calibration():
    return fb.Calibration(DEMO / "frames/calibration.json")


@pytest.fixture(scope="module")
def result():
    return fb.Result(DEMO / "result")


def test_frames_and_their_clocks_are_those_that_mcap_reads(session):
    outcomes = {camera: session.outcomes(camera) for camera in session.cameras}
    seen = 0
    for segment in sorted(SESSION.glob("node-*/segment-*.mcap")):
        with open(segment, "rb") as file:
            reader = make_reader(file, decoder_factories=[DecoderFactory()], validate_crcs=True)
            topics = [channel.topic for channel in reader.get_summary().channels.values()]
            for _, _, _, image in reader.iter_decoded_messages([topic for topic in topics if topic.endswith("/image")]):
                camera, trigger = image.frame_id, image.trigger_index
                frame = session.frame(trigger, camera)
                assert frame.dtype == np.uint8 and frame.tobytes() == image.data
                assert zlib.crc32(frame) == image.pixels_crc32
                row = outcomes[camera][trigger - session.range.start]
                assert (row["index"], row["outcome"]) == (trigger, "frame")
                assert row["camera_time_ns"] == image.camera_time_ns
                assert row["host_time_ns"] == image.host_time_ns
                seen += 1
    assert seen == sum((table["outcome"] == "frame").sum() for table in outcomes.values()) > 0


def test_triggers_have_a_column_for_each_clock(session):
    triggers = session.triggers
    assert {"index", "time_ns", "hsu_time_ns", "host_time_ns_a", "host_time_ns_b", "time_code"} == set(triggers.dtype.names)
    period_ns = np.diff(triggers["hsu_time_ns"])
    assert np.all(np.abs(np.diff(triggers["time_ns"]) - period_ns) <= 1000), "one clock's steps are the other's"
    assert np.all(triggers["index"] == np.arange(len(session)) + session.range.start)


def test_gaps_are_false_and_have_their_cause(session):
    for trigger, camera, frame in session.frames():
        if isinstance(frame, fb.Gap):
            assert not frame and frame.cause and (frame.trigger, frame.camera) == (trigger, camera)


def test_the_verdict_and_the_events_are_those_of_the_nodes(session):
    report = session.verify()
    assert {one["node"]: one["verdict"] for one in report["recordings"]} == session.verdict
    assert set(session.verdict) == set(session.nodes)
    assert all(event["node"] in session.nodes and event["kind"] for event in session.events())


def test_clouds_are_those_that_export_wrote(result):
    (path,) = (DEMO / "clouds/merged").glob("*.ply")
    theirs, ours = PlyData.read(path)["vertex"], result.cloud(int(path.stem))
    for name, column in zip("xyz", ours.xyz_m.T):
        assert np.array_equal(theirs[name], column)
    assert np.array_equal(theirs["camera"], ours.camera) and np.array_equal(theirs["v"], ours.uv[:, 1])
    assert ours.time_ns is not None and len(ours) == len(theirs)
    camera = ours.cameras[0]
    assert len(ours.of_camera(camera)) <= len(result.cloud(int(path.stem), camera))


def test_a_phase_map_is_the_columns_of_the_panel(result, calibration):
    trigger, camera = result.triggers[0], "h0_up"
    phase, cloud = result.phase(trigger, camera), result.cloud(trigger, camera)
    content = calibration.content()
    column = calibration.project("projector h0", cloud.xyz_m)[:, 0]
    known = phase.image()[cloud.uv[:, 1], cloud.uv[:, 0]]
    period = content["pattern"]["period_px"]
    # Fringe 0 begins at the panel's edge, half a pixel before the centre of its first column.
    assert np.abs((column + 0.5) / period - known).max() < 1e-3


def test_photographs_of_one_instant_give_the_points_of_the_session(session, calibration, result):
    trigger = result.triggers[0]
    images = {camera: session.frame(trigger, camera) for camera in session.cameras}
    made = fb.reconstruct_images({camera: image for camera, image in images.items() if len(image)}, calibration)
    stored = result.cloud(trigger)
    assert np.array_equal(made.merged.xyz_m, stored.xyz_m) and np.array_equal(made.merged.normal, stored.normal)


def test_the_memory_of_a_frame_is_kept_for_the_next_one(session, calibration, result):
    """Memory that went back to the system would be mapped anew, page by page: some 4000 pages a photograph."""
    images = {camera: session.frame(result.triggers[0], camera) for camera in session.cameras}
    reconstruct = fb.Reconstructor(calibration)
    faults = []
    for _ in range(5):
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        reconstruct(images)
        faults.append((resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before) / len(images))
    assert min(faults[1:]) < 500, faults


def test_a_session_becomes_a_result(session, calibration, tmp_path):
    seen = []
    triggers = range(session.range.start, session.range.start + 2)
    result = fb.reconstruct(session, calibration, tmp_path / "out", triggers=triggers, uncertainty=True,
                            progress=lambda done, of: seen.append((done, of)))
    assert result.triggers == tuple(triggers) and seen[-1] == (2, 2)
    cloud = result.cloud(triggers[0])
    assert cloud.sigma_m.shape == (len(cloud),) and 0 < np.median(cloud.sigma_m) < 0.001


def test_ctrl_c_ends_a_reconstruction(tmp_path):
    # A shell that runs these tests in the background has Ctrl-C ignored.
    program = ("import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
               f"import fourdbody as fb; s = fb.Session({str(SESSION)!r}); c = fb.Calibration({str(DEMO / 'frames/calibration.json')!r})\n"
               f"fb.reconstruct(s, c, {str(tmp_path / 'out')!r}, progress=lambda done, of: print(done, flush=True))")
    child = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert child.stdout.readline() == "0\n"
    child.send_signal(signal.SIGINT)
    _, said = child.communicate(timeout=120)
    assert child.returncode != 0 and "KeyboardInterrupt" in said
    assert not (tmp_path / "out/summary.json").exists(), "it has not run to its end"


def test_rays_and_pixels_are_those_of_opencv(calibration):
    cv2 = pytest.importorskip("cv2")
    rng = np.random.default_rng(1)
    for camera in calibration.cameras:
        width, height = calibration.size(camera)
        uv = rng.uniform((0, 0), (width - 1, height - 1), (200, 2))
        centre, directions = calibration.rays(camera, uv)
        points = centre + directions * rng.uniform(1.5, 3.0, (200, 1))
        assert np.abs(calibration.project(camera, points) - uv).max() < 1e-6
        heads = calibration.content()["heads"]
        device = next(c["device"] for head in heads for c in head["cameras"] if c["id"] == camera)
        lens, pose = device["lens"], device["world_from_device"]
        matrix = np.array([[lens["fx"], 0, lens["cx"]], [0, lens["fy"], lens["cy"]], [0, 0, 1]])
        rotation = np.array(pose["rotation"]).T
        turn, shift = cv2.Rodrigues(rotation)[0], -rotation @ np.array(pose["translation_m"])
        theirs = cv2.projectPoints(points, turn, shift, matrix, np.array(lens["distortion"]))[0][:, 0]
        assert np.abs(theirs - uv).max() < 1e-6


def test_mistakes_are_errors_with_the_programs_words_and_codes(session, calibration, result, tmp_path):
    with pytest.raises(fb.Error) as none:
        fb.Session(tmp_path / "nothing")
    assert none.value.code == 2 and "nothing" in str(none.value)
    with pytest.raises(KeyError, match="h9_up"):
        session.frame(0, "h9_up")
    with pytest.raises(IndexError):
        session.frame(10**6, "h0_up")
    with pytest.raises(KeyError, match="no cloud"):
        result.cloud(10**6)
    with pytest.raises(TypeError, match="uint8"):
        fb.reconstruct_images({"h0_up": np.zeros((1200, 1920))}, calibration)
    with pytest.raises(fb.Error, match="h9_up"):
        fb.reconstruct_images({"h9_up": np.zeros((1200, 1920), np.uint8)}, calibration)
    with pytest.raises(fb.Error, match="projector h0"):
        calibration.size("projector h9")
    with pytest.raises(ValueError, match="consecutive"):
        fb.reconstruct(session, calibration, tmp_path, triggers=range(0, 4, 2))
    small = fb.reconstruct_images({"h0_up": np.zeros((3, 4), np.uint8)}, calibration)
    assert len(small.merged) == 0 and "h0_up" in small.refused


def test_a_pair_kept_by_opencv_is_the_same_pair(calibration, tmp_path):
    cv2 = pytest.importorskip("cv2")
    head = calibration.content()["heads"][0]
    camera = head["cameras"][0]
    storage = cv2.FileStorage(str(tmp_path / "pair.yml"), cv2.FILE_STORAGE_WRITE)
    seen = []
    for number, device in [(1, camera["device"]), (2, head["projector"])]:
        lens, pose = device["lens"], device["world_from_device"]
        matrix = np.array([[lens["fx"], 0, lens["cx"]], [0, lens["fy"], lens["cy"]], [0, 0, 1]], float)
        storage.write(f"K{number}", matrix)
        storage.write(f"D{number}", np.array(lens["distortion"]))
        rotation = np.array(pose["rotation"])
        seen.append((rotation.T, -rotation.T @ np.array(pose["translation_m"])))
    turn = seen[1][0] @ seen[0][0].T
    storage.write("R", turn)
    storage.write("T", 1e3 * (seen[1][1] - turn @ seen[0][1]))
    storage.release()
    names = [camera["id"], head["id"]]
    made = fb.Calibration.from_opencv(tmp_path / "pair.yml", base=calibration, devices=names, unit_mm=1)
    points = np.random.default_rng(7).uniform([-0.3, -0.3, 0.7], [0.3, 0.3, 1.3], (100, 3))
    for device in [camera["id"], f"projector {head['id']}"]:
        assert np.abs(made.project(device, points) - calibration.project(device, points)).max() < 1e-6
    assert made.cameras == calibration.cameras and made.content()["origin"].startswith("pair.yml of OpenCV")
    with pytest.raises(fb.Error, match="unit of the translation") as error:
        fb.Calibration.from_opencv(tmp_path / "pair.yml", base=calibration, devices=names)
    assert error.value.code == 2
