// SPDX-License-Identifier: MIT OR Apache-2.0
//! A recorded session: its frames, its times and what `verify` finds.

use crate::error::{OrRaise, raise};
use fourdbody_core::base::ids::{CameraId, TriggerIndex};
use fourdbody_core::base::{Exit, Fault};
use fourdbody_core::data::FrameSource;
use fourdbody_record::{RecordingReader, SessionReader, TimeCodeLine, open_each, verify};
use numpy::{IntoPyArray, PyArray2, PyArrayMethods};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use std::path::PathBuf;

/// What stands in a column of times where none is known.
const UNKNOWN_NS: i64 = -1;

#[pyclass(frozen)]
pub struct Session {
    pub path: PathBuf,
    reader: SessionReader,
}

fn ns(time_ns: Option<u64>) -> i64 {
    time_ns.and_then(|time_ns| i64::try_from(time_ns).ok()).unwrap_or(UNKNOWN_NS)
}

#[pymethods]
impl Session {
    #[new]
    fn new(py: Python<'_>, path: PathBuf) -> PyResult<Self> {
        let reader =
            py.detach(|| SessionReader::open_timed(&path)).map_err(|e| raise(py, &Fault::from(e)))?;
        Ok(Self { path, reader })
    }

    /// Name, id, nodes, cameras, first and last trigger plus one, clock of the triggers' times, unreadable parts.
    fn facts<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let identity = self.reader.identity().or_raise(py, Exit::Corrupt)?;
        let facts = PyDict::new(py);
        facts.set_item("id", identity.id)?;
        facts.set_item("name", identity.name)?;
        facts.set_item("nodes", identity.nodes)?;
        let cameras: Vec<&str> = self.reader.cameras().iter().map(CameraId::as_str).collect();
        facts.set_item("cameras", cameras)?;
        facts.set_item("triggers", (self.reader.triggers().start, self.reader.triggers().end))?;
        facts.set_item("time_base", self.reader.time_base())?;
        let unreadable: Vec<String> = self.reader.unreadable().iter().map(ToString::to_string).collect();
        facts.set_item("unreadable", unreadable)?;
        Ok(facts)
    }

    /// Columns with an entry for each trigger.
    fn triggers<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let range = self.reader.triggers();
        let recordings = self.reader.recordings();
        let lines: Vec<TimeCodeLine> = recordings.iter().map(|one| TimeCodeLine::of(&one.events)).collect();
        let row = |index: u64| recordings.iter().find_map(|one| one.triggers.get(&TriggerIndex(index)));
        let hsu_ns = |index: u64| row(index).map(|row| row.hsu_time_ns);
        let columns = PyDict::new(py);
        columns.set_item("index", range.clone().collect::<Vec<u64>>().into_pyarray(py))?;
        let column = |time: &dyn Fn(u64) -> Option<u64>| {
            range.clone().map(|index| ns(time(index))).collect::<Vec<i64>>().into_pyarray(py)
        };
        columns.set_item("time_ns", column(&|index| self.reader.trigger_time_ns(TriggerIndex(index))))?;
        columns.set_item("hsu_time_ns", column(&hsu_ns))?;
        for recording in recordings {
            let reported = |index: u64| Some(recording.triggers.get(&TriggerIndex(index))?.host_time_ns);
            columns.set_item(format!("host_time_ns_{}", recording.header.node), column(&reported))?;
        }
        let code = |index: u64| {
            let hsu_ns = hsu_ns(index)?;
            lines.iter().find_map(|line| line.at(hsu_ns)).map(|at| at.to_string())
        };
        let codes: Vec<String> = range.clone().map(|index| code(index).unwrap_or_default()).collect();
        columns.set_item("time_code", codes)?;
        Ok(columns)
    }

    /// Columns with an entry for each trigger of one camera.
    fn outcomes<'py>(&self, py: Python<'py>, camera: &str) -> PyResult<Bound<'py, PyDict>> {
        let (mut words, mut blocks, mut camera_ns, mut host_ns) = (vec![], vec![], vec![], vec![]);
        let camera = CameraId::from(camera);
        let range = self.reader.triggers();
        py.detach(|| {
            for index in range.clone() {
                let found = self.reader.recorded_frame_meta(&camera, TriggerIndex(index));
                let meta = found.as_ref().ok().and_then(|outcome| outcome.as_ref().ok());
                words.push(match &found {
                    Ok(Ok(_)) => "frame".to_owned(),
                    Ok(Err(cause)) => cause.to_string(),
                    Err(_) => "damaged".to_owned(),
                });
                blocks.push(ns(meta.map(|meta| meta.block.0)));
                camera_ns.push(ns(meta.map(|meta| meta.camera_time_ns)));
                host_ns.push(ns(meta.map(|meta| meta.host_time_ns)));
            }
        });
        let columns = PyDict::new(py);
        columns.set_item("index", range.collect::<Vec<u64>>().into_pyarray(py))?;
        columns.set_item("outcome", words)?;
        columns.set_item("block_id", blocks.into_pyarray(py))?;
        columns.set_item("camera_time_ns", camera_ns.into_pyarray(py))?;
        columns.set_item("host_time_ns", host_ns.into_pyarray(py))?;
        Ok(columns)
    }

    /// The pixels of a frame, rows x columns, or the cause of its gap.
    fn frame<'py>(&self, py: Python<'py>, trigger: u64, camera: &str) -> PyResult<FrameOrGap<'py>> {
        let camera = CameraId::from(camera);
        let found = py.detach(|| self.reader.recorded_frame(&camera, TriggerIndex(trigger)));
        match found.or_raise(py, Exit::Corrupt)? {
            Ok(frame) => {
                let size = [frame.image.height(), frame.image.width()];
                Ok(FrameOrGap::Frame(frame.image.into_vec().into_pyarray(py).reshape(size)?))
            }
            Err(cause) => Ok(FrameOrGap::Gap(cause.to_string())),
        }
    }

    /// The rig file that the session was recorded with.
    fn rig(&self) -> String {
        self.reader.recordings().first().map_or_else(String::new, |one| one.header.rig_text.clone())
    }

    /// The stored verdict of each node as JSON; null where the recording was not finished.
    fn verdicts(&self) -> String {
        let of = |one: &RecordingReader| (one.header.node.to_string(), serde_json::json!(one.verdict));
        serde_json::Value::Object(self.reader.recordings().iter().map(of).collect()).to_string()
    }

    /// The events of all nodes as JSON, in order of time.
    fn events(&self, py: Python<'_>) -> PyResult<String> {
        let (readers, _) = py.detach(|| open_each(&self.path)).map_err(|e| raise(py, &Fault::from(e)))?;
        let named = readers.iter().flat_map(|one| one.events.iter().map(|event| (&one.header.node, event)));
        let mut events: Vec<_> = named.collect();
        events.sort_by_key(|(_, event)| event.host_time_ns);
        let event = |(node, event): &(_, &fourdbody_record::NodeEvent)| {
            let mut value = serde_json::json!(event);
            value["node"] = serde_json::json!(node);
            value
        };
        Ok(serde_json::Value::Array(events.iter().map(event).collect()).to_string())
    }

    /// What `fourdbody verify --json` prints.
    fn verify(&self, py: Python<'_>) -> PyResult<String> {
        let report = py.detach(|| verify::verify(&self.path, &|_, _| {}));
        let report = report.map_err(|e| raise(py, &Fault::from(e)))?;
        serde_json::to_string(&report).or_raise(py, Exit::Failure)
    }
}

/// What a camera has for a trigger.
#[derive(IntoPyObject)]
pub enum FrameOrGap<'py> {
    Frame(Bound<'py, PyArray2<u8>>),
    Gap(String),
}
