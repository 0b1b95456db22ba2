// SPDX-License-Identifier: MIT OR Apache-2.0
//! Linear time code: every code comes back with the time of its first edge, whatever the rate and polarity; no damage makes
//! a code that was not sent; and a unit keeps its edges out of the others.

use crate::unit::{Bench, SESSION};
use hsu_firmware_proto::{
    HEARTBEAT_NS, HostToUnit, LinkId, Ltc, MAX_MESSAGE, MAX_RECORDS, Refusal, Request, Slope,
    TIME_CODE_HISTORY, TimeCode, TimeCodeFrame, TimeCodeFrames, UnitToHost,
};
use proptest::prelude::{Just, Strategy, any, prop, prop_assert, prop_assert_eq, prop_oneof, proptest};

/// A frame as SMPTE 12M draws it: its bits in order of time. `user` are the bits that time code leaves to its users.
fn bits(code: TimeCode, user: u32) -> Vec<bool> {
    let digit = |value: u8, count: u8| (0..count).map(move |bit| value >> bit & 1 == 1);
    let mut groups = (0..8).map(|group| digit((user >> (4 * group)) as u8 & 0xf, 4));
    let mut user = move || groups.next().expect("eight groups");
    let mut bits = Vec::new();
    for (value, tens, flags) in [
        (code.frames(), 2, vec![code.drop_frame(), false]),
        (code.seconds(), 3, vec![false]),
        (code.minutes(), 3, vec![false]),
        (code.hours(), 2, vec![false, false]),
    ] {
        bits.extend(digit(value % 10, 4));
        bits.extend(user());
        bits.extend(digit(value / 10, tens));
        bits.extend(flags);
        bits.extend(user());
    }
    bits.extend("0011111111111101".chars().map(|bit| bit == '1'));
    assert_eq!(bits.len(), 80);
    bits
}

/// The edges of frames from `begin_ns` on, the first of them that of the first bit, the last that which ends the last one.
fn edges(frames: &[Vec<bool>], begin_ns: u64, frame_ns: u64, mut rising: bool) -> Vec<(u64, bool)> {
    let at = |half_cells: u64| begin_ns + half_cells * frame_ns / 160;
    let mut edges = vec![(begin_ns, rising)];
    for (cell, &one) in frames.iter().flatten().enumerate() {
        let cell = cell as u64;
        for half in [cell * 2 + 1, cell * 2 + 2] {
            if half % 2 == 0 || one {
                rising = !rising;
                edges.push((at(half), rising));
            }
        }
    }
    edges
}

fn decoded(edges: impl IntoIterator<Item = (u64, bool)>) -> (Vec<TimeCodeFrame>, u32) {
    let mut ltc = Ltc::new();
    let found = edges.into_iter().filter_map(|(time_ns, rising)| ltc.edge(rising, time_ns)).collect();
    (found, ltc.refused())
}

fn next(code: TimeCode, rate: u8) -> TimeCode {
    let drop = code.drop_frame();
    let total = (u32::from(code.hours()) * 60 + u32::from(code.minutes())) * 60 + u32::from(code.seconds());
    if code.frames() + 1 < rate {
        return TimeCode::new(code.hours(), code.minutes(), code.seconds(), code.frames() + 1, drop)
            .expect("the same second");
    }
    let total = (total + 1) % 86_400;
    let (hours, minutes, seconds) = ((total / 3600) as u8, (total / 60 % 60) as u8, (total % 60) as u8);
    TimeCode::new(hours, minutes, seconds, 0, drop)
        .or_else(|| TimeCode::new(hours, minutes, seconds, 2, drop))
        .expect("two are left out")
}

fn codes() -> impl Strategy<Value = (TimeCode, u8)> {
    (
        prop_oneof![0u32..86_400, 86_390u32..86_400],
        0u8..30,
        prop_oneof![Just((24, false)), Just((25, false)), Just((30, false)), Just((30, true)),],
    )
        .prop_filter_map("no such code", |(second, frame, (rate, drop))| {
            let (hours, minutes) = ((second / 3600) as u8, (second / 60 % 60) as u8);
            TimeCode::new(hours, minutes, (second % 60) as u8, frame % rate, drop).map(|code| (code, rate))
        })
}

