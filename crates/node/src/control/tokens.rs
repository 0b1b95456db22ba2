// SPDX-License-Identifier: MIT OR Apache-2.0
//! Tokens: secrets of 256 bits in files that only their owner can read, and the node's list of their hashes.
//!
//! A node's list has a line `NAME ROLE SHA256` per token; only its user has the secret itself. A secret
//! has 256 random bits, so that a plain hash of it cannot be reversed by guessing.

use crate::base::{Exit, Fault, regular};
use serde::de::IntoDeserializer;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::fmt;
use std::fs::OpenOptions;
use std::io::{self, Read, Write};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::Path;
use std::str::FromStr;
use subtle::ConstantTimeEq;

/// What the bearer of a token may do.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Role {
    /// Read everything, and change nothing.
    View,
    /// Also prepare, start, stop and abort sessions.
    Operate,
    /// Also what cannot be undone.
    Admin,
    /// Another node: operates, and cannot log in with a browser.
    Peer,
}

impl Role {
    /// Whether this role may do what `needed` may.
    pub fn may(self, needed: Self) -> bool {
        let rank = |role| match role {
            Self::View => 0,
            Self::Operate | Self::Peer => 1,
            Self::Admin => 2,
        };
        rank(self) >= rank(needed)
    }
}

impl fmt::Display for Role {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(f)
    }
}

impl FromStr for Role {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let role: Result<Self, serde::de::value::Error> = Self::deserialize(text.into_deserializer());
        role.map_err(|_| format!("expected a role (view, operate, admin or peer), found {text:?}"))
    }
}

/// The SHA-256 of a secret.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SecretHash([u8; 32]);

impl SecretHash {
    /// The hash of a secret as it is shown to a node.
    pub fn of(secret: &str) -> Self {
        Self::of_bytes(secret.as_bytes())
    }

    /// The SHA-256 of any bytes.
    pub(crate) fn of_bytes(bytes: &[u8]) -> Self {
        Self(Sha256::digest(bytes).into())
    }

    /// The hash as the key of an HMAC.
    pub(crate) fn bytes(&self) -> &[u8; 32] {
        &self.0
    }

    /// Compares two hashes in constant time.
    pub fn is(&self, other: &Self) -> bool {
        self.0.ct_eq(&other.0).into()
    }

    /// Reads a hash as [`fmt::Display`] writes it: 64 hexadecimal digits.
    pub(super) fn parse(text: &str) -> Option<Self> {
        from_hex(text)?.try_into().ok().map(Self)
    }
}

impl fmt::Display for SecretHash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&hex(&self.0))
    }
}

/// Bytes as hexadecimal digits, two each.
pub(crate) fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// The bytes of hexadecimal digits, two each.
pub(crate) fn from_hex(text: &str) -> Option<Vec<u8>> {
    let digit = |byte: u8| char::from(byte).to_digit(16).and_then(|digit| u8::try_from(digit).ok());
    let (pairs, rest) = text.as_bytes().as_chunks::<2>();
    let bytes = pairs.iter().map(|&[high, low]| Some(digit(high)? << 4 | digit(low)?));
    rest.is_empty().then(|| bytes.collect())?
}

/// 256 random bits in hexadecimal.
pub fn random_text() -> io::Result<String> {
    let mut bytes = [0; 32];
    getrandom::fill(&mut bytes).map_err(io::Error::other)?;
    Ok(hex(&bytes))
}

/// One line of a node's list.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Token {
    /// Whom it was given to: `[A-Za-z0-9._-]`, 1 to 64 characters.
    pub name: String,
    /// What its bearer may do.
    pub role: Role,
    pub hash: SecretHash,
}

/// The fault of a file of tokens, or of one with a secret.
fn wrong(path: &Path, what: impl fmt::Display) -> Fault {
    Fault::new(Exit::Usage, format!("{}: {what}", path.display()))
}

/// The list of a node's tokens.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct TokenList(pub Vec<Token>);

