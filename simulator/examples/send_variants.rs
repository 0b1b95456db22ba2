// SPDX-License-Identifier: MIT OR Apache-2.0
//! What it costs to send four cameras' packets over loopback, by the way of handing them to the kernel.
//!
//! `cargo run --release -p fourdbody-simulator --example send_variants -- [SECONDS [RATE_HZ]]` as root (packet
//! sockets). Run it once with `ethtool -K lo tx-udp-segmentation off` and once with `on`.
//!
//! Four sending threads, 1920 x 1200 pixels a frame, packets of 9000 bytes, to four packet sockets with rings as
//! Aravis has them. The receivers only count: a packet longer than a camera's is a run that nobody has cut. Time is
//! that of the sending threads, in which the kernel's receiving half of loopback runs, too.

use std::error::Error;
use std::io;
use std::net::{Ipv4Addr, SocketAddr, UdpSocket};
use std::os::fd::{AsRawFd, FromRawFd, OwnedFd};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

const CAMERAS: u16 = 4;
/// Pixels of a frame, and of a packet with its 8-byte header.
const FRAME: usize = 1920 * 1200;
const HEADER: usize = 8;
const PACKET: usize = 9000 - 28;
const PACKETS: usize = FRAME.div_ceil(PACKET - HEADER);
/// Packets in one segmented send: an IP packet has 65535 bytes.
const RUN: usize = 7;
/// Distinct frames of each camera: together more than the last cache holds.
const DISTINCT: usize = 8;
/// Aravis' ring: 16 blocks of 2 MiB.
const RING_BLOCK: usize = 2 << 20;
const RING_BLOCKS: usize = 16;

#[derive(Debug, Clone, Copy, PartialEq)]
enum Way {
    /// A system call for 64 packets.
    Sendmmsg,
    /// UDP_SEGMENT: runs of seven packets, copied by the kernel once.
    Segmented,
    /// Segmented, with MSG_ZEROCOPY: the kernel sends from our memory.
    ZeroCopy,
    /// The same from a file in memory by `sendfile`, which hands pages over.
    Sendfile,
}

fn check(result: impl TryInto<usize>) -> io::Result<usize> {
    result.try_into().map_err(|_| io::Error::last_os_error())
}

fn set<T>(socket: &impl AsRawFd, level: i32, name: i32, value: &T) -> io::Result<()> {
    let length = size_of::<T>() as libc::socklen_t;
    // SAFETY: pointer and length describe `value`, which outlives the call.
    check(unsafe {
        libc::setsockopt(socket.as_raw_fd(), level, name, std::ptr::from_ref(value).cast(), length)
    })
    .map(drop)
}

/// Memory of a file descriptor, or of nobody (-1).
struct Mapping {
    start: *mut u8,
    length: usize,
}

// SAFETY: the mapping is owned; whoever shares it reads and writes through raw pointers under its own rules.
unsafe impl Send for Mapping {}
// SAFETY: as above.
unsafe impl Sync for Mapping {}

impl Mapping {
    fn new(length: usize, file: Option<&OwnedFd>, huge: bool) -> io::Result<Self> {
        let (flags, fd) = match file {
            Some(file) => (libc::MAP_SHARED, file.as_raw_fd()),
            None => (libc::MAP_PRIVATE | libc::MAP_ANONYMOUS, -1),
        };
        let protection = libc::PROT_READ | libc::PROT_WRITE;
        // SAFETY: a new mapping at an address of the kernel's choice.
        let start = unsafe { libc::mmap(std::ptr::null_mut(), length, protection, flags, fd, 0) };
        if start == libc::MAP_FAILED {
            return Err(io::Error::last_os_error());
        }
        if huge {
            // SAFETY: advice on memory that was just mapped.
            check(unsafe { libc::madvise(start, length, libc::MADV_HUGEPAGE) })?;
        }
        Ok(Self { start: start.cast(), length })
    }
}

impl Drop for Mapping {
    fn drop(&mut self) {
        // SAFETY: mapped in `new`, and nobody borrows from it any more.
        unsafe { libc::munmap(self.start.cast(), self.length) };
    }
}

/// A packet socket with Aravis' ring on the loopback device, for one UDP port.
struct Receiver {
    socket: OwnedFd,
    ring: Mapping,
    udp: UdpSocket,
}

