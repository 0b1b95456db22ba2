// SPDX-License-Identifier: MIT OR Apache-2.0
//! What registers hold when they are read.

use super::{EXTENDED_IDS_BIT, PTP_STATES, Registers, XML_ADDRESS};
use crate::gige::VENDOR;
use crate::gige::gvsp::IdMode;
use crate::gige::map::Id;
use crate::gige::sensor;

/// GVCP capability: user-defined name, serial number, the controller's port and address, PACKETRESEND,
/// WRITEMEM, concatenation.
const GVCP_CAPABILITY: u32 = 1 << 31 | 1 << 30 | 1 << 27 | 1 << 2 | 1 << 1 | 1;
/// Bit of the GVCP capability register: the camera sends PENDING_ACK.
const PENDING_ACKS: u32 = 1 << 5;
/// GVCP capability: IEEE 1588, scheduled ACTION, ACTION.
const ACTIONS: u32 = 1 << 19 | 1 << 17 | 1 << 6;
/// GVSP capability: stream source port register, 16-bit block ids.
const GVSP_CAPABILITY: u32 = 1 << 31 | 1 << 30;
/// What no enumeration has an entry for.
const NO_ENTRY: u32 = 77;

impl Registers {
    pub(super) fn text(&self, id: Id) -> String {
        match id {
            Id::Manufacturer => match &self.firmware {
                Some(firmware) => firmware.vendor(),
                None => VENDOR.to_owned(),
            },
            Id::Model => self.identity.model.clone(),
            Id::DeviceVersion => env!("CARGO_PKG_VERSION").to_owned(),
            Id::ManufacturerInfo => "simulated camera".to_owned(),
            Id::Serial => self.identity.serial.clone(),
            Id::UserName => self.identity.user_name.clone(),
            Id::XmlUrl => match &self.described {
                Some(described) => described.url(),
                None => format!("Local:fourdbody-sim.xml;{XML_ADDRESS:x};{:x}", self.xml.len()),
            },
            _ => String::new(),
        }
    }

    pub(super) fn float(&self, id: Id) -> f64 {
        match id {
            Id::ExposureTime => self.settings.exposure_us(),
            Id::FrameRate => self.settings.frame_rate(),
            Id::FrameRateMax => {
                let period = sensor::shortest_period(self.settings.exposure(), self.settings.height);
                1.0 / period.as_secs_f64()
            }
            Id::Gain => self.settings.gain_db(),
            _ => 0.0,
        }
    }

    pub(super) fn integer(&self, id: Id) -> u32 {
        let settings = &self.settings;
        let mac = self.mac();
        if let Some(value) = self.firmware.as_ref().and_then(|_| self.network.word(id)) {
            return value;
        }
        match id {
            Id::Version => 2 << 16,
            // Big-endian, transmitter, UTF-8.
            Id::DeviceMode => 1 << 31 | 1,
            Id::MacHigh => (mac >> 32) as u32,
            Id::MacLow => (mac & 0xffff_ffff) as u32,
            // Its address is given: what the standard calls a persistent IP.
            Id::IpOptions | Id::IpConfiguration | Id::NetworkInterfaces | Id::StreamChannels => 1,
            Id::IpAddress | Id::PersistentAddress => self.identity.address.to_bits(),
            Id::SubnetMask | Id::PersistentMask => 0xff00_0000,
            Id::GvspCapability => GVSP_CAPABILITY,
            Id::GvcpCapability if self.firmware.is_some() => GVCP_CAPABILITY | PENDING_ACKS,
            Id::GvcpCapability => GVCP_CAPABILITY | ACTIONS,
            Id::ActionSignals => 1,
            // The device key can be written alone.
            Id::ActionGroupKey => self.action_keys[1],
            Id::ActionGroupMask => self.action_keys[2],
            Id::PtpEnable => u32::from(self.ptp),
            Id::PtpStatus if self.nonsense => NO_ENTRY,
            Id::Width if self.nonsense => 0,
            Id::AcquisitionMode if self.no_entry => NO_ENTRY,
            Id::PtpStatus => match (self.ptp, self.habits.ptp_listens || self.no_master) {
                (false, _) => PTP_STATES[0].1,
                (true, true) => PTP_STATES[1].1,
                (true, false) => PTP_STATES[2].1,
            },
            Id::Heartbeat => self.heartbeat_ms,
            Id::TickFrequencyHigh => (self.habits.frequency().unwrap_or(0) >> 32) as u32,
            Id::TickFrequencyLow => (self.habits.frequency().unwrap_or(0) & 0xffff_ffff) as u32,
            Id::TimestampHigh => (self.habits.ticks(self.latched) >> 32) as u32,
            Id::TimestampLow => (self.habits.ticks(self.latched) & 0xffff_ffff) as u32,
            Id::NanosecondsHigh => (self.latched >> 32) as u32,
            Id::NanosecondsLow => (self.latched & 0xffff_ffff) as u32,
            Id::GvspConfiguration if self.ids == IdMode::Extended => EXTENDED_IDS_BIT,
            Id::Privilege => self.privilege,
            Id::ControllerPort => self.controller.map_or(0, |c| u32::from(c.port())),
            Id::ControllerAddress => self.controller.map_or(0, |c| c.ip().to_bits()),
            Id::HostPort => u32::from(self.host_port),
            Id::PacketSize => u32::from(self.do_not_fragment) << 30 | u32::from(self.packet_size),
            Id::PacketDelay => self.packet_delay,
            Id::Destination => self.destination.to_bits(),
            Id::SourcePort => u32::from(self.source_port),
            Id::SensorWidth => self.sensor.0,
            Id::SensorHeight => self.sensor.1,
            Id::Width => settings.width,
            Id::Height => settings.height,
            Id::PixelFormat => settings.pixel_format,
            Id::PayloadSize => {
                u32::try_from(self.form().payload(settings.width, settings.height)).unwrap_or(u32::MAX)
            }
            Id::AcquisitionMode => settings.mode as u32,
            Id::FrameCount => settings.frame_count,
            Id::FrameRateEnable => u32::from(settings.frame_rate_enabled),
            Id::ExposureMode => settings.exposure_mode as u32,
            Id::TriggerSelector => settings.selected_trigger,
            Id::TriggerMode => u32::from(settings.is_trigger_on()),
            Id::TriggerSource => settings.source as u32,
            Id::TriggersIgnored => self.triggers_ignored,
            _ => 0,
        }
    }
}
