// SPDX-License-Identifier: MIT OR Apache-2.0
//! Action commands in a session: whether the cameras can be triggered by them now, because their clocks are one and
//! each answers; and in the end, what became of them.

use super::camera_keeper::{clock_readings, exchange};
use super::devices::Devices;
use super::event_kind::EventKind;
use super::node_thread::Node;
use crate::base::clock_fit::Exchange;
use crate::base::ids::CameraId;
use crate::base::{Exit, Fault};
use crate::host::realtime;
use crate::record::{ACTIONS_AT_ONCE, ptp_keeps};
use std::time::{Duration, Instant};

/// Longest time in which the cameras agree on a PTP master and set their clocks.
const PTP_PATIENCE: Duration = Duration::from_secs(30);
/// Time between two looks at the cameras' PTP status.
const POLL: Duration = Duration::from_millis(250);
/// Clocks that PTP keeps together differ by less than this, ns, besides the uncertainty of reading them.
const APART_NS: i128 = 100_000;

impl Devices {
    /// What keeps action commands from being the triggers, each camera by name.
    pub(super) fn check_actions(&mut self) -> Vec<Fault> {
        let Some(action) = self.unit().action().cloned() else { return Vec::new() };
        let fault = |text: String| Fault::new(Exit::Device, text);
        if let Some(ptp) = &action.ptp {
            ptp.forget();
            let troubles = self.wait_for_ptp();
            if !troubles.is_empty() {
                return troubles.into_iter().map(fault).collect();
            }
        } else {
            realtime::warn(
                ACTIONS_AT_ONCE,
                "cameras act when an action command reaches them: exposures of a trigger differ by what this host and \
                 the network delay each packet; with trigger.ptp = true they are at one time"
                    .to_owned(),
            );
        }
        match action.probe() {
            Ok(troubles) => {
                troubles.into_iter().map(|(id, trouble)| fault(format!("camera {id}: {trouble}"))).collect()
            }
            Err(error) => {
                vec![fault(format!("action commands cannot be sent: {error}; check the network interfaces"))]
            }
        }
    }

    /// Waits until every camera reports that PTP has set its clock, and their clocks show the same.
    fn wait_for_ptp(&mut self) -> Vec<String> {
        let until = Instant::now() + PTP_PATIENCE;
        loop {
            let troubles = self.ptp_troubles();
            if troubles.is_empty() || Instant::now() >= until {
                return troubles;
            }
            std::thread::sleep(POLL);
        }
    }

    fn ptp_troubles(&mut self) -> Vec<String> {
        let seconds = PTP_PATIENCE.as_secs();
        let mut troubles = Vec::new();
        let mut clocks = Vec::new();
        for slot in self.slots_mut() {
            let id = slot.config.id.clone();
            let Some(camera) = slot.camera.as_mut() else { continue };
            match camera.ptp_status() {
                Ok(Some(status)) if !ptp_keeps(&status) => {
                    troubles.push(format!(
                        "camera {id}: PtpStatus is {status}, expected Master or Slave within {seconds} s: let the \
                         switch pass multicast (224.0.1.129, UDP ports 319 and 320) between the cameras, or say \
                         trigger.ptp = false"
                    ));
                    continue;
                }
                // A camera without a PTP status is judged by its clock.
                Ok(_) => {}
                Err(error) => {
                    troubles.push(format!("camera {id}: {error}"));
                    continue;
                }
            }
            match clock_readings(camera.as_mut()).map(|sample| exchange(&sample)).min_by_key(round_trip) {
                Some(sample) => clocks.push((id, sample)),
                None => troubles.push(format!(
                    "camera {id}: its clock cannot be read, and actions cannot be scheduled by it: say \
                     trigger.ptp = false"
                )),
            }
        }
        troubles.extend(apart(&clocks).into_iter().map(|trouble| format!("{trouble} (within {seconds} s)")));
        troubles
    }
}

impl Node {
    /// Puts into the recording what became of the action commands: the counts of each camera, and at which triggers it
    /// did not expose at the time of the others.
    pub(super) fn record_actions(&self) {
        let (Some(session), Some(action)) = (&self.session, self.devices.unit().action()) else { return };
        for (camera, counts) in action.tally.counts() {
            let event = session.event(EventKind::ActionCommands, Some(camera), counts.to_string());
            if counts.is_clean() { session.record(event) } else { session.warn(event) }
        }
        // What came before Record is not recorded.
        let first = session.kept.as_ref().map_or(0, |kept| kept.first);
        for (camera, row, why) in action.tally.untimely() {
            let Some(row) = row.behind(first) else { continue };
            session.warn(row.event(camera, &why, session.clock.now()));
        }
    }
}

/// Cameras whose clocks do not show what the first one's shows.
fn apart(clocks: &[(CameraId, Exchange)]) -> Vec<String> {
    let Some(((first, reference), others)) = clocks.split_first() else { return Vec::new() };
    let mut troubles = Vec::new();
    for (id, sample) in others {
        let apart = offset(sample) - offset(reference);
        // Where in its round trip a clock was read cannot be known.
        let most = APART_NS + i128::from(round_trip(sample) + round_trip(reference)) / 2;
        if apart.abs() > most {
            troubles.push(format!(
                "camera {id}: its clock is {} us apart from that of {first}, expected {} us at most: both must be in \
                 one PTP network, with one master",
                apart / 1000,
                most / 1000
            ));
        }
    }
    troubles
}

fn round_trip(sample: &Exchange) -> u64 {
    sample.host_receive_ns.saturating_sub(sample.host_send_ns)
}

/// Clock of the camera minus this host's, ns.
fn offset(sample: &Exchange) -> i128 {
    let host = (i128::from(sample.host_send_ns) + i128::from(sample.host_receive_ns)) / 2;
    i128::from(sample.device_ns) - host
}

#[cfg(test)]
mod tests {
    use super::apart;
    use crate::base::clock_fit::Exchange;
    use crate::base::ids::CameraId;

    #[test]
    fn clocks_that_differ_by_more_than_reading_leaves_open_are_told() {
        let clock = |id: &str, host_send_ns, trip, device_ns| {
            (
                CameraId(id.to_owned()),
                Exchange { host_send_ns, host_receive_ns: host_send_ns + trip, device_ns },
            )
        };
        let reference = clock("a", 1_000_000, 200_000, 51_100_000);
        let near = clock("b", 3_000_000, 200_000, 53_350_000);
        let far = clock("c", 3_000_000, 200_000, 53_450_000);
        assert_eq!(apart(&[reference.clone(), near.clone()]), [""; 0]);
        let troubles = apart(&[reference, near, far]);
        assert!(
            troubles.len() == 1
                && troubles[0].starts_with("camera c: its clock is 350 us apart from that of a")
        );
    }
}
