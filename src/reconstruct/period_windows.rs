//! The paper's windows: median, range and crossings of every window of a run, many windows side by side.

use super::period::{HYSTERESIS, PERIOD_RANGE_PX};

/// Windows whose medians are sought together, and whose crossings are counted together.
const MEDIANS: usize = 64;
const LANES: usize = 16;

/// What [`measure`] finds, and memory for it: one entry for each window.
#[derive(Debug, Default)]
pub(super) struct Windows {
    /// The run with room behind it.
    padded: Vec<u8>,
    median: Vec<u8>,
    low: Vec<u8>,
    high: Vec<u8>,
    /// Mean distance of crossings of equal direction, px; 0 where there are too few, or it is no period.
    pub distance: Vec<f32>,
}

impl Windows {
    /// Largest less smallest intensity of a window, DN.
    pub fn range(&self, window: usize) -> u8 {
        self.high[window] - self.low[window]
    }

    /// Measures the windows of `length` pixels (less than 256) of a run; returns how many they are.
    #[inline(always)]
    pub fn measure(&mut self, row: &[u8], length: usize) -> usize {
        let windows = row.len() + 1 - length;
        let room = windows.next_multiple_of(MEDIANS);
        self.padded.clear();
        self.padded.extend_from_slice(row);
        self.padded.resize(room + length + LANES, 0);
        for plane in [&mut self.median, &mut self.low, &mut self.high] {
            plane.resize(room, 0);
        }
        self.distance.resize(room, 0.0);
        for first in (0..windows).step_by(MEDIANS) {
            self.order(first, length);
        }
        for first in (0..windows).step_by(LANES) {
            self.cross(first, length);
        }
        windows
    }

    /// Lower median and extremes of the windows from `first` on.
    #[inline(always)]
    fn order(&mut self, first: usize, length: usize) {
        let (mut low, mut high) = ([u8::MAX; MEDIANS], [0u8; MEDIANS]);
        for samples in self.padded[first..].windows(MEDIANS).take(length) {
            for i in 0..MEDIANS {
                low[i] = low[i].min(samples[i]);
                high[i] = high[i].max(samples[i]);
            }
        }
        // The largest value that at most `below` samples are less than, bit after bit.
        let below = ((length - 1) / 2) as u8;
        let mut median = [0u8; MEDIANS];
        for bit in (0..8).rev() {
            let (mut tried, mut less) = ([0u8; MEDIANS], [0u8; MEDIANS]);
            for i in 0..MEDIANS {
                tried[i] = median[i] | 1 << bit;
            }
            for samples in self.padded[first..].windows(MEDIANS).take(length) {
                for i in 0..MEDIANS {
                    less[i] = less[i].wrapping_add(u8::from(samples[i] < tried[i]));
                }
            }
            for i in 0..MEDIANS {
                median[i] = if less[i] <= below { tried[i] } else { median[i] };
            }
        }
        self.median[first..first + MEDIANS].copy_from_slice(&median);
        self.low[first..first + MEDIANS].copy_from_slice(&low);
        self.high[first..first + MEDIANS].copy_from_slice(&high);
    }