/// Codes that follow one another, with user bits.
fn run(first: TimeCode, rate: u8, count: usize, user: u32) -> (Vec<TimeCode>, Vec<Vec<bool>>) {
    let codes: Vec<TimeCode> =
        std::iter::successors(Some(first), |code| Some(next(*code, rate))).take(count).collect();
    let bits = codes.iter().zip(0u32..).map(|(code, at)| bits(*code, user.wrapping_mul(at + 1))).collect();
    (codes, bits)
}

#[derive(Debug, Clone)]
enum Damage {
    Lost,
    Moved(i64),
    Twice(u64),
    Glitch(u64, u64),
}

fn damage() -> impl Strategy<Value = Damage> {
    prop_oneof![
        Just(Damage::Lost),
        (-250_000i64..250_000).prop_map(Damage::Moved),
        (1u64..400_000).prop_map(Damage::Twice),
        (1u64..300_000, 1u64..300_000).prop_map(|(after, width)| Damage::Glitch(after, width)),
    ]
}

proptest! {
    /// From 23 to 31 frames a second, with jitter, in either polarity, whatever the user bits.
    #[test]
    fn codes_come_back_with_the_time_of_their_first_edge(
        (first, rate) in codes(), user in any::<u32>(), frame_ns in 1_000_000_000u64 / 31..1_000_000_000 / 23,
        rising in any::<bool>(), begin_ns in 0u64..1 << 50,
        jitter in prop::collection::vec(0u64..25_000, 1..200),
    ) {
        let (codes, bits) = run(first, rate, 6, user);
        let edges = edges(&bits, begin_ns, frame_ns, rising);
        let shaken = edges.iter().zip(jitter.iter().cycle()).map(|(&(time_ns, rising), by)| (time_ns + by, rising));
        let (found, refused) = decoded(shaken);
        // The first frame only says where the next one begins.
        prop_assert_eq!(found.iter().map(|frame| frame.code).collect::<Vec<_>>(), &codes[1..]);
        for (frame, at) in found.iter().zip(1u64..) {
            let due_ns = begin_ns + at * frame_ns;
            prop_assert!((due_ns..due_ns + 25_001).contains(&frame.time_ns));
            prop_assert!(u64::from(frame.duration_ns).abs_diff(frame_ns) <= 25_001);
        }
        prop_assert_eq!(refused, 0);
    }

    /// Edges that are lost, moved or added: what still comes was sent, and began then.
    #[test]
    fn damage_makes_no_code_that_was_not_sent(
        (first, rate) in codes(), user in any::<u32>(), frame_ns in 1_000_000_000u64 / 31..1_000_000_000 / 23,
        damages in prop::collection::vec((0usize..900, damage()), 1..12),
    ) {
        let begin_ns = 1_000_000;
        let (codes, bits) = run(first, rate, 6, user);
        let mut edges: Vec<Option<(u64, bool)>> = edges(&bits, begin_ns, frame_ns, true).into_iter().map(Some).collect();
        let mut added = Vec::new();
        let count = edges.len();
        for (at, damage) in damages {
            let Some((time_ns, rising)) = edges[at % count] else { continue };
            match damage {
                Damage::Lost => edges[at % count] = None,
                Damage::Moved(by) => edges[at % count] = Some((time_ns.saturating_add_signed(by), rising)),
                Damage::Twice(after) => added.push((time_ns + after, !rising)),
                Damage::Glitch(after, width) => {
                    added.extend([(time_ns + after, !rising), (time_ns + after + width, rising)]);
                }
            }
        }
        let mut edges: Vec<(u64, bool)> = edges.into_iter().flatten().chain(added).collect();
        edges.sort_by_key(|(time_ns, _)| *time_ns);
        for frame in decoded(edges).0 {
            let place = (frame.time_ns + frame_ns / 2 - begin_ns) / frame_ns;
            prop_assert_eq!(codes.get(place as usize), Some(&frame.code));
            prop_assert!(frame.time_ns.abs_diff(begin_ns + place * frame_ns) < 250_000);
        }
    }

    /// Any edges at any times, a clock that jumps included.
    #[test]
    fn noise_is_no_time_code(
        edges in prop::collection::vec((any::<bool>(), prop_oneof![
            8 => 136_000u64..609_000, 4 => (0u64..2).prop_map(|half| 208_333 * (half + 1)), 1 => 0u64..2_000_000,
        ]), 0..2000),
        jumps in prop::collection::vec(any::<u64>(), 0..3),
    ) {
        let mut now_ns = 0u64;
        let mut times: Vec<(u64, bool)> = edges.into_iter().map(|(rising, after)| { now_ns += after; (now_ns, rising) }).collect();
        let count = times.len();
        times.extend(jumps.into_iter().map(|time_ns| (time_ns, true)));
        times.swap(0, count.saturating_sub(1));
        prop_assert_eq!(decoded(times).0, vec![]);
    }

    /// Tape that is wound back.
    #[test]
    fn backwards_it_gives_nothing((first, rate) in codes(), user in any::<u32>()) {
        let (_, bits) = run(first, rate, 6, user);
        let edges = edges(&bits, 0, 40_000_000, true);
        let last_ns = edges[edges.len() - 1].0;
        let back = edges.iter().rev().map(|&(time_ns, rising)| (last_ns - time_ns, !rising));
        prop_assert_eq!(decoded(back), (vec![], 0));
    }
}

