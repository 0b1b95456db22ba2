# SPDX-License-Identifier: MIT OR Apache-2.0
"""The notebooks, run from their first to their last cell; each then has to hold what it shows.

Pictures go to FOURDBODY_OUT. A notebook whose packages are absent is skipped.
"""

import importlib.util
import os
from pathlib import Path

import pytest

nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
NOTEBOOKS = Path(__file__).parents[1] / "notebooks"

# Lines that the task may take, and what must hold at the end.
EXPECTED = {
    "moving_cloud": (3, """
        assert len(result) == len(session) and min(map(len, clouds)) > 100_000
        # The arms are on their way up.
        assert np.ptp(clouds[-1].xyz_m[:, 1]) > np.ptp(clouds[0].xyz_m[:, 1]) + 0.05
    """),
    "phase_and_uncertainty": (4, """
        assert np.isfinite(phase.image()).sum() == len(phase.uv) and 0 < np.nanmedian(sigma) < 0.5
        assert ((phase.light_image() > 0) == np.isfinite(phase.image())).mean() > 0.999
    """),
    "calibration_and_drift": (5, """
        assert max(residuals.values()) < 0.2 and stands["stands"] and moved["drift"]["devices"][0]["kinds"]
        assert moved["drift"]["devices"][0]["at_body_mm"] > 3 * stands["drift"]["devices"][0]["at_body_mm"]
    """),
    # The skeleton is one of a person: its nose above its hips above its knees, and limbs as long as limbs are.
    "landmarks": (10, """
        nose, shoulder, elbow, hip, knee = places_m[[0, 12, 14, 24, 26]]
        assert nose[2] > hip[2] > knee[2] and nose[2] > shoulder[2]
        assert 0.15 < np.linalg.norm(shoulder - elbow) < 0.45 and 0.25 < np.linalg.norm(hip - knee) < 0.6
        assert np.isfinite(places_m).all(1).sum() > 20
    """),
}


def test_each_notebook_is_expected():
    assert {path.stem for path in NOTEBOOKS.glob("*.ipynb")} == set(EXPECTED)


@pytest.mark.parametrize("name", EXPECTED)
def test_a_notebook_is_short_and_holds_what_it_shows(name):
    if name == "landmarks" and importlib.util.find_spec("mediapipe") is None:
        pytest.skip("mediapipe is not installed")
    most, checks = EXPECTED[name]
    notebook = nbformat.read(NOTEBOOKS / f"{name}.ipynb", 4)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert not any(cell.outputs or cell.execution_count for cell in code), "notebooks are stored without outputs"
    task = [line for cell in code if "task" in cell.metadata.get("tags", []) for line in cell.source.splitlines()]
    assert 0 < len([line for line in task if line.strip()]) <= most
    picture = Path(os.environ["FOURDBODY_OUT"]) / f"{name}.png"
    picture.unlink(missing_ok=True)
    lines = [line.strip() for line in checks.strip().splitlines()]
    notebook.cells.append(nbformat.v4.new_code_cell("\n".join(lines)))
    nbclient.NotebookClient(notebook, timeout=900, resources={"metadata": {"path": NOTEBOOKS}}).execute()
    assert picture.stat().st_size > 10_000
