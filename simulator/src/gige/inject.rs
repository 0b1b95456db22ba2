// SPDX-License-Identifier: MIT OR Apache-2.0
//! Injected faults on the wire: which datagrams a frame with a fault becomes, and when a camera injects one.

use super::gvsp::{FORMATS, Form, Layout, Payload};
use crate::faults::{CameraFaults, CameraPlan, Fault, Kind, Part, Resend};
use crate::random::hash;
use crate::wire::TriggerEdge;
use std::time::{Duration, Instant};

/// The faults of one camera while trains come and go.
#[derive(Debug)]
pub struct Injector {
    faults: CameraFaults,
    plan: CameraPlan,
    train: u64,
    last: Option<(i64, Instant)>,
    period: Option<Duration>,
    /// The camera is away, and the triggers pass it by.
    away: bool,
}

impl Injector {
    /// An injector before the first train begins.
    pub fn new(faults: CameraFaults) -> Self {
        let plan = CameraPlan::new(&faults.camera);
        Self { faults, plan, train: 0, last: None, period: None, away: false }
    }

    /// The fault of the trigger that this edge is. An edge whose number is not above the last one's begins a train.
    pub fn on_edge(&mut self, edge: &TriggerEdge) -> Option<Fault> {
        match self.last {
            Some((instant, _)) if edge.instant > instant + 1 => {}
            Some((instant, time)) if edge.instant > instant => {
                let since = edge.time.checked_duration_since(time);
                // A train on a busy host is late now and then, and no slower for it.
                self.period = since.min(self.period.or(since));
            }
            _ => {
                self.train += 1;
                self.plan = CameraPlan::new(&self.faults.camera);
            }
        }
        self.last = Some((edge.instant, edge.time));
        if std::mem::take(&mut self.away) {
            self.plan.returned(&self.faults.plan, edge.instant);
        }
        let fault = self.plan.fault(&self.faults.plan, edge.instant)?;
        if fault.kind == Kind::TriggerIgnored || fault.kind.is_absence() {
            self.record(edge.instant, None, fault);
        }
        self.away = fault.kind.is_absence();
        Some(fault)
    }

    /// The shortest time between two edges of the train.
    pub fn period(&self) -> Option<Duration> {
        self.period
    }

    /// A frame with a fault went out.
    pub fn sent(&self, instant: i64, block_id: u64, fault: Fault) {
        self.record(instant, Some(block_id), fault);
    }

    fn record(&self, instant: i64, block: Option<u64>, fault: Fault) {
        if let Ok(trigger) = u64::try_from(instant) {
            self.faults.truth.record(self.train, &self.faults.camera, trigger, block, fault);
        }
    }
}

/// What becomes of requests for packets of a frame with this fault.
pub fn resend_policy(fault: Fault) -> Resend {
    match fault.kind {
        Kind::Lost(_, resend) => resend,
        _ => Resend::Answered,
    }
}

/// What a frame with this fault is, and how it is cut: it may be no frame of the session's at all.
pub fn layout(layout: Layout, fault: Fault) -> Layout {
    /// Padding of a row and length of a chunk, bytes.
    const EXTRA: u16 = 8;
    let form = layout.form;
    layout.with(match fault.kind {
        // Every second one changes the leader alone, and its pixels stay as they were.
        Kind::WrongFormat => {
            let others = FORMATS.len() as u64 - 1;
            let (_, told) = FORMATS[1 + (fault.chance % others) as usize];
            let format = if (fault.chance / others).is_multiple_of(2) { told } else { form.format };
            Form { format, told, ..form }
        }
        Kind::PaddedRows => Form { padding: EXTRA, ..form },
        Kind::ChunksAppended => {
            Form { appended: u32::from(EXTRA), payload: Payload::ImageWithChunks, ..form }
        }
        // As firmware does that rounds them down (aravis#687).
        Kind::ShortPackets => Form { short: 4, ..form },
        _ => form,
    })
}

/// The timestamp of a frame with this fault, ns.
pub fn stamp(ns: u64, fault: Fault) -> u64 {
    match fault.kind {
        Kind::StampAbsent => 0,
        Kind::StampGlitch => match fault.chance % 4 {
            0 => ns.wrapping_add(60_000_000),
            1 => ns.saturating_sub(60_000_000).max(1),
            2 => ns.wrapping_add(1 << 45),
            _ => u64::MAX,
        },
        Kind::StampNear => ns.wrapping_add(3_000_000),
        _ => ns,
    }
}

