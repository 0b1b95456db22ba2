// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody cameras`: what answers to discovery.

use super::failure::Failure;
use crate::base::Exit;

/// List the cameras that answer to discovery, without opening any.
#[derive(clap::Args)]
#[command(after_help = "Example:\n  fourdbody cameras --json")]
pub struct Args {
    /// Print JSON instead of a table.
    #[arg(long)]
    json: bool,
}

/// Runs the command.
#[cfg(feature = "aravis")]
pub fn run(args: &Args) -> Result<Exit, Failure> {
    use crate::camera::CameraBackend;
    let mut list = crate::camera::AravisCameras.list();
    list.sort_by(|a, b| a.address.cmp(&b.address));
    if args.json {
        println!("{}", serde_json::json!({ "cameras": list }));
        return Ok(Exit::Done);
    }
    println!("{:<16} {:<12} {:<24} {:<20} protocol", "address", "serial", "vendor", "model");
    for camera in &list {
        println!(
            "{:<16} {:<12} {:<24} {:<20} {}",
            camera.address, camera.serial, camera.vendor, camera.model, camera.protocol
        );
    }
    println!("{} found", list.len());
    Ok(Exit::Done)
}

/// Runs the command.
#[cfg(not(feature = "aravis"))]
pub fn run(_args: &Args) -> Result<Exit, Failure> {
    let message = "this binary was built without the feature `aravis` and cannot see cameras; build it with default features";
    Err(Failure::new(Exit::Usage, message))
}
