// SPDX-License-Identifier: MIT OR Apache-2.0
//! Trigger times over a line that holds every message up, measured against the simulator's own edges.

#[path = "../../examples/clock_accuracy/measure.rs"]
mod measure;

use fourdbody_simulator::hsu::LineFaults;
use measure::{Train, measure};
use std::time::Duration;

/// Four times the pace of a session, so that a minute of it passes in a quarter; the error is compared with the
/// jitter that is injected.
#[test]
fn trigger_times_over_a_jittery_line_are_known_to_a_fraction_of_the_jitter() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let jitter = Duration::from_millis(2);
    let train = Train {
        triggers: 4_000,
        period: Duration::from_millis(2),
        drift_ppm: 100.0,
        line: LineFaults { seed: 5, jitter, ..LineFaults::default() },
        triggers_per_exchange: 100,
    };
    let found = measure(&train, &dir.path().join("hsu")).expect("a train");
    assert_eq!(found.errors_ns.len() as u64, train.triggers, "every trigger is known");
    let (median, p99) = (found.quantile_us(0.5), found.quantile_us(0.99));
    let limit = jitter.as_secs_f64() * 1e6;
    assert!(median < limit / 8.0 && p99 < limit / 2.0, "median {median} us, P99 {p99} us");
    let drift = found.fit.drift_ppm().expect("a fit");
    assert!((drift - train.drift_ppm).abs() < 40.0, "{drift} ppm in 8 s");
}
