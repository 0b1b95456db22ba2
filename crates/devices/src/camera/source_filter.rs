// SPDX-License-Identifier: MIT OR Apache-2.0
//! A filter in the kernel, so that a stream receives datagrams of its camera only.
//!
//! Aravis 0.8.26 sets no filter on its UDP socket, and one on its packet socket that lets every source port of the
//! camera's address pass. So any host that can send to the stream's port could replace pixels. The sockets are found
//! from outside, by the stream's port, and get a filter here. It checks the camera's address, and its source port
//! where the camera reports it.

use std::io;
use std::mem::{size_of, size_of_val};
use std::net::Ipv4Addr;
use std::os::fd::RawFd;
use std::time::{Duration, Instant};

/// Source and destination of a stream's datagrams.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Route {
    /// IPv4 address of the camera.
    pub camera: Ipv4Addr,
    /// UDP port that the camera sends from; `None` where the camera does not report it.
    pub source_port: Option<u16>,
    /// UDP port of the stream on this host.
    pub stream_port: u16,
}

/// Longest wait for Aravis' thread to open its packet socket.
const PATIENCE: Duration = Duration::from_millis(200);
/// Time between two searches for the packet socket.
const LOOK: Duration = Duration::from_millis(2);
/// Bytes of a passing packet that are handed over: all of it.
const WHOLE: u32 = 0x4_0000;
/// Offset of the IP header for any kind of socket (linux/filter.h, `SKF_NET_OFF`).
const IP_HEADER: u32 = 0u32.wrapping_sub(0x10_0000);

// Instructions of classic BPF.
const LOAD_WORD: u16 = 0x20;
const LOAD_HALF: u16 = 0x28;
const LOAD_BYTE: u16 = 0x30;
const LOAD_HALF_INDEXED: u16 = 0x48;
const LOAD_IP_LENGTH: u16 = 0xb1;
const JUMP_EQUAL: u16 = 0x15;
const JUMP_SET: u16 = 0x45;
const RETURN: u16 = 0x06;

/// A step of a filter: what to load from where, and the jump and value that decide whether the packet passes.
type Step = (u16, u32, Option<(u16, u32)>);

/// Sets the filter on the sockets of a stream.
///
/// # Errors
/// No socket of the stream is found, or the system refuses the filter.
pub fn restrict(route: Route, packet_socket: bool) -> io::Result<()> {
    let udp = sockets()?.into_iter().find(|fd| is_udp_of(*fd, route.stream_port));
    let udp = udp.ok_or_else(|| io::Error::other("the socket of its stream was not found"))?;
    attach(udp, &udp_filter(route))?;
    if !packet_socket || !may_open_packet_sockets() {
        return Ok(());
    }
    let own = local_address(udp).ok_or_else(|| io::Error::other("its socket has no address"))?.0;
    let deadline = Instant::now() + PATIENCE;
    loop {
        if let Some(packet) = sockets()?.into_iter().find(|fd| is_packet_socket_of(*fd, route.stream_port)) {
            return attach(packet, &packet_filter(route, own));
        }
        // Without a packet socket Aravis reads from the UDP socket, which has its filter.
        if Instant::now() >= deadline {
            return Ok(());
        }
        std::thread::sleep(LOOK);
    }
}

fn program(steps: &[Step]) -> Vec<libc::sock_filter> {
    let instruction = |code, jt, jf, k| libc::sock_filter { code, jt, jf, k };
    let checks: usize = steps.iter().map(|(.., test)| 1 + usize::from(test.is_some())).sum();
    let mut program = Vec::new();
    for (load, at, test) in steps {
        program.push(instruction(*load, 0, 0, *at));
        if let Some((jump, value)) = test {
            // Distance from the next instruction to the one that drops the packet; a filter has a few dozen at most.
            let far = u8::try_from(checks - program.len()).unwrap_or(u8::MAX);
            let (jt, jf) = if *jump == JUMP_SET { (far, 0) } else { (0, far) };
            program.push(instruction(*jump, jt, jf, *value));
        }
    }
    program.extend([instruction(RETURN, 0, 0, WHOLE), instruction(RETURN, 0, 0, 0)]);
    program
}