impl TokenList {
    /// Reads a list that only its owner can read.
    pub fn load(path: &Path) -> Result<Self, Fault> {
        let text = read_private(path)?;
        let mut tokens: Vec<Token> = Vec::new();
        for (line, text) in (1..).zip(text.lines()).filter(|(_, text)| is_entry(text)) {
            let refused = |problem: String| {
                let expected = "expected NAME ROLE SHA256";
                Fault::new(Exit::Usage, format!("{}:{line}: {expected}, {problem}", path.display()))
            };
            let token = parse_line(text).map_err(refused)?;
            if tokens.iter().any(|other| other.name == token.name) {
                return Err(refused(format!("found {} a second time", token.name)));
            }
            tokens.push(token);
        }
        Ok(Self(tokens))
    }

    /// Writes the list, mode 0600; what was there is replaced as a whole.
    pub fn save(&self, path: &Path) -> Result<(), Fault> {
        let mut text = String::from("# name role sha256-of-the-token; see `fourdbody token --help`\n");
        for Token { name, role, hash } in &self.0 {
            text += &format!("{name} {role} {hash}\n");
        }
        write_private(path, &text, true)
    }

    /// The token with this secret. Every entry is compared, so that the time reveals nothing.
    pub fn bearer(&self, secret: &str) -> Option<&Token> {
        let hash = SecretHash::of(secret);
        self.0.iter().fold(None, |found, token| if token.hash.is(&hash) { Some(token) } else { found })
    }
}

fn is_entry(line: &str) -> bool {
    let line = line.trim();
    !line.is_empty() && !line.starts_with('#')
}

fn parse_line(line: &str) -> Result<Token, String> {
    let words: Vec<&str> = line.split_whitespace().collect();
    let [name, role, hash] = words[..] else { return Err(format!("found {} words", words.len())) };
    let hash = SecretHash::parse(hash).ok_or("the third word is not 64 hexadecimal digits")?;
    Ok(Token { name: token_name(name)?, role: role.parse()?, hash })
}

/// Accepts a name that fits into a line of the list and of the audit log.
pub fn token_name(text: &str) -> Result<String, String> {
    let plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '_' | '-');
    if (1..=64).contains(&text.len()) && text.chars().all(plain) {
        return Ok(text.to_owned());
    }
    Err(format!("expected a name of 1 to 64 letters, digits, '.', '_' and '-', found {text:?}"))
}

/// Reads a secret that only its owner can read.
pub fn read_secret(path: &Path) -> Result<String, Fault> {
    let text = read_private(path)?;
    let secret = text.trim();
    if (32..=256).contains(&secret.len()) && secret.chars().all(|c| c.is_ascii_graphic()) {
        return Ok(secret.to_owned());
    }
    let expected =
        "expected one line with a token of 32 to 256 characters, as `fourdbody token new` writes it";
    Err(wrong(path, expected))
}

const PRIVATE_BYTES_MAX: u64 = 1 << 20;

/// Reads a file that only its owner may read or write.
pub fn read_private(path: &Path) -> Result<String, Fault> {
    let failed = |e: io::Error| wrong(path, e);
    let file = regular::open(path).map_err(failed)?;
    let mode = file.metadata().map_err(failed)?.mode() & 0o7777;
    if mode & 0o077 != 0 {
        let found = format!("its mode is {mode:o}, expected 600: others could read it");
        return Err(wrong(path, format!("{found}; `chmod 600` it, and renew the token in it")));
    }
    let mut text = String::new();
    file.take(PRIVATE_BYTES_MAX).read_to_string(&mut text).map_err(failed)?;
    Ok(text)
}

/// Writes a file with mode 0600, whole or not at all; with `replace` one that is there gives way.
pub fn write_private(path: &Path, text: &str, replace: bool) -> Result<(), Fault> {
    let failed = |e: io::Error| wrong(path, e);
    if !replace && path.exists() {
        return Err(failed(io::ErrorKind::AlreadyExists.into()));
    }
    let mut name = path.file_name().unwrap_or_default().to_owned();
    name.push(format!(".new-{}", std::process::id()));
    let temporary = path.with_file_name(name);
    let create = || {
        let mut file = OpenOptions::new().write(true).create_new(true).mode(0o600).open(&temporary)?;
        file.write_all(text.as_bytes())?;
        file.sync_all()?;
        // The owner of the list stays its owner: root may renew the tokens of a node's user.
        if let Ok(old) = std::fs::metadata(path) {
            let _ = std::os::unix::fs::fchown(&file, Some(old.uid()), Some(old.gid()));
        }
        std::fs::rename(&temporary, path)
    };
    create().map_err(|source| {
        let _ = std::fs::remove_file(&temporary);
        failed(source)
    })
}

