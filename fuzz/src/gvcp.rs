// SPDX-License-Identifier: MIT OR Apache-2.0
//! The simulated camera's control channel.

use super::Script;
use fourdbody_simulator::gige::control::{Action, Control};
use fourdbody_simulator::gige::registers::{Identity, Registers};
use fourdbody_simulator::gige::{CameraClock, ClockOptions, Habits};
use std::net::{Ipv4Addr, SocketAddrV4};
use std::sync::Arc;
use std::time::{Duration, Instant};

const SENSOR: (u32, u32) = (1920, 1200);
/// Largest GVCP packet that the standard allows without fragments, less its header.
const ANSWER_MAX: usize = 8 + 540;

/// A script of datagrams from four senders, and time between them: `sender, wait, length, bytes`.
///
/// Holds: answers are short and acknowledge their command; starts and stops alternate and agree with what the
/// device says of itself; a stream never gets an image that the sensor does not have.
pub fn control(data: &[u8]) {
    let mut now = Instant::now();
    let clock = CameraClock::new(now, ClockOptions { offset_ns: 5, drift_ppm: 0.0 });
    let identity = Identity {
        address: Ipv4Addr::new(127, 0, 7, 11),
        model: "Model".into(),
        serial: "S1".into(),
        user_name: "left".into(),
    };
    let mut control = Control::new(Registers::new(identity, SENSOR, Arc::new(clock), Habits::default()));
    let mut running = false;
    let mut script = Script(data);
    while let Some(sender) = script.byte() {
        now += Duration::from_millis(8 * u64::from(script.byte().unwrap_or(0)));
        let length = script.word().unwrap_or(0);
        let datagram = script.bytes(usize::from(length).min(2000));
        let from = SocketAddrV4::new(Ipv4Addr::LOCALHOST, 1000 + u16::from(sender % 4));
        let outcome = control.handle(datagram, from, now);
        if let Some(answer) = &outcome.answer {
            assert!((8..=ANSWER_MAX).contains(&answer.len()), "{} bytes", answer.len());
            assert_eq!(usize::from(u16::from_be_bytes([answer[4], answer[5]])), answer.len() - 8);
            if let Some(id) = datagram.get(6..8) {
                assert_eq!(&answer[6..8], id, "the request's id");
            }
        }
        for action in &outcome.actions {
            match action {
                Action::Start(stream) | Action::Update(stream) => {
                    if matches!(action, Action::Start(_)) {
                        assert!(!running, "a second start");
                        running = true;
                    }
                    assert!((16..=SENSOR.0).contains(&stream.layout.width));
                    assert!((1..=SENSOR.1).contains(&stream.layout.height));
                    assert!(stream.settings.exposure() >= Duration::from_micros(10));
                }
                Action::Stop => running = false,
                _ => {}
            }
        }
        assert_eq!(running, control.acquiring());
    }
}
