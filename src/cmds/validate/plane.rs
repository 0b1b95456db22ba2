// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody validate plane`: how flat the board comes out.

use super::{load_calibration, load_cloud, mean, of_something, open_clouds, points};
use crate::base::Exit;
use crate::calibrate::Board;
use crate::cmds::failure::Failure;
use crate::validate::deviations::Deviations;
use crate::validate::plane::{Flatness, flatness};
use crate::validate::ring::{Organized, place};
use nalgebra::Point3;
use std::path::PathBuf;

/// Fit a plane to the board's points, per camera and per head (both cameras together).
///
/// Without --board the largest plane is the board, and the convex hull of its points its outline. With --board the
/// circles give the board's pose. Points near the outline (--margin-mm) are left out; points of the board that are more
/// than 10 mm off the plane have a wrong fringe order: they are counted (left_out), not averaged.
#[derive(clap::Args)]
#[command(after_help = "Example:\n  fourdbody validate plane --clouds out --board config/board.toml")]
pub struct Args {
    /// What `fourdbody reconstruct` wrote (with clouds/ in it).
    #[arg(long, value_name = "DIR")]
    clouds: PathBuf,
    /// The calibration, which names the cameras of each head [default: that beside the clouds].
    #[arg(long, value_name = "FILE")]
    calibration: Option<PathBuf>,
    /// The board file, to find the board by its circles.
    #[arg(long, value_name = "FILE")]
    board: Option<PathBuf>,
    /// Points this near to the board's outline are left out: about one fringe.
    #[arg(long, value_name = "MM", default_value_t = 10.0)]
    margin_mm: f64,
    /// Print one JSON object instead of a table.
    #[arg(long)]
    json: bool,
}

#[derive(serde::Serialize)]
struct Row {
    #[serde(skip_serializing_if = "Option::is_none")]
    camera: Option<String>,
    head: String,
    trigger: u64,
    /// How the board was found: `circles`, or `largest plane` with the reason.
    found_by: String,
    #[serde(flatten)]
    flatness: Flatness,
}

/// Runs `validate plane` and prints its table.
pub fn run(args: &Args) -> Result<Exit, Failure> {
    let calibration = load_calibration(args.calibration.as_deref(), &args.clouds)?;
    let board = args.board.as_ref().map(|path| Board::load(path)).transpose()?;
    let set = open_clouds(&args.clouds)?;
    let (mut per_camera, mut per_head, mut failed) = (Vec::new(), Vec::new(), Vec::new());
    for ((trigger, head), files) in set.heads(Some(&calibration)) {
        let mut clouds = Vec::new();
        for (camera, place) in &files {
            clouds.push((*camera, load_cloud(&set, place)?));
        }
        let grids: Vec<Organized<'_>> = clouds.iter().filter_map(|(_, c)| Organized::new(c)).collect();
        let (placed, found_by) = match board.as_ref().map(|board| place(&grids, board)) {
            None => (None, "largest plane".to_owned()),
            Some(Ok(placed)) => (Some(placed), "circles".to_owned()),
            Some(Err(reason)) => (None, format!("largest plane: {reason}")),
        };
        let mut judge = |camera: Option<&str>, points: &[Point3<f64>], rows: &mut Vec<Row>| {
            let (camera, head, found_by) = (camera.map(str::to_owned), head.clone(), found_by.clone());
            match flatness(points, placed.as_ref(), 1e-3 * args.margin_mm) {
                Some(flatness) => rows.push(Row { camera, head, trigger, found_by, flatness }),
                None => failed.push(format!("{} {trigger}: no plane", camera.unwrap_or(head))),
            }
        };
        for (camera, cloud) in &clouds {
            judge(Some(camera), &points(cloud).collect::<Vec<_>>(), &mut per_camera);
        }
        judge(None, &clouds.iter().flat_map(|(_, c)| points(c)).collect::<Vec<_>>(), &mut per_head);
    }
    failed.iter().for_each(|reason| eprintln!("{reason}"));
    of_something(per_head.len(), &args.clouds, "directional clouds with a plane")?;
    print(args.json, &per_camera, &per_head);
    Ok(if failed.is_empty() { Exit::Done } else { Exit::Corrupt })
}

fn print(json: bool, per_camera: &[Row], per_head: &[Row]) {
    let rms_mm = mean(per_head.iter().map(|row| row.flatness.deviations.rms_mm));
    if json {
        println!("{}", serde_json::json!({"rms_mm": rms_mm, "per_head": per_head, "per_camera": per_camera}));
        return;
    }
    println!(
        "           trigger    points   rms mm robust mm   p95 mm  peak mm w. edge mm left out     edge   used % elsewhere  found by"
    );
    for Row { camera, head, trigger, found_by, flatness } in per_camera.iter().chain(per_head) {
        let name = camera.as_ref().unwrap_or(head);
        let Flatness { left_out, edge, rms_with_edge_mm, elsewhere, .. } = flatness;
        let Deviations { points, rms_mm, robust_mm, p95_mm, peak_mm, .. } = flatness.deviations;
        let used = 100.0 * flatness.used_share;
        println!(
            "{name:<10} {trigger:>7} {points:>9} {rms_mm:>8.4} {robust_mm:>9.4} {p95_mm:>8.3} {peak_mm:>8.3} {rms_with_edge_mm:>10.4} {left_out:>8} {edge:>8} {used:>8.2} {elsewhere:>9}  {found_by}"
        );
    }
    println!("mean of heads and triggers: {rms_mm:.4} mm");
}