fn equal(load: u16, at: u32, value: u32) -> Step {
    (load, at, Some((JUMP_EQUAL, value)))
}

/// The filter of a UDP socket, which sees the UDP header first.
fn udp_filter(route: Route) -> Vec<libc::sock_filter> {
    let mut steps = vec![equal(LOAD_WORD, IP_HEADER + 12, route.camera.to_bits())];
    steps.extend(route.source_port.map(|port| equal(LOAD_HALF, 0, u32::from(port))));
    program(&steps)
}

/// The filter of a packet socket, which sees an Ethernet header first.
fn packet_filter(route: Route, own: Ipv4Addr) -> Vec<libc::sock_filter> {
    const IPV4: u32 = 0x0800;
    const UDP: u32 = 17;
    const FRAGMENT_OFFSET: u32 = 0x1fff;
    let mut steps = vec![
        equal(LOAD_HALF, 12, IPV4),
        equal(LOAD_BYTE, 14 + 9, UDP),
        equal(LOAD_WORD, 14 + 12, route.camera.to_bits()),
        equal(LOAD_WORD, 14 + 16, own.to_bits()),
        (LOAD_HALF, 14 + 6, Some((JUMP_SET, FRAGMENT_OFFSET))),
        (LOAD_IP_LENGTH, 14, None),
    ];
    steps.extend(route.source_port.map(|port| equal(LOAD_HALF_INDEXED, 14, u32::from(port))));
    steps.push(equal(LOAD_HALF_INDEXED, 14 + 2, u32::from(route.stream_port)));
    program(&steps)
}

/// All open files of this process: sockets and others.
fn sockets() -> io::Result<Vec<RawFd>> {
    let names = std::fs::read_dir("/proc/self/fd")?;
    Ok(names.filter_map(|entry| entry.ok()?.file_name().to_str()?.parse().ok()).collect())
}

fn option(fd: RawFd, name: libc::c_int) -> Option<libc::c_int> {
    let mut value: libc::c_int = 0;
    let mut length = size_of_val(&value) as libc::socklen_t;
    // SAFETY: value and length are valid during the call, and the length is the value's. What is no socket is refused.
    let failed =
        unsafe { libc::getsockopt(fd, libc::SOL_SOCKET, name, (&raw mut value).cast(), &raw mut length) };
    (failed == 0).then_some(value)
}

fn local_address(fd: RawFd) -> Option<(Ipv4Addr, u16)> {
    // SAFETY: all zero is a valid `sockaddr_in`, which has numbers only.
    let mut address: libc::sockaddr_in = unsafe { std::mem::zeroed() };
    let mut length = size_of::<libc::sockaddr_in>() as libc::socklen_t;
    // SAFETY: address and length are valid during the call, and the length is the address'.
    let failed = unsafe { libc::getsockname(fd, (&raw mut address).cast(), &raw mut length) };
    let is_ip = failed == 0 && libc::c_int::from(address.sin_family) == libc::AF_INET;
    is_ip.then(|| (Ipv4Addr::from(u32::from_be(address.sin_addr.s_addr)), u16::from_be(address.sin_port)))
}

/// Whether a file is the UDP socket of this port. The stream lives, so port and file number belong to it.
fn is_udp_of(fd: RawFd, port: u16) -> bool {
    option(fd, libc::SO_DOMAIN) == Some(libc::AF_INET)
        && option(fd, libc::SO_TYPE) == Some(libc::SOCK_DGRAM)
        && local_address(fd).is_some_and(|(_, found)| found == port)
}

