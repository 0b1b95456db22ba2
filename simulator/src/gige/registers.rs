// SPDX-License-Identifier: MIT OR Apache-2.0
//! The register map: which registers exist, what they hold, and which values they take.
//!
//! Addresses below 0xa000 are the bootstrap registers of GigE Vision 2.x; those from 0x10000 on are the
//! camera's own features, declared to the world by [`super::genicam`].

use super::clock::CameraClock;
use super::described::Described;
use super::genicam;
use super::gvcp::{DISCOVERY_SIZE, ForceIp, Status};
use super::gvsp::{FORMATS, Form, IdMode};
use super::habits::{ClockHabit, Habits};
use super::make::{Firmware, Make};
use super::map::{Access, Id, Register, find};
use super::network::Network;
use super::settings::{AcquisitionMode, ExposureMode, Settings, TriggerSource};
use std::net::{Ipv4Addr, SocketAddrV4};
use std::sync::Arc;
use std::time::Instant;

mod kinds;
mod values;

/// Where the GenICam XML starts; the URL register has this address.
pub const XML_ADDRESS: u32 = 0x0010_0000;
/// Where the features begin that are not every GigE Vision camera's.
const FEATURES: u32 = 0x0001_0000;
/// Limits of the packet size register: IP, UDP and GVSP headers are counted in.
pub const PACKET_SIZE: std::ops::RangeInclusive<u16> = 576..=65_532;
/// The packet size must be a multiple of this.
pub const PACKET_SIZE_STEP: u16 = 4;
/// Columns of the narrowest image that the camera takes.
pub const WIDTH_MIN: u32 = 16;
/// The shortest heartbeat timeout that the camera accepts, ms.
const HEARTBEAT_MIN: u32 = 500;
/// States of PTP, as IEEE 1588 numbers them.
pub const PTP_STATES: [(&str, u32); 3] = [("Disabled", 3), ("Listening", 4), ("Slave", 9)];
/// GVSP configuration: 64-bit block ids are on.
pub const EXTENDED_IDS_BIT: u32 = 1 << 30;

/// What a camera is called and where it answers.
#[derive(Debug, Clone)]
pub struct Identity {
    pub address: Ipv4Addr,
    /// Model name, at most 31 bytes.
    pub model: String,
    /// Serial number, at most 15 bytes.
    pub serial: String,
    /// Name given by the user, at most 15 bytes.
    pub user_name: String,
}

/// What a register write sets off beyond the stored value.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Effect {
    /// Start acquiring with the settings as they stand.
    Start,
    Stop,
    SoftwareTrigger,
    /// Something changed that a running acquisition follows: destination, packet delay, exposure, rate.
    Stream,
    TestPacket,
    /// The control channel privilege register was written: the caller decides.
    Privilege(u32),
}

/// State behind the registers of one camera.
#[derive(Debug)]
pub struct Registers {
    identity: Identity,
    sensor: (u32, u32),
    clock: Arc<CameraClock>,
    xml: Vec<u8>,
    habits: Habits,
    /// The make of a camera with a table; else its features are those of [`super::map`].
    firmware: Option<Firmware>,
    /// Of a camera behind a published description; its features are those.
    described: Option<Arc<Described>>,
    /// Address, subnet mask and gateway of a camera that can be moved; in its memory.
    network: Network,
    /// The clock as it was latched, ns.
    latched: u64,
    /// Control channel privilege as others read it.
    pub privilege: u32,
    /// Who has it ("primary application").
    pub controller: Option<SocketAddrV4>,
    /// Milliseconds without a message after which the controller loses control.
    pub heartbeat_ms: u32,
    /// Port the stream goes to; 0 closes the stream.
    pub host_port: u16,
    /// Address the stream goes to.
    pub destination: Ipv4Addr,
    /// Port the stream comes from.
    pub source_port: u16,
    /// Size of stream packets, IP and UDP headers counted in.
    pub packet_size: u16,
    /// The stream's packets must not be fragmented.
    pub do_not_fragment: bool,
    /// The gap between two packets, ticks of the clock.
    pub packet_delay: u32,
    /// Width of block and packet ids.
    pub ids: IdMode,
    pub settings: Settings,
    /// Triggers ignored since the acquisition started.
    pub triggers_ignored: u32,
    /// Device key, group key and group mask of the actions that it takes; mask 0: none.
    pub action_keys: [u32; 3],
    ptp: bool,
    /// No entry of `AcquisitionMode` was set yet, and it stands at none.
    no_entry: bool,
    /// Some registers hold what the description has no word for.
    pub nonsense: bool,
    /// It hears no PTP master, and its clock goes on as it was set.
    pub no_master: bool,
}

