// SPDX-License-Identifier: MIT OR Apache-2.0
//! Edges at exact times, whatever the processor does. Two state machines of the PIO play them, fed by DMA from memory:
//!
//! - The *clock* counts x down every second cycle (16 ns), on every path of its program, also while it has nothing to
//!   wait for. So it cannot lose its time. y is when the next edge is due. Then it tells the *hand*.
//! - The *hand* sets all outputs. Edges that follow within a quarter of a microsecond it plays by itself.
//!
//! An edge lies where it was planned, to a cycle of 8 ns. An edge that is handed over too late is played at once, and
//! [`Player::feed`] says so; those behind it are right again.

use crate::board::{OUTPUT_BASE, OUTPUTS, now_ns};
use crate::pac::{DMA, IO_BANK0, PIO0, dma};
use core::sync::atomic::{Ordering, compiler_fence};
use cortex_m::interrupt;

/// State machines, which are also the numbers of their DMA channels and of their requests.
const CLOCK: usize = 0;
const HAND: usize = 1;

/// The hand's program. A word of it: cycles to hold before (17 bits), level of all outputs (10), where to go on (5).
const HAND_AT: usize = 0;
const WAIT: u32 = 0;
const NEXT: u32 = 1;
const HAND_PROGRAM: [u16; 5] = [
    0x20c0, // 0: wait 1 irq 0
    0x6031, // 1: out x, 17
    0x0042, // 2: jmp x--, 2
    0x600a, // 3: out pins, 10
    0x60a5, // 4: out pc, 5
];
/// The clock's program. An empty FIFO gives x, which is how it is known. Counts are two cycles apart in the mean.
const CLOCK_START: usize = 10;
const CLOCK_END: usize = 15;
const CLOCK_PROGRAM: [u16; 11] = [
    0x0046, //  5: jmp x--, 6
    0x00a5, //  6: jmp x!=y, 5
    0xc000, //  7: irq set 0
    0x0049, //  8: jmp x--, 9
    0x004a, //  9: jmp x--, 10
    0x004b, // 10: jmp x--, 11      .wrap_target
    0x004c, // 11: jmp x--, 12
    0x004d, // 12: jmp x--, 13
    0x8080, // 13: pull noblock
    0xa047, // 14: mov y, osr
    0x00a6, // 15: jmp x!=y, 6      .wrap
];

/// From `out pins` to the next of them, where the hand goes on by itself.
const HAND_CYCLES: u64 = 4;
/// Closer than this the hand goes on by itself: the clock needs 10 cycles for its next word.
const CLOSE: u64 = 32;
/// What is handed over must be so far ahead, 10 us; what is overdue is planned so far ahead, 200 us.
const MARGIN: u64 = 1_250;
const AHEAD: u64 = 25_000;
/// Nothing farther ahead is handed over, 20 s: the clock's x comes round after 68 s.
const FARTHEST: u64 = 2_500_000_000;
/// The last edge is long over, and the state machines still have words: 1 ms.
const HANGS: u64 = 125_000;

const EVENTS: usize = 64;

#[derive(Clone, Copy)]
struct Event {
    cycle: u64,
    raise: u32,
    lower: u32,
}

/// What is handed over: how many events, how many words for the clock and for the hand.
struct Plan {
    first: u64,
    last: u64,
    levels: u32,
    taken: usize,
    times: usize,
    hands: usize,
    late: bool,
}

pub struct Player {
    base_ns: u64,
    /// Not handed over yet, in order.
    events: [Event; EVENTS],
    count: usize,
    /// Levels after the last edge that was handed over, and when that is due.
    levels: u32,
    last: u64,
    /// What DMA reads: for the clock, for the hand.
    words: [[u32; EVENTS]; 2],
    /// There was no room for an edge.
    lost: bool,
}

impl Player {
    pub const fn new() -> Self {
        const NONE: Event = Event { cycle: 0, raise: 0, lower: 0 };
        Self {
            base_ns: 0,
            events: [NONE; EVENTS],
            count: 0,
            levels: 0,
            last: 0,
            words: [[0; EVENTS]; 2],
            lost: false,
        }
    }

    /// Outputs are low from here on; time of the player begins as the timer shows another microsecond.
    pub fn start(&mut self) {
        for (place, instruction) in HAND_PROGRAM.into_iter().chain(CLOCK_PROGRAM).enumerate() {
            PIO0.instr_mem(place).write(|w| w.set_instr_mem(instruction));
        }
        let execute = |machine: usize, instruction: u16| {
            PIO0.sm(machine).instr().write(|w| w.set_instr(instruction));
        };
        // `set pins, 0` and `set pindirs, 31`, five pins at a time, before the pins belong to the PIO.
        for base in [OUTPUT_BASE, OUTPUT_BASE + 5] {
            PIO0.sm(HAND).pinctrl().write(|w| {
                w.set_set_count(5);
                w.set_set_base(base as u8);
            });
            execute(HAND, 0xe000);
            execute(HAND, 0xe09f);
        }
        for pin in OUTPUT_BASE..OUTPUT_BASE + OUTPUTS {
            IO_BANK0.gpio(pin).ctrl().write(|w| w.set_funcsel(6));
        }
        PIO0.sm(HAND).pinctrl().write(|w| {
            w.set_out_count(OUTPUTS as u8);
            w.set_out_base(OUTPUT_BASE as u8);
        });
        for machine in [CLOCK, HAND] {
            PIO0.sm(machine).clkdiv().write(|w| w.0 = 1 << 16);
            // Eight words of FIFO, lowest bits first; the hand pulls by itself.
            PIO0.sm(machine).shiftctrl().write(|w| {
                w.set_fjoin_tx(true);
                w.set_out_shiftdir(true);
                w.set_autopull(machine == HAND);
            });
            DMA.ch(machine).write_addr().write_value(PIO0.txf(machine).as_ptr() as u32);
        }
        PIO0.sm(CLOCK).execctrl().write(|w| {
            w.set_wrap_bottom(CLOCK_START as u8);
            w.set_wrap_top(CLOCK_END as u8);
        });
        // Empty shift registers.
        PIO0.ctrl().write(|w| w.set_sm_restart(1 << CLOCK | 1 << HAND));
        DMA.inte(0).write_value(1 << CLOCK | 1 << HAND);
        execute(CLOCK, 0xe020); // set x, 0
        execute(CLOCK, CLOCK_START as u16); // jmp
        execute(HAND, HAND_AT as u16);
        let before = now_ns();
        while now_ns() == before {}
        PIO0.ctrl().write(|w| w.set_sm_enable(1 << CLOCK | 1 << HAND));
        self.base_ns = before + 1000;
    }

