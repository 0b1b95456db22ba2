// SPDX-License-Identifier: MIT OR Apache-2.0
//! A node under a limit on its memory: it refuses what has no room, by name, and lives.

use crate::api_node::write_config;
use crate::lab::{FOURDBODY, assert_contains, fourdbody, laboratory, start_nodes, text_of};
use std::os::unix::process::CommandExt;
use std::process::{Command, Stdio};

const MIB: u64 = 1 << 20;

#[test]
fn a_node_that_has_no_room_for_a_session_does_not_start() {
    let dir = tempfile::tempdir().expect("a directory");
    let config = write_config(dir.path(), "listen = \"127.0.0.1:0\"\n");
    for (what, mib, expected) in [
        (libc::RLIMIT_AS, 900, ["RLIMIT_AS", "LimitAS"]),
        (libc::RLIMIT_DATA, 300, ["RLIMIT_DATA", "LimitDATA"]),
    ] {
        let mut command = Command::new(FOURDBODY);
        command.args(["node", "--config"]).arg(&config).stdin(Stdio::null());
        // SAFETY: only a system call, between fork and exec.
        unsafe {
            command.pre_exec(move || {
                let limit = libc::rlimit { rlim_cur: mib * MIB, rlim_max: mib * MIB };
                match libc::setrlimit(what, &raw const limit) {
                    0 => Ok(()),
                    _ => Err(std::io::Error::last_os_error()),
                }
            });
        }
        let output = command.output().expect("it ends");
        assert_eq!(output.status.code(), Some(2), "{:?}: {}", output.status, text_of(&output));
        assert_contains(&text_of(&output), &expected);
        assert_contains(&text_of(&output), &["node a: ", "buffers_per_camera", &format!("{mib} MiB")]);
    }
}

#[test]
fn a_session_that_a_limit_has_no_room_for_is_refused_and_the_node_lives() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = laboratory(dir.path(), 20.0);
    let mut nodes = start_nodes(&laboratory);
    let pid = libc::pid_t::try_from(nodes[0].pid()).expect("a process id");
    let limit = |bytes: u64| {
        let limit = libc::rlimit { rlim_cur: bytes, rlim_max: libc::RLIM_INFINITY };
        // SAFETY: `limit` lives for the duration of the call, and nothing is asked back.
        assert_eq!(unsafe { libc::prlimit(pid, libc::RLIMIT_AS, &limit, std::ptr::null_mut()) }, 0);
    };
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).expect("it runs");
    let size = status.lines().find_map(|line| line.strip_prefix("VmSize:")).expect("a size");
    let size: u64 = size.trim().trim_end_matches(" kB").parse().expect("a number");
    let capture = |name: &str| {
        fourdbody(&["capture", "--nodes", &laboratory.urls(), "--triggers", "10", "--name", name])
    };
    // Room for what is there and a little more.
    limit(size * 1024 + 40 * MIB);
    let refused = capture("refused");
    assert_eq!(refused.status.code(), Some(2), "{}", text_of(&refused));
    assert_contains(&text_of(&refused), &["node a: ", "RLIMIT_AS", "LimitAS"]);
    // What is said to be enough is enough, for one session after the other.
    let text = text_of(&refused);
    let (_, enough) = text.split_once("expected at least ").expect("how much");
    let enough: u64 = enough.split(' ').next().and_then(|mib| mib.parse().ok()).expect("a number");
    limit(enough * MIB);
    for name in ["fits", "fits-again"] {
        let captured = capture(name);
        assert_eq!(captured.status.code(), Some(0), "{}", text_of(&captured));
    }
    limit(libc::RLIM_INFINITY);
    nodes.iter_mut().for_each(|node| drop(node.wait_ready()));
    let captured = capture("captured");
    assert_eq!(captured.status.code(), Some(0), "{}", text_of(&captured));
}
