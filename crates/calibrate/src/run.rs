// SPDX-License-Identifier: MIT OR Apache-2.0
//! A whole calibration: judges the photographs, runs the three stages, and reports how well it went.

use super::advice::advice;
use super::board::Board;
use super::bundle::{Adjusted, DEVICE_PARAMETER_NAMES, Observation};
use super::findings::Finding;
use super::gamma::response;
use super::global::{Together, bring_together, calibration};
use super::observed::Position;
use super::placement::check_placement;
use super::rigging::{HeadResult, Rigging, StageError};
use super::rows::find_rows;
use super::views::look;
use super::world::Vertical;
use crate::base::ids::{CameraId, HeadId};
use crate::data::{
    CONVENTIONS, CalibratedHead, Calibration, CameraResiduals, DeviceUncertainty, Extent, FrameSource,
    HeadLink, HeadVolume, Identity, Quality, Response, ValidVolume, World,
};

/// A calibration and how it came to be: `calibrate` makes it, and the command prints, reports and drops it.
#[derive(Debug)]
pub struct Outcome {
    pub calibration: Calibration,
    /// What was left out, and why.
    pub findings: Vec<Finding>,
    /// The positions of the board.
    pub positions: Vec<Position>,
    /// Stages 1 and 2, per head.
    pub heads: Vec<HeadResult>,
    /// Stage 3: all heads in one frame.
    pub together: Together,
    /// Outer size of the board (x, y), m.
    pub board_size_m: [f64; 2],
}

/// Why there is no calibration.
#[derive(Debug, thiserror::Error)]
pub enum CalibrateError {
    /// The photographs cannot be read.
    #[error("{0}")]
    Source(String),
    /// A stage failed; with everything that was left out before.
    #[error("{error}{}", list(.findings))]
    Stage { error: StageError, findings: Vec<Finding> },
}

fn list(findings: &[Finding]) -> String {
    findings.iter().map(|finding| format!("\n  {finding}")).collect()
}

/// What the operator chooses for a calibration, beside the photographs.
#[derive(Debug, Clone, Default)]
pub struct Options {
    /// Leave out heads without photographs instead of refusing.
    pub partial: bool,
    /// Positions of the board in which it stood upright or lay level: they define the vertical.
    pub verticals: Vec<Vertical>,
}

/// Calibrates all heads of `nominal`; with `partial`, those that have photographs.
pub fn calibrate(
    source: &dyn FrameSource,
    nominal: &Calibration,
    board: &Board,
    options: &Options,
) -> Result<Outcome, CalibrateError> {
    let stated = source.statement();
    if let Some(stated) = &stated {
        let ids: Vec<CameraId> = stated.cameras.iter().map(|camera| camera.id.clone()).collect();
        nominal.fits(&ids, stated).map_err(CalibrateError::Source)?;
    }
    let (positions, findings) = look(source, nominal, board).map_err(CalibrateError::Source)?;
    let mut outcome = solve(positions, findings, nominal, board, options)?;
    if let (Some(identity), Some(stated)) = (&mut outcome.calibration.identity, stated) {
        let cameras = stated.cameras.into_iter().filter(|camera| !camera.device.is_empty());
        identity.cameras = cameras.map(|camera| (camera.id, camera.device)).collect();
    }
    Ok(outcome)
}

