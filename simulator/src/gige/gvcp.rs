// SPDX-License-Identifier: MIT OR Apache-2.0
//! GVCP, the GigE Vision control protocol: packets to and from bytes, nothing else (no sockets, no state).
//!
//! A command is an 8-byte header (key 0x42, flags, command, length, request id) and its payload; an
//! acknowledge is status, command + 1, length, request id, payload. All big-endian (GigE Vision 2.x, part 2).

use std::net::Ipv4Addr;

/// UDP port on which every GigE Vision device listens.
pub const PORT: u16 = 3956;
/// Longest payload of a GVCP packet (576-byte IP datagram without IP, UDP and GVCP headers).
pub const MAX_PAYLOAD: usize = 540;
/// Most bytes of one READMEM or WRITEMEM: the payload limit without the address.
pub const MAX_MEMORY: usize = MAX_PAYLOAD - 4;
/// Bytes of a discovery answer: the first bootstrap registers as they lie in memory.
pub const DISCOVERY_SIZE: usize = 0xf8;

const HEADER: usize = 8;
const KEY: u8 = 0x42;
const FLAG_ACK: u8 = 0x01;
const FLAG_EXTENDED_ID: u8 = 0x10;
const FLAG_SCHEDULED: u8 = 0x80;

const DISCOVERY: u16 = 0x0002;
const FORCE_IP: u16 = 0x0004;
const PACKET_RESEND: u16 = 0x0040;
const READ_REGISTER: u16 = 0x0080;
const WRITE_REGISTER: u16 = 0x0082;
const READ_MEMORY: u16 = 0x0084;
const WRITE_MEMORY: u16 = 0x0086;
const PENDING_ACK: u16 = 0x0089;
const ACTION: u16 = 0x0100;
/// Bytes of a FORCEIP payload.
const FORCE_IP_SIZE: usize = 56;

/// Status codes that this device answers with (GigE Vision 2.x, table "status codes").
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u16)]
pub enum Status {
    Success = 0x0000,
    /// Command or value is not supported by the device.
    NotImplemented = 0x8001,
    /// A parameter is out of its range.
    InvalidParameter = 0x8002,
    /// No register at this address.
    InvalidAddress = 0x8003,
    WriteProtect = 0x8004,
    /// Address or length is not a multiple of four.
    BadAlignment = 0x8005,
    /// The sender lacks the privilege, or the register is locked while the camera acquires.
    AccessDenied = 0x8006,
    /// The packet requested again is no longer (or was never) in the camera's memory.
    PacketUnavailable = 0x800c,
    /// Header and datagram contradict each other.
    InvalidHeader = 0x800e,
    /// No clock sets this device's, and so it has none by which to act.
    NoReferenceTime = 0x8013,
    /// The time of the action was past; it was done at once.
    ActionLate = 0x8016,
}

/// The packets of a block whose retransmission is requested.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ResendRequest {
    /// Stream channel; this device has channel 0 only.
    pub channel: u16,
    /// GVSP block id: 16 bits, or 64 when `extended`.
    pub block_id: u64,
    /// The first packet id that is requested.
    pub first: u32,
    /// The last packet id that is requested, inclusive.
    pub last: u32,
    /// Sent with 64-bit block ids and 32-bit packet ids.
    pub extended: bool,
}

/// A GVCP command that a client sends.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Command {
    Discovery,
    /// Read 32-bit registers at these addresses.
    ReadRegisters(Vec<u32>),
    /// Write (address, value) pairs, in order.
    WriteRegisters(Vec<(u32, u32)>),
    /// Read `count` bytes from `address`.
    ReadMemory {
        address: u32,
        count: u16,
    },
    /// Write bytes from `address` on.
    WriteMemory {
        address: u32,
        data: Vec<u8>,
    },
    PacketResend(ResendRequest),
    /// Whoever has this MAC shall have this address.
    ForceIp(ForceIp),
    /// Whoever has these keys shall act.
    Action(ActionCommand),
}

/// Who shall act, and when.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ActionCommand {
    /// Of the devices that are meant.
    pub device_key: u32,
    /// Of the group that is meant.
    pub group_key: u32,
    /// Bits, of which a device must have one.
    pub group_mask: u32,
    /// When, on the devices' common clock, ns; at once otherwise.
    pub at_ns: Option<u64>,
}

