// SPDX-License-Identifier: MIT OR Apache-2.0
//! Identifies the circles that were found: grows their grid from neighbour to neighbour, then turns and shifts the grid
//! until the larger circles fall on the board's larger circles.
//!
//! Partial views, holes and stray circles are expected. A view that fits in no way, in more than one, or only
//! mirrored is refused with the reason.

use super::board::{Board, turned};
use super::estimate::median;
use super::findings::{Kind, Refusal};
use super::spots::Spot;
use std::collections::{BTreeMap, VecDeque};

/// A circle of the board that was found in the image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sighting {
    /// Its number in the list [`Board::circles`].
    pub circle: usize,
    pub spot: Spot,
}

/// Fewest circles of a grid that can be identified.
const LEAST: usize = 20;
/// Largest distance of a neighbour from where it is expected, as a share of the step to it.
const TOLERANCE: f64 = 0.3;
/// Circles whose size may be judged wrongly (hidden edges, dirt) before a place is no match.
const MISJUDGED: usize = 1;

/// The circles with their places on the board, or why the image shows no usable board.
pub fn identify(spots: &[Spot], board: &Board) -> Result<Vec<Sighting>, Refusal> {
    let places = grow(spots);
    if places.len() < LEAST {
        let message = format!(
            "{} circles of a grid, expected at least {LEAST}: is the board in view, lit and sharp?",
            places.len()
        );
        return Err(Refusal::new(Kind::NoBoard, message));
    }
    let large = large_ones(spots, &places, board);
    let fits = fits(&places, &large, board);
    let Some(best) = fits.iter().map(|fit| fit.wrong).min() else {
        let message = format!(
            "the larger circles do not lie as in the board file ({} of {} circles are large): another board, or the code is hidden",
            large.iter().filter(|is| **is).count(),
            places.len()
        );
        return Err(Refusal::new(Kind::WrongBoard, message));
    };
    // The more sizes the best fit judges wrongly, the larger its lead over the next one must be.
    let ahead = MISJUDGED.max(best.saturating_sub(1));
    let rivals: Vec<&Fit> = fits.iter().filter(|fit| fit.wrong <= best + ahead).collect();
    match rivals.as_slice() {
        [one] if one.turn >= 4 => Err(Refusal::new(
            Kind::Mirrored,
            "the board is seen mirrored: is the image flipped, or are rows and columns swapped in the board file?",
        )),
        [one] => Ok(places
            .iter()
            .filter_map(|(place, &spot)| {
                let [column, row] = one.place(*place);
                let circle = board.number(usize::try_from(column).ok()?, usize::try_from(row).ok()?);
                Some(Sighting { circle, spot: spots[spot] })
            })
            .collect()),
        _ => Err(Refusal::new(
            Kind::Ambiguous,
            format!(
                "the visible larger circles fit {} places on the board: show more of the code",
                rivals.len()
            ),
        )),
    }
}

type Places = BTreeMap<[i64; 2], usize>;

/// Gives the circles of the largest connected grid their places, from an arbitrary origin.
fn grow(spots: &[Spot]) -> Places {
    let mut best = Places::new();
    let mut used = vec![false; spots.len()];
    // The middle first; a stray region may take the first seed.
    for seed in seeds(spots) {
        if used[seed] {
            continue;
        }
        let grown = grow_from(spots, seed);
        grown.values().for_each(|&spot| used[spot] = true);
        if grown.len() > best.len() {
            best = grown;
        }
        if best.len() * 2 > spots.len() {
            break;
        }
    }
    best
}

fn seeds(spots: &[Spot]) -> Vec<usize> {
    let n = spots.len().max(1) as f64;
    let mean = |axis: usize| spots.iter().map(|s| s.ellipse.centre[axis]).sum::<f64>() / n;
    let middle = [mean(0), mean(1)];
    let mut order: Vec<usize> = (0..spots.len()).collect();
    order.sort_by(|a, b| {
        squared(spots[*a].ellipse.centre, middle).total_cmp(&squared(spots[*b].ellipse.centre, middle))
    });
    order
}

fn grow_from(spots: &[Spot], seed: usize) -> Places {
    let Some(steps) = first_steps(spots, seed) else { return Places::new() };
    let mut places = Places::from([([0, 0], seed)]);
    let mut taken = vec![false; spots.len()];
    taken[seed] = true;
    // A circle, its place, and the steps to its neighbours along both axes.
    let mut queue = VecDeque::from([(seed, [0i64, 0i64], steps)]);
    while let Some((spot, place, steps)) = queue.pop_front() {
        let from = spots[spot].ellipse.centre;
        for (axis, sign) in [(0, 1.0), (0, -1.0), (1, 1.0), (1, -1.0)] {
            let mut next = place;
            next[axis] += sign as i64;
            if places.contains_key(&next) {
                continue;
            }
            let step = steps[axis].map(|x| x * sign);
            let Some(neighbour) = nearest(spots, [from[0] + step[0], from[1] + step[1]], step) else {
                continue;
            };
            if std::mem::replace(&mut taken[neighbour], true) {
                continue;
            }
            places.insert(next, neighbour);
            let to = spots[neighbour].ellipse.centre;
            let mut steps = steps;
            steps[axis] = [(to[0] - from[0]) * sign, (to[1] - from[1]) * sign];
            queue.push_back((neighbour, next, steps));
        }
    }
    places
}

