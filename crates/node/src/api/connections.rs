// SPDX-License-Identifier: MIT OR Apache-2.0
//! Who may hold connections, and how many.
//!
//! A connection begins as a stranger's. Strangers have a share of their own: a new one is always accepted, and closes
//! the oldest of the address that has most of them. The first request with a valid token moves the connection to the
//! known ones. So idle connections, however many, keep no client out that has a token.

use super::limits::{
    CONNECTIONS_MAX, CONNECTIONS_OF_ONE_MAX, Key, LOOKERS_MAX, STRANGERS_MAX, STRANGERS_OF_ONE_MAX,
};
use std::collections::{BTreeMap, HashMap};
use std::io;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use tokio::sync::{Notify, watch};

/// All open connections of the server.
#[derive(Clone)]
pub struct Connections {
    book: Arc<Mutex<Book>>,
    /// Connections that are not closed yet, evicted ones among them.
    open: watch::Sender<usize>,
}

/// By number, the oldest first.
#[derive(Default)]
struct Book {
    next: u64,
    entries: BTreeMap<u64, Entry>,
}

struct Entry {
    key: Key,
    /// The caller, once authenticated, and whether they may only read.
    known: Option<(Key, bool)>,
    evicted: Arc<Notify>,
}

/// One connection; forgotten when dropped.
pub struct Admitted {
    number: u64,
    connections: Connections,
    evicted: Arc<Notify>,
    nonce: Arc<str>,
}

/// A connection as its requests see it.
#[derive(Clone)]
pub struct Standing {
    number: u64,
    connections: Connections,
    /// A random number of this connection alone, for which a proof of a token is made.
    pub nonce: Arc<str>,
}

impl Default for Connections {
    /// No connection is open yet.
    fn default() -> Self {
        Self { book: Arc::default(), open: watch::Sender::new(0) }
    }
}

impl Connections {
    /// Lets in a client of whom only the address is known: the oldest of those makes room for it.
    ///
    /// # Errors
    /// The system gives no random numbers.
    pub fn admit(&self, key: Key) -> io::Result<Admitted> {
        let nonce = crate::control::tokens::random_text()?;
        let mut book = self.book();
        book.make_room(&key);
        Ok(self.enter(&mut book, key, None, nonce))
    }

    /// Lets in a user whom the kernel names, if there may be one more connection.
    ///
    /// # Errors
    /// The system gives no random numbers.
    pub fn admit_known(&self, key: Key) -> io::Result<Option<Admitted>> {
        let nonce = crate::control::tokens::random_text()?;
        let mut book = self.book();
        let known = Some((key.clone(), false));
        Ok(book.has_room(&key, false).then(|| self.enter(&mut book, key, known, nonce)))
    }

    fn enter(&self, book: &mut Book, key: Key, known: Option<(Key, bool)>, nonce: String) -> Admitted {
        let (number, evicted) = (book.next, Arc::new(Notify::new()));
        book.next += 1;
        book.entries.insert(number, Entry { key, known, evicted: Arc::clone(&evicted) });
        self.open.send_modify(|open| *open += 1);
        Admitted { number, connections: self.clone(), evicted, nonce: nonce.into() }
    }

    /// Waits until none is left.
    pub async fn all_gone(&self) {
        // The sender lives as long as `self`.
        let _ = self.open.subscribe().wait_for(|open| *open == 0).await;
    }

    fn book(&self) -> MutexGuard<'_, Book> {
        // Entries are added and removed whole: what a panic left is usable.
        self.book.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Book {
    /// Closes a stranger's connection where one more would be too many.
    fn make_room(&mut self, key: &Key) {
        let mut strangers: HashMap<&Key, (usize, u64)> = HashMap::new();
        let mut all = 0;
        for (number, entry) in self.entries.iter().filter(|(_, entry)| entry.known.is_none()) {
            all += 1;
            let (count, _) = strangers.entry(&entry.key).or_insert((0, *number));
            *count += 1;
        }
        let own = strangers.get(key).filter(|(count, _)| *count >= STRANGERS_OF_ONE_MAX);
        let most = || strangers.values().max_by_key(|(count, oldest)| (*count, std::cmp::Reverse(*oldest)));
        let oldest = own.or_else(|| most().filter(|_| all >= STRANGERS_MAX)).map(|(_, oldest)| *oldest);
        if let Some(entry) = oldest.and_then(|oldest| self.entries.remove(&oldest)) {
            entry.evicted.notify_one();
        }
    }

    fn has_room(&self, caller: &Key, looks: bool) -> bool {
        let known = || self.entries.values().filter_map(|entry| entry.known.as_ref());
        known().count() < CONNECTIONS_MAX
            && known().filter(|(key, _)| key == caller).count() < CONNECTIONS_OF_ONE_MAX
            && (!looks || known().filter(|(_, looks)| *looks).count() < LOOKERS_MAX)
    }
}

impl Admitted {
    /// Returns when the connection has to make room for another.
    pub async fn evicted(&self) {
        self.evicted.notified().await;
    }

