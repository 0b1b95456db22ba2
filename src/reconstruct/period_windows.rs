//! The paper's windows: median, range and crossings of every window of a run, many windows side by side.

use super::period::{HYSTERESIS, PERIOD_RANGE_PX};

/// Windows that are measured together: their samples are bytes.
const LANES: usize = 32;

/// A byte of each of these windows.
type Bytes = [u8; LANES];

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
        let room = windows.next_multiple_of(LANES);
        self.padded.clear();
        self.padded.extend_from_slice(row);
        self.padded.resize(room + length, 0);
        for plane in [&mut self.median, &mut self.low, &mut self.high] {
            plane.resize(room, 0);
        }
        self.distance.resize(room, 0.0);
        for first in (0..windows).step_by(LANES) {
            self.order(first, length);
            self.cross(first, length);
        }
        windows
    }

    /// Lower median and extremes of the windows from `first` on.
    #[inline(always)]
    fn order(&mut self, first: usize, length: usize) {
        let (mut low, mut high) = ([u8::MAX; LANES], [0u8; LANES]);
        for samples in self.padded[first..].windows(LANES).take(length) {
            for i in 0..LANES {
                low[i] = low[i].min(samples[i]);
                high[i] = high[i].max(samples[i]);
            }
        }
        // The largest value that at most `below` samples are less than, bit after bit.
        let below = ((length - 1) / 2) as u8;
        let mut median = [0u8; LANES];
        for bit in (0..8).rev() {
            let (mut tried, mut less) = ([0u8; LANES], [0u8; LANES]);
            for i in 0..LANES {
                tried[i] = median[i] | 1 << bit;
            }
            for samples in self.padded[first..].windows(LANES).take(length) {
                for i in 0..LANES {
                    less[i] = less[i].wrapping_add(u8::from(samples[i] < tried[i]));
                }
            }
            for i in 0..LANES {
                median[i] = if less[i] <= below { tried[i] } else { median[i] };
            }
        }
        self.median[first..first + LANES].copy_from_slice(&median);
        self.low[first..first + LANES].copy_from_slice(&low);
        self.high[first..first + LANES].copy_from_slice(&high);
    }

    /// Mean distances of crossings of the windows' medians. A crossing counts once the light has left the median by a
    /// share of the range on the other side. Crossings that count rise and fall by turns: of the distances between those
    /// of one direction all cancel but those of the first two and of the last two.
    #[inline(always)]
    fn cross(&mut self, first: usize, length: usize) {
        let [mut median, mut above_from, mut below_to]: [Bytes; 3] = [[0; LANES]; 3];
        for i in 0..LANES {
            let (low, high) = (self.low[first + i], self.high[first + i]);
            // Differences are whole numbers: they exceed a margin where they exceed its whole part.
            let margin = (HYSTERESIS * f32::from(high - low)) as i32 as u8;
            median[i] = self.median[first + i];
            above_from[i] = median[i].saturating_add(margin);
            below_to[i] = median[i].saturating_sub(margin);
        }
        // The crossing seen last; of those that counted the first two, the last but one and the last, and their number.
        let [mut seen, mut begin, mut second, mut late, mut last] = [Crossings::default(); 5];
        let mut count: Bytes = [0; LANES];
        // Whether the light is above the median for certain, and whether it has been certain at all.
        let [mut above, mut settled]: [Bytes; 2] = [[0; LANES]; 2];
        for (k, samples) in self.padded[first..].windows(LANES).take(length).enumerate() {
            let before = &self.padded[first + k.saturating_sub(1)..][..LANES];
            let mut here = Crossings([[k as u8; LANES]; 3]);
            here.0[1].copy_from_slice(samples);
            here.0[2].copy_from_slice(before);
            let [mut crosses, mut counts]: [Bytes; 2] = [[0; LANES]; 2];
            for i in 0..LANES {
                crosses[i] = mask(samples[i] > median[i]) ^ mask(before[i] > median[i]);
            }
            seen.take(&crosses, &here);
            for i in 0..LANES {
                let (high, low) = (mask(samples[i] > above_from[i]), mask(samples[i] < below_to[i]));
                counts[i] = (high & !above[i] | low & above[i]) & settled[i];
                above[i] = (above[i] | high) & !low;
                settled[i] |= high | low;
            }
            let [mut is_first, mut is_second]: [Bytes; 2] = [[0; LANES]; 2];
            for i in 0..LANES {
                is_first[i] = counts[i] & mask(count[i] == 0);
                is_second[i] = counts[i] & mask(count[i] == 1);
            }
            begin.take(&is_first, &seen);
            second.take(&is_second, &seen);
            late.take(&counts, &last);
            last.take(&counts, &seen);
            for i in 0..LANES {
                count[i] += counts[i] & 1;
            }
        }
        let distance = &mut self.distance[first..first + LANES];
        for i in 0..LANES {
            let median = i32::from(median[i]);
            let sum = last.place(i, median) + late.place(i, median)
                - second.place(i, median)
                - begin.place(i, median);
            let mean = sum / f32::from(count[i].max(3) - 2);
            let known =
                (count[i] > 2) & (mean >= *PERIOD_RANGE_PX.start()) & (mean <= *PERIOD_RANGE_PX.end());
            distance[i] = if known { mean } else { 0.0 };
        }
    }
}

/// A crossing of each window: its sample's number, that sample, and the one before.
#[derive(Clone, Copy)]
struct Crossings([Bytes; 3]);

impl Default for Crossings {
    fn default() -> Self {
        Self([[0; LANES]; 3])
    }
}

impl Crossings {
    /// Becomes `new` in the windows where the mask has all bits: of choices the compiler makes branches.
    #[inline(always)]
    fn take(&mut self, mask: &Bytes, new: &Self) {
        for (lanes, new) in self.0.iter_mut().zip(&new.0) {
            for i in 0..LANES {
                lanes[i] = new[i] & mask[i] | lanes[i] & !mask[i];
            }
        }
    }

    /// Where the light goes through the median, in samples from the window's first.
    #[inline(always)]
    fn place(&self, i: usize, median: i32) -> f32 {
        let [k, value, before] = &self.0;
        let (value, before) = (i32::from(value[i]), i32::from(before[i]));
        f32::from(k[i]) - (value - median) as f32 / (value - before) as f32
    }
}

/// All bits or none.
#[inline(always)]
fn mask(is: bool) -> u8 {
    0u8.wrapping_sub(u8::from(is))
}

#[cfg(test)]
mod tests {
    use super::Windows;
    use crate::reconstruct::period::{HYSTERESIS, PERIOD_RANGE_PX};
    use proptest::prelude::{any, prop_assert_eq, proptest};

    /// Mean distance of crossings of equal direction by the definition.
    fn plain_distance(samples: &[u8], median: f32, margin: f32) -> f32 {
        let (mut counted, mut seen, mut side) = (Vec::new(), f32::NAN, 0);
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
                counted.push(seen);
            }
            side = now;
        }
        let distances: Vec<f32> = counted.windows(3).map(|three| three[2] - three[0]).collect();
        if distances.is_empty() {
            return 0.0;
        }
        // All but four cancel: the same sum in the order in which the lanes add.
        let (ends, n) = (&counted, counted.len());
        let mean = (ends[n - 1] + ends[n - 2] - ends[1] - ends[0]) / (n - 2) as f32;
        assert!((mean - distances.iter().sum::<f32>() / distances.len() as f32).abs() < 1e-5);
        if PERIOD_RANGE_PX.contains(&mean) { mean } else { 0.0 }
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
