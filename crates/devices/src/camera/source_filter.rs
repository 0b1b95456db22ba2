// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the kernel hands to a stream: datagrams of its camera, and nobody else's.
//!
//! Aravis 0.8.26 sets no filter on its UDP socket, and one on its packet socket that lets every source port of the
//! camera's address pass. So whoever can send to the stream's port could replace pixels. The sockets are found from
//! outside, by the stream's port, and get a filter of ours. It knows the camera's address, and the port it sends from
//! where the camera tells it.

use std::io;
use std::mem::{size_of, size_of_val};
use std::net::Ipv4Addr;
use std::os::fd::RawFd;
use std::time::{Duration, Instant};

/// Where a stream's datagrams come from, and where they go.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Route {
    /// The camera.
    pub camera: Ipv4Addr,
    /// The port that it sends from; `None` where it does not tell.
    pub source_port: Option<u16>,
    /// The stream's port on this host.
    pub stream_port: u16,
}

/// Aravis' thread has opened its packet socket by then, or will not.
const PATIENCE: Duration = Duration::from_millis(200);
const LOOK: Duration = Duration::from_millis(2);
/// A packet that passes, passes whole.
const WHOLE: u32 = 0x4_0000;
/// Where the IP header is, whatever the socket (linux/filter.h, `SKF_NET_OFF`).
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

/// A step of a filter: load something, and what it must be.
enum Step {
    Equal(u16, u32, u32),
    NotSet(u16, u32, u32),
    Load(u16, u32),
}

/// Sets the filter on the sockets of a stream.
///
/// # Errors
/// The stream has no socket that can be found, or the system refuses the filter.
pub fn restrict(route: Route, packet_socket: bool) -> io::Result<()> {
    let udp = sockets()?.into_iter().find(|fd| is_udp_of(*fd, route.stream_port));
    let udp = udp.ok_or_else(|| io::Error::new(io::ErrorKind::NotFound, "its socket is not there"))?;
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
        // Without one Aravis reads from the UDP socket, which has its filter.
        if Instant::now() >= deadline {
            return Ok(());
        }
        std::thread::sleep(LOOK);
    }
}

fn program(steps: Vec<Step>) -> Vec<libc::sock_filter> {
    let instruction = |code, jt, jf, k| libc::sock_filter { code, jt, jf, k };
    let mut program = Vec::new();
    for step in steps {
        // Where a jump leads is filled in below.
        match step {
            Step::Equal(load, at, value) => {
                program.extend([instruction(load, 0, 0, at), instruction(JUMP_EQUAL, 0, 1, value)]);
            }
            Step::NotSet(load, at, bits) => {
                program.extend([instruction(load, 0, 0, at), instruction(JUMP_SET, 1, 0, bits)]);
            }
            Step::Load(load, at) => program.push(instruction(load, 0, 0, at)),
        }
    }
    let drop = program.len() + 1;
    for (at, instruction) in program.iter_mut().enumerate() {
        // Distances are counted from the next instruction; a filter has a few dozen at most.
        let far = u8::try_from(drop - at - 1).unwrap_or(u8::MAX);
        match instruction.code {
            JUMP_EQUAL => instruction.jf = far,
            JUMP_SET => instruction.jt = far,
            _ => {}
        }
    }
    program.extend([instruction(RETURN, 0, 0, WHOLE), instruction(RETURN, 0, 0, 0)]);
    program
}

/// A UDP socket's filter sees the UDP header first.
fn udp_filter(route: Route) -> Vec<libc::sock_filter> {
    let mut steps = vec![Step::Equal(LOAD_WORD, IP_HEADER + 12, route.camera.to_bits())];
    steps.extend(route.source_port.map(|port| Step::Equal(LOAD_HALF, 0, u32::from(port))));
    program(steps)
}

/// A packet socket's filter sees an Ethernet header first.
fn packet_filter(route: Route, own: Ipv4Addr) -> Vec<libc::sock_filter> {
    const IPV4: u32 = 0x0800;
    const UDP: u32 = 17;
    const FRAGMENT_OFFSET: u32 = 0x1fff;
    let mut steps = vec![
        Step::Equal(LOAD_HALF, 12, IPV4),
        Step::Equal(LOAD_BYTE, 14 + 9, UDP),
        Step::Equal(LOAD_WORD, 14 + 12, route.camera.to_bits()),
        Step::Equal(LOAD_WORD, 14 + 16, own.to_bits()),
        Step::NotSet(LOAD_HALF, 14 + 6, FRAGMENT_OFFSET),
        Step::Load(LOAD_IP_LENGTH, 14),
    ];
    steps.extend(route.source_port.map(|port| Step::Equal(LOAD_HALF_INDEXED, 14, u32::from(port))));
    steps.push(Step::Equal(LOAD_HALF_INDEXED, 14 + 2, u32::from(route.stream_port)));
    program(steps)
}

/// The open files of this process that are sockets of any kind, and others.
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
    // SAFETY: all zero is a valid `sockaddr_in`: numbers alone.
    let mut address: libc::sockaddr_in = unsafe { std::mem::zeroed() };
    let mut length = size_of::<libc::sockaddr_in>() as libc::socklen_t;
    // SAFETY: address and length are valid during the call, and the length is the address'.
    let failed = unsafe { libc::getsockname(fd, (&raw mut address).cast(), &raw mut length) };
    let is_ip = failed == 0 && libc::c_int::from(address.sin_family) == libc::AF_INET;
    is_ip.then(|| (Ipv4Addr::from(u32::from_be(address.sin_addr.s_addr)), u16::from_be(address.sin_port)))
}

/// The stream lives, so its port is nobody else's, and neither is this file number.
fn is_udp_of(fd: RawFd, port: u16) -> bool {
    option(fd, libc::SO_DOMAIN) == Some(libc::AF_INET)
        && option(fd, libc::SO_TYPE) == Some(libc::SOCK_DGRAM)
        && local_address(fd).is_some_and(|(_, found)| found == port)
}

/// A packet socket is bound to an interface; Aravis' filter names the stream's port.
fn is_packet_socket_of(fd: RawFd, port: u16) -> bool {
    if option(fd, libc::SO_DOMAIN) != Some(libc::AF_PACKET) {
        return false;
    }
    const INSTRUCTIONS_MAX: usize = 64;
    let mut filter = [libc::sock_filter { code: 0, jt: 0, jf: 0, k: 0 }; INSTRUCTIONS_MAX];
    // Counted in instructions here, and not in bytes.
    let mut count = INSTRUCTIONS_MAX as libc::socklen_t;
    // SAFETY: the array has room for as many instructions as the count says; both are valid during the call.
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

    fn heard(receiver: &UdpSocket) -> Vec<u8> {
        let mut bytes = [0; 16];
        std::iter::from_fn(|| receiver.recv(&mut bytes).ok().map(|length| bytes[..length][0])).collect()
    }

    #[test]
    fn only_the_cameras_port_is_heard() {
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
        assert_eq!(heard(&receiver), [1, 2, 3], "without a filter everybody is heard");
        let camera_address = Ipv4Addr::new(127, 21, 90, 2);
        let mut route =
            Route { camera: camera_address, source_port: Some(port(&camera)), stream_port: to.port() };
        restrict(route, false).expect("restricted");
        send();
        assert_eq!(heard(&receiver), [2]);
        route.source_port = None;
        restrict(route, false).expect("restricted");
        send();
        assert_eq!(heard(&receiver), [1, 2], "a camera that does not tell its port is known by its address");
    }
}
