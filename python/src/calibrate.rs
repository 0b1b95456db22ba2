// SPDX-License-Identifier: MIT OR Apache-2.0
//! Photographs of the board to a calibration, and whether a calibration still stands, as the command line does it.

use crate::error::{OrRaise, raise};
use crate::work;
use fourdbody_calibrate::run::Options;
use fourdbody_calibrate::{Board, Vertical};
use fourdbody_core::base::{Exit, Fault};
use fourdbody_core::config::Rig;
use fourdbody_core::data;
use fourdbody_results::calibrating::{self, check::Check};
use pyo3::prelude::*;
use std::path::PathBuf;

/// Calibrates from sessions or directories of images; what `fourdbody calibrate --json` prints.
#[pyfunction]
#[pyo3(signature = (sessions, rig, board, out, report, partial, upright, level, progress))]
#[expect(clippy::too_many_arguments, reason = "the Python function has a name for each")]
pub fn calibrate(
    py: Python<'_>,
    sessions: Vec<PathBuf>,
    rig: PathBuf,
    board: PathBuf,
    out: PathBuf,
    report: Option<PathBuf>,
    partial: bool,
    upright: Vec<usize>,
    level: Vec<usize>,
    progress: Option<Py<PyAny>>,
) -> PyResult<String> {
    let rig = Rig::load(&rig).map_err(|e| raise(py, &Fault::from(e)))?;
    let board = Board::load(&board).map_err(|e| raise(py, &Fault::from(e)))?;
    let nominal = data::Calibration::nominal(&rig);
    let upright = upright.into_iter().map(Vertical::Upright);
    let verticals = upright.chain(level.into_iter().map(Vertical::Level)).collect();
    let options = Options { partial, verticals };
    let made = work::watched(py, progress.as_ref(), |at| {
        let source = calibrating::open(&sessions, &nominal)?;
        let files = (out.as_path(), report.as_deref());
        calibrating::calibrate(&source, &nominal, &board, &options, files, at).map(|made| made.json())
    });
    serde_json::to_string(&made?).or_raise(py, Exit::Failure)
}

/// Compares a session with a calibration; what `fourdbody calibration check --json` prints, with unreadable parts and why
/// no corrected calibration was written.
#[pyfunction]
#[pyo3(signature = (session, calibration, frame_sets, most_mm, corrected, history, progress))]
#[expect(clippy::too_many_arguments, reason = "the Python function has a name for each")]
pub fn calibration_check(
    py: Python<'_>,
    session: PathBuf,
    calibration: PathBuf,
    frame_sets: u64,
    most_mm: f64,
    corrected: Option<PathBuf>,
    history: Option<PathBuf>,
    progress: Option<Py<PyAny>>,
) -> PyResult<String> {
    let check = Check { session, calibration, frame_sets, most_mm, corrected, history };
    let found = work::watched(py, progress.as_ref(), |at| {
        let compared = check.open()?;
        let found = compared.run(at)?;
        let mut value = found.json();
        value["unreadable"] = compared.lost().iter().map(ToString::to_string).collect();
        value["not_corrected"] = serde_json::json!(found.no_better);
        Ok(value)
    });
    serde_json::to_string(&found?).or_raise(py, Exit::Failure)
}
