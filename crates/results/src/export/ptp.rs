// SPDX-License-Identifier: MIT OR Apache-2.0
//! Triggers on the clock that PTP gives the cameras (docs/guide/other-devices.md).
//!
//! A **witness** is a camera whose PTP status was Slave or Master at the beginning of the session and at its end, and
//! nothing else in between, was never lost, and whose clock was never set. From its stamps the delay from trigger to
//! stamp is taken away. That delay is measured: the readings of both clocks show how long after the trigger each
//! stamp was. It is the middle of many, by readings that leave least open, and what they leave open is stated with
//! each time.

use crate::base::clock_fit::{ClockFit, Exchange};
use crate::base::ids::{CameraId, TriggerIndex};
use crate::data::FrameSource;
use crate::record::{
    ClockSample, NodeEvent, PTP_STATUS, RecordingReader, ScaleFound, SessionReader, ptp_keeps,
};

/// The number of frames of each witness by which its delay is measured.
const LOOKS: usize = 256;
/// How long before the last trigger, ns, the fit of the clocks still has bounds.
const KNOWN_NS: u64 = 50_000_000_000;
/// The most that witnesses may differ besides the uncertainty of reading their clocks, ns.
const APART_NS: u64 = 100_000;

/// The time of a trigger by a witness.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PtpInstant {
    /// The trigger, the PTP clock, ns.
    pub time_ns: u64,
    /// What reading the clocks leaves open, to either side, ns. PTP's own error is not in it.
    pub open_ns: u64,
    /// The witness whose clock gave this time.
    pub camera: CameraId,
}

/// A camera whose stamps are times of the PTP clock.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
pub struct Witness {
    pub camera: CameraId,
    /// From a trigger to its stamp, ns.
    pub delay_ns: i64,
    /// How far that may be wrong to either side, ns.
    pub open_ns: u64,
    #[serde(skip)]
    recording: usize,
    #[serde(skip)]
    place: usize,
}

/// The cameras whose stamps give the times of triggers on the PTP clock.
#[derive(Debug, Clone, Default, PartialEq, Eq, serde::Serialize)]
pub struct PtpTime {
    /// The witness that leaves least open comes first.
    pub witnesses: Vec<Witness>,
    /// Why there is none although cameras have PTP.
    pub none_because: Option<String>,
    /// Which scale that clock has: that of the first witness.
    pub scale: Option<ScaleFound>,
}

impl PtpTime {
    /// The witnesses of a session, by its recordings.
    pub fn of(session: &SessionReader) -> Self {
        let (mut witnesses, mut reasons) = (Vec::new(), Vec::new());
        for (number, recording) in session.recordings().iter().enumerate() {
            let of_hsu = fit(None, &recording.clock_samples);
            for (place, camera) in recording.header.cameras.iter().enumerate() {
                let witness = match kept_time(&camera.id, &recording.events) {
                    None => continue,
                    Some(Err(reason)) => Err(reason),
                    Some(Ok(())) => measured(recording, place, of_hsu.as_ref()),
                };
                match witness {
                    Ok((delay_ns, open_ns)) => witnesses.push(Witness {
                        camera: camera.id.clone(),
                        delay_ns,
                        open_ns,
                        recording: number,
                        place,
                    }),
                    Err(reason) => reasons.push(format!("{}: {reason}", camera.id)),
                }
            }
        }
        witnesses.sort_by(|a, b| (a.open_ns, &a.camera).cmp(&(b.open_ns, &b.camera)));
        let mut found = Self { witnesses, none_because: None, scale: None };
        if let Some(contradiction) = found.contradiction(session) {
            found.witnesses.clear();
            reasons = vec![contradiction];
        }
        if found.witnesses.is_empty() && !reasons.is_empty() {
            found.none_because = Some(reasons.join("; "));
        }
        found.scale = found.witnesses.first().and_then(|witness| {
            let recording = session.recordings().get(witness.recording)?;
            ScaleFound::of(&witness.camera, &recording.clock_samples)
        });
        found
    }

    /// When a trigger was, by the first witness that has a frame of it.
    pub fn at(&self, session: &SessionReader, trigger: TriggerIndex) -> Option<PtpInstant> {
        self.witnesses.iter().find_map(|witness| witness.at(session, trigger))
    }

