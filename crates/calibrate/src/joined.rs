// SPDX-License-Identifier: MIT OR Apache-2.0
//! Photographs that were taken in several sessions, as one source: triggers run on from session to session.

use crate::base::ids::{CameraId, TriggerIndex};
use crate::data::{Frame, FrameSource, LostPart, SourceStatement};
use std::ops::Range;

/// Sources one after the other; each of them may be in several parts, one per node.
#[derive(Default)]
pub struct Joined {
    sessions: Vec<Session>,
    cameras: Vec<CameraId>,
    lost: Vec<LostPart>,
}

struct Session {
    parts: Vec<Box<dyn FrameSource>>,
    /// Its triggers in the joined source.
    triggers: Range<u64>,
    /// The first of them in the parts themselves.
    own_start: u64,
}

impl Joined {
    /// Adds a session behind the others.
    pub fn push(&mut self, parts: Vec<Box<dyn FrameSource>>) {
        for camera in parts.iter().flat_map(|part| part.cameras()) {
            if !self.cameras.contains(camera) {
                self.cameras.push(camera.clone());
            }
        }
        self.lost.extend(parts.iter().flat_map(|part| part.lost()).cloned());
        let own_start = parts.iter().map(|part| part.triggers().start).min().unwrap_or(0);
        let own_end = parts.iter().map(|part| part.triggers().end).max().unwrap_or(0).max(own_start);
        let start = self.triggers().end;
        let triggers = start..start + (own_end - own_start);
        self.sessions.push(Session { parts, triggers, own_start });
    }

    /// Takes the last session away again.
    pub fn pop(&mut self) {
        if let Some(session) = self.sessions.pop() {
            let gone = session.parts.iter().map(|part| part.lost().len()).sum::<usize>();
            self.lost.truncate(self.lost.len().saturating_sub(gone));
        }
    }

    /// The parts of all sessions, to be pushed to another.
    pub fn into_parts(self) -> Vec<Box<dyn FrameSource>> {
        self.sessions.into_iter().flat_map(|session| session.parts).collect()
    }

    /// How many sessions there are.
    pub fn len(&self) -> usize {
        self.sessions.len()
    }

    /// Whether there is no session yet.
    pub fn is_empty(&self) -> bool {
        self.sessions.is_empty()
    }
}

impl FrameSource for Joined {
    fn cameras(&self) -> &[CameraId] {
        &self.cameras
    }

    fn triggers(&self) -> Range<u64> {
        0..self.sessions.last().map_or(0, |session| session.triggers.end)
    }

    fn frame(&self, camera: &CameraId, trigger: TriggerIndex) -> Result<Frame<'_>, String> {
        let session = self.sessions.iter().find(|session| session.triggers.contains(&trigger.0));
        let session = session.ok_or_else(|| format!("trigger {trigger} lies in none of the sessions"))?;
        let part = session.parts.iter().find(|part| part.cameras().contains(camera));
        let lost = part.and_then(|part| part.lost().iter().find(|lost| lost.cameras.contains(camera)));
        match part {
            // This camera misses one position; the others have theirs.
            Some(_) if let Some(lost) = lost => Ok(Frame::Gap(lost.to_string())),
            Some(part) => {
                part.frame(camera, TriggerIndex(trigger.0 - session.triggers.start + session.own_start))
            }
            None => Ok(Frame::Gap("the session does not have this camera".to_owned())),
        }
    }

    fn lost(&self) -> &[LostPart] {
        &self.lost
    }

    /// Of the first session; cameras do not change between positions.
    fn statement(&self) -> Option<SourceStatement> {
        let stated: Vec<SourceStatement> =
            self.sessions.first()?.parts.iter().filter_map(|part| part.statement()).collect();
        let pattern = stated.first()?.pattern.clone();
        Some(SourceStatement { cameras: stated.into_iter().flat_map(|s| s.cameras).collect(), pattern })
    }
}

#[cfg(test)]
mod tests {
    use super::Joined;
    use crate::base::ids::{CameraId, TriggerIndex};
    use crate::base::image::Plane;
    use crate::data::{Frame, FrameSource, LostPart};
    use std::ops::Range;

    struct One(CameraId, Range<u64>);

    /// Of a node whose recording cannot be read.
    struct Lost(Vec<CameraId>, LostPart);

    impl FrameSource for Lost {
        fn cameras(&self) -> &[CameraId] {
            &self.0
        }
        fn triggers(&self) -> Range<u64> {
            0..2
        }
        fn frame(&self, _: &CameraId, _: TriggerIndex) -> Result<Frame<'_>, String> {
            Err("cannot be read".to_owned())
        }
        fn lost(&self) -> &[LostPart] {
            std::slice::from_ref(&self.1)
        }
    }

    #[test]
    fn a_position_whose_recording_cannot_be_read_is_one_less() {
        let camera = CameraId::from("b");
        let part = LostPart {
            reason: "node b: its recording cannot be read".to_owned(),
            cameras: vec![camera.clone()],
        };
        let mut joined = Joined::default();
        joined.push(vec![Box::new(One(camera.clone(), 0..2))]);
        joined.push(vec![Box::new(Lost(vec![camera.clone()], part.clone()))]);
        assert_eq!(joined.lost(), [part]);
        assert!(matches!(joined.frame(&camera, TriggerIndex(1)), Ok(Frame::Owned(_))));
        let gap = joined.frame(&camera, TriggerIndex(2));
        assert!(matches!(&gap, Ok(Frame::Gap(reason)) if reason.contains("node b")), "{gap:?}");
        joined.pop();
        assert!(joined.lost().is_empty());
    }

    impl FrameSource for One {
        fn cameras(&self) -> &[CameraId] {
            std::slice::from_ref(&self.0)
        }
        fn triggers(&self) -> Range<u64> {
            self.1.clone()
        }
        fn frame(&self, _: &CameraId, trigger: TriggerIndex) -> Result<Frame<'_>, String> {
            Ok(Frame::Owned(Plane::filled(1, 1, trigger.0 as u8)))
        }
    }

    #[test]
    fn triggers_run_on_from_session_to_session() {
        let part = |camera: &str, triggers| Box::new(One(CameraId::from(camera), triggers)) as Box<_>;
        let mut joined = Joined::default();
        joined.push(vec![part("a", 0..2), part("b", 0..2)]);
        joined.push(vec![part("a", 5..7)]);
        assert_eq!((joined.triggers(), joined.cameras().len()), (0..4, 2));
        let value = |camera: &str, trigger| match joined.frame(&CameraId::from(camera), TriggerIndex(trigger))
        {
            Ok(Frame::Owned(plane)) => Some(plane.at(0, 0)),
            _ => None,
        };
        assert_eq!(
            (value("a", 1), value("b", 1), value("a", 3), value("b", 3)),
            (Some(1), Some(1), Some(6), None)
        );
        assert!(joined.frame(&CameraId::from("a"), TriggerIndex(4)).is_err());
    }
}
