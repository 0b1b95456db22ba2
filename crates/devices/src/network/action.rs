// SPDX-License-Identifier: MIT OR Apache-2.0
//! Action commands of GVCP: one packet makes every camera with its keys take a frame, at once or at a time of the
//! cameras' common clock.
//!
//! The payload is device key, group key and group mask, and with the flag `SCHEDULED` a time of 64 bits. All
//! big-endian (GigE Vision 2.x, part 2).

use super::gvcp::{ACKNOWLEDGE, command, header};

const ACTION: u16 = 0x0100;
/// Flag of a command whose payload ends with a time.
const SCHEDULED: u8 = 0x80;
/// Status: the device's clock is not synchronized.
const NO_REFERENCE_TIME: u16 = 0x8013;
/// Status: the device's list of waiting actions is full.
const OVERFLOW: u16 = 0x8015;
/// Status: the time had passed, and the action was carried out at once.
const LATE: u16 = 0x8016;

/// The cameras of an action: those with this device key, this group key, and a bit of this mask.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ActionKeys {
    /// Key that all devices of a rig share.
    pub device: u32,
    /// Key of a group of devices of the rig.
    pub group: u32,
    /// Bits of which a device must have at least one.
    pub mask: u32,
}

/// A camera's answer to an action command.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ActionStatus {
    /// The action is carried out, or waits for its time.
    Taken,
    /// The time had passed, and the action was carried out at once.
    Late,
    /// Refused: the camera's clock is not synchronized (PTP).
    NoTime,
    /// Refused: too many actions wait for their time.
    Full,
    /// Refused for another reason, with this GVCP status.
    Refused(u16),
}

/// An action command with acknowledge, for a time of the cameras' clock (ns) or at once.
pub fn action(id: u16, keys: ActionKeys, at_ns: Option<u64>) -> Vec<u8> {
    let mut payload = Vec::with_capacity(20);
    [keys.device, keys.group, keys.mask].iter().for_each(|key| payload.extend(key.to_be_bytes()));
    payload.extend(at_ns.iter().flat_map(|ns| ns.to_be_bytes()));
    let flags = if at_ns.is_some() { ACKNOWLEDGE | SCHEDULED } else { ACKNOWLEDGE };
    command(ACTION, flags, id, &payload)
}

/// A camera's answer to an action command, with the command's id. `None` for any other datagram.
pub fn action_reply(datagram: &[u8]) -> Option<(u16, ActionStatus)> {
    let [status, code, _, id] = header(datagram)?;
    let status = match status {
        0 => ActionStatus::Taken,
        LATE => ActionStatus::Late,
        NO_REFERENCE_TIME => ActionStatus::NoTime,
        OVERFLOW => ActionStatus::Full,
        other => ActionStatus::Refused(other),
    };
    (code == ACTION + 1).then_some((id, status))
}

#[cfg(test)]
mod tests {
    use super::{ActionKeys, ActionStatus, action, action_reply};
    use proptest::prelude::*;

    #[test]
    fn an_action_has_the_bytes_of_the_standard() {
        let keys = ActionKeys { device: 0x0102_0304, group: 5, mask: 0x8000_0001 };
        // key, acknowledge | ACTION 0x0100 | 12 bytes | id | device key | group key | group mask
        let at_once = [0x42, 0x01, 1, 0, 0, 12, 0x12, 0x34, 1, 2, 3, 4, 0, 0, 0, 5, 0x80, 0, 0, 1];
        assert_eq!(action(0x1234, keys, None), at_once);
        // acknowledge and 0x80 | 20 bytes | ... | time, high word first
        let scheduled = [
            0x42, 0x81, 1, 0, 0, 20, 0, 9, 1, 2, 3, 4, 0, 0, 0, 5, 0x80, 0, 0, 1, //
            0x11, 0x22, 0x33, 0x44, 0x55, 0x66, 0x77, 0x88,
        ];
        assert_eq!(action(9, keys, Some(0x1122_3344_5566_7788)), scheduled);
    }

    #[test]
    fn an_answer_has_its_status() {
        let answer = |status: [u8; 2]| action_reply(&[status[0], status[1], 1, 1, 0, 0, 0, 9]);
        assert_eq!(answer([0, 0]), Some((9, ActionStatus::Taken)));
        assert_eq!(answer([0x80, 0x16]), Some((9, ActionStatus::Late)));
        assert_eq!(answer([0x80, 0x13]), Some((9, ActionStatus::NoTime)));
        assert_eq!(answer([0x80, 0x15]), Some((9, ActionStatus::Full)));
        assert_eq!(answer([0x80, 0x06]), Some((9, ActionStatus::Refused(0x8006))));
        assert_eq!(action_reply(&[0, 0, 0, 0x81, 0, 0, 0, 9]), None, "of a register");
        assert_eq!(action_reply(&[0, 0, 1, 1, 0, 0, 0]), None, "cut");
    }

    proptest! {
        #[test]
        fn lengths_and_fields_are_where_the_header_says(
            id: u16, device: u32, group: u32, mask: u32, at in any::<Option<u64>>(),
        ) {
            let bytes = action(id, ActionKeys { device, group, mask }, at);
            prop_assert_eq!(u16::from_be_bytes([bytes[4], bytes[5]]), (bytes.len() - 8) as u16);
            prop_assert_eq!(u16::from_be_bytes([bytes[6], bytes[7]]), id);
            prop_assert_eq!(&bytes[8..12], device.to_be_bytes());
            prop_assert_eq!(&bytes[12..16], group.to_be_bytes());
            prop_assert_eq!(&bytes[16..20], mask.to_be_bytes());
            let time = bytes.get(20..).and_then(|rest| rest.first_chunk()).map(|rest| u64::from_be_bytes(*rest));
            prop_assert_eq!(time, at);
            prop_assert_eq!(bytes[1] & 0x80 != 0, at.is_some());
        }

        #[test]
        fn no_datagram_panics(bytes in prop::collection::vec(any::<u8>(), 0..40)) {
            prop_assert!(bytes.len() >= 8 || action_reply(&bytes).is_none());
        }
    }
}
