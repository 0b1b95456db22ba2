// SPDX-License-Identifier: MIT OR Apache-2.0
//! Which position of the board comes next: leads an operator through a calibration. It knows neither cameras nor nodes,
//! only what each position gave.

use super::board::Board;
use super::observed::Position;
use super::start::{board_pose, is_same_position};
use crate::data::Calibration;
use nalgebra::{Isometry3, Vector3};

/// Positions that every head needs.
const POSITIONS: usize = 8;
/// Positions that neighbouring heads need in common.
const COMMON: usize = 2;
/// A board counts as turned or tilted to a side from here on, degrees.
const TILTED_DEG: f64 = 12.0;

/// How the board should stand before a head.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Stand {
    Facing,
    /// Its face turned to the right, as seen from the head.
    Right,
    Left,
    Up,
    Down,
    /// In any way that no earlier position had.
    Other,
}

impl Stand {
    const ALL: [Self; 5] = [Self::Facing, Self::Right, Self::Left, Self::Up, Self::Down];

    fn words(self) -> &'static str {
        match self {
            Self::Facing => "facing the head",
            Self::Right => "turned by 20 degrees to the right, as seen from the head",
            Self::Left => "turned by 20 degrees to the left, as seen from the head",
            Self::Up => "tilted upwards by 15 degrees",
            Self::Down => "tilted downwards by 15 degrees",
            Self::Other => {
                "nearer or farther, or turned about its own middle: any way that no earlier position had"
            }
        }
    }
}

/// The next position that the operator is led to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Request {
    /// The board before one head (its place in the rig).
    Head(usize, Stand),
    /// The board between two heads, so that both see it.
    Between(usize, usize),
}

/// How far a guided calibration is. The command makes it, adds each position it captured, and drops it at the end.
pub struct Guide<'a> {
    nominal: &'a Calibration,
    board: &'a Board,
    /// By position done: for each head, where the board was (world), where it was usable.
    done: Vec<Vec<Option<Isometry3<f64>>>>,
}

impl<'a> Guide<'a> {
    /// A calibration without any position yet.
    pub fn new(nominal: &'a Calibration, board: &'a Board) -> Self {
        Self { nominal, board, done: Vec::new() }
    }

    /// Counts a position; returns for each head whether it was usable.
    pub fn add(&mut self, position: &Position) -> Vec<bool> {
        let mut seen = Vec::new();
        for (place, head) in self.nominal.heads.iter().enumerate() {
            let views = &position.views[self.nominal.cameras_of(place)];
            let whole = views.iter().flatten().filter(|view| view.phase.is_some()).count() == views.len()
                && views.iter().flatten().any(|view| view.phase.as_ref().is_some_and(|phase| phase.marker));
            let pose = views.first().and_then(|view| view.as_ref()).and_then(|view| {
                let device = &head.cameras[0].device;
                let pose = board_pose(self.board, &view.sightings, &device.lens)?;
                Some(device.world_from_device.isometry() * pose)
            });
            seen.push(pose.filter(|_| whole));
        }
        let usable = seen.iter().map(Option::is_some).collect();
        self.done.push(seen);
        usable
    }

    /// Takes the last position away again.
    pub fn undo(&mut self) {
        self.done.pop();
    }

    /// What comes next: first positions before each head, then common ones of neighbours. `None` when all is there.
    pub fn next(&self) -> Option<Request> {
        let heads = self.nominal.heads.len();
        let before = |head: usize| {
            let positions = self.positions(head);
            let stands: Vec<Stand> = positions.iter().map(|pose| self.stand(head, pose)).collect();
            let missing = Stand::ALL.into_iter().find(|stand| !stands.contains(stand));
            let more = (positions.len() < POSITIONS).then_some(Stand::Other);
            missing.or(more).map(|stand| Request::Head(head, stand))
        };
        let pairs = if heads > 2 { heads } else { heads.saturating_sub(1) };
        let mut neighbours = (0..pairs).map(|a| (a, (a + 1) % heads));
        let mut between = || neighbours.find(|&(a, b)| self.common(a, b) < COMMON);
        (0..heads).find_map(before).or_else(|| between().map(|(a, b)| Request::Between(a, b)))
    }

    /// The board's positions before a head that differ from each other.
    fn positions(&self, head: usize) -> Vec<&Isometry3<f64>> {
        let mut distinct: Vec<&Isometry3<f64>> = Vec::new();
        for pose in self.done.iter().filter_map(|seen| seen[head].as_ref()) {
            if !distinct.iter().any(|other| is_same_position(other, pose)) {
                distinct.push(pose);
            }
        }
        distinct
    }

