// SPDX-License-Identifier: MIT OR Apache-2.0
//! Several takes of the same: named in a row, with pauses, ended together.

use super::report::Captured;
use super::run::{CaptureRequest, Control, Nodes, Stage, capture};
use crate::base::{Exit, Fault};
use serde::{Deserialize, Serialize};
use std::time::{Duration, Instant};

/// Takes of one wish.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct Series {
    /// Each take; with several of them its name gets `-01`, `-02`, ...
    #[serde(default)]
    pub wish: CaptureRequest,
    /// How many, at least one.
    #[serde(default = "one")]
    pub takes: u32,
    /// Seconds from the end of a take to the preparation of the next.
    #[serde(default)]
    pub pause_s: u32,
}

fn one() -> u32 {
    1
}

/// More takes than this are a slip of the finger.
pub const TAKES_MAX: u32 = 99;
/// As are pauses longer than this.
pub const PAUSE_MAX_S: u32 = 3600;

impl Series {
    /// A single take.
    pub fn single(wish: CaptureRequest) -> Self {
        Self { wish, takes: 1, pause_s: 0 }
    }

    /// What is asked for, or what is wrong with it.
    pub fn check(&self) -> Result<(), Fault> {
        let usage = |message: String| Err(Fault::new(Exit::Usage, message));
        if !(1..=TAKES_MAX).contains(&self.takes) {
            return usage(format!("{} takes; expected 1 to {TAKES_MAX}", self.takes));
        }
        if self.pause_s > PAUSE_MAX_S {
            return usage(format!("a pause of {} s; expected at most {PAUSE_MAX_S}", self.pause_s));
        }
        let endless = self.wish.duration_s.is_none() && self.wish.triggers.is_none_or(|n| n == 0);
        if self.takes > 1 && endless {
            return usage("several takes need a duration or a number of triggers each".to_owned());
        }
        Ok(())
    }

    /// The wish of take 1, 2, ...
    fn take(&self, number: u32) -> CaptureRequest {
        let mut wish = self.wish.clone();
        if let Some(name) = wish.name.as_mut().filter(|_| self.takes > 1) {
            *name = format!("{name}-{number:02}");
        }
        wish
    }
}

/// Runs all takes. `progress` gets the number of the take and how far it is. A take that fails ends the series: what went
/// before it is returned with the fault. Stopping a take ends the series after it.
pub fn run(
    nodes: Nodes<'_>,
    series: &Series,
    control: &Control,
    mut progress: impl FnMut(u32, &Stage),
    mut taken: impl FnMut(&Captured),
) -> Result<Vec<Captured>, (Vec<Captured>, Fault)> {
    let mut done = Vec::new();
    if let Err(fault) = series.check() {
        return Err((done, fault));
    }
    for number in 1..=series.takes {
        let mut stopped = false;
        let captured = capture(nodes, &series.take(number), control, |stage| {
            stopped |= *stage == Stage::Stopping;
            progress(number, stage);
        });
        match captured {
            Ok(captured) => {
                taken(&captured);
                let aborted = captured.verdict() == "aborted";
                done.push(captured);
                if stopped || aborted {
                    break;
                }
            }
            Err(fault) => return Err((done, fault)),
        }
        if number < series.takes && !rest(Duration::from_secs(series.pause_s.into()), control) {
            break;
        }
    }
    Ok(done)
}

/// `false` when the series was ended meanwhile.
fn rest(pause: Duration, control: &Control) -> bool {
    const STEP: Duration = Duration::from_millis(50);
    let begin = Instant::now();
    while begin.elapsed() < pause && !control.ends() {
        std::thread::sleep(STEP);
    }
    !control.ends()
}

#[cfg(test)]
mod tests {
    use super::{Series, TAKES_MAX};
    use crate::capture::run::CaptureRequest;

    #[test]
    fn takes_are_numbered_only_where_there_are_several() {
        let wish =
            CaptureRequest { name: Some("walk".to_owned()), triggers: Some(5), ..CaptureRequest::default() };
        let name = |takes, number| Series { wish: wish.clone(), takes, pause_s: 0 }.take(number).name;
        assert_eq!(name(1, 1).as_deref(), Some("walk"));
        assert_eq!(name(3, 2).as_deref(), Some("walk-02"));
        assert_eq!(Series { wish: CaptureRequest::default(), takes: 3, pause_s: 0 }.take(2).name, None);
    }

    #[test]
    fn a_series_without_an_end_is_refused() {
        let wish = |triggers| CaptureRequest { triggers, ..CaptureRequest::default() };
        assert!(Series { wish: wish(None), takes: 2, pause_s: 0 }.check().is_err());
        assert!(Series { wish: wish(Some(0)), takes: 2, pause_s: 0 }.check().is_err());
        assert!(Series { wish: wish(Some(3)), takes: TAKES_MAX + 1, pause_s: 0 }.check().is_err());
        assert!(Series { wish: wish(Some(3)), takes: 0, pause_s: 0 }.check().is_err());
        assert!(Series { wish: wish(Some(3)), takes: 2, pause_s: 0 }.check().is_ok());
        assert!(Series::single(wish(None)).check().is_ok());
    }
}
