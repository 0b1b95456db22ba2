// SPDX-License-Identifier: MIT OR Apache-2.0
//! Is this host fit for its cameras' rate? Facts are gathered, then judged, then told one by one.
//!
//! Every part has two halves that do not mix: `gather` touches the system, `judge` is a pure function from
//! facts and [`Load`] to [`Finding`]s. Nothing that is examined is left changed: files that were written are
//! deleted, cameras and HSU are released; devices that a running node holds are not touched at all, because
//! greeting an HSU takes back what has been armed.

pub mod devices;
pub mod disk;
pub mod firewall;
pub mod host;
mod load;
pub mod network;
pub mod reverse_path;
pub mod subnets;
pub mod usb;

pub use load::Load;

use crate::base::Exit;
use crate::camera::CameraBackend;
use crate::config::NodeConfig;
use crate::network::{Interface, discover, interfaces};
use serde::Serialize;
use std::collections::BTreeMap;
use std::net::{IpAddr, Ipv4Addr};
use std::path::Path;
use std::time::Duration;

/// Cameras answer a broadcast within this.
const DISCOVERY_PATIENCE: Duration = Duration::from_millis(700);

/// What a finding is about: decides the exit code.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Subject {
    /// This computer.
    Host,
    /// A camera or the HSU.
    Device,
}

/// How it stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Grade {
    /// As it should be.
    Ok,
    /// Works, but not at its best, or could not be examined.
    Warning,
    /// A session at the configured rate will lose frames or not start.
    Failed,
}

/// One verdict.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Finding {
    /// What was examined, for instance `net.core.rmem_max` or `camera h0_up: packet size`.
    pub check: String,
    /// What it belongs to.
    pub subject: Subject,
    /// How it stands.
    pub grade: Grade,
    /// What was found.
    pub found: String,
    /// What was expected; empty when all is well.
    pub expected: String,
    /// What to do; empty when all is well.
    pub advice: String,
}

impl std::fmt::Display for Finding {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let grade = match self.grade {
            Grade::Ok => "ok",
            Grade::Warning => "warning",
            Grade::Failed => "failed",
        };
        write!(f, "{grade:<8} {}: {}", self.check, self.found)?;
        if !self.expected.is_empty() {
            write!(f, "; expected {}", self.expected)?;
        }
        if !self.advice.is_empty() {
            write!(f, "; {}", self.advice)?;
        }
        Ok(())
    }
}

/// Something that is being examined; its methods make the verdict.
struct Check {
    subject: Subject,
    name: String,
}

impl Check {
    fn host(name: impl Into<String>) -> Self {
        Self { subject: Subject::Host, name: name.into() }
    }

    fn device(name: impl Into<String>) -> Self {
        Self { subject: Subject::Device, name: name.into() }
    }

    fn ok(self, found: impl Into<String>) -> Finding {
        self.grade(Grade::Ok, found, "", "")
    }

    fn warning(
        self,
        found: impl Into<String>,
        expected: impl Into<String>,
        advice: impl Into<String>,
    ) -> Finding {
        self.grade(Grade::Warning, found, expected, advice)
    }

    fn failed(
        self,
        found: impl Into<String>,
        expected: impl Into<String>,
        advice: impl Into<String>,
    ) -> Finding {
        self.grade(Grade::Failed, found, expected, advice)
    }

    fn grade(
        self,
        grade: Grade,
        found: impl Into<String>,
        expected: impl Into<String>,
        advice: impl Into<String>,
    ) -> Finding {
        Finding {
            check: self.name,
            subject: self.subject,
            grade,
            found: found.into(),
            expected: expected.into(),
            advice: advice.into(),
        }
    }
}

/// What the findings come to: a failed device is 5, an unfit host 1, warnings are 0.
pub fn exit_of(findings: &[Finding]) -> Exit {
    let failed = |subject| findings.iter().any(|f| f.grade == Grade::Failed && f.subject == subject);
    match (failed(Subject::Device), failed(Subject::Host)) {
        (true, _) => Exit::Device,
        (false, true) => Exit::Failure,
        (false, false) => Exit::Done,
    }
}

