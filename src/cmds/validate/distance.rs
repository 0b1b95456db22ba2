// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody validate distance`: distances between the outermost circles of the board.

use super::{find_calibration, load_cloud, mean, open_clouds, open_photographs};
use crate::base::Exit;
use crate::base::ids::{CameraId, TriggerIndex};
use crate::base::image::Mono8;
use crate::batch::result::{Clouds, Placed};
use crate::calibrate::Board;
use crate::cmds::failure::Failure;
use crate::data::{Calibration, Frame, FrameSource};
use crate::validate::distance::{Diagonals, Light, Sight, diagonals};
use crate::validate::ring::Organized;
use std::path::PathBuf;

/// Measure the distances between the outermost circles on both diagonals of the board, from edge to edge, per head.
///
/// The edges are found in the clouds' intensities, with the fringes that the calibration has there; with --session in
/// the photographs that the clouds were made of. Without --calibration the fringes at the edges are not known: expect
/// errors of some tenths of a millimetre.
#[derive(clap::Args)]
#[command(
    after_help = "Example:\n  fourdbody validate distance --clouds out --board config/board.toml --calibration calibration.json \\\n      --session sessions/board-9rpm"
)]
pub struct Args {
    /// What `fourdbody reconstruct` wrote (with clouds/ in it).
    #[arg(long, value_name = "DIR")]
    clouds: PathBuf,
    /// The board file, with the centres as measured.
    #[arg(long, value_name = "FILE")]
    board: PathBuf,
    /// The calibration that the clouds were made with.
    #[arg(long, value_name = "FILE")]
    calibration: Option<PathBuf>,
    /// The session, or directory of images CAMERA/INDEX.png, that the clouds were made of.
    #[arg(long, value_name = "DIR", requires = "calibration")]
    session: Option<PathBuf>,
    /// Print one JSON object instead of a table.
    #[arg(long)]
    json: bool,
}

#[derive(serde::Serialize)]
struct Row {
    head: String,
    trigger: u64,
    cameras: Vec<String>,
    #[serde(flatten)]
    diagonals: Diagonals,
}

/// A head at a trigger that could not be measured.
#[derive(serde::Serialize)]
struct Missing {
    head: String,
    trigger: u64,
    reason: String,
}

/// Runs `validate distance` and prints its table.
pub fn run(args: &Args) -> Result<Exit, Failure> {
    let board = Board::load(&args.board)?;
    let calibration = find_calibration(args.calibration.as_deref(), &args.clouds)?;
    let cameras: Vec<CameraId> =
        calibration.iter().flat_map(|c| c.cameras().map(|(_, camera)| camera.id.clone())).collect();
    let source = args.session.as_ref().map(|path| open_photographs(path, &cameras, &args.clouds));
    let source = source.transpose()?;
    let set = open_clouds(&args.clouds)?;
    let (mut rows, mut missing) = (Vec::new(), Vec::new());
    for ((trigger, head), files) in set.heads(calibration.as_ref()) {
        match measure(&board, calibration.as_ref(), source.as_deref(), trigger, (&set, &files))? {
            Ok(diagonals) => {
                let cameras = files.iter().map(|(camera, _)| (*camera).to_owned()).collect();
                rows.push(Row { head, trigger, cameras, diagonals });
            }
            Err(reason) => missing.push(Missing { head, trigger, reason }),
        }
    }
    print(args, &rows, &missing);
    Ok(if rows.is_empty() { Exit::Corrupt } else { Exit::Done })
}

/// One head at one trigger; the inner error is the reason why it cannot be measured.
fn measure(
    board: &Board,
    calibration: Option<&Calibration>,
    source: Option<&dyn FrameSource>,
    trigger: u64,
    (set, files): (&Clouds, &[Placed<'_>]),
) -> Result<Result<Diagonals, String>, Failure> {
    let (mut clouds, mut frames) = (Vec::new(), Vec::new());
    for (camera, place) in files {
        clouds.push(load_cloud(set, place)?);
        let frame = source.map(|s| s.frame(&CameraId::from(*camera), TriggerIndex(trigger))).transpose();
        match frame.map_err(|e| Failure::new(Exit::Corrupt, e))? {
            Some(Frame::Gap(reason)) => {
                return Ok(Err(format!("there is a cloud of {camera}, but no photograph: {reason}")));
            }
            frame => frames.push(frame),
        }
    }
    let grids: Vec<Organized<'_>> = clouds.iter().filter_map(Organized::new).collect();
    if grids.len() != files.len() {
        return Ok(Err("a camera's cloud is empty".to_owned()));
    }
    let mut sights = Vec::new();
    for (((camera, _), cloud), frame) in files.iter().zip(&grids).zip(&frames) {
        let head = calibration.and_then(|c| Some((c, c.camera(&CameraId::from(*camera))?.0)));
        let light = head.map(|(c, head)| Light { projector: &head.projector, pattern: &c.pattern });
        let photograph = match frame {
            Some(Frame::Image(image)) => Some(*image),
            Some(Frame::Owned(plane)) => Some(Mono8::from(plane)),
            _ => None,
        };
        sights.push(Sight { cloud, light, photograph });
    }
    Ok(diagonals(&sights, board))
}

fn print(args: &Args, rows: &[Row], missing: &[Missing]) {
    let errors = || rows.iter().flat_map(|row| row.diagonals.error_mm);
    let rms_mm = mean(errors().map(|e| e * e)).sqrt();
    let mean_abs_mm = mean(errors().map(f64::abs));
    let edges = match (&args.session, &args.calibration) {
        (Some(_), _) => "photographs",
        (None, Some(_)) => "intensities and pattern",
        (None, None) => "intensities",
    };
    if args.json {
        let report = serde_json::json!({
            "per_head": rows, "missing": missing, "rms_mm": rms_mm, "mean_abs_mm": mean_abs_mm, "edges_from": edges,
        });
        println!("{report}");
        return;
    }
    println!(
        "head   trigger           circles  measured mm  error mm  edges mm  rest %  error of each camera mm"
    );
    for Row { head, trigger, diagonals: d, .. } in rows {
        for i in 0..2 {
            let [from, to] = d.ends[i].map(|[column, row]| format!("{column},{row}"));
            let circles = format!("{from} to {to}");
            let (measured, error, edges) = (d.diagonal_mm[i], d.error_mm[i], d.edges_mm[i]);
            let each: Vec<String> = d.error_of_camera_mm.iter().map(|e| format!("{:+.3}", e[i])).collect();
            let (rest, each) = (100.0 * d.edge_rms, each.join(" "));
            println!(
                "{head:<6} {trigger:>7} {circles:>17} {measured:>12.3} {error:>+9.3} {edges:>+9.3} {rest:>7.2}  {each}"
            );
        }
    }
    for row in missing {
        println!("{:<6} {:>7} not measured: {}", row.head, row.trigger, row.reason);
    }
    println!("edges from {edges}: rms {rms_mm:.3} mm, mean size {mean_abs_mm:.3} mm");
}
