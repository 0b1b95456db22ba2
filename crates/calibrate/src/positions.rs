// SPDX-License-Identifier: MIT OR Apache-2.0
//! Brings the frames of each position of the board together: a white frame, and the frame with fringes that shows the
//! same circles at the same places. Which white frame that is, is decided by the circles, not by the order alone.

use super::board::Board;
use super::findings::{Finding, Kind, Refusal};
use super::gamma::light_samples;
use super::lattice::Sighting;
use super::marker_check::marker_is_there;
use super::observed::{DARK, Looked, Phase, Position, View};
use super::rows::ridge;
use super::start::board_pose;

use crate::base::ids::{CameraId, TriggerIndex};
use crate::base::image::Plane;
use crate::data::Calibration;
use crate::geometry::Device;
use crate::geometry::pattern::Pattern;
use crate::reconstruct::triangulate::camera_projector::CameraProjector;
use nalgebra::Point3;
use std::collections::{BTreeMap, BTreeSet};
use std::f64::consts::TAU;

/// Share of the circles that must be dark in the frame with fringes, where they were in the white one.
const SAME_PLACE: f64 = 0.5;
/// Fewest lit circles to judge by.
const LEAST_TO_JUDGE: usize = 15;
/// Share of the circles that should be seen below which something stands in front of the board.
const SEEN: f64 = 0.85;
/// Circles this near to the edge of the light or of the image need not be seen, as a share of its sides.
const EDGE: f64 = 0.06;

/// Positions from what every camera saw at every trigger, and what was wrong. `frames`: trigger, camera by its place in
/// the calibration, what it shows; sorted by trigger.
pub fn arrange(
    frames: Vec<(TriggerIndex, usize, Looked)>,
    nominal: &Calibration,
    board: &Board,
) -> (Vec<Position>, Vec<Finding>) {
    let ids: Vec<CameraId> = nominal.cameras().map(|(_, camera)| camera.id.clone()).collect();
    let mut findings = missing(&frames, &ids);
    let mut whites: Vec<TriggerIndex> =
        frames.iter().filter(|(.., l)| matches!(l, Looked::White(_))).map(|(t, ..)| *t).collect();
    whites.dedup();
    let empty = |white: &TriggerIndex| Position {
        white: *white,
        fringes: None,
        views: (0..ids.len()).map(|_| None).collect(),
    };
    let mut positions: Vec<Position> = whites.iter().map(empty).collect();
    let (mut fringes, mut dark) = (Vec::new(), Vec::new());
    for (trigger, camera, looked) in frames {
        match looked {
            Looked::Missing(_) => {}
            Looked::Dark => dark.push((trigger, camera)),
            Looked::Fringes { image, phase } => fringes.push((trigger, camera, image, phase)),
            Looked::White(view) => {
                let Ok(place) = whites.binary_search(&trigger) else { continue };
                match view {
                    Ok(view) => positions[place].views[camera] = Some(view),
                    Err(Refusal { kind, message }) => {
                        findings.push(Finding::left_out(&ids[camera], trigger, Some(place), kind, message));
                    }
                }
            }
        }
    }
    findings.extend(hidden(&positions, nominal, board));
    let pairs: Vec<Option<CameraProjector>> =
        nominal.cameras().map(|(head, camera)| CameraProjector::new(head, camera, nominal).ok()).collect();
    for (trigger, camera, image, phase) in fringes {
        let of = Owner { id: &ids[camera], camera, trigger, pair: pairs[camera].as_ref() };
        findings.extend(pair_up(&mut positions, board, &nominal.pattern, of, &image, phase));
    }
    // One line for each view, however many dark frames there are.
    let mut named = BTreeSet::new();
    let dark = dark.into_iter().filter_map(|(t, camera)| dark_fringes(&positions, &ids[camera], camera, t));
    findings.extend(dark.filter(|found| named.insert((found.camera.clone(), found.position))));
    let views = positions.iter_mut().flat_map(|p| &mut p.views).flatten();
    views.for_each(|view| view.white = None);
    findings.sort_by_key(|f| (f.trigger.is_none(), f.trigger));
    (positions, findings)
}

/// A dark frame after the white one of a view that has no fringes.
fn dark_fringes(
    positions: &[Position],
    id: &CameraId,
    camera: usize,
    trigger: TriggerIndex,
) -> Option<Finding> {
    let place = positions.partition_point(|p| p.white < trigger).checked_sub(1)?;
    let lacks = positions[place].views[camera].as_ref().is_some_and(|view| view.phase.is_none());
    let message = "the frame with fringes is dark, but the white frame shows the board. Expose longer, or check the projector";
    lacks.then(|| Finding::left_out(id, trigger, Some(place), Kind::TooDark, message))
}

