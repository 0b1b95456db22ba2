// SPDX-License-Identifier: MIT OR Apache-2.0
//! The size of a GigE camera's packets: the one that is asked for, the next smaller one that it takes, or a refusal by name.

use super::CameraError;
use super::description::Bounds;
use super::features::{Failed, Features, answered};
use crate::config::FeatureValue;

/// The feature that says it.
pub const FEATURE: &str = "GevSCPSPacketSize";

/// The largest size within these limits that is no larger than the one asked for: a larger one fits into no frame of the
/// network. Where there is none, the size asked for, which the camera then refuses.
pub fn fitting(asked: u32, bounds: Bounds) -> u32 {
    let wanted = f64::from(asked);
    let most = bounds.max.map_or(wanted, |max| wanted.min(max));
    let Some(min) = bounds.min else { return most as u32 };
    let step = bounds.step.filter(|step| *step >= 1.0).unwrap_or(1.0);
    if most < min {
        return asked;
    }
    (min + ((most - min) / step).floor() * step) as u32
}

/// Why a camera takes no packets of a size, and what would do.
pub fn refusal(asked: u32, why: &str, bounds: Bounds, now: Option<i64>) -> String {
    let edge = |bound: Option<f64>| bound.map_or_else(|| "any".to_owned(), |bound| bound.to_string());
    let has = now.map_or_else(String::new, |now| format!(", it has {now}"));
    let say = match (now, bounds.min) {
        (_, Some(min)) if min > f64::from(asked) => format!("{min}"),
        (Some(now), _) => format!("{now}"),
        (None, _) => "one that it takes".to_owned(),
    };
    format!(
        "{FEATURE} cannot be set to {asked}: the camera refuses it ({why}); it takes {} to {}{has}: say packet_bytes = {say}",
        edge(bounds.min),
        edge(bounds.max)
    )
}

/// Sets it; what an operator should know of it, or the problem.
pub fn set(camera: &dyn Features, asked: u32) -> Result<Result<Option<String>, String>, CameraError> {
    let writable =
        camera.feature(FEATURE).is_some_and(|feature| feature.is_writable() && feature.is_number());
    if asked == 0 || !writable || !camera.is_available(FEATURE) {
        return Ok(Ok(None));
    }
    if answered(camera.integer(FEATURE))? == Some(asked.into()) {
        return Ok(Ok(None));
    }
    let bounds = camera.bounds_now(FEATURE);
    let wrote = camera.write(FEATURE, &FeatureValue::Integer(fitting(asked, bounds).into()));
    let now = answered(camera.integer(FEATURE))?;
    match (wrote, now) {
        (Err(Failed::Lost(error)), _) => Err(error),
        (Err(Failed::Refused(why) | Failed::Nonsense(why)), now) => {
            Ok(Err(refusal(asked, &why, bounds, now)))
        }
        (Ok(()), Some(now)) if now > i64::from(asked) => {
            let why = format!("it makes {now} of it, which the network may not carry");
            Ok(Err(refusal(asked, &why, bounds, Some(now))))
        }
        (Ok(()), Some(now)) if now < i64::from(asked) => {
            Ok(Ok(Some(format!("packet_bytes = {asked}: the camera takes {now} bytes ({FEATURE})"))))
        }
        (Ok(()), _) => Ok(Ok(None)),
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
        assert!(text.ends_with("say packet_bytes = 1400"), "{text}");
        assert!(!text.contains("power"), "{text}");
    }
}