/// Calibrates from positions that `views::look` has found.
pub fn solve(
    positions: Vec<Position>,
    mut findings: Vec<Finding>,
    nominal: &Calibration,
    board: &Board,
    options: &Options,
) -> Result<Outcome, CalibrateError> {
    let all = Rigging { nominal, board, positions: &positions };
    let stage = |error, findings| CalibrateError::Stage { error, findings };
    if let Err(error) = check_placement(nominal, board, &positions) {
        return Err(stage(error, findings));
    }
    let mut heads = Vec::new();
    for head in 0..nominal.heads.len() {
        match all.calibrate_head(head) {
            Ok(result) => {
                findings.extend(result.findings.iter().cloned());
                heads.push(result);
            }
            Err(StageError::Positions { found: 0, .. }) if options.partial => {}
            Err(error) => return Err(stage(error, findings)),
        }
    }
    let used: Vec<usize> = heads.iter().map(|h| h.head).collect();
    if used.is_empty() {
        let head = nominal.heads.first().map_or(String::new(), |h| h.id.to_string());
        return Err(stage(StageError::Positions { head, found: 0 }, findings));
    }
    let together = match bring_together(&all, &heads, &options.verticals) {
        Ok(together) => together,
        Err(error) => return Err(stage(error, findings)),
    };
    let mut kept = nominal.clone();
    let mut place = 0..;
    kept.heads.retain(|_| place.next().is_some_and(|p| used.contains(&p)));
    let origin = format!("photographs of board {}", board.name);
    let mut result = calibration(&kept, origin, &together.all.model);
    let responses = responses(nominal, &positions, &used);
    result.quality = Some(Quality { responses, ..quality(&kept, board, &together) });
    result.identity = Some(Identity {
        rig_sha256: nominal.geometry_sha256(),
        board: board.name.clone(),
        board_sha256: board.sha256(),
        cameras: Vec::new(),
        software: concat!("fourdbody ", env!("CARGO_PKG_VERSION")).to_owned(),
        conventions: CONVENTIONS.to_owned(),
    });
    find_rows(&mut result, nominal, &heads, &positions);
    result.valid = ValidVolume::of(volumes(&kept, &together));
    Ok(Outcome { calibration: result, findings, positions, heads, together, board_size_m: board.size_m })
}

/// The measured response of each head's projector to panel values.
fn responses(nominal: &Calibration, positions: &[Position], used: &[usize]) -> Vec<(HeadId, Response)> {
    let of_head = |&place: &usize| {
        let cameras = nominal.cameras_of(place);
        let views = positions.iter().flat_map(|p| p.views[cameras.clone()].iter().flatten());
        let found = response(views.flat_map(|view| &view.light), &nominal.pattern)?;
        Some((nominal.heads[place].id.clone(), found))
    };
    used.iter().filter_map(of_head).collect()
}

/// The heads of a calibration, each with the number of its first device in the adjustment: cameras, then the projector.
pub(super) fn with_first_device(heads: &[CalibratedHead]) -> impl Iterator<Item = (&CalibratedHead, usize)> {
    heads.iter().scan(0, |next, head| {
        let first = *next;
        *next += head.cameras.len() + 1;
        Some((head, first))
    })
}

/// Boxes around the points whose phase each head measured.
fn volumes(kept: &Calibration, together: &Together) -> Vec<HeadVolume> {
    let volume = |(head, first): (&CalibratedHead, usize)| {
        let projector = first + head.cameras.len();
        let seen = together.observations.iter().zip(&together.all.outliers);
        let points = seen.filter(|(o, out)| o.device == projector && !**out).map(|(o, _)| {
            let point = together.all.model.boards[o.board] * o.point;
            [point.x, point.y, point.z]
        });
        Extent::around(points).map(|extent| HeadVolume { head: head.id.clone(), extent })
    };
    with_first_device(&kept.heads).filter_map(volume).collect()
}

fn quality(kept: &Calibration, board: &Board, together: &Together) -> Quality {
    let (mut cameras, mut projectors, mut uncertainties) = (Vec::new(), Vec::new(), Vec::new());
    for (head, first) in with_first_device(&kept.heads) {
        for (device, camera) in (first..).zip(&head.cameras) {
            cameras.push(CameraResiduals {
                camera: camera.id.clone(),
                positions: seen_positions(&together.observations, device),
                circles: together.observations.iter().filter(|o| o.device == device).count(),
                circles_rms_px: device_rms(together, device),
            });
            uncertainties.push(uncertainty(camera.id.to_string(), &together.all, device));
        }
        let projector = first + head.cameras.len();
        projectors.push((head.id.clone(), device_rms(together, projector)));
        uncertainties.push(uncertainty(format!("projector of {}", head.id), &together.all, projector));
    }
    Quality {
        board: board.name.clone(),
        cameras,
        projector_rms_px: projectors,
        links: together
            .links
            .iter()
            .map(|link| HeadLink { heads: link.heads, positions: link.positions, rms_mm: link.rms_m * 1e3 })
            .collect(),
        loop_error_mm: together.loop_error_m.map(|m| m * 1e3),
        uncertainties,
        responses: Vec::new(),
        world: Some(together.world.clone()),
    }
}

