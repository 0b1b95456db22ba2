// SPDX-License-Identifier: MIT OR Apache-2.0
//! What `fourdbody-sim lab` runs: nodes that show a live body, and the faults that one can type.

use crate::lab::{FOURDBODY, host, own_network, turn};
use fourdbody::control::client::NodeClient;
use fourdbody::control::request::Phase;
use fourdbody::control::status::path;
use fourdbody_simulator::cmds::lab::{Args, Lab};
use fourdbody_simulator::sequence::{Changes, Run};
use std::path::Path;
use std::time::{Duration, Instant};

fn wait_until(what: &str, holds: impl Fn() -> bool) {
    let deadline = Instant::now() + Duration::from_secs(60);
    while !holds() {
        assert!(Instant::now() < deadline, "waited in vain until {what}");
        std::thread::sleep(Duration::from_millis(100));
    }
}

/// A quarter of the size, two instants. Six seconds.
#[test]
fn a_laboratory_in_one_command_shows_a_body_and_obeys() {
    let _turn = turn();
    let dir = tempfile::tempdir().expect("a temporary directory");
    let scenario = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/scenarios/lab.toml");
    let changes = Changes { size_divisor: 4, instants: Some(2), ..Changes::default() };
    let frames = dir.path().join("frames");
    Run::load(&scenario, &changes).expect("fits").render(&frames, |_, _| ()).expect("rendered");
    let args = Args {
        dir: dir.path().to_owned(),
        frames: Some(frames.clone()),
        rate_hz: 5.0,
        first_address: host(own_network(), 11),
        first_port: 0,
        program: Some(FOURDBODY.into()),
        no_preview: false,
    };
    let mut lab = Lab::start(&args, dir.path(), &frames).expect("starts");
    let wait = |patience| {
        std::thread::sleep(patience);
        false
    };
    let url = lab.console(wait).expect("ready").expect("not ended");
    let client = NodeClient::new(&url);
    // As an open page does.
    let look =
        || client.post(path::PREVIEW, &serde_json::Value::Null, Duration::from_secs(5)).expect("a preview");
    let running =
        || client.status().is_ok_and(|status| status.is_in_preview() && status.phase == Phase::Running);
    wait_until("the cameras run", || {
        look();
        running()
    });
    let body = || {
        look();
        client.fetch("/api/v1/live?after=0", Duration::from_secs(5))
    };
    wait_until("a body is shown", || body().is_ok_and(|body| body.is_some_and(|bytes| bytes.len() > 1000)));

    assert_eq!(lab.obey("camera h0_up").as_deref(), Ok("camera h0_up is unplugged"));
    assert_eq!(lab.obey("camera h0_up").as_deref(), Ok("camera h0_up is plugged in"));
    assert!(lab.obey("camera h9").is_err_and(|reason| reason.contains("h0_up, h0_low")));
    assert!(lab.obey("break everything").is_err());
    assert_eq!(lab.obey("node a").as_deref(), Ok("node a was killed"));
    assert!(client.status().is_err());
    assert_eq!(lab.obey("node a").as_deref(), Ok("node a is started"));
    wait_until("the node is back", || client.status().is_ok());
    assert_eq!(lab.obey("line a").as_deref(), Ok("the line of node a to the HSU is cut"));
    wait_until("the line is missed", || client.status().is_ok_and(|status| status.hsu.problem.is_some()));
    if let Ok(done) = lab.obey("disk a") {
        assert_eq!(done, "the disk of node a is full");
        wait_until("the disk is full", || client.status().is_ok_and(|status| status.free_bytes == 0));
    }
    drop(lab);
    assert!(client.status().is_err(), "the nodes end with the laboratory");
}