/// Whether a file is the packet socket of this stream: Aravis' own filter on it names the stream's port.
fn is_packet_socket_of(fd: RawFd, port: u16) -> bool {
    if option(fd, libc::SO_DOMAIN) != Some(libc::AF_PACKET) {
        return false;
    }
    const INSTRUCTIONS_MAX: usize = 64;
    let mut filter = [libc::sock_filter { code: 0, jt: 0, jf: 0, k: 0 }; INSTRUCTIONS_MAX];
    // Counted in instructions here, and not in bytes.
    let mut count = INSTRUCTIONS_MAX as libc::socklen_t;
    // SAFETY: the array has room for as many instructions as the count; both are valid during the call.
    let failed = unsafe {
        let into = filter.as_mut_ptr().cast();
        libc::getsockopt(fd, libc::SOL_SOCKET, libc::SO_GET_FILTER, into, &raw mut count)
    };
    let found = filter.get(..count as usize).filter(|_| failed == 0).unwrap_or(&[]);
    found.windows(2).any(|pair| {
        let loads_destination = pair[0].code == LOAD_HALF_INDEXED && pair[0].k == 14 + 2;
        loads_destination && pair[1].code == JUMP_EQUAL && pair[1].k == u32::from(port)
    })
}

fn may_open_packet_sockets() -> bool {
    // SAFETY: a plain call; the descriptor is closed below.
    let fd = unsafe { libc::socket(libc::AF_PACKET, libc::SOCK_RAW | libc::SOCK_CLOEXEC, 0) };
    // SAFETY: a descriptor that was just opened here, if any.
    fd >= 0 && unsafe { libc::close(fd) } == 0
}

fn attach(fd: RawFd, program: &[libc::sock_filter]) -> io::Result<()> {
    let length = u16::try_from(program.len()).map_err(io::Error::other)?;
    let filter = libc::sock_fprog { len: length, filter: program.as_ptr().cast_mut() };
    let size = size_of_val(&filter) as libc::socklen_t;
    // SAFETY: the kernel copies the program, which it does not change; all of it is valid during the call.
    let failed = unsafe {
        libc::setsockopt(fd, libc::SOL_SOCKET, libc::SO_ATTACH_FILTER, (&raw const filter).cast(), size)
    };
    if failed == 0 { Ok(()) } else { Err(io::Error::last_os_error()) }
}

#[cfg(test)]
mod tests {
    use super::{Route, restrict};
    use std::net::{Ipv4Addr, UdpSocket};
    use std::time::Duration;

    fn received(receiver: &UdpSocket) -> Vec<u8> {
        let mut bytes = [0; 16];
        std::iter::from_fn(|| receiver.recv(&mut bytes).ok().map(|length| bytes[..length][0])).collect()
    }

    #[test]
    fn only_the_cameras_port_passes() {
        let bind = |address| UdpSocket::bind((Ipv4Addr::from(address), 0)).expect("an address of this host");
        let (receiver, camera) = (bind([127, 21, 90, 1]), bind([127, 21, 90, 2]));
        receiver.set_read_timeout(Some(Duration::from_millis(100))).expect("a time-out");
        let port = |socket: &UdpSocket| socket.local_addr().expect("bound").port();
        let to = receiver.local_addr().expect("bound");
        let other_port = bind([127, 21, 90, 2]);
        let other_address =
            UdpSocket::bind((Ipv4Addr::new(127, 21, 90, 3), port(&camera))).expect("free there");
        let send = || {
            for (socket, mark) in [(&other_port, 1u8), (&camera, 2), (&other_address, 3)] {
                socket.send_to(&[mark; 16], to).expect("sent");
            }
        };
        send();
        assert_eq!(received(&receiver), [1, 2, 3], "without a filter all senders pass");
        let camera_address = Ipv4Addr::new(127, 21, 90, 2);
        let mut route =
            Route { camera: camera_address, source_port: Some(port(&camera)), stream_port: to.port() };
        restrict(route, false).expect("restricted");
        send();
        assert_eq!(received(&receiver), [2]);
        route.source_port = None;
        restrict(route, false).expect("restricted");
        send();
        assert_eq!(
            received(&receiver),
            [1, 2],
            "a camera that does not report its port is known by its address"
        );
    }
}
