// SPDX-License-Identifier: MIT OR Apache-2.0
//! The way to each camera: which interface, and whether that carries its packets. USB cameras have none.

use super::finding::{Check, Finding, Grade};
use super::load::Load;
use crate::base::ids::CameraId;
use crate::camera::CameraListing;
use crate::config::{CameraConfig, NodeConfig};
use crate::network::{Interface, without_link};
use std::collections::BTreeMap;
use std::net::{IpAddr, Ipv4Addr};
use std::path::Path;

/// Where packets to an address leave this host.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Route {
    /// Directly through this interface, without a router.
    Direct(Interface),
    /// To a router behind this interface: a camera network has none.
    Gateway(String),
    /// No route; the interfaces of this host that have no link.
    None(Vec<String>),
}

/// One Ethernet camera and the way to it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CameraPath {
    pub id: CameraId,
    pub address: IpAddr,
    /// Bytes of one of its frames as it sends them.
    pub frame_bytes: u64,
    pub route: Route,
}

/// The bytes of a camera's frame as it sends them; 0 for one that the rig does not have.
pub fn sent_bytes(config: &NodeConfig, camera: &CameraConfig) -> u64 {
    let size = config.rig.cameras().find(|(_, known)| known.id == camera.id);
    let pixel = camera.words.pixel.unwrap_or_default();
    size.map_or(0, |(_, known)| pixel.sent_bytes((known.device.width, known.device.height)) as u64)
}

/// Finds the way to every Ethernet camera. Cameras that are configured by an Aravis id are looked for among those that
/// discovery `listed`; what is not found there is left to the device checks.
pub fn gather(config: &NodeConfig, listed: &[CameraListing], all: &[Interface]) -> Vec<CameraPath> {
    let table = std::fs::read_to_string("/proc/net/route").unwrap_or_default();
    let path = |camera: &CameraConfig| {
        let found = || listed.iter().find(|l| l.id == camera.address && l.protocol != "USB3Vision");
        let address = camera.address.parse().ok().or_else(|| found()?.address.parse().ok())?;
        let (id, frame_bytes) = (camera.id.clone(), sent_bytes(config, camera));
        Some(CameraPath { id, address, frame_bytes, route: route(&table, address, all) })
    };
    config.cameras.iter().filter_map(path).collect()
}

fn route(table: &str, address: IpAddr, all: &[Interface]) -> Route {
    // GigE Vision is IPv4 only.
    let IpAddr::V4(address) = address else { return Route::None(Vec::new()) };
    match find_route(table, address) {
        Some((name, false)) => {
            let known = all.iter().find(|at| at.name == name).cloned();
            Route::Direct(known.unwrap_or_else(|| Interface::describe(&name, Vec::new())))
        }
        Some((name, true)) => Route::Gateway(name),
        None => Route::None(without_link(Path::new("/sys"))),
    }
}

/// The interface of the most specific route in the text of `/proc/net/route`, of several the one with the lowest
/// metric, and whether the route leads to a gateway. Loopback addresses are in another table.
fn find_route(table: &str, address: Ipv4Addr) -> Option<(String, bool)> {
    const UP: u32 = 1;
    const GATEWAY: u32 = 2;
    if address.is_loopback() {
        return Some(("lo".to_owned(), false));
    }
    let rows = table.lines().skip(1).filter_map(|line| {
        let fields: Vec<&str> = line.split_whitespace().collect();
        // The kernel prints the bytes in network order as a number of this machine's order.
        let hex = |i: usize| u32::from_str_radix(fields.get(i)?, 16).ok();
        let bits = |i| Some(u32::from_be(hex(i)?));
        let (target, mask, flags) = (bits(1)?, bits(7)?, hex(3)?);
        let metric: u32 = fields.get(6)?.parse().ok()?;
        let fits = flags & UP != 0 && address.to_bits() & mask == target;
        fits.then(|| (mask, std::cmp::Reverse(metric), (*fields[0]).to_owned(), flags & GATEWAY != 0))
    });
    rows.max().map(|(_, _, name, gateway)| (name, gateway))
}

