// SPDX-License-Identifier: MIT OR Apache-2.0
//! Real-time priority, cores and locked memory: requested where configured, and what the system refuses is kept as a
//! warning for log, status and recording.
//!
//! The threads of the pixel path are started in several places, one of them inside Aravis: they all take what the
//! process was configured with once ([`configure`]) by calling [`enter_configured`] first.

pub use crate::config::Realtime;

use std::io;
use std::sync::{Mutex, MutexGuard, OnceLock, PoisonError};

/// Something that was requested of the system and refused.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Warning {
    /// `realtime_refused` or `memory_not_locked`: the kind of the recording's event.
    pub kind: &'static str,
    /// What was refused, found and needed.
    pub message: String,
}

static CONFIGURED: OnceLock<Realtime> = OnceLock::new();
static WARNINGS: Mutex<Vec<Warning>> = Mutex::new(Vec::new());

fn kept() -> MutexGuard<'static, Vec<Warning>> {
    // Only pushes happen under the lock: what a panic left is whole.
    WARNINGS.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Sets what [`enter_configured`] requests; the first call of the process counts.
pub fn configure(realtime: &Realtime) {
    CONFIGURED.get_or_init(|| realtime.clone());
}

/// Gives the calling thread what the process was configured with; a refusal becomes a warning. Whether it gets a
/// processor is watched from then on ([`super::run_delay`]).
pub fn enter_configured(role: &str) {
    let Some(realtime) = CONFIGURED.get() else { return };
    super::run_delay::watch(role);
    if let Some(message) = enter(realtime, role) {
        warn("realtime_refused", message);
    }
}

/// Lets the calling thread have what the others leave: for work that must not cost a frame.
pub fn step_back() {
    const LOWEST: libc::c_int = 19;
    // SAFETY: on Linux this sets the nice value of the calling thread; it touches no memory.
    if unsafe { libc::setpriority(libc::PRIO_PROCESS, 0, LOWEST) } != 0 {
        tracing::debug!("nice value {LOWEST} refused: {}", io::Error::last_os_error());
    }
}

/// Keeps a warning, and logs it, unless it is known already.
pub fn warn(kind: &'static str, message: String) {
    let warning = Warning { kind, message };
    let mut kept = kept();
    if !kept.contains(&warning) {
        tracing::warn!(kind, "{}", warning.message);
        kept.push(warning);
    }
}

/// All warnings so far, oldest first.
pub fn warnings() -> Vec<Warning> {
    kept().clone()
}

/// Gives the calling thread its priority and its cores. Returns what was refused, if anything: the same text for
/// every thread that is refused the same.
pub fn enter(realtime: &Realtime, role: &str) -> Option<String> {
    let priority = (realtime.priority > 0).then(|| set_priority(realtime.priority)).and_then(Result::err);
    let cpus = (!realtime.cpus.is_empty()).then(|| set_cpus(&realtime.cpus)).and_then(Result::err);
    let priority = priority.map(|error| {
        format!(
            "real-time priority {} refused ({error}): RLIMIT_RTPRIO is {}, needed {}; set LimitRTPRIO, or grant \
             CAP_SYS_NICE",
            realtime.priority,
            limit_text(soft_limit(libc::RLIMIT_RTPRIO)),
            realtime.priority
        )
    });
    let cpus = cpus.map(|error| {
        format!("cores {:?} refused ({error}); correct realtime.cpus in the node file", realtime.cpus)
    });
    tracing::debug!(role, priority = realtime.priority, cpus = ?realtime.cpus, "thread started");
    let refused: Vec<String> = priority.into_iter().chain(cpus).collect();
    (!refused.is_empty()).then(|| refused.join("; "))
}

fn set_priority(priority: u8) -> io::Result<()> {
    let parameters = libc::sched_param { sched_priority: i32::from(priority) };
    // Threads that this one starts (closing a segment) shall not inherit it.
    let policy = libc::SCHED_FIFO | libc::SCHED_RESET_ON_FORK;
    // SAFETY: 0 is the calling thread, and the parameters live during the call.
    match unsafe { libc::sched_setscheduler(0, policy, &parameters) } {
        0 => Ok(()),
        _ => Err(io::Error::last_os_error()),
    }
}