impl ActionCommand {
    fn payload(&self) -> Vec<u8> {
        let keys = [self.device_key, self.group_key, self.group_mask];
        let mut bytes: Vec<u8> = keys.iter().flat_map(|key| key.to_be_bytes()).collect();
        bytes.extend(self.at_ns.iter().flat_map(|ns| ns.to_be_bytes()));
        bytes
    }

    fn decode(scheduled: bool, payload: &[u8]) -> Option<Self> {
        let word = |at| be32(payload, at);
        if payload.len() != if scheduled { 20 } else { 12 } {
            return None;
        }
        let at_ns = match scheduled {
            true => Some(u64::from(word(12)?) << 32 | u64::from(word(16)?)),
            false => None,
        };
        Some(Self { device_key: word(0)?, group_key: word(4)?, group_mask: word(8)?, at_ns })
    }
}

/// Where a device shall move to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ForceIp {
    /// The MAC of the camera that is meant, 48 bits.
    pub mac: u64,
    pub address: Ipv4Addr,
    pub mask: Ipv4Addr,
    pub gateway: Ipv4Addr,
}

impl ForceIp {
    fn payload(&self) -> Vec<u8> {
        let mut bytes = self.mac.to_be_bytes().to_vec();
        for word in [self.address, self.mask, self.gateway] {
            bytes.extend([0; 12]);
            bytes.extend(word.octets());
        }
        bytes
    }

    fn decode(payload: &[u8]) -> Option<Self> {
        let word = |at| be32(payload, at).map(Ipv4Addr::from_bits);
        let mac = u64::from(be16(payload, 2)?) << 32 | u64::from(be32(payload, 4)?);
        Some(Self { mac, address: word(20)?, mask: word(36)?, gateway: word(52)? })
    }
}

/// One GVCP command, with the flags of its header that concern the answer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Request {
    /// Echoed by the acknowledge; never 0.
    pub id: u16,
    /// The sender wants an acknowledge.
    pub ack: bool,
    pub command: Command,
}

/// Why a datagram is not a command.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Malformed {
    /// Not GVCP at all, or too short for a header: no answer is possible.
    Ignore,
    /// A GVCP header, and something wrong after it.
    Refuse {
        status: Status,
        /// The command that is refused.
        command: u16,
        id: u16,
        /// The sender wants an acknowledge.
        ack: bool,
    },
}

impl Malformed {
    /// The error acknowledge, where one is due.
    pub fn answer(self) -> Option<Vec<u8>> {
        match self {
            Malformed::Refuse { status, command, id, ack: true } => {
                Some(acknowledge(status, command.wrapping_add(1), id, &[]))
            }
            Malformed::Refuse { .. } | Malformed::Ignore => None,
        }
    }
}

fn be16(bytes: &[u8], at: usize) -> Option<u16> {
    Some(u16::from_be_bytes(bytes.get(at..at.checked_add(2)?)?.try_into().ok()?))
}

fn be32(bytes: &[u8], at: usize) -> Option<u32> {
    Some(u32::from_be_bytes(bytes.get(at..at.checked_add(4)?)?.try_into().ok()?))
}

impl Request {
    /// Reads one datagram.
    ///
    /// # Errors
    /// [`Malformed`], with the error acknowledge that is due, if any.
    pub fn decode(datagram: &[u8]) -> Result<Self, Malformed> {
        let (Some(&key), Some(&flags)) = (datagram.first(), datagram.get(1)) else {
            return Err(Malformed::Ignore);
        };
        let (Some(code), Some(length), Some(id)) = (be16(datagram, 2), be16(datagram, 4), be16(datagram, 6))
        else {
            return Err(Malformed::Ignore);
        };
        if key != KEY {
            return Err(Malformed::Ignore);
        }
        let ack = flags & FLAG_ACK != 0;
        let refuse = |status| Malformed::Refuse { status, command: code, id, ack };
        let payload = &datagram[HEADER..];
        if payload.len() != usize::from(length) || payload.len() > MAX_PAYLOAD || id == 0 {
            return Err(refuse(Status::InvalidHeader));
        }
        let command = decode_payload(code, flags, payload).map_err(refuse)?;
        Ok(Request { id, ack, command })
    }

