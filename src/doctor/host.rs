// SPDX-License-Identifier: MIT OR Apache-2.0
//! The computer itself: sockets, limits, processors, clock, memory, the API's port.

use super::load::Load;
use super::{Check, Finding, bytes};
use crate::config::{ApiConfig, SocketMode};
use crate::control::client::NodeClient;
use crate::control::status::NodeStatus;
use crate::host::memory;
use std::io;
use std::net::{SocketAddr, TcpListener};

/// Bits of the effective capabilities (`capability.h`).
const CAP_IPC_LOCK: u32 = 14;
const CAP_SYS_NICE: u32 = 23;

/// What the camera layer asks the kernel for, per camera.
const SOCKET_BUFFER: u64 = 8 << 20;

/// Above this an ordinary UDP socket loses packets inside the system; measured: 276 MB/s of one camera gave
/// up to a bad frame in four seconds even with a large buffer, and hundreds without.
const UDP_BYTES_PER_S: f64 = 100e6;

/// From this load on, receiving and writing want four processors.
const HEAVY_BYTES_PER_S: f64 = 500e6;

/// Clock sources that are read without a system call and do not wander.
const GOOD_CLOCKS: [&str; 4] = ["tsc", "arch_sys_counter", "kvm-clock", "hyperv_clocksource_tsc_page"];

/// Who has the API's port.
#[derive(Debug)]
pub enum PortUse {
    /// Nobody.
    Free,
    /// A running node.
    Node(Box<NodeStatus>),
    /// Somebody who wants a token, or TLS: a running node, probably.
    Closed,
    /// Something else, or it cannot be had at all: the system's words.
    Taken(String),
}

/// What is known of the host. `None`: could not be read.
#[derive(Debug)]
pub struct HostFacts {
    /// Whether a packet socket can be opened; the system's words if not.
    pub packet_socket: Result<(), String>,
    /// `net.core.rmem_max`, bytes.
    pub rmem_max: Option<u64>,
    /// `net.core.rmem_default`, bytes.
    pub rmem_default: Option<u64>,
    /// `net.core.netdev_max_backlog`, packets.
    pub backlog: Option<u64>,
    /// RLIMIT_RTPRIO of this process.
    pub rtprio_limit: u64,
    /// RLIMIT_MEMLOCK of this process, bytes.
    pub memlock_limit: u64,
    /// Effective capabilities.
    pub capabilities: u64,
    /// Processors that this process may use.
    pub cores: usize,
    /// Memory that can be had without swapping, bytes.
    pub memory_available: Option<u64>,
    /// Frequency governors in use, each once; empty where there are none.
    pub governors: Vec<String>,
    /// The kernel's clock source.
    pub clock_source: Option<String>,
    /// The API's port and its user; `None` without a configuration.
    pub api_port: Option<PortUse>,
    /// The API's address.
    pub listen: Option<SocketAddr>,
}

impl HostFacts {
    /// Looks.
    pub fn gather(api: Option<&ApiConfig>) -> Self {
        Self {
            packet_socket: open_packet_socket().map_err(|e| e.to_string()),
            rmem_max: read_number("/proc/sys/net/core/rmem_max"),
            rmem_default: read_number("/proc/sys/net/core/rmem_default"),
            backlog: read_number("/proc/sys/net/core/netdev_max_backlog"),
            rtprio_limit: soft_limit(libc::RLIMIT_RTPRIO),
            memlock_limit: soft_limit(libc::RLIMIT_MEMLOCK),
            capabilities: read_line("/proc/self/status", "CapEff:")
                .and_then(|text| u64::from_str_radix(&text, 16).ok())
                .unwrap_or(0),
            cores: std::thread::available_parallelism().map_or(1, usize::from),
            memory_available: memory::available(),
            governors: governors(),
            clock_source: read_text("/sys/devices/system/clocksource/clocksource0/current_clocksource"),
            api_port: api.map(look_at_api),
            listen: api.and_then(|api| api.listen),
        }
    }

    fn may(&self, capability: u32) -> bool {
        self.capabilities >> capability & 1 == 1
    }
}

fn read_text(path: &str) -> Option<String> {
    std::fs::read_to_string(path).ok().map(|text| text.trim().to_owned())
}

fn read_number(path: &str) -> Option<u64> {
    read_text(path)?.parse().ok()
}

