// SPDX-License-Identifier: MIT OR Apache-2.0
//! Memory that the kernel gives to USB transfers: 16 MiB by default, less than a few frames of several cameras.

use super::{Check, Finding};
use crate::camera::CameraListing;
use crate::config::NodeConfig;
use std::path::Path;

/// Transfers that Aravis keeps under way for each stream, bytes; and one frame that is being taken.
const UNDER_WAY: u64 = 8 << 20;

/// USB3 cameras of a node, and the memory for their transfers.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct UsbFacts {
    /// Bytes of a frame of each of them.
    pub frames: Vec<u64>,
    /// `usbfs_memory_mb`; 0: no limit. `None`: cannot be read.
    pub memory_mb: Option<u64>,
}

/// Looks which of the node's cameras are on USB (by what discovery listed), below `sys`, which is `/sys`.
pub fn gather(sys: &Path, config: &NodeConfig, listed: &[CameraListing]) -> UsbFacts {
    let on_usb = |address: &str| {
        listed
            .iter()
            .any(|known| known.protocol == "USB3Vision" && (known.id == address || known.address == address))
    };
    let size = |camera: &crate::config::CameraConfig| {
        let known = config.rig.cameras().find(|(_, known)| known.id == camera.id);
        let pixel = camera.words.pixel.unwrap_or_default();
        known.map_or(0, |(_, known)| pixel.sent_bytes((known.device.width, known.device.height)) as u64)
    };
    UsbFacts {
        frames: config.cameras.iter().filter(|camera| on_usb(&camera.address)).map(size).collect(),
        memory_mb: memory_mb(sys),
    }
}

fn memory_mb(sys: &Path) -> Option<u64> {
    let text = std::fs::read_to_string(sys.join("module/usbcore/parameters/usbfs_memory_mb")).ok()?;
    text.trim().parse().ok()
}

/// The verdict; none where no camera is on USB.
pub fn judge(facts: &UsbFacts) -> Option<Finding> {
    if facts.frames.is_empty() {
        return None;
    }
    let check = Check::host("usbfs memory");
    let needed: u64 = facts.frames.iter().map(|frame| frame + UNDER_WAY).sum();
    let needed_mb = needed.div_ceil(1 << 20);
    let cameras = facts.frames.len();
    let expected = format!("at least {needed_mb} MiB for {cameras} USB3 cameras");
    let advice = "`echo 1000 > /sys/module/usbcore/parameters/usbfs_memory_mb`, for good as usbcore.usbfs_memory_mb=1000 on \
                  the kernel's command line";
    Some(match facts.memory_mb {
        Some(0) => check.ok("without a limit"),
        Some(mb) if mb < needed_mb => check.failed(format!("{mb} MiB"), expected, advice),
        Some(mb) => check.ok(format!("{mb} MiB for {cameras} USB3 cameras")),
        None => check.warning("cannot be read", expected, advice),
    })
}

#[cfg(test)]
mod tests {
    use super::{UsbFacts, judge, memory_mb};
    use crate::doctor::Grade;

    #[test]
    fn the_kernels_own_limit_is_too_low_for_two_cameras() {
        let sys = tempfile::tempdir().expect("a temporary directory");
        let grade = |cameras: usize| {
            let facts = UsbFacts { frames: vec![1920 * 1200; cameras], memory_mb: memory_mb(sys.path()) };
            judge(&facts).map(|finding| finding.grade)
        };
        assert_eq!((grade(0), grade(1)), (None, Some(Grade::Warning)), "nothing to be read");
        let dir = sys.path().join("module/usbcore/parameters");
        std::fs::create_dir_all(&dir).expect("a directory");
        let write = |text| std::fs::write(dir.join("usbfs_memory_mb"), text).expect("writable");
        write("16\n");
        assert_eq!((grade(1), grade(2)), (Some(Grade::Ok), Some(Grade::Failed)));
        write("1000\n");
        assert_eq!(grade(4), Some(Grade::Ok));
        write("0\n");
        assert_eq!(grade(4), Some(Grade::Ok), "no limit");
    }
}