    fn cycle(&self, time_ns: u64) -> u64 {
        time_ns.saturating_sub(self.base_ns) >> 3
    }

    /// Plans an edge: outputs to raise, and to lower.
    pub fn at(&mut self, time_ns: u64, raise: u32, lower: u32) {
        if self.count == EVENTS {
            self.lost = true;
            return;
        }
        let cycle = self.cycle(time_ns);
        let mut place = self.count;
        while place > 0 && self.events[place - 1].cycle > cycle {
            self.events[place] = self.events[place - 1];
            place -= 1;
        }
        self.events[place] = Event { cycle, raise, lower };
        self.count += 1;
    }

    fn is_busy(&self) -> bool {
        [CLOCK, HAND].iter().any(|&channel| DMA.ch(channel).ctrl_trig().read().busy())
    }

    /// Hands over all edges. Those that are planned later must not come before them: a trigger does not fall into the
    /// exposures of another. Returns whether an edge is not where it was planned. While DMA works nothing is handed
    /// over; its interrupt says when to come again.
    pub fn feed(&mut self) -> bool {
        let lost = core::mem::take(&mut self.lost);
        let empty = PIO0.fstat().read().txempty() & 0b11 == 0b11;
        assert!(empty || self.last + HANGS > self.cycle(now_ns()), "the player hangs");
        loop {
            if self.is_busy() || self.count == 0 {
                return lost;
            }
            let now = self.cycle(now_ns());
            let plan = self.plan(now);
            if plan.taken == 0 {
                return lost;
            }
            // An interrupt in between would make it too late: then it is planned again.
            let is_handed_over = interrupt::free(|_| {
                let in_time = plan.first >= self.cycle(now_ns()) + MARGIN;
                if in_time {
                    // The hand's words first: its clock must not be there before.
                    self.transfer(HAND, plan.hands);
                    self.transfer(CLOCK, plan.times);
                }
                in_time
            });
            if is_handed_over {
                (self.last, self.levels) = (plan.last, plan.levels);
                self.events.copy_within(plan.taken..self.count, 0);
                self.count -= plan.taken;
                return plan.late || lost;
            }
        }
    }

    /// Words for all edges, as they are played from now on.
    fn plan(&mut self, now: u64) -> Plan {
        let Self { last, levels, .. } = *self;
        let mut plan = Plan { first: 0, last, levels, taken: 0, times: 0, hands: 0, late: false };
        let [times, hands] = &mut self.words;
        for event in self.events[..self.count].iter().take_while(|event| event.cycle <= now + FARTHEST) {
            plan.levels = plan.levels & !event.lower | event.raise;
            plan.taken += 1;
            let levels = plan.levels << 17;
            let is_first = plan.hands == 0;
            let cycle;
            if !is_first && event.cycle <= plan.last + HAND_CYCLES / 2 {
                let word = &mut hands[plan.hands - 1];
                *word = *word & !(((1 << OUTPUTS) - 1) << 17) | levels;
                cycle = plan.last;
            } else if !is_first && event.cycle < plan.last + CLOSE {
                cycle = event.cycle.max(plan.last + HAND_CYCLES);
                hands[plan.hands - 1] |= NEXT << 27;
                hands[plan.hands] = (cycle - plan.last - HAND_CYCLES) as u32 | levels | WAIT << 27;
                plan.hands += 1;
            } else {
                let earliest = if is_first && event.cycle < now + 2 * MARGIN { now + AHEAD } else { 0 };
                cycle = event.cycle.max(plan.last + CLOSE).max(earliest);
                times[plan.times] = ((cycle >> 1) as u32).wrapping_neg();
                hands[plan.hands] = (cycle & 1) as u32 | levels | WAIT << 27;
                plan.times += 1;
                plan.hands += 1;
            }
            plan.late |= cycle > event.cycle + HAND_CYCLES / 2;
            plan.last = cycle;
            if is_first {
                plan.first = cycle;
            }
        }
        plan
    }

    fn transfer(&self, channel: usize, count: usize) {
        compiler_fence(Ordering::SeqCst);
        DMA.ch(channel).read_addr().write_value(self.words[channel].as_ptr() as u32);
        DMA.ch(channel).trans_count().write_value(count as u32);
        DMA.ch(channel).ctrl_trig().write(|w| {
            w.set_en(true);
            w.set_data_size(dma::vals::DataSize::SIZE_WORD);
            w.set_incr_read(true);
            w.set_chain_to(channel as u8);
            w.set_treq_sel(dma::vals::TreqSel::from_bits(channel as u8));
        });
    }
}

/// The next edges may be handed over.
pub fn acknowledge_transfer() {
    DMA.ints(0).write_value(1 << CLOCK | 1 << HAND);
}
