// SPDX-License-Identifier: MIT OR Apache-2.0
//! The `fourdbody` command line: parse, run the command, turn its outcome into the exit code.

use clap::Parser;
use fourdbody::base::print::harmless;
use fourdbody::cmds::Cli;
use std::io::IsTerminal;
use std::io::Write;
use std::process::ExitCode;
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;

fn main() -> ExitCode {
    let cli = Cli::parse();
    log();
    fourdbody::record::survive_file_limit();
    match cli.run() {
        Ok(exit) => exit.into(),
        Err(failure) => {
            // The message may quote a file, a camera or another node. Where it cannot be written, the exit code
            // remains.
            let _ = writeln!(std::io::stderr(), "error: {}", harmless(&failure.message));
            failure.exit.into()
        }
    }
}

/// To the journal with all fields where systemd has connected it (`JOURNAL_STREAM`), to standard error otherwise.
fn log() {
    let filter = tracing_subscriber::EnvFilter::try_from_env("FOURDBODY_LOG")
        .unwrap_or_else(|_| tracing_subscriber::EnvFilter::new("info,object_store=error"));
    let journal = std::env::var_os("JOURNAL_STREAM").and_then(|_| tracing_journald::layer().ok());
    let text = journal.is_none().then(|| tracing_subscriber::fmt::layer().with_writer(std::io::stderr));
    // A file holds no colours.
    let text = text.map(|layer| layer.with_ansi(std::io::stderr().is_terminal()));
    tracing_subscriber::registry().with(filter).with(journal).with(text).init();
}
