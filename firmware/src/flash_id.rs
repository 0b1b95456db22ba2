// SPDX-License-Identifier: MIT OR Apache-2.0
//! The number of the flash chip, which no other board has: the unit's serial number.
//!
//! The program is in that flash. While the chip is asked nothing may be read from it, so that [`ask`] lies in RAM and
//! calls the boot ROM only.

use crate::pac::{IO_QSPI, SSI, io};

type Rom = unsafe extern "C" fn();

/// "Read unique ID" of the chips that boards of the RP2040 have, four bytes of delay, eight bytes of number.
const READ_ID: u8 = 0x4b;
const BEFORE: usize = 5;
const LENGTH: usize = 8;

/// The number in hexadecimal digits. Interrupts must be off.
pub fn read() -> [u8; 16] {
    // SAFETY: addresses and types are those of the boot ROM's table (RP2040 datasheet, 2.8.3).
    let rom = |code: &[u8; 2]| unsafe {
        let table = u32::from((0x14 as *const u16).read_volatile());
        let look_up = u32::from((0x18 as *const u16).read_volatile()) as usize;
        let look_up: extern "C" fn(u32, u32) -> Rom = core::mem::transmute(look_up);
        look_up(table, u32::from(u16::from_le_bytes(*code)))
    };
    let calls = [rom(b"IF"), rom(b"EX"), rom(b"FC")];
    // The boot loader's second stage makes the flash readable again, from a copy.
    let mut boot2 = [0u32; 64];
    for (place, word) in boot2.iter_mut().enumerate() {
        // SAFETY: the first 256 bytes of the flash.
        *word = unsafe { (0x1000_0000 as *const u32).add(place).read_volatile() };
    }
    let mut id = [0; LENGTH];
    // SAFETY: the copy is code that returns; interrupts are off, and the other core sleeps.
    unsafe {
        let boot2: Rom = core::mem::transmute(boot2.as_ptr() as usize | 1);
        ask(&calls, boot2, &mut id);
    }
    let digit = |half: u8| b"0123456789abcdef"[usize::from(half)];
    core::array::from_fn(|place| digit(id[place / 2] >> (4 * (1 - place % 2)) & 15))
}

/// # Safety
/// `calls` are the ROM's ways to connect the flash, to leave reading it as memory, and to forget what was read.
#[unsafe(link_section = ".data.ask")]
#[inline(never)]
unsafe fn ask(calls: &[Rom; 3], boot2: Rom, id: &mut [u8; LENGTH]) {
    // SAFETY: as above.
    unsafe {
        calls[0]();
        calls[1]();
    }
    IO_QSPI.gpio(1).ctrl().modify(|w| w.set_outover(io::vals::Outover::LOW));
    let (mut sent, mut received) = (0, 0);
    while received < BEFORE + LENGTH {
        let state = SSI.sr().read();
        if sent < BEFORE + LENGTH && sent < received + 8 && state.tfnf() {
            SSI.dr0().write_value(if sent == 0 { u32::from(READ_ID) } else { 0 });
            sent += 1;
        }
        if received < sent && state.rfne() {
            let byte = SSI.dr0().read() as u8;
            if received >= BEFORE {
                // SAFETY: `received` is below the sum of both. A check would call what lies in the flash.
                unsafe { id.as_mut_ptr().add(received - BEFORE).write_volatile(byte) };
            }
            received += 1;
        }
    }
    IO_QSPI.gpio(1).ctrl().modify(|w| w.set_outover(io::vals::Outover::HIGH));
    // SAFETY: as above. The first of them also lets go of the chip's select line.
    unsafe {
        calls[2]();
        boot2();
    }
}
