// SPDX-License-Identifier: MIT OR Apache-2.0
//! What is written of a frame: its cloud, its phase map, and what both state of where they come from.

use super::{Camera, Format, Job, cameras_comment, frame_path};
use crate::batch::dump_maps;
use crate::batch::summary::FrameSummary;
use crate::data::Cloud;
use crate::formats::phase_file::{self, Statement};
use crate::formats::ply;
use crate::reconstruct::outcome::{Outcome, Reconstruction};
use std::borrow::Cow;
use std::io;
use std::path::Path;

impl Job<'_> {
    pub(super) fn comments(&self, trigger: u64, frames: &str) -> Vec<String> {
        let mut comments = vec![
            format!("fourdbody {}", env!("CARGO_PKG_VERSION")),
            format!("parameters {}", self.parameters),
            format!("calibration {}: {}", self.calibration.rig, self.calibration.origin),
        ];
        comments.extend(self.identity(trigger));
        comments.push(frames.to_owned());
        comments
    }

    /// The comments that state session, trigger and time.
    pub(super) fn identity(&self, trigger: u64) -> impl Iterator<Item = String> {
        let time = self.time_ns(trigger).map(|ns| format!("time_ns {ns}"));
        [format!("session {}", self.session), format!("trigger {trigger}")].into_iter().chain(time)
    }

    pub(super) fn merged_comments(&self, trigger: u64, frames: &str) -> Vec<String> {
        let mut comments = self.comments(trigger, frames);
        let names = self.heads.iter().flatten().map(|c| format!("{}={}", c.number, c.id));
        comments.push(format!("cameras {}", names.collect::<Vec<_>>().join(" ")));
        comments
    }

    /// Writes what the plan has of a frame: cloud, phase map, and pictures of its maps.
    pub(super) fn save(
        &self,
        camera: &Camera,
        trigger: u64,
        result: Reconstruction,
        frames: &str,
    ) -> Result<(FrameSummary, Cloud), String> {
        let id = &camera.id;
        if let (Some(folder), Some(maps)) = (&self.plan.maps, &result.maps) {
            dump_maps::write(folder, &format!("{id}_{trigger:06}"), maps)
                .map_err(|e| format!("{}: {e}", folder.display()))?;
        }
        let mut comments = self.comments(trigger, frames);
        comments.push(format!("camera {id}"));
        comments.push(camera.viewpoint.comment());
        comments.push(cameras_comment(self.cameras()));
        comments.push(format!("unresolved_px {}", result.counts.refused));
        let marker_offset_px = result.counts.dashes.offset_px;
        comments.extend(marker_offset_px.map(|offset| format!("marker_offset_px {offset}")));
        let differs_rad = Some(result.counts.differs_rad).filter(|by| *by > 0.0);
        comments.extend(differs_rad.map(|by| format!("differs_rad {by}")));
        let (outcome, reason) = match &result.outcome {
            Outcome::Cloud => ("cloud", None),
            Outcome::Refused(reason) => ("refused", Some(reason.clone())),
        };
        comments.extend(reason.iter().map(|reason| format!("refused {reason}")));
        if !self.plan.discard {
            for &format in &self.plan.formats {
                let path = frame_path(&self.plan.out, format, id, trigger);
                let saved = match format {
                    Format::Ply => ply::save(&path, &result.cloud, &comments),
                    Format::Phase => {
                        let comments = [comments.clone(), self.merged_comments(trigger, frames)];
                        self.write_map(&path, camera, trigger, &result, comments)
                    }
                };
                saved.map_err(|e| format!("{}: {e}", path.display()))?;
            }
        }
        self.timings().add(&result.stages);
        let (points, unresolved_px) = (result.counts.points, result.counts.refused);
        let (camera, outcome) = (id.clone(), outcome.into());
        let summary =
            FrameSummary { camera, outcome, reason, points, unresolved_px, marker_offset_px, differs_rad };
        let cloud = if self.plan.merges() { result.cloud } else { Cloud::default() };
        Ok((summary, cloud))
    }

    fn write_map(
        &self,
        path: &Path,
        camera: &Camera,
        trigger: u64,
        result: &Reconstruction,
        [comments, merged_comments]: [Vec<String>; 2],
    ) -> io::Result<()> {
        let mut map = Cow::Borrowed(&result.phase);
        if map.runs.is_empty() {
            // A frame refused before it was looked at closely.
            map.to_mut().frame = camera.pipeline.frame().map(|x| x as u16);
        }
        let (geometry_sha256, volume_m) = self.calibration_statement.clone();
        let statement = Statement {
            camera: camera.id.to_string(),
            trigger,
            time_ns: self.time_ns(trigger),
            geometry_sha256,
            volume_m,
            points: result.counts.points,
            comments,
            merged_comments,
        };
        phase_file::save(path, &statement, &map)
    }
}
