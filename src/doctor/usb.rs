// SPDX-License-Identifier: MIT OR Apache-2.0
//! Memory that the kernel gives to USB transfers: 16 MiB by default, less than a few frames of several cameras.

use super::finding::{Check, Finding, Grade};
use super::network::sent_bytes;
use crate::camera::CameraListing;
use crate::config::{CameraConfig, NodeConfig};
use std::path::Path;

/// Transfers that Aravis keeps under way for each stream, bytes; a frame that is being taken comes on top.
const UNDER_WAY: u64 = 8 << 20;

/// USB3 cameras of a node, and the memory for their transfers.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct UsbFacts {
    /// Bytes of a frame of each of them.
    pub frames: Vec<u64>,
    /// `usbfs_memory_mb`, MiB; 0 is unlimited, `None` where it cannot be read.
    pub memory_mb: Option<u64>,
}

/// Finds which of the node's cameras discovery `listed` on USB, and reads the limit below `sys`, which is `/sys`.
pub fn gather(sys: &Path, config: &NodeConfig, listed: &[CameraListing]) -> UsbFacts {
    let on_usb = |camera: &&CameraConfig| {
        let is_it = |known: &CameraListing| [&known.id, &known.address].contains(&&camera.address);
        listed.iter().any(|known| known.protocol == "USB3Vision" && is_it(known))
    };
    let cameras = config.cameras.iter().filter(on_usb);
    UsbFacts { frames: cameras.map(|camera| sent_bytes(config, camera)).collect(), memory_mb: memory_mb(sys) }
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
    let needed_mb = facts.frames.iter().map(|frame| frame + UNDER_WAY).sum::<u64>().div_ceil(1 << 20);
    let cameras = facts.frames.len();
    let (grade, found) = match facts.memory_mb {
        Some(0) => (Grade::Ok, "unlimited".to_owned()),
        Some(mb) if mb < needed_mb => (Grade::Failed, format!("{mb} MiB")),
        Some(mb) => (Grade::Ok, format!("{mb} MiB for {cameras} USB3 cameras")),
        None => (Grade::Warning, "cannot be read".to_owned()),
    };
    let advice = "`echo 1000 > /sys/module/usbcore/parameters/usbfs_memory_mb`, for good as \
        usbcore.usbfs_memory_mb=1000 on the kernel's command line";
    let expected = format!("at least {needed_mb} MiB for {cameras} USB3 cameras");
    Some(Check::host("usbfs memory").graded(grade, found, expected, advice))
}

#[cfg(test)]
mod tests {
    use super::{UsbFacts, judge, memory_mb};
    use crate::doctor::finding::Grade;

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