    /// The datagram of this command, as a controller sends it.
    pub fn encode(&self) -> Vec<u8> {
        let mut flags = if self.ack { FLAG_ACK } else { 0 };
        let (code, payload) = match &self.command {
            Command::Discovery => (DISCOVERY, Vec::new()),
            Command::ReadRegisters(addresses) => {
                (READ_REGISTER, addresses.iter().flat_map(|a| a.to_be_bytes()).collect())
            }
            Command::WriteRegisters(pairs) => {
                let bytes = pairs.iter().flat_map(|(a, v)| [a.to_be_bytes(), v.to_be_bytes()].concat());
                (WRITE_REGISTER, bytes.collect())
            }
            Command::ReadMemory { address, count } => {
                (READ_MEMORY, [&address.to_be_bytes()[..], &[0, 0], &count.to_be_bytes()].concat())
            }
            Command::WriteMemory { address, data } => {
                (WRITE_MEMORY, [&address.to_be_bytes(), &data[..]].concat())
            }
            Command::ForceIp(force) => (FORCE_IP, force.payload()),
            Command::Action(action) => {
                if action.at_ns.is_some() {
                    flags |= FLAG_SCHEDULED;
                }
                (ACTION, action.payload())
            }
            Command::PacketResend(request) => {
                if request.extended {
                    flags |= FLAG_EXTENDED_ID;
                }
                (PACKET_RESEND, request.payload())
            }
        };
        let length = u16::try_from(payload.len()).unwrap_or(u16::MAX);
        let mut bytes = vec![KEY, flags];
        bytes.extend(code.to_be_bytes());
        bytes.extend(length.to_be_bytes());
        bytes.extend(self.id.to_be_bytes());
        bytes.extend(payload);
        bytes
    }
}

impl ResendRequest {
    fn payload(&self) -> Vec<u8> {
        let mut bytes = self.channel.to_be_bytes().to_vec();
        let short_id = if self.extended { 0 } else { (self.block_id & 0xffff) as u16 };
        bytes.extend(short_id.to_be_bytes());
        bytes.extend(self.first.to_be_bytes());
        bytes.extend(self.last.to_be_bytes());
        if self.extended {
            bytes.extend(self.block_id.to_be_bytes());
        }
        bytes
    }

    fn decode(extended: bool, payload: &[u8]) -> Option<Self> {
        let expected = if extended { 20 } else { 12 };
        if payload.len() != expected {
            return None;
        }
        let (first, last) = (be32(payload, 4)?, be32(payload, 8)?);
        let channel = be16(payload, 0)?;
        if extended {
            let block_id = u64::from(be32(payload, 12)?) << 32 | u64::from(be32(payload, 16)?);
            return Some(Self { channel, block_id, first, last, extended });
        }
        // Standard ids: packet ids have 24 bits, the upper byte is reserved.
        let (first, last) = (first & 0x00ff_ffff, last & 0x00ff_ffff);
        Some(Self { channel, block_id: u64::from(be16(payload, 2)?), first, last, extended })
    }
}

fn decode_payload(code: u16, flags: u8, payload: &[u8]) -> Result<Command, Status> {
    let word = |at| be32(payload, at).ok_or(Status::InvalidHeader);
    match code {
        DISCOVERY if payload.is_empty() => Ok(Command::Discovery),
        READ_REGISTER if !payload.is_empty() && payload.len().is_multiple_of(4) => {
            (0..payload.len()).step_by(4).map(word).collect::<Result<_, _>>().map(Command::ReadRegisters)
        }
        WRITE_REGISTER if !payload.is_empty() && payload.len().is_multiple_of(8) => {
            let pairs = (0..payload.len()).step_by(8).map(|at| Ok((word(at)?, word(at + 4)?)));
            pairs.collect::<Result<_, _>>().map(Command::WriteRegisters)
        }
        READ_MEMORY if payload.len() == 8 => {
            let count = be16(payload, 6).ok_or(Status::InvalidHeader)?;
            if usize::from(count) > MAX_MEMORY || count == 0 {
                return Err(Status::InvalidParameter);
            }
            Ok(Command::ReadMemory { address: word(0)?, count })
        }
        WRITE_MEMORY if payload.len() > 4 => {
            Ok(Command::WriteMemory { address: word(0)?, data: payload[4..].to_vec() })
        }
        // Without what a FORCEIP holds it is nothing that a device knows.
        FORCE_IP if payload.len() == FORCE_IP_SIZE => {
            ForceIp::decode(payload).map(Command::ForceIp).ok_or(Status::InvalidHeader)
        }
        ACTION => ActionCommand::decode(flags & FLAG_SCHEDULED != 0, payload)
            .map(Command::Action)
            .ok_or(Status::InvalidHeader),
        PACKET_RESEND => ResendRequest::decode(flags & FLAG_EXTENDED_ID != 0, payload)
            .map(Command::PacketResend)
            .ok_or(Status::InvalidHeader),
        DISCOVERY | READ_REGISTER | WRITE_REGISTER | READ_MEMORY | WRITE_MEMORY => Err(Status::InvalidHeader),
        _ => Err(Status::NotImplemented),
    }
}

