// SPDX-License-Identifier: MIT OR Apache-2.0
//! Figures of signed deviations: mean, spread and quantiles.

/// Mean, RMS and the like of signed deviations.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Deviations {
    pub points: usize,
    pub mean_mm: f64,
    /// Root of their mean square, mm.
    pub rms_mm: f64,
    /// 1.4826 times the median of their sizes, mm.
    pub robust_mm: f64,
    /// 95th percentile of their sizes, mm.
    pub p95_mm: f64,
    /// Size of the largest deviation, mm.
    pub peak_mm: f64,
}

impl Deviations {
    /// Of deviations in metres; NaN figures where there are none.
    pub fn of(deviations_m: &[f64]) -> Self {
        let n = deviations_m.len() as f64;
        let mut sizes: Vec<f64> = deviations_m.iter().map(|d| d.abs()).collect();
        sizes.sort_unstable_by(f64::total_cmp);
        let quantile = |q: f64| {
            let place = (q * sizes.len().saturating_sub(1) as f64).round() as usize;
            sizes.get(place).map_or(f64::NAN, |d| 1e3 * d)
        };
        Self {
            points: sizes.len(),
            mean_mm: 1e3 * deviations_m.iter().sum::<f64>() / n,
            rms_mm: 1e3 * (sizes.iter().map(|d| d * d).sum::<f64>() / n).sqrt(),
            robust_mm: 1.4826 * quantile(0.5),
            p95_mm: quantile(0.95),
            peak_mm: quantile(1.0),
        }
    }
}

/// Numbers without a pattern, the same in every run (splitmix64).
#[derive(Debug)]
pub(super) struct Draws(pub(super) u64);

impl Draws {
    /// A number below `count`, which is not 0.
    pub(super) fn below(&mut self, count: usize) -> usize {
        (self.next() % count.max(1) as u64) as usize
    }

    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// A normally distributed number of unit variance, nearly: the sum of twelve even ones.
    #[cfg(test)]
    pub(super) fn normal(&mut self) -> f64 {
        (0..12).map(|_| self.next() as f64 / u64::MAX as f64).sum::<f64>() - 6.0
    }

    /// A number from 0 to 1.
    #[cfg(test)]
    pub(super) fn share(&mut self) -> f64 {
        self.next() as f64 / u64::MAX as f64
    }
}

#[cfg(test)]
mod tests {
    use super::Deviations;

    #[test]
    fn deviations_are_in_millimetres() {
        let d = Deviations::of(&[0.001, -0.001, 0.002, 0.0]);
        assert!((d.rms_mm - 1.5f64.sqrt()).abs() < 1e-12 && (d.mean_mm - 0.5).abs() < 1e-12, "{d:?}");
        assert_eq!((d.points, d.peak_mm), (4, 2.0));
    }
}
