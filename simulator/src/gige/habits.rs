// SPDX-License-Identifier: MIT OR Apache-2.0
//! What cameras do differently from each other, and in which they are right by their own lights: formats, padding,
//! chunks, packets of another size, clocks.

use super::gvsp::{FORMATS, Form, Payload};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::time::Duration;

/// The habits of one camera; by default none is worth a word.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Habits {
    /// Its pixel format after power-on, and what of its frames its features tell.
    pub power_on: Form,
    /// The form of its frames from a trigger on, although its features state another.
    pub frames: Option<(i64, Form)>,
    /// How its clock is read.
    pub clock: ClockHabit,
    /// Time from the beginning of the exposure to the frame's timestamp.
    pub stamp_late: Duration,
    /// It stamps frames with 0.
    pub no_stamps: bool,
    /// Time from the end of the exposure to the frame's first packet.
    pub send_late: Duration,
    /// Where in a frame it takes the stamp, to which `stamp_late` is added.
    pub stamp: StampPoint,
    /// Time from the end of the exposure to the readout.
    pub readout_late: Duration,
    /// The exposure for which its images are meant: others make them brighter or darker. None: all are right.
    pub nominal: Option<Duration>,
    /// Increment of the exposure; 0: none.
    pub exposure_step: Duration,
    /// What it does with an exposure that is not one of its own.
    pub exposures: Exposures,
    /// Time from the acknowledgement of a command to its execution, ms.
    pub command_ms: u64,
    /// Delay of answers to writes, ms.
    pub answer_late_ms: u64,
    /// Delay of test packets after their request, ms.
    pub test_packet_late_ms: u64,
    /// Its description names this as the largest packet, bytes, whatever it takes; 0: the largest that it takes.
    pub packet_max_told: u16,
    /// Its name has a byte that is no UTF-8, as names in older encodings have.
    pub foreign_names: bool,
    /// After power-on its `AcquisitionMode` holds a value of none of its entries, until one is set.
    pub no_entry: bool,
    /// Its description names features that it does not have, and nodes that are not there.
    pub broken_description: bool,
    /// How long another client has control after power-on, ms.
    pub held_ms: u64,
    /// It has a link-local address until a client gives it another; for cameras of other makes.
    pub link_local: bool,
    /// Nanoseconds of a tick of its clock, in place of those of `clock`; 0 leaves them.
    pub tick_ns: u64,
    /// Block ids have 64 bits after power-on.
    pub extended_ids: bool,
    /// PTP never sets its clock: it listens for ever.
    pub ptp_listens: bool,
    /// From one trigger of each train up to another it hears no master: its status is `Listening`, and its clock goes
    /// on as PTP left it.
    pub ptp_away: Option<(i64, i64)>,
    /// The number of left-over frames that it sends when an acquisition starts, one after each `stray_after`, as some
    /// do (aravis#762). Before its first frame it has none.
    pub strays: u32,
    /// The time from one left-over frame to the next (see `strays`).
    pub stray_after: Duration,
    /// Block ids go on from the acquisition before.
    pub ids_go_on: bool,
    /// It wakes up late: the number of triggers that it misses of each acquisition, warm-up included (aravis#818).
    pub late_triggers: u32,
    /// It takes one trigger of this number, because exposure and readout last longer than the period; 0 takes each.
    pub takes_one_in: u32,
}

/// Where in a frame a camera takes its stamp.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum StampPoint {
    #[default]
    ExposureStart,
    ExposureEnd,
    ReadoutStart,
    /// When the leader goes out.
    LeaderSent,
}

/// What a camera does with an exposure that is not a multiple of its increment.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Exposures {
    /// Takes the nearest, and returns that when it is read back; refuses what is out of bounds.
    #[default]
    Rounded,
    /// Takes the nearest, and returns the requested value when it is read back.
    Asked,
    /// Takes the nearest within its bounds for any number.
    Clamped,
}

/// How a camera's clock is read, and in which unit it stamps frames.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ClockHabit {
    /// Features of GigE Vision 1; ticks of 1 ns.
    #[default]
    Ticks,
    /// No features, only the bootstrap registers; ticks of 8 ns.
    Bootstrap,
    /// Features of SFNC 2, which count ns, beside ticks of 8 ns in stamps and bootstrap registers.
    Nanoseconds,
    /// Features of GigE Vision 1; ticks of 8 ns, and the frequency feature is 0.
    ZeroFrequency,
    /// No features, and no register states the length of the ticks of 8 ns.
    NoFrequency,
    /// Features of GigE Vision 1 whose latch does nothing.
    Still,
}

