// SPDX-License-Identifier: MIT OR Apache-2.0
//! The accounting's events: what happened before a frame and with it, and a summary of the session.

use super::{Accounting, Full, GIVEN_UP_KEPT, Lane, sighting};
use crate::acquire::receiver::Arrival;
use crate::acquire::writer_queue::ToWriter;
use crate::base::ids::{BlockId, CameraId, TriggerIndex};
use crate::base::time::host_time_ns;
use crate::camera::Breach;
use crate::matcher::{Finding, Matched};
use crate::record::{NodeEvent, UNCONFIRMED};

/// Texts name blocks, not triggers: an event has its trigger in a field, whose count may still change with Record.
impl Accounting {
    /// Reports the frames that were lost before a frame, and the triggers that its camera ignored: their number and
    /// the first.
    pub(super) fn report_skipped(
        &mut self,
        camera: usize,
        block: BlockId,
        lost: (u64, Option<u64>),
        ignored: (u64, Option<u64>),
    ) {
        if lost.0 > 0 {
            let text = format!("{} frames before block {block} were lost on the way", lost.0);
            self.note(camera, "frames_lost", lost.1, text);
        }
        if ignored.0 > 0 {
            let text = format!("the camera ignored {} triggers before block {block}", ignored.0);
            self.note(camera, "trigger_ignored", ignored.1, text);
        }
    }

    /// Reports what the matcher found about a frame.
    pub(super) fn report(&mut self, camera: usize, matched: &Matched, arrival: &Arrival) {
        let block = arrival.block_id;
        let (kind, text) = match matched.finding {
            None => return,
            Some(Finding::IdJump(by)) => {
                ("id_jump", format!("block ids jumped by {by} to {block} without loss"))
            }
            Some(Finding::IdRepeated) => {
                ("id_repeated", format!("block id {block} came twice; its timestamp is new"))
            }
            Some(Finding::ClockReset(step)) => (
                "camera_clock_reset",
                format!("its clock jumped by {step} ns at block {block}; the frames behind it agree"),
            ),
            Some(Finding::StampWrong(Some(by))) => (
                "stamp_wrong",
                format!(
                    "the timestamp of block {block} is {by} ns off; its block id and arrival agree on the trigger"
                ),
            ),
            Some(Finding::StampWrong(None)) => (
                "stamp_wrong",
                format!("block {block} has no timestamp; its block id and arrival agree on the trigger"),
            ),
        };
        self.note(camera, kind, u64::try_from(matched.number).ok(), text);
    }

    /// Reports consecutive dropped sets as one event, when frames are accepted again.
    pub(super) fn end_of_full(&mut self) {
        if let Some(Full { first, last, frames, starved }) = self.full.take() {
            let why =
                starved.map_or_else(|| "the disk did not keep up".to_owned(), |starved| starved.to_string());
            let message = format!(
                "{why}: {frames} frames of {} triggers from here on were dropped, set by set",
                last - first + 1
            );
            tracing::warn!(kind = "ring_full", "{message}");
            self.event("ring_full", None, Some(first), message);
        }
    }

    /// Counts a frame that no trigger explains. A free-running camera makes many, so only the first is an event.
    pub(super) fn spurious(&mut self, arrival: &Arrival, why: &str) {
        let lane = &mut self.lanes[arrival.camera];
        lane.spurious += 1;
        if lane.spurious == 1 {
            let text = format!("block {} {why}; not recorded (later ones are counted)", arrival.block_id);
            self.note(arrival.camera, "spurious_frame", None, text);
        }
    }

    /// Counts a frame that breaks its contract; the first of each kind is an event.
    pub(super) fn breach(&mut self, camera: usize, block: BlockId, breach: Breach) {
        if self.lanes[camera].breaches.count(breach) {
            let text = format!("block {block} is not recorded: {breach} (later ones are counted)");
            self.note(camera, "frame_refused", None, text);
        }
    }

