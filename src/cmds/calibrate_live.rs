// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody calibrate --live`: leads an operator through the positions of the board, one small session each.

use super::capture::stop_on_ctrl_c;
use super::failure::Failure;
use super::reconstruct::open_source;
use crate::base::Exit;
use crate::base::ids::CameraId;
use crate::calibrate::guide::Guide;
use crate::calibrate::joined::Joined;
use crate::calibrate::{Board, Finding, Position, views};
use crate::capture::participant::Participant;
use crate::capture::request::{CaptureRequest, Control};
use crate::capture::run::capture;
use crate::data::{Calibration, FrameSource};
use std::io::BufRead;
use std::sync::Arc;

/// How the positions are captured.
pub struct Live {
    pub nodes: Vec<Box<dyn Participant>>,
    /// Sessions are named BASE-p001 and so on.
    pub base: String,
    /// Triggers per position: white first, then fringes.
    pub triggers: u64,
}

/// Captures positions until all are there or the operator ends it; returns their frames as one source.
pub fn run(live: &Live, nominal: &Calibration, board: &Board) -> Result<Joined, Failure> {
    let cameras: Vec<CameraId> = nominal.cameras().map(|(_, camera)| camera.id.clone()).collect();
    let mut guide = Guide::new(nominal, board);
    let mut joined = Joined::default();
    let control = Arc::new(Control::default());
    stop_on_ctrl_c(&control)?;
    let mut input = std::io::stdin().lock();
    // Sessions that were undone keep their names.
    let mut number = 0;
    let mut failed = None;
    print_line(
        "Every position takes one white frame and one with fringes. Enter: capture; u: undo the last one; q: enough.",
    );
    while let Some(request) = guide.next() {
        print_line(&format!("[{}] {}", guide.progress().join(", "), guide.words(request)));
        let mut line = String::new();
        let read = input.read_line(&mut line).map_err(|e| Failure::new(Exit::Failure, e))?;
        match line.trim() {
            "q" => break,
            _ if read == 0 => break,
            "u" if !joined.is_empty() => {
                guide.undo();
                joined.pop();
                print_line("removed the last position; its session stays on the disks");
                continue;
            }
            "" => {}
            other => {
                print_line(&format!("expected Enter, u or q, found {other:?}"));
                continue;
            }
        }
        number += 1;
        // One session that fails must not cost the positions that were captured before.
        let parts = match one_session(live, number, &cameras, &control) {
            Ok(parts) => parts,
            Err(failure) => {
                print_line(&format!(
                    "this position was not captured and does not count: {}",
                    failure.message
                ));
                print_line("press Enter to try again");
                failed = Some(failure);
                continue;
            }
        };
        let mut alone = Joined::default();
        alone.push(parts);
        let looked = views::look(&alone, nominal, board).map_err(|e| Failure::new(Exit::Failure, e))?;
        let usable = report(&looked, nominal, &mut guide);
        match usable {
            true => joined.push(alone.into_parts()),
            false => print_line(
                "this position is not usable and does not count: correct what the lines above name, then press Enter",
            ),
        }
    }
    if joined.is_empty() {
        return Err(failed.unwrap_or_else(|| {
            Failure::new(Exit::Usage, "no usable position was captured; nothing to calibrate from")
        }));
    }
    print_line(&format!("{} positions, {} sessions taken", joined.len(), number));
    Ok(joined)
}

fn print_line(line: &str) {
    // Standard output has the result only; the dialogue goes to standard error.
    eprintln!("{line}");
}

/// Captures one position and opens its recordings.
fn one_session(
    live: &Live,
    number: usize,
    cameras: &[CameraId],
    control: &Control,
) -> Result<Vec<Box<dyn FrameSource>>, Failure> {
    let request = CaptureRequest {
        triggers: Some(live.triggers),
        name: Some(format!("{}-p{number:03}", live.base)),
        note: Some("calibration, one position of the board".to_owned()),
        ..CaptureRequest::default()
    };
    let captured = capture(&live.nodes, &request, control, |_| ())?;
    let open = |directory: std::path::PathBuf| {
        open_source(&directory, cameras).map_err(|e| {
            let message = format!(
                "{}\nThe node's recording must be readable here under the same path: mount its disk, or capture the positions with `fourdbody capture --triggers 2`, copy them, and give each to `calibrate --session`",
                e.message
            );
            Failure::new(Exit::Failure, message)
        })
    };
    captured.directories().into_iter().map(open).collect()
}

/// Prints what the last position gave, and returns whether it counts.
fn report(
    (positions, findings): &(Vec<Position>, Vec<Finding>),
    nominal: &Calibration,
    guide: &mut Guide<'_>,
) -> bool {
    let Some(position) = positions.iter().max_by_key(|p| p.views.iter().flatten().count()) else {
        print_line(
            "no white frame shows the board: check that the light is on and the pattern sequence runs",
        );
        return false;
    };
    for ((_, camera), view) in nominal.cameras().zip(&position.views) {
        let Some(view) = view else { continue };
        let phase = if view.phase.is_some() { "phase" } else { "no phase" };
        print_line(&format!("  {}: {} circles, {phase}", camera.id, view.sightings.len()));
    }
    // Findings of heads that do not see the board at this position are of no use to the operator.
    let involved = |finding: &&Finding| {
        let head = nominal.heads.iter().position(|h| h.cameras.iter().any(|c| c.id == finding.camera));
        head.is_some_and(|head| position.views[nominal.cameras_of(head)].iter().any(Option::is_some))
    };
    findings.iter().filter(involved).for_each(|finding| print_line(&format!("  {finding}")));
    let usable = guide.add(position);
    let names = nominal.heads.iter().zip(&usable).filter(|(_, usable)| **usable);
    let names: Vec<&str> = names.map(|(head, _)| head.id.as_str()).collect();
    if names.is_empty() {
        guide.undo();
        return false;
    }
    print_line(&format!("  good for {}", names.join(", ")));
    true
}
