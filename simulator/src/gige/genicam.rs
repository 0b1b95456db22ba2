// SPDX-License-Identifier: MIT OR Apache-2.0
//! The camera's GenICam description: exactly the features that the registers implement.
//!
//! Addresses and codes come from the register map and the settings' enumerations, so that description and
//! behaviour cannot drift apart. Feature names follow the SFNC, element order the GenApi 1.1 schema.

use super::VENDOR;
use super::gvsp::FORMATS;
use super::habits::{ClockHabit, Habits};
use super::map::Id;
use super::registers::{EXTENDED_IDS_BIT, PACKET_SIZE, PACKET_SIZE_STEP, PTP_STATES, WIDTH_MIN};
use super::settings::{AcquisitionMode, EXPOSURE_US, ExposureMode, FRAME_RATE_MIN, GAIN_DB, TriggerSource};
use std::fmt::Write;

/// The XML document, padded to a multiple of four bytes so that it can be read in words.
pub fn xml(model: &str, habits: &Habits) -> Vec<u8> {
    let mut xml = Description::default();
    xml.device_control();
    xml.image_format_control();
    if habits.power_on.payload.has_chunks() {
        xml.chunks();
    }
    xml.acquisition_control();
    let packet_max = match habits.packet_max_told {
        0 => *PACKET_SIZE.end(),
        told => told,
    };
    xml.transport_layer_control(habits.clock, packet_max);
    if habits.broken_description {
        xml.broken();
    }
    let mut document = xml.document(model).into_bytes();
    while !document.len().is_multiple_of(4) {
        document.push(b'\n');
    }
    document
}

/// Who may do what with a feature, as GenICam writes it.
#[derive(Clone, Copy, PartialEq)]
enum Mode {
    Ro,
    Rw,
    Wo,
}

impl Mode {
    fn text(self) -> &'static str {
        match self {
            Mode::Ro => "RO",
            Mode::Rw => "RW",
            Mode::Wo => "WO",
        }
    }
}

/// Limits of an integer: numbers, or another node.
enum Limits {
    None,
    Range(u64, u64, u64),
    UpTo(u64, &'static str),
}

const LOCKED: &str = "<pIsLocked>TLParamsLocked</pIsLocked>";

/// The document while it grows: nodes, and the features of each category.
#[derive(Default)]
struct Description {
    nodes: String,
    categories: Vec<(&'static str, Vec<&'static str>)>,
}

impl Description {
    fn category(&mut self, name: &'static str) {
        self.categories.push((name, Vec::new()));
    }

    fn feature(&mut self, name: &'static str) {
        if let Some((_, features)) = self.categories.last_mut() {
            features.push(name);
        }
    }

    fn node(&mut self, xml: &str) {
        self.nodes.push_str(xml);
        self.nodes.push('\n');
    }

    fn register(&mut self, name: &str, id: Id, mode: Mode) {
        self.node(&format!(
            "<IntReg Name=\"{name}\"><Visibility>Invisible</Visibility><Address>{:#x}</Address><Length>4</Length>\
             <AccessMode>{}</AccessMode><pPort>Device</pPort><Cachable>NoCache</Cachable>\
             <Sign>Unsigned</Sign><Endianess>BigEndian</Endianess></IntReg>",
            id.address(),
            mode.text()
        ));
    }

    /// Some bits of a register; bit 0 is the most significant, as in the standard's tables.
    fn bits(&mut self, name: &str, id: Id, mode: Mode, (first, last): (u8, u8)) {
        self.node(&format!(
            "<MaskedIntReg Name=\"{name}\"><Visibility>Invisible</Visibility><Address>{:#x}</Address>\
             <Length>4</Length><AccessMode>{}</AccessMode><pPort>Device</pPort><Cachable>NoCache</Cachable>\
             <LSB>{last}</LSB><MSB>{first}</MSB><Sign>Unsigned</Sign><Endianess>BigEndian</Endianess></MaskedIntReg>",
            id.address(),
            mode.text()
        ));
    }

    fn text(&mut self, name: &'static str, id: Id, length: u16, mode: Mode) {
        self.feature(name);
        self.node(&format!(
            "<StringReg Name=\"{name}\"><Address>{:#x}</Address><Length>{length}</Length>\
             <AccessMode>{}</AccessMode><pPort>Device</pPort><Cachable>NoCache</Cachable></StringReg>",
            id.address(),
            mode.text()
        ));
    }

