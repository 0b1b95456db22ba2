// SPDX-License-Identifier: MIT OR Apache-2.0
//! The computer itself: sockets, limits, processors, clock and memory.

use super::finding::{Check, Finding, Grade, bytes};
use super::load::Load;
use crate::config::SocketMode;
use crate::host::memory;
use crate::host::realtime::{limit_text, soft_limit};
use std::io;

/// Bit of the effective capabilities (`capability.h`) that permits locking memory without a limit.
const CAP_IPC_LOCK: u32 = 14;
/// Bit of the effective capabilities (`capability.h`) that permits real-time priorities without a limit.
const CAP_SYS_NICE: u32 = 23;

/// Receive buffer that the camera layer requests from the kernel for each camera, bytes.
const SOCKET_BUFFER: u64 = 8 << 20;

/// Above this load, bytes a second, an ordinary UDP socket loses packets inside the system; measured: 276 MB/s of one
/// camera gave up to one incomplete frame in four seconds with a large buffer, and hundreds without.
const UDP_BYTES_PER_S: f64 = 100e6;

/// From this load on, bytes a second, receiving and writing need four processors.
const HEAVY_BYTES_PER_S: f64 = 500e6;

/// Clock sources of the kernel that are read without a system call and run evenly.
const GOOD_CLOCKS: [&str; 4] = ["tsc", "arch_sys_counter", "kvm-clock", "hyperv_clocksource_tsc_page"];

/// Facts about the host; `None` where one could not be read.
#[derive(Debug)]
pub struct HostFacts {
    /// Whether a packet socket can be opened; the system's error message if not.
    pub packet_socket: Result<(), String>,
    /// `net.core.rmem_max`, the largest receive buffer of a socket, bytes.
    pub rmem_max: Option<u64>,
    /// `net.core.rmem_default`, the receive buffer of a socket that requests none, bytes.
    pub rmem_default: Option<u64>,
    /// `net.core.netdev_max_backlog`, packets that wait for the network stack.
    pub backlog: Option<u64>,
    /// RLIMIT_RTPRIO of this process; `None` is unlimited.
    pub rtprio_limit: Option<u64>,
    /// RLIMIT_MEMLOCK of this process, bytes; `None` is unlimited.
    pub memlock_limit: Option<u64>,
    /// Effective capabilities of this process, a bit each.
    pub capabilities: u64,
    /// Processors that this process may use.
    pub cores: usize,
    /// Memory that can be had without swapping, bytes.
    pub memory_available: Option<u64>,
    /// Frequency governors in use, each once; empty where there are none.
    pub governors: Vec<String>,
    /// The clock source that the kernel uses.
    pub clock_source: Option<String>,
}

impl HostFacts {
    /// Reads all facts of this host and of this process.
    pub fn gather() -> Self {
        let status = read_text("/proc/self/status").unwrap_or_default();
        let capabilities = status.lines().find_map(|line| line.strip_prefix("CapEff:"));
        let sysctl = |key: &str| read_text(&format!("/proc/sys/net/core/{key}"))?.parse().ok();
        Self {
            packet_socket: open_packet_socket().map_err(|e| e.to_string()),
            rmem_max: sysctl("rmem_max"),
            rmem_default: sysctl("rmem_default"),
            backlog: sysctl("netdev_max_backlog"),
            rtprio_limit: soft_limit(libc::RLIMIT_RTPRIO),
            memlock_limit: soft_limit(libc::RLIMIT_MEMLOCK),
            capabilities: capabilities.and_then(|hex| u64::from_str_radix(hex.trim(), 16).ok()).unwrap_or(0),
            cores: std::thread::available_parallelism().map_or(1, usize::from),
            memory_available: memory::available(),
            governors: governors(),
            clock_source: read_text("/sys/devices/system/clocksource/clocksource0/current_clocksource"),
        }
    }

    fn may(&self, capability: u32) -> bool {
        self.capabilities >> capability & 1 == 1
    }
}

