// SPDX-License-Identifier: MIT OR Apache-2.0
//! Trigger times over the real link: the simulated HSU behind its pty, a bad line, the real `serialport` and
//! conversation, and the fit. The truth is the instant at which the simulator raised each camera edge.

use crossbeam_channel::unbounded;
use fourdbody::base::clock_fit::{ClockFit, Exchange};
use fourdbody::base::ids::NodeId;
use fourdbody::base::time::monotonic_ns;
use fourdbody::hsu::{ArmRequest, Hsu, HsuEvent, HsuTimeouts, HsuTiming, SessionId};
use fourdbody_simulator::hsu::{HsuClock, HsuOptions, LineFaults, SimulatedHsu};
use hsu_firmware_proto::{HeadTiming, Sync};
use std::collections::HashMap;
use std::path::Path;
use std::time::Duration;

/// The train of triggers to measure.
pub struct Train {
    /// How many triggers the train has.
    pub triggers: u64,
    /// Time from one trigger to the next.
    pub period: Duration,
    /// How much faster the unit's clock runs than the host's.
    pub drift_ppm: f64,
    /// What the line does to messages.
    pub line: LineFaults,
    /// Triggers between two questions for the unit's clock.
    pub triggers_per_exchange: u64,
}

/// Errors of the clocks that the train has shown.
pub struct Found {
    /// Error of each trigger's host time as it was known when its report came, ns, in rising order.
    pub errors_ns: Vec<u64>,
    /// The fit at the end.
    pub fit: ClockFit,
}

impl Found {
    /// The error that this share of the triggers does not exceed, microseconds.
    pub fn quantile_us(&self, share: f64) -> f64 {
        let last = self.errors_ns.len().saturating_sub(1);
        self.errors_ns.get((last as f64 * share) as usize).map_or(f64::INFINITY, |ns| *ns as f64 / 1e3)
    }
}

/// Runs a train; the serial device is made at `device`.
pub fn measure(train: &Train, device: &Path) -> Result<Found, Box<dyn std::error::Error>> {
    let (edge, edges) = unbounded();
    let simulated = SimulatedHsu::start(HsuOptions {
        links: vec![device.to_owned()],
        cameras: vec![(0, edge)],
        clock: HsuClock { drift_ppm: train.drift_ppm, ..HsuClock::default() },
        line: Some(train.line),
        ..HsuOptions::default()
    })?;
    let node = NodeId::from("a");
    let hsu = Hsu::connect(device, &node, &HsuTimeouts::default())?;
    let delay_ns = 20_000;
    hsu.configure(&HsuTiming {
        period_ns: u64::try_from(train.period.as_nanos())?,
        sync: Sync::Timer,
        host_silence: Duration::from_secs(2),
        heads: vec![HeadTiming { delay_ns, exposure_ns: 500_000 }],
    })?;
    let mut fit = ClockFit::new();
    for _ in 0..32 {
        ask(&hsu, &mut fit);
    }
    let session = SessionId([7; 16]);
    hsu.arm(&ArmRequest { session, triggers: Some(train.triggers), warm_up: 0, nodes: vec![node] })?;
    hsu.start(session)?;
    let mut known: HashMap<i64, i128> = HashMap::new();
    let (questions, asked) = crossbeam_channel::bounded(1);
    std::thread::scope(|scope| -> Result<(), Box<dyn std::error::Error>> {
        let (answers_in, answers) = unbounded();
        let link = &hsu;
        // In a thread of its own, as in the node: reports are not kept waiting by an answer.
        scope.spawn(move || asked.iter().for_each(|()| drop(answers_in.send(link.query_clock()))));
        // It ends with the sender.
        let questions = questions;
        while let Ok(event) = hsu.events().recv_timeout(Duration::from_secs(10)) {
            let HsuEvent::Trigger { trigger, .. } = event else {
                if matches!(event, HsuEvent::Done { .. }) {
                    break;
                }
                continue;
            };
            fit.heard(trigger.time_ns, monotonic_ns(std::time::Instant::now()));
            let found = fit.host_from_device(i128::from(trigger.time_ns)).ok_or("no fit")?;
            known.insert(trigger.number, found);
            if trigger.number.unsigned_abs() % train.triggers_per_exchange == 0 {
                let _ = questions.try_send(());
            }
            answers.try_iter().flatten().for_each(|sample| enter(&sample, &mut fit));
        }
        Ok(())
    })?;
    let mut errors_ns = Vec::new();
    for edge in edges.try_iter() {
        let truth = i128::from(monotonic_ns(edge.time)) - i128::from(delay_ns);
        errors_ns.extend(known.get(&edge.instant).map(|found| found.abs_diff(truth) as u64));
    }
    drop(hsu);
    drop(simulated);
    errors_ns.sort_unstable();
    Ok(Found { errors_ns, fit })
}

/// One exchange; a lost one is lost.
fn ask(hsu: &Hsu, fit: &mut ClockFit) {
    if let Ok(sample) = hsu.query_clock() {
        enter(&sample, fit);
    }
}

fn enter(sample: &fourdbody::hsu::ClockSample, fit: &mut ClockFit) {
    fit.exchange(&Exchange {
        host_send_ns: monotonic_ns(sample.sent),
        host_receive_ns: monotonic_ns(sample.received),
        device_ns: sample.time_ns,
    });
}