impl Receiver {
    fn new() -> io::Result<Self> {
        // Aravis keeps an ordinary socket on the port as well, which it does not read.
        let udp = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0))?;
        // SAFETY: the result is checked before it is owned.
        let socket = unsafe {
            let fd = check(libc::socket(libc::AF_PACKET, libc::SOCK_RAW | libc::SOCK_CLOEXEC, 0))?;
            OwnedFd::from_raw_fd(fd as i32)
        };
        let step = |code: u32, jt: u8, jf: u8, k: u32| libc::sock_filter { code: code as u16, jt, jf, k };
        use libc::{BPF_ABS, BPF_B, BPF_H, BPF_JEQ, BPF_JMP, BPF_K, BPF_LD, BPF_RET};
        let mut filter = [
            step(BPF_LD | BPF_B | BPF_ABS, 0, 0, 23), // protocol: UDP
            step(BPF_JMP | BPF_JEQ | BPF_K, 0, 3, 17),
            step(BPF_LD | BPF_H | BPF_ABS, 0, 0, 36), // destination port
            step(BPF_JMP | BPF_JEQ | BPF_K, 0, 1, udp.local_addr()?.port().into()),
            step(BPF_RET | BPF_K, 0, 0, u32::MAX),
            step(BPF_RET | BPF_K, 0, 0, 0),
        ];
        let program = libc::sock_fprog { len: filter.len() as u16, filter: filter.as_mut_ptr() };
        set(&socket, libc::SOL_SOCKET, libc::SO_ATTACH_FILTER, &program)?;
        set(&socket, libc::SOL_PACKET, libc::PACKET_VERSION, &2i32)?; // TPACKET_V3
        let request = libc::tpacket_req3 {
            tp_block_size: RING_BLOCK as u32,
            tp_block_nr: RING_BLOCKS as u32,
            tp_frame_size: 1024,
            tp_frame_nr: (RING_BLOCK / 1024 * RING_BLOCKS) as u32,
            tp_retire_blk_tov: 5,
            tp_sizeof_priv: 0,
            tp_feature_req_word: 0,
        };
        set(&socket, libc::SOL_PACKET, libc::PACKET_RX_RING, &request)?;
        let ring = Mapping::new(RING_BLOCK * RING_BLOCKS, Some(&socket), false)?;
        // SAFETY: the name is a C string, and all-zero is a valid address.
        let (device, mut address) =
            unsafe { (libc::if_nametoindex(c"lo".as_ptr()), std::mem::zeroed::<libc::sockaddr_ll>()) };
        address.sll_family = libc::AF_PACKET as u16;
        address.sll_protocol = (libc::ETH_P_IP as u16).to_be();
        address.sll_ifindex = device as i32;
        let length = size_of_val(&address) as libc::socklen_t;
        // SAFETY: pointer and length describe `address`.
        check(unsafe { libc::bind(socket.as_raw_fd(), (&raw const address).cast(), length) })?;
        Ok(Self { socket, ring, udp })
    }

    /// Counts (packets of a camera's length, longer ones) until told to stop.
    fn run(&self, stop: &AtomicBool) -> (u64, u64) {
        let (mut whole, mut uncut, mut block) = (0, 0, 0);
        while !stop.load(Ordering::Acquire) {
            // SAFETY: the block lies in the ring. Its status says who owns it; while it is ours, headers and packets
            // in it do not change, and each header says where the next one is.
            unsafe {
                let start = self.ring.start.add(block * RING_BLOCK);
                let header = start.cast::<libc::tpacket_block_desc>();
                let status = &raw mut (*header).hdr.bh1.block_status;
                if status.read_volatile() & libc::TP_STATUS_USER == 0 {
                    let mut entry =
                        libc::pollfd { fd: self.socket.as_raw_fd(), events: libc::POLLIN, revents: 0 };
                    libc::poll(&raw mut entry, 1, 100);
                    continue;
                }
                std::sync::atomic::fence(Ordering::Acquire);
                let mut packet = start.add((*header).hdr.bh1.offset_to_first_pkt as usize);
                for _ in 0..(*header).hdr.bh1.num_pkts {
                    let packet_header = packet.cast::<libc::tpacket3_hdr>();
                    let is_whole = (*packet_header).tp_len as usize <= 14 + 28 + PACKET;
                    *(if is_whole { &mut whole } else { &mut uncut }) += 1;
                    packet = packet.add((*packet_header).tp_next_offset as usize);
                }
                std::sync::atomic::fence(Ordering::Release);
                status.write_volatile(libc::TP_STATUS_KERNEL);
            }
            block = (block + 1) % RING_BLOCKS;
        }
        (whole, uncut)
    }
}

