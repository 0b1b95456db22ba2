// SPDX-License-Identifier: MIT OR Apache-2.0
//! Gain: decibels, a factor, or steps of a size that the camera does not state.

use super::{Amount, Plan, Scale, Trouble, Wishes, Write, check_bounds, first_writable, none_of};
use crate::camera::description::{Description, Kind, plain};

const WORD: &str = "gain_db";
/// In decibels or as a factor, newest first; then in steps.
const GAINS: [&str; 4] = ["Gain", "GainAbs", "GainDB", "AnalogGain"];
const STEPS: [&str; 4] = ["GainRaw", "Gain", "GainAbs", "AnalogGain"];
/// By how much the camera's nearest gain may differ.
const TOLERANCE_DB: f64 = 0.25;

pub fn resolve(camera: &dyn Description, wishes: &Wishes, plan: &mut Plan) {
    if wishes.left_to_settings(WORD) {
        return;
    }
    let (name, amount) = match gain(camera, wishes.words.gain_db) {
        Ok(Some(found)) => found,
        Ok(None) => return,
        Err(trouble) => return plan.troubles.push(trouble),
    };
    let set = |amount: &Amount| Write::new(name, amount.clone(), WORD);
    let selector = first_writable(camera, &["GainSelector"]);
    let entries = selector.map_or_else(Vec::new, |(_, selector)| selector.entries);
    let select = |entry: &str| Write::entry("GainSelector", entry, WORD).optional();
    let nothing = match &amount {
        Amount::Near { scale, tolerance, unit, .. } => {
            Amount::Near { wanted: 0.0, scale: scale.clone(), tolerance: *tolerance, unit }
        }
        _ => Amount::Least,
    };
    // One gain for everything; else the one before digitizing carries it all. The others add nothing, as far as it is known
    // what adds nothing; those of taps balance halves of the sensor, and stay.
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
            for entry in &entries {
                let digital = plain(entry).contains("digital");
                let amount = if digital { &nothing } else { &amount };
                plan.writes.extend([select(entry), set(amount).optional()]);
            }
            if let Some(entry) = entries.iter().find(|entry| !plain(entry).contains("digital")) {
                plan.writes.extend([select(entry), set(&amount)]);
            }
        }
    }
}

fn gain(camera: &dyn Description, said_db: Option<f64>) -> Result<Option<(&'static str, Amount)>, Trouble> {
    let wanted_db = said_db.unwrap_or(0.0);
    let float = |name: &&'static str| {
        let feature = camera.feature(name).filter(|f| f.is_writable() && f.kind == Kind::Float)?;
        Some((*name, feature))
    };
    if let Some((name, feature)) = GAINS.iter().find_map(float) {
        let near = |scale| Amount::Near { wanted: wanted_db, scale, tolerance: TOLERANCE_DB, unit: "dB" };
        let unit = plain(feature.unit.as_deref().unwrap_or_default());
        match unit.as_str() {
            "db" | "decibel" | "decibels" => {
                check_bounds(name, &feature, wanted_db, WORD)?;
                return Ok(Some((name, near(Scale::Times(1.0)))));
            }
            "" | "x" | "times" | "factor" if feature.unit.as_deref() != Some("%") => {
                return Ok(Some((name, near(Scale::Gain))));
            }
            _ if wanted_db == 0.0 => return Ok(Some((name, Amount::Least))),
            _ => return Err(in_steps(name)),
        }
    }
    // Steps may be written with a point; only their own name says that they are none of decibels.
    let steps = |name: &&'static str| {
        let feature = camera.feature(name).filter(|f| f.is_writable() && f.is_number())?;
        Some((*name, plain(feature.unit.as_deref().unwrap_or_default())))
    };
    match STEPS.iter().find_map(steps) {
        Some((name, unit)) if unit == "db" => {
            let scale = Scale::Times(1.0);
            Ok(Some((name, Amount::Near { wanted: wanted_db, scale, tolerance: TOLERANCE_DB, unit: "dB" })))
        }
        Some((name, _)) if wanted_db == 0.0 => Ok(Some((name, Amount::Least))),
        Some((name, _)) => Err(in_steps(name)),
        // A camera without gain has none.
        None if wanted_db == 0.0 => Ok(None),
        None => Err(none_of(camera, &GAINS, "is its gain", WORD)),
    }
}

fn in_steps(name: &str) -> Trouble {
    Trouble::new(
        name,
        format!(
            "the camera counts its gain in steps ({name}) and does not say how many decibels one has: say gain_db = 0.0 \
             for the least gain, or left_to_settings = [\"gain_db\"] and [\"{name}\", STEPS] in `settings`, expected no other \
             gain_db"
        ),
    )
}
