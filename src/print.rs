// SPDX-License-Identifier: MIT OR Apache-2.0
//! `println`, `eprintln` and `eprint` that outlive their readers.
//!
//! Those of the standard library panic where their reader has ended (`fourdbody verify SESSION | head -1`, a terminal
//! that was closed), in the middle of whatever the command does. Here the line is lost, and the command goes on to its
//! own exit code. Unit tests keep the standard ones, whose lines the test harness holds back.

#[cfg(not(test))]
macro_rules! print_to {
    ($stream:ident, ) => {{
        use std::io::Write as _;
        let _ = writeln!(std::io::$stream());
    }};
    ($stream:ident, $($line:tt)*) => {{
        use std::io::Write as _;
        let _ = writeln!(std::io::$stream(), "{}", $crate::base::print::harmless(format_args!($($line)*)));
    }};
}

/// A line to standard output.
#[cfg(not(test))]
macro_rules! println {
    ($($line:tt)*) => { print_to!(stdout, $($line)*) };
}

/// A line to standard error.
#[cfg(not(test))]
macro_rules! eprintln {
    ($($line:tt)*) => { print_to!(stderr, $($line)*) };
}

/// Part of a line to standard error.
#[cfg(not(test))]
macro_rules! eprint {
    ($($line:tt)*) => {{
        use std::io::Write as _;
        let _ = write!(std::io::stderr(), $($line)*);
    }};
}
