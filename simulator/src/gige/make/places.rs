// SPDX-License-Identifier: MIT OR Apache-2.0
//! Where the features of a make lie: registers of their own, or those that every GigE Vision camera has.

use super::table::{Feature, Kind};
use crate::gige::map::Id;
use crate::gige::registers::EXTENDED_IDS_BIT;

/// Where the features' registers begin.
const FEATURES: u32 = 0x0002_0000;
/// Bytes from one feature's register to the next one's: as many as a text has.
pub const STRIDE: u32 = 0x40;
/// Where the firmware's words on each feature begin: smallest and largest value, increment, state.
const LIMITS: u32 = 0x0006_0000;
/// Most features of a make.
pub const MOST: usize = 4096;

/// A word of the firmware's state of a feature.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Said {
    /// Its smallest value, 8 bytes.
    Min,
    /// Its largest value, 8 bytes.
    Max,
    /// The feature's increment, in 8 bytes.
    Inc,
    /// Its state, 4 bytes: the bits below.
    State,
}

/// Bit of [`Said::State`]: writing is refused.
pub const LOCKED: u32 = 1;
/// Bit of [`Said::State`]: it is there at the moment.
pub const AVAILABLE: u32 = 2;
/// Bit of [`Said::State`]: this model has it.
pub const IMPLEMENTED: u32 = 4;

/// What lies at an address.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Place {
    /// A feature's value, and how many bytes into it.
    Value(usize, usize),
    /// What is said of a feature, and how many bytes into it.
    Said(usize, Said, usize),
}

/// Bytes of a feature's register.
pub fn length(kind: Kind) -> u32 {
    match kind {
        Kind::Integer | Kind::Float => 8,
        Kind::Enumeration | Kind::Boolean | Kind::Command => 4,
        Kind::String => STRIDE,
    }
}

fn offset(base: u32, index: usize) -> u32 {
    base + STRIDE * u32::try_from(index.min(MOST)).unwrap_or(0)
}

/// The address of a feature's value.
pub fn value(index: usize) -> u32 {
    offset(FEATURES, index)
}

/// The address of what is said of a feature.
pub fn said(index: usize, what: Said) -> u32 {
    offset(LIMITS, index)
        + match what {
            Said::Min => 0,
            Said::Max => 8,
            Said::Inc => 16,
            Said::State => 24,
        }
}

/// What lies at an address; the index may be beyond the last feature.
pub fn find(address: u32) -> Option<Place> {
    let within = |base: u32| {
        let distance = address.checked_sub(base)?;
        let index = usize::try_from(distance / STRIDE).ok().filter(|index| *index < MOST)?;
        Some((index, usize::try_from(distance % STRIDE).ok()?))
    };
    if let Some((index, at)) = within(LIMITS) {
        return match at {
            0..8 => Some(Place::Said(index, Said::Min, at)),
            8..16 => Some(Place::Said(index, Said::Max, at - 8)),
            16..24 => Some(Place::Said(index, Said::Inc, at - 16)),
            24..28 => Some(Place::Said(index, Said::State, at - 24)),
            _ => None,
        };
    }
    within(FEATURES).map(|(index, at)| Place::Value(index, at))
}

/// A register of GigE Vision that a feature shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Link {
    pub address: u32,
    /// Number of bytes of the place.
    pub length: u32,
    /// The bits it has of it, the most significant being 0; all where there is none.
    pub bits: Option<(u8, u8)>,
    pub writable: bool,
    /// For a command: what is written.
    pub command: u32,
    /// For an enumeration: codes of its entries, in the order of [`Link::entries`].
    pub entries: &'static [(&'static str, u32)],
}

