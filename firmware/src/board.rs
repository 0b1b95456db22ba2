// SPDX-License-Identifier: MIT OR Apache-2.0
//! The Raspberry Pi Pico as the unit needs it: clocks, timer, watchdog, serial lines, inputs, and outputs that are low.

use crate::pac::{
    CLOCKS, IO_BANK0, PADS_BANK0, PLL_SYS, PSM, RESETS, SIO, TIMER, UART0, UART1, WATCHDOG, XOSC,
};
use crate::pac::{clocks, io, uart::Uart};

/// Outputs are GPIO 6 to 15: camera lines of heads 0 to 7, the projectors' sync, the session.
pub const OUTPUT_BASE: usize = 6;
pub const OUTPUTS: usize = 10;
pub const SYNC_BIT: u32 = 1 << 8;
pub const SESSION_BIT: u32 = 1 << 9;
/// Input lines 0 to 7, then the projectors' frame sync.
pub const INPUT_PINS: [usize; 9] = [16, 17, 18, 19, 20, 21, 22, 26, 27];
pub const FRAME_SYNC: usize = 8;
pub const UARTS: [Uart; 2] = [UART0, UART1];

/// Interrupts that wake the main loop.
pub const IRQ_TIMER: i16 = 0;
pub const IRQ_DMA: i16 = 11;
pub const IRQ_IO: i16 = 13;
pub const IRQ_UART1: i16 = 21;
const INTERRUPTS: u32 = 1 << IRQ_TIMER | 1 << IRQ_DMA | 1 << IRQ_IO | 1 << 20 | 1 << IRQ_UART1;

/// The board restarts, with all outputs low, when the main loop did not come by for so long.
const WATCHDOG_US: u32 = 200_000;

/// From the crystal's 12 MHz: 125 MHz for system and peripherals, and microseconds for the timer.
pub fn start_clocks() {
    XOSC.startup().write(|w| w.set_delay(47));
    // 1 to 15 MHz, enabled.
    XOSC.ctrl().write(|w| w.0 = 0xfab << 12 | 0xaa0);
    while !XOSC.status().read().stable() {}
    CLOCKS.clk_ref_ctrl().write(|w| w.set_src(clocks::vals::ClkRefCtrlSrc::XOSC_CLKSRC));
    while CLOCKS.clk_ref_selected().read() != 1 << 2 {}
    CLOCKS.clk_sys_ctrl().write(|w| w.set_src(clocks::vals::ClkSysCtrlSrc::CLK_REF));
    while CLOCKS.clk_sys_selected().read() != 1 {}
    let is_used = |w: &mut crate::pac::resets::regs::Peripherals, in_reset: bool| {
        w.set_dma(in_reset);
        w.set_io_bank0(in_reset);
        w.set_pads_bank0(in_reset);
        w.set_pio0(in_reset);
        w.set_pll_sys(in_reset);
        w.set_timer(in_reset);
        w.set_uart0(in_reset);
        w.set_uart1(in_reset);
    };
    RESETS.reset().modify(|w| is_used(w, true));
    RESETS.reset().modify(|w| is_used(w, false));
    let wanted = !RESETS.reset().read().0 & 0x00e0_1524;
    while RESETS.reset_done().read().0 & wanted != wanted {}
    // 12 MHz * 125 / 6 / 2.
    PLL_SYS.cs().write(|w| w.set_refdiv(1));
    PLL_SYS.fbdiv_int().write(|w| w.set_fbdiv_int(125));
    PLL_SYS.pwr().modify(|w| {
        w.set_pd(false);
        w.set_vcopd(false);
    });
    while !PLL_SYS.cs().read().lock() {}
    PLL_SYS.prim().write(|w| {
        w.set_postdiv1(6);
        w.set_postdiv2(2);
    });
    PLL_SYS.pwr().modify(|w| w.set_postdivpd(false));
    CLOCKS.clk_sys_ctrl().modify(|w| w.set_auxsrc(clocks::vals::ClkSysCtrlAuxsrc::CLKSRC_PLL_SYS));
    CLOCKS.clk_sys_ctrl().modify(|w| w.set_src(clocks::vals::ClkSysCtrlSrc::CLKSRC_CLK_SYS_AUX));
    while CLOCKS.clk_sys_selected().read() != 1 << 1 {}
    CLOCKS.clk_peri_ctrl().write(|w| w.set_enable(true));
    WATCHDOG.tick().write(|w| {
        w.set_cycles(12);
        w.set_enable(true);
    });
}

