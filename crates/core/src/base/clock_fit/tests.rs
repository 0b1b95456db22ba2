// SPDX-License-Identifier: MIT OR Apache-2.0
//! The fit against clocks whose truth is known.

use super::{ClockFit, Exchange, Judged};
use proptest::prelude::{ProptestConfig, any, prop_assert, prop_assert_eq, proptest};

/// Pseudo-random numbers by xorshift64*, so that the tests are repeatable.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        self.0.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 16
    }

    fn below(&mut self, bound: u64) -> u64 {
        self.next() % bound.max(1)
    }
}

/// A device whose clock runs fast by `ppm`, behind a line that delays each message by up to `jitter_ns`.
struct Device {
    offset_ns: u64,
    ppm: f64,
    jitter_ns: u64,
    random: Random,
}

const HOST_NS: u64 = 1_790_000_000_000_000_000;

impl Device {
    fn reading(&self, host_ns: u64) -> u64 {
        let since = host_ns - HOST_NS;
        self.offset_ns + since.saturating_add_signed((since as f64 * self.ppm * 1e-6).round() as i64)
    }

    fn delay(&mut self) -> u64 {
        60_000 + self.random.below(self.jitter_ns)
    }

    fn exchange(&mut self, host_ns: u64) -> Exchange {
        let read = host_ns + self.delay();
        let device_ns = self.reading(read);
        Exchange { host_send_ns: host_ns, host_receive_ns: read + self.delay(), device_ns }
    }

    /// Feeds a session of `seconds` at 120 Hz with a burst of exchanges before it and five a second during it;
    /// returns the errors of trigger times as they were known then, ns.
    fn session(&mut self, fit: &mut ClockFit, seconds: u64, lost: u64) -> Vec<u64> {
        for k in 0..32 {
            fit.exchange(&self.exchange(HOST_NS + k * 15_000_000));
        }
        let mut errors = Vec::new();
        for k in 0..seconds * 120 {
            let host_ns = HOST_NS + 1_000_000_000 + k * 8_333_333;
            if k % 24 == 0 && self.random.below(100) >= lost {
                fit.exchange(&self.exchange(host_ns));
            }
            let trigger = self.reading(host_ns);
            let arrival = host_ns + self.delay();
            fit.heard(trigger, arrival);
            let found = fit.host_from_device(i128::from(trigger)).expect("a fit after the burst");
            errors.push(found.abs_diff(i128::from(host_ns)) as u64);
        }
        errors
    }
}

fn quantile(errors: &[u64], share: f64) -> u64 {
    let mut sorted = errors.to_vec();
    sorted.sort_unstable();
    sorted[((sorted.len() - 1) as f64 * share) as usize]
}

