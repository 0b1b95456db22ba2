// SPDX-License-Identifier: MIT OR Apache-2.0
//! The outcome of every frame of a run: `OUT/summary.json`.

use super::files::summary_path;
use super::key::Key;
use super::plan::Plan;
use super::unchecked::unchecked;
use crate::base::ids::CameraId;
use crate::base::{json, regular};
use crate::data::{Calibration, SessionIdentity};
use crate::reconstruct::outcome::NO_OBJECT;
use crate::reconstruct::paper;
use crate::reconstruct::pipeline::Method;
use serde::{Deserialize, Serialize};
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::path::Path;

/// The summary of a run over all triggers.
pub fn load_summary(out: &Path) -> Result<Summary, String> {
    let path = summary_path(out, None);
    let text =
        regular::read(&path, regular::SUMMARY_BYTES).map_err(|e| format!("{}: {e}", path.display()))?;
    json::from_slice(&text).map_err(|e| format!("{}: {e}; another version wrote it", path.display()))
}

/// The outcome of one frame.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FrameSummary {
    pub camera: CameraId,
    /// `cloud`, `refused` (no fringe order can be trusted), `gap` (no frame) or `damaged`.
    pub outcome: Cow<'static, str>,
    /// Why there is no cloud.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
    /// Points of the directional cloud.
    pub points: usize,
    /// Object pixels left out because their fringe order is not certain.
    pub unresolved_px: usize,
    /// How far the marker's dashes lie from where the calibration has them, px of the panel
    /// ([`crate::reconstruct::marker::epipolar_check::Dashes::offset_px`]): a fraction of one, unless a device has
    /// moved.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub marker_offset_px: Option<f32>,
    /// By how much the camera differs from the others in the mean, where they see one surface, rad; absent where too few
    /// places tell.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub differs_rad: Option<f32>,
}

impl FrameSummary {
    /// A frame that is not there, or cannot be read.
    pub fn missing(camera: &CameraId, outcome: &'static str, reason: String) -> Self {
        let (camera, outcome, reason) = (camera.clone(), outcome.into(), Some(reason));
        Self {
            camera,
            outcome,
            reason,
            points: 0,
            unresolved_px: 0,
            marker_offset_px: None,
            differs_rad: None,
        }
    }
}

/// The outcome of one trigger.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TriggerSummary {
    pub trigger: u64,
    /// When it was, ns since 1970 on the clock of [`Summary::time_base`]; absent where the source knows no times.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub time_ns: Option<u64>,
    /// Points of the merged cloud; absent where none is made, as of phase maps.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub merged_points: Option<usize>,
    /// Its frames, in the calibration's order.
    pub frames: Vec<FrameSummary>,
}

/// The outcome of a run. [`super::run::run`] makes it, later steps add what they find, and `summary.json` keeps it as
/// long as the results: every frame of the run has exactly one outcome in it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Summary {
    /// The session whose frames were reconstructed.
    pub session: SessionIdentity,
    /// The number of the algorithm that made the clouds ([`super::key::ALGORITHM`]).
    pub algorithm: u32,
    /// Hash of everything that the clouds depend on beside the frames.
    pub parameters: String,
    /// `joint` or `paper`, as the command line calls it.
    pub method: Cow<'static, str>,
    /// Cameras of the session or of the calibration that were left out, as the options request; absent where there
    /// are none.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub left_out: Vec<CameraId>,
    /// Parts of the session that cannot be read, a sentence each; absent where there are none.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub unreadable: Vec<String>,
    /// What fringe orders were not checked against, though they could be, a sentence each; absent where there is
    /// nothing.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub unchecked: Vec<String>,
    /// Pairs of frames one of which shows another trigger, without proof which, a sentence each; absent where there
    /// are none.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub suspects: Vec<String>,
    /// What clock the triggers' times are of, in words; absent where there are no times.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub time_base: Option<String>,
    pub frames: usize,
    pub clouds: usize,
    pub refused: usize,
    pub gaps: usize,
    /// Frames that could not be read.
    pub damaged: usize,
    /// Points of all merged clouds; absent where none are made.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub merged_points: Option<usize>,
    pub triggers: Vec<TriggerSummary>,
}

