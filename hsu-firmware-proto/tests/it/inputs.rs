// SPDX-License-Identifier: MIT OR Apache-2.0
//! Input lines: every edge is kept with its number and time or counted, a named edge starts an armed train, and the
//! session's output is high from the first trigger to the end.

use crate::unit::{Bench, PERIOD, SESSION};
use hsu_firmware_proto::{
    EDGE_HISTORY, EDGES_KEPT, Edge, HEARTBEAT_NS, INPUTS, LinkId, MAX_EDGES, MAX_MESSAGE, Refusal, Request,
    Slope, State, UnitToHost,
};
use proptest::prelude::{any, prop, prop_assert, prop_assert_eq, proptest};

fn slope(line: u8, rising: bool) -> Slope {
    Slope::new(line, rising).expect("a line that exists")
}

/// All that the unit still has from `first` on, as a host asks for it; and the number of the next edge, and the levels.
fn edges(bench: &mut Bench, mut first: u64) -> (Vec<Edge>, u64, u8) {
    let mut found: Vec<Edge> = Vec::new();
    loop {
        let UnitToHost::Edges { next, levels, edges, .. } =
            bench.ask(LinkId::A, Request::QueryEdges { first })
        else {
            panic!("expected edges");
        };
        found.extend(edges.as_slice());
        match edges.as_slice().last() {
            Some(last) if last.number + 1 < next => first = last.number + 1,
            _ => return (found, next, levels),
        }
    }
}

proptest! {
    /// Whatever comes in: what is kept is numbered without a gap, and with what was skipped it is all that came.
    #[test]
    fn every_edge_is_kept_or_counted(
        came in prop::collection::vec((0..INPUTS as u8, any::<bool>(), 0u64..20_000_000), 1..400),
    ) {
        let mut bench = Bench::ready();
        let (mut kept, mut levels, mut told) = (Vec::new(), 0u8, 0);
        for (at, &(line, rising, pause_ns)) in came.iter().enumerate() {
            bench.now += pause_ns;
            bench.unit.input(slope(line, rising), bench.now, &mut bench.out);
            levels = if rising { levels | 1 << line } else { levels & !(1 << line) };
            // The host asks as often as a node does, or the unit would forget.
            if at % 50 == 49 || at + 1 == came.len() {
                let (new, next, unit_levels) = edges(&mut bench, told);
                prop_assert_eq!(unit_levels, levels);
                kept.extend(new);
                told = next;
            }
        }
        let numbers: Vec<u64> = kept.iter().map(|edge| edge.number).collect();
        prop_assert_eq!(&numbers, &(0..kept.len() as u64).collect::<Vec<_>>());
        let mut place = 0;
        for edge in &kept {
            place += usize::from(edge.skipped);
            let (line, rising, _) = came[place];
            prop_assert_eq!(edge.slope, slope(line, rising));
            place += 1;
        }
        prop_assert!(place <= came.len());
    }
}

#[test]
fn a_line_that_swings_fast_is_counted_and_the_oldest_edges_are_forgotten() {
    let mut bench = Bench::ready();
    for _ in 0..usize::from(EDGES_KEPT) + 10 {
        bench.unit.input(slope(3, true), bench.now, &mut bench.out);
    }
    bench.now += HEARTBEAT_NS;
    bench.unit.input(slope(3, false), bench.now, &mut bench.out);
    let UnitToHost::Edges { edges: most, .. } = bench.ask(LinkId::A, Request::QueryEdges { first: 0 }) else {
        panic!("expected edges");
    };
    assert_eq!(most.as_slice().len(), MAX_EDGES, "as many as one message takes");
    let (found, next, _) = edges(&mut bench, 0);
    assert_eq!(next, u64::from(EDGES_KEPT) + 1);
    let last = found.last().expect("kept");
    assert_eq!((last.number, last.skipped, last.slope), (next - 1, 10, slope(3, false)));
    for _ in 0..EDGE_HISTORY {
        bench.now += HEARTBEAT_NS;
        bench.unit.input(slope(0, true), bench.now, &mut bench.out);
    }
    let (found, next, _) = edges(&mut bench, 0);
    assert_eq!((found.len(), found[0].number), (EDGE_HISTORY, next - EDGE_HISTORY as u64));
}