    /// The view of the connection that its requests receive.
    pub fn standing(&self) -> Standing {
        let (number, connections) = (self.number, self.connections.clone());
        Standing { number, connections, nonce: Arc::clone(&self.nonce) }
    }
}

impl Drop for Admitted {
    fn drop(&mut self) {
        self.connections.book().entries.remove(&self.number);
        self.connections.open.send_modify(|open| *open -= 1);
    }
}

impl Standing {
    /// A request authenticated the owner of this connection. False when they have too many: the request is refused.
    pub fn is_of(&self, caller: &Key, looks: bool) -> bool {
        let mut book = self.connections.book();
        if book.entries.get(&self.number).is_some_and(|entry| entry.known.is_some()) {
            return true;
        }
        let room = book.has_room(caller, looks);
        match book.entries.get_mut(&self.number) {
            Some(entry) if room => entry.known = Some((caller.clone(), looks)),
            // One that is being closed may finish its answer, if it can.
            Some(_) | None => return room,
        }
        true
    }
}

#[cfg(test)]
mod tests {
    use super::{Admitted, Connections};
    use crate::api::limits::{
        CONNECTIONS_MAX, CONNECTIONS_OF_ONE_MAX, Key, LOOKERS_MAX, STRANGERS_MAX, STRANGERS_OF_ONE_MAX,
    };

    fn address(n: u8) -> Key {
        Key::of_address([10, 0, 0, n].into())
    }

    fn token(n: usize) -> Key {
        Key::Token(format!("t{n}"))
    }

    fn is_open(connection: &Admitted) -> bool {
        connection.connections.book().entries.contains_key(&connection.number)
    }

    #[test]
    fn strangers_keep_nobody_out() {
        let connections = Connections::default();
        let known = connections.admit(address(1)).expect("admitted");
        assert!(known.standing().is_of(&token(0), true));
        let early = connections.admit(address(2)).expect("admitted");
        let idle: Vec<_> =
            (0..3 * STRANGERS_MAX).map(|_| connections.admit(address(1)).expect("admitted")).collect();
        let count = idle.iter().filter(|connection| is_open(connection)).count();
        assert_eq!(count, STRANGERS_OF_ONE_MAX, "the newest ones of an address stay");
        assert!(is_open(&known) && is_open(&early), "others are not concerned");
        assert!(is_open(&idle[idle.len() - 1]) && !is_open(&idle[0]));
        let many: Vec<_> = (10..210).map(|n| connections.admit(address(n)).expect("admitted")).collect();
        let strangers = idle.iter().chain(&many).filter(|connection| is_open(connection)).count();
        assert!(strangers <= STRANGERS_MAX, "{strangers}");
        assert!(is_open(&known) && is_open(&many[199]));
        assert!(many[199].standing().is_of(&token(1), false));
    }

    #[test]
    fn known_callers_are_bounded_and_lookers_leave_room() {
        let connections = Connections::default();
        let mut held = Vec::new();
        let mut more = |caller: &Key, looks| {
            let connection = connections.admit(address(1)).expect("admitted");
            let taken = connection.standing().is_of(caller, looks);
            held.extend(taken.then_some(connection));
            taken
        };
        assert_eq!((0..100).filter(|_| more(&token(1), true)).count(), CONNECTIONS_OF_ONE_MAX);
        assert_eq!((0..100).filter(|_| more(&token(2), true)).count(), LOOKERS_MAX - CONNECTIONS_OF_ONE_MAX);
        assert_eq!((3..300).filter(|n| more(&token(*n), false)).count(), CONNECTIONS_MAX - LOOKERS_MAX);
        drop(held);
        let last = connections.admit_known(Key::User(7)).expect("admitted");
        assert!(last.is_some() && connections.book().entries.len() == 1);
        drop(last);
        assert_eq!(*connections.open.borrow(), 0);
    }
}