    /// Mean distances of crossings of the windows' medians. A crossing counts once the light has left the median by a
    /// share of the range on the other side.
    #[inline(always)]
    fn cross(&mut self, first: usize, length: usize) {
        let [mut median, mut margin, mut before] = [[0f32; LANES]; 3];
        for i in 0..LANES {
            median[i] = f32::from(self.median[first + i]);
            margin[i] = HYSTERESIS * f32::from(self.high[first + i] - self.low[first + i]);
            before[i] = f32::from(self.padded[first + i]) - median[i];
        }
        // The crossing seen last, and those that counted last: falling, rising.
        let [mut seen, mut fell, mut rose] = [[f32::NAN; LANES]; 3];
        // Whether the light is above the median for certain, and whether it has been certain at all; as masks, because of
        // choices the compiler makes branches, and then no vectors.
        let [mut above, mut settled] = [[0u32; LANES]; 2];
        let (mut sum, mut count) = ([0f32; LANES], [0u32; LANES]);
        for (k, samples) in self.padded[first..].windows(LANES).take(length).enumerate() {
            for i in 0..LANES {
                let value = f32::from(samples[i]) - median[i];
                let crosses = mask((value > 0.0) != (before[i] > 0.0));
                let at = k as f32 - value / (value - before[i]);
                seen[i] = choose(crosses, at, seen[i]);
                before[i] = value;
                let (high, low) = (mask(value > margin[i]), mask(value < -margin[i]));
                let rises = high & !above[i] & settled[i];
                let falls = low & above[i] & settled[i];
                above[i] = (above[i] | high) & !low;
                settled[i] |= high | low;
                let rises_again = rises & !mask(rose[i].is_nan());
                let falls_again = falls & !mask(fell[i].is_nan());
                // What is not counted adds 0.
                sum[i] += choose(rises_again, seen[i] - rose[i], 0.0);
                sum[i] += choose(falls_again, seen[i] - fell[i], 0.0);
                count[i] += (rises_again | falls_again) & 1;
                rose[i] = choose(rises, seen[i], rose[i]);
                fell[i] = choose(falls, seen[i], fell[i]);
            }
        }
        for i in 0..LANES {
            let mean = sum[i] / count[i].max(1) as f32;
            let known =
                (count[i] > 0) & (mean >= *PERIOD_RANGE_PX.start()) & (mean <= *PERIOD_RANGE_PX.end());
            self.distance[first + i] = if known { mean } else { 0.0 };
        }
    }
}

/// All bits or none.
#[inline(always)]
fn mask(is: bool) -> u32 {
    0u32.wrapping_sub(u32::from(is))
}

#[inline(always)]
fn choose(mask: u32, a: f32, b: f32) -> f32 {
    f32::from_bits(a.to_bits() & mask | b.to_bits() & !mask)
}

#[cfg(test)]
mod tests {
    use super::Windows;
    use crate::reconstruct::period::{HYSTERESIS, PERIOD_RANGE_PX};
    use proptest::prelude::{any, prop_assert_eq, proptest};

    /// Mean distance of crossings of equal direction by the definition.
    fn plain_distance(samples: &[u8], median: f32, margin: f32) -> f32 {
        let (mut sum, mut count, mut counted) = (0.0, 0u32, [f32::NAN; 2]);
        let (mut seen, mut side) = (f32::NAN, 0);
        for i in 0..samples.len() {
            let value = f32::from(samples[i]) - median;
            let before = f32::from(samples[i.saturating_sub(1)]) - median;
            if (value > 0.0) != (before > 0.0) {
                seen = i as f32 - value / (value - before);
            }
            let now = if value > margin {
                1
            } else if value < -margin {
                -1
            } else {
                side
            };
            if now != side && side != 0 {
                let last = &mut counted[usize::from(now > 0)];
                if !last.is_nan() {
                    sum += seen - *last;
                    count += 1;
                }
                *last = seen;
            }
            side = now;
        }
        let mean = sum / count.max(1) as f32;
        if count > 0 && PERIOD_RANGE_PX.contains(&mean) { mean } else { 0.0 }
    }

    proptest! {
        #[test]
        fn windows_side_by_side_are_windows_alone(
            values in proptest::collection::vec(any::<u8>(), 30..200),
            length in 3usize..30,
            period in 5.5f32..20.0,
            noise in 0.0f32..1.0,
        ) {
            let fringe = |u: usize| 120.0 + 100.0 * (std::f32::consts::TAU * u as f32 / period).cos();
            let light = |(u, &x): (usize, &u8)| (fringe(u) * (1.0 - noise) + noise * f32::from(x)) as u8;
            let row: Vec<u8> = values.iter().enumerate().map(light).collect();
            let mut found = Windows::default();
            prop_assert_eq!(found.measure(&row, length), row.len() + 1 - length);
            for (i, window) in row.windows(length).enumerate() {
                let mut sorted = window.to_vec();
                sorted.sort_unstable();
                let range = sorted[length - 1] - sorted[0];
                prop_assert_eq!(found.range(i), range);
                prop_assert_eq!(found.median[i], sorted[(length - 1) / 2]);
                let distance = plain_distance(window, f32::from(found.median[i]), HYSTERESIS * f32::from(range));
                prop_assert_eq!(found.distance[i], distance);
            }
        }
    }
}
