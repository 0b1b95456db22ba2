// SPDX-License-Identifier: MIT OR Apache-2.0
//! The checks of fringe orders that a run lacks, though another run could have them.
//!
//! A frame set of all cameras, with a calibration that knows the panel's rows, has every check that there is. A run
//! with less is no error: a laboratory may have lost a camera. But the reader of its figures must know it.

use crate::base::ids::CameraId;
use crate::data::Calibration;

/// A sentence for each check that a run of these cameras lacks.
pub(crate) fn unchecked(calibration: &Calibration, cameras: &[CameraId]) -> Vec<String> {
    let used = |id: &CameraId| cameras.contains(id);
    let mut lacks = Vec::new();
    let missing: Vec<&str> =
        calibration.cameras().filter(|(_, c)| !used(&c.id)).map(|(_, c)| c.id.as_str()).collect();
    if !missing.is_empty() {
        lacks.push(format!(
            "fringe orders by {}, which the calibration has beside those used",
            list(&missing)
        ));
    }
    let all = || calibration.heads.iter().filter(|head| head.cameras.iter().any(|c| used(&c.id)));
    let alone = all().filter(|head| head.cameras.iter().filter(|c| used(&c.id)).count() == 1);
    let alone: Vec<&str> = alone.map(|head| head.id.as_str()).collect();
    if !alone.is_empty() {
        let heads = list(&alone);
        lacks.push(format!(
            "{heads}: fringe orders by a second camera of the head, which confirms most of them"
        ));
    }
    let rowless: Vec<&str> = all().filter(|head| head.rows.is_none()).map(|head| head.id.as_str()).collect();
    if !rowless.is_empty() {
        lacks.push(format!(
            "{}: whether calibration, camera and light belong together, because the calibration does not \
             state the panel's rows; calibrate again",
            list(&rowless)
        ));
    }
    lacks
}

fn list(names: &[&str]) -> String {
    names.join(", ")
}

#[cfg(test)]
mod tests {
    use super::unchecked;
    use crate::base::ids::CameraId;
    use crate::config::Rig;
    use crate::data::{Calibration, PanelRows};

    #[test]
    fn what_a_run_lacks_is_said_and_nothing_else() {
        let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config/rig.toml");
        let mut calibration = Calibration::nominal(&Rig::load(&path).expect("the shipped rig"));
        calibration.heads.iter_mut().for_each(|head| head.rows = Some(PanelRows::exact()));
        let all: Vec<CameraId> = calibration.cameras().map(|(_, camera)| camera.id.clone()).collect();
        assert_eq!(unchecked(&calibration, &all), Vec::<String>::new());
        // A whole head is missing: the others are checked by their own second cameras.
        let three_heads = unchecked(&calibration, &all[..6]);
        assert_eq!(three_heads.len(), 1);
        assert!(three_heads[0].contains("h3_up, h3_low"), "{three_heads:?}");
        let one = unchecked(&calibration, &all[..1]);
        assert!(one.len() == 2 && one[1].starts_with("h0: "), "{one:?}");
        calibration.heads[2].rows = None;
        let rowless = unchecked(&calibration, &all);
        assert!(rowless.len() == 1 && rowless[0].starts_with("h2: "), "{rowless:?}");
    }
}
