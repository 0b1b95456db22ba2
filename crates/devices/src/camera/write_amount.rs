// SPDX-License-Identifier: MIT OR Apache-2.0
//! One value is written as near to what is wanted as the camera can, and read back.

use super::CameraError;
use super::description::{Access, Bounds, Kind, list};
use super::features::{Failed, Features, answered};
use super::profile::{Amount, Scale, Write};
use crate::config::FeatureValue;

/// What a write came to.
#[derive(Debug, Clone, PartialEq)]
pub struct Done {
    /// What was asked for, as the feature counts.
    pub requested: FeatureValue,
    /// What was read back.
    pub actual: FeatureValue,
    /// What an operator should know of it.
    pub told: Option<String>,
}

/// Whether a camera has another value than the one that it should have.
pub fn differs(wanted: &FeatureValue, actual: &FeatureValue) -> bool {
    use FeatureValue::{Flag, Float, Integer, Text};
    match (wanted, actual) {
        (Flag(a), Integer(b)) => i64::from(*a) != *b,
        (Float(a), Integer(b)) | (Integer(b), Float(a)) => (a - *b as f64).abs() > 0.5,
        // A number that was read back and is read again is the same.
        (Float(a), Float(b)) => (a - b).abs() > 1e-3 * a.abs().max(1.0),
        (Text(a), Text(b)) => a != b,
        (a, b) => a != b,
    }
}

/// The bootstrap registers of GigE Vision with the frequency of the camera's clock.
const FREQUENCY: [u64; 2] = [0x093c, 0x0940];

/// Writes; the inner error is a problem in words.
pub fn write(camera: &dyn Features, write: &Write) -> Result<Result<Done, String>, CameraError> {
    let name = write.feature.as_str();
    let bounds = camera.bounds_now(name);
    match &write.amount {
        Amount::Value(value) => whole(camera, write, value, bounds),
        Amount::Least => {
            let least = bounds.min.unwrap_or(0.0);
            let value = number_of(camera, name, least);
            whole(camera, write, &value, Bounds::default())
        }
        Amount::Near { wanted, scale, tolerance, unit } => {
            let per_unit = match per_unit(camera, scale, bounds)? {
                Ok(per_unit) => per_unit,
                Err(why) => return Ok(Err(format!("{name} cannot be set by {}: {why}", write.word))),
            };
            near(camera, write, Number { wanted: *wanted, per_unit, tolerance: *tolerance, unit }, bounds)
        }
    }
}

/// A value that must be taken as it is.
fn whole(
    camera: &dyn Features,
    write: &Write,
    value: &FeatureValue,
    bounds: Bounds,
) -> Result<Result<Done, String>, CameraError> {
    let name = write.feature.as_str();
    if let FeatureValue::Text(text) = value {
        let entries = camera.entries(name);
        if !entries.is_empty() && !entries.contains(text) {
            return Ok(Err(format!(
                "`{text}` is not among the entries of {name} that the camera has now: {}{}",
                list(&entries),
                change(write)
            )));
        }
    }
    if let FeatureValue::Integer(number) = value {
        let number = *number as f64;
        let outside =
            bounds.min.is_some_and(|min| number < min) || bounds.max.is_some_and(|max| number > max);
        if outside {
            return Ok(Err(format!(
                "{name} takes {} now, asked for {number}{}",
                range(bounds),
                change(write)
            )));
        }
    }
    let fixed = camera.feature(name).is_some_and(|feature| !feature.is_writable());
    if !fixed && let Err(failed) = camera.write(name, value) {
        return refused(write, &value.to_string(), failed);
    }
    if camera.feature(name).is_some_and(|feature| feature.access == Access::Write) {
        // A key is secret: that it was taken is all that can be known.
        return Ok(Ok(Done { requested: value.clone(), actual: value.clone(), told: None }));
    }
    let actual = match camera.read(name) {
        Ok(actual) => actual,
        Err(failed) => return refused(write, &value.to_string(), failed),
    };
    if differs(value, &actual) && fixed {
        return Ok(Err(format!(
            "{name} is {actual}, expected {value}, and can only be read{}",
            change(write)
        )));
    }
    if differs(value, &actual) {
        return Ok(Err(format!("{name} is {actual}, although it was set to {value}{}", change(write))));
    }
    Ok(Ok(Done { requested: value.clone(), actual, told: None }))
}

struct Number {
    wanted: f64,
    /// From the word's unit to the feature's and back.
    per_unit: PerUnit,
    tolerance: f64,
    unit: &'static str,
}

