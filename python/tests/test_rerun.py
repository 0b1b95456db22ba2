# SPDX-License-Identifier: MIT OR Apache-2.0
"""`Result.to_rerun`, read back from the file that Rerun wrote."""

import builtins
import os
from pathlib import Path

import fourdbody as fb
import numpy as np
import pytest

RESULT = Path(os.environ["FOURDBODY_DEMO"]) / "result"


def test_every_trigger_has_its_cloud_on_both_time_lines(tmp_path):
    rr = pytest.importorskip("rerun")
    reader = pytest.importorskip("rerun.chunk").RrdReader
    result = fb.Result(RESULT)
    result.triggers = result.triggers[:3]
    with rr.RecordingStream("test") as recording:
        recording.save(tmp_path / "walk.rrd")
        result.to_rerun(5000, recording=recording)
    rows = {}
    for chunk in reader(tmp_path / "walk.rrd").stream():
        if chunk.entity_path == "/body" and not chunk.is_static:
            batch = chunk.to_record_batch()
            names = ("trigger", "Points3D:positions", "Points3D:colors")
            columns = [batch.column(name).to_pylist() for name in names]
            times_ns = batch.column("session_time").cast("int64").to_pylist()
            rows |= {trigger: rest for trigger, *rest in zip(*columns, times_ns)}
    assert sorted(rows) == list(result.triggers)
    for trigger, (places, colours, time_ns) in rows.items():
        cloud = result.cloud(trigger)
        assert len(places) == len(colours) == 5000
        assert np.array_equal(np.array(places[0], np.float32), cloud.xyz_m[0])
        assert np.array_equal(np.array(places[-1], np.float32), cloud.xyz_m[-1])
        assert colours[0] >> 24 == round(255 * float(cloud.intensity[0]))
        assert time_ns == cloud.time_ns


def test_without_rerun_what_to_install_is_named(monkeypatch):
    real = builtins.__import__
    missing = lambda name, *rest: (_ for _ in ()).throw(ImportError(name)) if name == "rerun" else real(name, *rest)
    monkeypatch.setattr(builtins, "__import__", missing)
    with pytest.raises(ImportError, match="pip install rerun-sdk"):
        fb.Result(RESULT).to_rerun()
    with pytest.raises(ValueError, match="above 0"):
        fb.Result(RESULT).to_rerun(0)