#[test]
fn every_code_of_a_day_comes_back() {
    for (rate, drop) in [(24, false), (25, false), (30, false), (30, true)] {
        let frame_ns = 1_000_000_000 / u64::from(rate);
        let mut ltc = Ltc::new();
        let mut code = TimeCode::new(0, 0, 0, 0, drop).expect("midnight");
        let (mut begin_ns, mut heard, mut rising) = (0, 0, true);
        let minutes = [0, 1, 2, 9, 10, 59];
        let day = 86_400 * u32::from(rate) - if drop { 144 * 18 } else { 0 };
        loop {
            // Every hour, some minutes, every second and frame.
            if minutes.contains(&code.minutes()) {
                let frame = edges(&[bits(code, 0)], begin_ns, frame_ns, rising);
                rising = frame[frame.len() - 1].1;
                // The edge that ends a frame is the next one's first.
                for &(time_ns, rising) in &frame[usize::from(heard > 0)..] {
                    if let Some(found) = ltc.edge(rising, time_ns) {
                        assert_eq!((found.code, found.time_ns), (code, begin_ns));
                    }
                }
                begin_ns = frame[frame.len() - 1].0;
                heard += 1;
            }
            let following = next(code, rate);
            assert_eq!(code.after(1, rate), Some(following));
            assert_eq!((code.until(following, rate), following.until(code, rate)), (Some(1), Some(day - 1)));
            assert!(code.is_followed_by(following) && !following.is_followed_by(code));
            assert_eq!(TimeCode::parse(&code.to_string()), Some(code));
            code = following;
            if code == TimeCode::new(0, 0, 0, 0, drop).expect("midnight") {
                break;
            }
        }
        let dropped = if drop { 24 * 4 * 2 } else { 0 };
        assert_eq!(heard, 24 * 6 * 60 * u32::from(rate) - dropped);
        assert_eq!(ltc.refused(), 0);
    }
}

#[test]
fn codes_that_do_not_exist_are_not_read() {
    for text in [
        "",
        "1:2:3:4",
        "12:34:56:30",
        "24:00:00:00",
        "12:34:60:00",
        "00:01:00;00",
        "12:34:56.07",
        "12:34:56:0x",
    ] {
        assert_eq!(TimeCode::parse(text), None, "{text}");
    }
    let at_24 = TimeCode::parse("12:34:56:24").expect("a code");
    assert_eq!((at_24.after(1, 24), at_24.until(at_24, 24)), (None, None), "25 frames are more than 24");
}

#[test]
fn digits_that_do_not_exist_are_refused_and_counted() {
    let good = TimeCode::new(12, 34, 56, 7, false).expect("a code");
    // Bits that make a unit 10 or more; more than 30 frames, 60 seconds, 60 minutes; 10 hours in the units; 32 hours.
    for wrong in [vec![3], vec![8, 9], vec![19], vec![25], vec![42], vec![51], vec![57]] {
        let mut frame = bits(good, 0);
        wrong.iter().for_each(|&bit| frame[bit] = true);
        let (found, refused) = decoded(edges(&[bits(good, 0), frame, bits(good, 0)], 0, 40_000_000, true));
        assert_eq!((found.len(), refused), (1, 1), "{wrong:?}");
    }
    assert!(TimeCode::new(0, 1, 0, 1, true).is_none() && TimeCode::new(0, 10, 0, 1, true).is_some());
}

