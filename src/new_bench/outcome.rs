// SPDX-License-Identifier: MIT OR Apache-2.0
//! What came of setting a bench up: its cameras, their pictures, and what stands above their entries.

use super::delays::Delays;
use super::found::Found;
use super::roles::{Known, Role};
use crate::base::ids::CameraId;
use crate::base::image::{Mono8, write_png_grey};
use serde::Serialize;
use std::path::{Path, PathBuf};

/// A camera as it was set up.
#[derive(Debug, Clone, Serialize)]
pub struct NamedCamera {
    /// Its name in the rig.
    pub id: CameraId,
    /// Who it is.
    pub device: Found,
    /// How its name is known.
    pub named: Known,
    /// The line that the HSU is wired to; `None` where raw settings say it, or it was not found.
    pub trigger_line: Option<String>,
    /// The number of the head on whose wire it hangs.
    pub head: Option<usize>,
    /// From the edge to the stamp, us.
    pub stamp_us: Option<f64>,
    /// From the edge to the first packet, us.
    pub arrival_us: Option<f64>,
    /// The largest packet that arrives, bytes.
    pub largest_packet_bytes: Option<u32>,
    /// Frames at the rig's rate, and the triggers that they are of.
    pub frames_at_rate: Option<(usize, u32)>,
    /// A picture of it.
    pub picture: Option<PathBuf>,
}

/// What came of it.
#[derive(Debug, Clone, Serialize)]
pub struct Outcome {
    /// The node file.
    pub file: PathBuf,
    /// The cameras, in the rig's order.
    pub cameras: Vec<NamedCamera>,
    /// What keeps the bench from being used.
    pub problems: Vec<String>,
    /// What an operator should know.
    pub told: Vec<String>,
}

/// What stands above a camera's entry.
pub fn comment(found: &Found, known: Known, delays: Option<Delays>) -> String {
    let who = format!("{} {} {}", found.vendor, found.model, found.serial);
    let named = if known == Known::InOrder { ", named in the order of serial numbers" } else { "" };
    match delays {
        None => format!("{who}{named}: no frame yet"),
        Some(delays) => {
            let stamp = match delays.stamp_us {
                Some(stamp) => format!("stamp {:.1} ms", stamp / 1000.0),
                None => "no stamp".to_owned(),
            };
            format!(
                "{who}{named}: {stamp} and first packet {:.1} ms after the edge",
                delays.arrival_us / 1000.0
            )
        }
    }
}

/// Writes a picture beside the file; `None` where there is none.
///
/// # Errors
/// Why it cannot be written.
pub fn picture(
    path: &Path,
    role: &Role,
    size: (usize, usize),
    pixels: &[u8],
) -> Result<Option<PathBuf>, String> {
    let Some(image) = Mono8::new(size.0, size.1, pixels) else { return Ok(None) };
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    let file = path.with_file_name(format!("{stem}-{}.png", role.id));
    write_png_grey(&file, image)
        .map_err(|e| format!("its picture {} cannot be written: {e}", file.display()))?;
    Ok(Some(file))
}