impl Registers {
    /// Registers after power-on of a camera with a sensor of (columns, rows).
    pub fn new(identity: Identity, sensor: (u32, u32), clock: Arc<CameraClock>, habits: Habits) -> Self {
        let mut settings = Settings::new(sensor.0, sensor.1);
        settings.pixel_format = habits.power_on.format;
        Self {
            xml: genicam::xml(&identity.model, &habits),
            no_entry: habits.no_entry,
            nonsense: false,
            no_master: false,
            habits,
            firmware: None,
            described: None,
            network: Network::new(identity.address),
            identity,
            sensor,
            clock,
            latched: 0,
            privilege: 0,
            controller: None,
            heartbeat_ms: 3000,
            host_port: 0,
            destination: Ipv4Addr::UNSPECIFIED,
            source_port: 0,
            packet_size: 9000,
            do_not_fragment: true,
            packet_delay: 0,
            ids: if habits.extended_ids { IdMode::Extended } else { IdMode::Standard },
            settings,
            triggers_ignored: 0,
            action_keys: [0; 3],
            ptp: false,
        }
    }

    /// Its MAC: a locally administered one that holds its first address, unique on this host.
    pub fn mac(&self) -> u64 {
        0x0200_0000_0000_u64 | u64::from(self.identity.address.to_bits())
    }

    /// Whether it can be given another address.
    pub fn can_move(&self) -> bool {
        self.firmware.is_some()
    }

    /// Takes another address until power-off.
    pub fn move_to(&mut self, force: &ForceIp) {
        self.network.now = (force.address, force.mask, force.gateway);
        self.network.away = false;
    }

    /// The camera's addresses: those of now and the persistent ones.
    pub fn network(&self) -> &Network {
        &self.network
    }

    /// Does what has become due by now.
    pub fn tick(&mut self, acquiring: bool, now: Instant) {
        if let Some(firmware) = &mut self.firmware {
            firmware.tick(acquiring, now);
            self.settings = firmware.settings();
        }
    }

    /// The form of an image's payload by its features.
    pub fn form(&self) -> Form {
        if let Some(firmware) = &self.firmware {
            return firmware.form(self.habits.power_on);
        }
        let format = self.settings.pixel_format;
        Form { format, told: format, ..self.habits.power_on }
    }

    /// Where the stream goes, if it is open.
    pub fn stream_destination(&self) -> Option<SocketAddrV4> {
        let open = self.host_port != 0 && !self.destination.is_unspecified();
        open.then(|| SocketAddrV4::new(self.destination, self.host_port))
    }

    /// The discovery answer: the bootstrap registers from address 0, unused ones as zeros.
    pub fn discovery(&self) -> [u8; DISCOVERY_SIZE] {
        let mut bytes = [0; DISCOVERY_SIZE];
        for (at, word) in (0u32..).step_by(4).zip(bytes.chunks_exact_mut(4)) {
            if let Some(value) = self.word(at) {
                word.copy_from_slice(&value);
            }
        }
        bytes
    }