    /// Two witnesses whose clocks do not show the same: there is more than one PTP clock, and none is "the" one.
    fn contradiction(&self, session: &SessionReader) -> Option<String> {
        let (first, others) = self.witnesses.split_first()?;
        let triggers = session.triggers();
        others.iter().find_map(|other| {
            let both = spread(triggers.clone(), LOOKS).find_map(|trigger| {
                Some((first.at(session, trigger)?.time_ns, other.at(session, trigger)?.time_ns))
            });
            let apart_ns = both.map(|(a, b)| a.abs_diff(b))?;
            let most_ns = APART_NS.saturating_add(first.open_ns).saturating_add(other.open_ns);
            (apart_ns > most_ns).then(|| {
                format!(
                    "the PTP clocks of {} and {} are {} us apart, expected {} us at most: they follow two masters",
                    first.camera,
                    other.camera,
                    apart_ns / 1000,
                    most_ns / 1000
                )
            })
        })
    }
}

impl Witness {
    fn at(&self, session: &SessionReader, trigger: TriggerIndex) -> Option<PtpInstant> {
        let stamp = stamp(session.recordings().get(self.recording)?, self.place, trigger)?;
        let time_ns = stamp.checked_add_signed(self.delay_ns.checked_neg()?)?;
        Some(PtpInstant { time_ns, open_ns: self.open_ns, camera: self.camera.clone() })
    }
}

fn stamp(recording: &RecordingReader, place: usize, trigger: TriggerIndex) -> Option<u64> {
    let meta = recording.frame_meta(place, trigger).ok()?.ok()?;
    Some(meta.camera_time_ns).filter(|ns| *ns != 0)
}

/// Up to `count` triggers of these, evenly.
fn spread(triggers: std::ops::Range<u64>, count: usize) -> impl Iterator<Item = TriggerIndex> {
    let step = (triggers.end.saturating_sub(triggers.start) / count as u64).max(1);
    triggers.step_by(usize::try_from(step).unwrap_or(usize::MAX)).map(TriggerIndex)
}

/// Whether a camera was kept by PTP all the time; `None` where it reported no PTP status.
fn kept_time(camera: &CameraId, events: &[NodeEvent]) -> Option<Result<(), String>> {
    let mut own = events.iter().filter(|event| event.camera.as_ref() == Some(camera));
    let statuses: Vec<&str> =
        own.clone().filter(|event| event.kind == PTP_STATUS).map(|event| event.message.as_str()).collect();
    if statuses.is_empty() {
        return None;
    }
    Some(if let Some(other) = statuses.iter().find(|status| !ptp_keeps(status)) {
        Err(format!("its PTP status was {other}, expected Slave or Master throughout"))
    } else if own.any(|event| event.kind == "camera_back" || event.kind == "camera_clock_reset") {
        Err("it was lost for a while, or its clock was set".to_owned())
    } else if statuses.len() < 2 {
        Err("it reported no PTP status at the end of the session".to_owned())
    } else {
        Ok(())
    })
}

/// A device's clock by the recorded readings; `None` where there are too few, or it was set.
fn fit(device: Option<&CameraId>, samples: &[ClockSample]) -> Option<ClockFit> {
    let mut fit = ClockFit::new();
    for sample in samples.iter().filter(|sample| sample.camera.as_ref() == device) {
        fit.exchange(&Exchange {
            host_send_ns: sample.host_send_ns,
            host_receive_ns: sample.host_receive_ns,
            device_ns: sample.device_time_ns,
        });
    }
    (fit.is_ready() && fit.resets() == 0).then_some(fit)
}

