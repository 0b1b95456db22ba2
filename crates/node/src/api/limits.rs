// SPDX-License-Identifier: MIT OR Apache-2.0
//! Limits for one client, and for all of them together.

use std::collections::HashMap;
use std::net::{IpAddr, Ipv6Addr};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Time within which the whole head of a request must arrive.
pub const HEADER: Duration = Duration::from_secs(5);
/// Time within which the whole body of a request must arrive.
pub const BODY: Duration = Duration::from_secs(5);
/// A client that reads nothing for this time is disconnected.
pub const STALL: Duration = Duration::from_secs(5);
/// Largest body of a request, bytes.
pub const BODY_BYTES_MAX: usize = 64 << 10;
/// Largest head of a request, bytes.
pub const HEADER_BYTES_MAX: usize = 32 << 10;
/// Most header lines of a request.
pub const HEADERS_MAX: usize = 64;
/// Most connections of all authenticated callers at the same time.
pub const CONNECTIONS_MAX: usize = 128;
/// Most connections of one caller at the same time.
pub const CONNECTIONS_OF_ONE_MAX: usize = 48;
/// Most connections of all callers with the role `view`: the rest is for those who run sessions.
pub const LOOKERS_MAX: usize = 64;
/// Most connections whose client has not authenticated; a new one closes the oldest of the address that has most.
pub const STRANGERS_MAX: usize = 64;
/// Most connections of one address whose client has not authenticated.
pub const STRANGERS_OF_ONE_MAX: usize = 32;
/// Requests of one caller: how many a second, and how many at once after a pause.
pub const REQUESTS: Rate = Rate { per_second: 200.0, burst: 400.0 };
/// Requests of one client that fail to authenticate, before it gets the answer to come back later.
pub const REFUSALS: Rate = Rate { per_second: 1.0, burst: 20.0 };

/// The client that a request counts against.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub enum Key {
    /// A user of this machine.
    User(u32),
    /// A machine; of IPv6 addresses the first 64 bits.
    Address(IpAddr),
    /// The bearer of a token.
    Token(String),
}

impl Key {
    /// The client at an address.
    pub fn of_address(address: IpAddr) -> Self {
        Self::Address(match address.to_canonical() {
            IpAddr::V6(v6) => Ipv6Addr::from_bits(v6.to_bits() & !u128::from(u64::MAX)).into(),
            v4 => v4,
        })
    }
}

/// A rate with a burst.
#[derive(Debug, Clone, Copy)]
pub struct Rate {
    /// Requests a second in the long run.
    pub per_second: f64,
    /// Requests that are allowed at once after a pause.
    pub burst: f64,
}

/// Counts the requests of many clients, each against the same rate.
pub struct Buckets {
    rate: Rate,
    left: Mutex<HashMap<Key, (f64, Instant)>>,
}

/// Clients that are counted at the same time; beyond, those without recent requests are forgotten.
const CLIENTS_MAX: usize = 1024;

impl Buckets {
    /// Counters at this rate, with no request counted yet.
    pub fn new(rate: Rate) -> Self {
        Self { rate, left: Mutex::default() }
    }

    /// Counts a request at `now`; or returns how long to wait.
    pub fn take(&self, key: Key, now: Instant) -> Result<(), Duration> {
        let Rate { per_second, burst } = self.rate;
        let filled = |(left, since): &(f64, Instant)| {
            (left + now.saturating_duration_since(*since).as_secs_f64() * per_second).min(burst)
        };
        let mut left = self.left.lock().unwrap_or_else(PoisonError::into_inner);
        if left.len() >= CLIENTS_MAX && !left.contains_key(&key) {
            left.retain(|_, bucket| filled(bucket) < burst);
            if left.len() >= CLIENTS_MAX {
                return Err(Duration::from_secs(1));
            }
        }
        let bucket = left.entry(key).or_insert((burst, now));
        *bucket = (filled(bucket), now);
        if bucket.0 < 1.0 {
            // The missing part may be worth less than a nanosecond: a wait of zero would make the client try again at
            // once.
            let wait = Duration::from_secs_f64((1.0 - bucket.0) / per_second);
            return Err(wait.max(Duration::from_millis(1)));
        }
        bucket.0 -= 1.0;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::{Buckets, CLIENTS_MAX, Key, Rate};
    use proptest::prelude::{prop_assert, proptest};
    use std::time::{Duration, Instant};

    proptest! {
        #[test]
        fn no_client_gets_more_than_its_rate(gaps in proptest::collection::vec(0u64..400, 1..200)) {
            let buckets = Buckets::new(Rate { per_second: 10.0, burst: 5.0 });
            let start = Instant::now();
            let (mut now, mut granted) = (start, 0u32);
            for gap in gaps {
                now += Duration::from_millis(gap);
                match buckets.take(Key::User(1), now) {
                    Ok(()) => granted += 1,
                    Err(wait) => prop_assert!(wait <= Duration::from_millis(101) && !wait.is_zero()),
                }
                let allowed = 5.0 + (now - start).as_secs_f64() * 10.0;
                prop_assert!(f64::from(granted) <= allowed + 1e-6);
            }
            prop_assert!(buckets.take(Key::User(2), now).is_ok(), "another client is not concerned");
        }
    }

    #[test]
    fn clients_are_forgotten_not_collected() {
        let buckets = Buckets::new(Rate { per_second: 10.0, burst: 1.0 });
        let start = Instant::now();
        let many = CLIENTS_MAX as u32;
        assert!((0..many).all(|uid| buckets.take(Key::User(uid), start).is_ok()));
        assert!(buckets.take(Key::User(many), start).is_err());
        assert!(buckets.take(Key::User(many), start + Duration::from_secs(1)).is_ok());
        assert_eq!(buckets.left.lock().expect("not poisoned").len(), 1);
    }

    #[test]
    fn addresses_of_one_machine_are_one_client() {
        let of = |text: &str| Key::of_address(text.parse().expect("an address"));
        assert_eq!(of("2001:db8::1"), of("2001:db8::ffff"));
        assert_ne!(of("2001:db8::1"), of("2001:db8:0:1::1"));
        assert_eq!(of("::ffff:10.0.0.1"), of("10.0.0.1"));
    }
}