#[test]
fn an_armed_train_starts_at_the_edge_that_was_named_and_at_no_other() {
    let mut bench = Bench::ready();
    assert!(matches!(
        bench.refusal(LinkId::A, Request::StartAtEdge(SESSION, slope(2, true))),
        Refusal::NotAllArmed { .. }
    ));
    let mut bench = Bench::armed(5, 2);
    bench.ack(LinkId::A, Request::StartAtEdge(SESSION, slope(2, true)));
    for other in [slope(2, false), slope(1, true)] {
        bench.unit.input(other, bench.now, &mut bench.out);
    }
    bench.pass(PERIOD, 20);
    assert_eq!((bench.unit.state(), bench.numbers()), (State::Armed, vec![]));
    bench.unit.input(slope(2, true), bench.now, &mut bench.out);
    bench.pass(PERIOD / 4, 80);
    assert_eq!((bench.unit.state(), bench.numbers()), (State::Finished, (-2..5).collect()));
    // High with trigger 0, the third that was fired; low when all seven are out.
    assert_eq!(bench.out.output, [(true, 3), (false, 7)]);
    // The session is spent: another such edge starts nothing.
    bench.unit.input(slope(2, true), bench.now, &mut bench.out);
    bench.pass(PERIOD, 20);
    assert_eq!(bench.numbers().len(), 7);
}

#[test]
fn an_edge_starts_nothing_once_an_arming_was_taken_back() {
    let mut bench = Bench::armed(5, 0);
    bench.ack(LinkId::A, Request::StartAtEdge(SESSION, slope(0, true)));
    bench.ack(LinkId::B, Request::Disarm(SESSION));
    bench.unit.input(slope(0, true), bench.now, &mut bench.out);
    bench.pass(PERIOD, 20);
    assert_eq!((bench.unit.state(), bench.numbers()), (State::Finished, vec![]));
    assert!(bench.out.output.is_empty(), "no trigger, no output");
}

#[test]
fn golden_bytes_of_the_inputs() {
    let request = |request| {
        let mut bytes = [0; MAX_MESSAGE];
        let length = hsu_firmware_proto::HostToUnit { request_id: 0x0403_0201, request }.encode(&mut bytes);
        bytes[..length].to_vec()
    };
    let start = request(Request::StartAtEdge(SESSION, slope(7, true)));
    assert_eq!(start, [&[1, 12, 1, 2, 3, 4][..], &SESSION.0, &[7, 1]].concat());
    assert_eq!(request(Request::QueryEdges { first: 0x0102 }), [1, 13, 1, 2, 3, 4, 2, 1, 0, 0, 0, 0, 0, 0]);
    let mut edges = hsu_firmware_proto::Edges::default();
    assert!(edges.push(Edge { number: 9, time_ns: 0x1020_3040, slope: slope(5, false), skipped: 0x0203 }));
    let message = UnitToHost::Edges { request_id: 0x0403_0201, next: 10, levels: 0b100, edges };
    let mut bytes = [0; MAX_MESSAGE];
    let length = message.encode(&mut bytes);
    let expected = [
        &[1, 0x8b, 1, 2, 3, 4][..],
        &[10, 0, 0, 0, 0, 0, 0, 0, 4, 1],
        &[9, 0, 0, 0, 0, 0, 0, 0, 0x40, 0x30, 0x20, 0x10, 0, 0, 0, 0, 5, 0, 3, 2],
    ]
    .concat();
    assert_eq!(bytes[..length], expected);
    assert_eq!(UnitToHost::decode(&expected), Ok(message));
    let mut wrong = expected;
    wrong[32] = 8;
    assert!(UnitToHost::decode(&wrong).is_err(), "the unit has no line 8");
}
