// SPDX-License-Identifier: MIT OR Apache-2.0
//! Exposure, and the time between two packets.

use super::{
    Amount, Plan, Scale, Trouble, Wishes, Write, check_bounds, first_writable, none_of, writable_number,
};
use crate::camera::description::{Description, plain};
use crate::config::PacketDelay;
use crate::network::wire;

/// Exposure as a time, in the order of standards, newest first.
const EXPOSURES: [&str; 6] =
    ["ExposureTime", "ExposureTimeAbs", "ExposureTimeUs", "IntegrationTime", "ShutterTimeAbs", "ShutterTime"];
/// Names that mean an exposure only where their unit is a time.
const IN_A_UNIT: [&str; 4] = ["Exposure", "ExposureValue", "Shutter", "ShutterSpeed"];
/// Exposure in ticks, and the features that may say how long a tick is.
const RAW: &str = "ExposureTimeRaw";
const TICKS: [&str; 4] =
    ["ExposureTimeBaseAbs", "ExposureTimebaseAbs", "ExposureTimeBase", "ExposureTimeRawUnit"];
/// By how much a camera's nearest exposure may differ, unless the node file says: the lines of the slowest sensors.
const TOLERANCE_US: f64 = 20.0;

/// How many of this unit are a microsecond; `None` for a unit that is no time.
fn per_microsecond(unit: Option<&str>) -> Option<f64> {
    let unit = unit.map(str::trim).unwrap_or_default();
    // SFNC: microseconds.
    if unit.is_empty() {
        return Some(1.0);
    }
    // A letter of another alphabet before seconds is a mu, or what was made of one on its way.
    let prefix = if unit.is_ascii() { "" } else { "u" };
    match format!("{prefix}{}", plain(unit)).as_str() {
        "us" | "usec" | "usecs" | "usecond" | "useconds" | "microsec" | "microsecs" | "microsecond"
        | "microseconds" => Some(1.0),
        "ms" | "msec" | "msecs" | "millisec" | "millisecs" | "millisecond" | "milliseconds" => Some(1e-3),
        "s" | "sec" | "secs" | "second" | "seconds" => Some(1e-6),
        "ns" | "nsec" | "nsecs" | "nanosec" | "nanosecs" | "nanosecond" | "nanoseconds" => Some(1e3),
        _ => None,
    }
}

pub fn exposure(camera: &dyn Description, wishes: &Wishes, plan: &mut Plan) {
    if wishes.left_to_settings("exposure_us") {
        return;
    }
    // One exposure for all lines of a sensor that could have several.
    for (name, entries) in
        [("ExposureTimeMode", &["Common"][..]), ("ExposureTimeSelector", &["Common", "All"])]
    {
        if let Some((name, feature)) = first_writable(camera, &[name])
            && let Some(entry) = feature.entry(entries)
        {
            plan.writes.push(Write::entry(name, entry, "exposure_us").optional());
        }
    }
    plan.add(exposure_write(camera, wishes).map(Some));
}

fn exposure_write(camera: &dyn Description, wishes: &Wishes) -> Result<Write, Trouble> {
    const WORD: &str = "exposure_us";
    let wanted = wishes.exposure_us();
    let near = |name: &str, scale: Scale| {
        let tolerance = wishes.words.exposure_tolerance_us.unwrap_or(TOLERANCE_US);
        Write::new(name, Amount::Near { wanted, scale, tolerance, unit: "us" }, WORD)
    };
    let time = |name: &&'static str| {
        let feature = writable_number(camera, name)?;
        Some((*name, per_microsecond(feature.unit.as_deref())?, feature))
    };
    let in_a_unit = |name: &&'static str| time(name).filter(|(_, _, feature)| feature.unit.is_some());
    let found =
        EXPOSURES.iter().find_map(time).or_else(|| IN_A_UNIT.iter().chain([&RAW]).find_map(in_a_unit));
    if let Some((name, scale, feature)) = found {
        check_bounds(name, &feature, wanted * scale, &format!("; change {WORD}"))?;
        return Ok(near(name, Scale::Times(scale)));
    }
    if writable_number(camera, RAW).is_none() {
        return Err(none_of(camera, &EXPOSURES, "is its exposure", WORD));
    }
    let tick = TICKS.iter().find(|name| camera.feature(name).is_some_and(|f| f.is_number()));
    match tick {
        Some(tick) => Ok(near(RAW, Scale::Ticks((*tick).to_owned()))),
        None => Err(Trouble::new(
            RAW,
            format!(
                "the camera counts its exposure in ticks ({RAW}), expected a feature with the length of one (looked \
                 for {}): set [\"{RAW}\", TICKS] in `settings`, and set left_to_settings = [\"{WORD}\"]",
                TICKS.join(", ")
            ),
        )),
    }
}