/// The figure: 2 ms of jitter each way, 100 ppm; see docs/benchmarks.md.
#[test]
fn trigger_times_are_known_to_a_fraction_of_the_jitter() {
    let mut all = Vec::new();
    for seed in 1..=20 {
        for ppm in [-100.0, 100.0] {
            let mut device =
                Device { offset_ns: 5_000_000_000, ppm, jitter_ns: 2_000_000, random: Random(seed * 77) };
            let mut fit = ClockFit::new();
            let errors = device.session(&mut fit, 60, 10);
            let drift = fit.drift_ppm().expect("a fit");
            assert!((drift - ppm).abs() < 5.0, "drift {drift} ppm, truth {ppm}");
            assert_eq!((fit.left_out(), fit.resets()), (0, 0));
            all.extend(errors);
        }
    }
    let [median, p999, max] = [0.5, 0.999, 1.0].map(|share| quantile(&all, share) as f64 / 1e3);
    println!("{} triggers: median {median:.1} us, P99.9 {p999:.1} us, max {max:.1} us", all.len());
    assert!(all.len() > 100_000 && median < 60.0 && p999 < 200.0, "median {median}, P99.9 {p999}");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(32))]

    #[test]
    fn the_truth_lies_within_the_uncertainty(
        seed in any::<u64>(), ppm in -150f64..150.0, jitter_ns in 0u64..3_000_000, lost in 0u64..60,
    ) {
        let mut device = Device { offset_ns: 1 << 40, ppm, jitter_ns, random: Random(seed | 1) };
        let mut fit = ClockFit::new();
        device.session(&mut fit, 12, lost);
        for ahead_ns in [0u64, 500_000_000, 2_000_000_000] {
            let host_ns = HOST_NS + 13_000_000_000 + ahead_ns;
            let device_ns = i128::from(device.reading(host_ns));
            let error = fit.host_from_device(device_ns).expect("a fit") - i128::from(host_ns);
            let stated = fit.uncertainty_ns(device_ns).expect("a fit");
            prop_assert!(error.unsigned_abs() <= u128::from(stated) + 1000, "{error} ns, stated {stated}");
            prop_assert!(stated >= 60_000, "stated {stated} ns, but half the round trip is at least that");
        }
        prop_assert_eq!(fit.left_out(), 0);
    }

    /// There and back is the identity, for any instant within a day and clocks of any reading.
    #[test]
    fn nothing_is_lost_between_the_clocks(
        seed in any::<u64>(), offset_ns in 0u64..1 << 62, ppm in -150f64..150.0, away_ns in -86_400_000_000_000i64..86_400_000_000_000,
    ) {
        let mut device = Device { offset_ns, ppm, jitter_ns: 500_000, random: Random(seed | 1) };
        let mut fit = ClockFit::new();
        device.session(&mut fit, 5, 0);
        let host_ns = i128::from(HOST_NS) + i128::from(away_ns);
        let device_ns = fit.device_from_host(host_ns).expect("a fit");
        let back = fit.host_from_device(device_ns).expect("a fit");
        prop_assert!((back - host_ns).abs() <= 1, "{} ns", back - host_ns);
    }

    #[test]
    fn a_reset_is_told_from_a_bad_exchange(
        seed in any::<u64>(), step_ns in 20_000_000u64..1 << 50, forward in any::<bool>(),
    ) {
        let mut device = Device { offset_ns: 1 << 51, ppm: 40.0, jitter_ns: 2_000_000, random: Random(seed | 1) };
        let mut fit = ClockFit::new();
        device.session(&mut fit, 10, 0);
        let at = |k: u64| HOST_NS + 12_000_000_000 + k * 1_000_000_000;
        let mut bad = device.exchange(at(0));
        bad.device_ns += 50_000_000;
        prop_assert_eq!(fit.exchange(&bad), Judged::LeftOut);
        prop_assert_eq!(fit.exchange(&device.exchange(at(1))), Judged::Used);
        device.offset_ns = if forward { device.offset_ns + step_ns } else { device.offset_ns - step_ns };
        prop_assert_eq!(fit.exchange(&device.exchange(at(2))), Judged::LeftOut);
        prop_assert_eq!(fit.exchange(&device.exchange(at(3))), Judged::LeftOut);
        let Judged::Reset { step_ns: found } = fit.exchange(&device.exchange(at(4))) else {
            return Err(proptest::test_runner::TestCaseError::fail("no reset was found"));
        };
        let truth = if forward { i128::from(step_ns) } else { -i128::from(step_ns) };
        prop_assert!((found - truth).abs() < 5_000_000, "step {found}, truth {truth}");
        prop_assert_eq!((fit.resets(), fit.left_out()), (1, 1));
        let host_ns = at(5);
        let seen = fit.host_from_device(i128::from(device.reading(host_ns))).expect("a fit");
        prop_assert!(seen.abs_diff(i128::from(host_ns)) < 3_000_000);
    }
}

#[test]
fn a_clock_that_stands_still_gives_no_fit() {
    let mut fit = ClockFit::new();
    for k in 0..20 {
        let host_send_ns = HOST_NS + k * 1_000_000_000;
        fit.exchange(&Exchange { host_send_ns, host_receive_ns: host_send_ns + 100_000, device_ns: 7 });
        assert!(!fit.is_ready(), "after {k} readings");
    }
}
