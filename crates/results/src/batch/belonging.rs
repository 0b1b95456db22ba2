// SPDX-License-Identifier: MIT OR Apache-2.0
//! Whether the files of a result belong together. Each file states its session, parameters, trigger and camera; it is
//! held against its name, against `reconstruct.json` and against `summary.json`.
//!
//! What is *foreign* states something else than these three: it is not used. What is *missing* has points by the
//! summary and is not there. What the summary does not have, because the last run was one over other triggers, is
//! left out: its outcome is not known.

use super::files::{named, summary_path};
use super::key::Key;
use super::summary::{FrameSummary, TriggerSummary, load_summary};
use crate::formats::{CloudSource, Commented};
use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use std::path::Path;
use std::time::SystemTime;

/// What the files of a result must state; nothing where a directory has no descriptions of a result.
#[derive(Debug, Default)]
pub struct Expected {
    /// Of all files: comments as `session ID` and `parameters HASH`.
    stated: Vec<String>,
    /// Points of the frames that have a file, by trigger and camera; `None` without a summary.
    points: Option<BTreeMap<u64, BTreeMap<String, usize>>>,
    /// Those of merged clouds, where any were made.
    merged_points: BTreeMap<u64, usize>,
    times_ns: BTreeMap<u64, u64>,
    time_base: Option<String>,
    unfinished: Option<String>,
}

impl Expected {
    /// What the descriptions in a directory state of its files.
    ///
    /// # Errors
    /// Its descriptions cannot be read, or are of two results.
    pub fn of(directory: &Path) -> Result<Self, String> {
        let key = Key::load(directory)?;
        let mut expected = Self::default();
        let stated = |key: &Key| {
            vec![format!("session {}", key.session.id), format!("parameters {}", key.parameters())]
        };
        expected.stated = key.as_ref().map_or_else(Vec::new, stated);
        let path = summary_path(directory, None);
        if !path.exists() {
            let unfinished = || {
                format!(
                    "{}: not there; the run has not been finished, so that it is not known what is missing: \
                     run `fourdbody reconstruct` again",
                    path.display()
                )
            };
            expected.unfinished = key.is_some().then(unfinished);
            return Ok(expected);
        }
        let summary = load_summary(directory)?;
        if let Some(key) = key
            && (&summary.session.id, &summary.parameters) != (&key.session.id, &key.parameters())
        {
            return Err(format!(
                "{}: of the session {} with the parameters {}, but reconstruct.json is of {} with {}; run \
                 `fourdbody reconstruct` again",
                path.display(),
                summary.session,
                summary.parameters,
                key.session,
                key.parameters()
            ));
        }
        let has_file = |frame: &&FrameSummary| matches!(&*frame.outcome, "cloud" | "refused");
        let frames = |one: &TriggerSummary| {
            let frames =
                one.frames.iter().filter(has_file).map(|frame| (frame.camera.to_string(), frame.points));
            (one.trigger, frames.collect())
        };
        expected.points = Some(summary.triggers.iter().map(frames).collect());
        expected.times_ns =
            summary.triggers.iter().filter_map(|one| Some((one.trigger, one.time_ns?))).collect();
        expected.merged_points =
            summary.triggers.iter().filter_map(|one| Some((one.trigger, one.merged_points?))).collect();
        expected.time_base = summary.time_base;
        Ok(expected)
    }

    /// When a trigger was, ns since 1970, on the clock of [`Self::time_base`].
    pub fn time_ns(&self, trigger: u64) -> Option<u64> {
        self.times_ns.get(&trigger).copied()
    }

    /// What clock the times are of, in words.
    pub fn time_base(&self) -> Option<&str> {
        self.time_base.as_deref()
    }

    /// Whether the summary has this trigger, or there is no summary.
    pub fn speaks_of(&self, trigger: u64) -> bool {
        self.points.as_ref().is_none_or(|points| points.contains_key(&trigger))
    }