    fn integer_node(&mut self, name: &'static str, head: &str, limits: Limits) {
        self.feature(name);
        let limits = match limits {
            Limits::None => String::new(),
            Limits::Range(min, max, step) => format!("<Min>{min}</Min><Max>{max}</Max><Inc>{step}</Inc>"),
            Limits::UpTo(min, node) => format!("<Min>{min}</Min><pMax>{node}</pMax><Inc>1</Inc>"),
        };
        self.node(&format!("<Integer Name=\"{name}\">{head}<pValue>{name}Reg</pValue>{limits}</Integer>"));
    }

    fn integer(&mut self, name: &'static str, id: Id, mode: Mode, locked: bool, limits: Limits) {
        self.integer_node(name, if locked { LOCKED } else { "" }, limits);
        self.register(&format!("{name}Reg"), id, mode);
    }

    fn float(&mut self, name: &'static str, id: Id, unit: &str, limits: &str) {
        self.feature(name);
        self.node(&format!(
            "<Float Name=\"{name}\"><pValue>{name}Reg</pValue>{limits}<Unit>{unit}</Unit></Float>"
        ));
        self.float_register(&format!("{name}Reg"), id, Mode::Rw);
    }

    fn float_register(&mut self, name: &str, id: Id, mode: Mode) {
        self.node(&format!(
            "<FloatReg Name=\"{name}\"><Visibility>Invisible</Visibility><Address>{:#x}</Address><Length>8</Length>\
             <AccessMode>{}</AccessMode><pPort>Device</pPort><Cachable>NoCache</Cachable>\
             <Endianess>BigEndian</Endianess></FloatReg>",
            id.address(),
            mode.text()
        ));
    }

    fn enumeration(&mut self, name: &'static str, id: Id, locked: bool, entries: &[(&str, u32)]) {
        self.feature(name);
        let lock = if locked { LOCKED } else { "" };
        let mut node = format!("<Enumeration Name=\"{name}\">{lock}");
        for (entry, code) in entries {
            let _ = write!(node, "<EnumEntry Name=\"{entry}\"><Value>{code}</Value></EnumEntry>");
        }
        let _ = write!(node, "<pValue>{name}Reg</pValue></Enumeration>");
        self.node(&node);
        self.register(&format!("{name}Reg"), id, Mode::Rw);
    }

    fn command(&mut self, name: &'static str, id: Id, value: u32) {
        self.feature(name);
        let register = format!("{name}Reg");
        self.node(&format!(
            "<Command Name=\"{name}\"><pValue>{register}</pValue><CommandValue>{value}</CommandValue></Command>"
        ));
        self.register(&register, id, Mode::Wo);
    }

    /// A 64-bit number in a pair of registers, high word first.
    fn wide(&mut self, name: &'static str, high: Id, low: Id) {
        self.feature(name);
        self.node(&format!("<Integer Name=\"{name}\"><pValue>{name}Calc</pValue></Integer>"));
        self.node(&format!(
            "<IntSwissKnife Name=\"{name}Calc\"><pVariable Name=\"HIGH\">{name}HighReg</pVariable>\
             <pVariable Name=\"LOW\">{name}LowReg</pVariable><Formula>(HIGH &lt;&lt; 32) | LOW</Formula></IntSwissKnife>"
        ));
        self.register(&format!("{name}HighReg"), high, Mode::Ro);
        self.register(&format!("{name}LowReg"), low, Mode::Ro);
    }

    fn device_control(&mut self) {
        self.category("DeviceControl");
        self.text("DeviceVendorName", Id::Manufacturer, 32, Mode::Ro);
        self.text("DeviceModelName", Id::Model, 32, Mode::Ro);
        self.text("DeviceVersion", Id::DeviceVersion, 32, Mode::Ro);
        self.text("DeviceManufacturerInfo", Id::ManufacturerInfo, 48, Mode::Ro);
        self.text("DeviceSerialNumber", Id::Serial, 16, Mode::Ro);
        self.text("DeviceID", Id::Serial, 16, Mode::Ro);
        self.text("DeviceUserID", Id::UserName, 16, Mode::Rw);
    }

    fn image_format_control(&mut self) {
        self.category("ImageFormatControl");
        self.integer("SensorWidth", Id::SensorWidth, Mode::Ro, false, Limits::None);
        self.integer("SensorHeight", Id::SensorHeight, Mode::Ro, false, Limits::None);
        // There are no offsets: the largest image is the sensor.
        self.integer("WidthMax", Id::SensorWidth, Mode::Ro, false, Limits::None);
        self.integer("HeightMax", Id::SensorHeight, Mode::Ro, false, Limits::None);
        self.integer("Width", Id::Width, Mode::Rw, true, Limits::UpTo(u64::from(WIDTH_MIN), "WidthMax"));
        self.integer("Height", Id::Height, Mode::Rw, true, Limits::UpTo(1, "HeightMax"));
        self.integer("OffsetX", Id::OffsetX, Mode::Rw, true, Limits::Range(0, 0, 1));
        self.integer("OffsetY", Id::OffsetY, Mode::Rw, true, Limits::Range(0, 0, 1));
        self.enumeration("PixelFormat", Id::PixelFormat, true, &FORMATS);
    }

