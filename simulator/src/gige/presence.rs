// SPDX-License-Identifier: MIT OR Apache-2.0
//! Whether a camera can be reached, and by whom: what its two threads must agree on while a fault keeps it away.

use std::net::SocketAddrV4;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::SeqCst};
use std::sync::{Mutex, PoisonError};

/// Shared by the streaming thread, which injects faults at triggers, and the control thread, which answers.
#[derive(Debug, Default)]
pub struct Presence {
    /// Without power: what arrives is not answered.
    dark: AtomicBool,
    /// How often power came back.
    boots: AtomicU64,
    /// Its registers hold what its description has no word for.
    nonsense: AtomicBool,
    /// It hears no PTP master.
    no_master: AtomicBool,
    /// Who is to be given control next.
    usurper: Mutex<Option<SocketAddrV4>>,
}

impl Presence {
    /// Switches the camera's power off: it stops answering.
    pub fn power_off(&self) {
        self.dark.store(true, SeqCst);
    }

    /// The power is back: all registers as after power-on.
    pub fn power_on(&self) {
        // Before it answers again, so that no answer comes from an old register.
        self.boots.fetch_add(1, SeqCst);
        self.dark.store(false, SeqCst);
    }

    /// Whether it is without power.
    pub fn is_dark(&self) -> bool {
        self.dark.load(SeqCst)
    }

    /// How often power came back.
    pub fn boots(&self) -> u64 {
        self.boots.load(SeqCst)
    }

    /// Its registers hold nonsense from now on, or do not any more.
    pub fn talk_nonsense(&self, nonsense: bool) {
        self.nonsense.store(nonsense, SeqCst);
    }

    /// Whether its registers hold nonsense.
    pub fn talks_nonsense(&self) -> bool {
        self.nonsense.load(SeqCst)
    }

    /// It hears no PTP master from now on, or hears one.
    pub fn lose_master(&self, lost: bool) {
        self.no_master.store(lost, SeqCst);
    }

    /// Whether it hears no PTP master.
    pub fn has_no_master(&self) -> bool {
        self.no_master.load(SeqCst)
    }

    /// Control shall go to another client.
    pub fn give_control_to(&self, client: SocketAddrV4) {
        *self.usurper.lock().unwrap_or_else(PoisonError::into_inner) = Some(client);
    }

    /// Who is to be given control now.
    pub fn take_usurper(&self) -> Option<SocketAddrV4> {
        self.usurper.lock().unwrap_or_else(PoisonError::into_inner).take()
    }
}
