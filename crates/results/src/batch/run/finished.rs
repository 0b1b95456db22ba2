// SPDX-License-Identifier: MIT OR Apache-2.0
//! What of a session's frames is finished already: made of the same frames, with the same parameters.

use super::{Camera, Job, cameras_comment};
use crate::base::ids::TriggerIndex;
use crate::batch::files::stated;
use crate::batch::plan::Format;
use crate::batch::summary::FrameSummary;
use crate::data::Frame;
use crate::formats::ply;

impl Job<'_> {
    /// The outcomes of a trigger's frames, where all of them are finished and were made of the frames that the source
    /// has; and the comment that names these.
    pub(super) fn finished_frames(&self, trigger: u64) -> Option<(Vec<FrameSummary>, String)> {
        let found = self.heads.iter().flatten().map(|camera| self.finished_frame(camera, trigger));
        let (frames, stated): (Vec<_>, Vec<_>) = found.collect::<Option<Vec<_>>>()?.into_iter().unzip();
        // Read last: of images this takes longer than all headers.
        let expected = self.frames(trigger);
        stated.iter().flatten().all(|stated| *stated == expected).then_some((frames, expected))
    }

    /// The outcome of a frame that is finished: with a cloud made with the same parameters, and the comment that
    /// names the frames that it was made of; or missing in the source. `None` with `--dump-maps`.
    pub(super) fn finished_frame(
        &self,
        camera: &Camera,
        trigger: u64,
    ) -> Option<(FrameSummary, Option<String>)> {
        if self.plan.maps.is_some() || self.plan.discard {
            return None;
        }
        let stated = |format: &Format| stated(&self.plan.out, *format, &camera.id, trigger);
        let headers: Option<Vec<ply::Header>> = self.plan.formats.iter().map(stated).collect();
        // Cloud and map of a frame state the same.
        let same = |headers: &Vec<ply::Header>| {
            headers
                .windows(2)
                .all(|pair| (pair[0].points, &pair[0].comments) == (pair[1].points, &pair[1].comments))
        };
        let header = headers.filter(same).and_then(|headers| headers.into_iter().next());
        let camera = &camera.id;
        let Some(header) = header else {
            return match self.source.frame(camera, TriggerIndex(trigger)) {
                Ok(Frame::Gap(cause)) => Some((FrameSummary::missing(camera, "gap", cause), None)),
                _ => None,
            };
        };
        let same = header.comment("parameters") == Some(&self.parameters);
        let of_trigger = self.identity(trigger).chain([cameras_comment(self.cameras())]);
        if !same || !of_trigger.into_iter().all(|comment| header.comments.contains(&comment)) {
            return None;
        }
        let frames = header.comments.iter().find(|comment| comment.starts_with("frames "))?.clone();
        let reason = header.comment("refused").map(str::to_owned);
        let summary = FrameSummary {
            camera: camera.clone(),
            outcome: if reason.is_some() { "refused" } else { "cloud" }.into(),
            reason,
            points: header.points,
            unresolved_px: header.comment("unresolved_px").and_then(|x| x.parse().ok()).unwrap_or(0),
            marker_offset_px: header.comment("marker_offset_px").and_then(|x| x.parse().ok()),
            differs_rad: header.comment("differs_rad").and_then(|x| x.parse().ok()),
        };
        Some((summary, Some(frames)))
    }
}