    /// Reads `count` bytes; both must be multiples of four.
    ///
    /// # Errors
    /// Bad alignment, or an address that holds no register.
    pub fn read(&self, address: u32, count: u16) -> Result<Vec<u8>, Status> {
        if !address.is_multiple_of(4) || !count.is_multiple_of(4) {
            return Err(Status::BadAlignment);
        }
        let mut bytes = Vec::with_capacity(usize::from(count));
        for offset in (0..u32::from(count)).step_by(4) {
            let at = address.checked_add(offset).ok_or(Status::InvalidAddress)?;
            bytes.extend(self.word(at).ok_or(Status::InvalidAddress)?);
        }
        Ok(bytes)
    }

    /// Writes the one register that starts at `address` with the beginning of `data`; returns how many bytes it
    /// took and what follows from it. `acquiring` locks what must not change under a running acquisition.
    ///
    /// # Errors
    /// Bad alignment, no register, read-only, locked, or a value out of range: the register keeps its value.
    pub fn write(
        &mut self,
        address: u32,
        data: &[u8],
        acquiring: bool,
        now: Instant,
    ) -> Result<(usize, Option<Effect>), Status> {
        if !address.is_multiple_of(4) || !data.len().is_multiple_of(4) {
            return Err(Status::BadAlignment);
        }
        if let Some(firmware) = self.firmware.as_mut().filter(|_| (FEATURES..XML_ADDRESS).contains(&address))
        {
            let done = firmware.write(address, data, acquiring, now)?;
            self.settings = firmware.settings();
            return Ok(done);
        }
        if let Some(done) = self.write_memory(address, data) {
            return Ok(done);
        }
        let Some((register, offset)) = find(address) else {
            let in_xml = self.xml_word(address).is_some();
            return Err(if in_xml { Status::WriteProtect } else { Status::InvalidAddress });
        };
        if self.firmware.is_some() && data.len() >= 4 && self.network.write(register.id, data) {
            return Ok((4, None));
        }
        if register.access == Access::ReadOnly {
            return Err(Status::WriteProtect);
        }
        if register.locked && acquiring {
            return Err(Status::AccessDenied);
        }
        let whole = usize::from(register.length);
        if register.id == Id::UserName {
            let length = data.len().min(whole - offset);
            self.write_user_name(offset, &data[..length])?;
            return Ok((length, None));
        }
        // Half of a 64-bit value would be neither the old nor the new one.
        if offset != 0 || data.len() < whole {
            return Err(Status::InvalidAddress);
        }
        let effect = match <[u8; 8]>::try_from(&data[..whole]) {
            Ok(bytes) => self.write_float(register, f64::from_be_bytes(bytes)),
            Err(_) => {
                let bytes = <[u8; 4]>::try_from(&data[..whole]).map_err(|_| Status::InvalidParameter)?;
                self.write_integer(register, u32::from_be_bytes(bytes), now)
            }
        }?;
        Ok((whole, effect))
    }

    fn write_user_name(&mut self, offset: usize, data: &[u8]) -> Result<(), Status> {
        let mut bytes = text::<16>(&self.identity.user_name);
        bytes[offset..offset + data.len()].copy_from_slice(data);
        let end = bytes.iter().position(|b| *b == 0).unwrap_or(15).min(15);
        let name = std::str::from_utf8(&bytes[..end]).map_err(|_| Status::InvalidParameter)?;
        name.clone_into(&mut self.identity.user_name);
        Ok(())
    }

    fn write_float(&mut self, register: &Register, value: f64) -> Result<Option<Effect>, Status> {
        let set = match register.id {
            Id::ExposureTime => self.settings.set_exposure_us(value),
            Id::FrameRate => self.settings.set_frame_rate(value),
            Id::Gain => self.settings.set_gain_db(value),
            _ => return Err(Status::WriteProtect),
        };
        set.then_some(Some(Effect::Stream)).ok_or(Status::InvalidParameter)
    }