impl ClockHabit {
    /// The frequency that the registers state, Hz.
    pub fn frequency(self) -> Option<u64> {
        match self {
            Self::Ticks | Self::Still => Some(1_000_000_000),
            Self::Bootstrap | Self::Nanoseconds => Some(125_000_000),
            Self::ZeroFrequency => Some(0),
            Self::NoFrequency => None,
        }
    }

    /// Ticks of this number of nanoseconds.
    pub fn ticks(self, ns: u64) -> u64 {
        match self {
            Self::Ticks | Self::Still => ns,
            _ => ns / 8,
        }
    }

    /// Whether its description names the features of GigE Vision 1.
    pub fn has_gev_features(self) -> bool {
        matches!(self, Self::Ticks | Self::ZeroFrequency | Self::Still)
    }
}

/// Why habits cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("[[habit]] {0}")]
pub struct HabitError(String);

impl Habits {
    /// The frequency of its clock by the registers, Hz.
    pub fn frequency(&self) -> Option<u64> {
        match (self.clock.frequency()?, self.tick_ns) {
            (0, _) => Some(0),
            (frequency, 0) => Some(frequency),
            (_, tick_ns) => Some(1_000_000_000 / tick_ns),
        }
    }

    /// Ticks of its clock in a number of nanoseconds.
    pub fn ticks(&self, ns: u64) -> u64 {
        ns.checked_div(self.tick_ns).unwrap_or_else(|| self.clock.ticks(ns))
    }

    /// Reads the tables `[[habit]]` of a TOML text: the habits of each camera that is named.
    ///
    /// # Errors
    /// Text that is no TOML, an unknown key or name, a camera that is named twice.
    pub fn parse(text: &str) -> Result<BTreeMap<String, Self>, HabitError> {
        let file: File = toml::from_str(text).map_err(|e| HabitError(e.to_string()))?;
        let mut habits = BTreeMap::new();
        for table in file.habit {
            let from = table.frames.as_ref().map(|frames| frames.from_trigger.unwrap_or(i64::MIN));
            let frames = table.frames.as_ref().map(FormTable::form).transpose()?;
            let habit = Self {
                power_on: table.power_on.as_ref().map(FormTable::form).transpose()?.unwrap_or_default(),
                frames: from.zip(frames),
                clock: table.clock,
                stamp_late: Duration::from_micros(table.stamp_late_us),
                no_stamps: table.no_stamps,
                send_late: Duration::from_micros(table.send_late_us),
                stamp: table.stamp,
                readout_late: Duration::from_micros(table.readout_late_us),
                nominal: None,
                exposure_step: Duration::from_micros(table.exposure_step_us),
                exposures: table.exposures,
                command_ms: table.command_ms,
                answer_late_ms: table.answer_late_ms,
                test_packet_late_ms: table.test_packet_late_ms,
                packet_max_told: table.packet_max_told,
                foreign_names: table.foreign_names,
                no_entry: table.no_entry,
                broken_description: table.broken_description,
                held_ms: table.held_ms,
                link_local: table.link_local,
                tick_ns: table.tick_ns,
                extended_ids: table.extended_ids,
                ptp_listens: table.ptp_listens,
                ptp_away: table.ptp_away.map(|away| (away.from_trigger, away.to_trigger)),
                strays: table.strays,
                stray_after: Duration::from_millis(table.stray_after_ms),
                ids_go_on: table.ids_go_on,
                late_triggers: table.late_triggers,
                takes_one_in: table.takes_one_in,
            };
            if habits.insert(table.camera.clone(), habit).is_some() {
                return Err(HabitError(format!("{} is named twice", table.camera)));
            }
        }
        Ok(habits)
    }
}

