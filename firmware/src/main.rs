// SPDX-License-Identifier: MIT OR Apache-2.0
//! The HSU on a Raspberry Pi Pico: `hsu_firmware_proto::Unit` between two serial lines, inputs, and outputs with exact
//! times. The guide is `docs/guide/building-the-hsu.md`.
#![no_std]
#![no_main]

mod board;
mod flash_id;
mod lines;
mod player;
mod ring;

use cortex_m::{asm, interrupt};
use cortex_m_rt::{ExceptionFrame, entry, exception};
use hsu_firmware_proto::frame::Decoder;
use hsu_firmware_proto::{Identity, LINKS, LinkId, NodeName, Slope, State, Sync, Unit};
use lines::Lines;
use ring::Ring;
use rp_pac as pac;

#[unsafe(link_section = ".boot2")]
#[used]
static BOOT2: [u8; 256] = rp2040_boot2::BOOT_LOADER_W25Q080;

static RECEIVED: [Ring<u8, 1024>; LINKS] = [Ring::new(0), Ring::new(0)];
/// Place in `INPUT_PINS`, whether it rose, when.
static EDGES: Ring<(u8, bool, u64), 256> = Ring::new((0, false, 0));

/// A timed trigger is planned so long ahead; half a period where that is shorter.
const LEAD_NS: u64 = 3_000_000;
/// With less than this before it a trigger is too late, and moved; at most half of what it is planned ahead. The
/// difference is how long the processor may be held up.
const LEAST_NS: u64 = 600_000;

/// Codes of the fault Hardware: a trigger was moved, because the processor was held up.
const HELD_UP: u32 = 1;
/// An edge of an output is not where it was planned.
const EDGE_MOVED: u32 = 2;
/// Edges of inputs, or bytes of a line, were lost.
const QUEUE_FULL: u32 = 3;

/// The serial number is the flash's, and is put in when it was read.
const IDENTITY: Identity = Identity {
    name: NodeName(*b"fourdbody-hsu\0\0\0"),
    unique_id: [b'0'; 16],
    firmware: [
        version(env!("CARGO_PKG_VERSION_MAJOR")),
        version(env!("CARGO_PKG_VERSION_MINOR")),
        version(env!("CARGO_PKG_VERSION_PATCH")),
    ],
};

#[entry]
fn main() -> ! {
    static mut UNIT: Unit = Unit::new(IDENTITY);
    static mut LINES: Lines = Lines::new();
    static mut DECODERS: [Decoder; LINKS] = [const { Decoder::new() }; LINKS];
    interrupt::disable();
    UNIT.identify(Identity { unique_id: flash_id::read(), ..IDENTITY });
    board::start_clocks();
    board::start_uarts();
    board::start_inputs();
    LINES.player.start();
    board::start_watchdog();
    board::enable_interrupts();
    // SAFETY: all that the handlers use has been set up.
    unsafe { interrupt::enable() };
    let mut planned_ns = 0;
    loop {
        board::feed_watchdog();
        take_inputs(UNIT, LINES);
        take_messages(UNIT, LINES, DECODERS);
        let wake_ns = act(UNIT, LINES, &mut planned_ns);
        // Not a division: this processor has none.
        let now_us = board::micros();
        let ahead_ns = wake_ns.saturating_sub(now_us * 1000).clamp(20_000, 100_000_000);
        wait(now_us + ((ahead_ns * 4_294_968) >> 32));
    }
}

const fn version(digits: &str) -> u16 {
    match u16::from_str_radix(digits, 10) {
        Ok(number) => number,
        Err(_) => panic!("Cargo's versions are numbers"),
    }
}

fn take_inputs(unit: &mut Unit, lines: &mut Lines) {
    while let Some((place, rising, edge_ns)) = EDGES.pop() {
        lines.now_ns = edge_ns;
        if usize::from(place) != board::FRAME_SYNC {
            if let Some(slope) = Slope::new(place, rising) {
                unit.input(slope, edge_ns, lines);
            }
        } else if rising {
            unit.frame_sync(edge_ns, lines);
        }
    }
    if EDGES.take_lost() | RECEIVED[0].take_lost() | RECEIVED[1].take_lost() {
        fault(unit, lines, QUEUE_FULL);
    }
}

