// SPDX-License-Identifier: MIT OR Apache-2.0
//! A directory that `reconstruct` wrote: its clouds, and its phase maps.

use crate::arrays;
use crate::error::OrRaise;
use fourdbody_core::base::Exit;
use fourdbody_core::data::{STEPS_PER_FRINGE, STEPS_PER_LEVEL, decode_sigma};
use fourdbody_core::formats::phase_file;
use fourdbody_results::batch::result::Clouds;
use numpy::IntoPyArray;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use std::path::PathBuf;

#[pyclass(frozen)]
pub struct Result {
    path: PathBuf,
    clouds: Clouds,
}

#[pymethods]
impl Result {
    #[new]
    fn new(py: Python<'_>, path: PathBuf) -> PyResult<Self> {
        let clouds = py.detach(|| Clouds::open(&path)).or_raise(py, Exit::Corrupt)?;
        Ok(Self { path, clouds })
    }

    /// The triggers that have a cloud, in order.
    fn triggers(&self) -> Vec<u64> {
        let mut triggers: Vec<u64> = self.clouds.merged.keys().copied().collect();
        triggers.extend(self.clouds.directional.keys().map(|(trigger, _)| *trigger));
        triggers.sort_unstable();
        triggers.dedup();
        triggers
    }

    /// Arrays and comments of a cloud: of one camera, or merged. `None` where there is none.
    fn cloud<'py>(
        &self,
        py: Python<'py>,
        trigger: u64,
        camera: Option<String>,
    ) -> PyResult<Option<(Bound<'py, PyDict>, Vec<String>)>> {
        let place = match camera {
            None => self.clouds.merged.get(&trigger),
            Some(camera) => self.clouds.directional.get(&(trigger, camera)),
        };
        let Some(place) = place else { return Ok(None) };
        let (comments, cloud) = py.detach(|| self.clouds.load(place)).or_raise(py, Exit::Corrupt)?;
        Ok(Some((arrays::cloud(py, cloud)?, comments)))
    }

    /// Pixels, phase and light of a stored phase map; `None` where there is none.
    fn phase<'py>(
        &self,
        py: Python<'py>,
        trigger: u64,
        camera: &str,
    ) -> PyResult<Option<Bound<'py, PyDict>>> {
        let path = self.path.join("phases").join(format!("{camera}_{trigger:06}.phase"));
        if !path.exists() {
            return Ok(None);
        }
        let (_, map) = py.detach(|| phase_file::load(&path)).or_raise(py, Exit::Corrupt)?;
        let pixels = map.pixels().collect::<Vec<[u16; 2]>>();
        let columns = PyDict::new(py);
        columns.set_item("size", (map.frame[0], map.frame[1]))?;
        columns.set_item("uv", arrays::table(py, pixels)?)?;
        let phase = map.phase.iter().map(|steps| f64::from(*steps) / f64::from(STEPS_PER_FRINGE));
        columns.set_item("fringes", phase.collect::<Vec<f64>>().into_pyarray(py))?;
        let light = map.light.iter().map(|steps| f32::from(*steps) / STEPS_PER_LEVEL);
        columns.set_item("light_dn", light.collect::<Vec<f32>>().into_pyarray(py))?;
        let sigma = map.sigma_code.iter().map(|code| decode_sigma(*code)).collect::<Vec<f32>>();
        columns.set_item("sigma_rad", (!sigma.is_empty()).then(|| sigma.into_pyarray(py)))?;
        Ok(Some(columns))
    }
}
