// SPDX-License-Identifier: MIT OR Apache-2.0
//! The HSU's protocol: both decoders, and the unit's state machine.

use super::Script;
use hsu_firmware_proto::frame::{self, Decoder};
use hsu_firmware_proto::{
    HeadTiming, HostToUnit, Identity, LINKS, LinkId, MAX_MESSAGE, NodeName, Refusal, Request, Slope,
    TriggerRecord, Unit, UnitOutputs, UnitToHost,
};

/// Bytes of a serial line, and the same bytes as a bare message.
///
/// Holds: the messages do not depend on how the bytes are cut; what decodes encodes to the same bytes again.
pub fn decoder(data: &[u8]) {
    let mut whole = Vec::new();
    Decoder::new().feed(data, |message| whole.push(message.to_vec()));
    let mut one_by_one = Vec::new();
    let mut decoder = Decoder::new();
    for &byte in data {
        one_by_one.extend(decoder.push(byte).map(<[u8]>::to_vec));
    }
    assert_eq!(whole, one_by_one);
    whole.iter().for_each(|message| check_message(message));
    check_message(&data[..data.len().min(MAX_MESSAGE)]);
    // Framed by us it comes back, whatever lay on the line before; what no message begins with is not framed.
    let message = &data[..data.len().min(MAX_MESSAGE)];
    let mut framed = [0; frame::MAX_FRAME];
    let length = frame::encode(message, &mut framed);
    if message.first() == Some(&frame::NO_MESSAGE) {
        assert_eq!(length, 0);
        return;
    }
    let mut last = None;
    decoder.feed(&framed[..length], |found| last = Some(found.to_vec()));
    assert_eq!(last.as_deref().unwrap_or_default(), message);
}

fn check_message(message: &[u8]) {
    let mut bytes = [0; MAX_MESSAGE];
    if let Ok(decoded) = HostToUnit::decode(message) {
        // A timing that cannot be run is told apart when it is read; it has no bytes of its own.
        if !matches!(decoded.request, Request::Configure(Err(_))) {
            let length = decoded.encode(&mut bytes);
            // A greeting is read whatever version its first byte claims: two ends without a common version can
            // still say so.
            let skip = usize::from(matches!(decoded.request, Request::Hello(_)));
            assert_eq!(&bytes[skip..length], &message[skip..], "{decoded:?}");
        }
    }
    if let Ok(decoded) = UnitToHost::decode(message) {
        // A refusal for a reason that this version does not know keeps its code only: it is never sent on.
        if !matches!(decoded, UnitToHost::Refused(_, Refusal::Other { .. })) {
            let length = decoded.encode(&mut bytes);
            assert_eq!(UnitToHost::decode(&bytes[..length]), Ok(decoded));
        }
    }
}

/// The world of a unit, with what must hold in it.
#[derive(Default)]
struct World {
    /// Per link: ids of answers.
    answers: [Vec<u32>; LINKS],
    line_is_full: bool,
    last: Option<TriggerRecord>,
    period_ns: u64,
}

impl UnitOutputs for World {
    fn send(&mut self, link: LinkId, message: &UnitToHost) -> bool {
        let mut bytes = [0; MAX_MESSAGE];
        let length = message.encode(&mut bytes);
        assert_eq!(UnitToHost::decode(&bytes[..length]), Ok(*message), "the host can read it");
        self.answers[link.index()].extend(message.request_id());
        !self.line_is_full
    }

    fn fire(&mut self, trigger: &TriggerRecord, _: &[HeadTiming]) {
        if let Some(last) = self.last.filter(|last| last.number + 1 == trigger.number) {
            let apart = trigger.time_ns - last.time_ns;
            assert!(apart >= self.period_ns / 8 * 7, "{apart} ns between {last:?} and {trigger:?}");
        } else {
            assert!(trigger.number <= 0, "{:?} and then {trigger:?}", self.last);
        }
        self.last = Some(*trigger);
    }

    fn session_output(&mut self, _: bool) {}
}

/// A script of messages, bytes on the line, passing time, frame syncs and edges of inputs for a unit.
///
/// Holds: every request is answered once, with its id; the unit settles after every step; triggers of a train
/// are consecutive and never closer than 7/8 of a period; what the unit says, a host can read.
pub fn unit(data: &[u8]) {
    let name = NodeName::new("fourdbody-hsu").unwrap_or_default();
    let identity = Identity { name, unique_id: *b"FUZZED-000000001", firmware: [1, 0, 0] };
    let (mut unit, mut world, mut now_ns) = (Unit::new(identity), World::default(), 1_000_000_000u64);
    let mut decoders: [Decoder; LINKS] = std::array::from_fn(|_| Decoder::new());
    let mut script = Script(data);
    while let Some(order) = script.byte() {
        let link = LinkId::ALL[usize::from(order >> 7)];
        match order & 0x7f {
            0..64 => {
                let length = script.byte().unwrap_or(0);
                let message = script.bytes(usize::from(length).min(MAX_MESSAGE));
                receive(&mut unit, &mut world, link, now_ns, message);
            }
            64..72 => {
                let length = script.byte().unwrap_or(0);
                let bytes = script.bytes(usize::from(length));
                let decoder = &mut decoders[link.index()];
                let mut messages = Vec::new();
                decoder.feed(bytes, |message| messages.push(message.to_vec()));
                messages.iter().for_each(|m| receive(&mut unit, &mut world, link, now_ns, m));
                unit.bad_frames(link, decoder.errors().total());
            }
            72..112 => now_ns += 50_000 * u64::from(script.word().unwrap_or(0)),
            112..120 => unit.frame_sync(now_ns, &mut world),
            120..124 => unit.hardware_fault(u32::from(script.byte().unwrap_or(0)), now_ns, &mut world),
            124 | 125 => world.line_is_full = !world.line_is_full,
            _ => edges(&mut unit, &mut world, &mut now_ns, &mut script),
        }
        world.period_ns = unit.timing().map_or(0, |timing| timing.period_ns);
        settle(&mut unit, &mut world, now_ns);
    }
}

/// Edges of input lines: a byte each for line and direction, and one for the time since the one before.
fn edges(unit: &mut Unit, world: &mut World, now_ns: &mut u64, script: &mut Script<'_>) {
    for _ in 0..script.byte().unwrap_or(0) {
        let (Some(which), Some(after)) = (script.byte(), script.byte()) else { return };
        *now_ns += 5_000 * u64::from(after);
        let slope = Slope::new(which & 7, which & 8 != 0).expect("a line of the unit");
        unit.input(slope, *now_ns, world);
    }
}

fn receive(unit: &mut Unit, world: &mut World, link: LinkId, now_ns: u64, message: &[u8]) {
    let answers = world.answers[link.index()].len();
    unit.receive(link, now_ns, message, world);
    let answers = &world.answers[link.index()][answers..];
    match HostToUnit::decode(message) {
        Ok(message) => assert_eq!(answers, [message.request_id], "{message:?}"),
        Err(unreadable) => assert_eq!(answers, unreadable.request_id.as_slice(), "{unreadable:?}"),
    }
}

fn settle(unit: &mut Unit, world: &mut World, now_ns: u64) {
    for _ in 0..64 {
        unit.tick(now_ns, world);
        if unit.next_due() > now_ns {
            return;
        }
    }
    panic!("the unit has something to do at {} for ever, in state {:?}", unit.next_due(), unit.state());
}
