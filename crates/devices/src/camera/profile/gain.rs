// SPDX-License-Identifier: MIT OR Apache-2.0
//! Gain: decibels, a factor, or steps of a size that the camera does not state.

use super::plan::{Amount, Plan, Scale, Trouble, Wishes, Write, first_writable, none_of, writable_number};
use crate::camera::description::{Description, Feature, Kind, plain};

const WORD: &str = "gain_db";
/// Features that hold the gain in decibels or as a factor, newest standard first.
const GAINS: [&str; 4] = ["Gain", "GainAbs", "GainDB", "AnalogGain"];
/// Features that hold the gain in steps, newest standard first.
const STEPS: [&str; 4] = ["GainRaw", "Gain", "GainAbs", "AnalogGain"];
/// Largest difference between the camera's nearest gain and the requested one, dB.
const TOLERANCE_DB: f64 = 0.25;

/// Adds the gain, or the reason why it cannot be set.
pub fn resolve(camera: &dyn Description, wishes: &Wishes, plan: &mut Plan) {
    if wishes.left_to_settings(WORD) {
        return;
    }
    let (name, amount) = match gain(camera, wishes.words.gain_db.unwrap_or(0.0)) {
        Ok(Some(found)) => found,
        Ok(None) => return,
        Err(trouble) => return plan.troubles.push(trouble),
    };
    let set = |amount: &Amount| Write::new(name, amount.clone(), WORD);
    let selector = first_writable(camera, &["GainSelector"]);
    let entries = selector.map_or_else(Vec::new, |(_, selector)| selector.entries);
    let select = |entry: &str| Write::entry("GainSelector", entry, WORD).optional();
    let nothing = match &amount {
        Amount::Near { scale, .. } => near(0.0, scale.clone()),
        _ => Amount::Least,
    };
    // One gain for everything; else the analog one carries it all. The others add nothing, where the value that adds
    // nothing is known. Gains of taps balance halves of the sensor, and stay.
    let whole = entries.iter().find(|entry| plain(entry) == "all").cloned();
    match whole {
        Some(entry) => {
            let stays = |other: &&String| **other == entry || plain(other).starts_with("tap");
            for other in entries.iter().filter(|other| nothing != Amount::Least && !stays(other)) {
                plan.writes.extend([select(other), set(&nothing).optional()]);
            }
            plan.writes.extend([select(&entry), set(&amount)]);
        }
        None if entries.is_empty() => plan.writes.push(set(&amount)),
        None => {
            let digital = |entry: &String| plain(entry).contains("digital");
            for entry in &entries {
                let amount = if digital(entry) { &nothing } else { &amount };
                plan.writes.extend([select(entry), set(amount).optional()]);
            }
            if let Some(entry) = entries.iter().find(|entry| !digital(entry)) {
                plan.writes.extend([select(entry), set(&amount)]);
            }
        }
    }
}

fn near(wanted: f64, scale: Scale) -> Amount {
    Amount::Near { wanted, scale, tolerance: TOLERANCE_DB, unit: "dB" }
}

/// The feature that is the gain, and the value for the wanted decibels; `None` for a camera without gain.
fn gain(camera: &dyn Description, wanted_db: f64) -> Result<Option<(&'static str, Amount)>, Trouble> {
    let with_unit = |name: &&'static str| {
        let feature = writable_number(camera, name)?;
        let unit = plain(feature.unit.as_deref().unwrap_or_default());
        Some((*name, feature, unit))
    };
    let is_float = |(_, feature, _): &(_, Feature, _)| feature.kind == Kind::Float;
    if let Some((name, feature, unit)) = GAINS.iter().filter_map(with_unit).find(is_float) {
        match unit.as_str() {
            "db" | "decibel" | "decibels" => {
                return Ok(Some((name, near(wanted_db, Scale::Times(1.0)))));
            }
            "" | "x" | "times" | "factor" if feature.unit.as_deref() != Some("%") => {
                return Ok(Some((name, near(wanted_db, Scale::Gain))));
            }
            _ if wanted_db == 0.0 => return Ok(Some((name, Amount::Least))),
            _ => return Err(in_steps(name)),
        }
    }
    // A number without a unit of decibels counts steps, whether it is an integer or a float.
    match STEPS.iter().find_map(with_unit) {
        Some((name, _, unit)) if unit == "db" => Ok(Some((name, near(wanted_db, Scale::Times(1.0))))),
        Some((name, ..)) if wanted_db == 0.0 => Ok(Some((name, Amount::Least))),
        Some((name, ..)) => Err(in_steps(name)),
        // A camera without gain has none to set.
        None if wanted_db == 0.0 => Ok(None),
        None => Err(none_of(camera, &GAINS, "is its gain", WORD)),
    }
}

fn in_steps(name: &str) -> Trouble {
    Trouble::new(
        name,
        format!(
            "the camera counts its gain in steps ({name}) and does not state how many decibels one has: set gain_db = \
             0.0 \
             for the least gain, or left_to_settings = [\"gain_db\"] and [\"{name}\", STEPS] in `settings`, expected \
             no other \
             gain_db"
        ),
    )
}