/// From now on [`feed_watchdog`] must be called again and again.
pub fn start_watchdog() {
    // Everything but the two oscillators is reset, pins too: their pull-downs make them low.
    PSM.wdsel().write(|w| w.0 = 0x1_fffc);
    feed_watchdog();
    WATCHDOG.ctrl().modify(|w| w.set_enable(true));
}

pub fn feed_watchdog() {
    // The counter of this chip goes down twice a microsecond (erratum RP2040-E1).
    WATCHDOG.load().write(|w| w.set_load(2 * WATCHDOG_US));
}

/// Whatever the player does: all outputs low, until the board restarts.
pub fn lower_outputs() {
    for pin in OUTPUT_BASE..OUTPUT_BASE + OUTPUTS {
        IO_BANK0.gpio(pin).ctrl().modify(|w| w.set_outover(io::vals::Outover::LOW));
    }
}

/// Microseconds since the timer was started.
pub fn micros() -> u64 {
    loop {
        let (high, low) = (TIMER.timerawh().read(), TIMER.timerawl().read());
        if TIMER.timerawh().read() == high {
            return u64::from(high) << 32 | u64::from(low);
        }
    }
}

pub fn now_ns() -> u64 {
    micros() * 1000
}

pub fn set_alarm(at_us: u64) {
    TIMER.alarm(0).write_value(at_us as u32);
    // An alarm in the past would come in 71 minutes.
    if micros() >= at_us {
        TIMER.armed().write(|w| w.set_armed(1));
        TIMER.intf().write(|w| w.set_alarm(0, true));
    }
}

pub fn acknowledge_alarm() {
    TIMER.intf().write(|w| w.set_alarm(0, false));
    TIMER.intr().write(|w| w.set_alarm(0, true));
}

pub fn enable_interrupts() {
    TIMER.inte().write(|w| w.set_alarm(0, true));
    // SAFETY: the handler of all of them is there, and what it shares with the main loop are queues.
    unsafe { (*cortex_m::peripheral::NVIC::PTR).iser[0].write(INTERRUPTS) };
}

/// 921600 baud, 8N1, with FIFOs: UART0 on GPIO 0 and 1, UART1 on GPIO 4 and 5.
pub fn start_uarts() {
    for (uart, pins) in UARTS.into_iter().zip([[0, 1], [4, 5]]) {
        pins.iter().for_each(|&pin| IO_BANK0.gpio(pin).ctrl().write(|w| w.set_funcsel(2)));
        // 125 MHz / (16 * (8 + 31/64)) = 920,810 baud: 0.09 % slow.
        uart.uartibrd().write(|w| w.set_baud_divint(8));
        uart.uartfbrd().write(|w| w.set_baud_divfrac(31));
        uart.uartlcr_h().write(|w| {
            w.set_wlen(3);
            w.set_fen(true);
        });
        // An interrupt at four bytes of 32, or after a pause of 32 bits.
        uart.uartifls().write(|w| w.0 = 0);
        uart.uartcr().write(|w| {
            w.set_uarten(true);
            w.set_txe(true);
            w.set_rxe(true);
        });
        uart.uartimsc().write(|w| {
            w.set_rxim(true);
            w.set_rtim(true);
        });
    }
}

pub fn start_inputs() {
    for pin in INPUT_PINS {
        // With a Schmitt trigger, and pulled down: an open input is low.
        PADS_BANK0.gpio(pin).write(|w| {
            w.set_ie(true);
            w.set_pde(true);
            w.set_schmitt(true);
        });
        IO_BANK0.gpio(pin).ctrl().write(|w| w.set_funcsel(5));
        take_edges(pin);
        IO_BANK0.int_proc(0).inte(pin / 8).modify(|w| {
            w.set_edge_low(pin % 8, true);
            w.set_edge_high(pin % 8, true);
        });
    }
}

/// Edges of an input since the last call: fell, rose.
pub fn take_edges(pin: usize) -> (bool, bool) {
    let seen = IO_BANK0.intr(pin / 8).read();
    let (fell, rose) = (seen.edge_low(pin % 8), seen.edge_high(pin % 8));
    if fell || rose {
        IO_BANK0.intr(pin / 8).write(|w| {
            w.set_edge_low(pin % 8, fell);
            w.set_edge_high(pin % 8, rose);
        });
    }
    (fell, rose)
}

pub fn is_high(pin: usize) -> bool {
    SIO.gpio_in(0).read() & 1 << pin != 0
}
