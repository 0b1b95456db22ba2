// SPDX-License-Identifier: MIT OR Apache-2.0
//! One serial line of the simulated unit: the master end of a pty, and a link to its slave end.

use super::disturb::{Disturbance, LineFaults};
use serialport::{SerialPort, TTYPort};
use std::collections::VecDeque;
use std::io;
use std::os::fd::{AsRawFd, FromRawFd, IntoRawFd, OwnedFd, RawFd};
use std::path::{Path, PathBuf};
use std::time::Instant;

/// A transmit buffer like that of a USB serial converter and its driver; when it is full, messages are lost.
const TRANSMIT_BYTES: usize = 16 * 1024;

/// The unit's end of a line.
#[derive(Debug)]
pub(super) struct Line {
    /// The master, and the slave: held open, so that a host may close and reopen the device without the master seeing
    /// a hangup. `None` while the cable is out.
    ends: Option<(OwnedFd, TTYPort)>,
    link: PathBuf,
    transmit: VecDeque<u8>,
    silent: bool,
    /// What happens to bytes on their way to the host and from it; `None`: nothing.
    faults: Option<Faults>,
}

#[derive(Debug)]
struct Faults {
    delays: bool,
    to_host: Disturbance,
    from_host: Disturbance,
    /// Disturbed places that were not yet fetched.
    places: u32,
}

impl Line {
    /// Line `number` of a unit.
    pub(super) fn open(link: &Path, faults: Option<LineFaults>, number: usize) -> io::Result<Self> {
        let ends = Some(pair(link)?);
        let faults = faults.map(|faults| Faults {
            delays: faults.delays(),
            to_host: Disturbance::new(faults, &format!("line {number} to host")),
            from_host: Disturbance::new(faults, &format!("line {number} from host")),
            places: 0,
        });
        Ok(Self { ends, link: link.to_owned(), transmit: VecDeque::new(), silent: false, faults })
    }

    /// From now on every byte is lost in both directions, or none is any more.
    pub(super) fn set_silent(&mut self, silent: bool) {
        self.silent = silent;
        self.lose_what_is_on_its_way();
    }

    fn lose_what_is_on_its_way(&mut self) {
        self.transmit.clear();
        if let Some(faults) = &mut self.faults {
            faults.to_host.clear();
            faults.from_host.clear();
        }
    }

    /// How many places of what went over the line were disturbed since the last call.
    pub(super) fn take_disturbed(&mut self) -> u32 {
        self.faults.as_mut().map_or(0, |faults| std::mem::take(&mut faults.places))
    }

    /// When the next message that is held up arrives at either end.
    pub(super) fn next_due(&self) -> Option<Instant> {
        let faults = self.faults.as_ref()?;
        [faults.to_host.next_due(), faults.from_host.next_due()].into_iter().flatten().min()
    }

    /// Pulls the cable, or puts it in again: the host's device vanishes, and comes back under the same name.
    pub(super) fn set_plugged(&mut self, plugged: bool) {
        if !plugged {
            self.remove_link();
            self.ends = None;
            self.lose_what_is_on_its_way();
        } else if self.ends.is_none() {
            match pair(&self.link) {
                Ok(ends) => self.ends = Some(ends),
                Err(error) => tracing::error!(%error, "the line cannot be plugged in again"),
            }
        }
    }

    /// -1 while the cable is out, which `poll` passes over.
    pub(super) fn fd(&self) -> RawFd {
        self.ends.as_ref().map_or(-1, |(master, _)| master.as_raw_fd())
    }

    fn remove_link(&self) {
        let ours = std::fs::read_link(&self.link).ok();
        let name = self.ends.as_ref().and_then(|(_, slave)| slave.name()).map(PathBuf::from);
        if ours.is_some() && ours == name {
            // Whoever removed the directory before us is welcome.
            let _ = std::fs::remove_file(&self.link);
        }
    }

    pub(super) fn has_output(&self) -> bool {
        !self.transmit.is_empty()
    }

