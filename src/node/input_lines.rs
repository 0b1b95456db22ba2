// SPDX-License-Identifier: MIT OR Apache-2.0
//! Asks the HSU during a session which edges came on its input lines, and makes events of them for the recording.

use crate::hsu::{Hsu, HsuError};
use crate::record::{InputEdge, NodeEvent};

/// What is known of the lines.
#[derive(Debug, Default)]
pub struct InputLines {
    /// Number of the next edge; `None` before the first answer.
    next: Option<u64>,
    /// The unit's firmware knows no inputs.
    absent: bool,
}

impl InputLines {
    /// What came since the last time; nothing where the unit does not answer: it is asked again. `host_time_ns` is now.
    pub fn look(&mut self, hsu: &Hsu, host_time_ns: u64) -> Vec<NodeEvent> {
        let mut events = Vec::new();
        let told = |kind: &str, message: String| NodeEvent {
            host_time_ns,
            kind: kind.to_owned(),
            camera: None,
            trigger: None,
            message,
        };
        while !self.absent {
            let asked = self.next;
            let answer = match hsu.input_edges(asked.unwrap_or(u64::MAX)) {
                Ok(answer) => answer,
                Err(HsuError::Refused { .. }) => {
                    tracing::debug!("the HSU's firmware has no inputs");
                    self.absent = true;
                    break;
                }
                Err(error) => {
                    tracing::debug!("the HSU's inputs: {error}");
                    break;
                }
            };
            let Some(mut next) = asked else {
                self.next = Some(answer.next);
                if answer.levels != 0 {
                    let high: Vec<String> = (0..8)
                        .filter(|line| answer.levels >> line & 1 == 1)
                        .map(|line| line.to_string())
                        .collect();
                    let message = format!("high at the beginning: {}", high.join(", "));
                    events.push(told("hsu_input_levels", message));
                }
                break;
            };
            if answer.next < next {
                let message =
                    "the HSU counts its input edges anew: it was restarted, and what came before is lost";
                events.push(told("hsu_inputs_lost", message.to_owned()));
                self.next = Some(0);
                continue;
            }
            for edge in answer.edges.as_slice() {
                if edge.number > next {
                    let message =
                        format!("{} edges of the HSU's inputs came and were forgotten", edge.number - next);
                    events.push(told("hsu_inputs_lost", message));
                }
                next = edge.number.saturating_add(1);
                let edge = InputEdge {
                    number: edge.number,
                    line: edge.slope.line(),
                    rising: edge.slope.rising,
                    hsu_time_ns: edge.time_ns,
                    skipped: edge.skipped,
                };
                events.push(edge.event(host_time_ns));
            }
            let behind = next < answer.next && !answer.edges.as_slice().is_empty();
            self.next = Some(next);
            if !behind {
                break;
            }
        }
        events
    }
}