/// An acknowledge: `command` is the acknowledge's own code (command + 1).
fn acknowledge(status: Status, command: u16, id: u16, payload: &[u8]) -> Vec<u8> {
    let length = u16::try_from(payload.len()).unwrap_or(u16::MAX);
    let mut bytes = Vec::with_capacity(HEADER + payload.len());
    bytes.extend((status as u16).to_be_bytes());
    bytes.extend(command.to_be_bytes());
    bytes.extend(length.to_be_bytes());
    bytes.extend(id.to_be_bytes());
    bytes.extend_from_slice(payload);
    bytes
}

/// DISCOVERY_ACK: the first [`DISCOVERY_SIZE`] bytes of the bootstrap registers.
pub fn discovery_ack(id: u16, bootstrap: &[u8; DISCOVERY_SIZE]) -> Vec<u8> {
    acknowledge(Status::Success, DISCOVERY + 1, id, bootstrap)
}

/// FORCEIP_ACK: nothing but its status.
pub fn force_ip_ack(id: u16, status: Status) -> Vec<u8> {
    acknowledge(status, FORCE_IP + 1, id, &[])
}

/// Whether a datagram is an action command, right or wrong.
pub fn is_action(datagram: &[u8]) -> bool {
    datagram.first() == Some(&KEY) && be16(datagram, 2) == Some(ACTION)
}

/// ACTION_ACK: nothing but its status.
pub fn action_ack(id: u16, status: Status) -> Vec<u8> {
    acknowledge(status, ACTION + 1, id, &[])
}

/// PENDING_ACK: the answer to request `id` follows after this number of milliseconds.
pub fn pending_ack(id: u16, milliseconds: u16) -> Vec<u8> {
    let time = milliseconds.to_be_bytes();
    acknowledge(Status::Success, PENDING_ACK, id, &[0, 0, time[0], time[1]])
}

/// The request id of an answer to a write, which is what can take a camera long.
pub fn answers_write(answer: &[u8]) -> Option<u16> {
    let code = be16(answer, 2)?;
    [WRITE_REGISTER + 1, WRITE_MEMORY + 1].contains(&code).then(|| be16(answer, 6))?
}

/// READREG_ACK: the values read, up to the first that failed.
pub fn read_registers_ack(id: u16, status: Status, values: &[u32]) -> Vec<u8> {
    let payload: Vec<u8> = values.iter().flat_map(|v| v.to_be_bytes()).collect();
    acknowledge(status, READ_REGISTER + 1, id, &payload)
}

/// WRITEREG_ACK: how many registers were written; when one failed, also its index.
pub fn write_registers_ack(id: u16, status: Status, written: u16) -> Vec<u8> {
    let index = written.to_be_bytes();
    acknowledge(status, WRITE_REGISTER + 1, id, &[0, 0, index[0], index[1]])
}

/// READMEM_ACK: address and data; an error carries neither.
pub fn read_memory_ack(id: u16, result: Result<(u32, &[u8]), Status>) -> Vec<u8> {
    match result {
        Ok((address, data)) => {
            let payload = [&address.to_be_bytes(), data].concat();
            acknowledge(Status::Success, READ_MEMORY + 1, id, &payload)
        }
        Err(status) => acknowledge(status, READ_MEMORY + 1, id, &[]),
    }
}

