// SPDX-License-Identifier: MIT OR Apache-2.0
//! Bytes from outside: never a panic, and nothing read that was not written.

use hsu_firmware_proto::{
    DecodeError, HeadTiming, HostToUnit, MAX_HEADS, MAX_MESSAGE, MAX_RECORDS, Request, SessionId, Sync,
    Timing, TimingError, TriggerRecord, TriggerRecords, UnitToHost, version,
};
use proptest::prelude::{any, prop, prop_assert_eq, prop_oneof, proptest};

proptest! {
    /// What can be read is written again as the same bytes: there is one spelling of each message.
    #[test]
    fn any_bytes_are_read_or_refused(
        version in prop_oneof![4 => 1u8..=1, 1 => any::<u8>()],
        kind in prop_oneof![0u8..18, 0x80u8..0x90, any::<u8>()],
        rest in prop::collection::vec(any::<u8>(), 0..MAX_MESSAGE - 2),
    ) {
        let mut bytes = vec![version, kind];
        bytes.extend(rest);
        let mut again = [0; MAX_MESSAGE];
        if let Ok(message) = HostToUnit::decode(&bytes) {
            let length = message.encode(&mut again);
            let fixed = matches!(message.request, Request::Hello(_) | Request::Configure(Err(_)));
            prop_assert_eq!(fixed || again[..length] == bytes, true);
        }
        if let Ok(message) = UnitToHost::decode(&bytes) {
            let length = message.encode(&mut again);
            prop_assert_eq!(length, bytes.len());
            let fixed = matches!(message, UnitToHost::Welcome(..) | UnitToHost::Refused(..));
            prop_assert_eq!(fixed || again[..length] == bytes, true);
        }
    }

    /// A message that is cut or lengthened is refused.
    #[test]
    fn length_is_exact(cut in 0usize..100, extra in 1usize..20) {
        let heads = [HeadTiming { delay_ns: 1, exposure_ns: 2 }; 4];
        let timing = Timing::new(1_000_000, Sync::Timer, 1_000_000_000, &heads).expect("valid");
        let mut bytes = [0; MAX_MESSAGE];
        let length = HostToUnit { request_id: 9, request: Request::Configure(Ok(timing)) }.encode(&mut bytes);
        let short = HostToUnit::decode(&bytes[..cut.min(length - 1)]);
        prop_assert_eq!(short.map_err(|e| e.error), Err(DecodeError::Length));
        let long = HostToUnit::decode(&bytes[..length + extra]);
        prop_assert_eq!(long.map_err(|e| (e.request_id, e.error)), Err((Some(9), DecodeError::Length)));
    }
}

#[test]
fn the_longest_messages_fit() {
    let heads = [HeadTiming { delay_ns: 1, exposure_ns: 2 }; MAX_HEADS];
    let timing = Timing::new(1_000_000, Sync::Timer, 1_000_000_000, &heads).expect("valid");
    let mut bytes = [0; MAX_MESSAGE];
    let message = UnitToHost::Timing(1, timing);
    let length = message.encode(&mut bytes);
    assert_eq!(UnitToHost::decode(&bytes[..length]), Ok(message));
    let mut records = TriggerRecords::default();
    assert!(
        (0..MAX_RECORDS as i64).all(|number| records.push(TriggerRecord { number, ..Default::default() }))
    );
    assert!(!records.push(TriggerRecord::default()));
    let message = UnitToHost::Triggers(1, SessionId::NONE, records);
    let length = message.encode(&mut bytes);
    assert_eq!(UnitToHost::decode(&bytes[..length]), Ok(message));
}

#[test]
fn timings_that_cannot_be_run_are_named() {
    let head = HeadTiming { delay_ns: 500_000, exposure_ns: 499_999 };
    let long = HeadTiming { delay_ns: 500_000, exposure_ns: 500_000 };
    let huge = HeadTiming { delay_ns: u64::MAX, exposure_ns: u64::MAX };
    let dark = HeadTiming { delay_ns: 0, exposure_ns: 0 };
    let new = |period_ns, heads: &[HeadTiming]| Timing::new(period_ns, Sync::Timer, 1_000_000_000, heads);
    assert!(new(1_000_000, &[head; MAX_HEADS]).is_ok());
    assert_eq!(new(999_999, &[head]), Err(TimingError::Period));
    assert_eq!(new(u64::MAX, &[head]), Err(TimingError::Period));
    assert_eq!(new(1_000_000, &[]), Err(TimingError::HeadCount));
    assert_eq!(new(1_000_000, &[head; MAX_HEADS + 1]), Err(TimingError::HeadCount));
    for bad in [long, huge, dark] {
        assert_eq!(new(1_000_000, &[head, bad]), Err(TimingError::Head(1)));
    }
    assert_eq!(Timing::new(1_000_000, Sync::Timer, 0, &[head]), Err(TimingError::HostSilence));
}

#[test]
fn versions_agree_on_the_highest_in_both_ranges() {
    let (min, current) = (version::MIN, version::CURRENT);
    assert_eq!(version::agree(min, current), Some(current));
    assert_eq!(version::agree(min, u8::MAX), Some(current));
    assert_eq!(version::agree(current + 1, u8::MAX), None, "the other end is too new");
    assert_eq!(version::agree(0, min - 1), None, "the other end is too old");
}