    /// Gives a frame up whose trigger cannot be determined: the trigger gets a gap record.
    pub(super) fn give_up(&mut self, arrival: &Arrival) {
        let at = self.lanes[arrival.camera].matcher.points_at(arrival.block_id);
        if at.is_some_and(|number| number < 0) {
            return self.warm_up_frame(arrival);
        }
        let lane = &mut self.lanes[arrival.camera];
        (lane.given_up, lane.given_up_now) = (lane.given_up + 1, lane.given_up_now + 1);
        let at = at.and_then(|number| u64::try_from(number).ok());
        let by_clock = lane.matcher.claim(&sighting(arrival)).and_then(|(_, hsu_ns)| {
            let (number, residual) = self.table.reported().nearest(hsu_ns)?;
            u64::try_from(number)
                .ok()
                .filter(|_| residual.unsigned_abs() < u128::from(self.options.period_ns / 4))
        });
        if let Some(trigger) = at.filter(|trigger| lane.given_up_at.iter().all(|(id, _)| id != trigger)) {
            if lane.given_up_at.len() == GIVEN_UP_KEPT {
                lane.given_up_at.pop_front();
            }
            lane.given_up_at.push_back((trigger, by_clock));
        }
        if lane.given_up == 1 {
            let text = format!(
                "block {}: no two of counter, clock and arrival agree on a trigger that was reported; not recorded \
                 (later \
                 ones are counted)",
                arrival.block_id
            );
            self.note(arrival.camera, "identity_unknown", None, text);
        }
    }

    pub(super) fn note(&mut self, camera: usize, kind: &str, trigger: Option<u64>, message: String) {
        let id = self.lanes[camera].id.clone();
        tracing::warn!(camera = %id, kind, "{message}");
        self.event(kind, Some(id), trigger, message);
    }

    pub(super) fn event(
        &mut self,
        kind: &str,
        camera: Option<CameraId>,
        trigger: Option<u64>,
        message: String,
    ) {
        let (host_time_ns, kind, trigger) = (host_time_ns(), kind.to_owned(), trigger.map(TriggerIndex));
        self.ring.small(ToWriter::Event(NodeEvent { host_time_ns, kind, camera, trigger, message }));
    }

    /// Records a summary of the session: the clocks, and the counts of all that went wrong.
    pub(crate) fn sum_up(&mut self) {
        self.clock_event(None);
        for camera in 0..self.lanes.len() {
            self.clock_event(Some(camera));
            let Lane { spurious, unconfirmed, given_up, .. } = self.lanes[camera];
            for text in std::mem::take(&mut self.lanes[camera].breaches).summary() {
                self.note(camera, "frames_refused", None, text);
            }
            if spurious > 1 {
                self.note(
                    camera,
                    "spurious_frames",
                    None,
                    format!("{spurious} frames that no trigger explains"),
                );
            }
            if given_up > 1 {
                let text = format!("{given_up} frames whose trigger could not be determined");
                self.note(camera, "identity_unknown", None, text);
            }
            if unconfirmed > 0 {
                let text = format!("{unconfirmed} frames have their trigger by one witness alone");
                self.note(camera, UNCONFIRMED, None, text);
            }
        }
        if self.ring.refused > 0 {
            let text = format!("{} small records found no room on the way to the disk", self.ring.refused);
            self.event("records_lost", None, None, text);
        }
    }

    fn clock_event(&mut self, camera: Option<usize>) {
        let fit = camera.map_or(&self.hsu, |camera| self.lanes[camera].matcher.clock());
        let Some(drift) = fit.drift_ppm() else { return };
        let message = format!(
            "drift {drift:.2} ppm against the host; {} exchanges used, {} left out, {} resets",
            fit.used(),
            fit.left_out(),
            fit.resets()
        );
        let id = camera.map(|camera| self.lanes[camera].id.clone());
        self.event("clock_fit", id, None, message);
    }
}
