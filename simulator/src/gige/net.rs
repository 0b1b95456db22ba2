// SPDX-License-Identifier: MIT OR Apache-2.0
//! The few socket calls that the standard library lacks: shared binding, polling several sockets, the
//! don't-fragment option, and sending many datagrams by one system call without copying them together.
#![allow(unsafe_code, reason = "thin wrappers around libc calls; nothing else in this module tree is unsafe")]

use std::io;
use std::net::{Ipv4Addr, SocketAddrV4, UdpSocket};
use std::os::fd::{AsRawFd, FromRawFd, OwnedFd};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

/// Most datagrams handed to the kernel at once.
pub const BATCH: usize = 64;

fn set_option(
    socket: &impl AsRawFd,
    level: libc::c_int,
    name: libc::c_int,
    value: libc::c_int,
) -> io::Result<()> {
    // SAFETY: the pointer and length describe `value`, which outlives the call.
    let result = unsafe {
        libc::setsockopt(
            socket.as_raw_fd(),
            level,
            name,
            (&raw const value).cast(),
            size_of::<libc::c_int>() as libc::socklen_t,
        )
    };
    if result == 0 { Ok(()) } else { Err(io::Error::last_os_error()) }
}

/// A UDP socket on an address that other processes (and cameras) may bind as well: broadcast addresses.
///
/// # Errors
/// The system's error, for instance where a program holds the port for itself alone.
pub fn bind_shared(address: SocketAddrV4) -> io::Result<UdpSocket> {
    // SAFETY: no pointers are passed; the result is checked before use.
    let fd = unsafe { libc::socket(libc::AF_INET, libc::SOCK_DGRAM | libc::SOCK_CLOEXEC, 0) };
    if fd < 0 {
        return Err(io::Error::last_os_error());
    }
    // SAFETY: `fd` was just opened and no other owner exists.
    let socket = unsafe { OwnedFd::from_raw_fd(fd) };
    set_option(&socket, libc::SOL_SOCKET, libc::SO_REUSEADDR, 1)?;
    let name = libc::sockaddr_in {
        sin_family: libc::AF_INET as libc::sa_family_t,
        sin_port: address.port().to_be(),
        sin_addr: libc::in_addr { s_addr: address.ip().to_bits().to_be() },
        sin_zero: [0; 8],
    };
    // SAFETY: the pointer and length describe `name`, which outlives the call.
    let result = unsafe {
        libc::bind(
            socket.as_raw_fd(),
            (&raw const name).cast(),
            size_of::<libc::sockaddr_in>() as libc::socklen_t,
        )
    };
    if result == 0 { Ok(UdpSocket::from(socket)) } else { Err(io::Error::last_os_error()) }
}

/// Puts another socket into the place of one that is shared by threads.
///
/// # Errors
/// The error that the system reports.
pub fn replace(socket: &UdpSocket, other: &UdpSocket) -> io::Result<()> {
    // SAFETY: both descriptors are open and owned by sockets that outlive the call; `socket` owns the copy from now on,
    // as it owned what the system closes here.
    let result = unsafe { libc::dup3(other.as_raw_fd(), socket.as_raw_fd(), libc::O_CLOEXEC) };
    if result < 0 { Err(io::Error::last_os_error()) } else { Ok(()) }
}

/// Asks for a larger send buffer; the system may give less.
pub fn set_send_buffer(socket: &UdpSocket, bytes: i32) -> io::Result<()> {
    set_option(socket, libc::SOL_SOCKET, libc::SO_SNDBUF, bytes)
}

/// Sets or clears "don't fragment" on what the socket sends.
pub fn set_do_not_fragment(socket: &UdpSocket, set: bool) -> io::Result<()> {
    let mode = if set { libc::IP_PMTUDISC_PROBE } else { libc::IP_PMTUDISC_DONT };
    set_option(socket, libc::IPPROTO_IP, libc::IP_MTU_DISCOVER, mode)
}

/// Asks for 2 MiB pages under memory that is not touched yet: the kernel walks fewer page tables when it copies
/// pixels out of it. A wish; where the system has no such pages nothing changes.
pub fn prefer_huge_pages(memory: &mut [std::mem::MaybeUninit<u8>]) {
    const PAGE: usize = 4096;
    let range = memory.as_mut_ptr_range();
    let (start, end) = (range.start as usize, range.end as usize);
    let (first, last) = (start.next_multiple_of(PAGE), end - end % PAGE);
    if first < last {
        let at = range.start.wrapping_byte_add(first - start);
        // SAFETY: the pages lie within `memory`; the advice changes no content.
        unsafe { libc::madvise(at.cast(), last - first, libc::MADV_HUGEPAGE) };
    }
}