/// In how many positions a device saw the board.
pub(super) fn seen_positions(observations: &[Observation], device: usize) -> usize {
    let mut boards: Vec<usize> =
        observations.iter().filter(|o| o.device == device).map(|o| o.board).collect();
    boards.sort_unstable();
    boards.dedup();
    boards.len()
}

/// RMS of a device's residuals per coordinate, px, without what was left out; 0 of none.
fn device_rms(together: &Together, device: usize) -> f64 {
    let all = &together.all;
    let kept = all.residuals.iter().zip(&together.observations).zip(&all.outliers);
    let mine = kept.filter(|((_, o), out)| o.device == device && !**out).map(|(pair, _)| pair);
    let coordinates = mine.flat_map(|(r, o)| r[..if o.columns_only { 1 } else { 2 }].iter());
    let (sum, n) = coordinates.fold((0.0, 0.0), |(sum, n), x| (sum + x * x, n + 1.0));
    if n > 0.0 { f64::sqrt(sum / n) } else { 0.0 }
}

fn uncertainty(device: String, adjusted: &Adjusted, number: usize) -> DeviceUncertainty {
    let values = DEVICE_PARAMETER_NAMES.iter().zip(adjusted.device_sigma[number]);
    DeviceUncertainty { device, sigma: values.map(|(name, sigma)| ((*name).to_owned(), sigma)).collect() }
}

impl Outcome {
    /// The result in lines that the command prints.
    pub fn lines(&self) -> Vec<String> {
        let mut lines = vec![format!("{} positions of the board", self.positions.len())];
        let Some(quality) = &self.calibration.quality else { return lines };
        lines.extend(quality.cameras.iter().map(
            |CameraResiduals { camera, positions, circles, circles_rms_px }| {
                format!("  {camera}: {circles} circles in {positions} positions, {circles_rms_px:.4} px rms")
            },
        ));
        let projectors = quality.projector_rms_px.iter();
        lines.extend(projectors.map(|(head, rms)| format!("  projector of {head}: {rms:.4} panel px rms")));
        lines.extend(self.calibration.heads.iter().map(|head| match head.rows {
            Some(rows) => {
                format!("  rows of {}'s panel, by the marker's dashes: {:.4} px rms", head.id, rows.rms_px)
            }
            None => format!(
                "  rows of {}'s panel: too few of the marker's dashes agree; no photograph will be checked by its dashes",
                head.id
            ),
        }));
        lines.extend(quality.links.iter().map(|HeadLink { heads: [a, b], positions, rms_mm }| {
            format!("  heads {a} and {b}: {positions} common positions, {rms_mm:.3} mm rms")
        }));
        lines.extend(quality.responses.iter().map(|(head, r)| {
            format!(
                "  projector of {head}: gamma {:.3} +- {:.3}, harmonics {:.2} % and {:.2} %",
                r.gamma,
                r.sigma,
                100.0 * r.second_harmonic,
                100.0 * r.third_harmonic
            )
        }));
        lines.extend(quality.loop_error_mm.map(|mm| format!("  around all heads: {mm:.3} mm")));
        lines.extend(quality.world.iter().map(World::line));
        lines.extend(self.findings.iter().map(|finding| format!("  {finding}")));
        lines.extend(advice(self).into_iter().map(|advice| format!("  advice: {advice}")));
        lines
    }
}
