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

/// How the captures are made.
pub struct Live {
    /// The nodes.
    pub nodes: Vec<Box<dyn Participant>>,
    /// Sessions are named BASE-p001 and so on.
    pub base: String,
    /// Triggers per position: white first, then fringes.
    pub triggers: u64,
}

/// Asks for positions until everything is there or the operator ends it; gives their frames as one source.
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
    say(
        "Every position takes one white frame and one with fringes. Enter: capture; u: undo the last one; q: enough.",
    );
    while let Some(request) = guide.next() {
        say(&format!("[{}] {}", guide.progress().join(", "), guide.words(request)));
        let mut line = String::new();
        let read = input.read_line(&mut line).map_err(|e| Failure::new(Exit::Failure, e))?;
        match line.trim() {
            "q" => break,
            _ if read == 0 => break,
            "u" if !joined.is_empty() => {
                guide.undo();
                joined.pop();
                say("forgot the last position; its session stays on the disks");
                continue;
            }
            "" => {}
            other => {
                say(&format!("expected Enter, u or q, found {other:?}"));
                continue;
            }
        }
        number += 1;
        // What was captured before is worth too much to be lost with one session that fails.
        let parts = match one_session(live, number, &cameras, &control) {
            Ok(parts) => parts,
            Err(failure) => {
                say(&format!("this position does not count: {}", failure.message));
                say("press Enter to try again");
                failed = Some(failure);
                continue;
            }
        };
        let mut alone = Joined::default();
        alone.push(parts);
        let looked = views::look(&alone, nominal, board).map_err(|e| Failure::new(Exit::Failure, e))?;
        let usable = tell(&looked, nominal, &mut guide);
        match usable {
            true => joined.push(alone.into_parts()),
            false => say("this position is not usable and does not count; put it right and press Enter"),
        }
    }
    if joined.is_empty() {
        return Err(failed.unwrap_or_else(|| {
            Failure::new(Exit::Usage, "no usable position was captured; nothing to calibrate from")
        }));
    }
    say(&format!("{} positions, {} sessions taken", joined.len(), number));
    Ok(joined)
}

fn say(line: &str) {
    // Standard output has the result; the conversation goes beside it.
    eprintln!("{line}");
}

/// Captures one position and opens its recordings.
fn one_session(
    live: &Live,
    number: usize,
    cameras: &[CameraId],
    control: &Control,
) -> Result<Vec<Box<dyn FrameSource>>, Failure> {
    let wish = CaptureRequest {
        triggers: Some(live.triggers),
        name: Some(format!("{}-p{number:03}", live.base)),
        note: Some("calibration, one position of the board".to_owned()),
        ..CaptureRequest::default()
    };
    let captured = capture(&live.nodes, &wish, control, |_| ())?;
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

/// Says what the last position gave; whether it counts.
fn tell(
    (positions, findings): &(Vec<Position>, Vec<Finding>),
    nominal: &Calibration,
    guide: &mut Guide<'_>,
) -> bool {
    let Some(position) = positions.iter().max_by_key(|p| p.views.iter().flatten().count()) else {
        say("no white frame shows anything: is the light on, is the pattern sequence running?");
        return false;
    };
    for ((_, camera), view) in nominal.cameras().zip(&position.views) {
        let Some(view) = view else { continue };
        let phase = if view.phase.is_some() { "phase" } else { "no phase" };
        say(&format!("  {}: {} circles, {phase}", camera.id, view.sightings.len()));
    }
    // A camera that cannot see the board has nothing to complain about while another head is being served.
    let involved = |finding: &&Finding| {
        let head = nominal.heads.iter().position(|h| h.cameras.iter().any(|c| c.id == finding.camera));
        head.is_some_and(|head| position.views[nominal.cameras_of(head)].iter().any(Option::is_some))
    };
    findings.iter().filter(involved).for_each(|finding| say(&format!("  {finding}")));
    let usable = guide.add(position);
    let names = nominal.heads.iter().zip(&usable).filter(|(_, usable)| **usable);
    let names: Vec<&str> = names.map(|(head, _)| head.id.as_str()).collect();
    if names.is_empty() {
        guide.undo();
        return false;
    }
    say(&format!("  good for {}", names.join(", ")));
    true
}
