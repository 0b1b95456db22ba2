// SPDX-License-Identifier: MIT OR Apache-2.0
//! Seeded randomness by hashing: every value depends only on what it is for, never on the order of work.

use std::f64::consts::TAU;

/// Mixes a seed and some words into 64 well-spread bits (SplitMix64's finalizer per word).
pub fn hash(seed: u64, words: &[u64]) -> u64 {
    words.iter().fold(mix(seed), |state, &word| mix(state ^ word.wrapping_mul(0x9e37_79b9_7f4a_7c15)))
}

/// SplitMix64's step: a bijection that spreads every input bit over all output bits.
#[inline]
pub fn mix(value: u64) -> u64 {
    let mut z = value.wrapping_add(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

/// A number in [0, 1) from 64 well-spread bits.
pub fn share(bits: u64) -> f64 {
    (bits >> 11) as f64 / (1u64 << 53) as f64
}

/// A stable 64-bit number of a text (FNV-1a), for hashing names.
pub fn text_number(text: &str) -> u64 {
    text.bytes().fold(0xcbf2_9ce4_8422_2325, |h, byte| (h ^ u64::from(byte)).wrapping_mul(0x100_0000_01b3))
}

/// A stream of random numbers for one purpose.
#[derive(Debug, Clone)]
pub struct Stream(u64);

impl Stream {
    /// The stream of `purpose` under `seed`.
    pub fn new(seed: u64, purpose: &str) -> Self {
        Self(hash(seed, &[text_number(purpose)]))
    }

    /// A uniform random number between 0 and 1, both exclusive.
    pub fn uniform(&mut self) -> f64 {
        self.0 = mix(self.0);
        ((self.0 >> 11) as f64 + 0.5) / (1u64 << 53) as f64
    }

    /// Standard normal (Box and Muller 1958), cut at 2.5 standard deviations so that a rig stays buildable.
    pub fn normal(&mut self) -> f64 {
        let radius = (-2.0 * self.uniform().ln()).sqrt();
        (radius * (TAU * self.uniform()).cos()).clamp(-2.5, 2.5)
    }
}

/// Standard normal values by 16 random bits: the inverse of the normal distribution at 65,536 equal steps.
pub struct NormalTable(Vec<f32>);

impl NormalTable {
    /// Tabulates the inverse of the cumulative distribution, integrated over -6..6 by the trapezoid rule.
    pub fn new() -> Self {
        const STEPS: usize = 120_000;
        const ENTRIES: usize = 65_536;
        let x_of = |step: usize| -6.0 + 12.0 * step as f64 / STEPS as f64;
        let density = |x: f64| (-0.5 * x * x).exp();
        let mut cumulative = Vec::with_capacity(STEPS + 1);
        cumulative.push(0.0);
        for step in 1..=STEPS {
            cumulative.push(cumulative[step - 1] + density(x_of(step - 1)) + density(x_of(step)));
        }
        let total = cumulative[STEPS];
        let mut step = 0;
        let entries = (0..ENTRIES).map(|entry| {
            let target = total * (entry as f64 + 0.5) / ENTRIES as f64;
            while cumulative[step + 1] < target {
                step += 1;
            }
            let part = (target - cumulative[step]) / (cumulative[step + 1] - cumulative[step]);
            (x_of(step) + 12.0 / STEPS as f64 * part) as f32
        });
        Self(entries.collect())
    }

    /// The value that the top 16 of these bits pick.
    #[inline]
    pub fn pick(&self, bits: u64) -> f32 {
        self.0[(bits >> 48) as usize]
    }
}

impl Default for NormalTable {
    fn default() -> Self {
        Self::new()
    }
}

#[cfg(test)]
mod tests {
    use super::{NormalTable, Stream, mix};

    #[test]
    fn the_table_is_a_standard_normal() {
        let table = NormalTable::new();
        let values: Vec<f64> =
            (0..200_000u64).map(|i| f64::from(table.pick(mix(i.wrapping_mul(7))))).collect();
        let moment = |power: i32| values.iter().map(|x| x.powi(power)).sum::<f64>() / values.len() as f64;
        assert!(moment(1).abs() < 0.01, "mean {}", moment(1));
        assert!((moment(2) - 1.0).abs() < 0.01, "variance {}", moment(2));
        assert!((moment(4) - 3.0).abs() < 0.1, "fourth moment {}", moment(4));
    }

    #[test]
    fn streams_repeat_and_differ_by_purpose() {
        let draw = |seed, purpose| Stream::new(seed, purpose).normal();
        assert_eq!(draw(7, "a"), draw(7, "a"));
        assert_ne!(draw(7, "a"), draw(7, "b"));
        assert_ne!(draw(7, "a"), draw(8, "a"));
    }
}