fn take_messages(unit: &mut Unit, lines: &mut Lines, decoders: &mut [Decoder; LINKS]) {
    for link in LinkId::ALL {
        let decoder = &mut decoders[link.index()];
        while let Some(byte) = RECEIVED[link.index()].pop() {
            let bad = decoder.errors().total();
            if let Some(message) = decoder.push(byte) {
                lines.now_ns = board::now_ns();
                unit.receive(link, lines.now_ns, message, lines);
            }
            let bad = decoder.errors().total() - bad;
            if bad > 0 {
                unit.bad_frames(link, bad);
            }
        }
    }
}

/// Plans the next trigger, plays edges, sends. `planned_ns` is the latest time that the unit was told. Returns when to
/// come again.
fn act(unit: &mut Unit, lines: &mut Lines, planned_ns: &mut u64) -> u64 {
    let (sync, period_ns) = unit.timing().map_or((Sync::Timer, 0), |timing| (timing.sync, timing.period_ns));
    lines.sync = sync;
    let is_timed = unit.state() == State::Running && sync == Sync::Timer;
    let lead_ns = if is_timed { LEAD_NS.min(period_ns / 2) } else { 0 };
    let least_ns = LEAST_NS.min(lead_ns / 2);
    let now_ns = board::now_ns();
    let due_ns = unit.next_due();
    if due_ns <= now_ns + lead_ns {
        lines.now_ns = due_ns.max(now_ns + least_ns).max(*planned_ns);
        *planned_ns = lines.now_ns;
        unit.tick(lines.now_ns, lines);
    }
    if lines.player.feed() {
        fault(unit, lines, EDGE_MOVED);
    }
    if is_timed && due_ns < now_ns + least_ns {
        fault(unit, lines, HELD_UP);
    }
    lines.tell(board::now_ns()).min(unit.next_due().saturating_sub(lead_ns))
}

fn fault(unit: &mut Unit, lines: &mut Lines, code: u32) {
    lines.now_ns = board::now_ns();
    unit.hardware_fault(code, lines.now_ns, lines);
}

/// Sleeps until an interrupt comes; what came since the queues were looked at is not slept through, nor is the alarm.
fn wait(until_us: u64) {
    interrupt::free(|_| {
        board::set_alarm(until_us);
        if RECEIVED.iter().all(Ring::is_empty) && EDGES.is_empty() {
            asm::wfi();
        }
    });
}

#[exception]
unsafe fn DefaultHandler(irq: i16) {
    match irq {
        board::IRQ_TIMER => board::acknowledge_alarm(),
        board::IRQ_DMA => player::acknowledge_transfer(),
        board::IRQ_IO => {
            let now_ns = board::now_ns();
            for (place, pin) in board::INPUT_PINS.into_iter().enumerate() {
                let high = board::is_high(pin);
                match board::take_edges(pin) {
                    (true, true) => {
                        EDGES.push((place as u8, !high, now_ns));
                        EDGES.push((place as u8, high, now_ns));
                    }
                    (false, false) => {}
                    (_, rose) => EDGES.push((place as u8, rose, now_ns)),
                }
            }
        }
        _ => {
            let link = usize::from(irq == board::IRQ_UART1);
            while !board::UARTS[link].uartfr().read().rxfe() {
                RECEIVED[link].push(board::UARTS[link].uartdr().read().data());
            }
        }
    }
}

#[exception]
unsafe fn HardFault(_: &ExceptionFrame) -> ! {
    stop()
}

#[panic_handler]
fn panic(_: &core::panic::PanicInfo<'_>) -> ! {
    stop()
}

/// Outputs low; then nobody feeds the watchdog, and the board restarts.
fn stop() -> ! {
    interrupt::disable();
    board::lower_outputs();
    loop {
        asm::nop();
    }
}
