// SPDX-License-Identifier: MIT OR Apache-2.0
//! Photographs to points: of one instant in memory, and of a session to files, as the command line does it.

use crate::arrays;
use crate::calibration::Calibration;
use crate::error::{OrRaise, raise};
use crate::work;
use fourdbody_core::base::ids::CameraId;
use fourdbody_core::base::image::Mono8;
use fourdbody_core::base::{Exit, Fault};
use fourdbody_core::data::FrameSource;
use fourdbody_reconstruct::Reconstructor as Library;
use fourdbody_reconstruct::outcome::Outcome;
use fourdbody_record::SessionReader;
use fourdbody_results::batch::run::{self, Format, Plan};
use fourdbody_results::batch::whole;
use numpy::{PyReadonlyArray2, PyUntypedArrayMethods};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use std::collections::BTreeMap;
use std::path::PathBuf;

#[pyclass(frozen)]
pub struct Reconstructor {
    library: Library,
}

#[pymethods]
impl Reconstructor {
    #[new]
    fn new(py: Python<'_>, calibration: &Calibration) -> PyResult<Self> {
        let library = py.detach(|| Library::new(&calibration.content)).or_raise(py, Exit::Usage)?;
        Ok(Self { library })
    }

    /// The clouds of the cameras by their names: arrays, and why there are no points; and the merged cloud.
    fn reconstruct<'py>(
        &self,
        py: Python<'py>,
        images: BTreeMap<String, PyReadonlyArray2<'py, u8>>,
    ) -> PyResult<(Bound<'py, PyDict>, Bound<'py, PyDict>)> {
        let known: Vec<&str> = self.library.cameras().map(CameraId::as_str).collect();
        let mut photographs = BTreeMap::new();
        for (camera, image) in &images {
            if !known.contains(&camera.as_str()) {
                let message =
                    format!("expected cameras of the calibration ({}), found {camera:?}", known.join(", "));
                return Err(raise(py, &Fault::new(Exit::Usage, message)));
            }
            let pixels = image.as_slice().or_raise(py, Exit::Usage)?;
            let mono = Mono8::new(image.shape()[1], image.shape()[0], pixels);
            let mono = mono.ok_or("expected an image with pixels").or_raise(py, Exit::Usage)?;
            photographs.insert(camera.as_str(), mono);
        }
        let made = py.detach(|| self.library.reconstruct(|camera| photographs.get(camera.as_str()).copied()));
        let merged = arrays::cloud(py, py.detach(|| self.library.merge(&made)))?;
        let clouds = PyDict::new(py);
        for (camera, made) in known.iter().zip(made) {
            let Some(made) = made else { continue };
            let refused = match made.outcome {
                Outcome::Cloud => None,
                Outcome::Refused(reason) => Some(reason),
            };
            clouds.set_item(camera, (arrays::cloud(py, made.cloud)?, refused))?;
        }
        Ok((clouds, merged))
    }
}

/// Reconstructs triggers of a session into a directory; `progress` gets triggers done and their number, now and then.
#[pyfunction]
#[pyo3(signature = (session, calibration, out, triggers, cameras, uncertainty, ply, progress))]
#[expect(clippy::too_many_arguments, reason = "the Python function has a name for each")]
pub fn reconstruct(
    py: Python<'_>,
    session: PathBuf,
    calibration: &Calibration,
    out: PathBuf,
    triggers: Option<(u64, u64)>,
    cameras: Vec<String>,
    uncertainty: bool,
    ply: bool,
    progress: Option<Py<PyAny>>,
) -> PyResult<()> {
    let calibration = &calibration.content;
    let known: Vec<CameraId> = calibration.cameras().map(|(_, camera)| camera.id.clone()).collect();
    let wanted: Vec<CameraId> = cameras.iter().map(|name| CameraId::from(name.as_str())).collect();
    let fault = |fault: Fault| raise(py, &fault);
    let source = py.detach(|| SessionReader::open_timed(&session)).map_err(|e| fault(e.into()))?;
    if wanted.is_empty() {
        let identity = source.identity().or_raise(py, Exit::Corrupt)?;
        whole::same_cameras(&known, &identity).or_raise(py, Exit::Usage)?;
    }
    let cameras = if wanted.is_empty() { known } else { wanted };
    whole::fits(calibration, &cameras, &source).or_raise(py, Exit::Usage)?;
    let all = source.triggers();
    let triggers = triggers.map_or(all.clone(), |(first, end)| first.max(all.start)..end.min(all.end));
    if triggers.is_empty() {
        let message =
            format!("expected triggers of the session, {} to {}", all.start, all.end.saturating_sub(1));
        return Err(fault(Fault::new(Exit::Usage, message)));
    }
    let mut formats = vec![Format::Phase];
    formats.extend(ply.then_some(Format::Ply));
    let count = (triggers.end - triggers.start) as usize;
    let plan = Plan { out, triggers, cameras, formats, uncertainty, ..Plan::default() };
    let work = |at: work::At<'_>| {
        let _ = at(0, count);
        let (mut summary, _) = run::run(&source, calibration, &plan, |done| at(done, count))?;
        let lost = source.lost().iter();
        whole::finish(&plan, None, calibration, &mut summary, lost, whole::RATE_HZ, |_, _| {})
    };
    work::watched(py, progress.as_ref(), work)?;
    progress.map_or(Ok(()), |progress| progress.bind(py).call1((count, count)).map(drop))
}
