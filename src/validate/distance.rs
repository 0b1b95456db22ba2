//! Distances between the outermost circles on both diagonals of the board (paper, 5.1, step 2).
//!
//! As the paper has it, the distance of two circles is the mean of that between the points on their outer edges and
//! that between the points on their inner edges, on the line through their middles. Edges are found in the image grid of
//! the cloud; their points lie on the surface that the cloud's points around the circle make (points whose fringe window
//! a circle reaches are not taken for it).
//!
//! The outermost circle at a corner of the board is the nearest one to that corner that all cameras of the head see whole;
//! it is named by column and row. The distance of the two is held against the board's own.

use super::edge::{self, Edge};
use super::ring::{Organized, Ring};
use crate::calibrate::Board;
use crate::image::Mono8;
use serde::Serialize;
use std::collections::BTreeMap;

pub use super::edge::Light;

/// Circles tried at each corner.
const TRIED: usize = 8;

/// What one camera has of the board.
#[derive(Debug, Clone, Copy)]
pub struct Sight<'a> {
    /// Its cloud.
    pub cloud: &'a Organized<'a>,
    /// What lights it, where the calibration is known.
    pub light: Option<Light<'a>>,
    /// The photograph of the cloud, where it is at hand.
    pub photograph: Option<Mono8<'a>>,
}

/// The circles at both ends of the two diagonals.
#[derive(Debug, Clone, Serialize)]
pub struct Diagonals {
    /// Column and row of the circles at both ends of each diagonal.
    pub ends: [[[usize; 2]; 2]; 2],
    /// Mean of outer and inner distance of each diagonal, mean of the cameras, mm.
    pub diagonal_mm: [f64; 2],
    /// What the board says, mm.
    pub board_mm: [f64; 2],
    /// Measured minus board, mm.
    pub error_mm: [f64; 2],
    /// The errors of each camera alone, mm.
    pub error_of_camera_mm: Vec<[f64; 2]>,
    /// Outer distance minus inner distance minus twice the board's diameters, mean of the cameras, mm: what the
    /// edges are worth.
    pub edges_mm: [f64; 2],
    /// Root mean square of what the edges' models leave, as a share of the light.
    pub edge_rms: f64,
}

/// Measures both diagonals with all cameras of a head; an error says what is not seen.
pub fn diagonals(sights: &[Sight<'_>], board: &Board) -> Result<Diagonals, String> {
    let mut rings: Vec<Vec<Ring>> = Vec::new();
    for sight in sights {
        rings.push(sight.cloud.circles(board).map_err(|e| e.to_string())?);
    }
    let (right, top) = (board.columns - 1, board.rows - 1);
    let corners = [[0, 0], [right, top], [right, 0], [0, top]];
    let mut found: Vec<(usize, Vec<Edge>)> = Vec::new();
    for corner in corners {
        found.push(outermost(sights, &rings, board, corner).ok_or_else(|| {
            format!("no circle near column {}, row {} is seen whole by every camera", corner[0], corner[1])
        })?);
    }
    let name = |circle: usize| [circle % board.columns, circle / board.columns];
    let (mut errors, mut edges) = (vec![[0.0; 2]; sights.len()], [0.0; 2]);
    let (mut diagonal_mm, mut board_mm) = ([0.0; 2], [0.0; 2]);
    let mut ends = [[[0; 2]; 2]; 2];
    for diagonal in 0..2 {
        let [(a, of_a), (b, of_b)] = [&found[2 * diagonal], &found[2 * diagonal + 1]];
        ends[diagonal] = [name(*a), name(*b)];
        let [from, to] = [a, b].map(|&i| board.circles()[i]);
        let apart = |i: usize| to.centre_m[i] - from.centre_m[i];
        board_mm[diagonal] = 1e3 * (apart(0).powi(2) + apart(1).powi(2) + apart(2).powi(2)).sqrt();
        let n = sights.len() as f64;
        for ((one, other), errors) in of_a.iter().zip(of_b).zip(&mut errors) {
            let length = |sign: f64| {
                1e3 * (one.towards(&other.centre(), sign) - other.towards(&one.centre(), sign)).norm()
            };
            let (inner, outer) = (length(1.0), length(-1.0));
            errors[diagonal] = (inner + outer) / 2.0 - board_mm[diagonal];
            diagonal_mm[diagonal] += (inner + outer) / 2.0 / n;
            edges[diagonal] += (outer - inner - 2e3 * (from.radius_m + to.radius_m)) / n;
        }
    }
    let rms: Vec<f64> = found.iter().flat_map(|(_, edges)| edges.iter().map(|e| e.rms)).collect();
    Ok(Diagonals {
        ends,
        diagonal_mm,
        board_mm,
        error_mm: [0, 1].map(|i| diagonal_mm[i] - board_mm[i]),
        error_of_camera_mm: errors,
        edges_mm: edges,
        edge_rms: (rms.iter().map(|r| r * r).sum::<f64>() / rms.len() as f64).sqrt(),
    })
}

/// The circle nearest to a corner whose edge every camera sees.
fn outermost(
    sights: &[Sight<'_>],
    rings: &[Vec<Ring>],
    board: &Board,
    corner: [usize; 2],
) -> Option<(usize, Vec<Edge>)> {
    let mut seen: BTreeMap<usize, usize> = BTreeMap::new();
    rings.iter().flatten().for_each(|ring| *seen.entry(ring.circle).or_default() += 1);
    let mut candidates: Vec<usize> =
        seen.into_iter().filter(|(_, n)| *n == sights.len()).map(|(circle, _)| circle).collect();
    let steps = |circle: &usize| {
        let (column, row) = (circle % board.columns, circle / board.columns);
        column.abs_diff(corner[0]).pow(2) + row.abs_diff(corner[1]).pow(2)
    };
    candidates.sort_by_key(steps);
    candidates.truncate(TRIED);
    candidates.into_iter().find_map(|circle| {
        let radius = board.circles().get(circle)?.radius_m;
        let edges: Option<Vec<Edge>> = sights
            .iter()
            .zip(rings)
            .map(|(sight, rings)| {
                let ring = rings.iter().find(|ring| ring.circle == circle)?;
                edge::find(sight.cloud, ring, rings, radius, sight.light, sight.photograph)
            })
            .collect();
        Some((circle, edges?))
    })
}
