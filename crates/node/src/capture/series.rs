// SPDX-License-Identifier: MIT OR Apache-2.0
//! Several takes of the same: named in a row, with pauses, ended together.

use super::numbering;
use super::participant::Nodes;
use super::report::Captured;
use super::request::{CaptureRequest, Control, Stage};
use super::run::capture;
use crate::base::{Exit, Fault};
use serde::{Deserialize, Serialize};
use std::time::{Duration, Instant};

/// Several takes with the same settings.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct Series {
    /// The request for each take; where there are several, its name gets `-01`, `-02`, ...
    pub wish: CaptureRequest,
    /// How many, at least one.
    #[serde(default = "one")]
    pub takes: u32,
    /// Seconds from the end of a take to the preparation of the next.
    #[serde(default)]
    pub pause_s: u32,
    /// A name that a node has already gets the next free number instead of being refused.
    #[serde(default)]
    pub number: bool,
}

/// A series that came to its end.
#[derive(Debug, Default)]
pub struct Ended {
    /// The takes, in their order.
    pub takes: Vec<Captured>,
    /// Where the operator ended it before its last take: the state of the take under way.
    pub stopped: Option<String>,
}

fn one() -> u32 {
    1
}

/// Most takes of a series: more are taken for a typing error.
pub const TAKES_MAX: u32 = 99;
/// Longest pause between takes, s: a longer one is taken for a typing error.
pub const PAUSE_MAX_S: u32 = 3600;

impl Series {
    /// A series of one take.
    pub fn single(wish: CaptureRequest) -> Self {
        Self { wish, takes: 1, pause_s: 0, number: false }
    }

    /// Checks the series, and returns what is wrong with it.
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

    /// The request of take 1, 2, ...; `last` is the name of the take before it.
    fn take(&self, nodes: Nodes<'_>, number: u32, last: Option<&str>) -> Result<CaptureRequest, Fault> {
        let mut wish = self.wish.clone();
        let Some(name) = wish.name.as_mut() else { return Ok(wish) };
        if self.takes > 1 {
            *name = format!("{name}-{number:02}");
        }
        if self.number && !wish.dry_run {
            // After a take whose name was taken, the numbers go on from there.
            let wanted = last.filter(|_| self.takes > 1).map_or_else(|| name.clone(), numbering::next);
            *name = numbering::free_on_all(nodes, &wanted)?;
        }
        Ok(wish)
    }
}

/// Runs all takes. `progress` gets the number of the take and how far it is. A take that fails ends the series: what
/// went before it is returned with the fault. Stopping a take ends the series after it; one that is stopped before it
/// has recorded anything is no fault of a series that has recorded others.
pub fn run(
    nodes: Nodes<'_>,
    series: &Series,
    control: &Control,
    mut progress: impl FnMut(u32, &Stage),
    mut taken: impl FnMut(&Captured),
) -> Result<Ended, (Vec<Captured>, Fault)> {
    let mut done: Vec<Captured> = Vec::new();
    if let Err(fault) = series.check() {
        return Err((done, fault));
    }
    let of = series.takes;
    for number in 1..=of {
        let mut stopped = false;
        let wish = series.take(nodes, number, done.last().map(|last| last.name.as_str()));
        let captured = wish.and_then(|wish| {
            capture(nodes, &wish, control, |stage| {
                stopped |= *stage == Stage::Stopping;
                progress(number, stage);
            })
        });
        match captured {
            Ok(captured) => {
                taken(&captured);
                let aborted = captured.verdict() == "aborted";
                done.push(captured);
                if stopped || aborted {
                    let after = (number < of).then(|| format!("ended after take {number} of {of}"));
                    return Ok(Ended { takes: done, stopped: after.filter(|_| control.end_was_requested()) });
                }
            }
            Err(fault) if control.end_was_requested() && !done.is_empty() => {
                let message = format!(
                    "take {number} of {of} was ended before it recorded anything ({})",
                    fault.message
                );
                return Ok(Ended { takes: done, stopped: Some(message) });
            }
            Err(fault) => return Err((done, fault)),
        }
        if number < of && !rest(Duration::from_secs(series.pause_s.into()), control) {
            let message = format!("ended after take {number} of {of}");
            return Ok(Ended { takes: done, stopped: Some(message) });
        }
    }
    Ok(Ended { takes: done, stopped: None })
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
    use crate::capture::request::CaptureRequest;

    #[test]
    fn takes_are_numbered_only_where_there_are_several() {
        let wish =
            CaptureRequest { name: Some("walk".to_owned()), triggers: Some(5), ..CaptureRequest::default() };
        let series = |wish, takes| Series { takes, ..Series::single(wish) };
        let name = |wish: &CaptureRequest, takes, number| {
            series(wish.clone(), takes).take(&[], number, None).expect("no node to ask").name
        };
        assert_eq!(name(&wish, 1, 1).as_deref(), Some("walk"));
        assert_eq!(name(&wish, 3, 2).as_deref(), Some("walk-02"));
        assert_eq!(name(&CaptureRequest::default(), 3, 2), None);
    }

    #[test]
    fn a_series_without_an_end_is_refused() {
        let wish = |triggers| CaptureRequest { triggers, ..CaptureRequest::default() };
        let series = |triggers, takes| Series { takes, ..Series::single(wish(triggers)) };
        assert!(series(None, 2).check().is_err());
        assert!(series(Some(0), 2).check().is_err());
        assert!(series(Some(3), TAKES_MAX + 1).check().is_err());
        assert!(series(Some(3), 0).check().is_err());
        assert!(series(Some(3), 2).check().is_ok());
        assert!(Series::single(wish(None)).check().is_ok());
    }
}
