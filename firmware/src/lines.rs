// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the unit says: messages on the serial lines, edges at the outputs. A trigger is planned before its time comes,
//! so what is said of it is held until then.

use crate::board::{SESSION_BIT, SYNC_BIT, UARTS, now_ns};
use crate::player::Player;
use hsu_firmware_proto::frame::{self, MAX_FRAME};
use hsu_firmware_proto::{
    HeadTiming, LINKS, LinkId, MAX_MESSAGE, Sync, TriggerRecord, UnitOutputs, UnitToHost,
};

const HELD: usize = 16;
const TRANSMIT: usize = 8192;
/// The projectors' sync line is high for so long.
const SYNC_NS: u64 = 100_000;
/// The session's output falls so long after the last exposure has ended.
const AFTER_NS: u64 = 1_000;

struct Line {
    bytes: [u8; TRANSMIT],
    first: usize,
    count: usize,
}

impl Line {
    fn queue(&mut self, framed: &[u8]) -> bool {
        if self.count + framed.len() > TRANSMIT {
            return false;
        }
        for &byte in framed {
            self.bytes[(self.first + self.count) % TRANSMIT] = byte;
            self.count += 1;
        }
        true
    }

    fn write(&mut self, link: usize) {
        while self.count > 0 && !UARTS[link].uartfr().read().txff() {
            UARTS[link].uartdr().write(|w| w.set_data(self.bytes[self.first]));
            self.first = (self.first + 1) % TRANSMIT;
            self.count -= 1;
        }
    }
}

#[derive(Clone, Copy)]
struct Held {
    at_ns: u64,
    link: usize,
    length: usize,
    framed: [u8; MAX_FRAME],
}

pub struct Lines {
    lines: [Line; LINKS],
    held: [Held; HELD],
    held_count: usize,
    last_ns: u64,
    pub player: Player,
    /// What the unit takes for now.
    pub now_ns: u64,
    /// The last exposure that was planned ends then.
    over_ns: u64,
    pub sync: Sync,
}

impl Lines {
    pub const fn new() -> Self {
        const LINE: Line = Line { bytes: [0; TRANSMIT], first: 0, count: 0 };
        const NONE: Held = Held { at_ns: 0, link: 0, length: 0, framed: [0; MAX_FRAME] };
        Self {
            lines: [LINE; LINKS],
            held: [NONE; HELD],
            held_count: 0,
            last_ns: 0,
            player: Player::new(),
            now_ns: 0,
            over_ns: 0,
            sync: Sync::Timer,
        }
    }

    /// Sends what may be said by now; returns when to come again.
    pub fn tell(&mut self, now_ns: u64) -> u64 {
        let mut told = 0;
        while told < self.held_count && self.held[told].at_ns <= now_ns {
            let Held { link, length, framed, .. } = self.held[told];
            self.lines[link].queue(&framed[..length]);
            told += 1;
        }
        if told > 0 {
            self.held.copy_within(told..self.held_count, 0);
            self.held_count -= told;
        }
        self.lines.iter_mut().enumerate().for_each(|(link, line)| line.write(link));
        // Half of what the transmitters' FIFOs hold.
        let again = if self.lines.iter().any(|line| line.count > 0) { now_ns + 170_000 } else { u64::MAX };
        if self.held_count > 0 { again.min(self.held[0].at_ns) } else { again }
    }
}

impl UnitOutputs for Lines {
    fn send(&mut self, link: LinkId, message: &UnitToHost) -> bool {
        let mut bytes = [0; MAX_MESSAGE];
        let length = message.encode(&mut bytes);
        let mut framed = [0; MAX_FRAME];
        let length = frame::encode(&bytes[..length], &mut framed);
        if message.request_id().is_some() {
            return self.lines[link.index()].queue(&framed[..length]);
        }
        // In the order in which the unit says it: Done of a Disarm does not overtake a trigger that is planned.
        self.last_ns = self.last_ns.max(self.now_ns);
        if self.last_ns <= now_ns() && self.held_count == 0 {
            return self.lines[link.index()].queue(&framed[..length]);
        }
        if self.held_count == HELD {
            return false;
        }
        self.held[self.held_count] = Held { at_ns: self.last_ns, link: link.index(), length, framed };
        self.held_count += 1;
        true
    }

    fn fire(&mut self, trigger: &TriggerRecord, heads: &[HeadTiming]) {
        if self.sync == Sync::Timer {
            self.player.at(trigger.time_ns, SYNC_BIT, 0);
            self.player.at(trigger.time_ns + SYNC_NS, 0, SYNC_BIT);
        }
        for (number, head) in heads.iter().enumerate() {
            let rise_ns = trigger.time_ns + head.delay_ns;
            self.player.at(rise_ns, 1 << number, 0);
            self.player.at(rise_ns + head.exposure_ns, 0, 1 << number);
            self.over_ns = self.over_ns.max(rise_ns + head.exposure_ns);
        }
    }

    fn session_output(&mut self, high: bool) {
        let (raise, lower) = if high { (SESSION_BIT, 0) } else { (0, SESSION_BIT) };
        // Low no sooner than the last exposure has ended, also where a Disarm ends the session.
        let at_ns = if high { self.now_ns } else { self.now_ns.max(self.over_ns) + AFTER_NS };
        self.player.at(at_ns, raise, lower);
    }
}
