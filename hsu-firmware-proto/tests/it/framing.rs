// SPDX-License-Identifier: MIT OR Apache-2.0
//! Properties of the framing: any portions, any corruption.

use hsu_firmware_proto::MAX_MESSAGE;
use hsu_firmware_proto::frame::{Decoder, MAX_FRAME, NO_MESSAGE, encode};
use proptest::prelude::{Just, Strategy, any, prop, prop_assert, prop_assert_eq, prop_oneof, proptest};

fn framed(message: &[u8]) -> Vec<u8> {
    let mut out = [0; MAX_FRAME];
    let length = encode(message, &mut out);
    out[..length].to_vec()
}

fn decoded(decoder: &mut Decoder, bytes: &[u8]) -> Vec<Vec<u8>> {
    let mut messages = Vec::new();
    decoder.feed(bytes, |message| messages.push(message.to_vec()));
    messages
}

/// Plenty of zeros, which is where stuffing can go wrong, and of ones, to which the CRC is blind at the front.
fn message() -> impl Strategy<Value = Vec<u8>> {
    let rest = prop::collection::vec(prop_oneof![Just(0u8), Just(0xff), any::<u8>()], 0..MAX_MESSAGE);
    (0..NO_MESSAGE, rest).prop_map(|(first, rest)| [vec![first], rest].concat())
}

#[derive(Debug, Clone)]
enum Damage {
    Flip(usize, u8),
    Insert(usize, Vec<u8>),
    Delete(usize, usize),
    Truncate(usize),
}

fn damage() -> impl Strategy<Value = Damage> {
    let garbage = prop::collection::vec(any::<u8>(), 1..600);
    prop_oneof![
        (any::<usize>(), 1u8..).prop_map(|(at, mask)| Damage::Flip(at, mask)),
        (any::<usize>(), garbage).prop_map(|(at, bytes)| Damage::Insert(at, bytes)),
        (any::<usize>(), 1usize..300).prop_map(|(at, length)| Damage::Delete(at, length)),
        any::<usize>().prop_map(Damage::Truncate),
    ]
}

fn apply(bytes: &mut Vec<u8>, damage: &Damage) {
    let place = |at: usize| at % bytes.len().max(1);
    match damage {
        Damage::Flip(at, mask) => {
            let at = place(*at);
            if let Some(byte) = bytes.get_mut(at) {
                *byte ^= mask;
            }
        }
        Damage::Insert(at, garbage) => {
            let at = place(*at);
            bytes.splice(at..at, garbage.iter().copied());
        }
        Damage::Delete(at, length) => {
            let at = place(*at);
            bytes.drain(at..at.saturating_add(*length).min(bytes.len()));
        }
        Damage::Truncate(at) => {
            let at = place(*at);
            bytes.truncate(at);
        }
    }
}

proptest! {
    #[test]
    fn portions_do_not_matter(
        messages in prop::collection::vec(message(), 1..6),
        portions in prop::collection::vec(1usize..50, 1..40),
    ) {
        let stream: Vec<u8> = messages.iter().flat_map(|m| framed(m)).collect();
        let mut decoder = Decoder::new();
        let mut found = Vec::new();
        let mut rest = &stream[..];
        for portion in portions.iter().cycle() {
            let (head, tail) = rest.split_at((*portion).min(rest.len()));
            found.extend(decoded(&mut decoder, head));
            rest = tail;
            if rest.is_empty() {
                break;
            }
        }
        prop_assert_eq!(found, messages);
        prop_assert_eq!(decoder.errors().total(), 0);
    }

    /// A zero stands at both ends of a frame and nowhere else.
    #[test]
    fn frames_hold_no_zero(message in message()) {
        let frame = framed(&message);
        prop_assert_eq!(frame.iter().filter(|&&byte| byte == 0).count(), 2);
        prop_assert_eq!((frame[0], frame[frame.len() - 1]), (0, 0));
        prop_assert!(frame.len() <= message.len() + 4 + 3);
    }

    /// Whatever happens to the line: only messages that were sent come out, in the order in which they were
    /// sent, and the first intact frame behind the damage is one of them.
    #[test]
    fn corruption_costs_frames_but_never_invents_one(
        before in prop::collection::vec(message(), 1..5),
        damages in prop::collection::vec(damage(), 1..6),
        after in message(),
    ) {
        let mut stream: Vec<u8> = before.iter().flat_map(|m| framed(m)).collect();
        damages.iter().for_each(|damage| apply(&mut stream, damage));
        stream.extend(framed(&after));
        let mut decoder = Decoder::new();
        let mut found = decoded(&mut decoder, &stream);
        prop_assert_eq!(found.pop(), Some(after));
        let mut sent = before.iter();
        for message in &found {
            prop_assert!(sent.any(|s| s == message), "{message:?} was not sent, or not in this order");
        }
    }

    #[test]
    fn noise_alone_says_nothing(noise in prop::collection::vec(any::<u8>(), 0..4000)) {
        prop_assert!(decoded(&mut Decoder::new(), &noise).is_empty());
    }
}