impl Summary {
    /// Writes it, which is never half there. The error names the file.
    pub fn save(&self, path: &Path) -> Result<(), String> {
        json::save(path, self)
    }

    /// The outcome of all triggers together.
    pub(crate) fn of(
        triggers: Vec<TriggerSummary>,
        key: &Key,
        plan: &Plan,
        calibration: &Calibration,
    ) -> Self {
        let known = calibration.cameras().map(|(_, camera)| &camera.id);
        let beyond = key.session.cameras.iter().filter(|id| calibration.camera(id).is_none());
        let mut summary = Self {
            session: key.session.clone(),
            algorithm: key.algorithm,
            parameters: key.parameters(),
            method: key.method.clone().into(),
            left_out: known.chain(beyond).filter(|id| !key.cameras.contains(id)).cloned().collect(),
            unreadable: Vec::new(),
            unchecked: match plan.method {
                Method::Joint => unchecked(calibration, &plan.cameras),
                Method::Paper => vec![paper::UNCHECKED.to_owned()],
            },
            suspects: Vec::new(),
            time_base: None,
            frames: 0,
            clouds: 0,
            refused: 0,
            gaps: 0,
            damaged: 0,
            merged_points: plan.merges().then_some(0),
            triggers,
        };
        summary.count();
        summary
    }

    /// Counts its frames and points.
    pub(super) fn count(&mut self) {
        let frames = || self.triggers.iter().flat_map(|trigger| &trigger.frames);
        let count = |outcome: &str| frames().filter(|frame| frame.outcome == outcome).count();
        let all = (frames().count(), count("cloud"), count("refused"), count("gap"), count("damaged"));
        let merged = self.merged_points.map(|_| self.triggers.iter().filter_map(|t| t.merged_points).sum());
        (self.frames, self.clouds, self.refused, self.gaps, self.damaged) = all;
        self.merged_points = merged;
    }

    /// The mean of `marker_offset_px` over each camera's clouds.
    pub fn marker_offsets_px(&self) -> BTreeMap<&CameraId, f32> {
        self.means(|frame| frame.marker_offset_px)
    }

    /// The mean of `differs_rad` over each camera's clouds.
    pub fn differ_rad(&self) -> BTreeMap<&CameraId, f32> {
        self.means(|frame| frame.differs_rad)
    }

    /// The mean of what clouds have, by camera.
    fn means(&self, of: impl Fn(&FrameSummary) -> Option<f32>) -> BTreeMap<&CameraId, f32> {
        let mut sums = BTreeMap::<_, (f32, f32)>::new();
        let frames = self.triggers.iter().flat_map(|trigger| &trigger.frames);
        for frame in frames.filter(|frame| frame.outcome == "cloud") {
            if let Some(value) = of(frame) {
                let sum = sums.entry(&frame.camera).or_default();
                (sum.0, sum.1) = (sum.0 + value, sum.1 + 1.0);
            }
        }
        sums.into_iter().map(|(camera, (sum, frames))| (camera, sum / frames)).collect()
    }

    /// Frames in which there is no light: nothing is lost where they have no cloud.
    pub fn dark(&self) -> usize {
        let frames = self.triggers.iter().flat_map(|trigger| &trigger.frames);
        frames.filter(|frame| frame.reason.as_deref() == Some(NO_OBJECT)).count()
    }

    /// The reason that most refused frames have.
    pub fn most_refused_for(&self) -> Option<&str> {
        let mut counts = BTreeMap::<&str, usize>::new();
        let frames = self.triggers.iter().flat_map(|trigger| &trigger.frames);
        for reason in frames.filter_map(|frame| frame.reason.as_deref()) {
            *counts.entry(reason).or_default() += 1;
        }
        counts.into_iter().max_by_key(|(_, count)| *count).map(|(reason, _)| reason)
    }

    /// Points of all directional clouds.
    pub fn points(&self) -> usize {
        self.triggers.iter().flat_map(|trigger| &trigger.frames).map(|frame| frame.points).sum()
    }
}