/// Leader, payload and trailer of a frame to the datagrams that go out instead.
pub fn datagrams(mut packets: Vec<Vec<u8>>, fault: Fault, header: usize) -> Vec<Vec<u8>> {
    // Leader and trailer around at least one payload packet: a layout has no empty image.
    let payload = packets.len().saturating_sub(2).max(1) as u64;
    let one = 1 + (fault.chance % payload) as usize;
    match fault.kind {
        Kind::FrameLost | Kind::Stall => packets.clear(),
        Kind::Lost(part, resend) => {
            let trailer = packets.len().saturating_sub(1);
            let lost = match part {
                Part::Packet => one..one + 1,
                // Aravis asks for a quarter of a frame's packets at most.
                Part::Burst if resend == Resend::Answered => one..(one + 2).min(trailer),
                Part::Burst => one..(one + 3).min(trailer),
                Part::Leader => 0..1,
                Part::Trailer => trailer..trailer + 1,
            };
            drop(packets.drain(lost));
        }
        Kind::Reordered => {
            // Fisher and Yates; the order depends on the fault alone.
            for last in (1..packets.len()).rev() {
                let other = hash(fault.chance, &[last as u64]) % (last as u64 + 1);
                packets.swap(last, other as usize);
            }
        }
        Kind::Duplicated => {
            packets = packets.into_iter().flat_map(|packet| [packet.clone(), packet]).collect()
        }
        Kind::RepeatedFrame => packets.extend(packets.clone()),
        Kind::Truncated => {
            if let Some(packet) = packets.get_mut(one) {
                packet.truncate(header + (packet.len() - header.min(packet.len())) / 2);
            }
        }
        Kind::Malformed => {
            for (place, garbage) in malformed(&packets, fault, header).into_iter().enumerate() {
                packets.insert((1 + place).min(packets.len()), garbage);
            }
        }
        Kind::TriggerIgnored | Kind::ExtraFrame | Kind::IdJump | Kind::ClockReset => {}
        Kind::StampGlitch | Kind::StampNear | Kind::StampAbsent => {}
        Kind::Unplugged | Kind::ControlTaken => packets.clear(),
        Kind::RogueClient | Kind::Nonsense => {}
        Kind::ForeignFar | Kind::ForeignAhead | Kind::ForeignPixels | Kind::ForeignSmall => {}
        // What they are is in the layout.
        Kind::WrongFormat | Kind::PaddedRows | Kind::ChunksAppended | Kind::ShortPackets => {}
    }
    packets
}

/// Datagrams that are no packets: too short for a header, a header of no known format, a packet id beyond the
/// trailer's. Those with a header carry the frame's own id: a foreign one would be another fault, a jump of ids.
fn malformed(packets: &[Vec<u8>], fault: Fault, header: usize) -> Vec<Vec<u8>> {
    let Some(model) = packets.get(1) else { return Vec::new() };
    let noise = |length: u64| (0..length).map(|k| hash(fault.chance, &[k]) as u8);
    // No longer than the status: Aravis reads an id from any datagram, and follows it (docs/design/faults.md).
    let short = vec![0; (fault.chance % 3) as usize];
    let mut unknown: Vec<u8> = model.iter().copied().take(header).chain(noise(64)).collect();
    if let Some(format) = unknown.get_mut(4) {
        *format = *format & 0x80 | 0x0f;
    }
    let mut beyond: Vec<u8> = model.iter().copied().take(header).chain(noise(64)).collect();
    // The last three bytes of a header are packet id in both widths.
    if let Some(id) = beyond.get_mut(header.saturating_sub(3)..header) {
        id.fill(0xf0);
    }
    vec![short, unknown, beyond]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame() -> Vec<Vec<u8>> {
        (0..8u8).map(|id| vec![id; 40]).collect()
    }

    #[test]
    fn losses_lose_and_the_rest_keeps_every_packet() {
        for kind in Kind::all() {
            for chance in 0..50 {
                let sent = datagrams(frame(), Fault { kind, chance, count: 1 }, 8);
                let all = frame().iter().all(|packet| sent.contains(packet));
                let losing = matches!(kind, Kind::FrameLost | Kind::Stall | Kind::Lost(..) | Kind::Truncated);
                assert_eq!(all, !losing, "{kind} {chance}");
                let leader_lost = matches!(kind, Kind::Lost(Part::Leader, _));
                if let Kind::Lost(..) = kind {
                    assert_eq!(sent.contains(&frame()[0]), !leader_lost);
                    assert!((5..=7).contains(&sent.len()), "{kind}: {}", sent.len());
                }
            }
        }
    }
}
