// SPDX-License-Identifier: MIT OR Apache-2.0
//! `println`, `eprintln` and `eprint` that outlive their readers.
//!
//! Those of the standard library panic where nobody reads any more (`fourdbody verify SESSION | head -1`, a terminal that was
//! closed), in the middle of whatever the command does. Here the line is lost, and the command goes on to its own exit code. Unit
//! tests keep the standard ones, whose lines the test harness holds back.

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
