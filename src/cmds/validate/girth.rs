// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody validate girth`: girths of merged clouds at stated heights.

use super::{load_cloud, open_clouds};
use crate::base::Exit;
use crate::cmds::failure::Failure;
use crate::validate::girth::{Loop, SurfacePoint, loops, names};
use std::path::PathBuf;

/// Measure closed contours of the merged clouds at stated heights, and their convex hulls.
///
/// The slice is 8 mm thick, and its points are moved to its middle along the surface. Separate loops are named by where
/// they lie: the trunk keeps the name, an arm on its left is NAME:+y or so. Two legs are NAME:+y and NAME:-y.
#[derive(clap::Args)]
#[command(
    after_help = "Example:\n  fourdbody validate girth --clouds out --at waist=1.05 --at hip=0.88 --known waist=812.4 --known hip=961.0"
)]
pub struct Args {
    /// What `fourdbody reconstruct` wrote (with merged/ in it).
    #[arg(long, value_name = "DIR")]
    clouds: PathBuf,
    /// A girth to measure: its name and height in the world, m.
    #[arg(long, value_name = "NAME=HEIGHT_M", required = true, value_parser = parse_pair)]
    at: Vec<(String, f64)>,
    /// What the contour of that name is known to measure, mm.
    #[arg(long, value_name = "NAME=MM", value_parser = parse_pair)]
    known: Vec<(String, f64)>,
    /// Compare the convex hull with the known girth, as for tape measurements, instead of the contour.
    #[arg(long)]
    tape: bool,
    /// Only the merged cloud of this trigger.
    #[arg(long, value_name = "N")]
    trigger: Option<u64>,
    /// Print one JSON object instead of a table.
    #[arg(long)]
    json: bool,
}

#[derive(serde::Serialize)]
struct Row {
    name: String,
    height_m: f64,
    trigger: u64,
    #[serde(flatten)]
    girth: Loop,
    #[serde(skip_serializing_if = "Option::is_none")]
    known_mm: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    difference_mm: Option<f64>,
}

/// Runs `validate girth` and prints its table.
pub fn run(args: &Args) -> Result<Exit, Failure> {
    let set = open_clouds(&args.clouds)?;
    let mut rows = Vec::new();
    for (&trigger, place) in set.merged.iter().filter(|(t, _)| args.trigger.is_none_or(|only| only == **t)) {
        let cloud = load_cloud(&set, place)?;
        for (name, height_m) in &args.at {
            let points = cloud.position_m.iter().zip(&cloud.normal);
            let points = points.map(|(&position_m, &normal)| SurfacePoint { position_m, normal });
            let found = loops(points, *height_m);
            let names = names(name, &found);
            for (name, girth) in names.into_iter().zip(found) {
                let known_mm = args.known.iter().find(|(known, _)| *known == name).map(|(_, mm)| *mm);
                let measured = if args.tape { girth.hull_mm } else { girth.contour_mm };
                let difference_mm = known_mm.map(|known| measured - known);
                rows.push(Row { name, height_m: *height_m, trigger, girth, known_mm, difference_mm });
            }
        }
    }
    check(args, &rows)?;
    print(args.json, &rows);
    Ok(Exit::Done)
}

/// A requested girth that is not there is a failure, not an empty row.
fn check(args: &Args, rows: &[Row]) -> Result<(), Failure> {
    let of = |name: &str| rows.iter().any(|r| r.name == name || r.name.starts_with(&format!("{name}:")));
    if let Some((name, height)) = args.at.iter().find(|(name, _)| !of(name)) {
        let message = format!(
            "{name}: the merged clouds under {} have no loop at {height} m; expected a height of the body, in metres above the floor",
            args.clouds.display()
        );
        return Err(Failure::new(Exit::Corrupt, message));
    }
    if let Some((name, _)) = args.known.iter().find(|(name, _)| rows.iter().all(|r| r.name != *name)) {
        let found: Vec<&str> = rows.iter().map(|r| r.name.as_str()).collect();
        let message = format!("--known {name}: no loop has this name; found {}", found.join(", "));
        return Err(Failure::new(Exit::Usage, message));
    }
    Ok(())
}

fn print(json: bool, rows: &[Row]) {
    let differences: Vec<f64> = rows.iter().filter_map(|r| r.difference_mm).map(f64::abs).collect();
    let known = !differences.is_empty();
    let mean_mm = known.then(|| super::mean(differences.iter().copied()));
    let max_mm = known.then(|| differences.iter().copied().fold(0.0, f64::max));
    if json {
        println!("{}", serde_json::json!({"girths": rows, "mean_mm": mean_mm, "max_mm": max_mm}));
        return;
    }
    println!(
        "girth             height trigger contour mm    hull mm differ mm  points     out  rms mm  gap mm folded %"
    );
    for Row { name, height_m, trigger, girth, difference_mm, .. } in rows {
        let Loop { contour_mm, hull_mm, points, left_out, rms_mm, gap_mm, folded_share, .. } = girth;
        let differ = difference_mm.map_or("-".to_owned(), |d| format!("{d:+.2}"));
        let folded = 100.0 * folded_share;
        println!(
            "{name:<16} {height_m:>7.3} {trigger:>7} {contour_mm:>10.2} {hull_mm:>10.2} {differ:>9} {points:>7} {left_out:>7} {rms_mm:>7.3} {gap_mm:>7.1} {folded:>8.1}"
        );
    }
    if let (Some(mean), Some(max)) = (mean_mm, max_mm) {
        println!("difference: mean {mean:.3} mm, largest {max:.3} mm");
    }
}

fn parse_pair(text: &str) -> Result<(String, f64), String> {
    let parsed = text.rsplit_once('=').and_then(|(name, number)| Some((name, number.parse::<f64>().ok()?)));
    parsed
        .filter(|(name, number)| !name.is_empty() && number.is_finite())
        .map(|(name, number)| (name.to_owned(), number))
        .ok_or_else(|| format!("expected NAME=NUMBER, for instance waist=1.05, found {text:?}"))
}