/// A sender: the packets of all its frames one after the other, as they go over the wire.
struct Sender {
    way: Way,
    socket: UdpSocket,
    file: OwnedFd,
    wire: Mapping,
}

impl Sender {
    fn new(way: Way, huge: bool, to: SocketAddr) -> io::Result<Self> {
        let length = DISTINCT * PACKETS * PACKET;
        // SAFETY: the name is a C string; the result is checked before it is owned.
        let file = unsafe { OwnedFd::from_raw_fd(check(libc::memfd_create(c"frames".as_ptr(), 0))? as i32) };
        // SAFETY: a length for an open file.
        check(unsafe { libc::ftruncate(file.as_raw_fd(), length as i64) })?;
        let wire =
            Mapping::new(length, (way == Way::Sendfile).then_some(&file), huge && way != Way::Sendfile)?;
        // SAFETY: the mapping is ours and `length` long.
        unsafe { wire.start.write_bytes(7, length) };
        let socket = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0))?;
        socket.connect(to)?;
        set(&socket, libc::SOL_SOCKET, libc::SO_SNDBUF, &(8i32 << 20))?;
        if way != Way::Sendmmsg {
            set(&socket, libc::SOL_UDP, libc::UDP_SEGMENT, &(PACKET as i32))?;
        }
        if way == Way::ZeroCopy {
            set(&socket, libc::SOL_SOCKET, libc::SO_ZEROCOPY, &1i32)?;
        }
        Ok(Self { way, socket, file, wire })
    }

    fn send(&self, frame: usize) -> io::Result<()> {
        let together = if self.way == Way::Sendmmsg { 1 } else { RUN };
        let start = frame % DISTINCT * PACKETS * PACKET;
        let runs: Vec<(usize, usize)> = (0..PACKETS)
            .step_by(together)
            .map(|first| (start + first * PACKET, together.min(PACKETS - first) * PACKET))
            .collect();
        let fd = self.socket.as_raw_fd();
        if self.way == Way::Sendfile {
            for (offset, length) in runs {
                let mut offset = offset as i64;
                // SAFETY: the offset is a local.
                check(unsafe { libc::sendfile(fd, self.file.as_raw_fd(), &raw mut offset, length) })?;
            }
            return Ok(());
        }
        let vector = |(offset, length): &(usize, usize)| libc::iovec {
            iov_base: self.wire.start.wrapping_add(*offset).cast(),
            iov_len: *length,
        };
        let mut vectors: Vec<libc::iovec> = runs.iter().map(vector).collect();
        let message = |vector: &mut libc::iovec| {
            // SAFETY: all-zero is a valid `mmsghdr`.
            let mut message: libc::mmsghdr = unsafe { std::mem::zeroed() };
            (message.msg_hdr.msg_iov, message.msg_hdr.msg_iovlen) = (vector, 1);
            message
        };
        let mut messages: Vec<libc::mmsghdr> = vectors.iter_mut().map(message).collect();
        let flags = if self.way == Way::ZeroCopy { libc::MSG_ZEROCOPY } else { 0 };
        for batch in messages.chunks_mut(64) {
            // SAFETY: every message points to a vector, which points into the mapping.
            check(unsafe { libc::sendmmsg(fd, batch.as_mut_ptr(), batch.len() as u32, flags) })?;
        }
        if self.way == Way::ZeroCopy {
            // SAFETY: a message without room for anything: the notices are only taken off the queue.
            unsafe {
                let mut notice: libc::msghdr = std::mem::zeroed();
                while libc::recvmsg(fd, &raw mut notice, libc::MSG_ERRQUEUE | libc::MSG_DONTWAIT) >= 0 {}
            }
        }
        Ok(())
    }
}

