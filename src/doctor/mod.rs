// SPDX-License-Identifier: MIT OR Apache-2.0
//! Is this host fit for its cameras' rate? Facts are gathered, then judged, then reported one by one.
//!
//! Every part has two halves that do not mix: `gather` touches the system, `judge` is a pure function from
//! facts and [`Load`] to [`Finding`]s. Nothing that is examined is left changed: files that were written are
//! deleted, cameras and HSU are released. Devices that a running node holds are not touched at all: a new connection to
//! an HSU disarms it.

mod devices;
mod disk;
mod finding;
mod host;
mod load;
mod network;
mod node;
mod reverse_path;
mod subnets;
mod usb;

pub use finding::{Finding, Grade, exit_of};
pub use load::Load;

use crate::camera::CameraBackend;
use crate::config::NodeConfig;
use crate::network::{Interface, discover, interfaces};
use network::Route;
use std::net::IpAddr;
use std::path::Path;
use std::time::Duration;

/// How long the doctor waits for cameras to answer a discovery broadcast.
const DISCOVERY_PATIENCE: Duration = Duration::from_millis(700);

/// Examines the host, and with a configuration also the ways to its devices, the disk and the devices. `report`
/// receives every finding as soon as it is known; `disk_progress` receives the elapsed and the whole duration of the
/// disk test. Without a `backend` cameras are not opened.
pub fn examine(
    config: Option<&NodeConfig>,
    mut backend: Option<Box<dyn CameraBackend>>,
    disk_time: Duration,
    disk_progress: &dyn Fn(Duration, Duration),
    mut report: impl FnMut(Finding),
) {
    let load = config.map_or_else(Load::reference, Load::of);
    host::judge(&host::HostFacts::gather(), &load).into_iter().for_each(&mut report);
    let Some(config) = config else { return };
    let port = node::look_at_api(&config.api);
    report(node::judge_port(&port, config.api.listen));
    // A camera that is configured by its Aravis id, or is on USB, is found in a list of all cameras.
    let by_id = config.cameras.iter().any(|camera| camera.address.parse::<IpAddr>().is_err());
    let listed = backend.as_mut().filter(|_| by_id).map_or_else(Vec::new, |backend| backend.list());
    let all = interfaces();
    let paths = network::gather(config, &listed, &all);
    network::judge(&paths, &load).into_iter().for_each(&mut report);
    let mut used: Vec<Interface> = Vec::new();
    for path in &paths {
        if let Route::Direct(at) = &path.route
            && !used.contains(at)
        {
            used.push(at.clone());
        }
    }
    let answers = discover(&all, DISCOVERY_PATIENCE);
    subnets::judge(&all, &used, &answers).into_iter().for_each(&mut report);
    let filters = reverse_path::gather(Path::new("/proc"), &used);
    reverse_path::judge(&filters, &all).into_iter().for_each(&mut report);
    usb::judge(&usb::gather(Path::new("/sys"), config, &listed)).into_iter().for_each(&mut report);
    // A test at full speed would slow the disk of a session that may be running.
    let disk_time = if port.is_held() { Duration::ZERO } else { disk_time };
    let disk = disk::DiskFacts::gather(config, disk_time, disk_progress);
    disk::judge(&disk, &load).into_iter().for_each(&mut report);
    if let node::PortUse::Node(status) = &port {
        return node::judge_status(status).into_iter().for_each(report);
    }
    match backend {
        Some(mut backend) => {
            for camera in &config.cameras {
                let facts = devices::CameraFacts::gather(camera, config, backend.as_mut());
                devices::judge_camera(&facts, &load).into_iter().for_each(&mut report);
            }
        }
        None => report(devices::cameras_not_examined()),
    }
    match config.trigger.action() {
        Some(action) => report(devices::judge_actions(action, config.cameras.len())),
        None => {
            let hsu = devices::HsuFacts::gather(config);
            devices::judge_hsu(&hsu, &load).into_iter().for_each(report);
        }
    }
}