    /// Holds the comments of a file, and the number of its points where it is read whole, against its name: the
    /// trigger, and the camera where it is a directional cloud.
    ///
    /// # Errors
    /// It is of something else; of what, and what was expected.
    pub fn hold(
        &self,
        trigger: u64,
        camera: Option<&str>,
        points: Option<usize>,
        comments: &[String],
    ) -> Result<(), String> {
        let named = [Some(format!("trigger {trigger}")), camera.map(|camera| format!("camera {camera}"))];
        for expected in named.iter().flatten().chain(&self.stated) {
            let Some((key, _)) = expected.split_once(' ') else { continue };
            let is_of_key =
                |comment: &&String| comment.strip_prefix(key).is_some_and(|rest| rest.starts_with(' '));
            // A key that a file does not state is not compared: files of other programs and of older versions state
            // less.
            if let Some(found) = comments.iter().find(is_of_key).filter(|found| *found != expected) {
                return Err(format!(
                    "it is of {found}, expected {expected}: a file of something else, or a wrong name"
                ));
            }
        }
        let stated = match (self.at(trigger), camera) {
            (Some(frames), Some(camera)) => {
                Some(*frames.get(camera).ok_or("by summary.json this frame has no cloud")?)
            }
            (_, None) => self.merged_points.get(&trigger).copied(),
            (None, _) => None,
        };
        match points.zip(stated) {
            Some((points, stated)) if points != stated => {
                Err(format!("it has {points} points, summary.json states {stated}"))
            }
            _ => Ok(()),
        }
    }

    /// Points of a trigger's frames by camera.
    fn at(&self, trigger: u64) -> Option<&BTreeMap<String, usize>> {
        self.points.as_ref()?.get(&trigger)
    }

    /// The cameras that have a file of a trigger by the summary.
    pub fn cameras_at(&self, trigger: u64) -> BTreeSet<String> {
        self.at(trigger).into_iter().flat_map(|frames| frames.keys().cloned()).collect()
    }

    /// Whether a trigger has points by the summary.
    pub fn has_points(&self, trigger: u64) -> bool {
        self.at(trigger).is_some_and(|frames| frames.values().any(|points| *points > 0))
    }

    /// The triggers that have points by the summary.
    pub fn triggers_with_points(&self) -> impl Iterator<Item = u64> + '_ {
        self.points.iter().flatten().map(|(trigger, _)| *trigger).filter(|trigger| self.has_points(*trigger))
    }

    /// The cameras that have points at a trigger by the summary, and no file.
    pub fn missing_at(&self, trigger: u64, there: &Listed) -> impl Iterator<Item = &str> {
        let lit = self.at(trigger).into_iter().flatten().filter(|(_, points)| **points > 0);
        let there = there.get(&trigger).cloned().unwrap_or_default();
        lit.map(|(camera, _)| camera.as_str()).filter(move |camera| !there.contains(*camera))
    }

    /// A sentence for each camera whose files are missing at these triggers, and one for the files that must be left
    /// out.
    pub fn amiss(
        &self,
        there: &Listed,
        triggers: &Range<u64>,
        cameras: &dyn Fn(&str) -> bool,
    ) -> Vec<String> {
        let mut amiss: Vec<String> = self.unfinished.iter().cloned().collect();
        let Some(points) = &self.points else { return amiss };
        let mut missing: BTreeMap<&str, Vec<u64>> = BTreeMap::new();
        for (&trigger, _) in points.range(triggers.clone()) {
            for camera in self.missing_at(trigger, there).filter(|camera| cameras(camera)) {
                missing.entry(camera).or_default().push(trigger);
            }
        }
        let sentence = |(camera, triggers): (&str, Vec<u64>)| {
            format!("MISSING  {camera}: the files of {}, which have points by summary.json", named(&triggers))
        };
        amiss.extend(missing.into_iter().map(sentence));
        let unknown: Vec<u64> =
            there.range(triggers.clone()).map(|(t, _)| *t).filter(|t| !self.speaks_of(*t)).collect();
        if !unknown.is_empty() {
            let left_out = named(&unknown);
            amiss.push(format!(
                "LEFT OUT  {left_out}: summary.json does not have them; run `fourdbody reconstruct` over \
                 all triggers, which keeps what is finished"
            ));
        }
        amiss
    }
}

/// Cameras that have a file, by trigger.
pub type Listed = BTreeMap<u64, BTreeSet<String>>;