fn read_text(path: &str) -> Option<String> {
    std::fs::read_to_string(path).ok().map(|text| text.trim().to_owned())
}

fn open_packet_socket() -> io::Result<()> {
    // Protocol 0: receives nothing.
    // SAFETY: a plain call with constant arguments.
    let descriptor = unsafe { libc::socket(libc::AF_PACKET, libc::SOCK_RAW | libc::SOCK_CLOEXEC, 0) };
    if descriptor < 0 {
        return Err(io::Error::last_os_error());
    }
    // SAFETY: the descriptor was opened above and is closed once.
    unsafe { libc::close(descriptor) };
    Ok(())
}

fn governors() -> Vec<String> {
    let Ok(entries) = std::fs::read_dir("/sys/devices/system/cpu") else { return Vec::new() };
    let governor =
        |entry: std::fs::DirEntry| read_text(entry.path().join("cpufreq/scaling_governor").to_str()?);
    let mut found: Vec<String> = entries.flatten().filter_map(governor).collect();
    found.sort();
    found.dedup();
    found
}

/// The verdicts on the host, for the load of its node.
pub fn judge(facts: &HostFacts, load: &Load) -> Vec<Finding> {
    let mut findings = vec![judge_packet_socket(facts, load)];
    findings.extend(judge_buffers(facts, load));
    findings.extend(judge_limits(facts, load));
    findings.extend(judge_processors(facts, load));
    findings
}

fn judge_packet_socket(facts: &HostFacts, load: &Load) -> Finding {
    let check = Check::host("packet socket");
    let megabytes = load.bytes_per_s() / 1e6;
    let heavy = load.bytes_per_s() > UDP_BYTES_PER_S;
    let grant = "grant CAP_NET_RAW: the systemd unit does; by hand `setcap cap_net_raw+ep` on the binary";
    match (&facts.packet_socket, load.socket) {
        (Ok(()), SocketMode::Auto) => check.ok("may be opened (CAP_NET_RAW)"),
        (_, SocketMode::Standard) if heavy => check.warning(
            format!("switched off by the configuration, for {megabytes:.0} MB/s"),
            "acquisition.socket = \"auto\"",
            "an ordinary UDP socket loses packets at this rate: remove the setting",
        ),
        (_, SocketMode::Standard) => check.ok("not used (acquisition.socket = \"standard\")"),
        (Err(error), SocketMode::Auto) if heavy => check.failed(
            format!("cannot be opened ({error}), for {megabytes:.0} MB/s"),
            "the right to open one, because an ordinary UDP socket loses packets at this rate",
            grant,
        ),
        (Err(error), SocketMode::Auto) => {
            check.warning(format!("cannot be opened ({error})"), "the right to open one", grant)
        }
    }
}

fn judge_buffers(facts: &HostFacts, load: &Load) -> [Finding; 3] {
    let udp = load.socket == SocketMode::Standard || facts.packet_socket.is_err();
    let frame = load.largest_frame();
    let packets = load.packets_per_trigger();
    let judge =
        |key: &str, found: Option<u64>, needed, text: fn(u64) -> String, expected, raised: u64, fatal| {
            let check = Check::host(format!("net.core.{key}"));
            let Some(found) = found else {
                return check.warning("cannot be read", "/proc/sys/net/core", "mount /proc");
            };
            if found >= needed {
                return check.ok(text(found));
            }
            let advice = format!(
                "`sysctl -w net.core.{key}={raised}`, and the same in /etc/sysctl.d/90-fourdbody.conf"
            );
            let grade = if fatal && found < frame { Grade::Failed } else { Grade::Warning };
            check.graded(grade, text(found), expected, advice)
        };
    let in_packets = |count: u64| format!("{count} packets");
    [
        judge(
            "rmem_max",
            facts.rmem_max,
            SOCKET_BUFFER,
            bytes,
            format!("{} per camera; a frame has {}", bytes(SOCKET_BUFFER), bytes(frame)),
            SOCKET_BUFFER,
            udp,
        ),
        judge(
            "rmem_default",
            facts.rmem_default,
            // The packet socket does not use it.
            if udp { frame } else { 0 },
            bytes,
            format!("a frame, {}: the first frame of a stream has to fit in it", bytes(frame)),
            frame.next_power_of_two(),
            false,
        ),
        judge(
            "netdev_max_backlog",
            facts.backlog,
            packets,
            in_packets,
            format!("{packets}: the frames of all cameras arrive together"),
            (packets * 2).next_power_of_two(),
            false,
        ),
    ]
}

