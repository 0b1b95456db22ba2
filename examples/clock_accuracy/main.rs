// SPDX-License-Identifier: MIT OR Apache-2.0
//! How well trigger times are known, end to end, with a serial line that delays every message.
//!
//!     clock_accuracy [TRIGGERS] [PERIOD_US] [DRIFT_PPM] [JITTER_MS] [SEED] [EXCHANGES_PER_S]

mod measure;

use fourdbody_simulator::hsu::LineFaults;
use measure::{Train, measure};
use std::time::Duration;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1).map(|text| text.parse::<f64>());
    let mut argument = |default: f64| arguments.next().unwrap_or(Ok(default));
    let (triggers, period_us) = (argument(5_000.0)? as u64, argument(8_333.0)?);
    let (drift_ppm, jitter_ms, seed) = (argument(100.0)?, argument(2.0)?, argument(1.0)? as u64);
    let jitter = Duration::from_secs_f64(jitter_ms / 1e3);
    let period = Duration::from_secs_f64(period_us / 1e6);
    // As often as a node asks.
    let per_s = argument(5.0)?;
    let triggers_per_exchange = (1.0 / per_s / period.as_secs_f64()).ceil().max(1.0) as u64;
    let line = LineFaults { seed, jitter, ..LineFaults::default() };
    let path = std::env::temp_dir().join(format!("clock-accuracy-{}", std::process::id()));
    let found = measure(&Train { triggers, period, drift_ppm, line, triggers_per_exchange }, &path)?;
    println!(
        "{} of {triggers} triggers: median {:.1} us, P99 {:.1} us, P99.9 {:.1} us, max {:.1} us; drift {:.2} ppm, {} exchanges, {} left out",
        found.errors_ns.len(),
        found.quantile_us(0.5),
        found.quantile_us(0.99),
        found.quantile_us(0.999),
        found.quantile_us(1.0),
        found.fit.drift_ppm().unwrap_or_default(),
        found.fit.used(),
        found.fit.left_out()
    );
    Ok(())
}
