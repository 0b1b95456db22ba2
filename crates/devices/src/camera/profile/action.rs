// SPDX-License-Identifier: MIT OR Apache-2.0
//! The trigger as an action command: the source, the keys, and the clock that all cameras share.

use super::{Amount, Plan, Trouble, Write, first_writable};
use crate::camera::description::{Description, Feature, list, nearest, plain};
use crate::config::{ActionConfig, FeatureValue};

pub(super) const WORD: &str = "trigger.source";
const SOURCE: &str = "TriggerSource";
/// What switches PTP on, before SFNC 2.3 and after.
pub const PTP_SWITCHES: [&str; 3] = ["PtpEnable", "GevIEEE1588", "PtpMode"];

/// The entry of the trigger's source that is an action: the one with the lowest number.
pub(super) fn source(camera: &dyn Description) -> Result<Write, Trouble> {
    const REMEDY: &str =
        "it cannot be triggered by action commands: use an HSU (source = \"hsu\"), or another camera";
    let Some(feature) = camera.feature(SOURCE) else {
        return Err(Trouble::new(SOURCE, format!("the camera has no {SOURCE}, and {REMEDY}")));
    };
    let number = |entry: &String| plain(entry).strip_prefix("action")?.parse::<u32>().ok();
    match feature.entries.iter().filter(|entry| number(entry).is_some()).min_by_key(|entry| number(entry)) {
        Some(entry) => Ok(Write::entry(SOURCE, entry, WORD)),
        None => Err(Trouble::no_entry(SOURCE, "Action0", &feature, REMEDY)),
    }
}

/// Keys and mask of the action with the lowest number.
pub(super) fn keys(camera: &dyn Description, action: ActionConfig, plan: &mut Plan) {
    let selector = first_writable(camera, &["ActionSelector"]);
    if let Some((name, feature)) = &selector {
        let least = match feature.entries.first() {
            Some(entry) => Amount::Value(FeatureValue::Text(entry.clone())),
            None => Amount::Least,
        };
        plan.writes.push(Write::new(name, least, WORD).optional());
    }
    for (name, key) in [
        ("ActionDeviceKey", action.device_key),
        ("ActionGroupKey", action.group_key),
        ("ActionGroupMask", action.group_mask),
    ] {
        match camera.feature(name).filter(Feature::is_writable) {
            Some(_) => {
                let key = Amount::Value(FeatureValue::Integer(key.into()));
                plan.writes.push(Write::new(name, key, WORD));
            }
            None => plan.troubles.push(Trouble::new(
                name,
                format!(
                    "the camera has no {name} that can be set (nearest names: {}), and cannot be triggered by action \
                     commands: use an HSU (source = \"hsu\"), or another camera",
                    list(&nearest(name, &camera.names()))
                ),
            )),
        }
    }
}

/// PTP on.
pub(super) fn ptp(camera: &dyn Description, plan: &mut Plan) {
    let found = first_writable(camera, &PTP_SWITCHES);
    let on = found.as_ref().and_then(|(_, feature)| match feature.entry(&["Auto", "On", "True", "Slave"]) {
        Some(entry) => Some(FeatureValue::Text(entry.to_owned())),
        None if feature.entries.is_empty() => Some(FeatureValue::Flag(true)),
        None => None,
    });
    match (found, on) {
        (Some((name, _)), Some(on)) => plan.writes.push(Write::new(name, Amount::Value(on), WORD)),
        _ => plan.troubles.push(Trouble::new(
            PTP_SWITCHES[0],
            format!(
                "the camera has no PTP that can be switched on (looked for {}), and actions cannot be scheduled: say \
                 trigger.ptp = false for actions at once, whose exposures differ by what the network delays them",
                PTP_SWITCHES.join(", ")
            ),
        )),
    }
}
