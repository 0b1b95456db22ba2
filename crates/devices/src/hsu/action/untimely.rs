// SPDX-License-Identifier: MIT OR Apache-2.0
//! Triggers at which a camera did not, or may not have, exposed at the same time as the others.
//!
//! A camera reports that a command came late, or refuses it; or its clock is not synchronized by PTP. Triggers of the
//! warm-up are left out, because they are not recorded.

use crate::network::ActionStatus;
use crate::record::{TriggerRow, TriggerRows, ptp_keeps};

/// The untimely triggers of one camera, by reason. The size is bounded by [`TriggerRows`].
#[derive(Debug, Clone, Default)]
pub(super) struct Untimely {
    late: TriggerRows,
    refused: TriggerRows,
    /// The camera's first refusal of a command.
    refusal: Option<ActionStatus>,
    unkept: TriggerRows,
    /// The first PTP status without synchronization.
    status: Option<String>,
    /// The first trigger that was not exposed yet when the last good status was read.
    good_from: Option<i64>,
    /// The first trigger behind the last good status, while the clock is not synchronized.
    bad_from: Option<i64>,
}

impl Untimely {
    /// Notes the camera's answer to the command of a trigger.
    pub(super) fn answered(&mut self, number: i64, status: ActionStatus) {
        let rows = match status {
            ActionStatus::Taken => return,
            ActionStatus::Late => &mut self.late,
            status => {
                self.refusal.get_or_insert(status);
                &mut self.refused
            }
        };
        add(rows, number, number.saturating_add(1));
    }

    /// Notes the camera's PTP status. `requested` and `now` are the first unexposed triggers when the status was
    /// requested and when it was received.
    pub(super) fn ptp(&mut self, status: &str, requested: i64, now: i64) {
        if ptp_keeps(status) {
            if let Some(from) = self.bad_from.take() {
                add(&mut self.unkept, from, now);
            }
            self.good_from = Some(requested);
        } else {
            self.status.get_or_insert_with(|| status.to_owned());
            self.bad_from.get_or_insert(self.good_from.unwrap_or(requested));
        }
    }

    /// Notes that the camera was lost: its PTP status is not known any more.
    pub(super) fn lost(&mut self) {
        self.good_from = None;
    }

    /// The untimely triggers and their reasons; `now` is the first unexposed trigger.
    pub(super) fn rows(&self, now: i64) -> Vec<(TriggerRow, String)> {
        let mut unkept = self.unkept.clone();
        if let Some(from) = self.bad_from {
            add(&mut unkept, from, now);
        }
        let late = "its action command came late (0x8016) and was carried out at once".to_owned();
        let refused = match self.refusal {
            Some(ActionStatus::NoTime) => {
                "the camera refused an action command: no reference time (0x8013)".to_owned()
            }
            Some(ActionStatus::Full) => {
                "the camera refused an action command: too many wait (0x8015)".to_owned()
            }
            Some(ActionStatus::Refused(status)) => {
                format!("the camera refused an action command with status {status:#06x}")
            }
            _ => String::new(),
        };
        let unkept_by = format!(
            "its PTP status was {}, expected Slave or Master: its clock may not have been synchronized",
            self.status.as_deref().unwrap_or_default()
        );
        let all = [(&self.late, late), (&self.refused, refused), (&unkept, unkept_by)];
        all.iter().flat_map(|(rows, why)| rows.iter().map(move |row| (row, why.clone()))).collect()
    }
}

/// Adds the triggers from `from` up to `to`, without those of the warm-up.
fn add(rows: &mut TriggerRows, from: i64, to: i64) {
    let first = u64::try_from(from).unwrap_or(0);
    if let Some(last) = u64::try_from(to).ok().and_then(|to| to.checked_sub(1)).filter(|last| *last >= first)
    {
        rows.add(TriggerRow::all(first, last));
    }
}

#[cfg(test)]
mod tests {
    use super::Untimely;
    use crate::network::ActionStatus;

    /// Rows, each with a part of its reason.
    fn rows(untimely: &Untimely, now: i64) -> Vec<(u64, u64, &'static str)> {
        let word = |why: &str| {
            ["0x8016", "0x8013", "0x8001", "Listening"]
                .into_iter()
                .find(|word| why.contains(word))
                .expect("a reason")
        };
        untimely.rows(now).iter().map(|(row, why)| (row.first, row.last, word(why))).collect()
    }

    #[test]
    fn late_and_refused_commands_are_named_and_those_of_the_warm_up_are_not() {
        let mut untimely = Untimely::default();
        for number in [-3, -1, 11, 12, 20] {
            untimely.answered(number, ActionStatus::Late);
        }
        untimely.answered(5, ActionStatus::Taken);
        assert_eq!(rows(&untimely, 100), [(11, 12, "0x8016"), (20, 20, "0x8016")]);
        untimely.answered(7, ActionStatus::NoTime);
        untimely.answered(8, ActionStatus::Full);
        assert_eq!(rows(&untimely, 100)[2..], [(7, 8, "0x8013")]);
        let mut other = Untimely::default();
        other.answered(3, ActionStatus::Refused(0x8001));
        assert_eq!(rows(&other, 100), [(3, 3, "0x8001")]);
    }

    #[test]
    fn what_lies_between_two_good_states_of_ptp_rests_on_nothing() {
        let mut untimely = Untimely::default();
        untimely.ptp("Slave", i64::MIN, -8);
        untimely.ptp("Master", 20, 21);
        untimely.ptp("Listening", 40, 41);
        assert_eq!(rows(&untimely, 50), [(20, 49, "Listening")], "while it lasts");
        untimely.ptp("Uncalibrated", 60, 61);
        untimely.ptp("Slave", 80, 82);
        assert_eq!(rows(&untimely, 200), [(20, 81, "Listening")]);
        untimely.ptp("Slave", 100, 101);
        untimely.ptp("Listening", 120, 121);
        untimely.ptp("Slave", 140, 141);
        assert_eq!(rows(&untimely, 200), [(20, 81, "Listening"), (100, 140, "Listening")]);
    }

    #[test]
    fn a_camera_that_comes_back_is_believed_from_its_next_good_state_on() {
        let mut untimely = Untimely::default();
        untimely.ptp("Slave", 10, 11);
        untimely.lost();
        untimely.ptp("Slave", 60, 60);
        assert_eq!(rows(&untimely, 200), [], "what it did not expose is a gap");
        untimely.lost();
        untimely.ptp("Listening", 90, 90);
        untimely.ptp("Slave", 110, 112);
        assert_eq!(rows(&untimely, 200), [(90, 111, "Listening")]);
        // From the beginning on, and before anything was triggered.
        let mut never = Untimely::default();
        never.ptp("Listening", i64::MIN, i64::MIN);
        assert_eq!(rows(&never, i64::MIN), []);
        assert_eq!(rows(&never, 5), [(0, 4, "Listening")]);
    }
}