/// The gap that cameras in one network leave between packets, as a share of what the others need.
pub fn packet_delay(camera: &dyn Description, wishes: &Wishes, plan: &mut Plan) {
    const WORD: &str = "packet_delay_us";
    let Some(delay) = wishes.words.packet_delay else { return };
    if wishes.left_to_settings(WORD) {
        return;
    }
    let delay_us = match delay {
        PacketDelay::Microseconds(delay_us) => delay_us,
        PacketDelay::Auto => automatic_us(wishes, plan.image_bytes(wishes)),
    };
    let names = ["GevSCPD", "GevSCPDelay", "StreamPacketsB2BDelay"];
    let Some((name, feature)) = first_writable(camera, &names) else {
        if delay == PacketDelay::Auto && limit_rate(camera, wishes, plan) {
            return;
        }
        // No delay needs no feature; USB has no packets.
        if delay_us > 0.0 {
            plan.troubles.push(none_of(camera, &names, "is the time between two packets", WORD));
        }
        return;
    };
    let scale = match feature.unit.as_deref().and_then(|unit| per_microsecond(Some(unit))) {
        Some(times) => Scale::Times(times),
        None if delay_us == 0.0 => Scale::Times(1.0),
        None => Scale::Clock,
    };
    let amount = Amount::Near { wanted: delay_us, scale, tolerance: 1.0 + delay_us * 0.1, unit: "us" };
    plan.writes.push(Write::new(name, amount, WORD));
}

/// Cameras that pace their packets by bytes a second get as many as a frame needs in nine tenths of a period.
fn limit_rate(camera: &dyn Description, wishes: &Wishes, plan: &mut Plan) -> bool {
    if wishes.link.cameras < 2 {
        return false;
    }
    let bytes_per_s = |name: &&'static str| {
        let feature = writable_number(camera, name)?;
        let unit = plain(feature.unit.as_deref().unwrap_or_default());
        ["", "bps", "bytess", "bytespersecond"].contains(&unit.as_str()).then_some(*name)
    };
    let names = ["StreamBytesPerSecond", "DeviceLinkThroughputLimit"];
    let Some(name) = names.iter().find_map(bytes_per_s) else { return false };
    // Headers are a twentieth where packets are small.
    let wanted = plan.image_bytes(wishes) as f64 * 1.05 * 1e9 / (0.9 * wishes.link.period_ns as f64);
    let amount = Amount::Near { wanted, scale: Scale::Times(1.0), tolerance: 0.05 * wanted, unit: "bytes/s" };
    plan.writes.push(Write::new(name, amount, "packet_delay_us"));
    true
}

/// With k cameras in one network each leaves room for the packets of the others on the slowest link that cameras have, as far
/// as its frame then still fits into nine tenths of a period.
fn automatic_us(wishes: &Wishes, image_bytes: usize) -> f64 {
    let Wishes { link, .. } = wishes;
    if link.cameras < 2 || link.packet_bytes < 64 {
        return 0.0;
    }
    /// 1 Gbit/s.
    const BITS_PER_US: f64 = 1000.0;
    let packets = image_bytes as f64 / (u64::from(link.packet_bytes) - wire::HEADERS) as f64;
    let each_us = 0.9 * link.period_ns as f64 / 1000.0 / packets;
    let share = (link.cameras - 1) as f64 / link.cameras as f64;
    let others_us = (u64::from(link.packet_bytes) + wire::ETHERNET) as f64 * 8.0 / BITS_PER_US
        * (link.cameras - 1) as f64;
    ((each_us * share).min(others_us) * 10.0).floor() / 10.0
}