/// The register that a feature shows, where its name is one of the standard's.
pub fn link(feature: &Feature) -> Option<Link> {
    use Kind::{Boolean, Command, Enumeration, Integer, String as Text};
    const EXTENDED: &[(&str, u32)] = &[("Off", 0), ("On", EXTENDED_IDS_BIT)];
    const PRIVILEGE: &[(&str, u32)] = &[
        ("OpenAccess", 0),
        ("ExclusiveAccess", 1),
        ("Exclusive", 1),
        ("ControlAccess", 2),
        ("Control", 2),
        ("ExclusiveAndControl", 3),
        ("ExclusiveControl", 3),
    ];
    let at = |id: Id, length, writable| Link {
        address: id.address(),
        length,
        bits: None,
        writable,
        command: 1,
        entries: &[],
    };
    let bits = |id: Id, bits, writable| Link { bits: Some(bits), ..at(id, 4, writable) };
    let clock = |command| Link { command, ..at(Id::TimestampControl, 4, true) };
    let link = match (feature.name.as_str(), feature.kind) {
        ("DeviceVendorName", Text) => at(Id::Manufacturer, 32, false),
        ("DeviceModelName", Text) => at(Id::Model, 32, false),
        ("DeviceVersion", Text) => at(Id::DeviceVersion, 32, false),
        ("DeviceManufacturerInfo", Text) => at(Id::ManufacturerInfo, 48, false),
        ("DeviceSerialNumber" | "DeviceID", Text) => at(Id::Serial, 16, false),
        ("DeviceUserID", Text) => at(Id::UserName, 16, true),
        ("GevMACAddress", Integer) => at(Id::MacHigh, 8, false),
        ("GevCurrentIPAddress", Integer) => at(Id::IpAddress, 4, false),
        ("GevCurrentSubnetMask", Integer) => at(Id::SubnetMask, 4, false),
        ("GevCurrentDefaultGateway", Integer) => at(Id::Gateway, 4, false),
        ("GevPersistentIPAddress", Integer) => at(Id::PersistentAddress, 4, true),
        ("GevPersistentSubnetMask", Integer) => at(Id::PersistentMask, 4, true),
        ("GevPersistentDefaultGateway", Integer) => at(Id::PersistentGateway, 4, true),
        ("GevCurrentIPConfigurationPersistentIP", Boolean) => bits(Id::IpConfiguration, (31, 31), true),
        ("GevCurrentIPConfigurationDHCP", Boolean) => bits(Id::IpConfiguration, (30, 30), true),
        ("GevCurrentIPConfigurationLLA", Boolean) => bits(Id::IpConfiguration, (29, 29), false),
        ("GevHeartbeatTimeout", Integer) => at(Id::Heartbeat, 4, true),
        ("GevTimestampTickFrequency", Integer) => at(Id::TickFrequencyHigh, 8, false),
        ("GevTimestampTickFrequencyHigh", Integer) => at(Id::TickFrequencyHigh, 4, false),
        ("GevTimestampTickFrequencyLow", Integer) => at(Id::TickFrequencyLow, 4, false),
        ("GevTimestampValue", Integer) => at(Id::TimestampHigh, 8, false),
        ("GevTimestampValueHigh", Integer) => at(Id::TimestampHigh, 4, false),
        ("GevTimestampValueLow", Integer) => at(Id::TimestampLow, 4, false),
        ("GevTimestampControlReset" | "TimestampReset", Command) => clock(1),
        ("GevTimestampControlLatch" | "TimestampLatch", Command) => clock(2),
        ("GevTimestampControlLatchReset", Command) => clock(3),
        ("TimestampLatchValue" | "Timestamp", Integer) => at(Id::NanosecondsHigh, 8, false),
        ("GevCCP", Enumeration) => Link { entries: PRIVILEGE, ..at(Id::Privilege, 4, true) },
        ("GevGVSPExtendedIDMode", Enumeration) => {
            Link { entries: EXTENDED, ..at(Id::GvspConfiguration, 4, true) }
        }
        ("GevSCPHostPort", Integer) => bits(Id::HostPort, (16, 31), true),
        ("GevSCPSPacketSize", Integer) => bits(Id::PacketSize, (16, 31), true),
        ("GevSCPSFireTestPacket", Boolean | Command) => bits(Id::PacketSize, (0, 0), true),
        ("GevSCPSDoNotFragment", Boolean) => bits(Id::PacketSize, (1, 1), true),
        ("GevSCPD", Integer) => at(Id::PacketDelay, 4, true),
        ("GevSCDA", Integer) => at(Id::Destination, 4, true),
        ("GevSCSP", Integer) => bits(Id::SourcePort, (16, 31), false),
        _ => return None,
    };
    // An entry without a code of the standard's is another feature of the same name.
    let known = |entry: &String| link.entries.iter().any(|(name, _)| name == entry);
    (feature.kind != Enumeration || feature.entries.iter().all(known)).then_some(link)
}