/// Has the kernel note when each datagram arrives, for [`receive`]. It begins soon afterwards: until then a datagram has
/// the time at which it was read.
pub fn stamp_arrivals(socket: &UdpSocket) -> io::Result<()> {
    set_option(socket, libc::SOL_SOCKET, libc::SO_TIMESTAMPNS, 1)
}

/// The next datagram: how long it is, its sender, and when it arrived, however late this thread gets to run.
pub fn receive(socket: &UdpSocket, buffer: &mut [u8]) -> io::Result<(usize, SocketAddrV4, Instant)> {
    // SAFETY: all-zero is a valid address and a valid `msghdr`: null pointers with zero lengths.
    let (mut from, mut message): (libc::sockaddr_in, libc::msghdr) = unsafe { std::mem::zeroed() };
    let mut control = [0u64; 8];
    let mut part = libc::iovec { iov_base: buffer.as_mut_ptr().cast(), iov_len: buffer.len() };
    message.msg_name = (&raw mut from).cast();
    message.msg_namelen = size_of::<libc::sockaddr_in>() as libc::socklen_t;
    (message.msg_iov, message.msg_iovlen) = (&raw mut part, 1);
    message.msg_control = control.as_mut_ptr().cast();
    message.msg_controllen = size_of_val(&control) as _;
    // SAFETY: `message` points to places that outlive the call, with their lengths.
    let length = unsafe { libc::recvmsg(socket.as_raw_fd(), &raw mut message, 0) };
    let length = usize::try_from(length).map_err(|_| io::Error::last_os_error())?;
    let now = Instant::now();
    let mut arrived = now;
    // SAFETY: the kernel has filled `control` with whole headers and said how much of it; data of a stamp is a
    // `timespec`, which is read without alignment.
    unsafe {
        let header = libc::CMSG_FIRSTHDR(&raw const message);
        if !header.is_null()
            && ((*header).cmsg_level, (*header).cmsg_type) == (libc::SOL_SOCKET, libc::SCM_TIMESTAMPNS)
        {
            let stamp = libc::CMSG_DATA(header).cast::<libc::timespec>().read_unaligned();
            let since = Duration::new(stamp.tv_sec.unsigned_abs(), u32::try_from(stamp.tv_nsec).unwrap_or(0));
            // A time of day that was set meanwhile is no measure.
            let age = SystemTime::now().duration_since(UNIX_EPOCH + since).unwrap_or_default();
            arrived = now.checked_sub(age.min(Duration::from_secs(1))).unwrap_or(now);
        }
    }
    let address = Ipv4Addr::from_bits(u32::from_be(from.sin_addr.s_addr));
    Ok((length, SocketAddrV4::new(address, u16::from_be(from.sin_port)), arrived))
}

/// Waits until a socket has something to read, at most for this time. Appends the indices of those that have.
pub fn poll_readable(sockets: &[&UdpSocket], timeout: Duration, ready: &mut Vec<usize>) -> io::Result<()> {
    let mut entries: Vec<libc::pollfd> = sockets
        .iter()
        .map(|s| libc::pollfd { fd: s.as_raw_fd(), events: libc::POLLIN, revents: 0 })
        .collect();
    let milliseconds = i32::try_from(timeout.as_millis()).unwrap_or(i32::MAX);
    // SAFETY: pointer and count describe `entries`, which outlives the call.
    let result = unsafe { libc::poll(entries.as_mut_ptr(), entries.len() as libc::nfds_t, milliseconds) };
    if result < 0 {
        let error = io::Error::last_os_error();
        return if error.kind() == io::ErrorKind::Interrupted { Ok(()) } else { Err(error) };
    }
    ready.extend(entries.iter().enumerate().filter(|(_, e)| e.revents != 0).map(|(i, _)| i));
    Ok(())
}

/// CPU time this process has used so far, user and system.
pub fn process_cpu_time() -> Duration {
    let mut time = libc::timespec { tv_sec: 0, tv_nsec: 0 };
    // SAFETY: the pointer is to a local `timespec`.
    let result = unsafe { libc::clock_gettime(libc::CLOCK_PROCESS_CPUTIME_ID, &raw mut time) };
    if result != 0 {
        return Duration::ZERO;
    }
    Duration::new(time.tv_sec.unsigned_abs(), u32::try_from(time.tv_nsec).unwrap_or(0))
}

/// Datagrams of two parts each (header, pixels) on their way out through a connected socket.
#[derive(Debug)]
pub struct Batch<'a> {
    parts: [(&'a [u8], &'a [u8]); BATCH],
    length: usize,
    segmented: bool,
}

impl Default for Batch<'_> {
    fn default() -> Self {
        Self { parts: [(&[], &[]); BATCH], length: 0, segmented: false }
    }
}