/// One line for every camera that lacks frames.
fn missing(frames: &[(TriggerIndex, usize, Looked)], ids: &[CameraId]) -> Vec<Finding> {
    let mut causes: BTreeMap<usize, BTreeMap<&str, usize>> = BTreeMap::new();
    for (_, camera, looked) in frames {
        if let Looked::Missing(cause) = looked {
            *causes.entry(*camera).or_default().entry(cause).or_default() += 1;
        }
    }
    let line = |(camera, causes): (usize, BTreeMap<&str, usize>)| {
        let count: usize = causes.values().sum();
        let all = frames.iter().filter(|(_, c, _)| *c == camera).count();
        let causes: Vec<String> = causes.iter().map(|(cause, n)| format!("{n} x {cause}")).collect();
        Finding {
            camera: ids[camera].clone(),
            trigger: None,
            position: None,
            kind: Kind::NoFrames,
            left_out: true,
            message: format!("no frame at {count} of {all} triggers ({})", causes.join(", ")),
        }
    };
    causes.into_iter().map(line).collect()
}

/// How many circles are where they should be in a frame with fringes.
struct Confirmed {
    circles: Vec<bool>,
    dark: usize,
    lit: usize,
}

impl Confirmed {
    fn is_same_place(&self) -> bool {
        self.lit >= LEAST_TO_JUDGE && self.dark as f64 >= SAME_PLACE * self.lit as f64
    }

    fn has_holes(&self) -> bool {
        (self.dark as f64) < SEEN * self.lit as f64
    }
}

/// Looks for the circles of a view in a frame with fringes. A circle is there when it is dark all over while its
/// surroundings are lit: elsewhere, some of the samples would lie on bright fringes.
fn confirm(view: &View, image: &Plane<u8>, board: &Board) -> Confirmed {
    let mut confirmed = Confirmed { circles: vec![false; board.circles().len()], dark: 0, lit: 0 };
    for sighting in &view.sightings {
        let Some(around) = lightest(sighting, image, 1.5) else { continue };
        if around < f64::from(DARK) {
            continue;
        }
        confirmed.lit += 1;
        if lightest(sighting, image, 0.6).is_some_and(|inside| inside < 0.5 * around) {
            confirmed.dark += 1;
            confirmed.circles[sighting.circle] = true;
        }
    }
    confirmed
}

/// The lightest level on the outline of a circle that is `scale` times as large; `None` where that leaves the image.
fn lightest(sighting: &Sighting, image: &Plane<u8>, scale: f64) -> Option<f64> {
    const SAMPLES: usize = 48;
    let ellipse = &sighting.spot.ellipse;
    let mut most: f64 = 0.0;
    for i in 0..SAMPLES {
        let [u, v] = ellipse.at(i as f64 * TAU / SAMPLES as f64);
        let u = (ellipse.centre[0] + scale * (u - ellipse.centre[0])).round();
        let v = (ellipse.centre[1] + scale * (v - ellipse.centre[1])).round();
        if !(u >= 0.0 && v >= 0.0 && (u as usize) < image.width() && (v as usize) < image.height()) {
            return None;
        }
        most = most.max(f64::from(image.at(u as usize, v as usize)));
    }
    Some(most)
}

/// Whose frame it is: a camera, also by its place in the calibration, at a trigger.
struct Owner<'a> {
    id: &'a CameraId,
    camera: usize,
    trigger: TriggerIndex,
    pair: Option<&'a CameraProjector>,
}