    /// Chunks that cannot be switched off.
    fn chunks(&mut self) {
        self.category("ChunkDataControl");
        self.feature("ChunkModeActive");
        self.node(
            "<Boolean Name=\"ChunkModeActive\"><pValue>ChunkModeActiveCalc</pValue><OnValue>1</OnValue>\
             <OffValue>0</OffValue></Boolean>",
        );
        self.node("<IntSwissKnife Name=\"ChunkModeActiveCalc\"><Formula>1</Formula></IntSwissKnife>");
    }

    fn acquisition_control(&mut self) {
        self.category("AcquisitionControl");
        self.enumeration("AcquisitionMode", Id::AcquisitionMode, true, AcquisitionMode::ENTRIES);
        self.integer("AcquisitionFrameCount", Id::FrameCount, Mode::Rw, true, Limits::Range(1, 0xffff, 1));
        self.command("AcquisitionStart", Id::AcquisitionStart, 1);
        self.command("AcquisitionStop", Id::AcquisitionStop, 1);
        self.feature("AcquisitionFrameRateEnable");
        self.node(
            "<Boolean Name=\"AcquisitionFrameRateEnable\"><pValue>AcquisitionFrameRateEnableReg</pValue>\
             <OnValue>1</OnValue><OffValue>0</OffValue></Boolean>",
        );
        self.register("AcquisitionFrameRateEnableReg", Id::FrameRateEnable, Mode::Rw);
        let rate = format!("<Min>{FRAME_RATE_MIN}</Min><pMax>FrameRateMaxReg</pMax>");
        self.float("AcquisitionFrameRate", Id::FrameRate, "Hz", &rate);
        self.float_register("FrameRateMaxReg", Id::FrameRateMax, Mode::Ro);
        self.enumeration("ExposureMode", Id::ExposureMode, true, ExposureMode::ENTRIES);
        self.enumeration("ExposureAuto", Id::ExposureAuto, true, &[("Off", 0)]);
        let limits = |range: std::ops::RangeInclusive<f64>| {
            format!("<Min>{}</Min><Max>{}</Max>", range.start(), range.end())
        };
        self.float("ExposureTime", Id::ExposureTime, "us", &limits(EXPOSURE_US));
        self.enumeration(
            "TriggerSelector",
            Id::TriggerSelector,
            false,
            &[("FrameStart", 0), ("AcquisitionStart", 1)],
        );
        self.enumeration("TriggerMode", Id::TriggerMode, true, &[("Off", 0), ("On", 1)]);
        self.enumeration("TriggerSource", Id::TriggerSource, true, TriggerSource::ENTRIES);
        self.enumeration("TriggerActivation", Id::TriggerActivation, true, &[("RisingEdge", 0)]);
        self.command("TriggerSoftware", Id::TriggerSoftware, 1);
        self.integer("FrameTriggerMissedCount", Id::TriggersIgnored, Mode::Ro, false, Limits::None);
        self.category("ActionControl");
        self.integer("ActionDeviceKey", Id::ActionDeviceKey, Mode::Wo, false, Limits::None);
        self.integer("ActionGroupKey", Id::ActionGroupKey, Mode::Rw, false, Limits::None);
        self.integer("ActionGroupMask", Id::ActionGroupMask, Mode::Rw, false, Limits::None);
        self.category("AnalogControl");
        self.float("Gain", Id::Gain, "dB", &limits(GAIN_DB));
    }

