// SPDX-License-Identifier: MIT OR Apache-2.0
//! Writes one value as near to the wanted one as the camera can take, and reads it back.

use super::description::{Access, Bounds, list};
use super::error::CameraError;
use super::features::{FREQUENCY, Failed, Features, answered, number_of, stated_frequency};
use super::profile::{Amount, Scale, Write};
use super::settings::differs;
use crate::config::FeatureValue;

/// A value that was written and read back.
#[derive(Debug, Clone, PartialEq)]
pub struct Done {
    /// The requested value, in the feature's unit.
    pub requested: FeatureValue,
    /// The value that the camera has now.
    pub actual: FeatureValue,
    /// What the operator should know: that the camera rounded the value.
    pub remark: Option<String>,
}

/// Writes a value and reads it back.
///
/// # Errors
/// [`Failed::Refused`] with the problem and its remedy; [`Failed::Lost`] when the camera does not answer.
pub fn write(camera: &dyn Features, write: &Write) -> Result<Done, Failed> {
    let name = write.feature.as_str();
    let bounds = camera.bounds_now(name);
    match &write.amount {
        Amount::Value(value) => whole(camera, write, value, bounds),
        Amount::Least => {
            let value = number_of(camera, name, bounds.min.unwrap_or(0.0));
            whole(camera, write, &value, Bounds::default())
        }
        Amount::Near { wanted, scale, tolerance, unit } => {
            let per_unit = per_unit(camera, scale, bounds)?
                .map_err(|why| Failed::Refused(format!("{name} cannot be set by {}: {why}", write.word)))?;
            near(camera, write, Number { wanted: *wanted, per_unit, tolerance: *tolerance, unit }, bounds)
        }
    }
}

/// Writes a value that the camera must take exactly.
fn whole(camera: &dyn Features, write: &Write, value: &FeatureValue, bounds: Bounds) -> Result<Done, Failed> {
    let name = write.feature.as_str();
    let problem = |text: String| Err(Failed::Refused(text + &change(write)));
    if let FeatureValue::Text(text) = value {
        let entries = camera.entries(name);
        if !entries.is_empty() && !entries.contains(text) {
            return problem(format!(
                "`{text}` is not among the entries of {name} that the camera has now: {}",
                list(&entries)
            ));
        }
    }
    if let FeatureValue::Integer(number) = value
        && bounds.exclude(*number as f64)
    {
        return problem(format!("{name} takes {bounds} now, requested {number}"));
    }
    let known = camera.feature(name);
    let fixed = known.as_ref().is_some_and(|feature| !feature.is_writable());
    if !fixed {
        camera.write(name, value).map_err(|failed| refused(write, value, failed))?;
    }
    if known.is_some_and(|feature| feature.access == Access::Write) {
        // A write-only value, as a key, cannot be read back.
        return Ok(Done { requested: value.clone(), actual: value.clone(), remark: None });
    }
    let actual = camera.read(name).map_err(|failed| refused(write, value, failed))?;
    match (differs(value, &actual), fixed) {
        (true, true) => problem(format!("{name} is {actual}, expected {value}, and can only be read")),
        (true, false) => problem(format!("{name} is {actual}, although it was set to {value}")),
        (false, _) => Ok(Done { requested: value.clone(), actual, remark: None }),
    }
}

/// A wanted number, and how it is converted to the feature's unit.
struct Number {
    wanted: f64,
    per_unit: PerUnit,
    tolerance: f64,
    unit: &'static str,
}

/// How a number in the configuration key's unit is converted to the feature's unit, and back.
#[derive(Clone, Copy)]
enum PerUnit {
    /// The feature has this many units for one of the key's.
    Times(f64),
    /// The feature is a factor, and the key counts decibels.
    Factor,
    /// The feature counts steps of unknown size, so only its least value has a meaning: 0.
    LeastAlone(f64),
}

impl PerUnit {
    fn to_feature(self, number: f64) -> f64 {
        match self {
            Self::Times(times) => number * times,
            Self::Factor => 10f64.powf(number / 20.0),
            Self::LeastAlone(least) => least,
        }
    }

    fn to_word(self, value: f64) -> f64 {
        match self {
            Self::Times(times) => value / times,
            Self::Factor => 20.0 * value.max(f64::MIN_POSITIVE).log10(),
            Self::LeastAlone(least) => value - least,
        }
    }
}

/// Writes the nearest value that the camera takes, within the tolerance.
fn near(camera: &dyn Features, write: &Write, number: Number, bounds: Bounds) -> Result<Done, Failed> {
    let name = write.feature.as_str();
    let Number { wanted, per_unit, tolerance, unit } = number;
    let requested = format!("{} = {wanted}", write.word);
    let value = per_unit.to_feature(wanted);
    let least = per_unit.to_word(bounds.min.unwrap_or(value));
    let most = per_unit.to_word(bounds.max.unwrap_or(value));
    // The bounds of the moment may be narrower than those of the description.
    if wanted < least - tolerance || wanted > most + tolerance {
        let then = match write.word {
            "packet_delay_us" if wanted > most => {
                "; packets of cameras on one link then come closer to each other, and the switch must hold them: give \
                 the \
                 camera a port of its own, or let each packet be larger (acquisition.packet_bytes)"
            }
            _ => "",
        };
        return Err(Failed::Refused(format!(
            "{name} takes {} to {} {unit} now, requested {requested}: set {} within that{then}",
            rounded(least),
            rounded(most),
            write.word
        )));
    }
    let value = number_of(camera, name, nearest_step(value, bounds));
    camera.write(name, &value).map_err(|failed| refused(write, &value, failed))?;
    let actual = camera.read(name).map_err(|failed| refused(write, &value, failed))?;
    let taken = per_unit.to_word(as_number(&actual));
    let off = (taken - wanted).abs();
    if !taken.is_finite() || off > tolerance + 1e-9 * wanted.abs() {
        let allow = match write.word {
            "exposure_us" => format!(", or exposure_tolerance_us = {}", off.ceil()),
            _ => String::new(),
        };
        return Err(Failed::Refused(format!(
            "{requested}: the nearest that the camera takes is {1} {unit} ({name} is {actual}), more than {tolerance} \
             {unit} away; set {} = {1}{allow}",
            write.word,
            rounded(taken)
        )));
    }
    let remark = (off > 1e-3 * wanted.abs().max(1.0) * 0.1)
        .then(|| format!("{requested}: the camera takes {} {unit} ({name} {actual})", rounded(taken)));
    Ok(Done { requested: value, actual, remark })
}

