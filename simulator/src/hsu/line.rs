//! One serial line of the simulated unit: the master end of a pty, and a link to its slave end.

use super::SerialNoise;
use serialport::{SerialPort, TTYPort};
use std::collections::VecDeque;
use std::io;
use std::os::fd::{AsRawFd, FromRawFd, IntoRawFd, OwnedFd, RawFd};
use std::path::{Path, PathBuf};

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
    noise: Option<Noise>,
}

impl Line {
    pub(super) fn open(link: &Path, noise: Option<(SerialNoise, u64)>) -> io::Result<Self> {
        let ends = Some(pair(link)?);
        let noise = noise.map(|(noise, line)| Noise::new(noise, line));
        Ok(Self { ends, link: link.to_owned(), transmit: VecDeque::new(), noise })
    }

    /// Pulls the cable, or puts it in again: the host's device vanishes, and comes back under the same name.
    pub(super) fn set_plugged(&mut self, plugged: bool) {
        if !plugged {
            self.remove_link();
            self.ends = None;
            self.transmit.clear();
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
    pub(super) fn queue(&mut self, frame: &[u8]) -> bool {
        if self.transmit.len() + frame.len() > TRANSMIT_BYTES {
            return false;
        }
        let start = self.transmit.len();
        self.transmit.extend(frame);
        if let Some(noise) = &mut self.noise {
            self.transmit.iter_mut().skip(start).for_each(|byte| noise.disturb(byte));
        }
        true
    }

    /// Gives the line what it takes at the moment.
    pub(super) fn write(&mut self) {
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

    /// What has come in, if anything.
    pub(super) fn read<'a>(&mut self, buffer: &'a mut [u8]) -> &'a [u8] {
        // SAFETY: the descriptor is open, and the pointer and length are those of a live, exclusive slice.
        let read = unsafe { libc::read(self.fd(), buffer.as_mut_ptr().cast(), buffer.len()) };
        let taken = &mut buffer[..usize::try_from(read).unwrap_or(0)];
        if let Some(noise) = &mut self.noise {
            taken.iter_mut().for_each(|byte| noise.disturb(byte));
        }
        taken
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

/// xorshift64*: repeatable, and good enough to pick bits.
#[derive(Debug)]
struct Noise {
    flips_per_million: u32,
    state: u64,
}

impl Noise {
    fn new(noise: SerialNoise, line: u64) -> Self {
        let state = noise.seed.wrapping_add(line.wrapping_mul(0x9e37_79b9_7f4a_7c15)) | 1;
        Self { flips_per_million: noise.flips_per_million, state }
    }

    fn next(&mut self) -> u64 {
        self.state ^= self.state >> 12;
        self.state ^= self.state << 25;
        self.state ^= self.state >> 27;
        self.state.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 16
    }

    fn disturb(&mut self, byte: &mut u8) {
        if self.next() % 1_000_000 < u64::from(self.flips_per_million) {
            *byte ^= 1 << (self.next() % 8);
        }
    }
}
