// SPDX-License-Identifier: MIT OR Apache-2.0
//! Whether this host cuts long UDP sends apart before its loopback device.
//!
//! With UDP_SEGMENT a system call and a walk through the sending half of the IP stack carry seven packets of
//! 9000 bytes instead of one. By default Linux hands such a send over loopback as one piece and cuts it where a
//! UDP socket receives it; a packet socket, which Aravis prefers, then sees 64 KiB datagrams that no camera
//! sends. Where the loopback device has `tx-udp-segmentation` switched off (`ethtool -K lo tx-udp-segmentation
//! off`), the kernel cuts before the device, and every receiver sees what was meant.
#![allow(unsafe_code, reason = "the ethtool ioctl has no safe wrapper in this workspace")]

use std::io;
use std::net::UdpSocket;
use std::os::fd::AsRawFd;

const SIOCETHTOOL: libc::c_ulong = 0x8946;
const GET_STRINGS: u32 = 0x1b;
const GET_SET_INFO: u32 = 0x37;
const GET_FEATURES: u32 = 0x3a;
/// The string set that names the features.
const FEATURES: u32 = 4;
/// Bytes of a name in a string set.
const NAME: usize = 32;
/// No kernel has more features; bounds what is allocated on its word.
const MOST_FEATURES: usize = 1024;

/// Can several packets be handed to the kernel as one, and all receivers on loopback see them apart?
/// False where the kernel does not tell.
pub fn loopback_cuts_before_receivers() -> bool {
    let known =
        UdpSocket::bind("127.0.0.1:0").and_then(|socket| feature(&socket, "lo", "tx-udp-segmentation"));
    matches!(known, Ok(Some(false)))
}

/// Whether a network device has a feature switched on; `None` where the kernel does not know it.
fn feature(socket: &UdpSocket, device: &str, name: &str) -> io::Result<Option<bool>> {
    // Command, reserved, mask of string sets, then a length per set.
    let mut info = [GET_SET_INFO, 0, 1 << FEATURES, 0, 0];
    ethtool(socket, device, &mut info)?;
    let count = (info[4] as usize).min(MOST_FEATURES);
    // Command, string set, length, then the names.
    let mut strings = vec![0u32; 3 + count * NAME / 4];
    strings[..3].copy_from_slice(&[GET_STRINGS, FEATURES, count as u32]);
    ethtool(socket, device, &mut strings)?;
    let names: Vec<u8> = strings[3..].iter().flat_map(|word| word.to_ne_bytes()).collect();
    let is_it = |entry: &[u8]| entry.split(|byte| *byte == 0).next() == Some(name.as_bytes());
    let Some(index) = names.chunks_exact(NAME).position(is_it) else { return Ok(None) };
    // Command, length, then (available, requested, active, never changed) for every 32 features.
    let groups = count.div_ceil(32);
    let mut features = vec![0u32; 2 + groups * 4];
    features[..2].copy_from_slice(&[GET_FEATURES, groups as u32]);
    ethtool(socket, device, &mut features)?;
    let active = features.get(2 + index / 32 * 4 + 2);
    Ok(active.map(|bits| bits >> (index % 32) & 1 == 1))
}

/// One ethtool request. `words` must have room for the answer that its own header announces.
fn ethtool(socket: &UdpSocket, device: &str, words: &mut [u32]) -> io::Result<()> {
    // SAFETY: all-zero is a valid `ifreq`.
    let mut request: libc::ifreq = unsafe { std::mem::zeroed() };
    for (to, from) in request.ifr_name.iter_mut().take(libc::IFNAMSIZ - 1).zip(device.bytes()) {
        *to = from as libc::c_char;
    }
    request.ifr_ifru.ifru_data = words.as_mut_ptr().cast();
    // SAFETY: the request points to `words`, which outlives the call; the kernel writes no more entries than the
    // count in its header, for which the callers above made room.
    let result = unsafe { libc::ioctl(socket.as_raw_fd(), SIOCETHTOOL as _, &raw mut request) };
    if result == 0 { Ok(()) } else { Err(io::Error::last_os_error()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn features_are_read_by_name() {
        let socket = UdpSocket::bind("127.0.0.1:0").expect("a socket");
        // Fixed in the kernel: loopback can never switch scatter-gather off.
        assert_eq!(feature(&socket, "lo", "tx-scatter-gather").ok().flatten(), Some(true));
        assert_eq!(feature(&socket, "lo", "no-such-feature").ok().flatten(), None);
        assert!(feature(&socket, "no-such-device", "tx-scatter-gather").is_err());
    }
}