/// The verdicts: one per camera on the way to it, one per interface on its load.
pub fn judge(paths: &[CameraPath], load: &Load) -> Vec<Finding> {
    let mut findings = Vec::new();
    let mut carried: BTreeMap<&str, (&Interface, f64, usize)> = BTreeMap::new();
    for path in paths {
        findings.push(judge_path(path, load));
        if let Route::Direct(interface) = &path.route {
            let (_, bits, cameras) = carried.entry(&interface.name).or_insert((interface, 0.0, 0));
            *bits += load.link_bits_per_s(path.frame_bytes);
            *cameras += 1;
        }
    }
    findings.extend(carried.into_values().map(|(interface, bits, n)| judge_interface(interface, bits, n)));
    findings
}

fn judge_path(path: &CameraPath, load: &Load) -> Finding {
    let check = Check::host(format!("way to camera {}", path.id));
    let (packet, address) = (load.packet_bytes, path.address);
    match &path.route {
        Route::None(down) if down.is_empty() => check.failed(
            format!("no route to {address}"),
            "an interface in the camera's network",
            "give an interface of this host an address in that network",
        ),
        // An interface without a link often loses its routes.
        Route::None(down) => check.failed(
            format!("no route to {address}, and no link on {}", down.join(", ")),
            "an interface with a link in the camera's network",
            format!(
                "check the cable, the switch and the camera's power, switch the interface on (`ip link set {} up`), or \
                 give another one an address in that network",
                down[0]
            ),
        ),
        Route::Gateway(name) => check.failed(
            format!("{address} lies behind a router ({name})"),
            "an interface in the camera's network",
            "give an interface of this host an address in that network, or correct the camera's address",
        ),
        Route::Direct(Interface { name, mtu: Some(mtu), .. }) => check.graded(
            if *mtu >= packet { Grade::Ok } else { Grade::Failed },
            format!("{name}, MTU {mtu} for packets of {packet} bytes"),
            format!("an MTU of at least {packet} (acquisition.packet_bytes)"),
            format!("`ip link set {name} mtu {packet}`, on the switch as well"),
        ),
        Route::Direct(Interface { name, mtu: None, .. }) => check.warning(
            format!("the MTU of {name} cannot be read"),
            format!("at least {packet}"),
            format!("look with `ip link show {name}`"),
        ),
    }
}

fn judge_interface(interface: &Interface, bits_per_s: f64, cameras: usize) -> Finding {
    let check = Check::host(format!("interface {}", interface.name));
    let load = format!("{:.2} Gbit/s of {cameras} cameras", bits_per_s / 1e9);
    if !interface.up {
        return check.failed("has no link", "a link", "check the cable, the switch and the camera's power");
    }
    let Some(speed) = interface.speed_mbit else {
        return check.ok(format!("up, speed not known, carries {load}"));
    };
    let share = bits_per_s / (speed as f64 * 1e6);
    let found = format!("{speed} Mbit/s for {load} ({:.0} %)", share * 100.0);
    match share {
        s if s > 1.0 => {
            check.failed(found, "a faster link", "use 5GigE or 10GigE ports, or spread the cameras")
        }
        s if s > 0.95 => {
            check.warning(found, "room for packets that are sent again", "spread the cameras over more ports")
        }
        _ => check.ok(found),
    }
}

#[cfg(test)]
mod tests {
    use super::{CameraPath, Interface, Route, find_route, judge};
    use crate::base::ids::CameraId;
    use crate::doctor::finding::Grade;
    use crate::doctor::load::Load;
    use std::net::Ipv4Addr;