fn set_cpus(cpus: &[usize]) -> io::Result<()> {
    // SAFETY: a set of cores is plain bits, all zero is the empty one.
    let mut set: libc::cpu_set_t = unsafe { std::mem::zeroed() };
    for &cpu in cpus {
        if cpu >= 8 * size_of::<libc::cpu_set_t>() {
            return Err(io::Error::new(io::ErrorKind::InvalidInput, format!("there is no core {cpu}")));
        }
        // SAFETY: the bit lies in the set, by the check above.
        unsafe { libc::CPU_SET(cpu, &mut set) };
    }
    // SAFETY: 0 is the calling thread, and the set lives during the call and is as long as said.
    match unsafe { libc::sched_setaffinity(0, size_of::<libc::cpu_set_t>(), &set) } {
        0 => Ok(()),
        _ => Err(io::Error::last_os_error()),
    }
}

/// The process's soft limit of a resource; `None`: unlimited, or not known.
pub fn soft_limit(resource: libc::__rlimit_resource_t) -> Option<u64> {
    let mut limit = libc::rlimit { rlim_cur: 0, rlim_max: 0 };
    // SAFETY: the structure lives during the call, which only fills it.
    let code = unsafe { libc::getrlimit(resource, &mut limit) };
    (code == 0 && limit.rlim_cur != libc::RLIM_INFINITY).then_some(limit.rlim_cur)
}

/// A limit of the process as text, `unlimited` where there is none.
pub fn limit_text(limit: Option<u64>) -> String {
    limit.map_or_else(|| "unlimited".to_owned(), |limit| limit.to_string())
}

#[cfg(test)]
mod tests {
    use super::{enter, warn, warnings};
    use crate::config::Realtime;

    #[test]
    fn ordinary_threads_are_refused_nothing() {
        assert_eq!(enter(&Realtime::default(), "test"), None);
    }

    #[test]
    fn cores_are_set_and_absent_ones_are_named() {
        // On a thread of its own: the test runner's keep their cores.
        std::thread::spawn(|| {
            // SAFETY: no arguments.
            let here = usize::try_from(unsafe { libc::sched_getcpu() }).expect("a core");
            let one = Realtime { cpus: vec![here], ..Realtime::default() };
            assert_eq!(enter(&one, "test"), None);
            assert_eq!(std::thread::available_parallelism().expect("known").get(), 1);
            for absent in [1023, 1 << 20] {
                let refused = enter(&Realtime { cpus: vec![absent], ..Realtime::default() }, "test");
                assert!(refused.is_some_and(|text| text.contains(&absent.to_string())));
            }
        })
        .join()
        .expect("the thread ends well");
    }

    #[test]
    fn a_priority_is_set_for_the_thread_alone_or_its_refusal_says_what_is_needed() {
        // SAFETY: plain calls for the calling thread.
        let policy = || unsafe { libc::sched_getscheduler(0) };
        std::thread::spawn(move || match enter(&Realtime { priority: 5, ..Realtime::default() }, "test") {
            None => {
                assert_eq!(policy(), libc::SCHED_FIFO | libc::SCHED_RESET_ON_FORK);
                assert_eq!(std::thread::spawn(policy).join().expect("it ends"), libc::SCHED_OTHER);
            }
            Some(refused) => assert!(refused.contains("RLIMIT_RTPRIO") && refused.contains("needed 5")),
        })
        .join()
        .expect("the thread ends well");
    }

    #[test]
    fn a_warning_is_kept_once() {
        warn("test_refused", "twice".to_owned());
        warn("test_refused", "twice".to_owned());
        assert_eq!(warnings().iter().filter(|w| w.kind == "test_refused").count(), 1);
    }
}