    fn transport_layer_control(&mut self, clock: ClockHabit, packet_max: u16) {
        self.category("TransportLayerControl");
        self.integer("PayloadSize", Id::PayloadSize, Mode::Ro, false, Limits::None);
        self.feature("TLParamsLocked");
        self.node("<Integer Name=\"TLParamsLocked\"><Value>0</Value><Min>0</Min><Max>1</Max></Integer>");
        self.integer("GevHeartbeatTimeout", Id::Heartbeat, Mode::Rw, false, Limits::None);
        if clock.has_gev_features() || clock == ClockHabit::Nanoseconds {
            self.wide("GevTimestampTickFrequency", Id::TickFrequencyHigh, Id::TickFrequencyLow);
        }
        if clock.has_gev_features() {
            self.timestamp();
        } else if clock == ClockHabit::Nanoseconds {
            self.command("TimestampLatch", Id::TimestampControl, 2);
            self.wide("TimestampLatchValue", Id::NanosecondsHigh, Id::NanosecondsLow);
        }
        self.feature("PtpEnable");
        self.node(&format!(
            "<Boolean Name=\"PtpEnable\">{LOCKED}<pValue>PtpEnableReg</pValue><OnValue>1</OnValue>\
             <OffValue>0</OffValue></Boolean>"
        ));
        self.register("PtpEnableReg", Id::PtpEnable, Mode::Rw);
        self.feature("PtpStatus");
        let states: String = PTP_STATES
            .iter()
            .map(|(state, code)| format!("<EnumEntry Name=\"{state}\"><Value>{code}</Value></EnumEntry>"))
            .collect();
        self.node(&format!(
            "<Enumeration Name=\"PtpStatus\">{states}<pValue>PtpStatusReg</pValue></Enumeration>"
        ));
        self.register("PtpStatusReg", Id::PtpStatus, Mode::Ro);
        self.feature("GevGVSPExtendedIDMode");
        self.node(&format!(
            "<Enumeration Name=\"GevGVSPExtendedIDMode\">{LOCKED}\
             <EnumEntry Name=\"Off\"><Value>0</Value></EnumEntry>\
             <EnumEntry Name=\"On\"><Value>{EXTENDED_IDS_BIT}</Value></EnumEntry>\
             <pValue>GevGVSPExtendedIDModeReg</pValue></Enumeration>"
        ));
        self.register("GevGVSPExtendedIDModeReg", Id::GvspConfiguration, Mode::Rw);
        self.integer_node("GevSCPHostPort", LOCKED, Limits::Range(0, 0xffff, 1));
        self.bits("GevSCPHostPortReg", Id::HostPort, Mode::Rw, (16, 31));
        let (min, max) = (u64::from(*PACKET_SIZE.start()), u64::from(packet_max));
        let limits = Limits::Range(min, max, u64::from(PACKET_SIZE_STEP));
        self.integer_node("GevSCPSPacketSize", LOCKED, limits);
        self.bits("GevSCPSPacketSizeReg", Id::PacketSize, Mode::Rw, (16, 31));
        for (name, bit) in [("GevSCPSDoNotFragment", 1), ("GevSCPSFireTestPacket", 0)] {
            let register = format!("{name}Reg");
            self.feature(name);
            self.node(&match bit {
                0 => format!(
                    "<Command Name=\"{name}\">{LOCKED}<pValue>{register}</pValue>\
                     <CommandValue>1</CommandValue></Command>"
                ),
                _ => format!("<Boolean Name=\"{name}\">{LOCKED}<pValue>{register}</pValue></Boolean>"),
            });
            self.bits(&register, Id::PacketSize, Mode::Rw, (bit, bit));
        }
        self.integer("GevSCPD", Id::PacketDelay, Mode::Rw, false, Limits::None);
        self.integer("GevSCDA", Id::Destination, Mode::Rw, true, Limits::None);
        self.integer_node("GevSCSP", "", Limits::None);
        self.bits("GevSCSPReg", Id::SourcePort, Mode::Ro, (16, 31));
    }

    /// Features that the description names and does not have, and some that point to what is not there.
    fn broken(&mut self) {
        self.feature("NotThere");
        let gone = "<pValue>NoSuchNode</pValue>";
        for (name, node) in [
            (
                "BrokenInteger",
                format!("<Integer Name=\"BrokenInteger\">{gone}<pMax>NoSuchNode</pMax></Integer>"),
            ),
            ("BrokenFloat", format!("<Float Name=\"BrokenFloat\">{gone}<pMin>NoSuchNode</pMin></Float>")),
            ("BrokenBoolean", format!("<Boolean Name=\"BrokenBoolean\">{gone}</Boolean>")),
            (
                "BrokenCommand",
                format!("<Command Name=\"BrokenCommand\">{gone}<CommandValue>1</CommandValue></Command>"),
            ),
            ("BrokenEntries", format!("<Enumeration Name=\"BrokenEntries\">{gone}</Enumeration>")),
            (
                "BrokenEntry",
                "<Enumeration Name=\"BrokenEntry\"><EnumEntry Name=\"One\"></EnumEntry></Enumeration>"
                    .to_owned(),
            ),
            (
                "BrokenSwissKnife",
                "<IntSwissKnife Name=\"BrokenSwissKnife\"><pVariable Name=\"A\">NoSuchNode</pVariable>\
                 <Formula>A / 0</Formula></IntSwissKnife>"
                    .to_owned(),
            ),
        ] {
            self.feature(name);
            self.node(&node);
        }
    }