/// What follows `key` at the start of a line.
fn read_line(path: &str, key: &str) -> Option<String> {
    let text = read_text(path)?;
    text.lines().find_map(|line| line.strip_prefix(key)).map(|rest| rest.trim().to_owned())
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

fn soft_limit(resource: libc::__rlimit_resource_t) -> u64 {
    let mut limit = libc::rlimit { rlim_cur: 0, rlim_max: 0 };
    // SAFETY: `limit` is valid for writing.
    if unsafe { libc::getrlimit(resource, &mut limit) } == 0 { limit.rlim_cur } else { 0 }
}

fn governors() -> Vec<String> {
    let Ok(entries) = std::fs::read_dir("/sys/devices/system/cpu") else { return Vec::new() };
    let path = |entry: std::fs::DirEntry| entry.path().join("cpufreq/scaling_governor");
    let texts = entries.flatten().filter_map(|entry| std::fs::read_to_string(path(entry)).ok());
    let mut found: Vec<String> = texts.map(|text| text.trim().to_owned()).collect();
    found.sort();
    found.dedup();
    found
}

/// A node answers on its socket without a token, on its port perhaps not.
fn look_at_api(api: &ApiConfig) -> PortUse {
    if let Some(socket) = &api.socket
        && let Ok(status) = NodeClient::new(&format!("unix:{}", socket.path.display())).status()
    {
        return PortUse::Node(Box::new(status));
    }
    let Some(listen) = api.listen else { return PortUse::Free };
    match TcpListener::bind(listen) {
        Ok(_) => PortUse::Free,
        Err(error) => match NodeClient::new(&listen.to_string()).status() {
            Ok(status) => PortUse::Node(Box::new(status)),
            Err(_) if api.tokens.is_some() || api.tls.is_some() => PortUse::Closed,
            Err(_) => PortUse::Taken(error.to_string()),
        },
    }
}

/// The verdicts on the host.
pub fn judge(facts: &HostFacts, load: &Load) -> Vec<Finding> {
    let mut findings = vec![judge_packet_socket(facts, load)];
    findings.extend(judge_buffers(facts, load));
    findings.extend(judge_limits(facts, load));
    findings.extend(judge_processors(facts, load));
    findings.extend(judge_port(facts));
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
            "the right to, because an ordinary UDP socket loses packets at this rate",
            grant,
        ),
        (Err(error), SocketMode::Auto) => {
            check.warning(format!("cannot be opened ({error})"), "the right to", grant)
        }
    }
}

fn judge_buffers(facts: &HostFacts, load: &Load) -> [Finding; 3] {
    let udp = load.socket == SocketMode::Standard || facts.packet_socket.is_err();
    let frame = load.largest_frame();
    let unreadable = |check: Check| check.warning("cannot be read", "/proc/sys/net/core", "mount /proc");
    let raise = |key: &str, to: u64| {
        format!("`sysctl -w net.core.{key}={to}`, and the same in /etc/sysctl.d/90-fourdbody.conf")
    };
    let check = Check::host("net.core.rmem_max");
    let max = match facts.rmem_max {
        None => unreadable(check),
        Some(found) if found >= SOCKET_BUFFER => check.ok(bytes(found)),
        Some(found) => {
            let expected = format!("{} per camera; a frame has {}", bytes(SOCKET_BUFFER), bytes(frame));
            let advice = raise("rmem_max", SOCKET_BUFFER);
            match udp && found < frame {
                true => check.failed(bytes(found), expected, advice),
                false => check.warning(bytes(found), expected, advice),
            }
        }
    };
    let check = Check::host("net.core.rmem_default");
    let default = match facts.rmem_default {
        None => unreadable(check),
        Some(found) if found >= frame => check.ok(bytes(found)),
        Some(found) if !udp => check.ok(format!("{} (the packet socket does not use it)", bytes(found))),
        Some(found) => check.warning(
            bytes(found),
            format!("a frame, {}: the first frame of a stream has to fit in it", bytes(frame)),
            raise("rmem_default", frame.next_power_of_two()),
        ),
    };
    let check = Check::host("net.core.netdev_max_backlog");
    let needed = load.packets_per_trigger();
    let backlog = match facts.backlog {
        None => unreadable(check),
        Some(found) if found >= needed => check.ok(format!("{found} packets")),
        Some(found) => check.warning(
            format!("{found} packets"),
            format!("{needed}: the frames of all cameras arrive together"),
            raise("netdev_max_backlog", (needed * 2).next_power_of_two()),
        ),
    };
    [max, default, backlog]
}

