// SPDX-License-Identifier: MIT OR Apache-2.0
//! Writes manual pages and completions of the command line: `cargo run --example manual -- DIR`.

use clap::CommandFactory;
use clap_complete::{Shell, generate_to};
use std::path::PathBuf;

fn main() -> std::io::Result<()> {
    let dir = std::env::args_os().nth(1).map(PathBuf::from);
    let dir = dir.ok_or_else(|| std::io::Error::other("expected the directory to write to"))?;
    let man = dir.join("man");
    std::fs::create_dir_all(&man)?;
    let mut command = fourdbody::cmds::Cli::command().name("fourdbody");
    clap_mangen::generate_to(command.clone(), &man)?;
    for shell in [Shell::Bash, Shell::Zsh] {
        generate_to(shell, &mut command, "fourdbody", &dir)?;
    }
    Ok(())
}
