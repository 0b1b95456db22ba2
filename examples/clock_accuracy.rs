//! How well trigger times are known, end to end: the simulated HSU behind its pty, the real `serialport` and link, and
//! the fit. The truth is the instant at which the simulator raised each camera edge.
//!
//!     clock_accuracy [TRIGGERS] [PERIOD_US] [DRIFT_PPM]

use crossbeam_channel::unbounded;
use fourdbody::acquire::clock::{ClockFit, Exchange};
use fourdbody::hsu::{ArmRequest, Hsu, HsuEvent, HsuTimeouts, HsuTiming, SessionId};
use fourdbody::ids::NodeId;
use fourdbody::time::monotonic_ns;
use fourdbody_simulator::hsu::{HsuClock, HsuOptions, SimulatedHsu};
use hsu_firmware_proto::{HeadTiming, Sync};
use std::collections::HashMap;
use std::time::{Duration, Instant};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1).map(|text| text.parse::<f64>());
    let mut argument = |default: f64| arguments.next().unwrap_or(Ok(default));
    let (triggers, period_us, drift_ppm) = (argument(5_000.0)? as u64, argument(8_333.0)?, argument(100.0)?);
    let path = std::env::temp_dir().join(format!("clock-accuracy-{}", std::process::id()));
    let (edge, edges) = unbounded();
    let simulated = SimulatedHsu::start(HsuOptions {
        links: vec![path.clone()],
        cameras: vec![(0, edge)],
        clock: HsuClock { drift_ppm, ..HsuClock::default() },
        ..HsuOptions::default()
    })?;
    let node = NodeId::from("a");
    let hsu = Hsu::connect(&path, &node, &HsuTimeouts::default())?;
    let delay_ns = 20_000;
    hsu.configure(&HsuTiming {
        period_ns: (period_us * 1e3) as u64,
        sync: Sync::Timer,
        host_silence: Duration::from_secs(2),
        heads: vec![HeadTiming { delay_ns, exposure_ns: 500_000 }],
    })?;
    let mut fit = ClockFit::new();
    for _ in 0..32 {
        ask(&hsu, &mut fit);
    }
    let session = SessionId([7; 16]);
    hsu.arm(&ArmRequest { session, triggers: Some(triggers), warm_up: 0, nodes: vec![node] })?;
    hsu.start(session)?;
    let mut known: HashMap<i64, i128> = HashMap::new();
    let mut asked = Instant::now();
    while let Ok(event) = hsu.events().recv_timeout(Duration::from_secs(10)) {
        match event {
            HsuEvent::Trigger { trigger, .. } => {
                fit.heard(trigger.time_ns, monotonic_ns(Instant::now()));
                let found = fit.host_from_device(i128::from(trigger.time_ns)).ok_or("no fit")?;
                known.insert(trigger.number, found);
            }
            HsuEvent::Done { .. } => break,
            _ => {}
        }
        if asked.elapsed() >= Duration::from_secs(1) {
            ask(&hsu, &mut fit);
            asked = Instant::now();
        }
    }
    let mut errors: Vec<u64> = Vec::new();
    for edge in edges.try_iter() {
        let truth = i128::from(monotonic_ns(edge.time)) - i128::from(delay_ns);
        errors.extend(known.get(&edge.instant).map(|found| found.abs_diff(truth) as u64));
    }
    drop(simulated);
    errors.sort_unstable();
    let last = errors.len().checked_sub(1).ok_or("no trigger was seen")?;
    let at = |share: f64| errors[(last as f64 * share) as usize] as f64 / 1e3;
    println!(
        "{} of {triggers} triggers: median {:.1} us, P99.9 {:.1} us, max {:.1} us; drift {:.2} ppm, {} exchanges, {} left out",
        errors.len(),
        at(0.5),
        at(0.999),
        at(1.0),
        fit.drift_ppm().unwrap_or_default(),
        fit.used(),
        fit.left_out()
    );
    Ok(())
}

/// One exchange; a lost one is lost.
fn ask(hsu: &Hsu, fit: &mut ClockFit) {
    if let Ok(sample) = hsu.query_clock() {
        fit.exchange(&Exchange {
            host_send_ns: monotonic_ns(sample.sent),
            host_receive_ns: monotonic_ns(sample.received),
            device_ns: sample.time_ns,
        });
    }
}