#[cfg(test)]
mod tests {
    use super::{Role, SecretHash, Token, TokenList, random_text, read_secret, write_private};
    use proptest::prelude::{prop_assert, proptest};
    use std::os::unix::fs::PermissionsExt;

    fn list() -> TokenList {
        let token =
            |name: &str, role, secret| Token { name: name.to_owned(), role, hash: SecretHash::of(secret) };
        TokenList(vec![token("anna", Role::Operate, "secret-1"), token("node-b", Role::Peer, "secret-2")])
    }

    #[test]
    fn lists_come_back_and_wide_ones_are_refused() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let path = dir.path().join("tokens");
        list().save(&path).expect("writable");
        assert_eq!(TokenList::load(&path).expect("readable"), list());
        std::fs::set_permissions(&path, PermissionsExt::from_mode(0o640)).expect("mine");
        let wide = TokenList::load(&path).expect_err("refused");
        assert!(wide.message.contains("mode is 640, expected 600"), "{wide:?}");
        assert!(!format!("{list:?}", list = list()).contains("secret-1"));
    }

    #[test]
    fn a_line_that_is_no_token_is_named() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let path = dir.path().join("tokens");
        let hash = SecretHash::of("x");
        for (line, words) in [
            ("anna operate", "2 words"),
            ("anna boss 00", "hexadecimal"),
            (&format!("anna boss {hash}"), "expected a role"),
            (&format!("an/na view {hash}"), "letters"),
            (&format!("a view {hash}\na view {hash}"), "second time"),
        ] {
            write_private(&path, &format!("# comment\n\n{line}\n"), true).expect("writable");
            let error = TokenList::load(&path).expect_err("refused").message;
            assert!(error.contains(words) && error.contains("tokens:"), "{error}");
        }
    }

    #[test]
    fn secrets_are_long_random_and_private() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let path = dir.path().join("secret");
        let (one, two) = (random_text().expect("randomness"), random_text().expect("randomness"));
        assert!(one != two && one.len() == 64);
        write_private(&path, &format!("{one}\n"), false).expect("writable");
        assert_eq!(read_secret(&path).expect("readable"), one);
        assert!(write_private(&path, &two, false).is_err(), "nothing is overwritten unasked");
        std::fs::set_permissions(&path, PermissionsExt::from_mode(0o604)).expect("mine");
        assert!(read_secret(&path).is_err_and(|fault| fault.message.contains("mode is 604")));
        write_private(&dir.path().join("short"), "hunter2", false).expect("writable");
        let short = read_secret(&dir.path().join("short"));
        assert!(short.is_err_and(|fault| fault.message.contains("a token of 32 to 256 characters")));
    }

    #[test]
    fn roles_are_ordered() {
        assert!(
            Role::Admin.may(Role::Operate) && Role::Operate.may(Role::View) && Role::Peer.may(Role::Operate)
        );
        assert!(
            !Role::View.may(Role::Operate) && !Role::Operate.may(Role::Admin) && !Role::Peer.may(Role::Admin)
        );
    }

    proptest! {
        #[test]
        fn only_the_very_secret_is_accepted(text in ".{0,80}") {
            let bearer = list();
            let bearer = bearer.bearer(&text).map(|token| token.name.as_str());
            prop_assert!(bearer.is_none() || text == "secret-1" || text == "secret-2");
        }
    }

    #[test]
    fn the_bearer_is_found() {
        assert_eq!(list().bearer("secret-2").map(|token| token.role), Some(Role::Peer));
    }
}
