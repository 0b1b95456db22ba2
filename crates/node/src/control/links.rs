// SPDX-License-Identifier: MIT OR Apache-2.0
//! Links that log a browser in once: a code of 256 random bits, of which the node's directory keeps only the hash.
//!
//! `fourdbody token link` makes the code. Beside the node's list of tokens lies the directory `LIST.links` with a file per
//! code that nobody has used yet: its name is the code's hash, its text whose login it is, and until when. The invariants
//! are in `docs/design/api.md`.

use super::tokens::{SecretHash, Token, random_text, read_private, write_private};
use crate::base::{Exit, Fault};
use std::fs::OpenOptions;
use std::io::ErrorKind;
use std::os::unix::fs::{DirBuilderExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::time::Duration;

/// A link is for now: longer ones would lie about in mails.
pub const LIFETIME_MAX: Duration = Duration::from_secs(3600);
/// Most codes that wait to be used.
const WAITING_MAX: usize = 64;

/// The directory of the codes that belong to a list of tokens.
fn directory(tokens: &Path) -> PathBuf {
    let mut name = tokens.file_name().unwrap_or_default().to_owned();
    name.push(".links");
    tokens.with_file_name(name)
}

/// Makes a code that logs the bearer of `token` in once, until `lifetime` after `now_ns`.
///
/// # Errors
/// Nothing can be written beside the list, or too many codes wait already.
pub fn issue(tokens: &Path, token: &Token, lifetime: Duration, now_ns: u64) -> Result<String, Fault> {
    let directory = directory(tokens);
    let failed =
        |error: std::io::Error| Fault::new(Exit::Failure, format!("{}: {error}", directory.display()));
    if !directory.is_dir() {
        std::fs::DirBuilder::new().mode(0o700).create(&directory).map_err(failed)?;
        own_as(&directory, tokens);
    }
    let mut waiting = 0;
    for entry in std::fs::read_dir(&directory).map_err(failed)? {
        let path = entry.map_err(failed)?.path();
        match read(&path) {
            Ok(link) if link.ends_ns > now_ns => waiting += 1,
            // Expired, or nothing that works.
            _ => std::fs::remove_file(&path).map_err(failed)?,
        }
    }
    if waiting >= WAITING_MAX {
        let message = format!(
            "expected fewer than {WAITING_MAX} links that nobody has used yet, found {waiting} in {}; wait until they \
             expire, or remove the files",
            directory.display()
        );
        return Err(Fault::new(Exit::Usage, message));
    }
    let code = random_text()
        .map_err(|error| Fault::new(Exit::Failure, format!("the system gives no random numbers: {error}")))?;
    let lifetime_ns = u64::try_from(lifetime.min(LIFETIME_MAX).as_nanos()).unwrap_or(u64::MAX);
    let path = directory.join(SecretHash::of(&code).to_string());
    let text = format!("{} {} {}\n", token.name, token.hash, now_ns.saturating_add(lifetime_ns));
    write_private(&path, &text, false)?;
    own_as(&path, tokens);
    Ok(code)
}

/// Takes a code: the hash of the token whose bearer it logs in. It works at most once, whoever comes first.
///
/// # Errors
/// Why it does not work, for the log; whoever has shown it learns only that.
pub(crate) fn redeem(tokens: &Path, code: &str, now_ns: u64) -> Result<SecretHash, String> {
    // The hash is the name: what was sent never becomes a path.
    let path = directory(tokens).join(SecretHash::of(code).to_string());
    // The claim: of many at once, one renames the file.
    let claimed = path.with_extension("used");
    std::fs::rename(&path, &claimed).map_err(|error| match error.kind() {
        ErrorKind::NotFound => "no such code: it was used, has expired, or is of another node".to_owned(),
        _ => format!("{} cannot be used up, so it is not accepted: {error}", path.display()),
    })?;
    let link = read(&claimed);
    // Emptied before it is removed: a power cut does not bring it back.
    let emptied =
        OpenOptions::new().write(true).open(&claimed).and_then(|file| file.set_len(0).and(file.sync_all()));
    let removed = emptied.and_then(|()| std::fs::remove_file(&claimed));
    removed.map_err(|error| {
        format!("{} cannot be removed, so it is not accepted: {error}", claimed.display())
    })?;
    let link = link?;
    let left_ns = link.ends_ns.saturating_sub(now_ns);
    match left_ns > 0 && u128::from(left_ns) <= LIFETIME_MAX.as_nanos() {
        true => Ok(link.token),
        false => Err(format!("the link of {} has expired", link.name)),
    }
}

struct Link {
    name: String,
    token: SecretHash,
    ends_ns: u64,
}

fn read(path: &Path) -> Result<Link, String> {
    let text = read_private(path).map_err(|fault| fault.message)?;
    let words: Vec<&str> = text.split_whitespace().collect();
    let link = || {
        let [name, hash, ends] = words[..] else { return None };
        Some(Link { name: name.to_owned(), token: SecretHash::parse(hash)?, ends_ns: ends.parse().ok()? })
    };
    link().ok_or_else(|| format!("{}: expected NAME SHA256 NANOSECONDS", path.display()))
}

/// Root may make links for the node's user.
fn own_as(path: &Path, tokens: &Path) {
    if let Ok(list) = std::fs::metadata(tokens) {
        let _ = std::os::unix::fs::chown(path, Some(list.uid()), Some(list.gid()));
    }
}

#[cfg(test)]
mod tests {
    use super::{LIFETIME_MAX, WAITING_MAX, directory, issue, redeem};
    use crate::control::tokens::{Role, SecretHash, Token, TokenList};
    use std::os::unix::fs::PermissionsExt;
    use std::path::PathBuf;
    use std::sync::atomic::{AtomicUsize, Ordering};
    use std::time::Duration;

    const MINUTE: Duration = Duration::from_secs(60);
    const MINUTE_NS: u64 = 60_000_000_000;

    fn list() -> (tempfile::TempDir, PathBuf, Token) {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let token = Token { name: "anna".to_owned(), role: Role::View, hash: SecretHash::of("secret") };
        let path = dir.path().join("tokens");
        TokenList(vec![token.clone()]).save(&path).expect("writable");
        (dir, path, token)
    }

    #[test]
    fn a_code_works_once_and_is_kept_nowhere() {
        let (dir, tokens, anna) = list();
        let code = issue(&tokens, &anna, MINUTE, 5).expect("a code");
        let folder = directory(&tokens);
        let mode =
            |path: &std::path::Path| std::fs::metadata(path).expect("there").permissions().mode() & 0o777;
        let files: Vec<PathBuf> =
            std::fs::read_dir(&folder).expect("there").map(|entry| entry.expect("an entry").path()).collect();
        assert_eq!((files.len(), mode(&folder), mode(&files[0])), (1, 0o700, 0o600));
        let text = std::fs::read_to_string(&files[0]).expect("readable");
        assert!(!text.contains(&code) && !files[0].display().to_string().contains(&code), "{text}");
        assert!(redeem(&tokens, &"0".repeat(64), 6).is_err());
        assert!(redeem(&tokens, "../tokens", 6).is_err() && tokens.exists());
        assert_eq!(redeem(&tokens, &code, 6), Ok(anna.hash));
        assert!(redeem(&tokens, &code, 6).is_err_and(|why| why.contains("was used")));
        assert_eq!(std::fs::read_dir(&folder).expect("there").count(), 0);
        drop(dir);
    }

    #[test]
    fn of_many_who_come_at_once_one_is_let_in() {
        let (_dir, tokens, anna) = list();
        for _ in 0..20 {
            let code = issue(&tokens, &anna, MINUTE, 5).expect("a code");
            let let_in = AtomicUsize::new(0);
            std::thread::scope(|scope| {
                for _ in 0..8 {
                    scope.spawn(|| {
                        let_in.fetch_add(usize::from(redeem(&tokens, &code, 6).is_ok()), Ordering::Relaxed)
                    });
                }
            });
            assert_eq!(let_in.into_inner(), 1);
        }
    }

    #[test]
    fn a_code_expires_and_is_no_less_used_up() {
        let (_dir, tokens, anna) = list();
        let code = issue(&tokens, &anna, MINUTE, 0).expect("a code");
        assert!(redeem(&tokens, &code, MINUTE_NS).is_err_and(|why| why.contains("anna has expired")));
        assert!(redeem(&tokens, &code, 1).is_err(), "also by a clock that was set back");
        let long = issue(&tokens, &anna, 48 * LIFETIME_MAX, MINUTE_NS).expect("a code");
        assert!(redeem(&tokens, &long, MINUTE_NS + 3600 * 1_000_000_000).is_err(), "an hour at most");
        let ahead = issue(&tokens, &anna, MINUTE, 1 << 60).expect("a code");
        assert!(redeem(&tokens, &ahead, 1).is_err(), "made by a clock far ahead");
    }

    #[test]
    fn links_are_bounded_and_old_ones_are_removed() {
        let (_dir, tokens, anna) = list();
        for _ in 0..WAITING_MAX {
            issue(&tokens, &anna, MINUTE, 0).expect("a code");
        }
        let full = issue(&tokens, &anna, MINUTE, 1).expect_err("too many").message;
        assert!(full.contains("expected fewer than 64 links") && full.contains("tokens.links"), "{full}");
        issue(&tokens, &anna, MINUTE, MINUTE_NS).expect("the others have expired");
        assert_eq!(std::fs::read_dir(directory(&tokens)).expect("there").count(), 1);
    }

    #[test]
    fn a_file_that_others_can_read_opens_nothing() {
        let (_dir, tokens, anna) = list();
        let code = issue(&tokens, &anna, MINUTE, 0).expect("a code");
        let path = directory(&tokens).join(SecretHash::of(&code).to_string());
        std::fs::set_permissions(&path, PermissionsExt::from_mode(0o640)).expect("mine");
        assert!(redeem(&tokens, &code, 1).is_err_and(|why| why.contains("mode is 640")));
        assert!(!path.exists());
    }
}
