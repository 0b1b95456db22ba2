// SPDX-License-Identifier: MIT OR Apache-2.0
//! Results of a camera's action commands, as numbers and as the text of its event.

use super::layout::NodeEvent;
use serde::Serialize;
use std::fmt;

/// Kind of the events whose message counts the results of a camera's action commands.
pub const ACTION_COMMANDS: &str = "action_commands";

/// Counts of one camera; those of the warm-up are among them.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct ActionCounts {
    pub sent: u64,
    /// Commands that the camera took in time.
    pub acknowledged: u64,
    /// Commands that it took after their time.
    pub late: u64,
    pub refused: u64,
    /// Commands that it did not answer.
    pub unanswered: u64,
    /// Triggers without a command: this host's network refused it, or the cameras' clock was not known.
    pub not_sent: u64,
}

impl ActionCounts {
    /// Whether each came in time.
    pub fn is_clean(&self) -> bool {
        self.acknowledged == self.sent && self.not_sent == 0
    }

    /// The counts in an event; `None` for other kinds.
    pub fn of(event: &NodeEvent) -> Option<Self> {
        let message = event.message.strip_suffix(" not sent").filter(|_| event.kind == ACTION_COMMANDS)?;
        let mut numbers = message.split([' ', ',']).filter_map(|word| word.parse().ok());
        let mut next = || numbers.next();
        Some(Self {
            sent: next()?,
            acknowledged: next()?,
            late: next()?,
            refused: next()?,
            unanswered: next()?,
            not_sent: next()?,
        })
    }
}

impl fmt::Display for ActionCounts {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { sent, acknowledged, late, refused, unanswered, not_sent } = self;
        write!(
            f,
            "{sent} action commands sent, {acknowledged} acknowledged, {late} late, {refused} refused, {unanswered} \
             unanswered, {not_sent} not sent"
        )
    }
}

#[cfg(test)]
mod tests {
    use super::{ACTION_COMMANDS, ActionCounts};
    use crate::layout::NodeEvent;

    #[test]
    fn an_event_gives_the_counts_back() {
        let counts =
            ActionCounts { sent: 38, acknowledged: 30, late: 4, refused: 1, unanswered: 3, not_sent: 2 };
        let event = |kind: &str, message: String| NodeEvent {
            host_time_ns: 0,
            kind: kind.to_owned(),
            camera: None,
            trigger: None,
            message,
        };
        assert_eq!(ActionCounts::of(&event(ACTION_COMMANDS, counts.to_string())), Some(counts));
        assert_eq!(ActionCounts::of(&event("other", counts.to_string())), None);
        for message in ["", "1 action commands sent, 2 not sent", "-1 not sent"] {
            assert_eq!(ActionCounts::of(&event(ACTION_COMMANDS, message.to_owned())), None, "{message}");
        }
    }
}