    /// Queues a whole frame, or nothing.
    pub(super) fn queue(&mut self, frame: &[u8], now: Instant) -> bool {
        if self.silent {
            return true;
        }
        let held = self.faults.as_ref().map_or(0, |faults| faults.to_host.held_bytes());
        if self.transmit.len() + held + frame.len() > TRANSMIT_BYTES {
            return false;
        }
        let Some(faults) = &mut self.faults else {
            self.transmit.extend(frame);
            return true;
        };
        let (bytes, places) = faults.to_host.bytes(frame);
        faults.places += places;
        if faults.delays {
            faults.to_host.hold(bytes, now);
        } else {
            self.transmit.extend(bytes);
        }
        true
    }

    /// Gives the line what it takes at the moment.
    pub(super) fn write(&mut self, now: Instant) {
        if let Some(faults) = &mut self.faults {
            while let Some(bytes) = faults.to_host.arrived(now) {
                self.transmit.extend(bytes);
            }
        }
        while !self.transmit.is_empty() {
            let (chunk, _) = self.transmit.as_slices();
            // SAFETY: the descriptor is open, and the pointer and length are those of a live slice.
            let written = unsafe { libc::write(self.fd(), chunk.as_ptr().cast(), chunk.len()) };
            match usize::try_from(written) {
                Ok(written) => drop(self.transmit.drain(..written)),
                Err(_) => return,
            }
        }
    }

    /// What has come in, if anything, instead of what is in `received`.
    pub(super) fn read(&mut self, now: Instant, received: &mut Vec<u8>) {
        received.clear();
        let mut buffer = [0; 1024];
        // SAFETY: the descriptor is open, and the pointer and length are those of a live, exclusive array.
        let read = unsafe { libc::read(self.fd(), buffer.as_mut_ptr().cast(), buffer.len()) };
        let taken = &buffer[..usize::try_from(read).unwrap_or(0)];
        if self.silent {
            return;
        }
        let Some(faults) = &mut self.faults else { return received.extend_from_slice(taken) };
        if !taken.is_empty() {
            let (bytes, places) = faults.from_host.bytes(taken);
            faults.places += places;
            if faults.delays {
                faults.from_host.hold(bytes, now);
            } else {
                received.extend(bytes);
            }
        }
        while let Some(bytes) = faults.from_host.arrived(now) {
            received.extend(bytes);
        }
    }

    /// A real driver lifts exclusive use when the last host closes the device. Here the slave stays open, so
    /// that a host which died would lock its successor out.
    pub(super) fn lift_exclusive_use(&self) {
        let Some((_, slave)) = &self.ends else { return };
        // SAFETY: an ioctl without argument on an open descriptor.
        unsafe { libc::ioctl(slave.as_raw_fd(), libc::TIOCNXCL) };
    }
}

impl Drop for Line {
    fn drop(&mut self) {
        self.remove_link();
    }
}

/// A pty whose slave has a link.
fn pair(link: &Path) -> io::Result<(OwnedFd, TTYPort)> {
    let (master, slave) = TTYPort::pair()?;
    let name = slave.name().ok_or_else(|| io::Error::other("the pty has no name"))?;
    // SAFETY: `into_raw_fd` gives the descriptor up, so this is its only owner.
    let master = unsafe { OwnedFd::from_raw_fd(master.into_raw_fd()) };
    set_nonblocking(master.as_raw_fd())?;
    if let Ok(found) = link.symlink_metadata() {
        if !found.is_symlink() {
            let message = format!("{}: expected nothing or a link, found a file", link.display());
            return Err(io::Error::new(io::ErrorKind::AlreadyExists, message));
        }
        std::fs::remove_file(link)?;
    }
    std::os::unix::fs::symlink(name, link)?;
    Ok((master, slave))
}

fn set_nonblocking(fd: RawFd) -> io::Result<()> {
    // SAFETY: fcntl with plain integers on an open descriptor.
    let result = unsafe {
        let flags = libc::fcntl(fd, libc::F_GETFL);
        libc::fcntl(fd, libc::F_SETFL, flags | libc::O_NONBLOCK)
    };
    if result == -1 { Err(io::Error::last_os_error()) } else { Ok(()) }
}
