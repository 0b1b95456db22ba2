// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the photographs of the board show, frame by frame and position by position.

use super::findings::Refusal;
use super::lattice::Sighting;
use crate::base::ids::TriggerIndex;
use crate::base::image::Plane;

/// Light below this level counts as dark, grey levels.
pub(super) const DARK: u8 = 24;

/// The board at one place: a white frame, and the frame with fringes that belongs to it.
///
/// `arrange` makes the positions of a session from all its frames. The stages read them; nothing changes them later.
#[derive(Debug, Clone)]
pub struct Position {
    /// The trigger of the white frames.
    pub white: TriggerIndex,
    /// The trigger of the frames with fringes; `None` where no camera has one.
    pub fringes: Option<TriggerIndex>,
    /// What each camera sees, in the calibration's order.
    pub views: Vec<Option<View>>,
}

/// A camera's view of the board at one position.
#[derive(Debug, Clone)]
pub struct View {
    /// The circles that were found in the white frame and identified.
    pub sightings: Vec<Sighting>,
    /// The phase in the frame with fringes; `None` without such a frame.
    pub phase: Option<Phase>,
    /// By circle of the board: seen in the white frame and again in the frame with fringes. Empty without fringes.
    pub confirmed: Vec<bool>,
    /// The white frame, until the frame with fringes was compared with it.
    pub white: Option<Plane<u8>>,
    /// How the fringes' light compares with the white light, at points between the circles.
    pub light: Vec<LightSample>,
    /// The markers' ridges in the frame with fringes.
    pub ridge: Vec<RidgePixel>,
}

/// The phase of a frame by itself, rad.
#[derive(Debug, Clone)]
pub struct Phase {
    /// Unwrapped phase, rad; NaN where there is none.
    pub plane: Plane<f32>,
    /// Where the frame's own marker gives the fringe order. Elsewhere whole fringes may be missing, another number in
    /// each patch; `orders.rs` finds them from the board.
    pub by_marker: Plane<bool>,
    /// Whether the marker is where the phase has it.
    pub marker: bool,
}

/// Light around one point between the circles, in both frames of a view.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LightSample {
    /// Mean level in white light, grey levels.
    pub white: f64,
    /// Mean level of the fringes, grey levels.
    pub mean: f64,
    /// Amplitudes of the fringes' first three harmonics, grey levels.
    pub harmonics: [f64; 3],
}

/// A pixel on a marker's ridge, and its light over one period of the fringes, DN.
#[derive(Debug, Clone, Copy)]
pub struct RidgePixel {
    pub(super) u: usize,
    pub(super) v: usize,
    pub(super) light: f64,
}

/// What one frame shows, judged by itself.
#[derive(Debug, Clone)]
pub enum Looked {
    /// There is no frame, for this reason.
    Missing(String),
    /// Nothing in the frame is lit.
    Dark,
    /// The board in white light, or why it cannot be used.
    White(Result<View, Refusal>),
    /// The board with fringes on it.
    Fringes {
        /// The frame itself, to find the circles again.
        image: Plane<u8>,
        /// The phase, or why there is none.
        phase: Result<Phase, Refusal>,
    },
}
