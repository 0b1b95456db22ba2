// SPDX-License-Identifier: MIT OR Apache-2.0
//! How the world of a calibration was chosen.

use serde::{Deserialize, Serialize};

/// How the world of a calibration was chosen, and how far its cameras are from where the rig file has them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct World {
    /// The number of cameras that were fitted to the rig file.
    pub cameras: usize,
    /// Root mean square over them of the distance from the rig file's place, mm.
    pub places_rms_mm: f64,
    /// The same of the angle to the rig file's attitude, degrees.
    pub attitudes_rms_deg: f64,
    /// Positions of the board that define the vertical; empty: the fit alone does.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub vertical_positions: Vec<usize>,
    /// How far they turned the world away from the fit, degrees.
    #[serde(default)]
    pub vertical_turn_deg: f64,
}

impl World {
    /// A line of a report for people.
    pub fn line(&self) -> String {
        let list: Vec<String> = self.vertical_positions.iter().map(ToString::to_string).collect();
        let vertical = match list.len() {
            0 => "vertical as in the rig file".to_owned(),
            n => format!(
                "vertical by {} {}, {:.2} degrees from the rig file's",
                if n == 1 { "position" } else { "positions" },
                list.join(", "),
                self.vertical_turn_deg
            ),
        };
        format!(
            "  world: best fit to the rig file's {} cameras, which are {:.1} mm and {:.2} degrees away; {vertical}",
            self.cameras, self.places_rms_mm, self.attitudes_rms_deg
        )
    }
}