#[derive(Deserialize)]
struct File {
    #[serde(default)]
    habit: Vec<Table>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Table {
    camera: String,
    #[serde(default)]
    clock: ClockHabit,
    #[serde(default)]
    stamp_late_us: u64,
    #[serde(default)]
    no_stamps: bool,
    #[serde(default)]
    send_late_us: u64,
    #[serde(default)]
    stamp: StampPoint,
    #[serde(default)]
    readout_late_us: u64,
    #[serde(default)]
    exposure_step_us: u64,
    #[serde(default)]
    exposures: Exposures,
    #[serde(default)]
    command_ms: u64,
    #[serde(default)]
    answer_late_ms: u64,
    #[serde(default)]
    test_packet_late_ms: u64,
    #[serde(default)]
    packet_max_told: u16,
    #[serde(default)]
    foreign_names: bool,
    #[serde(default)]
    no_entry: bool,
    #[serde(default)]
    broken_description: bool,
    #[serde(default)]
    held_ms: u64,
    #[serde(default)]
    link_local: bool,
    #[serde(default)]
    tick_ns: u64,
    #[serde(default)]
    extended_ids: bool,
    #[serde(default)]
    ptp_listens: bool,
    ptp_away: Option<AwayTable>,
    #[serde(default)]
    strays: u32,
    #[serde(default)]
    stray_after_ms: u64,
    #[serde(default)]
    ids_go_on: bool,
    #[serde(default)]
    late_triggers: u32,
    #[serde(default)]
    takes_one_in: u32,
    // Which make it is: read by `Make::parse_all`.
    #[serde(default, rename = "like")]
    _like: Option<String>,
    #[serde(default, rename = "wired_to")]
    _wired_to: Option<String>,
    #[serde(default, rename = "left_over")]
    _left_over: Option<toml::Table>,
    #[serde(default, rename = "without")]
    _without: Vec<String>,
    power_on: Option<FormTable>,
    frames: Option<FormTable>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct AwayTable {
    from_trigger: i64,
    to_trigger: i64,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct FormTable {
    pixel_format: Option<String>,
    /// The pixel format in the leader, where it differs.
    told: Option<String>,
    /// Padding bytes that follow each row.
    #[serde(default)]
    padding: u16,
    /// Bytes that follow the image in its payload.
    #[serde(default)]
    appended: u32,
    /// The payload type that the leader states.
    #[serde(default)]
    payload: Payload,
    /// Bytes by which each packet is shorter than requested.
    #[serde(default)]
    short: u16,
    from_trigger: Option<i64>,
}

impl FormTable {
    fn form(&self) -> Result<Form, HabitError> {
        let code = |name: &str| {
            let known = FORMATS.iter().find(|(known, _)| *known == name);
            known.map(|(_, code)| *code).ok_or_else(|| {
                let names: Vec<&str> = FORMATS.iter().map(|(name, _)| *name).collect();
                HabitError(format!("pixel format {name:?}: expected one of {}", names.join(", ")))
            })
        };
        let format = code(self.pixel_format.as_deref().unwrap_or("Mono8"))?;
        let told = self.told.as_deref().map_or(Ok(format), code)?;
        let Self { padding, appended, payload, short, .. } = *self;
        Ok(Form { format, told, padding, appended, payload, short })
    }
}

#[cfg(test)]
mod tests {
    use super::{ClockHabit, Form, Habits, Payload};

    #[test]
    fn habits_are_read_by_camera_and_wrong_ones_refused() {
        let text = "[[habit]]\ncamera = \"h0_up\"\nclock = \"bootstrap\"\n\
            frames = { pixel_format = \"Mono16\", from_trigger = 20 }\n\
            [[habit]]\ncamera = \"h0_low\"\npower_on = { appended = 16, payload = \"image_with_chunks\" }\n\
             ptp_away = { from_trigger = 40, to_trigger = 90 }\n";
        let habits = Habits::parse(text).expect("valid");
        let up = habits["h0_up"];
        assert_eq!(up.clock, ClockHabit::Bootstrap);
        assert_eq!(up.frames.map(|(from, form)| (from, form.format)), Some((20, 0x0110_0007)));
        assert_eq!(
            habits["h0_low"].power_on,
            Form { appended: 16, payload: Payload::ImageWithChunks, ..Form::default() }
        );
        assert_eq!((up.ptp_away, habits["h0_low"].ptp_away), (None, Some((40, 90))));
        for wrong in ["clock = \"sun\"", "frames = { pixel_format = \"Grey\" }", "colour = 1"] {
            assert!(Habits::parse(&format!("[[habit]]\ncamera = \"c\"\n{wrong}\n")).is_err(), "{wrong}");
        }
        assert!(Habits::parse("[[habit]]\ncamera = \"c\"\n[[habit]]\ncamera = \"c\"\n").is_err());
    }
}
