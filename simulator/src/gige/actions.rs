// SPDX-License-Identifier: MIT OR Apache-2.0
//! Action commands on their way to a camera: which arrive, and which triggers they are.
//!
//! A camera does not learn which trigger a command is. The simulator must, to show the light of that instant: it takes
//! the request id for a count of the triggers (number modulo 65535, plus 1), as this project's node has it.

use super::gvcp::{Command, Request};
use crate::wire::TriggerEdge;
use std::fmt;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// What the network makes of an action command.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ActionFate {
    Arrives,
    Lost,
    Twice,
    /// It arrives so much later.
    Late(Duration),
}

/// Decides by the trigger's number whether its command arrives.
#[derive(Clone)]
pub struct ActionFilter(Arc<dyn Fn(i64) -> ActionFate + Send + Sync>);

impl ActionFilter {
    /// A filter that decides by this rule.
    pub fn new(fate: impl Fn(i64) -> ActionFate + Send + Sync + 'static) -> Self {
        Self(Arc::new(fate))
    }
}

impl fmt::Debug for ActionFilter {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("ActionFilter")
    }
}

/// Number of request ids after which they repeat.
const IDS: i64 = u16::MAX as i64;

/// The action commands of one camera.
#[derive(Debug)]
pub struct Actions {
    filter: Option<ActionFilter>,
    /// Number of the last one.
    last: i64,
}

impl Actions {
    /// A counter before the first action command.
    pub fn new(filter: Option<ActionFilter>) -> Self {
        Self { filter, last: 0 }
    }

    /// An acquisition starts, and with it a train.
    pub fn begin(&mut self) {
        self.last = 0;
    }

    /// The trigger nearest to the last one that has this id.
    fn number(&self, id: u16) -> i64 {
        let ahead = (i64::from(id) - 1 - self.last).rem_euclid(IDS);
        self.last + if ahead > IDS / 2 { ahead - IDS } else { ahead }
    }

    /// What becomes of a datagram; whatever is no action arrives.
    pub fn fate(&self, datagram: &[u8]) -> ActionFate {
        let Some(filter) = &self.filter else { return ActionFate::Arrives };
        match Request::decode(datagram) {
            Ok(Request { id, command: Command::Action(_), .. }) => (filter.0)(self.number(id)),
            _ => ActionFate::Arrives,
        }
    }

    /// The trigger that a command is.
    pub fn edge(&mut self, id: u16, time: Instant) -> TriggerEdge {
        self.last = self.number(id);
        TriggerEdge { instant: self.last, time, width_ns: 0 }
    }
}

#[cfg(test)]
mod tests {
    use super::Actions;
    use std::time::Instant;

    #[test]
    fn ids_count_on_from_the_warm_up_and_around() {
        let mut actions = Actions::new(None);
        let id = |number: i64| (number.rem_euclid(65_535) + 1) as u16;
        for number in (-8..10).chain((20_000..200_000).step_by(20_000)) {
            assert_eq!(actions.edge(id(number), Instant::now()).instant, number);
        }
        actions.begin();
        assert_eq!(actions.edge(id(-8), Instant::now()).instant, -8);
    }
}
