// SPDX-License-Identifier: MIT OR Apache-2.0
//! The connected pieces of the marker's cores, and which of the pattern's markers each one is.

use crate::base::image::Plane;
use crate::kernels::connected_components::{self, Piece};
use crate::kernels::pixel_runs::Runs;
use std::ops::Range;

/// Pieces of one frame's marker cores.
#[derive(Debug)]
pub struct MarkerPieces {
    /// The runs of all cores.
    cores: Runs,
    /// The piece of each of their runs.
    of: Vec<u32>,
    /// Area and rows of each piece.
    pub pieces: Vec<Piece>,
    /// The marker that each piece is, 1 for the first of `CameraProjector::markers`; 0 where it is none, or not known.
    pub number: Vec<u8>,
}

impl MarkerPieces {
    /// Connects cores; of none the number is known.
    pub fn new(cores: Runs) -> Self {
        let (of, pieces) = connected_components::connect(&cores);
        let number = vec![0; pieces.len()];
        Self { cores, of, pieces, number }
    }

    /// All runs of the cores with the piece of each: row, columns, piece.
    pub fn runs(&self) -> impl Iterator<Item = (usize, Range<usize>, usize)> {
        self.cores.each().map(|(v, place, run)| (v, run.columns(), self.of[place] as usize))
    }

    /// Sets a plane to the number of the marker that each pixel is on, 0 where it is on none. Returns how many are on
    /// one.
    pub fn paint(&self, anchor: &mut Plane<u8>) -> usize {
        anchor.as_mut_slice().fill(0);
        self.runs().for_each(|(v, columns, piece)| anchor.row_mut(v)[columns].fill(self.number[piece]));
        let known = self.pieces.iter().zip(&self.number).filter(|(_, number)| **number != 0);
        known.map(|(piece, _)| piece.area as usize).sum()
    }
}