/// The cameras of a source that have a file.
pub fn listed(source: &dyn CloudSource) -> Listed {
    let name = |&place: &usize| source.cameras()[place].1.clone();
    source.triggers().iter().map(|(trigger, places)| (*trigger, places.iter().map(name).collect())).collect()
}

/// Clouds, each of which is held against what the result states of it. Whoever reads a result makes it around the
/// source of its clouds; it refuses each file that is of something else, and lasts as long as the source.
pub struct Held<'a> {
    source: &'a dyn CloudSource,
    expected: &'a Expected,
    triggers: BTreeMap<u64, Vec<usize>>,
}

impl<'a> Held<'a> {
    /// The clouds of a source whose triggers the summary has.
    pub fn new(source: &'a dyn CloudSource, expected: &'a Expected) -> Self {
        let all = source.triggers().iter().filter(|(trigger, _)| expected.speaks_of(**trigger));
        Self {
            source,
            expected,
            triggers: all.map(|(trigger, cameras)| (*trigger, cameras.clone())).collect(),
        }
    }
}

impl CloudSource for Held<'_> {
    fn cameras(&self) -> &[(u8, String)] {
        self.source.cameras()
    }

    fn triggers(&self) -> &BTreeMap<u64, Vec<usize>> {
        &self.triggers
    }

    fn clouds(&self, trigger: u64, cameras: &[usize]) -> Result<Vec<Commented>, String> {
        let clouds = self.source.clouds(trigger, cameras)?;
        for ((comments, cloud), &camera) in clouds.iter().zip(cameras) {
            let name = &self.source.cameras()[camera].1;
            // Picked out of a merged cloud it states no camera.
            let is_own = comments.iter().any(|comment| comment.starts_with("camera "));
            let own = is_own.then_some((name.as_str(), cloud.len()));
            let held = self.expected.hold(trigger, own.map(|x| x.0), own.map(|x| x.1), comments);
            held.map_err(|reason| format!("FOREIGN  camera {name}, trigger {trigger}: {reason}"))?;
        }
        Ok(clouds)
    }

    fn modified(&self, trigger: u64, cameras: &[usize]) -> Option<SystemTime> {
        self.source.modified(trigger, cameras)
    }

    fn time_ns(&self, trigger: u64) -> Option<u64> {
        self.expected.time_ns(trigger).or_else(|| self.source.time_ns(trigger))
    }
}

#[cfg(test)]
mod tests {
    use super::Expected;

    fn comments(of: &[&str]) -> Vec<String> {
        of.iter().map(|text| (*text).to_owned()).collect()
    }

    #[test]
    fn a_file_is_held_against_its_name_its_session_and_the_summary() {
        let points = Some([(3, [("h0_up".to_owned(), 7)].into())].into());
        let stated = comments(&["session 01", "parameters ab"]);
        let expected = Expected { stated, points, ..Expected::default() };
        let own = comments(&["fourdbody 1", "parameters ab", "trigger 3", "session 01", "camera h0_up"]);
        let hold = |camera: &str, trigger, points, comments: &[String]| {
            expected.hold(trigger, Some(camera), Some(points), comments)
        };
        assert_eq!(hold("h0_up", 3, 7, &own), Ok(()));
        assert_eq!(hold("h0_up", 3, 7, &[]), Ok(()), "what states nothing is of another program, or older");
        let foreign = |camera, trigger, points, comments: &[String], words: &str| {
            let error = hold(camera, trigger, points, comments).expect_err(words);
            assert!(error.contains(words), "{error}");
        };
        foreign("h0_up", 4, 7, &own, "it is of trigger 3, expected trigger 4");
        foreign("h0_low", 3, 7, &own, "it is of camera h0_up, expected camera h0_low");
        foreign("h0_up", 3, 8, &own, "it has 8 points, summary.json states 7");
        let mut other = own.clone();
        other[3] = "session 02".to_owned();
        foreign("h0_up", 3, 7, &other, "it is of session 02, expected session 01");
        other[1] = "parameters cd".to_owned();
        foreign("h0_up", 3, 7, &other, "it is of session 02");
        let of_low = comments(&["camera h0_low", "trigger 3"]);
        foreign("h0_low", 3, 7, &of_low, "no cloud");
    }
}