fn judge_limits(facts: &HostFacts, load: &Load) -> Vec<Finding> {
    let mut findings = Vec::new();
    let unit = "the systemd unit sets it; by hand in /etc/security/limits.d";
    let check = Check::host("real-time priority");
    findings.push(match facts.rtprio_limit {
        _ if facts.may(CAP_SYS_NICE) => check.ok("allowed (CAP_SYS_NICE)"),
        0 => check.warning("not allowed (RLIMIT_RTPRIO 0)", "RLIMIT_RTPRIO of 1 to 99", unit),
        limit => check.ok(format!("allowed (RLIMIT_RTPRIO {limit})")),
    });
    let check = Check::host("memory lock");
    let pool = load.pool_bytes();
    findings.push(match facts.memlock_limit {
        _ if facts.may(CAP_IPC_LOCK) => check.ok("allowed (CAP_IPC_LOCK)"),
        libc::RLIM_INFINITY => check.ok("unlimited (RLIMIT_MEMLOCK)"),
        limit if limit >= pool => check.ok(format!("{} (RLIMIT_MEMLOCK)", bytes(limit))),
        limit => check.warning(
            format!("{} (RLIMIT_MEMLOCK)", bytes(limit)),
            format!("{}, the size of the frame pools", bytes(pool)),
            unit,
        ),
    });
    let check = Check::host("memory");
    findings.push(match facts.memory_available {
        None => check.warning("cannot be read", "/proc/meminfo", "mount /proc"),
        Some(free) if free >= 2 * pool => check.ok(format!("{} available", bytes(free))),
        Some(free) => {
            let expected = format!("{} for the frame pools, and as much again for the rest", bytes(pool));
            let advice = "end other programs, or lower acquisition.buffers_per_camera";
            match free < pool {
                true => check.failed(format!("{} available", bytes(free)), expected, advice),
                false => check.warning(format!("{} available", bytes(free)), expected, advice),
            }
        }
    });
    findings
}

fn judge_processors(facts: &HostFacts, load: &Load) -> Vec<Finding> {
    let mut findings = Vec::new();
    let wanted = if load.bytes_per_s() > HEAVY_BYTES_PER_S { 4 } else { 2 };
    let check = Check::host("processors");
    findings.push(match facts.cores {
        cores if cores >= wanted => check.ok(cores.to_string()),
        cores => check.warning(
            cores.to_string(),
            format!("{wanted} for {:.0} MB/s", load.bytes_per_s() / 1e6),
            "give this computer to the acquisition alone",
        ),
    });
    let check = Check::host("frequency governor");
    let slow = facts.governors.iter().any(|name| name != "performance");
    findings.push(match facts.governors.as_slice() {
        [] => check.ok("none (the firmware or the hypervisor decides)"),
        names if slow => {
            check.warning(names.join(", "), "performance", "`cpupower frequency-set -g performance`")
        }
        names => check.ok(names.join(", ")),
    });
    let check = Check::host("clock source");
    findings.push(match facts.clock_source.as_deref() {
        Some(name) if GOOD_CLOCKS.contains(&name) => check.ok(name),
        found => check.warning(
            found.unwrap_or("cannot be read"),
            "tsc",
            "look for `clocksource` in `dmesg`: the kernel says why it gave up on tsc",
        ),
    });
    findings
}

fn judge_port(facts: &HostFacts) -> Option<Finding> {
    let name = facts.listen.map_or_else(|| "API port".to_owned(), |listen| format!("API port {listen}"));
    let check = Check::host(name);
    Some(match facts.api_port.as_ref()? {
        PortUse::Free => check.ok("free"),
        PortUse::Node(status) => check.warning(
            format!("node {} runs here ({:?}) and has the devices", status.node, status.phase),
            "a free port",
            "what follows is what it says of them; to examine them, stop it first",
        ),
        PortUse::Closed => check.warning(
            "somebody has it who wants a token: probably the node, with the devices".to_owned(),
            "a free port",
            "run this as a user of the node's socket (api.socket), or stop the node first",
        ),
        PortUse::Taken(error) => check.failed(
            format!("not to be had ({error})"),
            "a free port",
            "`ss -ltnp` shows who has it; end that program or change api.listen",
        ),
    })
}

#[cfg(test)]
mod tests {
    use super::{HostFacts, PortUse, judge};
    use crate::config::SocketMode;
    use crate::doctor::Grade;
    use crate::doctor::load::Load;

    fn good() -> HostFacts {
        HostFacts {
            packet_socket: Ok(()),
            rmem_max: Some(32 << 20),
            rmem_default: Some(4 << 20),
            backlog: Some(4096),
            rtprio_limit: 70,
            memlock_limit: libc::RLIM_INFINITY,
            capabilities: 0,
            cores: 8,
            memory_available: Some(16 << 30),
            governors: vec!["performance".to_owned()],
            clock_source: Some("tsc".to_owned()),
            api_port: Some(PortUse::Free),
            listen: Some(([127, 0, 0, 1], 7401).into()),
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
        let facts = HostFacts { rtprio_limit: 0, memlock_limit: 8 << 20, ..good() };
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
            api_port: Some(PortUse::Taken("Address already in use".to_owned())),
            ..good()
        };
        let expected = [
            ("memory".to_owned(), Grade::Failed),
            ("processors".to_owned(), Grade::Warning),
            ("frequency governor".to_owned(), Grade::Warning),
            ("clock source".to_owned(), Grade::Warning),
            ("API port 127.0.0.1:7401".to_owned(), Grade::Failed),
        ];
        assert_eq!(complaints(&facts, &Load::reference()), expected);
    }

    #[test]
    fn this_host_can_be_looked_at() {
        let facts = HostFacts::gather(None);
        assert!(facts.cores > 0 && facts.rmem_max.is_some() && facts.memory_available.is_some());
    }
}