/// WRITEMEM_ACK: how many bytes were written; when one register failed, also its offset.
pub fn write_memory_ack(id: u16, status: Status, written: u16) -> Vec<u8> {
    let index = written.to_be_bytes();
    acknowledge(status, WRITE_MEMORY + 1, id, &[0, 0, index[0], index[1]])
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn commands_have_the_bytes_of_the_standard() {
        // key, flags | READREG | 4 bytes | id 0x1234 | CCP at 0x0a00
        let golden = [0x42, 0x01, 0x00, 0x80, 0x00, 0x04, 0x12, 0x34, 0x00, 0x00, 0x0a, 0x00];
        let read = Request { id: 0x1234, ack: true, command: Command::ReadRegisters(vec![0x0a00]) };
        assert_eq!(read.encode(), golden);
        assert_eq!(Request::decode(&golden), Ok(read));

        // WRITEREG of CCP = 2 (control): address, value
        let golden = [0x42, 1, 0x00, 0x82, 0x00, 0x08, 0, 1, 0x00, 0x00, 0x0a, 0x00, 0, 0, 0, 2];
        let write = Request { id: 1, ack: true, command: Command::WriteRegisters(vec![(0x0a00, 2)]) };
        assert_eq!(write.encode(), golden);

        // READMEM of 512 bytes at 0x200: address, reserved, count
        let golden = [0x42, 1, 0x00, 0x84, 0x00, 0x08, 0, 2, 0x00, 0x00, 0x02, 0x00, 0, 0, 0x02, 0x00];
        let read = Request { id: 2, ack: true, command: Command::ReadMemory { address: 0x200, count: 512 } };
        assert_eq!(read.encode(), golden);

        // Discovery as Aravis 0.8.26 broadcasts it: id 0xffff, no payload
        let golden = [0x42, 0x01, 0x00, 0x02, 0x00, 0x00, 0xff, 0xff];
        assert_eq!(Request::decode(&golden).map(|r| (r.id, r.command)), Ok((0xffff, Command::Discovery)));
    }

    #[test]
    fn resend_requests_come_in_two_layouts() {
        // channel 0, block 7 | first 3 | last 5
        let golden = [0x42, 0, 0x00, 0x40, 0, 12, 0, 9, 0, 0, 0, 7, 0, 0, 0, 3, 0, 0, 0, 5];
        let expected = ResendRequest { channel: 0, block_id: 7, first: 3, last: 5, extended: false };
        let request = Request { id: 9, ack: false, command: Command::PacketResend(expected) };
        assert_eq!(Request::decode(&golden), Ok(request));

        // flag 0x10: channel 0, reserved | first 3 | last 5 | 64-bit block id 2^32 + 7
        let golden = [
            0x42, 0x10, 0x00, 0x40, 0, 20, 0, 9, 0, 0, 0, 0, 0, 0, 0, 3, 0, 0, 0, 5, //
            0, 0, 0, 1, 0, 0, 0, 7,
        ];
        let extended = ResendRequest { block_id: (1 << 32) + 7, extended: true, ..expected };
        assert_eq!(Request::decode(&golden).map(|r| r.command), Ok(Command::PacketResend(extended)));
    }

    #[test]
    fn actions_have_the_bytes_of_the_standard() {
        // ACTION 0x0100: device key | group key | group mask, and with flag 0x80 a time, high word first
        let at_once = [0x42, 1, 1, 0, 0, 12, 0, 9, 0, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0, 3];
        let action = ActionCommand { device_key: 1, group_key: 2, group_mask: 3, at_ns: None };
        let request = Request { id: 9, ack: true, command: Command::Action(action) };
        assert_eq!(Request::decode(&at_once), Ok(request));
        let scheduled = [
            0x42, 0x81, 1, 0, 0, 20, 0, 9, 0, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0, 3, //
            0, 0, 0, 1, 0, 0, 0, 7,
        ];
        let action = ActionCommand { at_ns: Some((1 << 32) + 7), ..action };
        assert_eq!(Request::decode(&scheduled).map(|r| r.command), Ok(Command::Action(action)));
        // ACTION_ACK 0x0101 with status 0x8016: late
        assert_eq!(action_ack(9, Status::ActionLate), [0x80, 0x16, 1, 1, 0, 0, 0, 9]);
    }

    #[test]
    fn acknowledges_have_the_bytes_of_the_standard() {
        // status 0 | READREG_ACK 0x81 | 4 bytes | id | value
        assert_eq!(
            read_registers_ack(0x1234, Status::Success, &[0xdead_beef]),
            [0, 0, 0x00, 0x81, 0, 4, 0x12, 0x34, 0xde, 0xad, 0xbe, 0xef]
        );
        // status 0x8006 access denied | WRITEREG_ACK 0x83 | 4 bytes | id | reserved, index 0
        assert_eq!(
            write_registers_ack(3, Status::AccessDenied, 0),
            [0x80, 0x06, 0x00, 0x83, 0, 4, 0, 3, 0, 0, 0, 0]
        );
        // status 0x8003 invalid address | READMEM_ACK 0x85 | nothing
        assert_eq!(read_memory_ack(3, Err(Status::InvalidAddress)), [0x80, 0x03, 0x00, 0x85, 0, 0, 0, 3]);
    }

    #[test]
    fn wrong_packets_are_refused_or_ignored() {
        let answer = |bytes: &[u8]| Request::decode(bytes).expect_err("malformed").answer();
        assert_eq!(answer(&[0x42, 1, 0]), None, "too short");
        assert_eq!(answer(&[0x43, 1, 0, 0x80, 0, 0, 0, 1]), None, "another protocol");
        // FORCEIP (4) is not implemented: 0x8001, FORCEIP_ACK 5
        assert_eq!(answer(&[0x42, 1, 0, 4, 0, 0, 0, 1]), Some(vec![0x80, 1, 0, 5, 0, 0, 0, 1]));
        assert_eq!(answer(&[0x42, 0, 0, 4, 0, 0, 0, 1]), None, "no acknowledge asked for");
        // The header promises four bytes that are not there: 0x800e
        assert_eq!(answer(&[0x42, 1, 0, 0x80, 0, 4, 0, 1]), Some(vec![0x80, 0x0e, 0, 0x81, 0, 0, 0, 1]));
    }

    fn commands() -> impl Strategy<Value = Command> {
        let memory = proptest::collection::vec(any::<u8>(), 1..=MAX_MEMORY);
        prop_oneof![
            Just(Command::Discovery),
            proptest::collection::vec(any::<u32>(), 1..=135).prop_map(Command::ReadRegisters),
            proptest::collection::vec(any::<(u32, u32)>(), 1..=67).prop_map(Command::WriteRegisters),
            (any::<u32>(), 1..=MAX_MEMORY as u16)
                .prop_map(|(address, count)| Command::ReadMemory { address, count }),
            (any::<u32>(), memory).prop_map(|(address, data)| Command::WriteMemory { address, data }),
            (any::<(u32, u32, u32)>(), any::<Option<u64>>()).prop_map(
                |((device_key, group_key, group_mask), at_ns)| {
                    Command::Action(ActionCommand { device_key, group_key, group_mask, at_ns })
                }
            ),
            (any::<u16>(), any::<u64>(), any::<(u32, u32)>(), any::<bool>()).prop_map(
                |(channel, block_id, (first, last), extended)| {
                    let (ids, packets) = if extended { (u64::MAX, u32::MAX) } else { (0xffff, 0x00ff_ffff) };
                    Command::PacketResend(ResendRequest {
                        channel,
                        block_id: block_id & ids,
                        first: first & packets,
                        last: last & packets,
                        extended,
                    })
                }
            ),
        ]
    }

    proptest! {
        #[test]
        fn what_is_encoded_is_decoded(command in commands(), id in 1u16.., ack: bool) {
            let request = Request { id, ack, command };
            prop_assert_eq!(Request::decode(&request.encode()), Ok(request));
        }

        #[test]
        fn no_datagram_panics(bytes in proptest::collection::vec(any::<u8>(), 0..700)) {
            if let Err(malformed) = Request::decode(&bytes) {
                let _ = malformed.answer();
            }
        }

        #[test]
        fn no_payload_panics(
            code in prop_oneof![Just(2u16), Just(0x40), Just(0x80), Just(0x82), Just(0x84), Just(0x86), Just(0x100), any::<u16>()],
            flags: u8,
            payload in proptest::collection::vec(any::<u8>(), 0..560),
        ) {
            let mut bytes = vec![KEY, flags];
            bytes.extend(code.to_be_bytes());
            bytes.extend((payload.len() as u16).to_be_bytes());
            bytes.extend([0, 1]);
            bytes.extend(payload);
            if let Err(malformed) = Request::decode(&bytes) {
                prop_assert!(malformed != Malformed::Ignore, "a header was there: {:?}", malformed);
            }
        }
    }
}
