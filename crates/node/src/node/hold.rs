// SPDX-License-Identifier: MIT OR Apache-2.0
//! Whether the memory for a session is there, and seconds before Record: how many frame sets are held for them.

use super::node_thread::Node;
use super::state_machine::Event;
use crate::base::{Exit, Fault};
use crate::config::{NodeConfig, RigCamera};
use crate::control::request::{KeepRequest, Phase, SessionRequest};
use crate::host::frame_memory::block_bytes;
use crate::host::memory;
use crate::host::process_limits::ProcessMemory;
use std::sync::atomic::Ordering;

/// Memory that is left to everything else on this host, bytes.
const LEFT_FREE: u64 = 1 << 30;

/// Number of frame sets to hold: those of the requested seconds and of one second more, for which Record may be on its
/// way from one node to the other.
pub(crate) fn held_sets(request: &SessionRequest, rate_hz: f64) -> usize {
    match usize::try_from(request.pre_triggers).unwrap_or(usize::MAX) {
        0 => 0,
        asked => asked.saturating_add(rate_hz.ceil() as usize),
    }
}

/// Refuses sessions of a node that the limits of this process have no room for; `held`: frame sets that are held
/// before Record.
///
/// # Errors
/// The limit, by name.
pub fn check_limits(config: &NodeConfig, memory: &ProcessMemory, held: u64) -> Result<(), Fault> {
    let bytes = |camera: &RigCamera| {
        let said = config.cameras.iter().find(|said| said.id == camera.id).and_then(|said| said.words.pixel);
        said.unwrap_or_default().sent_bytes((camera.device.width, camera.device.height))
    };
    let cameras = config.rig.cameras_of(&config.node);
    let set_bytes: u64 = cameras.map(|(_, camera)| block_bytes(bytes(camera)) as u64).sum();
    let sets = held.saturating_add(config.buffers_per_camera as u64);
    memory
        .check(config.cameras.len() as u64, set_bytes.saturating_mul(sets))
        .map_err(|fault| Fault { message: format!("node {}: {}", config.node, fault.message), ..fault })
}

impl Node {
    /// Gives back the memory that frames were held in: hours may go by until the next session.
    pub(crate) fn release_held_memory(&self) {
        if self.session.as_ref().is_some_and(|session| session.request.pre_triggers > 0) {
            self.devices.release_memory();
        }
    }

    /// Refuses a session that does not fit into what this process may have, or whose frames of before Record do not
    /// fit into what this host has left.
    pub(crate) fn check_memory(&self) -> Result<(), Fault> {
        let Some(session) = &self.session else { return Ok(()) };
        let rate_hz = self.config.rig.trigger_rate_hz;
        let sets = held_sets(&session.request, rate_hz) as u64;
        check_limits(&self.config, &self.memory, sets)?;
        let Some(available) = memory::available().filter(|_| sets > 0) else { return Ok(()) };
        let set_bytes: u64 =
            session.cameras.iter().map(|camera| block_bytes(camera.contract.received_bytes()) as u64).sum();
        let ordinary = self.config.buffers_per_camera as u64;
        // What the node has from earlier sessions is not taken once more.
        let has = self.devices.idle_bytes();
        let may = available.saturating_sub(LEFT_FREE).saturating_add(has);
        let refused = refusal(set_bytes, sets, ordinary, rate_hz, may);
        refused
            .map_or(Ok(()), |why| Err(Fault::new(Exit::Usage, format!("node {}: {why}", self.config.node))))
    }

    /// Record was pressed: the recording begins at a trigger of the past.
    pub(crate) fn keep(&mut self, request: &KeepRequest) -> Result<(), Fault> {
        let usage = |message: String| Err(Fault::new(Exit::Usage, message));
        let ours = self.machine.request().is_some_and(|ours| ours.session_id == request.session_id);
        let Some(session) = self.session.as_ref().filter(|_| ours) else {
            return usage("the node is not in this session".to_owned());
        };
        let phase = self.machine.phase();
        if phase != Phase::Holding {
            return usage(format!("the session is {phase:?}; expected one that holds frames before Record"));
        }
        let KeepRequest { first, pressed, .. } = *request;
        let end = session.progress.held_to.load(Ordering::Relaxed);
        // Where Record was pressed is what another node had: this one may be a little behind.
        if first > end || pressed < first {
            return usage(format!(
                "a recording from trigger {first} on, with Record at {pressed}; expected held triggers, up to {end}"
            ));
        }
        self.in_session(|session| session.kept = Some(*request));
        self.take(Event::Keep(*request));
        Ok(())
    }
}

/// Why this many frame sets cannot be held beside the ordinary ones, in `may` bytes of memory.
fn refusal(set_bytes: u64, sets: u64, ordinary: u64, rate_hz: f64, may: u64) -> Option<String> {
    let needed = set_bytes.saturating_mul(sets.saturating_add(ordinary));
    let fits = (may / set_bytes.max(1)).saturating_sub(ordinary);
    // Without the second that is held beyond the requested ones.
    let seconds = |sets: u64| (sets as f64 / rate_hz - 1.0).max(0.0);
    (needed > may).then(|| {
        format!(
            "{:.1} s before Record need {} MiB of memory for frames; expected at most {} MiB, so that 1 GiB stays \
             free: at most {:.1} s",
            seconds(sets),
            needed >> 20,
            may >> 20,
            (seconds(fits) * 10.0).floor() / 10.0
        )
    })
}

#[cfg(test)]
mod tests {
    use super::refusal;

    #[test]
    fn what_does_not_fit_is_refused_with_what_would() {
        // Four cameras of 1920 x 1200 at 120 Hz: 11 GB for ten seconds.
        let set = 4 * (1920 * 1200 + 4096);
        assert_eq!(refusal(set, 11 * 120, 64, 120.0, 14 << 30), None);
        let told = refusal(set, 11 * 120, 64, 120.0, 8 << 30).expect("8 GiB are too few");
        assert!(told.contains("10.0 s before Record need 12185 MiB"), "{told}");
        assert!(told.contains("at most 8192 MiB") && told.contains("at most 6.2 s"), "{told}");
        let told = refusal(u64::MAX, u64::MAX, 64, 120.0, 0).expect("nothing fits");
        assert!(told.contains("at most 0.0 s"), "{told}");
    }
}
