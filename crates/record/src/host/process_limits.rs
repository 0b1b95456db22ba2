// SPDX-License-Identifier: MIT OR Apache-2.0
//! Limits on the memory of this process (`ulimit -v`, `ulimit -d`): whether a session fits, before it begins.
//!
//! Libraries that this program stands on end the process where they get no memory: a thread that cannot be started, a
//! list that cannot grow. So nothing is begun that a limit has no room for. What the process had before its first
//! session is what the rest is measured from: what a session leaves behind is used again by the next one.

use super::memory::bytes_of;
use super::realtime::soft_limit;
use crate::base::{Exit, Fault, regular};
use std::path::Path;

const MIB: u64 = 1 << 20;

/// Threads of a camera: its receiver, its attendant, and two of Aravis.
const THREADS_PER_CAMERA: u64 = 4;
/// Threads of a session: recorder, writer, disks, the link to the HSU, the API, previews, the live body.
const THREADS: u64 = 12;
/// Address space of a thread's stack, bytes: the default of glibc.
const STACK_BYTES: u64 = 8 * MIB;
/// Address space of an arena of the allocator, bytes; it writes to a small part of it.
const ARENA_BYTES: u64 = 64 * MIB;
/// Arenas for each core, at most: the default of glibc.
const ARENAS_PER_CORE: u64 = 8;
/// Memory that a thread holds beside its stack, bytes, estimated.
const HEAP_BYTES: u64 = 2 * MIB;
/// Chunks on their way to the disk, packets of cameras and tables, bytes, estimated.
const REST_BYTES: u64 = 256 * MIB;

/// The sizes of this process that limits apply to, bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Counted {
    address_space: u64,
    data: u64,
}

impl Counted {
    /// From the text of `/proc/self/status`.
    fn in_status(text: &str) -> Option<Self> {
        Some(Self { address_space: bytes_of("VmSize:", text)?, data: bytes_of("VmData:", text)? })
    }
}

/// The process as it was before its first session.
#[derive(Debug, Clone, Copy)]
pub struct ProcessMemory {
    at_start: Option<Counted>,
}

impl ProcessMemory {
    /// Reads what the process has at this moment.
    pub fn at_start() -> Self {
        let text = regular::read_text(Path::new("/proc/self/status"), MIB);
        Self { at_start: text.ok().and_then(|text| Counted::in_status(&text)) }
    }

    /// Refuses a session of `cameras` cameras with `frame_bytes` bytes of memory for frames, if the present limits of
    /// the process have no room for it.
    ///
    /// # Errors
    /// The limit by name, what it is and what it would have to be.
    pub fn check(&self, cameras: u64, frame_bytes: u64) -> Result<(), Fault> {
        // Where the system does not report what the process has, nothing is refused.
        let Some(at_start) = self.at_start else { return Ok(()) };
        let cores = std::thread::available_parallelism().map_or(1, std::num::NonZero::get) as u64;
        let limits =
            Limits { address_space: soft_limit(libc::RLIMIT_AS), data: soft_limit(libc::RLIMIT_DATA) };
        refusal(at_start, limits, cores, cameras, frame_bytes)
            .map_or(Ok(()), |why| Err(Fault::new(Exit::Usage, why)))
    }
}

/// Limits of the process, bytes; `None` where there is none.
#[derive(Debug, Clone, Copy)]
struct Limits {
    address_space: Option<u64>,
    data: Option<u64>,
}

fn refusal(at_start: Counted, limits: Limits, cores: u64, cameras: u64, frame_bytes: u64) -> Option<String> {
    let threads = THREADS + THREADS_PER_CAMERA.saturating_mul(cameras);
    let common = (REST_BYTES + threads * STACK_BYTES).saturating_add(frame_bytes);
    let arenas = threads.min(ARENAS_PER_CORE * cores) * ARENA_BYTES;
    let of = [
        (["RLIMIT_AS", "LimitAS", "ulimit -v"], limits.address_space, at_start.address_space, arenas),
        (["RLIMIT_DATA", "LimitDATA", "ulimit -d"], limits.data, at_start.data, threads * HEAP_BYTES),
    ];
    of.into_iter().find_map(|([name, unit, shell], limit, had, more)| {
        let (limit, needed) = (limit?, had.saturating_add(common.saturating_add(more)));
        (limit < needed).then(|| {
            format!(
                "{name} lets this process have {} MiB, expected at least {} MiB for a session of {cameras} cameras, {} \
                 MiB of them for frames; raise it ({unit} of the unit, {shell}), or lower \
                 acquisition.buffers_per_camera",
                limit / MIB,
                needed.div_ceil(MIB),
                frame_bytes.div_ceil(MIB)
            )
        })
    })
}

#[cfg(test)]
mod tests {
    use super::{Counted, Limits, MIB, ProcessMemory, refusal};

    #[test]
    fn what_a_limit_has_no_room_for_is_refused_by_name() {
        let text = "Name:\tx\nVmPeak:\t 9 kB\nVmSize:\t 102400 kB\nVmLck:\t0 kB\nVmData:\t   51200 kB\n";
        let at_start = Counted::in_status(text).expect("both lines");
        assert_eq!(at_start, Counted { address_space: 100 * MIB, data: 50 * MIB });
        assert_eq!(Counted::in_status("VmSize: 1 kB\n"), None);
        let refusal_of = |address_space: Option<u64>, data: Option<u64>| {
            let [address_space, data] = [address_space, data].map(|mib| mib.map(|mib| mib * MIB));
            refusal(at_start, Limits { address_space, data }, 2, 4, 600 * MIB)
        };
        // 28 threads: 224 MiB of stacks; 16 arenas of 64 MiB.
        assert_eq!((refusal_of(None, None), refusal_of(Some(2204), Some(1186))), (None, None));
        let refused = refusal_of(Some(2203), None).expect("too little");
        assert!(
            refused.contains("RLIMIT_AS lets this process have 2203 MiB, expected at least 2204 MiB"),
            "{refused}"
        );
        assert!(refused.contains("600 MiB of them for frames") && refused.contains("LimitAS"), "{refused}");
        assert!(refusal_of(None, Some(1185)).expect("too little").contains("RLIMIT_DATA"));
        assert_eq!(ProcessMemory::at_start().check(1, 0), Ok(()), "tests run without limits");
    }
}
