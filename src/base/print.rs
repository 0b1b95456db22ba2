// SPDX-License-Identifier: MIT OR Apache-2.0
//! `println`, `eprintln` and `eprint` that outlive their readers.
//!
//! Those of the standard library panic where nobody reads any more (`fourdbody verify SESSION | head -1`, a terminal that was
//! closed), in the middle of whatever the command does. Here the line is lost, and the command goes on to its own exit code. Unit
//! tests keep the standard ones, whose lines the test harness holds back.

/// A text without what steers a terminal: it may hold what is in somebody else's file. Its lines stay lines; what must be one
/// goes through [`one_line`](super::ids::one_line).
pub fn harmless(text: impl std::fmt::Display) -> String {
    let text = text.to_string();
    let steers = |c: char| super::ids::is_control(c) && !matches!(c, '\n' | '\t');
    if text.contains(steers) { text.replace(steers, "\u{fffd}") } else { text }
}

/// A line to standard output.
#[cfg(not(test))]
macro_rules! println {
    () => {{
        use std::io::Write as _;
        let _ = writeln!(std::io::stdout());
    }};
    ($($line:tt)*) => {{
        use std::io::Write as _;
        let _ = writeln!(std::io::stdout(), "{}", $crate::base::print::harmless(format_args!($($line)*)));
    }};
}

/// A line to standard error.
#[cfg(not(test))]
macro_rules! eprintln {
    () => {{
        use std::io::Write as _;
        let _ = writeln!(std::io::stderr());
    }};
    ($($line:tt)*) => {{
        use std::io::Write as _;
        let _ = writeln!(std::io::stderr(), "{}", $crate::base::print::harmless(format_args!($($line)*)));
    }};
}

/// Part of a line to standard error.
#[cfg(not(test))]
macro_rules! eprint {
    ($($line:tt)*) => {{
        use std::io::Write as _;
        let _ = write!(std::io::stderr(), $($line)*);
    }};
}
