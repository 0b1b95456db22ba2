// SPDX-License-Identifier: MIT OR Apache-2.0
//! The lock that a node holds during a session, for what must not end one: an upgrade of the package, a restart.
//!
//! It is an advisory lock (flock) on `session.lock` in the service's runtime directory. The kernel releases it with the
//! process, so that it never outlives a node that died. Whoever holds it keeps sessions from beginning: what is asked
//! and what is done are one step (`systemd/restart-between-takes`).

use crate::base::{Exit, Fault, regular};
use std::fs::{File, TryLockError};
use std::io::Write;
use std::path::{Path, PathBuf};

/// The name of the file in the runtime directory.
const NAME: &str = "session.lock";
/// Only the service's user and root: whoever can open the file can keep sessions from beginning.
const MODE: u32 = 0o600;

/// The lock of a node's service; without a service manager there is none, and nothing is held.
#[derive(Debug, Default)]
pub(crate) struct SessionLock {
    file: Option<(File, PathBuf)>,
    held: bool,
}

impl SessionLock {
    /// Opens the lock in the runtime directory that systemd has made for the service (`RUNTIME_DIRECTORY`).
    ///
    /// # Errors
    /// The file cannot be made: an upgrade could then end a session.
    pub(crate) fn of_service() -> std::io::Result<Self> {
        let directories = std::env::var("RUNTIME_DIRECTORY").unwrap_or_default();
        match directories.split(':').next().filter(|first| !first.is_empty()) {
            Some(directory) => Self::at(&Path::new(directory).join(NAME)),
            None => Ok(Self::default()),
        }
    }

    fn at(path: &Path) -> std::io::Result<Self> {
        Ok(Self { file: Some((regular::append(path, MODE)?, path.to_owned())), held: false })
    }

    /// Takes the lock for a session of this name.
    ///
    /// # Errors
    /// Somebody else holds it.
    pub(crate) fn take(&mut self, session: &str) -> Result<(), Fault> {
        let Some((file, path)) = self.file.as_mut().filter(|_| !self.held) else { return Ok(()) };
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                let message = format!(
                    "the node is about to be restarted, by an upgrade or an administrator ({} is locked by another \
                     process); expected no restart: try again in a minute",
                    path.display()
                );
                return Err(Fault::new(Exit::Usage, message));
            }
            // The session counts for more than the lock.
            Err(TryLockError::Error(error)) => {
                tracing::warn!(
                    "{} cannot be locked, an upgrade could end this session: {error}",
                    path.display()
                );
                return Ok(());
            }
        }
        self.held = true;
        // Only for people: the lock itself is what counts.
        let written = file.set_len(0).and_then(|()| writeln!(file, "session {session}"));
        if let Err(error) = written {
            tracing::warn!("{} cannot be written: {error}", path.display());
        }
        Ok(())
    }

    /// Gives it back when no session is under way.
    pub(crate) fn give_back(&mut self) {
        let Some((file, path)) = self.file.as_ref().filter(|_| self.held) else { return };
        self.held = false;
        let given = file.set_len(0).and_then(|()| file.unlock());
        if let Err(error) = given {
            tracing::warn!("{} cannot be unlocked: {error}", path.display());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::SessionLock;
    use std::fs::OpenOptions;
    use std::os::unix::fs::PermissionsExt;

    #[test]
    fn one_of_session_and_restart_holds_the_lock() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let path = dir.path().join("session.lock");
        let mut lock = SessionLock::at(&path).expect("writable");
        let mode = std::fs::metadata(&path).expect("there").permissions().mode();
        assert_eq!(mode & 0o777, 0o600);
        let other = OpenOptions::new().append(true).open(&path).expect("there");
        lock.take("walk").expect("free");
        lock.take("walk").expect("held already");
        assert!(other.try_lock().is_err());
        assert_eq!(std::fs::read_to_string(&path).expect("readable"), "session walk\n");
        lock.give_back();
        assert_eq!(std::fs::read_to_string(&path).expect("readable"), "");
        other.try_lock().expect("free");
        let refused = lock.take("walk").expect_err("a restart is under way").message;
        assert!(refused.contains("restarted") && refused.contains("session.lock"), "{refused}");
        lock.give_back();
        other.unlock().expect("mine");
        lock.take("walk").expect("free again");
    }

    #[test]
    fn without_a_service_manager_nothing_is_held() {
        let mut lock = SessionLock::default();
        lock.take("walk").expect("no lock");
        lock.give_back();
    }
}
