// SPDX-License-Identifier: MIT OR Apache-2.0
//! The time between "every node is ready" and the first trigger: one of them may cease to be.

use super::participant::{LOST_PATIENCE, Nodes, abort_all};
use super::request::{COUNTDOWN_MAX_S, Control, Stage};
use crate::base::ids::NodeId;
use crate::base::{Exit, Fault};
use crate::control::status::Outcome;
use std::time::{Duration, Instant};

/// Time between two status requests to the nodes.
const LOOK: Duration = Duration::from_millis(250);

/// Counts down unless the operator ends it, or a node gives up or is lost: who it was, and why.
pub(crate) fn count_down(
    seconds: u32,
    control: &Control,
    progress: &mut impl FnMut(&Stage),
    watch: &mut Watch<'_>,
) -> Result<(), Fault> {
    const STEP: Duration = Duration::from_millis(50);
    let begin = Instant::now();
    let whole = Duration::from_secs(seconds.min(COUNTDOWN_MAX_S).into());
    let mut told = None;
    let mut looked = begin;
    while let Some(left) = whole.checked_sub(begin.elapsed()).filter(|left| !left.is_zero()) {
        if control.ends() {
            return Ok(());
        }
        let left_s = left.as_secs_f64().ceil() as u32;
        if told.replace(left_s) != Some(left_s) {
            progress(&Stage::CountingDown { left_s });
        }
        if looked.elapsed() >= LOOK {
            watch.look()?;
            looked = Instant::now();
        }
        std::thread::sleep(STEP.min(left));
    }
    Ok(())
}

/// Looks after nodes that are ready for a session and wait for its start.
pub(crate) struct Watch<'a> {
    nodes: Nodes<'a>,
    session_id: u64,
    /// When each node last answered.
    answered: Vec<Instant>,
}

impl<'a> Watch<'a> {
    /// All nodes have just reported that they are ready.
    pub fn new(nodes: Nodes<'a>, session_id: u64) -> Self {
        Self { nodes, session_id, answered: vec![Instant::now(); nodes.len()] }
    }

    /// Ends the session on every node because of a fault, and collects their own reasons: the fault that is seen first
    /// may be only the effect of another node's.
    pub fn give_up(&self, fault: Fault) -> Fault {
        let told = format!("another node gave up: {}", fault.message);
        abort_all(self.nodes, self.session_id, &told);
        let deadline = Instant::now() + LOST_PATIENCE;
        loop {
            let statuses: Vec<_> = self.nodes.iter().filter_map(|node| node.status().ok()).collect();
            let outcomes = statuses.iter().map(|status| {
                let session = status.session_of(self.session_id)?;
                Some((&status.node, session.outcome.as_ref()?))
            });
            let outcomes: Vec<_> = outcomes.flatten().collect();
            if outcomes.len() < self.nodes.len() && Instant::now() < deadline {
                std::thread::sleep(LOOK);
                continue;
            }
            let reason = |(node, outcome): &(&NodeId, &Outcome)| match outcome {
                Outcome::Failed(own) if own.message != told => Some(format!("node {node}: {}", own.message)),
                _ => None,
            };
            let mut reasons: Vec<String> = outcomes.iter().filter_map(reason).collect();
            if !reasons.contains(&fault.message) && (reasons.is_empty() || outcomes.len() < self.nodes.len())
            {
                reasons.insert(0, fault.message);
            }
            return Fault { exit: fault.exit, message: reasons.join("; ") };
        }
    }

    /// Asks each node once; the first that is not in the session any more, with its reason.
    pub fn look(&mut self) -> Result<(), Fault> {
        for (node, answered) in self.nodes.iter().zip(&mut self.answered) {
            let Ok(status) = node.status() else {
                if answered.elapsed() < LOST_PATIENCE {
                    continue;
                }
                let message = format!("the node at {} stopped answering", node.place());
                return Err(Fault::new(Exit::Device, message));
            };
            *answered = Instant::now();
            match status.session_of(self.session_id) {
                Some(session) => {
                    if let Some(Outcome::Failed(fault)) = &session.outcome {
                        let message = format!("node {}: {}", status.node, fault.message);
                        return Err(Fault { exit: fault.exit, message });
                    }
                }
                None => {
                    let message = format!("node {} left the session: it was restarted", status.node);
                    return Err(Fault::new(Exit::Device, message));
                }
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::{Watch, count_down};
    use crate::capture::request::Control;

    #[test]
    fn a_countdown_ends_when_the_operator_does_not_want_it_any_more() {
        let control = Control::default();
        let mut told = Vec::new();
        let counted = count_down(
            60,
            &control,
            &mut |stage| {
                told.push(stage.clone());
                control.stop();
            },
            &mut Watch::new(&[], 1),
        );
        assert_eq!((counted, told.len()), (Ok(()), 1));
        assert!(control.ends());
    }
}
