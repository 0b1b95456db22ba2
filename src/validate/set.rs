//! What `fourdbody reconstruct` wrote, by trigger, camera and head: `clouds/CAMERA_TRIGGER.ply` and
//! `merged/TRIGGER.ply`, or the same files in one directory (what lies in the two counts first).

use crate::calibrate::Calibration;
use crate::export::{Cloud, ply};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// The files of a reconstruction.
#[derive(Debug, Default)]
pub struct CloudSet {
    /// Directional clouds by trigger and camera.
    pub directional: BTreeMap<(u64, String), PathBuf>,
    /// Merged clouds by trigger.
    pub merged: BTreeMap<u64, PathBuf>,
}

impl CloudSet {
    /// Lists the clouds under `directory`; an error when there are none.
    pub fn open(directory: &Path) -> Result<Self, String> {
        let mut set = Self::default();
        for folder in [directory.join("clouds"), directory.join("merged"), directory.to_owned()] {
            if folder.is_dir() {
                set.list(&folder).map_err(|e| format!("{}: {e}", folder.display()))?;
            }
        }
        if set.directional.is_empty() && set.merged.is_empty() {
            return Err(format!(
                "{}: expected clouds/CAMERA_TRIGGER.ply or merged/TRIGGER.ply as `fourdbody reconstruct` writes them, found none",
                directory.display()
            ));
        }
        Ok(set)
    }

    fn list(&mut self, folder: &Path) -> std::io::Result<()> {
        for entry in std::fs::read_dir(folder)? {
            let path = entry?.path();
            let Some(stem) = path.file_name().and_then(|n| n.to_str()?.strip_suffix(".ply")) else {
                continue;
            };
            if let Ok(trigger) = stem.parse() {
                self.merged.entry(trigger).or_insert(path);
            } else if let Some((camera, index)) = stem.rsplit_once('_')
                && let Ok(trigger) = index.parse()
            {
                self.directional.entry((trigger, camera.to_owned())).or_insert(path);
            }
        }
        Ok(())
    }

    /// The triggers that have directional clouds, in order.
    pub fn triggers(&self) -> Vec<u64> {
        let mut triggers: Vec<u64> = self.directional.keys().map(|key| key.0).collect();
        triggers.dedup();
        triggers
    }

    /// Directional clouds by trigger and head. The calibration says which cameras make a head; without one, the
    /// part of the camera's name before its last `_` does.
    pub fn heads(&self, calibration: Option<&Calibration>) -> BTreeMap<(u64, String), Vec<(&str, &Path)>> {
        let mut heads: BTreeMap<_, Vec<(&str, &Path)>> = BTreeMap::new();
        for ((trigger, camera), path) in &self.directional {
            let known = calibration.and_then(|c| c.cameras().find(|(_, found)| found.id.as_str() == camera));
            let head = match known {
                Some((head, _)) => head.id.to_string(),
                None => camera.rsplit_once('_').map_or(camera.as_str(), |(head, _)| head).to_owned(),
            };
            heads.entry((*trigger, head)).or_default().push((camera, path));
        }
        heads
    }
}

/// Reads one cloud.
pub fn load(path: &Path) -> Result<Cloud, String> {
    ply::load(path).map(|(_, cloud)| cloud).map_err(|e| e.to_string())
}

/// Mean, RMS and the like of signed deviations.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Deviations {
    /// Number of values.
    pub points: usize,
    /// Their mean, mm.
    pub mean_mm: f64,
    /// Root of their mean square, mm.
    pub rms_mm: f64,
    /// 1.4826 times the median of their sizes, mm.
    pub robust_mm: f64,
    /// 95th percentile of their sizes, mm.
    pub p95_mm: f64,
    /// Largest size, mm.
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
    use super::{CloudSet, Deviations};

    #[test]
    fn clouds_are_found_by_name() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        std::fs::create_dir(dir.path().join("clouds")).expect("writable");
        std::fs::create_dir(dir.path().join("merged")).expect("writable");
        for name in ["clouds/h0_up_000003.ply", "clouds/h0_low_000003.ply", "merged/000003.ply", "notes.txt"]
        {
            std::fs::write(dir.path().join(name), "").expect("writable");
        }
        let set = CloudSet::open(dir.path()).expect("clouds");
        let heads = set.heads(None);
        assert_eq!(heads.keys().collect::<Vec<_>>(), [&(3, "h0".to_owned())]);
        assert_eq!(heads.values().next().map(Vec::len), Some(2));
        assert_eq!((set.merged.len(), set.triggers()), (1, vec![3]));
        assert!(CloudSet::open(&dir.path().join("nothing")).is_err());
    }

    #[test]
    fn deviations_are_in_millimetres() {
        let d = Deviations::of(&[0.001, -0.001, 0.002, 0.0]);
        assert!((d.rms_mm - 1.5f64.sqrt()).abs() < 1e-12 && (d.mean_mm - 0.5).abs() < 1e-12, "{d:?}");
        assert_eq!((d.points, d.peak_mm), (4, 2.0));
    }
}