    fn write_integer(
        &mut self,
        register: &Register,
        value: u32,
        now: Instant,
    ) -> Result<Option<Effect>, Status> {
        match register.id {
            Id::Heartbeat => {
                accept(value >= HEARTBEAT_MIN)?;
                self.heartbeat_ms = value;
                Ok(None)
            }
            Id::TimestampControl => {
                if value & 1 != 0 {
                    self.clock.reset(now);
                }
                if value & 2 != 0 && self.habits.clock != ClockHabit::Still {
                    self.latched = self.clock.at(now);
                }
                Ok(None)
            }
            Id::Privilege => Ok(Some(Effect::Privilege(value))),
            // Of other makes the features would say so, and theirs do not act.
            Id::ActionDeviceKey | Id::ActionGroupKey | Id::ActionGroupMask if self.firmware.is_some() => {
                Err(Status::InvalidAddress)
            }
            Id::ActionDeviceKey => self.set_action_key(0, value),
            Id::ActionGroupKey => self.set_action_key(1, value),
            Id::ActionGroupMask => self.set_action_key(2, value),
            Id::PtpEnable => {
                accept(value <= 1)?;
                self.ptp = value == 1;
                self.clock.set_common(self.ptp && !self.habits.ptp_listens);
                Ok(None)
            }
            Id::HostPort | Id::PacketSize | Id::PacketDelay | Id::Destination | Id::GvspConfiguration => {
                self.write_stream_channel(register.id, value)
            }
            _ => self.write_feature(register.id, value),
        }
    }

    fn set_action_key(&mut self, place: usize, value: u32) -> Result<Option<Effect>, Status> {
        self.action_keys[place] = value;
        Ok(None)
    }

    /// When the clock that it shares with others shows this, ns.
    pub fn common_instant(&self, ns: u64) -> Option<Instant> {
        self.clock.instant(ns)
    }

    /// Registers of the stream channel.
    fn write_stream_channel(&mut self, id: Id, value: u32) -> Result<Option<Effect>, Status> {
        match id {
            Id::HostPort => {
                // Bit 31 would make this a receiver; the interface index has one value.
                accept(value <= 0xffff)?;
                self.host_port = (value & 0xffff) as u16;
            }
            Id::PacketSize => {
                let mut size = (value & 0xffff) as u16;
                if let Some(firmware) = &self.firmware {
                    size = firmware.packet_size(size).ok_or(Status::InvalidParameter)?;
                } else {
                    accept(PACKET_SIZE.contains(&size) && size.is_multiple_of(PACKET_SIZE_STEP))?;
                }
                // Mono8 has no byte order: the big-endian bit is accepted and has nothing to change.
                self.packet_size = size;
                self.do_not_fragment = value & 1 << 30 != 0;
                return Ok((value & 1 << 31 != 0).then_some(Effect::TestPacket));
            }
            Id::PacketDelay => self.packet_delay = value,
            Id::Destination => self.destination = Ipv4Addr::from_bits(value),
            Id::GvspConfiguration => {
                accept(value & !EXTENDED_IDS_BIT == 0)?;
                self.ids = if value == 0 { IdMode::Standard } else { IdMode::Extended };
            }
            _ => return Err(Status::WriteProtect),
        }
        Ok(Some(Effect::Stream))
    }