/// Processor time of the calling thread.
fn thread_time() -> Duration {
    let mut time = libc::timespec { tv_sec: 0, tv_nsec: 0 };
    // SAFETY: the pointer is to a local.
    unsafe { libc::clock_gettime(libc::CLOCK_THREAD_CPUTIME_ID, &raw mut time) };
    Duration::new(time.tv_sec as u64, time.tv_nsec as u32)
}

fn measure(way: Way, huge: bool, taps: bool, seconds: f64, rate_hz: f64) -> Result<(), Box<dyn Error>> {
    let receivers = (0..CAMERAS).map(|_| Receiver::new()).collect::<io::Result<Vec<_>>>()?;
    let to = receivers.iter().map(|receiver| receiver.udp.local_addr()).collect::<io::Result<Vec<_>>>()?;
    let senders = to.iter().map(|to| Sender::new(way, huge, *to)).collect::<io::Result<Vec<_>>>()?;
    // Without taps the ordinary sockets remain: the difference is what the packet sockets cost the sender.
    let _ports =
        receivers.iter().map(|receiver| receiver.udp.try_clone()).collect::<io::Result<Vec<UdpSocket>>>()?;
    let receivers = if taps { receivers } else { Vec::new() };
    let (stop, spent, frames) = (AtomicBool::new(false), AtomicU64::new(0), (seconds * rate_hz) as usize);
    let begin = Instant::now() + Duration::from_millis(200);
    let counts = std::thread::scope(|scope| -> Result<Vec<(u64, u64)>, Box<dyn Error>> {
        let counting: Vec<_> = receivers.iter().map(|receiver| scope.spawn(|| receiver.run(&stop))).collect();
        let sending: Vec<_> = senders
            .iter()
            .map(|sender| {
                let spent = &spent;
                scope.spawn(move || -> io::Result<()> {
                    let before = thread_time();
                    for frame in 0..frames {
                        let due = begin + Duration::from_secs_f64(frame as f64 / rate_hz);
                        std::thread::sleep(due.saturating_duration_since(Instant::now()));
                        sender.send(frame)?;
                    }
                    spent.fetch_add((thread_time() - before).as_micros() as u64, Ordering::Relaxed);
                    Ok(())
                })
            })
            .collect();
        let sent: Vec<_> = sending.into_iter().map(std::thread::ScopedJoinHandle::join).collect();
        std::thread::sleep(Duration::from_millis(100));
        stop.store(true, Ordering::Release);
        sent.into_iter().try_for_each(|sent| {
            sent.map_err(|_| "a sender panicked")?.map_err(Into::into) as Result<_, Box<dyn Error>>
        })?;
        counting.into_iter().map(|thread| thread.join().map_err(|_| "a receiver panicked".into())).collect()
    })?;
    let sent = frames * usize::from(CAMERAS);
    let (whole, uncut) = counts.iter().fold((0, 0), |sum, count| (sum.0 + count.0, sum.1 + count.1));
    let (spent, gb) = (spent.into_inner() as f64 / 1e6, (sent * FRAME) as f64 / 1e9);
    println!(
        "{:<10} {:<5} {:<5} {:6.3} s/GB {:6.2} us/packet {:8.1} % received whole {uncut:7} uncut",
        format!("{way:?}"),
        if huge { "huge" } else { "" },
        if taps { "" } else { "notap" },
        spent / gb,
        spent * 1e6 / (sent * PACKETS) as f64,
        100.0 * whole as f64 / (sent * PACKETS) as f64,
    );
    Ok(())
}

fn main() -> Result<(), Box<dyn Error>> {
    let mut args = std::env::args().skip(1);
    let seconds = args.next().map_or(Ok(4.0), |text| text.parse())?;
    let rate_hz = args.next().map_or(Ok(120.0), |text| text.parse())?;
    let cuts = fourdbody_simulator::gige::loopback_cuts_before_receivers();
    println!("loopback cuts runs before receivers see them: {cuts}");
    for (way, huge, taps) in [
        (Way::Sendmmsg, false, true),
        (Way::Sendmmsg, true, true),
        (Way::Sendmmsg, true, false),
        (Way::Segmented, false, true),
        (Way::Segmented, true, true),
        (Way::Segmented, true, false),
        (Way::ZeroCopy, true, true),
        (Way::Sendfile, false, true),
    ] {
        if let Err(error) = measure(way, huge, taps, seconds, rate_hz) {
            println!("{way:?}: {error}");
        }
    }
    Ok(())
}
