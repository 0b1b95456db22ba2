// SPDX-License-Identifier: MIT OR Apache-2.0
//! What is good and what is bad: every threshold by its name, once. `status`, the console and reports show these.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// How a value is judged.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Grade {
    /// The value is as it should be.
    Good,
    /// The value lies between the two bounds.
    Fair,
    /// Frames are lost, or soon will be.
    Bad,
}

/// A measured value's bounds. Where `good` is below `bad`, less is better; otherwise more is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Threshold {
    /// Its name, with no unit.
    pub name: &'static str,
    /// Of the value and both bounds.
    pub unit: &'static str,
    /// Good up to here, this included.
    pub good: f64,
    /// Bad from here on, this included.
    pub bad: f64,
    /// What is measured, and what follows when it is bad.
    pub meaning: &'static str,
}

/// Number of the node's cameras that cannot be used.
pub const CAMERAS_MISSING: Threshold = Threshold {
    name: "cameras_missing",
    unit: "cameras",
    good: 0.0,
    bad: 1.0,
    meaning: "cameras that do not answer: no session can start",
};
/// Whether the link to the HSU is down.
pub const HSU_MISSING: Threshold = Threshold {
    name: "hsu_missing",
    unit: "links",
    good: 0.0,
    bad: 1.0,
    meaning: "links to the HSU that are down: no session can start",
};
/// Seconds of capture until the disk is full.
pub const DISK_TIME_LEFT: Threshold = Threshold {
    name: "disk_time_left",
    unit: "s",
    good: 600.0,
    bad: 60.0,
    meaning: "seconds of capture that the disk still holds, above its reserve",
};
/// Share of the frames that have a gap record in their place.
pub const FRAMES_MISSING: Threshold = Threshold {
    name: "frames_missing",
    unit: "%",
    good: 0.0,
    bad: 0.1,
    meaning: "share of the frames so far that are missing; a single one makes the verdict incomplete",
};
/// The highest level of the ring before the writer.
pub const RING_HIGH_WATER: Threshold = Threshold {
    name: "ring_high_water",
    unit: "%",
    good: 25.0,
    bad: 75.0,
    meaning: "highest level of the buffer before the disk in this session; when it is full, frames are lost",
};
/// Time from a frame's last packet until its trigger is known.
pub const MATCH_P99: Threshold = Threshold {
    name: "match_p99",
    unit: "ms",
    good: 50.0,
    bad: 250.0,
    meaning: "time from a frame's last packet until its trigger is known, for 99 of 100 frames",
};
/// Time in the ring until the writer has taken the frame.
pub const WRITE_P99: Threshold = Threshold {
    name: "write_p99",
    unit: "ms",
    good: 100.0,
    bad: 300.0,
    meaning: "time in the buffer before the disk, for 99 of 100 frames; it holds 400 ms at 120 Hz",
};
/// Time from the writer until the frame survives a power cut.
pub const DURABLE_P99: Threshold = Threshold {
    name: "durable_p99",
    unit: "ms",
    good: 600.0,
    bad: 1000.0,
    meaning: "time until a written frame survives a power cut, for 99 of 100 frames; expected below a second",
};

/// Share of a picture's lit pixels that are saturated.
pub const SATURATED: Threshold = Threshold {
    name: "saturated",
    unit: "%",
    good: 0.2,
    bad: 1.0,
    meaning: "share of a camera's lit pixels that are saturated: a clipped fringe has no phase",
};
/// Median amplitude of the fringes in a picture.
pub const MODULATION: Threshold = Threshold {
    name: "modulation",
    unit: "DN",
    good: 30.0,
    bad: 12.0,
    meaning: "median fringe amplitude of the lit pixels: with a smaller one, points are noisier",
};
/// Share of the picture that is lit.
pub const LIT: Threshold = Threshold {
    name: "lit",
    unit: "%",
    good: 2.0,
    bad: 0.5,
    meaning: "share of a camera's picture that is lit: is the subject in place, and is the light on?",
};

/// All thresholds, in the order in which they are shown.
pub const ALL: [Threshold; 11] = [
    CAMERAS_MISSING,
    HSU_MISSING,
    DISK_TIME_LEFT,
    FRAMES_MISSING,
    RING_HIGH_WATER,
    MATCH_P99,
    WRITE_P99,
    DURABLE_P99,
    SATURATED,
    MODULATION,
    LIT,
];

/// A measured value with its threshold and grade.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Judgement {
    /// The name of the threshold, such as `ring_high_water`.
    pub name: String,
    /// Of the value and both bounds.
    pub unit: String,
    /// The measured value, in `unit`.
    pub value: f64,
    /// Good up to here (or from here on, where more is better).
    pub good: f64,
    /// Bad from here on (or up to here).
    pub bad: f64,
    /// The grade of the value by these bounds.
    pub grade: Grade,
    /// What is measured, and what follows when it is bad.
    pub meaning: String,
}

impl Threshold {
    /// Where a value lies; one that is no number is bad.
    pub fn grade(&self, value: f64) -> Grade {
        let (value, good, bad) =
            if self.good < self.bad { (value, self.good, self.bad) } else { (-value, -self.good, -self.bad) };
        if value <= good {
            Grade::Good
        } else if value < bad {
            Grade::Fair
        } else {
            Grade::Bad
        }
    }

    /// Grades a value, and returns it with its bounds.
    pub fn judge(&self, value: f64) -> Judgement {
        Judgement {
            name: self.name.to_owned(),
            unit: self.unit.to_owned(),
            value,
            good: self.good,
            bad: self.bad,
            grade: self.grade(value),
            meaning: self.meaning.to_owned(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{ALL, DISK_TIME_LEFT, FRAMES_MISSING, Grade, RING_HIGH_WATER};

    #[test]
    fn bounds_belong_to_their_grade() {
        assert_eq!(
            [25.0, 25.1, 74.9, 75.0, f64::NAN].map(|value| RING_HIGH_WATER.grade(value)),
            [Grade::Good, Grade::Fair, Grade::Fair, Grade::Bad, Grade::Bad]
        );
        assert_eq!(
            [1e9, 600.0, 599.0, 60.0, 0.0].map(|value| DISK_TIME_LEFT.grade(value)),
            [Grade::Good, Grade::Good, Grade::Fair, Grade::Bad, Grade::Bad]
        );
        assert_eq!(FRAMES_MISSING.grade(1e-4), Grade::Fair);
    }

    #[test]
    fn names_are_unique_and_bounds_apart() {
        for (i, threshold) in ALL.iter().enumerate() {
            assert!(ALL[..i].iter().all(|other| other.name != threshold.name));
            assert!(threshold.good != threshold.bad);
        }
    }
}