    /// Camera features that are integers.
    fn write_feature(&mut self, id: Id, value: u32) -> Result<Option<Effect>, Status> {
        let settings = &mut self.settings;
        let coded = Status::InvalidParameter;
        match id {
            // Features with a single value, by their description.
            Id::StreamConfiguration | Id::OffsetX | Id::OffsetY => accept(value == 0)?,
            Id::ExposureAuto | Id::TriggerActivation => accept(value == 0)?,
            Id::TriggerSelector => {
                accept(value <= 1)?;
                settings.selected_trigger = value;
            }
            Id::PixelFormat => {
                accept(FORMATS.iter().any(|(_, code)| *code == value))?;
                settings.pixel_format = value;
            }
            Id::Width => {
                accept((WIDTH_MIN..=self.sensor.0).contains(&value))?;
                settings.width = value;
            }
            Id::Height => {
                accept((1..=self.sensor.1).contains(&value))?;
                settings.height = value;
            }
            Id::AcquisitionMode => {
                settings.mode = AcquisitionMode::from_code(value).ok_or(coded)?;
                self.no_entry = false;
            }
            Id::FrameCount => {
                accept((1..=0xffff).contains(&value))?;
                settings.frame_count = value;
            }
            Id::FrameRateEnable => {
                accept(value <= 1)?;
                settings.frame_rate_enabled = value == 1;
                return Ok(Some(Effect::Stream));
            }
            Id::ExposureMode => settings.exposure_mode = ExposureMode::from_code(value).ok_or(coded)?,
            Id::TriggerMode => {
                accept(value <= 1)?;
                *settings.trigger_mode() = value == 1;
            }
            Id::TriggerSource => settings.source = TriggerSource::from_code(value).ok_or(coded)?,
            Id::AcquisitionStart => return command(value, Effect::Start),
            Id::AcquisitionStop => return command(value, Effect::Stop),
            Id::TriggerSoftware => {
                if !settings.triggered || settings.source != TriggerSource::Software {
                    return Err(Status::AccessDenied);
                }
                return command(value, Effect::SoftwareTrigger);
            }
            _ => return Err(Status::WriteProtect),
        }
        Ok(None)
    }

    fn xml_word(&self, address: u32) -> Option<[u8; 4]> {
        let at = usize::try_from(address.checked_sub(XML_ADDRESS)?).ok()?;
        self.xml.get(at..at.checked_add(4)?)?.try_into().ok()
    }

    /// The four bytes at an aligned address.
    fn word(&self, address: u32) -> Option<[u8; 4]> {
        if let Some(word) = self.memory_word(address) {
            return Some(word);
        }
        if let Some(firmware) = self.firmware.as_ref().filter(|_| (FEATURES..XML_ADDRESS).contains(&address))
        {
            // Of a standard's register and nothing else of the map's own features.
            let clock = (Id::NanosecondsHigh.address()..=Id::NanosecondsLow.address()).contains(&address);
            return if clock {
                find(address).map(|(r, _)| self.integer(r.id).to_be_bytes())
            } else {
                firmware.word(address).ok()
            };
        }
        let Some((register, offset)) = find(address) else { return self.xml_word(address) };
        if matches!(register.id, Id::TickFrequencyHigh | Id::TickFrequencyLow) {
            // Not every camera states it.
            self.habits.frequency()?;
        }
        match register.length {
            4 => Some(self.integer(register.id).to_be_bytes()),
            8 => self.float(register.id).to_be_bytes().get(offset..offset + 4)?.try_into().ok(),
            _ => {
                let mut text = self.text(register.id).into_bytes();
                if self.habits.foreign_names
                    && matches!(register.id, Id::Model | Id::UserName | Id::DeviceVersion)
                {
                    // A letter of Latin-1.
                    text.truncate(usize::from(register.length) - 2);
                    text.push(0xfc);
                }
                let mut word = [0; 4];
                for (i, byte) in word.iter_mut().enumerate() {
                    // The last byte stays a terminator.
                    let at = offset + i;
                    if at + 1 < usize::from(register.length) {
                        *byte = text.get(at).copied().unwrap_or(0);
                    }
                }
                Some(word)
            }
        }
    }
}

fn accept(valid: bool) -> Result<(), Status> {
    if valid { Ok(()) } else { Err(Status::InvalidParameter) }
}

fn command(value: u32, effect: Effect) -> Result<Option<Effect>, Status> {
    if value == 1 { Ok(Some(effect)) } else { Err(Status::InvalidParameter) }
}

/// Text in a fixed field, cut to leave a terminator.
fn text<const N: usize>(text: &str) -> [u8; N] {
    let mut bytes = [0; N];
    for (to, from) in bytes[..N - 1].iter_mut().zip(text.bytes()) {
        *to = from;
    }
    bytes
}
