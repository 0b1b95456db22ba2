//! One file per subcommand of `fourdbody-sim`.

pub mod cameras;