fn judge_limits(facts: &HostFacts, load: &Load) -> [Finding; 3] {
    let unit = "the systemd unit sets it; by hand in /etc/security/limits.d";
    let check = Check::host("real-time priority");
    let priority = match facts.rtprio_limit {
        _ if facts.may(CAP_SYS_NICE) => check.ok("allowed (CAP_SYS_NICE)"),
        Some(0) => check.warning("not allowed (RLIMIT_RTPRIO 0)", "RLIMIT_RTPRIO of 1 to 99", unit),
        limit => check.ok(format!("allowed (RLIMIT_RTPRIO {})", limit_text(limit))),
    };
    let check = Check::host("memory lock");
    let pool = load.pool_bytes();
    let lock = match facts.memlock_limit {
        _ if facts.may(CAP_IPC_LOCK) => check.ok("allowed (CAP_IPC_LOCK)"),
        None => check.ok("unlimited (RLIMIT_MEMLOCK)"),
        Some(limit) => {
            let grade = if limit >= pool { Grade::Ok } else { Grade::Warning };
            let found = format!("{} (RLIMIT_MEMLOCK)", bytes(limit));
            check.graded(grade, found, format!("{}, the size of the frame pools", bytes(pool)), unit)
        }
    };
    let check = Check::host("memory");
    let Some(free) = facts.memory_available else {
        return [priority, lock, check.warning("cannot be read", "/proc/meminfo", "mount /proc")];
    };
    let grade = match free {
        free if free < pool => Grade::Failed,
        free if free < 2 * pool => Grade::Warning,
        _ => Grade::Ok,
    };
    let expected = format!("{} for the frame pools, and as much again for the rest", bytes(pool));
    let advice = "end other programs, or lower acquisition.buffers_per_camera";
    [priority, lock, check.graded(grade, format!("{} available", bytes(free)), expected, advice)]
}

fn judge_processors(facts: &HostFacts, load: &Load) -> [Finding; 3] {
    let graded = |good| if good { Grade::Ok } else { Grade::Warning };
    let wanted = if load.bytes_per_s() > HEAVY_BYTES_PER_S { 4 } else { 2 };
    let processors = Check::host("processors").graded(
        graded(facts.cores >= wanted),
        facts.cores.to_string(),
        format!("{wanted} for {:.0} MB/s", load.bytes_per_s() / 1e6),
        "give this computer to the acquisition alone",
    );
    let check = Check::host("frequency governor");
    let governor = match facts.governors.as_slice() {
        [] => check.ok("none (the firmware or the hypervisor decides)"),
        names => check.graded(
            graded(names.iter().all(|name| name == "performance")),
            names.join(", "),
            "performance",
            "`cpupower frequency-set -g performance`",
        ),
    };
    let clock = facts.clock_source.as_deref().unwrap_or("cannot be read");
    let clock = Check::host("clock source").graded(
        graded(GOOD_CLOCKS.contains(&clock)),
        clock,
        "tsc",
        "`dmesg | grep clocksource` shows why the kernel does not use tsc",
    );
    [processors, governor, clock]
}

#[cfg(test)]
mod tests {
    use super::{HostFacts, judge};
    use crate::config::SocketMode;
    use crate::doctor::finding::Grade;
    use crate::doctor::load::Load;