/// Frames that another program has written: `ltc_encoder_get_frame` of libltc 1.3.2 from 12:34:56:07 on, 25 frames a second,
/// the date and the time zone in the user bits.
#[test]
fn frames_of_another_encoder_are_read() {
    let frames =
        ["8720161564235229fcbf", "8820161564235229fcbf", "8920161564235221fcbf", "8021161564235229fcbf"];
    let bits: Vec<Vec<bool>> = frames
        .iter()
        .map(|hex| {
            let bytes =
                (0..10).map(|byte| u8::from_str_radix(&hex[byte * 2..byte * 2 + 2], 16).expect("hex"));
            bytes.flat_map(|byte| (0..8).map(move |bit| byte >> bit & 1 == 1)).collect()
        })
        .collect();
    let (found, refused) = decoded(edges(&bits, 0, 40_000_000, true));
    let read: Vec<String> = found.iter().map(|frame| frame.code.to_string()).collect();
    assert_eq!(
        (read, refused),
        (["12:34:56:08", "12:34:56:09", "12:34:56:10"].map(String::from).to_vec(), 0)
    );
}

/// Names input 3 for time code, and gives the unit these frames on it, and an edge on input 4 with each.
fn feed(bench: &mut Bench, codes: &[Vec<bool>]) {
    let frames = edges(codes, bench.now, 40_000_000, true);
    for &(time_ns, rising) in &frames {
        bench.unit.input(Slope::new(3, rising).expect("a line"), time_ns, &mut bench.out);
    }
    bench.now = frames[frames.len() - 1].0;
}

fn asked(bench: &mut Bench, first: u64) -> (Option<u8>, u64, u64, Vec<TimeCode>) {
    let UnitToHost::TimeCodes { input, next, first, codes, .. } =
        bench.ask(LinkId::B, Request::QueryTimeCodes { first })
    else {
        panic!("expected time codes");
    };
    (input, next, first, codes.as_slice().iter().map(|frame| frame.code).collect())
}

#[test]
fn a_unit_decodes_the_input_that_was_named_and_tells_its_edges_no_more() {
    let mut bench = Bench::ready();
    let (sent, bits) = run(TimeCode::new(9, 59, 59, 20, false).expect("a code"), 25, 90, 0);
    feed(&mut bench, &bits[..2]);
    assert_eq!(asked(&mut bench, 0), (None, 0, 0, vec![]), "nobody has named an input");
    bench.now += HEARTBEAT_NS;
    let UnitToHost::Edges { next: others, .. } = bench.ask(LinkId::A, Request::QueryEdges { first: 0 })
    else {
        panic!("expected edges");
    };
    assert!(others > 0, "an input like any other");

    bench.ack(LinkId::A, Request::SetTimeCode(Some(3)));
    feed(&mut bench, &bits[..6]);
    bench.unit.input(Slope::new(4, true).expect("a line"), bench.now, &mut bench.out);
    assert_eq!(asked(&mut bench, 0), (Some(3), 5, 0, sent[1..6].to_vec()));
    assert_eq!(asked(&mut bench, 3), (Some(3), 5, 3, sent[4..6].to_vec()));
    assert_eq!(asked(&mut bench, u64::MAX), (Some(3), 5, 5, vec![]));
    let UnitToHost::Edges { next, .. } = bench.ask(LinkId::A, Request::QueryEdges { first: 0 }) else {
        panic!("expected edges");
    };
    assert_eq!(next, others + 1, "that of input 4");

    // The oldest are forgotten, and the answer says from where on it is.
    feed(&mut bench, &bits);
    let (_, next, first, codes) = asked(&mut bench, 0);
    assert_eq!((first, codes.len()), (next - TIME_CODE_HISTORY as u64, MAX_RECORDS));
    assert_eq!(codes[0], sent[90 - TIME_CODE_HISTORY]);
}

#[test]
fn both_hosts_name_the_same_input_and_a_host_that_left_names_none() {
    let mut bench = Bench::ready();
    bench.ack(LinkId::A, Request::SetTimeCode(Some(3)));
    bench.ack(LinkId::B, Request::SetTimeCode(Some(3)));
    bench.ack(LinkId::B, Request::SetTimeCode(None));
    let differs = bench.refusal(LinkId::B, Request::SetTimeCode(Some(4)));
    assert_eq!(differs, Refusal::TimeCodeDiffers { unit: 3, host: 4 });
    bench.ack(LinkId::A, Request::SetTimeCode(Some(5)));
    assert_eq!(asked(&mut bench, 0).0, Some(5), "a host may change its mind");
    bench.ack(LinkId::A, Request::Goodbye);
    assert_eq!(asked(&mut bench, 0).0, None);
    bench.ack(LinkId::B, Request::SetTimeCode(Some(4)));
    assert_eq!(asked(&mut bench, 0).0, Some(4));
}