/// The two shortest ways to neighbours that are not parallel, oriented as x and y of a board that is seen from the
/// front (v runs downwards).
fn first_steps(spots: &[Spot], seed: usize) -> Option<[[f64; 2]; 2]> {
    let from = spots[seed].ellipse.centre;
    let mut steps: Vec<[f64; 2]> = (0..spots.len())
        .filter(|other| *other != seed)
        .map(|other| [spots[other].ellipse.centre[0] - from[0], spots[other].ellipse.centre[1] - from[1]])
        .collect();
    steps.sort_by(|a, b| squared(*a, [0.0; 2]).total_cmp(&squared(*b, [0.0; 2])));
    let first = *steps.first()?;
    let length = |s: [f64; 2]| squared(s, [0.0; 2]).sqrt();
    let second = steps.into_iter().take(8).find(|s| {
        let sine = (first[0] * s[1] - first[1] * s[0]).abs() / (length(first) * length(*s));
        sine > 0.6
    })?;
    // Rows to the left of columns, as y is to the left of x on the board: a camera in front sees them so.
    let cross = first[0] * second[1] - first[1] * second[0];
    Some([first, if cross < 0.0 { second } else { second.map(|x| -x) }])
}

fn nearest(spots: &[Spot], place: [f64; 2], step: [f64; 2]) -> Option<usize> {
    let found = (0..spots.len()).min_by(|a, b| {
        squared(spots[*a].ellipse.centre, place).total_cmp(&squared(spots[*b].ellipse.centre, place))
    })?;
    let limit = TOLERANCE * TOLERANCE * squared(step, [0.0; 2]);
    (squared(spots[found].ellipse.centre, place) < limit).then_some(found)
}

fn squared(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).powi(2) + (a[1] - b[1]).powi(2)
}

/// Which circles are large, judged against the median of those around them, in the order of `places`.
fn large_ones(spots: &[Spot], places: &Places, board: &Board) -> Vec<bool> {
    let radius = |large: bool| board.circles().iter().find(|c| c.large == large).map_or(1.0, |c| c.radius_m);
    let limit = (radius(true) / radius(false)).sqrt();
    let is_large = |(place, &spot): (&[i64; 2], &usize)| {
        let around = (-2..=2).flat_map(|y| (-2..=2).map(move |x| [place[0] + x, place[1] + y]));
        let radii = around.filter_map(|p| places.get(&p)).map(|&other| spots[other].ellipse.radius());
        spots[spot].ellipse.radius() > limit * median(radii)
    };
    places.iter().map(is_large).collect()
}

/// Seen at a slant, the shortest steps from a circle may lead along a row and along a diagonal. These shears undo that:
/// multiples of y that are added to x, and of x that are added to y.
const SHEARS: [[i64; 2]; 5] = [[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]];

/// A way to lay the found grid on the board.
struct Fit {
    shear: [i64; 2],
    turn: usize,
    shift: [i64; 2],
    wrong: usize,
}

impl Fit {
    fn place(&self, place: [i64; 2]) -> [i64; 2] {
        let [x, y] = turned(sheared(place, self.shear), self.turn);
        [x + self.shift[0], y + self.shift[1]]
    }
}

fn sheared([x, y]: [i64; 2], [a, b]: [i64; 2]) -> [i64; 2] {
    [x + a * y, y + b * x]
}

/// All ways in which the sizes agree but for a few: two, or fewer than there are larger circles that agree.
fn fits(places: &Places, large: &[bool], board: &Board) -> Vec<Fit> {
    let mut fits = Vec::new();
    for (shear, turn) in SHEARS.iter().flat_map(|shear| (0..8).map(move |turn| (*shear, turn))) {
        let turned: Vec<[i64; 2]> = places.keys().map(|place| turned(sheared(*place, shear), turn)).collect();
        let range = |axis: usize, size: usize| {
            let low = turned.iter().map(|p| p[axis]).min().unwrap_or(0);
            let high = turned.iter().map(|p| p[axis]).max().unwrap_or(0);
            -low..size as i64 - high
        };
        for dx in range(0, board.columns) {
            for dy in range(1, board.rows) {
                let differs = |(place, is): (&[i64; 2], &bool)| {
                    let circle = board.circle((place[0] + dx) as usize, (place[1] + dy) as usize);
                    circle.is_none_or(|circle| circle.large != *is)
                };
                let wrong = turned.iter().zip(large).filter(|pair| differs(*pair)).count();
                let right = turned.iter().zip(large).filter(|&(p, is)| *is && !differs((p, is))).count();
                if right > 0 && (wrong <= 2 * MISJUDGED || wrong < right) {
                    fits.push(Fit { shear, turn, shift: [dx, dy], wrong });
                }
            }
        }
    }
    fits
}
