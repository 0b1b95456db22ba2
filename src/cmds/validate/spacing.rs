// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody validate spacing`: distances between points.

use super::{load_cloud, mean, of_something, open_clouds};
use crate::base::Exit;
use crate::cmds::failure::Failure;
use crate::validate::spacing::{Directional, Merged, directional, merged};
use std::path::PathBuf;

/// Measure the distances between points: per directional cloud between pixel neighbours, merged to the nearest points
/// and by density.
#[derive(clap::Args)]
#[command(after_help = "Example:\n  fourdbody validate spacing --clouds out")]
pub struct Args {
    /// What `fourdbody reconstruct` wrote (with clouds/ and merged/ in it).
    #[arg(long, value_name = "DIR")]
    clouds: PathBuf,
    /// Print one JSON object instead of a table.
    #[arg(long)]
    json: bool,
}

#[derive(serde::Serialize)]
struct CloudRow {
    camera: String,
    trigger: u64,
    #[serde(flatten)]
    spacing: Directional,
}

#[derive(serde::Serialize)]
struct MergedRow {
    trigger: u64,
    #[serde(flatten)]
    spacing: Merged,
}

/// Runs `validate spacing` and prints its tables.
pub fn run(args: &Args) -> Result<Exit, Failure> {
    let set = open_clouds(&args.clouds)?;
    let (mut clouds, mut all) = (Vec::new(), Vec::new());
    for ((trigger, camera), place) in &set.directional {
        let found = directional(&load_cloud(&set, place)?);
        clouds.extend(found.map(|spacing| CloudRow { camera: camera.clone(), trigger: *trigger, spacing }));
    }
    for (&trigger, place) in &set.merged {
        all.extend(merged(&load_cloud(&set, place)?).map(|spacing| MergedRow { trigger, spacing }));
    }
    of_something(clouds.len() + all.len(), &args.clouds, "clouds with points")?;
    // Every point counts the same.
    let weighted = clouds.iter().map(|row| row.spacing.points as f64 * row.spacing.spacing_mm).sum::<f64>();
    let spacing_cloud_mm = weighted / clouds.iter().map(|row| row.spacing.points as f64).sum::<f64>();
    let of = |value: fn(&Merged) -> f64| mean(all.iter().map(|row| value(&row.spacing)));
    let (nearest, four, density) = (of(|m| m.nearest_mm), of(|m| m.nearest_4_mm), of(|m| m.density_mm));
    if args.json {
        let report = serde_json::json!({
            "spacing_cloud_mm": spacing_cloud_mm, "spacing_merged_mm": four,
            "spacing_merged_nearest_mm": nearest, "spacing_merged_density_mm": density,
            "clouds": clouds, "merged": all,
        });
        println!("{report}");
        return Ok(Exit::Done);
    }
    println!("cloud                   points  spacing mm     u mm     v mm   area m2");
    for CloudRow { camera, trigger, spacing } in &clouds {
        let name = format!("{camera} {trigger}");
        let Directional { points, spacing_mm, spacing_u_mm: u, spacing_v_mm: v, area_m2 } = spacing;
        println!("{name:<20} {points:>9} {spacing_mm:>11.3} {u:>8.3} {v:>8.3} {area_m2:>9.4}");
    }
    println!("merged                  points   4 near mm  near mm dens. mm      lone");
    for MergedRow { trigger, spacing } in &all {
        let Merged { points, lone, nearest_mm, nearest_4_mm, density_mm } = spacing;
        println!(
            "{trigger:<20} {points:>9} {nearest_4_mm:>11.3} {nearest_mm:>8.3} {density_mm:>8.3} {lone:>9}"
        );
    }
    println!(
        "directional {spacing_cloud_mm:.3} mm; merged {four:.3} mm (four nearest), density {density:.3} mm"
    );
    Ok(Exit::Done)
}