#[test]
fn time_code_starts_no_session() {
    let mut bench = Bench::armed(5, 0);
    let slope = |line| Slope::new(line, true).expect("a line");
    bench.ack(LinkId::A, Request::SetTimeCode(Some(3)));
    assert_eq!(
        bench.refusal(LinkId::B, Request::StartAtEdge(SESSION, slope(3))),
        Refusal::InputIsTimeCode { input: 3 }
    );
    bench.ack(LinkId::B, Request::StartAtEdge(SESSION, slope(4)));
    assert!(matches!(bench.refusal(LinkId::A, Request::SetTimeCode(Some(4))), Refusal::Busy(_)));
}

#[test]
fn golden_bytes_of_the_time_code() {
    let request = |request| {
        let mut bytes = [0; MAX_MESSAGE];
        let message = HostToUnit { request_id: 0x0403_0201, request };
        let length = message.encode(&mut bytes);
        assert_eq!(HostToUnit::decode(&bytes[..length]), Ok(message));
        bytes[..length].to_vec()
    };
    assert_eq!(request(Request::SetTimeCode(Some(3))), [1, 14, 1, 2, 3, 4, 3]);
    assert_eq!(request(Request::SetTimeCode(None)), [1, 14, 1, 2, 3, 4, 0xff]);
    assert!(HostToUnit::decode(&[1, 14, 1, 2, 3, 4, 8]).is_err(), "the unit has no line 8");
    let asked = request(Request::QueryTimeCodes { first: 0x0102 });
    assert_eq!(asked, [1, 15, 1, 2, 3, 4, 2, 1, 0, 0, 0, 0, 0, 0]);
    let code = TimeCode::new(23, 59, 58, 29, true).expect("a code");
    let frame = TimeCodeFrame { time_ns: 0x1020_3040, duration_ns: 0x01fd_32c5, code };
    let mut codes = TimeCodeFrames::default();
    assert!(codes.push(frame));
    let told = |codes| UnitToHost::TimeCodes {
        request_id: 0x0403_0201,
        input: Some(3),
        next: 10,
        refused: 0x0506,
        first: 9,
        codes,
    };
    let mut bytes = [0; MAX_MESSAGE];
    let length = told(codes).encode(&mut bytes);
    let expected = [
        &[1, 0x8c, 1, 2, 3, 4, 3][..],
        &[10, 0, 0, 0, 0, 0, 0, 0, 6, 5, 0, 0, 9, 0, 0, 0, 0, 0, 0, 0, 1],
        &[0x40, 0x30, 0x20, 0x10, 0, 0, 0, 0, 0xc5, 0x32, 0xfd, 0x01, 23, 59, 58, 29, 1],
    ]
    .concat();
    assert_eq!(bytes[..length], expected);
    assert_eq!(UnitToHost::decode(&expected), Ok(told(codes)));
    for (place, wrong) in [(6, 8), (40, 24), (41, 60), (42, 60), (43, 30), (44, 2)] {
        let mut bytes = expected.clone();
        bytes[place] = wrong;
        assert!(UnitToHost::decode(&bytes).is_err(), "{place}");
    }
    while codes.push(frame) {}
    let length = told(codes).encode(&mut bytes);
    assert_eq!(UnitToHost::decode(&bytes[..length]), Ok(told(codes)), "the longest fits");
    for (refusal, code, values) in [
        (Refusal::TimeCodeDiffers { unit: 3, host: 4 }, 16, [3u64, 4]),
        (Refusal::InputIsTimeCode { input: 3 }, 17, [3, 0]),
    ] {
        let message = UnitToHost::Refused(7, refusal);
        let length = message.encode(&mut bytes);
        let values = values.map(u64::to_le_bytes).concat();
        assert_eq!(bytes[..length], [&[1, 0x82, 7, 0, 0, 0, code][..], &values].concat());
        assert_eq!(UnitToHost::decode(&bytes[..length]), Ok(message));
    }
}