impl<'a> Batch<'a> {
    /// An empty batch. Where `segmented`, runs of datagrams of one length go through the kernel as one, which
    /// cuts them apart again (UDP_SEGMENT): see [`super::segmentation`] for when every receiver sees them cut.
    pub fn new(segmented: bool) -> Self {
        Self { segmented, ..Self::default() }
    }

    /// Adds a datagram. The batch must not be full.
    pub fn push(&mut self, header: &'a [u8], body: &'a [u8]) {
        if let Some(place) = self.parts.get_mut(self.length) {
            *place = (header, body);
            self.length += 1;
        }
    }

    /// Must it be sent before another datagram is added?
    pub fn is_full(&self) -> bool {
        self.length == BATCH
    }

    /// Sends everything and empties the batch; returns how many datagrams went out.
    ///
    /// # Errors
    /// The system's error for the first datagram that did not go out. A refusal by the receiver's host
    /// (no program listens yet) is reported on the packet after, which is tried again once.
    pub fn send(&mut self, socket: &UdpSocket) -> io::Result<usize> {
        let (mut sent, mut refused) = (0, false);
        while sent < self.length {
            match send_many(socket, &self.parts[sent..self.length], self.segmented) {
                Ok(count) => sent += count,
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) if error.kind() == io::ErrorKind::ConnectionRefused && !refused => refused = true,
                Err(error) => {
                    self.length = 0;
                    return Err(error);
                }
            }
        }
        self.length = 0;
        Ok(sent)
    }
}

/// Most bytes of datagrams that one IP packet can carry through the kernel together.
const MOST_TOGETHER: usize = 65_507;

/// How many of the first datagrams can go as one: all as long as the first, but the last, which may be shorter.
fn run_length(parts: &[(&[u8], &[u8])]) -> usize {
    let length = |(header, body): &(&[u8], &[u8])| header.len() + body.len();
    let Some(first) = parts.first().map(length).filter(|first| *first > 0) else { return parts.len().min(1) };
    let most = (MOST_TOGETHER / first).max(1);
    let same = parts.iter().take(most).take_while(|part| length(part) == first).count();
    let shorter = parts.get(same).is_some_and(|part| same < most && (1..first).contains(&length(part)));
    same + usize::from(shorter)
}

/// Room for the one control message that has the length of each datagram of a run. Aligned as `cmsghdr` wants.
type Control = [u64; 3];

/// Makes `message` a run of datagrams of `length` bytes each (the last one may be shorter).
fn ask_to_cut(message: &mut libc::msghdr, control: &mut Control, length: u16) {
    // SAFETY: computes sizes only.
    let (space, used) = unsafe { (libc::CMSG_SPACE(2), libc::CMSG_LEN(2)) };
    debug_assert!(space as usize <= size_of::<Control>(), "the control message fits");
    message.msg_control = control.as_mut_ptr().cast();
    message.msg_controllen = space as _;
    // SAFETY: `control` is aligned, zeroed, and as long as `msg_controllen` states: there is a first header in it,
    // with room for two bytes of data.
    unsafe {
        let header = libc::CMSG_FIRSTHDR(message);
        (*header).cmsg_level = libc::SOL_UDP;
        (*header).cmsg_type = libc::UDP_SEGMENT;
        (*header).cmsg_len = used as _;
        libc::CMSG_DATA(header).cast::<u16>().write_unaligned(length);
    }
}

fn send_many(socket: &UdpSocket, parts: &[(&[u8], &[u8])], segmented: bool) -> io::Result<usize> {
    let empty = libc::iovec { iov_base: std::ptr::null_mut(), iov_len: 0 };
    let mut vectors = [[empty; 2]; BATCH];
    let mut controls: [Control; BATCH] = [[0; 3]; BATCH];
    let mut runs = [0; BATCH];
    // SAFETY: all-zero is a valid `mmsghdr`: null pointers with zero lengths.
    let mut messages: [libc::mmsghdr; BATCH] = unsafe { std::mem::zeroed() };
    for (pair, (header, body)) in vectors.iter_mut().zip(parts) {
        *pair = [header, body]
            .map(|part| libc::iovec { iov_base: part.as_ptr().cast_mut().cast(), iov_len: part.len() });
    }
    let (mut count, mut left, mut vectors) = (0, &parts[..parts.len().min(BATCH)], &mut vectors[..]);
    for ((message, control), run) in messages.iter_mut().zip(&mut controls).zip(&mut runs) {
        *run = if segmented { run_length(left) } else { left.len().min(1) };
        let Some((header, body)) = left.first() else { break };
        let (own, others) = std::mem::take(&mut vectors).split_at_mut(*run);
        message.msg_hdr.msg_iov = own.as_mut_ptr().cast();
        message.msg_hdr.msg_iovlen = 2 * *run;
        if let (2.., Ok(length)) = (*run, u16::try_from(header.len() + body.len())) {
            ask_to_cut(&mut message.msg_hdr, control, length);
        }
        (count, left, vectors) = (count + 1, &left[*run..], others);
    }
    // SAFETY: the first `count` messages point to vectors that point to slices borrowed for this call, and to
    // control messages; the kernel only reads through them (and writes the message lengths).
    let sent = unsafe { libc::sendmmsg(socket.as_raw_fd(), messages.as_mut_ptr(), count, 0) };
    let sent = usize::try_from(sent).map_err(|_| io::Error::last_os_error())?;
    Ok(runs.iter().take(sent).sum())
}