/// Gives a frame with fringes to the white frame that shows the board at the same place.
fn pair_up(
    positions: &mut [Position],
    board: &Board,
    pattern: &Pattern,
    Owner { id, camera, trigger, pair }: Owner<'_>,
    image: &Plane<u8>,
    phase: Result<Phase, Refusal>,
) -> Vec<Finding> {
    let after = positions.partition_point(|p| p.white < trigger);
    let finding = |place, kind, message: &str| Finding::left_out(id, trigger, place, kind, message);
    let judge = |place: Option<usize>| {
        let place = place.filter(|p| *p < positions.len())?;
        let view = positions[place].views[camera].as_ref()?;
        Some((place, confirm(view, image, board)))
    };
    let (first, second) = (judge(after.checked_sub(1)), judge(Some(after)));
    // Whatever cannot be paired belongs to the white frame before it, where there is one.
    let seen = if after > 0 { first.as_ref() } else { second.as_ref() };
    let seen = seen.map(|(place, c)| (*place, c.dark, c.lit));
    let found = [first, second].into_iter().flatten().find(|(_, confirmed)| confirmed.is_same_place());
    let Some((place, confirmed)) = found else {
        return vec![match seen {
            Some((place, _, lit)) if lit < LEAST_TO_JUDGE => {
                let message = format!(
                    "only {lit} circles of the white frame are lit by the fringes, expected at least {LEAST_TO_JUDGE}: too dark, or the projector does not reach the board there. Expose longer"
                );
                finding(Some(place), Kind::TooDark, &message)
            }
            Some((place, dark, lit)) => {
                let message = format!(
                    "only {dark} of {lit} circles of the white frame are at the same place in the fringes: the board moved between the two, or something stands before it. Hold it still, white first, then fringes"
                );
                finding(Some(place), Kind::Moved, &message)
            }
            None => {
                let message = "fringes without a usable white frame of the same position";
                finding(after.checked_sub(1), Kind::Unpaired, message)
            }
        }];
    };
    let mut phase = match phase {
        Ok(phase) => phase,
        Err(Refusal { kind, message }) => return vec![finding(Some(place), kind, &message)],
    };
    let position = &mut positions[place];
    let swapped = position.white > trigger;
    let Some(view) = position.views[camera].as_mut().filter(|view| view.phase.is_none()) else {
        // A second frame with fringes of the same position adds little.
        return Vec::new();
    };
    let (dark, lit, has_holes) = (confirmed.dark, confirmed.lit, confirmed.has_holes());
    if let Some(white) = view.white.take() {
        view.light = light_samples(view, &white, image, &phase.plane, &confirmed.circles, board, pattern);
    }
    // The pipeline may have taken circles for the marker's dashes.
    let pair = pair.filter(|pair| phase.marker && marker_is_there(view, image, &phase.plane, pair));
    if let Some(pair) = pair {
        view.ridge = ridge(view, image, &phase.plane, pair);
    }
    let marker = pair.is_some();
    phase.marker = marker;
    view.phase = Some(phase);
    view.confirmed = confirmed.circles;
    position.fringes = Some(trigger);
    let used = |kind, message: &str| finding(Some(place), kind, message).used();
    let mut findings = Vec::new();
    if swapped {
        let message = "the fringes came before the white frame of their position, expected white first; paired by the circles";
        findings.push(used(Kind::OrderSwapped, message));
    }
    if has_holes {
        let message = format!(
            "only {dark} of {lit} circles of the white frame are seen in the fringes: is something in front of the board?"
        );
        findings.push(used(Kind::Hidden, &message));
    } else if !marker {
        let message = "no marker in the fringes: the board gives their order. Is it the rig's pattern (`fourdbody pattern`), and does the marker fall on the board?";
        findings.push(used(Kind::NoMarker, message));
    }
    findings
}

/// Views that lack circles which lie in the image and in the light.
fn hidden(positions: &[Position], nominal: &Calibration, board: &Board) -> Vec<Finding> {
    let mut findings = Vec::new();
    for (place, position) in positions.iter().enumerate() {
        for ((head, camera), view) in nominal.cameras().zip(&position.views) {
            let Some(view) = view else { continue };
            let expected = expected_circles(view, &camera.device, &head.projector, board);
            let found =
                view.sightings.iter().filter(|s| expected.get(s.circle).is_some_and(|is| *is)).count();
            let all = expected.iter().filter(|is| **is).count();
            if (found as f64) < SEEN * all as f64 {
                let message = format!(
                    "{} of {all} circles that lie in image and light are not seen: is something in front of the board?",
                    all - found
                );
                let hidden =
                    Finding::left_out(&camera.id, position.white, Some(place), Kind::Hidden, message);
                findings.push(hidden.used());
            }
        }
    }
    findings
}

/// By circle of the board, whether it lies well inside the image and the light of the projector.
fn expected_circles(view: &View, camera: &Device, projector: &Device, board: &Board) -> Vec<bool> {
    let Some(pose) = board_pose(board, &view.sightings, &camera.lens) else {
        return vec![false; board.circles().len()];
    };
    let inside = |[u, v]: [f64; 2], device: &Device| {
        let (w, h) = (device.width as f64, device.height as f64);
        (EDGE * w..(1.0 - EDGE) * w).contains(&u) && (EDGE * h..(1.0 - EDGE) * h).contains(&v)
    };
    let expected = |centre: Point3<f64>| {
        let p = pose * centre;
        let pixel = (p.z > 0.0).then(|| camera.lens.distort(p.x / p.z, p.y / p.z)).flatten();
        let panel = projector.project(&(camera.world_from_device.isometry() * p));
        pixel.is_some_and(|p| inside(p, camera)) && panel.is_some_and(|p| inside(p, projector))
    };
    board.circles().iter().map(|circle| expected(Point3::from(circle.centre_m))).collect()
}
