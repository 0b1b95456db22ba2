// SPDX-License-Identifier: MIT OR Apache-2.0
//! Asks the HSU during a session which edges came on its input lines, and makes events of them for the recording.

use super::event_kind::EventKind;
use crate::hsu::{EDGE_HISTORY, HsuError, INPUTS, InputEdges, Refusal};
use crate::record::{InputEdge, NodeEvent};

/// The edges of the HSU's inputs that were read so far.
#[derive(Debug, Default)]
pub struct InputLines {
    /// Number of the next edge; `None` before the first answer.
    next: Option<u64>,
    /// The unit's firmware knows no inputs.
    absent: bool,
}

impl InputLines {
    /// The edges since the last call, as events; none where the unit does not answer, and the next call repeats the
    /// request. `ask` requests the edges from a number on, at most as often as gives all that a unit remembers;
    /// `host_time_ns` is now.
    pub fn look(
        &mut self,
        mut ask: impl FnMut(u64) -> Result<InputEdges, HsuError>,
        host_time_ns: u64,
    ) -> Vec<NodeEvent> {
        let mut events = Vec::new();
        // Each answer has one edge at least, or it is the last.
        for _ in 0..EDGE_HISTORY {
            if self.absent {
                break;
            }
            let answer = match ask(self.next.unwrap_or(u64::MAX)) {
                Ok(answer) => answer,
                Err(error) => {
                    tracing::debug!("the HSU's inputs: {error}");
                    self.absent =
                        matches!(error, HsuError::Refused { refusal: Refusal::UnknownRequest { .. }, .. });
                    break;
                }
            };
            let Some(asked) = self.next else {
                self.next = Some(answer.next);
                let high: Vec<String> = (0..INPUTS)
                    .filter(|line| answer.levels >> line & 1 == 1)
                    .map(|line| line.to_string())
                    .collect();
                if !high.is_empty() {
                    let message = format!("high at the beginning: {}", high.join(", "));
                    events.push(EventKind::HsuInputLevels.event(host_time_ns, None, message));
                }
                break;
            };
            if answer.next < asked {
                let message =
                    "the HSU counts its input edges anew: it was restarted, and what came before is lost";
                events.push(EventKind::HsuInputsLost.event(host_time_ns, None, message));
                self.next = Some(0);
                continue;
            }
            let mut next = asked;
            // Edges whose number was seen before are left out: the protocol numbers each edge once, in rising order.
            for edge in answer.edges.as_slice().iter().filter(|edge| edge.number >= asked) {
                if edge.number > next {
                    let message =
                        format!("{} edges of the HSU's inputs came and were forgotten", edge.number - next);
                    events.push(EventKind::HsuInputsLost.event(host_time_ns, None, message));
                }
                next = next.max(edge.number.saturating_add(1));
                let edge = InputEdge {
                    number: edge.number,
                    line: edge.slope.line(),
                    rising: edge.slope.rising,
                    hsu_time_ns: edge.time_ns,
                    skipped: edge.skipped,
                };
                events.push(edge.event(host_time_ns));
            }
            self.next = Some(next);
            if next == asked || next >= answer.next {
                break;
            }
        }
        events
    }
}

#[cfg(test)]
mod tests {
    use super::InputLines;
    use crate::hsu::{EDGE_HISTORY, Edge, Edges, HsuError, InputEdges, Refusal, Slope};
    use crate::record::InputEdge;

    /// A unit's answer: these numbers, and the next one.
    fn answer(numbers: &[u64], next: u64) -> InputEdges {
        let mut edges = Edges::default();
        let slope = Slope::new(2, true).expect("a line");
        for &number in numbers {
            assert!(edges.push(Edge { number, time_ns: number, slope, skipped: 0 }));
        }
        InputEdges { next, levels: 0b100, edges }
    }

    fn refused(refusal: Refusal) -> Result<InputEdges, HsuError> {
        Err(HsuError::Refused { request: "a question for its inputs", refusal })
    }

    /// Kinds of the events, and the numbers of the edges.
    fn looked(
        lines: &mut InputLines,
        ask: impl FnMut(u64) -> Result<InputEdges, HsuError>,
    ) -> (Vec<String>, Vec<u64>) {
        let events = lines.look(ask, 7);
        let numbers = events.iter().filter_map(InputEdge::of).map(|edge| edge.number).collect();
        (events.into_iter().map(|event| event.kind).collect(), numbers)
    }

    #[test]
    fn edges_are_told_once_and_holes_and_restarts_are_told() {
        let mut lines = InputLines::default();
        let begin = looked(&mut lines, |_| Ok(answer(&[], 5)));
        assert_eq!(
            begin,
            (vec!["hsu_input_levels".to_owned()], vec![]),
            "what came before is not the session's"
        );
        let mut asked = Vec::new();
        let (kinds, numbers) = looked(&mut lines, |first| {
            asked.push(first);
            Ok(if first == 5 { answer(&[5, 6], 9) } else { answer(&[8], 9) })
        });
        assert_eq!((asked, numbers), (vec![5, 7], vec![5, 6, 8]));
        assert_eq!(kinds.iter().filter(|kind| *kind == "hsu_inputs_lost").count(), 1, "7 is forgotten");
        let (kinds, numbers) = looked(&mut lines, |first| Ok(answer(if first == 0 { &[0] } else { &[] }, 1)));
        assert_eq!((kinds[0].as_str(), numbers), ("hsu_inputs_lost", vec![0]), "it was restarted");
        assert_eq!(looked(&mut lines, |_| Ok(answer(&[], 1))), (vec![], vec![]));
    }

    #[test]
    fn only_a_unit_that_does_not_know_the_question_is_not_asked_again() {
        let mut lines = InputLines::default();
        looked(&mut lines, |_| refused(Refusal::HelloFirst));
        assert_eq!(looked(&mut lines, |_| Ok(answer(&[], 0))).0.len(), 1, "asked again");
        looked(&mut lines, |_| refused(Refusal::UnknownRequest { kind: 13 }));
        assert!(looked(&mut lines, |_| panic!("asked again")).0.is_empty());
    }

    #[test]
    fn whatever_a_unit_answers_is_taken_in_bounded_time() {
        let mut lines = InputLines::default();
        looked(&mut lines, |_| Ok(answer(&[], 3)));
        let mut times = 0;
        let same = looked(&mut lines, |_| {
            times += 1;
            Ok(answer(&[0, 1, 2], u64::MAX))
        });
        assert_eq!((same.1, times), (vec![], 1), "nothing new");
        let mut times = 0;
        looked(&mut lines, |first| {
            times += 1;
            Ok(answer(&[first], u64::MAX))
        });
        assert_eq!(times, EDGE_HISTORY);
    }
}
