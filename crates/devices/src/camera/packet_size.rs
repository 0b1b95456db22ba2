// SPDX-License-Identifier: MIT OR Apache-2.0
//! The size of a GigE camera's packets: the requested one, the next smaller one that the camera takes, or a refusal.

use super::description::Bounds;
use super::features::{Failed, Features, answered, or_reason};
use crate::config::FeatureValue;

/// The feature that holds the packet size, bytes with IP and UDP headers.
pub const FEATURE: &str = "GevSCPSPacketSize";

/// The largest size within the bounds that is not larger than the requested one, because the network may not carry
/// larger packets. Where there is none: the requested size, which the camera then refuses.
pub fn fitting(requested: u32, bounds: Bounds) -> u32 {
    let wanted = f64::from(requested);
    let most = bounds.max.map_or(wanted, |max| wanted.min(max));
    let Some(min) = bounds.min else { return most as u32 };
    let step = bounds.step.filter(|step| *step >= 1.0).unwrap_or(1.0);
    if most < min {
        return requested;
    }
    (min + ((most - min) / step).floor() * step) as u32
}

/// The message for a size that the camera refuses, with the sizes that it takes.
pub fn refusal(requested: u32, why: &str, bounds: Bounds, now: Option<i64>) -> String {
    let has = now.map_or_else(String::new, |now| format!(", it has {now}"));
    let remedy = match (now, bounds.min) {
        (_, Some(min)) if min > f64::from(requested) => format!("{min}"),
        (Some(now), _) => format!("{now}"),
        (None, _) => "one that it takes".to_owned(),
    };
    format!(
        "{FEATURE} cannot be set to {requested}: the camera refuses it ({why}); it takes {bounds}{has}: set \
         packet_bytes = {remedy}"
    )
}

/// Sets the packet size. Gives a remark for the operator where the camera takes a smaller one.
///
/// # Errors
/// [`Failed::Refused`] with the problem and its remedy.
pub fn set(camera: &dyn Features, requested: u32) -> Result<Option<String>, Failed> {
    let writable =
        camera.feature(FEATURE).is_some_and(|feature| feature.is_writable() && feature.is_number());
    if requested == 0 || !writable || !camera.is_available(FEATURE) {
        return Ok(None);
    }
    if answered(camera.integer(FEATURE))? == Some(requested.into()) {
        return Ok(None);
    }
    let bounds = camera.bounds_now(FEATURE);
    let size = FeatureValue::Integer(fitting(requested, bounds).into());
    let written = or_reason(camera.write(FEATURE, &size))?;
    let now = answered(camera.integer(FEATURE))?;
    let refused = |why: &str| Err(Failed::Refused(refusal(requested, why, bounds, now)));
    match (written, now) {
        (Err(why), _) => refused(&why),
        (Ok(()), Some(now)) if now > i64::from(requested) => {
            refused(&format!("it makes {now} of it, which the network may not carry"))
        }
        (Ok(()), Some(now)) if now < i64::from(requested) => {
            Ok(Some(format!("packet_bytes = {requested}: the camera takes {now} bytes ({FEATURE})")))
        }
        (Ok(()), _) => Ok(None),
    }
}

#[cfg(test)]
mod tests {
    use super::{Bounds, fitting, refusal};

    #[test]
    fn the_size_is_the_one_asked_for_or_the_next_smaller_one() {
        let bounds = |min, max, step| Bounds { min: Some(min), max: Some(max), step: Some(step) };
        assert_eq!(fitting(9000, Bounds::default()), 9000);
        assert_eq!(fitting(9000, bounds(220.0, 16_260.0, 4.0)), 9000);
        assert_eq!(fitting(9000, bounds(220.0, 16_260.0, 16.0)), 8988, "never the nearest one above");
        assert_eq!(fitting(9000, bounds(576.0, 1500.0, 4.0)), 1500);
        assert_eq!(fitting(576, bounds(1400.0, 1500.0, 4.0)), 576, "there is none");
    }

    #[test]
    fn a_refusal_says_what_the_camera_takes() {
        let bounds = Bounds { min: Some(1400.0), max: Some(1500.0), step: None };
        let text = refusal(576, "out of range", bounds, Some(1500));
        assert!(
            text.contains("cannot be set to 576") && text.contains("it takes 1400 to 1500, it has 1500"),
            "{text}"
        );
        assert!(text.ends_with("set packet_bytes = 1400"), "{text}");
        assert!(!text.contains("power"), "{text}");
    }
}
