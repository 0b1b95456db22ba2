//! How much one client, and all of them, may ask for.

use std::collections::HashMap;
use std::net::{IpAddr, Ipv6Addr};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

/// The whole head of a request must be there after this long.
pub const HEADER: Duration = Duration::from_secs(5);
/// And its whole body after this long.
pub const BODY: Duration = Duration::from_secs(5);
/// A client that reads nothing for so long is given up.
pub const STALL: Duration = Duration::from_secs(5);
/// Bytes of a request's body.
pub const BODY_BYTES_MAX: usize = 64 << 10;
/// Bytes of a request's head.
pub const HEADER_BYTES_MAX: usize = 32 << 10;
/// Header lines of a request.
pub const HEADERS_MAX: usize = 64;
/// Connections of all clients at the same time.
pub const CONNECTIONS_MAX: usize = 128;
/// Connections of one client at the same time.
pub const CONNECTIONS_OF_ONE_MAX: usize = 48;
/// Requests of one caller: how many a second, and how many at once after a pause.
pub const REQUESTS: Rate = Rate { per_second: 200.0, burst: 400.0 };
/// Requests of one client that were refused for want of authentication, before it is told to come back later.
pub const REFUSALS: Rate = Rate { per_second: 1.0, burst: 20.0 };

/// Who is counted.
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
    /// In the long run.
    pub per_second: f64,
    /// After a pause.
    pub burst: f64,
}

/// Counts what many clients ask for, each against the same rate.
pub struct Buckets {
    rate: Rate,
    left: Mutex<HashMap<Key, (f64, Instant)>>,
}

/// Clients that are counted at the same time; beyond, those who have asked for nothing lately are forgotten.
const CLIENTS_MAX: usize = 1024;

impl Buckets {
    /// Nothing counted yet.
    pub fn new(rate: Rate) -> Self {
        Self { rate, left: Mutex::default() }
    }

    /// Counts a request at `now`; or says how long to wait.
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
            // What is missing may be less than a nanosecond's worth: to wait for nothing would be to ask again at once.
            let wait = Duration::from_secs_f64((1.0 - bucket.0) / per_second);
            return Err(wait.max(Duration::from_millis(1)));
        }
        bucket.0 -= 1.0;
        Ok(())
    }
}

/// Connections, of all and of each.
#[derive(Clone)]
pub struct Connections {
    all: Arc<Semaphore>,
    of_one: Arc<Mutex<HashMap<Key, usize>>>,
}

/// One connection; dropped when it ends.
pub struct Admitted {
    key: Key,
    connections: Connections,
    _permit: OwnedSemaphorePermit,
}

impl Default for Connections {
    /// None yet.
    fn default() -> Self {
        Self { all: Arc::new(Semaphore::new(CONNECTIONS_MAX)), of_one: Arc::default() }
    }
}

impl Connections {
    /// Counts a connection, if there may be one more.
    pub fn admit(&self, key: Key) -> Option<Admitted> {
        let permit = Arc::clone(&self.all).try_acquire_owned().ok()?;
        let mut of_one = self.of_one.lock().unwrap_or_else(PoisonError::into_inner);
        let count = of_one.entry(key.clone()).or_insert(0);
        if *count >= CONNECTIONS_OF_ONE_MAX {
            return None;
        }
        *count += 1;
        Some(Admitted { key, connections: self.clone(), _permit: permit })
    }

    /// Waits until none is left.
    pub async fn all_gone(&self) {
        // The semaphore is never closed.
        let _ = self.all.acquire_many(CONNECTIONS_MAX as u32).await;
    }
}

impl Drop for Admitted {
    fn drop(&mut self) {
        let mut of_one = self.connections.of_one.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(count) = of_one.get_mut(&self.key) {
            *count -= 1;
            if *count == 0 {
                of_one.remove(&self.key);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{Buckets, CLIENTS_MAX, CONNECTIONS_MAX, CONNECTIONS_OF_ONE_MAX, Connections, Key, Rate};
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

    #[test]
    fn connections_are_bounded_for_one_and_for_all() {
        let connections = Connections::default();
        let of_one: Vec<_> = std::iter::from_fn(|| connections.admit(Key::User(1))).collect();
        assert_eq!(of_one.len(), CONNECTIONS_OF_ONE_MAX);
        let others: Vec<_> = (2..1000).map_while(|uid| connections.admit(Key::User(uid))).collect();
        assert_eq!(of_one.len() + others.len(), CONNECTIONS_MAX);
        drop(of_one);
        assert!(connections.admit(Key::User(1)).is_some());
        assert!(connections.of_one.lock().expect("not poisoned").get(&Key::User(1)).is_none());
    }
}