/// From the trigger to a camera's stamp, and what is open of it, ns.
fn measured(
    recording: &RecordingReader,
    place: usize,
    of_hsu: Option<&ClockFit>,
) -> Result<(i64, u64), String> {
    let camera = fit(Some(&recording.header.cameras[place].id), &recording.clock_samples);
    let (Some(of_hsu), Some(camera)) = (of_hsu, camera) else {
        return Err("its clock or that of the triggers was read too seldom, or was set".to_owned());
    };
    let last_ns = recording.triggers.last_key_value().map_or(0, |(_, row)| row.hsu_time_ns);
    let known =
        recording.triggers.iter().filter(|(_, row)| row.hsu_time_ns.saturating_add(KNOWN_NS) >= last_ns);
    let known: Vec<_> = known.collect();
    let mut delays: Vec<(u64, i64)> = known
        .iter()
        .step_by((known.len() / LOOKS).max(1))
        .filter_map(|(trigger, row)| {
            let stamp = i128::from(stamp(recording, place, **trigger)?);
            let hsu_ns = i128::from(row.hsu_time_ns);
            let delay = camera.host_from_device(stamp)? - of_hsu.host_from_device(hsu_ns)?;
            let open = camera.uncertainty_ns(stamp)?.saturating_add(of_hsu.uncertainty_ns(hsu_ns)?);
            Some((open, i64::try_from(delay).ok()?))
        })
        .collect();
    middle_of_the_best(&mut delays).ok_or_else(|| "it has no frame with a time".to_owned())
}

/// Of delays, each with what is open of it: the middle of the quarter that leaves least open, and the most that is
/// open of these or lies between them.
fn middle_of_the_best(delays: &mut Vec<(u64, i64)>) -> Option<(i64, u64)> {
    delays.sort_unstable();
    delays.truncate(delays.len().div_ceil(4));
    let open_ns = delays.last()?.0;
    let mut best: Vec<i64> = delays.iter().map(|(_, delay)| *delay).collect();
    best.sort_unstable();
    let middle = best[best.len() / 2];
    let scatter = best.iter().map(|delay| delay.abs_diff(middle)).max().unwrap_or(0);
    Some((middle, open_ns.max(scatter)))
}

#[cfg(test)]
mod tests {
    use super::{kept_time, middle_of_the_best};
    use crate::base::ids::CameraId;
    use crate::record::{NodeEvent, PTP_STATUS};

    #[test]
    fn only_a_camera_that_ptp_kept_from_beginning_to_end_is_a_witness() {
        let id = CameraId("h0_up".to_owned());
        let event = |kind: &str, message: &str| NodeEvent {
            host_time_ns: 0,
            kind: kind.to_owned(),
            camera: Some(id.clone()),
            trigger: None,
            message: message.to_owned(),
        };
        let status = |status| event(PTP_STATUS, status);
        let kept = |events: &[NodeEvent]| kept_time(&id, events);
        assert_eq!(kept(&[]), None);
        assert_eq!(kept_time(&CameraId("h1_up".to_owned()), &[status("Slave")]), None, "another camera's");
        assert_eq!(kept(&[status("Slave"), status("Slave")]), Some(Ok(())));
        assert_eq!(kept(&[status("Slave"), status("Master"), status("Master")]), Some(Ok(())));
        for (events, reason) in [
            (vec![status("Listening"), status("Slave")], "was Listening"),
            (
                vec![status("Slave"), status("Uncalibrated"), status("Slave"), status("Slave")],
                "was Uncalibrated",
            ),
            (vec![status("Slave"), event("camera_back", ""), status("Slave"), status("Slave")], "lost"),
            (vec![status("Slave"), event("camera_clock_reset", ""), status("Slave")], "set"),
            (vec![status("Slave")], "at the end"),
        ] {
            let refused = kept(&events).expect("it has a status").expect_err("no witness");
            assert!(refused.contains(reason), "{refused}");
        }
    }

    #[test]
    fn a_delay_is_the_middle_of_those_that_leave_least_open() {
        let mut delays: Vec<(u64, i64)> =
            (0..40u32).map(|i| (u64::from(1000 + i), i64::from(i % 5))).collect();
        delays.extend((0..40).map(|i| (90_000, 70_000 + i)));
        // The best twenty: 0 to 4, four times each.
        assert_eq!(middle_of_the_best(&mut delays), Some((2, 1019)));
        assert_eq!(middle_of_the_best(&mut vec![(5, -7), (6, 9)]), Some((-7, 5)));
        let mut scattered = vec![(9, 0); 9];
        scattered.extend([(5, 0), (5, 100), (5, 900), (5, 100)]);
        assert_eq!(middle_of_the_best(&mut scattered), Some((100, 800)));
        assert_eq!(middle_of_the_best(&mut Vec::new()), None);
    }
}
