// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody view`: a picture of a cloud.

use super::failure::{Failure, no_reconstruction, print, tell_amiss, unreadable, unusable_clouds};
use crate::base::Exit;
use crate::base::image::write_png_rgb;
use crate::batch::result::{self, Clouds};
use crate::export::view::{Style, draw_sides};
use crate::formats::Commented;
use serde_json::json;
use std::path::PathBuf;

/// Draw a cloud as a PNG picture, from one side or several side by side.
#[derive(clap::Args)]
#[command(after_help = "\
Each file is held against its name, its session and summary.json. Exit codes: 3, the files of a camera are missing;
4, a file is damaged, or of something else, or there is nothing to draw.

Examples:
  fourdbody view walk-01 --trigger 12 --out body.png --sides 4
  fourdbody view walk-01/phases/h0_up_000012.phase --out h0_up.png")]
pub struct Args {
    /// What `fourdbody reconstruct` wrote: its directory, of which the merged cloud of a trigger is drawn, or one file
    /// of it (.ply, .phase).
    cloud: PathBuf,
    /// With a directory: which trigger [default: the one in the middle].
    #[arg(long, value_name = "INDEX")]
    trigger: Option<u64>,
    /// The PNG file to write.
    #[arg(long, value_name = "PNG")]
    out: PathBuf,
    /// Number of views, evenly around the cloud.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u8).range(1..=12))]
    sides: u8,
    /// Where the first view is from, degrees: 0 from +x, 90 from +y.
    #[arg(long, default_value_t = 0.0, allow_negative_numbers = true)]
    azimuth: f64,
    /// Number of rows of the picture.
    #[arg(long, default_value_t = 1000, value_parser = clap::value_parser!(u16).range(16..=8000))]
    height: u16,
    /// Colour the points by camera.
    #[arg(long)]
    by_camera: bool,
    /// Print what was drawn as JSON: {"picture": PATH, "points": N}.
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> Result<Exit, Failure> {
    let ((comments, cloud), amiss) = load(args)?;
    let is_amiss = tell_amiss(&amiss);
    if cloud.is_empty() {
        let reason = comments.iter().find_map(|comment| comment.strip_prefix("refused "));
        let reason = reason.map_or_else(String::new, |reason| format!(" ({reason})"));
        let path = args.cloud.display();
        return Err(Failure::corrupt(format!("{path}: has no points{reason}; nothing is drawn")));
    }
    let height = usize::from(args.height);
    let style = Style { width: height * 4 / 5, height, by_camera: args.by_camera };
    let picture = draw_sides(&cloud, args.azimuth, usize::from(args.sides), style);
    write_png_rgb(&args.out, picture.width, picture.height, &picture.rgb)
        .map_err(|e| Failure::at(&args.out, e))?;
    print(args.json, &json!({ "picture": args.out, "points": cloud.len() }), || {
        println!("{}: {} points", args.out.display(), cloud.len());
    });
    Ok(if is_amiss { Exit::DataLoss } else { Exit::Done })
}

/// The requested cloud with its comments, and what is missing of it.
fn load(args: &Args) -> Result<(Commented, Vec<String>), Failure> {
    let usage = |message: String| Failure::usage(message);
    if !args.cloud.exists() {
        return Err(no_reconstruction(&args.cloud, ""));
    }
    if !args.cloud.is_dir() {
        if args.trigger.is_some() {
            return Err(usage("--trigger: is for a directory; this is one file".to_owned()));
        }
        let cloud = result::load_file(&args.cloud).map_err(|e| unreadable(&args.cloud, e))?;
        return Ok((cloud, Vec::new()));
    }
    let clouds = Clouds::open(&args.cloud).map_err(|e| unusable_clouds(&args.cloud, e))?;
    let place = match args.trigger {
        Some(trigger) => clouds.merged.get_key_value(&trigger),
        None => clouds.merged.iter().nth(clouds.merged.len() / 2),
    };
    let amiss = |trigger: u64| clouds.amiss(&(trigger..trigger.saturating_add(1)));
    let (&trigger, place) = place.ok_or_else(|| {
        if let Some(amiss) = args.trigger.map(amiss).filter(|amiss| !amiss.is_empty()) {
            return Failure::corrupt(amiss.join("\n"));
        }
        let (shown, wanted) = (args.cloud.display(), args.trigger.unwrap_or_default());
        match (clouds.merged.keys().next(), clouds.merged.keys().next_back()) {
            (Some(first), Some(last)) => {
                let found = clouds.merged.len();
                let expected = format!("expected a trigger that {shown} has a cloud of: {first} to {last}");
                usage(format!("--trigger {wanted}: {expected} ({found} of them), found none"))
            }
            _ => usage(format!(
                "{shown}: expected merged clouds, found none; `fourdbody view` draws one of its files"
            )),
        }
    })?;
    let cloud = clouds.load(place).map_err(Failure::corrupt)?;
    Ok((cloud, amiss(trigger)))
}
