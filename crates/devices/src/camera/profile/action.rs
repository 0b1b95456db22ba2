// SPDX-License-Identifier: MIT OR Apache-2.0
//! The trigger as an action command: the source, the keys, and the clock that all cameras share.

use super::plan::{Amount, Plan, Trouble, Write, first_writable};
use crate::camera::description::{Description, Feature, list, nearest, plain};
use crate::config::{ActionConfig, FeatureValue};

const WORD: &str = "trigger.source";
const SOURCE: &str = "TriggerSource";
/// Features that switch PTP on: SFNC 2.3 and later, GigE Vision 2.0, and a spelling of vendors.
pub const PTP_SWITCHES: [&str; 3] = ["PtpEnable", "GevIEEE1588", "PtpMode"];

/// The trigger source that is an action: the entry with the lowest number.
pub(super) fn source(camera: &dyn Description) -> Result<Option<Write>, Trouble> {
    const REMEDY: &str =
        "it cannot be triggered by action commands: use an HSU (source = \"hsu\"), or another camera";
    let Some(feature) = camera.feature(SOURCE) else {
        return Err(Trouble::new(SOURCE, format!("the camera has no {SOURCE}, and {REMEDY}")));
    };
    let number = |entry: &String| plain(entry).strip_prefix("action")?.parse::<u32>().ok();
    match feature.entries.iter().filter(|entry| number(entry).is_some()).min_by_key(|entry| number(entry)) {
        Some(entry) => Ok(Some(Write::entry(SOURCE, entry, WORD))),
        None => Err(Trouble::no_entry(SOURCE, "Action0", &feature, REMEDY)),
    }
}

/// Adds keys and mask of the action with the lowest number.
pub(super) fn keys(camera: &dyn Description, action: ActionConfig, plan: &mut Plan) {
    if let Some((name, feature)) = first_writable(camera, &["ActionSelector"]) {
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
        let key = Amount::Value(FeatureValue::Integer(key.into()));
        plan.add(match camera.feature(name).filter(Feature::is_writable) {
            Some(_) => Ok([Write::new(name, key, WORD)]),
            None => Err(Trouble::new(
                name,
                format!(
                    "the camera has no {name} that can be set (nearest names: {}), and cannot be triggered by action \
                     commands: use an HSU (source = \"hsu\"), or another camera",
                    list(&nearest(name, &camera.names()))
                ),
            )),
        });
    }
}

/// Switches PTP on, because scheduled actions need a clock that all cameras share.
pub(super) fn ptp(camera: &dyn Description) -> Result<Option<Write>, Trouble> {
    let switch = first_writable(camera, &PTP_SWITCHES).and_then(|(name, feature)| {
        let on = match feature.entry(&["Auto", "On", "True", "Slave"]) {
            Some(entry) => FeatureValue::Text(entry.to_owned()),
            None => feature.entries.is_empty().then_some(FeatureValue::Flag(true))?,
        };
        Some(Write::new(name, Amount::Value(on), WORD))
    });
    let none = || {
        Trouble::new(
            PTP_SWITCHES[0],
            format!(
                "the camera has no PTP that can be switched on (looked for {}), and actions cannot be scheduled: set \
                 trigger.ptp = false for actions at once, whose exposures differ by what the network delays them",
                PTP_SWITCHES.join(", ")
            ),
        )
    };
    switch.map(Some).ok_or_else(none)
}
