// SPDX-License-Identifier: MIT OR Apache-2.0
//! The connected pieces of the marker's cores, and which of the pattern's markers each one is.

use crate::base::image::Plane;
use crate::kernels::connected_components::{self, Piece};
use crate::kernels::pixel_runs::Runs;

/// Pieces of one frame's marker cores.
#[derive(Debug)]
pub struct MarkerPieces {
    /// All cores.
    pub cores: Runs,
    /// The piece of each of their runs.
    pub of: Vec<u32>,
    /// The pieces.
    pub pieces: Vec<Piece>,
    /// The marker that each piece is, 1 for the first of [`crate::triangulate::camera_projector::CameraProjector::markers`]; 0: it is none, or not known.
    pub number: Vec<u8>,
}

impl MarkerPieces {
    /// Connects cores; of none the number is known.
    pub fn new(cores: Runs) -> Self {
        let (of, pieces) = connected_components::connect(&cores);
        let number = vec![0; pieces.len()];
        Self { cores, of, pieces, number }
    }

    /// Sets a plane to the number of the marker that each pixel is on, 0 where it is on none. Returns how many are on one.
    pub fn paint(&self, anchor: &mut Plane<u8>) -> usize {
        anchor.as_mut_slice().fill(0);
        for v in 0..self.cores.height() {
            for place in self.cores.places(v) {
                let columns = self.cores.all()[place].columns();
                anchor.row_mut(v)[columns].fill(self.number[self.of[place] as usize]);
            }
        }
        let known = self.pieces.iter().zip(&self.number).filter(|(_, number)| **number != 0);
        known.map(|(piece, _)| piece.area as usize).sum()
    }
}
