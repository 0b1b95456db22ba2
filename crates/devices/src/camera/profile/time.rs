// SPDX-License-Identifier: MIT OR Apache-2.0
//! Exposure, and the time between two packets.

use super::plan::{Amount, Plan, Scale, Trouble, Wishes, Write, first_writable, none_of, writable_number};
use crate::camera::description::{Description, plain};
use crate::config::PacketDelay;
use crate::network::wire;

/// Features with the exposure as a time, newest standard first.
const EXPOSURES: [&str; 6] =
    ["ExposureTime", "ExposureTimeAbs", "ExposureTimeUs", "IntegrationTime", "ShutterTimeAbs", "ShutterTime"];
/// Features that are the exposure only where their unit is a time.
const IN_A_UNIT: [&str; 4] = ["Exposure", "ExposureValue", "Shutter", "ShutterSpeed"];
/// Feature with the exposure in ticks.
const RAW: &str = "ExposureTimeRaw";
/// Features that may hold the length of a tick, microseconds.
const TICKS: [&str; 4] =
    ["ExposureTimeBaseAbs", "ExposureTimebaseAbs", "ExposureTimeBase", "ExposureTimeRawUnit"];
/// Largest difference between the camera's exposure and the requested one, microseconds, unless the node file has
/// another: the time of a line of the slowest sensors.
const TOLERANCE_US: f64 = 20.0;

/// How many of this unit are one microsecond; `None` for a unit that is no time.
fn per_microsecond(unit: Option<&str>) -> Option<f64> {
    let unit = unit.map(str::trim).unwrap_or_default();
    // Without a unit, SFNC means microseconds.
    if unit.is_empty() {
        return Some(1.0);
    }
    // A letter outside ASCII in front of the seconds is a mu, or what an encoding made of it.
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
    // Some sensors can expose lines differently: here all lines share one exposure.
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
    if let Some((name, scale, _)) = found {
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

/// Adds the gap between packets, which leaves room for the packets of other cameras in the network.
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
        // A delay of 0 needs no feature, and USB has no packets.
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

/// Limits the rate of a camera that paces its packets by bytes per second: a frame then takes nine tenths of a period.
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
    // Headers add up to a twentieth where packets are small.
    let wanted = plan.image_bytes(wishes) as f64 * 1.05 * 1e9 / (0.9 * wishes.link.period_ns as f64);
    let amount = Amount::Near { wanted, scale: Scale::Times(1.0), tolerance: 0.05 * wanted, unit: "bytes/s" };
    plan.writes.push(Write::new(name, amount, "packet_delay_us"));
    true
}

/// The packet delay for "auto", microseconds: each camera leaves room for the packets of the others on a link of 1
/// Gbit/s, as far as its frame still fits into nine tenths of a period.
fn automatic_us(wishes: &Wishes, image_bytes: usize) -> f64 {
    let Wishes { link, .. } = wishes;
    if link.cameras < 2 || link.packet_bytes < 64 {
        return 0.0;
    }
    // The slowest link of a camera has 1 Gbit/s.
    const BITS_PER_US: f64 = 1000.0;
    let packets = image_bytes as f64 / (u64::from(link.packet_bytes) - wire::HEADERS) as f64;
    let each_us = 0.9 * link.period_ns as f64 / 1000.0 / packets;
    let share = (link.cameras - 1) as f64 / link.cameras as f64;
    let others_us = (u64::from(link.packet_bytes) + wire::ETHERNET) as f64 * 8.0 / BITS_PER_US
        * (link.cameras - 1) as f64;
    ((each_us * share).min(others_us) * 10.0).floor() / 10.0
}
