// SPDX-License-Identifier: MIT OR Apache-2.0
//! Browser sessions: a random id in a cookie stands for a token, until it expires or the token is revoked.

use crate::control::tokens::{Role, SecretHash, TokenList, random_text};
use std::io;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

/// A login ends after this time in any case: a working day.
pub const LIFETIME: Duration = Duration::from_secs(12 * 3600);
/// Most logins at the same time; a further one ends the oldest.
const LOGINS_MAX: usize = 256;

struct Login {
    /// Of the id: what is in memory opens nothing.
    id: SecretHash,
    token: SecretHash,
    ends: Instant,
}

/// All logins of the node's process.
#[derive(Default)]
pub struct Logins(Mutex<Vec<Login>>);

impl Logins {
    /// Begins one for the bearer of a token; returns the cookie's value.
    pub(super) fn begin(&self, token: SecretHash) -> io::Result<String> {
        let id = random_text()?;
        let now = Instant::now();
        let mut logins = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        logins.retain(|login| login.ends > now);
        if logins.len() >= LOGINS_MAX {
            logins.remove(0);
        }
        logins.push(Login { id: SecretHash::of(&id), token, ends: now + LIFETIME });
        Ok(id)
    }

    /// Who is behind a cookie, as long as their token is valid.
    pub(super) fn who(&self, id: &str, tokens: &TokenList) -> Option<(String, Role)> {
        let id = SecretHash::of(id);
        let logins = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let now = Instant::now();
        let login = logins.iter().find(|login| login.id.is(&id) && login.ends > now)?;
        let token = tokens.0.iter().find(|token| token.hash.is(&login.token))?;
        Some((token.name.clone(), token.role))
    }

    /// Ends the login with this cookie.
    pub(super) fn end(&self, id: &str) {
        let id = SecretHash::of(id);
        self.0.lock().unwrap_or_else(PoisonError::into_inner).retain(|login| !login.id.is(&id));
    }
}

#[cfg(test)]
mod tests {
    use super::{LOGINS_MAX, Logins};
    use crate::control::tokens::{Role, SecretHash, Token, TokenList};

    #[test]
    fn a_login_lives_as_long_as_its_token() {
        let hash = SecretHash::of("secret");
        let tokens = TokenList(vec![Token { name: "anna".to_owned(), role: Role::Operate, hash }]);
        let logins = Logins::default();
        let id = logins.begin(hash).expect("randomness");
        assert_eq!(logins.who(&id, &tokens), Some(("anna".to_owned(), Role::Operate)));
        assert_eq!(logins.who(&id[1..], &tokens), None);
        assert_eq!(logins.who(&id, &TokenList::default()), None, "its token was revoked");
        logins.end(&id);
        assert_eq!(logins.who(&id, &tokens), None);
    }

    #[test]
    fn logins_are_bounded() {
        let logins = Logins::default();
        (0..2 * LOGINS_MAX).for_each(|_| drop(logins.begin(SecretHash::of("secret"))));
        assert_eq!(logins.0.lock().expect("not poisoned").len(), LOGINS_MAX);
    }
}