/// Every single-bit error of a frame is caught; none passes as another message.
#[test]
fn every_single_bit_error_is_caught() {
    let message: Vec<u8> = (0..40).map(|i| (i % 7) as u8).collect();
    let frame = framed(&message);
    for bit in 0..frame.len() * 8 {
        let mut damaged = frame.clone();
        damaged[bit / 8] ^= 1 << (bit % 8);
        let mut decoder = Decoder::new();
        // A damaged leading zero does no harm if the line was quiet before: then it is garbage in front.
        for found in decoded(&mut decoder, &damaged) {
            assert_eq!(found, message);
        }
        decoded(&mut decoder, &[0]);
        assert!(bit / 8 == frame.len() - 1 || decoder.errors().total() > 0, "bit {bit} went unnoticed");
    }
}

/// Five code bytes of a run of zeros unstuff to four zeros, which is the CRC of nothing.
#[test]
fn zeros_that_were_cut_short_are_no_empty_message() {
    let mut decoder = Decoder::new();
    let cut = &framed(&[0; 30])[..6];
    assert_eq!(cut, [0, 1, 1, 1, 1, 1]);
    assert!(decoded(&mut decoder, cut).is_empty());
    assert!(decoded(&mut decoder, &framed(b"next")).len() == 1);
    assert_eq!(decoder.errors().stuffing, 1);
}

/// Ones and the zeros behind them hold their own CRC, so whatever cuts a message to them would pass.
#[test]
fn ones_that_hold_their_own_crc_are_no_message() {
    let mut decoder = Decoder::new();
    // Stuffed: ff 00 00 00 ff; ff ff 00 00 ff ff; ff ff ff 00 ff ff ff; eight times ff.
    let cuts: [&[u8]; 4] = [
        &[0, 2, 0xff, 1, 1, 2, 0xff, 0],
        &[0, 3, 0xff, 0xff, 1, 3, 0xff, 0xff, 0],
        &[0, 4, 0xff, 0xff, 0xff, 4, 0xff, 0xff, 0xff, 0],
        &[0, 9, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0],
    ];
    for cut in cuts {
        assert!(decoded(&mut decoder, cut).is_empty(), "{cut:02x?} passed");
    }
    assert_eq!((decoder.errors().crc, decoder.errors().total()), (4, 4));
    // The same within a message, the line going dead before and behind it.
    let mut stream = framed(&[1, 0, 0xff, 0, 0, 0, 0xff, 0, 7]);
    (stream[2], stream[9]) = (0, 0);
    assert!(decoded(&mut decoder, &stream).is_empty());
}

#[test]
fn a_message_that_is_too_long_or_empty_or_begins_with_ones_is_not_framed() {
    let mut out = [0; MAX_FRAME];
    assert_eq!(encode(&[], &mut out), 0);
    assert_eq!(encode(&[1; MAX_MESSAGE + 1], &mut out), 0);
    assert_eq!(encode(&[NO_MESSAGE, 1], &mut out), 0);
    assert!(encode(&[1; MAX_MESSAGE], &mut out) > MAX_MESSAGE);
}