    fn common(&self, a: usize, b: usize) -> usize {
        self.done.iter().filter(|seen| seen[a].is_some() && seen[b].is_some()).count()
    }

    /// How a board stands before a head; the larger of turn and tilt counts.
    fn stand(&self, head: usize, world_from_board: &Isometry3<f64>) -> Stand {
        let normal = world_from_board.rotation * Vector3::z();
        let back = self.nominal.heads[head].projector.centre().coords - world_from_board.translation.vector;
        let level = Vector3::new(back.x, back.y, 0.0).normalize();
        // To the right as seen from the head: away from it, turned by a quarter clockwise as seen from above.
        let right = (-level).cross(&Vector3::z());
        let degrees = |share: f64| share.clamp(-1.0, 1.0).asin().to_degrees();
        let (turn, tilt) = (degrees(normal.dot(&right)), degrees(normal.z));
        let most = turn.abs().max(tilt.abs());
        if most < TILTED_DEG / 2.0 {
            Stand::Facing
        } else if most < TILTED_DEG {
            Stand::Other
        } else if turn.abs() >= tilt.abs() {
            if turn > 0.0 { Stand::Right } else { Stand::Left }
        } else if tilt > 0.0 {
            Stand::Up
        } else {
            Stand::Down
        }
    }

    /// The request as a sentence for the operator.
    pub fn words(&self, request: Request) -> String {
        let name = |head: usize| &self.nominal.heads[head].id;
        match request {
            Request::Head(head, stand) => format!(
                "head {}: {} of {POSITIONS} positions. Put the board before it, {}",
                name(head),
                self.positions(head).len(),
                stand.words()
            ),
            Request::Between(a, b) => format!(
                "heads {} and {}: {} of {COMMON} common positions. Put the board into the middle, facing between the two, so that both see it",
                name(a),
                name(b),
                self.common(a, b)
            ),
        }
    }

    /// How far every head is.
    pub fn progress(&self) -> Vec<String> {
        let heads = self.nominal.heads.iter().enumerate();
        heads.map(|(i, head)| format!("{} {}/{POSITIONS}", head.id, self.positions(i).len())).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::{Guide, Request, Stand};
    use crate::board::Board;
    use crate::config::Rig;
    use crate::data::Calibration;
    use nalgebra::{Isometry3, UnitQuaternion, Vector3};
    use std::path::Path;

    /// A board in the middle whose face looks to the azimuth (from +x towards +y) and upwards by the tilt.
    fn board_at(azimuth_deg: f64, tilt_deg: f64, distance_m: f64) -> Isometry3<f64> {
        let upright =
            UnitQuaternion::from_euler_angles(std::f64::consts::FRAC_PI_2, 0.0, std::f64::consts::FRAC_PI_2);
        let turn = |axis: Vector3<f64>, d: f64| UnitQuaternion::from_scaled_axis(axis * d.to_radians());
        let rotation = turn(Vector3::z(), azimuth_deg) * upright * turn(-Vector3::x(), tilt_deg);
        Isometry3::from_parts(Vector3::new(distance_m, 0.0, 1.0).into(), rotation)
    }

    #[test]
    fn an_operator_who_obeys_comes_to_an_end() {
        let config = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config");
        let nominal = Calibration::nominal(&Rig::load(&config.join("rig.toml")).expect("valid"));
        let board = Board::load(&config.join("board.toml")).expect("valid");
        let mut guide = Guide::new(&nominal, &board);
        let mut steps = 0;
        while let Some(request) = guide.next() {
            assert!(!guide.words(request).is_empty());
            let mut seen = vec![None; 4];
            match request {
                Request::Head(head, stand) => {
                    // Looking from +x along -x, +y is to the right.
                    let (turn, tilt) = match stand {
                        Stand::Facing => (0.0, 0.0),
                        Stand::Right => (20.0, 0.0),
                        Stand::Left => (-20.0, 0.0),
                        Stand::Up => (0.0, 15.0),
                        Stand::Down => (0.0, -15.0),
                        Stand::Other => (1.0, 1.0),
                    };
                    let around =
                        UnitQuaternion::from_scaled_axis(Vector3::z() * (90.0 * head as f64).to_radians());
                    seen[head] = Some(around * board_at(turn, tilt, 0.05 * f64::from(steps)));
                }
                Request::Between(a, b) => {
                    (seen[a], seen[b]) = (Some(Isometry3::identity()), Some(Isometry3::identity()));
                }
            }
            guide.done.push(seen);
            steps += 1;
            assert!(steps < 60, "asks for the same for ever: {request:?}");
        }
        assert_eq!(steps, 4 * 8 + 4 * 2);
        guide.undo();
        assert_eq!(guide.next(), Some(Request::Between(3, 0)));
    }
}
