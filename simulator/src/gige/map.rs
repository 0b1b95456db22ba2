// SPDX-License-Identifier: MIT OR Apache-2.0
//! Where each register lies: address, length, access, and whether a running acquisition locks it.

use self::Access::{ReadOnly, ReadWrite};

/// Who may do what with a register.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Access {
    /// Writes are answered with "write protect".
    ReadOnly,
    /// Readable, and writable by the controller.
    ReadWrite,
}

/// One register of the map.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Register {
    /// The address of the register's first byte.
    pub address: u32,
    /// Bytes: 4 is an unsigned integer, 8 an IEEE 754 double, anything longer text.
    pub length: u16,
    pub access: Access,
    /// A running acquisition locks it.
    pub locked: bool,
    pub id: Id,
}

macro_rules! registers {
    ($($id:ident $address:literal $length:literal $access:ident $($locked:ident)?;)*) => {
        /// The names of all registers of the map.
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        #[allow(missing_docs, reason = "the table below and the standard name them")]
        pub enum Id { $($id),* }

        impl Id {
            /// The register's address, for the GenICam description.
            pub const fn address(self) -> u32 {
                match self { $(Id::$id => $address),* }
            }
        }

        /// All registers of the map, by their addresses.
        pub const REGISTERS: &[Register] = &[$(Register {
            address: $address,
            length: $length,
            access: $access,
            locked: registers!(@locked $($locked)?),
            id: Id::$id,
        }),*];
    };
    (@locked locked) => { true };
    (@locked) => { false };
}

registers! {
    // Bootstrap registers, GigE Vision 2.x.
    Version             0x0000  4 ReadOnly;
    DeviceMode          0x0004  4 ReadOnly;
    MacHigh             0x0008  4 ReadOnly;
    MacLow              0x000c  4 ReadOnly;
    IpOptions           0x0010  4 ReadOnly;
    IpConfiguration     0x0014  4 ReadOnly;
    IpAddress           0x0024  4 ReadOnly;
    SubnetMask          0x0034  4 ReadOnly;
    Gateway             0x0044  4 ReadOnly;
    Manufacturer        0x0048 32 ReadOnly;
    Model               0x0068 32 ReadOnly;
    DeviceVersion       0x0088 32 ReadOnly;
    ManufacturerInfo    0x00a8 48 ReadOnly;
    Serial              0x00d8 16 ReadOnly;
    UserName            0x00e8 16 ReadWrite;
    XmlUrl              0x0200 512 ReadOnly;
    XmlUrlSecond        0x0400 512 ReadOnly;
    NetworkInterfaces   0x0600  4 ReadOnly;
    PersistentAddress   0x064c  4 ReadOnly;
    PersistentMask      0x065c  4 ReadOnly;
    PersistentGateway   0x066c  4 ReadOnly;
    MessageChannels     0x0900  4 ReadOnly;
    StreamChannels      0x0904  4 ReadOnly;
    ActionSignals       0x0908  4 ReadOnly;
    ActionDeviceKey     0x090c  4 ReadWrite;
    GvspCapability      0x092c  4 ReadOnly;
    MessageCapability   0x0930  4 ReadOnly;
    GvcpCapability      0x0934  4 ReadOnly;
    Heartbeat           0x0938  4 ReadWrite;
    TickFrequencyHigh   0x093c  4 ReadOnly;
    TickFrequencyLow    0x0940  4 ReadOnly;
    TimestampControl    0x0944  4 ReadWrite;
    TimestampHigh       0x0948  4 ReadOnly;
    TimestampLow        0x094c  4 ReadOnly;
    GvspConfiguration   0x0960  4 ReadWrite locked;
    Privilege           0x0a00  4 ReadWrite;
    ControllerPort      0x0a04  4 ReadOnly;
    ControllerAddress   0x0a14  4 ReadOnly;
    HostPort            0x0d00  4 ReadWrite;
    PacketSize          0x0d04  4 ReadWrite locked;
    PacketDelay         0x0d08  4 ReadWrite;
    Destination         0x0d18  4 ReadWrite;
    SourcePort          0x0d1c  4 ReadOnly;
    StreamCapability    0x0d20  4 ReadOnly;
    StreamConfiguration 0x0d24  4 ReadWrite locked;
    ActionGroupKey      0x9800  4 ReadWrite;
    ActionGroupMask     0x9804  4 ReadWrite;
    // The camera's features, as its GenICam description declares them.
    SensorWidth         0x10000 4 ReadOnly;
    SensorHeight        0x10004 4 ReadOnly;
    Width               0x10008 4 ReadWrite locked;
    Height              0x1000c 4 ReadWrite locked;
    OffsetX             0x10010 4 ReadWrite locked;
    OffsetY             0x10014 4 ReadWrite locked;
    PixelFormat         0x10018 4 ReadWrite locked;
    PayloadSize         0x1001c 4 ReadOnly;
    AcquisitionMode     0x10020 4 ReadWrite locked;
    FrameCount          0x10024 4 ReadWrite locked;
    AcquisitionStart    0x10028 4 ReadWrite;
    AcquisitionStop     0x1002c 4 ReadWrite;
    FrameRateEnable     0x10030 4 ReadWrite;
    FrameRate           0x10038 8 ReadWrite;
    FrameRateMax        0x10040 8 ReadOnly;
    ExposureTime        0x10048 8 ReadWrite;
    ExposureMode        0x10050 4 ReadWrite locked;
    ExposureAuto        0x10054 4 ReadWrite locked;
    Gain                0x10058 8 ReadWrite;
    TriggerSelector     0x10060 4 ReadWrite;
    TriggerMode         0x10064 4 ReadWrite locked;
    TriggerSource       0x10068 4 ReadWrite locked;
    TriggerActivation   0x1006c 4 ReadWrite locked;
    TriggerSoftware     0x10070 4 ReadWrite;
    TriggersIgnored     0x10074 4 ReadOnly;
    NanosecondsHigh     0x10080 4 ReadOnly;
    NanosecondsLow      0x10084 4 ReadOnly;
    PtpEnable           0x10090 4 ReadWrite locked;
    PtpStatus           0x10094 4 ReadOnly;
}

/// The register that holds an address, and how far into it the address lies.
pub fn find(address: u32) -> Option<(&'static Register, usize)> {
    let after = REGISTERS.partition_point(|r| r.address <= address);
    let register = REGISTERS.get(after.checked_sub(1)?)?;
    let offset = usize::try_from(address - register.address).ok()?;
    (offset < usize::from(register.length)).then_some((register, offset))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_is_sorted_and_disjoint() {
        for pair in REGISTERS.windows(2) {
            let end = pair[0].address + u32::from(pair[0].length);
            assert!(end <= pair[1].address, "{:?} runs into {:?}", pair[0].id, pair[1].id);
        }
        for register in REGISTERS {
            assert!(register.address.is_multiple_of(4) && register.length.is_multiple_of(4));
            assert_eq!(find(register.address), Some((register, 0)));
            assert_eq!(register.id.address(), register.address);
        }
        assert_eq!(find(0x18), None);
        assert_eq!(find(0x4c).map(|(r, offset)| (r.id, offset)), Some((Id::Manufacturer, 4)));
    }
}