    fn good() -> HostFacts {
        HostFacts {
            packet_socket: Ok(()),
            rmem_max: Some(32 << 20),
            rmem_default: Some(4 << 20),
            backlog: Some(4096),
            rtprio_limit: Some(70),
            memlock_limit: None,
            capabilities: 0,
            cores: 8,
            memory_available: Some(16 << 30),
            governors: vec!["performance".to_owned()],
            clock_source: Some("tsc".to_owned()),
        }
    }

    /// Name and grade of what is not ok.
    fn complaints(facts: &HostFacts, load: &Load) -> Vec<(String, Grade)> {
        let findings = judge(facts, load).into_iter().filter(|f| f.grade != Grade::Ok);
        findings
            .map(|f| {
                assert!(!f.expected.is_empty() && !f.advice.is_empty(), "{f}");
                (f.check, f.grade)
            })
            .collect()
    }

    #[test]
    fn a_good_host_is_fit() {
        assert_eq!(complaints(&good(), &Load::reference()), []);
    }

    #[test]
    fn a_host_without_packet_socket_is_unfit_at_full_rate_only() {
        let facts = HostFacts { packet_socket: Err("Operation not permitted".to_owned()), ..good() };
        let full = Load::reference();
        assert_eq!(complaints(&facts, &full), [("packet socket".to_owned(), Grade::Failed)]);
        let slow = Load { rate_hz: 10.0, ..full.clone() };
        assert_eq!(complaints(&facts, &slow), [("packet socket".to_owned(), Grade::Warning)]);
        let standard = Load { socket: SocketMode::Standard, ..full };
        assert_eq!(complaints(&good(), &standard), [("packet socket".to_owned(), Grade::Warning)]);
    }

    #[test]
    fn small_buffers_are_fatal_only_where_they_are_used() {
        let small =
            HostFacts { rmem_max: Some(212_992), rmem_default: Some(212_992), backlog: Some(1000), ..good() };
        let backlog = ("net.core.netdev_max_backlog".to_owned(), Grade::Warning);
        let max = |grade| ("net.core.rmem_max".to_owned(), grade);
        let load = Load::reference();
        assert_eq!(complaints(&small, &load), [max(Grade::Warning), backlog.clone()]);
        let standard = Load { socket: SocketMode::Standard, rate_hz: 10.0, ..load };
        let default = ("net.core.rmem_default".to_owned(), Grade::Warning);
        assert_eq!(complaints(&small, &standard), [max(Grade::Failed), default, backlog]);
    }

    #[test]
    fn limits_are_waived_by_capabilities() {
        let facts = HostFacts { rtprio_limit: Some(0), memlock_limit: Some(8 << 20), ..good() };
        let names: Vec<_> =
            complaints(&facts, &Load::reference()).into_iter().map(|(name, _)| name).collect();
        assert_eq!(names, ["real-time priority", "memory lock"]);
        let root = HostFacts { capabilities: 1 << 14 | 1 << 23, ..facts };
        assert_eq!(complaints(&root, &Load::reference()), []);
    }

    #[test]
    fn everything_else_is_noticed() {
        let facts = HostFacts {
            cores: 2,
            memory_available: Some(100 << 20),
            governors: vec!["performance".to_owned(), "powersave".to_owned()],
            clock_source: Some("hpet".to_owned()),
            ..good()
        };
        let expected = [
            ("memory".to_owned(), Grade::Failed),
            ("processors".to_owned(), Grade::Warning),
            ("frequency governor".to_owned(), Grade::Warning),
            ("clock source".to_owned(), Grade::Warning),
        ];
        assert_eq!(complaints(&facts, &Load::reference()), expected);
    }

    #[test]
    fn this_host_can_be_looked_at() {
        let facts = HostFacts::gather();
        assert!(facts.cores > 0 && facts.rmem_max.is_some() && facts.memory_available.is_some());
    }
}