    fn timestamp(&mut self) {
        self.feature("GevTimestampControlLatch");
        self.feature("GevTimestampControlReset");
        for (name, value) in [("GevTimestampControlLatch", 2), ("GevTimestampControlReset", 1)] {
            self.node(&format!(
                "<Command Name=\"{name}\"><pValue>GevTimestampControlReg</pValue>\
                 <CommandValue>{value}</CommandValue></Command>"
            ));
        }
        self.register("GevTimestampControlReg", Id::TimestampControl, Mode::Wo);
        self.wide("GevTimestampValue", Id::TimestampHigh, Id::TimestampLow);
    }

    fn document(self, model: &str) -> String {
        let model: String = model.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '_' }).collect();
        let mut xml = format!(
            "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n\
             <RegisterDescription ModelName=\"{model}\" VendorName=\"{VENDOR}\" \
             ToolTip=\"Simulated camera of fourdbody\" StandardNameSpace=\"GEV\" \
             SchemaMajorVersion=\"1\" SchemaMinorVersion=\"1\" SchemaSubMinorVersion=\"0\" \
             MajorVersion=\"1\" MinorVersion=\"0\" SubMinorVersion=\"0\" \
             ProductGuid=\"6f0f1f2c-9a1b-4d63-9b6c-4db0d1f0c001\" \
             VersionGuid=\"6f0f1f2c-9a1b-4d63-9b6c-4db0d1f0c002\" \
             xmlns=\"http://www.genicam.org/GenApi/Version_1_1\" \
             xmlns:xsi=\"http://www.w3.org/2001/XMLSchema-instance\" \
             xsi:schemaLocation=\"http://www.genicam.org/GenApi/Version_1_1 GenApiSchema_Version_1_1.xsd\">\n"
        );
        let category = |name: &str, features: &[&str]| {
            let list: String = features.iter().map(|f| format!("<pFeature>{f}</pFeature>")).collect();
            format!("<Category Name=\"{name}\" NameSpace=\"Standard\">{list}</Category>\n")
        };
        let names: Vec<&str> = self.categories.iter().map(|(name, _)| *name).collect();
        xml.push_str(&category("Root", &names));
        for (name, features) in &self.categories {
            xml.push_str(&category(name, features));
        }
        xml.push_str(&self.nodes);
        xml.push_str("<Port Name=\"Device\" NameSpace=\"Standard\"></Port>\n</RegisterDescription>\n");
        xml
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::HashSet;

    fn names_after<'a>(xml: &'a str, mark: &str, end: char) -> Vec<&'a str> {
        xml.split(mark).skip(1).filter_map(|rest| rest.split(end).next()).collect()
    }

    #[test]
    fn every_reference_has_its_node() {
        for clock in [ClockHabit::Ticks, ClockHabit::Bootstrap, ClockHabit::Nanoseconds] {
            let habits = Habits { clock, ..Habits::default() };
            references_have_nodes(&xml("Sim 23", &habits));
        }
    }

    fn references_have_nodes(bytes: &[u8]) {
        assert!(bytes.len().is_multiple_of(4));
        let xml = std::str::from_utf8(bytes).expect("UTF-8");
        let mut names = HashSet::new();
        for name in names_after(xml, " Name=\"", '"') {
            // Entries of enumerations; one of them has the name of a command, too.
            let entry = [
                "Off",
                "On",
                "HIGH",
                "LOW",
                "Mono8",
                "Timed",
                "FrameStart",
                "RisingEdge",
                "AcquisitionStart",
            ];
            assert!(names.insert(name) || entry.contains(&name), "{name} is there twice");
        }
        for mark in ["<pFeature>", "<pValue>", "<pMax>", "<pPort>", "<pIsLocked>"] {
            for name in names_after(xml, mark, '<') {
                assert!(names.contains(name), "{mark}{name} leads nowhere");
            }
        }
    }

    #[test]
    fn the_registers_take_what_the_enumerations_declare() {
        for (name, code) in TriggerSource::ENTRIES {
            assert_eq!(TriggerSource::from_code(*code).map(|s| format!("{s:?}")).as_deref(), Some(*name));
        }
        for (_, code) in AcquisitionMode::ENTRIES {
            assert_eq!(AcquisitionMode::from_code(*code).map(|mode| mode as u32), Some(*code));
        }
    }
}