/// Examines the host, and with a configuration also the ways to its devices, the disk and the devices.
/// `tell` gets every finding as soon as it is known, `disk_progress` how much of the disk's test is over. Without a `backend` cameras are not opened.
pub fn examine(
    config: Option<&NodeConfig>,
    mut backend: Option<&mut dyn CameraBackend>,
    disk_time: Duration,
    disk_progress: &dyn Fn(Duration, Duration),
    mut tell: impl FnMut(Finding),
) {
    let load = config.map_or_else(Load::reference, Load::of);
    let facts = host::HostFacts::gather(config.map(|config| &config.api));
    host::judge(&facts, &load).into_iter().for_each(&mut tell);
    let Some(config) = config else { return };
    // One camera that is known by its Aravis id alone, or is on USB, needs a list of all.
    let by_id = config.cameras.iter().any(|camera| camera.address.parse::<IpAddr>().is_err());
    let listed = backend.as_deref_mut().filter(|_| by_id).map_or_else(Vec::new, |backend| backend.list());
    let all = interfaces();
    let paths = network::gather(config, &listed, &all);
    network::judge(&paths, &load).into_iter().for_each(&mut tell);
    examine_network(&paths, &all, &load, facts.packet_socket.is_ok()).into_iter().for_each(&mut tell);
    usb::judge(&usb::gather(Path::new("/sys"), config, &listed)).into_iter().for_each(&mut tell);
    let held = matches!(facts.api_port, Some(host::PortUse::Node(_) | host::PortUse::Closed));
    // A test at full speed would take the disk from a session that may be running.
    let disk_time = if held { Duration::ZERO } else { disk_time };
    let disk = disk::DiskFacts::gather(config, disk_time, disk_progress);
    disk::judge(&disk, &load).into_iter().for_each(&mut tell);
    if let Some(host::PortUse::Node(status)) = &facts.api_port {
        return devices::judge_status(status).into_iter().for_each(tell);
    }
    match backend {
        Some(backend) => {
            for camera in &config.cameras {
                let facts = devices::CameraFacts::gather(camera, config, backend);
                devices::judge_camera(&facts, &load).into_iter().for_each(&mut tell);
            }
        }
        None => tell(devices::cameras_not_examined()),
    }
    match config.trigger.action() {
        Some(action) => tell(devices::judge_actions(action, config.cameras.len())),
        None => {
            let hsu = devices::HsuFacts::gather(config);
            devices::judge_hsu(&hsu, &load).into_iter().for_each(tell);
        }
    }
}

/// Subnets, filters and firewalls between the cameras and this program.
fn examine_network(
    paths: &[network::CameraPath],
    all: &[Interface],
    load: &Load,
    packet_socket: bool,
) -> Vec<Finding> {
    let mut cameras: BTreeMap<String, Vec<Ipv4Addr>> = BTreeMap::new();
    let mut used: Vec<Interface> = Vec::new();
    for path in paths {
        if let (network::Route::Direct(at), IpAddr::V4(address)) = (&path.route, path.address) {
            cameras.entry(at.name.clone()).or_default().push(address);
            if !used.contains(at) {
                used.push(at.clone());
            }
        }
    }
    let answers = discover(all, DISCOVERY_PATIENCE);
    let mut findings = subnets::judge(all, &used, &answers);
    findings.extend(reverse_path::judge(&reverse_path::gather(Path::new("/proc"), &used), all));
    let cameras: Vec<(String, Vec<Ipv4Addr>)> = cameras.into_iter().collect();
    if !cameras.is_empty() {
        findings.extend(firewall::judge(&firewall::gather(), &cameras, load, packet_socket));
    }
    findings
}

/// A number of bytes for people.
fn bytes(count: u64) -> String {
    const UNITS: [(u64, &str); 3] = [(1 << 30, "GiB"), (1 << 20, "MiB"), (1 << 10, "KiB")];
    match UNITS.iter().find(|(size, _)| count >= *size) {
        Some((size, unit)) => format!("{:.1} {unit}", count as f64 / *size as f64),
        None => format!("{count} B"),
    }
}

#[cfg(test)]
mod tests {
    use super::{Check, Finding, bytes, exit_of};
    use crate::base::Exit;

    #[test]
    fn a_failed_device_counts_before_an_unfit_host_and_warnings_do_not_count() {
        let ok = || Check::host("a").ok("1");
        let warning = || Check::device("b").warning("1", "2", "3");
        let unfit = || Check::host("c").failed("1", "2", "3");
        let broken = || Check::device("d").failed("1", "2", "3");
        assert_eq!(exit_of(&[ok(), warning()]), Exit::Done);
        assert_eq!(exit_of(&[ok(), warning(), unfit()]), Exit::Failure);
        assert_eq!(exit_of(&[unfit(), broken(), ok()]), Exit::Device);
    }

    #[test]
    fn a_verdict_is_one_line_with_all_that_is_known() {
        let line = |finding: Finding| finding.to_string();
        assert_eq!(line(Check::host("mtu").ok("9000")), "ok       mtu: 9000");
        let failed = Check::host("mtu").failed("1500", "9000", "ip link set eth0 mtu 9000");
        assert_eq!(line(failed), "failed   mtu: 1500; expected 9000; ip link set eth0 mtu 9000");
        assert_eq!(
            [bytes(12), bytes(8 << 20), bytes(3 << 29)],
            ["12 B", "8.0 MiB", "1.5 GiB"].map(str::to_owned)
        );
    }
}