/// How a number of the word's unit is one of the feature's.
#[derive(Clone, Copy)]
enum PerUnit {
    Times(f64),
    /// A factor for decibels.
    Factor,
    /// Steps of a size that is not known: the least stands for nothing.
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

fn near(
    camera: &dyn Features,
    write: &Write,
    number: Number,
    bounds: Bounds,
) -> Result<Result<Done, String>, CameraError> {
    let name = write.feature.as_str();
    let Number { wanted, per_unit, tolerance, unit } = number;
    let asked = format!("{} = {wanted}", write.word);
    let value = per_unit.to_feature(wanted);
    let least = per_unit.to_word(bounds.min.unwrap_or(value));
    let most = per_unit.to_word(bounds.max.unwrap_or(value));
    // The camera itself says how far it goes, which is more than its description does.
    if wanted < least - tolerance || wanted > most + tolerance {
        let then = match write.word {
            "packet_delay_us" if wanted > most => {
                "; packets of cameras on one link then come closer to each other, and the switch must hold them: give the \
                 camera a port of its own, or let each packet be larger (acquisition.packet_bytes)"
            }
            _ => "",
        };
        return Ok(Err(format!(
            "{name} takes {} to {} {unit} now, asked for {asked}: say {} within that{then}",
            rounded(least),
            rounded(most),
            write.word
        )));
    }
    let value = nearest_step(value, bounds);
    let value = number_of(camera, name, value);
    if let Err(failed) = camera.write(name, &value) {
        return refused(write, &value.to_string(), failed);
    }
    let actual = match camera.read(name) {
        Ok(actual) => actual,
        Err(failed) => return refused(write, &value.to_string(), failed),
    };
    let taken = per_unit.to_word(as_number(&actual));
    let off = (taken - wanted).abs();
    if !taken.is_finite() || off > tolerance + 1e-9 * wanted.abs() {
        let allow = match write.word {
            "exposure_us" => format!(", or exposure_tolerance_us = {}", off.ceil()),
            _ => String::new(),
        };
        return Ok(Err(format!(
            "{asked}: the nearest that the camera takes is {1} {unit} ({name} is {actual}), more than {tolerance} \
             {unit} away; say {} = {1}{allow}",
            write.word,
            rounded(taken)
        )));
    }
    let told = (off > 1e-3 * wanted.abs().max(1.0) * 0.1)
        .then(|| format!("{asked}: the camera takes {} {unit} ({name} {actual})", rounded(taken)));
    Ok(Ok(Done { requested: value, actual, told }))
}

fn per_unit(
    camera: &dyn Features,
    scale: &Scale,
    bounds: Bounds,
) -> Result<Result<PerUnit, String>, CameraError> {
    Ok(match scale {
        Scale::Times(times) => Ok(PerUnit::Times(*times)),
        Scale::Ticks(feature) => {
            let tick_us = answered(camera.read(feature))?.map_or(0.0, |value| as_number(&value));
            match tick_us > 0.0 {
                true => Ok(PerUnit::Times(1.0 / tick_us)),
                false => Err(format!("{feature}, which says how long a tick is, cannot be read")),
            }
        }
        Scale::Clock => match tick_frequency(camera)? {
            Some(hz) => Ok(PerUnit::Times(hz as f64 / 1e6)),
            None => Err(
                "it counts ticks, and the camera does not say how many a second has; set it in `settings`, \
                 and say left_to_settings = [\"packet_delay_us\"]"
                    .to_owned(),
            ),
        },
        Scale::Gain => match bounds.min {
            // A factor of one adds nothing; below it are those that dim, and none is zero.
            Some(min) if min > 0.0 && min <= 1.5 => Ok(PerUnit::Factor),
            Some(min) if min <= 0.0 => Ok(PerUnit::Times(1.0)),
            Some(min) => Ok(PerUnit::LeastAlone(min)),
            None => Ok(PerUnit::Times(1.0)),
        },
    })
}

fn tick_frequency(camera: &dyn Features) -> Result<Option<u64>, CameraError> {
    const FEATURE: &str = "GevTimestampTickFrequency";
    let stated = match camera.has(FEATURE) {
        true => answered(camera.integer(FEATURE))?.and_then(|hz| u64::try_from(hz).ok()),
        false => None,
    };
    if let Some(hz) = stated.filter(|hz| *hz > 0) {
        return Ok(Some(hz));
    }
    if !camera.has_registers() {
        return Ok(None);
    }
    let high = answered(camera.register(FREQUENCY[0]))?.unwrap_or(0);
    let low = answered(camera.register(FREQUENCY[1]))?.unwrap_or(0);
    Ok(Some(u64::from(high) << 32 | u64::from(low)).filter(|hz| *hz > 0))
}

/// The nearest value that lies in the bounds and on their steps.
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

/// A number as the feature's kind has it.
fn number_of(camera: &dyn Features, feature: &str, number: f64) -> FeatureValue {
    match camera.feature(feature).map(|known| known.kind) {
        Some(Kind::Integer) => FeatureValue::Integer(number.round() as i64),
        _ => FeatureValue::Float(number),
    }
}

/// As people read it.
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

fn range(bounds: Bounds) -> String {
    let edge = |bound: Option<f64>| bound.map_or_else(|| "any".to_owned(), |bound| bound.to_string());
    format!("{} to {}", edge(bounds.min), edge(bounds.max))
}

fn change(write: &Write) -> String {
    match write.word {
        "" => String::new(),
        "width" | "height" => "; the rig file has this size for it".to_owned(),
        word => format!("; change {word}"),
    }
}

fn refused(write: &Write, value: &str, failed: Failed) -> Result<Result<Done, String>, CameraError> {
    match failed {
        Failed::Lost(error) => Err(error),
        Failed::Refused(why) | Failed::Nonsense(why) => Ok(Err(format!(
            "{} cannot be set to {value}: the camera refuses it ({why}){}",
            write.feature,
            change(write)
        ))),
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
