// SPDX-License-Identifier: MIT OR Apache-2.0
//! A disk that misbehaves by a plan: a directory seen through FUSE, so that the real node records onto it.
//!
//! ```text
//! node -> kernel -> [passthrough] -> backing directory
//!                        |  each call: how long, how much, or an error
//!                    [medium] <- [plan] (seed, node)      [unsynced]: what a failed fdatasync loses
//!                        `-> faults.jsonl (crate::faults::DiskEvent)
//! ```
//!
//! Needs `/dev/fuse` and the right to mount; [`SimulatedDisk::unavailable`] reports whether both are there.
//! `docs/design/faults.md` has what each fault is and what a recording must state about it.

mod medium;
mod nodes;
mod passthrough;
pub mod plan;
mod unsynced;

pub use plan::{Amount, DiskPlan, DiskPlanError, Full, IoFault, Operation, ReadFault, Slow};

use crate::faults::TruthLog;
use fuser::{BackgroundSession, Config, MountOption};
use medium::Medium;
use passthrough::{Passthrough, Shared};
use std::ffi::CString;
use std::io;
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// A writer that waits for a slow disk must not keep readers waiting.
const THREADS: usize = 4;

/// A mounted disk; unmounted when dropped.
pub struct SimulatedDisk {
    mount_point: PathBuf,
    shared: Arc<Shared>,
    /// The mounted session; `None` once it is dropped.
    session: Option<BackgroundSession>,
}

impl SimulatedDisk {
    /// Why no disk can be simulated here, if so.
    pub fn unavailable() -> Option<String> {
        let device = Path::new("/dev/fuse");
        if let Err(error) = std::fs::OpenOptions::new().read(true).write(true).open(device) {
            return Some(format!("{}: {error}", device.display()));
        }
        // SAFETY: the call only returns a number.
        (unsafe { libc::geteuid() } != 0).then(|| "mounting needs root".to_owned())
    }

    /// Mounts the disk of `node` at `mount_point`; what is written there lies in `backing`, where it can be read as
    /// from a disk that was moved to a sound computer. Both directories are made if needed.
    ///
    /// # Errors
    /// What the system says.
    pub fn mount(
        plan: &DiskPlan,
        node: &str,
        backing: &Path,
        mount_point: &Path,
        truth: Option<Arc<TruthLog>>,
    ) -> io::Result<Self> {
        plan.check().map_err(|e| io::Error::new(io::ErrorKind::InvalidInput, e))?;
        // A simulator that was killed has left its mount behind; no process answers there any more.
        while std::fs::metadata(mount_point).is_err_and(|e| e.raw_os_error() == Some(libc::ENOTCONN)) {
            detach(mount_point)?;
        }
        for dir in [backing, mount_point] {
            std::fs::create_dir_all(dir)?;
        }
        let medium = Medium::new(plan.drawn(node));
        let shared = Arc::new(Shared::new(backing.canonicalize()?, node, medium, plan.fallocate, truth));
        shared.set_unreadable(plan.unreadable.clone());
        let mut config = Config::default();
        config.mount_options =
            vec![MountOption::FSName("fourdbody-sim".to_owned()), MountOption::NoDev, MountOption::NoSuid];
        config.n_threads = Some(THREADS);
        let session = fuser::spawn_mount(Passthrough(Arc::clone(&shared)), mount_point, &config)?;
        Ok(Self { mount_point: mount_point.to_owned(), shared, session: Some(session) })
    }

    /// The directory at which the disk is mounted.
    pub fn mount_point(&self) -> &Path {
        &self.mount_point
    }

    /// What cannot be read from now on, instead of what the plan has; `path` is below the mount point.
    pub fn set_unreadable(&self, faults: Vec<ReadFault>) {
        self.shared.set_unreadable(faults);
    }

    /// There is no room on the disk from now on, until it is repaired.
    pub fn fill(&self) {
        self.shared.fill();
    }

    /// Ends all faults: from now on the disk is sound.
    pub fn repair(&self) {
        self.shared.repair();
    }
}

impl Drop for SimulatedDisk {
    fn drop(&mut self) {
        // Files may still be open: without this the mount would stay, and whoever looks at it would wait.
        if let Err(error) = detach(&self.mount_point) {
            tracing::warn!(path = %self.mount_point.display(), %error, "the simulated disk stays mounted");
        }
        drop(self.session.take());
    }
}

fn detach(mount_point: &Path) -> io::Result<()> {
    let path = CString::new(mount_point.as_os_str().as_bytes())?;
    // SAFETY: the path is a C string that lives for the duration of the call.
    match unsafe { libc::umount2(path.as_ptr(), libc::MNT_DETACH) } {
        0 => Ok(()),
        _ => Err(io::Error::last_os_error()),
    }
}

#[cfg(test)]
mod tests;