    const TABLE: &str = "Iface\tDestination\tGateway \tFlags\tRefCnt\tUse\tMetric\tMask\t\tMTU\tWindow\tIRTT\n\
        eth0\t00000000\t0101A8C0\t0003\t0\t0\t100\t00000000\t0\t0\t0\n\
        cam1\t000AA8C0\t00000000\t0001\t0\t0\t200\t00FFFFFF\t0\t0\t0\n\
        cam0\t000AA8C0\t00000000\t0001\t0\t0\t100\t00FFFFFF\t0\t0\t0\n\
        cam2\t800AA8C0\t00000000\t0001\t0\t0\t500\t80FFFFFF\t0\t0\t0\n\
        broken line\n";

    #[test]
    #[cfg(target_endian = "little")]
    fn the_most_specific_route_wins_and_of_several_the_one_with_the_lowest_metric() {
        let found = |name: &str, gateway| Some((name.to_owned(), gateway));
        let to = |last| find_route(TABLE, Ipv4Addr::new(192, 168, 10, last));
        assert_eq!(to(2), found("cam0", false));
        assert_eq!(to(200), found("cam2", false));
        assert_eq!(find_route(TABLE, Ipv4Addr::new(10, 0, 0, 1)), found("eth0", true));
        assert_eq!(find_route(TABLE, Ipv4Addr::new(127, 9, 9, 9)), found("lo", false));
        assert_eq!(find_route("", Ipv4Addr::new(10, 0, 0, 1)), None);
    }

    fn paths(mtu: u32, speed_mbit: Option<u64>, up: bool, cameras: u8) -> Vec<CameraPath> {
        let subnets = Vec::new();
        let interface = Interface { name: "cam0".to_owned(), mtu: Some(mtu), up, speed_mbit, subnets };
        let path = |n| CameraPath {
            id: CameraId(format!("c{n}")),
            address: [192, 168, 10, n].into(),
            frame_bytes: 1920 * 1200,
            route: Route::Direct(interface.clone()),
        };
        (0..cameras).map(path).collect()
    }

    fn grades(paths: Vec<CameraPath>) -> Vec<Grade> {
        judge(&paths, &Load::reference()).iter().map(|finding| finding.grade).collect()
    }

    #[test]
    fn packets_must_fit_and_links_must_carry_their_cameras() {
        use Grade::{Failed, Ok, Warning};
        assert_eq!(grades(paths(9000, Some(5000), true, 1)), [Ok, Ok]);
        assert_eq!(grades(paths(1500, Some(5000), true, 1)), [Failed, Ok]);
        assert_eq!(grades(paths(9000, Some(1000), true, 1)), [Ok, Failed]);
        assert_eq!(grades(paths(9000, None, true, 1)), [Ok, Ok]);
        assert_eq!(grades(paths(9000, None, false, 1)), [Ok, Failed]);
        // Four cameras fill 89 % of a 10 GbE port, and 98 % of one with 9.1 Gbit/s.
        assert_eq!(grades(paths(9000, Some(10_000), true, 4)), [Ok, Ok, Ok, Ok, Ok]);
        assert_eq!(grades(paths(9000, Some(9_100), true, 4)), [Ok, Ok, Ok, Ok, Warning]);
        assert_eq!(grades(paths(9000, Some(5_000), true, 4)), [Ok, Ok, Ok, Ok, Failed]);
    }

    #[test]
    fn a_camera_behind_a_router_or_without_a_route_fails() {
        let mut lost = paths(9000, None, true, 1);
        lost[0].route = Route::Gateway("eth0".to_owned());
        assert_eq!(grades(lost.clone()), [Grade::Failed]);
        lost[0].route = Route::None(Vec::new());
        assert_eq!(grades(lost.clone()), [Grade::Failed]);
        lost[0].route = Route::None(vec!["cam0".to_owned()]);
        let text = judge(&lost, &Load::reference())[0].to_string();
        assert!(text.contains("no link on cam0") && text.contains("ip link set cam0 up"), "{text}");
    }
}