/// Addresses on which broadcast discoveries arrive on loopback.
pub const BROADCASTS: [Ipv4Addr; 2] = [Ipv4Addr::BROADCAST, Ipv4Addr::new(127, 255, 255, 255)];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_batch_arrives_in_order_and_whole() {
        let receiver = UdpSocket::bind("127.0.0.1:0").expect("a socket");
        receiver.set_read_timeout(Some(Duration::from_secs(5))).expect("a timeout");
        let sender = UdpSocket::bind("127.0.0.1:0").expect("a socket");
        sender.connect(receiver.local_addr().expect("an address")).expect("a route");
        let headers: Vec<[u8; 2]> = (0..BATCH as u8).map(|i| [i, 0xff]).collect();
        let body = [7; 100];
        // Equal lengths, rising and falling ones, nothing but headers.
        let lengths: [fn(usize) -> usize; 4] = [|i| i, |_| 100, |i| 99 - i, |i| [100, 100, 100, 0, 3][i % 5]];
        for (segmented, length_of) in [false, true].into_iter().flat_map(|s| lengths.map(|l| (s, l))) {
            let mut batch = Batch::new(segmented);
            for (i, header) in headers.iter().enumerate() {
                batch.push(header, &body[..length_of(i)]);
            }
            assert!(batch.is_full());
            assert_eq!(batch.send(&sender).expect("sent"), BATCH);
            let mut buffer = [0; 200];
            for (i, header) in headers.iter().enumerate() {
                let length = receiver.recv(&mut buffer).expect("a datagram");
                assert_eq!(buffer[..length], [&header[..], &body[..length_of(i)]].concat());
            }
        }
    }

    #[test]
    fn a_datagram_tells_when_it_arrived_and_not_when_it_was_read() {
        let receiver = UdpSocket::bind("127.0.0.1:0").expect("a socket");
        stamp_arrivals(&receiver).expect("stamps");
        let sender = UdpSocket::bind("127.0.0.1:0").expect("a socket");
        let has_arrival = |_| {
            let before = Instant::now();
            sender.send_to(&[1, 2, 3], receiver.local_addr().expect("an address")).expect("sent");
            let sent = Instant::now();
            std::thread::sleep(Duration::from_millis(20));
            let mut buffer = [0; 8];
            let (length, from, arrived) = receive(&receiver, &mut buffer).expect("a datagram");
            assert_eq!(&buffer[..length], [1, 2, 3]);
            assert_eq!(Some(from.port()), sender.local_addr().ok().map(|address| address.port()));
            // Two clocks are read one after the other.
            let slack = Duration::from_millis(5);
            arrived + slack >= before && arrived <= sent + slack
        };
        // The first one may come before the kernel's queue of work has turned stamps on.
        assert!((0..100).any(has_arrival), "a hundred datagrams have the time at which they were read");
    }

    #[test]
    fn a_run_ends_where_the_kernel_would_cut_wrongly() {
        let bytes = [0; 9000];
        let run = |lengths: &[usize]| {
            let parts: Vec<(&[u8], &[u8])> = lengths.iter().map(|l| (&bytes[..8], &bytes[8..*l])).collect();
            run_length(&parts)
        };
        assert_eq!(run(&[]), 0);
        assert_eq!(run(&[44, 8972, 8972]), 1, "a longer one cannot follow");
        assert_eq!(run(&[8972, 8972, 500, 8972]), 3, "nothing after a shorter one");
        assert_eq!(run(&[8972; 20]), 7, "an IP packet has 65535 bytes");
        assert_eq!(run(&[8972, 8972, 8972, 8972, 8972, 8972, 8972, 500]), 7);
    }

    #[test]
    fn a_closed_receiver_is_an_error_and_not_a_hang() {
        let closed = UdpSocket::bind("127.0.0.1:0").expect("a socket").local_addr().expect("an address");
        let sender = UdpSocket::bind("127.0.0.1:0").expect("a socket");
        sender.connect(closed).expect("a route");
        for _ in 0..4 {
            let mut batch = Batch::default();
            batch.push(&[1], &[2]);
            batch.push(&[1], &[2]);
            let _ = batch.send(&sender);
        }
    }
}
