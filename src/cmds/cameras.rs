// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody cameras`: what answers to discovery; its subcommands: the whole state of cameras.

use super::connect::backend;
use super::failure::{Failure, print};
use super::{camera_setup, camera_state};
use crate::base::Exit;
use crate::camera::CameraListing;

/// List the cameras that answer to discovery, without opening any; with a subcommand: set a new bench up, or the whole
/// state of cameras.
#[derive(clap::Args)]
#[command(args_conflicts_with_subcommands = true)]
#[command(after_help = "\
Examples:
  fourdbody cameras --json
  fourdbody cameras setup --config /etc/fourdbody/node.toml
  fourdbody cameras dump --config /etc/fourdbody/node.toml")]
pub struct Args {
    #[command(subcommand)]
    about: Option<About>,
    /// Print JSON instead of a table.
    #[arg(long)]
    json: bool,
}

#[derive(clap::Subcommand)]
enum About {
    Setup(Box<camera_setup::SetupArgs>),
    Dump(camera_state::DumpArgs),
    Diff(camera_state::DiffArgs),
}

pub fn run(args: &Args) -> Result<Exit, Failure> {
    match &args.about {
        Some(About::Setup(args)) => camera_setup::setup(args),
        Some(About::Dump(args)) => camera_state::dump(args),
        Some(About::Diff(args)) => camera_state::diff(args),
        None => list(args),
    }
}

fn list(args: &Args) -> Result<Exit, Failure> {
    let mut list = backend()?.list();
    list.sort_by(|a, b| a.address.cmp(&b.address));
    print(args.json, &serde_json::json!({ "cameras": list }), || {
        println!("{:<16} {:<12} {:<24} {:<20} protocol", "address", "serial", "vendor", "model");
        for CameraListing { address, serial, vendor, model, protocol, .. } in &list {
            println!("{address:<16} {serial:<12} {vendor:<24} {model:<20} {protocol}");
        }
        println!("{} found", list.len());
    });
    Ok(Exit::Done)
}
