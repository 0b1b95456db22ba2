// SPDX-License-Identifier: MIT OR Apache-2.0
//! Names of takes: a name that is taken already is followed by the next number.

use super::participant::Nodes;
use crate::base::ids::SessionName;
use crate::base::{Exit, Fault};
use std::path::Path;

/// The largest number of a take.
const NUMBER_MAX: u32 = 9999;

/// The name after this one: `walk` is followed by `walk-02`, `walk-07` by `walk-08`.
pub fn next(name: &str) -> String {
    let (base, number) = parts(name);
    format!("{base}-{:02}", number.saturating_add(1))
}

/// The first name from `wanted` on under which nothing is recorded in this directory.
///
/// # Errors
/// `wanted` is no name of a session, or every number is taken.
pub fn free_in(sessions_dir: &Path, wanted: &str) -> Result<String, String> {
    SessionName::parse(wanted)?;
    let mut name = wanted.to_owned();
    // A link whose disk is away is a name that is taken.
    while std::fs::symlink_metadata(sessions_dir.join(&name)).is_ok() {
        if parts(&name).1 >= NUMBER_MAX {
            return Err(format!("all names from {wanted} to {name} are taken; choose another"));
        }
        name = next(&name);
        SessionName::parse(&name)?;
    }
    Ok(name)
}

/// The first name from `wanted` on that is free on all nodes.
pub(super) fn free_on_all(nodes: Nodes<'_>, wanted: &str) -> Result<String, Fault> {
    let mut name = wanted.to_owned();
    loop {
        let before = name.clone();
        for node in nodes {
            name = node.free_name(&name)?;
        }
        if name == before {
            return SessionName::parse(&name).map(|name| name.0).map_err(|e| Fault::new(Exit::Usage, e));
        }
    }
}

/// A name without its number, and the number; 1 where it has none.
fn parts(name: &str) -> (&str, u32) {
    let number = |digits: &str| {
        let plain = (2..=4).contains(&digits.len()) && digits.bytes().all(|b| b.is_ascii_digit());
        plain.then(|| digits.parse().ok())?
    };
    match name.rsplit_once('-').and_then(|(base, digits)| Some((base, number(digits)?))) {
        Some((base, number)) if !base.is_empty() => (base, number),
        _ => (name, 1),
    }
}

#[cfg(test)]
mod tests {
    use super::{free_in, next, parts};

    #[test]
    fn numbers_go_on_where_a_name_has_one() {
        for (name, after) in [
            ("walk", "walk-02"),
            ("walk-01", "walk-02"),
            ("walk-09", "walk-10"),
            ("walk-99", "walk-100"),
            ("p-7", "p-7-02"),
            ("session-1763743000", "session-1763743000-02"),
        ] {
            assert_eq!(next(name), after);
        }
        assert_eq!(parts("walk"), ("walk", 1));
    }

    #[test]
    fn a_name_that_is_taken_is_followed_by_the_first_that_is_free() {
        let dir = tempfile::tempdir().expect("a directory");
        for taken in ["walk", "walk-02", "walk-04", "run-01"] {
            std::fs::create_dir(dir.path().join(taken)).expect("made");
        }
        std::os::unix::fs::symlink("/away", dir.path().join("run-02")).expect("made");
        for (wanted, free) in
            [("walk", "walk-03"), ("walk-04", "walk-05"), ("sit", "sit"), ("run-01", "run-03")]
        {
            assert_eq!(free_in(dir.path(), wanted).as_deref(), Ok(free));
        }
        for bad in ["", "../walk", "a/b", "-rf", ".."] {
            assert!(free_in(dir.path(), bad).is_err(), "{bad:?}");
        }
        std::fs::create_dir(dir.path().join("end-9999")).expect("made");
        assert!(free_in(dir.path(), "end-9999").is_err_and(|e| e.contains("choose another")));
        let long = "x".repeat(64);
        std::fs::create_dir(dir.path().join(&long)).expect("made");
        assert!(free_in(dir.path(), &long).is_err(), "no name has more than 64 characters");
    }
}