/// How a scale converts numbers for this camera; the inner error names what the camera does not state.
fn per_unit(
    camera: &dyn Features,
    scale: &Scale,
    bounds: Bounds,
) -> Result<Result<PerUnit, String>, CameraError> {
    Ok(match scale {
        Scale::Times(times) => Ok(PerUnit::Times(*times)),
        Scale::Ticks(feature) => match answered(camera.read(feature))?.map(|value| as_number(&value)) {
            Some(tick_us) if tick_us > 0.0 => Ok(PerUnit::Times(1.0 / tick_us)),
            _ => Err(format!("{feature}, which states the length of a tick, cannot be read")),
        },
        Scale::Clock => match tick_frequency(camera)? {
            Some(hz) => Ok(PerUnit::Times(hz as f64 / 1e6)),
            None => Err(
                "it counts ticks, and the camera does not state how many a second has; set it in `settings`, \
                 and set left_to_settings = [\"packet_delay_us\"]"
                    .to_owned(),
            ),
        },
        // A gain factor begins near one, and may begin below one, but never at zero.
        Scale::Gain => Ok(match bounds.min {
            Some(min) if min > 0.0 && min <= 1.5 => PerUnit::Factor,
            Some(min) if min > 1.5 => PerUnit::LeastAlone(min),
            _ => PerUnit::Times(1.0),
        }),
    })
}

/// Ticks of the camera's clock a second: by its feature, else by its registers. A half that a camera does not answer is 0.
fn tick_frequency(camera: &dyn Features) -> Result<Option<u64>, CameraError> {
    if let Some(hz) = stated_frequency(camera)? {
        return Ok(Some(hz));
    }
    if !camera.has_registers() {
        return Ok(None);
    }
    let [high, low] = FREQUENCY.map(|register| answered(camera.register(register)));
    let (high, low) = (high?.unwrap_or(0), low?.unwrap_or(0));
    Ok(Some(u64::from(high) << 32 | u64::from(low)).filter(|hz| *hz > 0))
}

/// The nearest value that lies within the bounds and on a step.
fn nearest_step(value: f64, bounds: Bounds) -> f64 {
    let (min, max) = (bounds.min.unwrap_or(f64::MIN), bounds.max.unwrap_or(f64::MAX));
    let value = if min <= max { value.clamp(min, max) } else { value };
    match (bounds.step, bounds.min) {
        (Some(step), Some(min)) if step > 1e-9 && step < value.abs().max(1.0) => {
            let stepped = min + ((value - min) / step).round() * step;
            if stepped > max { stepped - step } else { stepped }
        }
        _ => value,
    }
}

/// Three decimals are enough for a message.
fn rounded(number: f64) -> f64 {
    (number * 1e3).round() / 1e3
}

fn as_number(value: &FeatureValue) -> f64 {
    match value {
        FeatureValue::Integer(value) => *value as f64,
        FeatureValue::Float(value) => *value,
        FeatureValue::Flag(_) | FeatureValue::Text(_) => f64::NAN,
    }
}

/// The end of a message: which key of the configuration to change.
fn change(write: &Write) -> String {
    match write.word {
        "" => String::new(),
        "width" | "height" => "; the rig file has this size for it".to_owned(),
        word => format!("; change {word}"),
    }
}

/// Adds feature and value to the reason of a refusal.
fn refused(write: &Write, value: &FeatureValue, failed: Failed) -> Failed {
    match failed {
        Failed::Refused(why) | Failed::Nonsense(why) => Failed::Refused(format!(
            "{} cannot be set to {value}: the camera refuses it ({why}){}",
            write.feature,
            change(write)
        )),
        lost @ Failed::Lost(_) => lost,
    }
}

#[cfg(test)]
mod tests {
    use super::{Bounds, PerUnit, nearest_step};

    #[test]
    fn values_go_to_the_nearest_step() {
        let bounds = |min, max, step| Bounds { min: Some(min), max: Some(max), step: Some(step) };
        assert_eq!(nearest_step(1000.0, bounds(35.0, 10_000.0, 35.0)), 1015.0);
        assert_eq!(nearest_step(1000.0, bounds(10.0, 500.0, 7.0)), 500.0);
        assert_eq!(nearest_step(1000.0, bounds(10.0, 1e6, 0.0)), 1000.0);
        assert_eq!(nearest_step(1000.0, Bounds::default()), 1000.0);
    }

    #[test]
    fn decibels_are_a_factor_and_back() {
        assert!((PerUnit::Factor.to_feature(6.0) - 1.995).abs() < 1e-3);
        assert!((PerUnit::Factor.to_word(1.0)).abs() < 1e-12);
        assert_eq!(PerUnit::LeastAlone(66.0).to_feature(0.0), 66.0);
    }
}
