// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a view has in each cell of 8 x 8 px, laid out for the other cameras, which look it up at any place.
//!
//! Other cameras look up cells all over the image, and each look waits for memory. A cell that one node fills is a
//! plane of 16 bytes, of which all stay in the cache, and so is one beside the object: a bit for each of its pixels.
//! Only the others, on outlines and at steps, keep their pixels, side by side.

use super::patches::CELL_PX;
use crate::kernels::bit_rows::{self, WORD};
use crate::kernels::pixel_runs::Runs;

/// Cells around the region of interest in the grid of a view, on each side: beyond them there is nothing but
/// background.
pub const PAD_CELLS: usize = 3;

/// Width of the margin of [`PAD_CELLS`] around the region of interest, px.
pub const PAD_PX: usize = PAD_CELLS * CELL_PX;

/// A camera looks past the body at a place only if there is background this far to the left, right, above and below,
/// px: outlines are blurred.
pub const BACKGROUND_PX: f32 = 10.0;

/// Cells of the padded grid along a side of `px` pixels.
pub fn padded(px: usize) -> usize {
    px.div_ceil(CELL_PX) + 2 * PAD_CELLS
}

/// Machine words that hold a bit for each pixel of a row of `cells` cells.
fn words(cells: usize) -> usize {
    (cells * CELL_PX).div_ceil(WORD)
}

/// What the other cameras see in a cell, in 16 bytes.
#[derive(Debug, Clone, Copy)]
pub struct CellContent {
    /// The node that fills it, or one of the constants below; then the phase of the node's plane at the cell's first
    /// pixel, rad, as bits of a float; NaN where there is none.
    surface: [u32; 2],
    /// Of a plane its two steps, as bits of floats; of [`Self::NEAR`] a bit for each pixel, the upper rows first.
    bits: [u32; 2],
}

/// The phases of a cell that one patch fills.
#[derive(Debug, Clone, Copy)]
pub struct Plane {
    /// Phase of the cell's first pixel, rad.
    pub phase: f32,
    /// Steps from column to column, and from row to row, rad.
    pub steps: [f32; 2],
}

impl Plane {
    /// The phase at this distance, in columns and rows, from the cell's first pixel, rad.
    #[inline(always)]
    pub fn at(&self, right: f32, down: f32) -> f32 {
        self.phase + (right * self.steps[0] + down * self.steps[1])
    }
}

/// What is seen in a cell.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    /// Beside the object, and so is all within [`BACKGROUND_PX`].
    Far,
    /// Beside the object, with object within [`BACKGROUND_PX`].
    Near,
    /// Pixels of several kinds: the place in [`CellLookup::rims`].
    Rim(usize),
    /// Filled by one patch, the node of this number.
    Node(u32),
}

impl CellContent {
    /// Beside the object, and so is all within [`BACKGROUND_PX`].
    pub const FAR: u32 = u32::MAX;
    /// Beside the object, with object within [`BACKGROUND_PX`].
    pub const NEAR: u32 = u32::MAX - 1;
    /// From here on: places in [`CellLookup::rims`].
    pub const RIM: u32 = 1 << 31;
    /// What is not seen: a plane without a phase.
    pub const UNSEEN: Self = Self::none(0);

    /// A cell that a node fills, as a plane: its phase at the first pixel, its step from column to column, and from
    /// row to row, rad.
    #[inline(always)]
    pub fn of_plane(node: u32, plane: Plane) -> Self {
        Self { surface: [node, plane.phase.to_bits()], bits: plane.steps.map(f32::to_bits) }
    }

    /// A cell beside the object, with its [`near`](Self::near).
    fn beside(near: u64) -> Self {
        Self { bits: [near as u32, (near >> u32::BITS) as u32], ..Self::none(Self::NEAR) }
    }

    const fn none(kind: u32) -> Self {
        Self { surface: [kind, f32::NAN.to_bits()], bits: [0; 2] }
    }

    /// The plane of a cell that a node fills; of any other, numbers that mean nothing.
    #[inline(always)]
    pub fn as_plane(&self) -> Plane {
        Plane { phase: f32::from_bits(self.surface[1]), steps: self.bits.map(f32::from_bits) }
    }

    /// The node that fills it, or what else it is.
    #[inline(always)]
    fn node(&self) -> u32 {
        self.surface[0]
    }

    /// Of a cell beside the object: a bit for each pixel, row by row, that has the object [`BACKGROUND_PX`] to the
    /// left, to the right, above or below. Of any other nothing of use.
    fn near(&self) -> u64 {
        let [above, below] = self.bits.map(u64::from);
        above | below << u32::BITS
    }

    /// The content as an enumeration.
    #[inline(always)]
    fn kind(&self) -> Kind {
        match self.node() {
            Self::FAR => Kind::Far,
            Self::NEAR => Kind::Near,
            node if node >= Self::RIM => Kind::Rim((node - Self::RIM) as usize),
            node => Kind::Node(node),
        }
    }
}

/// What some cells have, each in its lane.
#[derive(Debug, Clone, Copy)]
pub struct CellLanes<const N: usize> {
    surface: [[u32; 2]; N],
    bits: [[u32; 2]; N],
}

impl<const N: usize> CellLanes<N> {
    /// Cells that are not seen.
    pub const UNSEEN: Self =
        Self { surface: [CellContent::UNSEEN.surface; N], bits: [CellContent::UNSEEN.bits; N] };

    /// Puts a cell into a lane.
    #[inline(always)]
    pub fn set(&mut self, lane: usize, cell: &CellContent) {
        (self.surface[lane], self.bits[lane]) = (cell.surface, cell.bits);
    }

    /// The node that fills each cell, or [`CellContent::FAR`], [`CellContent::NEAR`], or a rim from
    /// [`CellContent::RIM`] on.
    #[inline(always)]
    pub fn node(&self, lane: usize) -> u32 {
        self.surface[lane][0]
    }

    /// The phase of a plane at this distance, in columns and rows, from its first pixel, rad.
    #[inline(always)]
    pub fn phase(&self, lane: usize, right: f32, down: f32) -> f32 {
        let phase = f32::from_bits(self.surface[lane][1]);
        let [by_column, by_row] = self.bits[lane];
        phase + (right * f32::from_bits(by_column) + down * f32::from_bits(by_row))
    }

    /// Of a cell beside the object: whether a pixel has the object [`BACKGROUND_PX`] to the left, to the right, above
    /// or below.
    #[inline(always)]
    pub fn is_near(&self, lane: usize, u: u32, v: u32) -> bool {
        // By halves: words of 64 bits would be half as many at once.
        let [above, below] = self.bits[lane];
        let pixel = v.wrapping_mul(CELL_PX as u32) | u;
        let is_below = 0u32.wrapping_sub((pixel / u32::BITS) & 1);
        (above & !is_below | below & is_below) >> (pixel % u32::BITS) & 1 != 0
    }
}

/// A row of a cell whose pixels differ in kind. All that a look at a place needs lies in one cache line, because
/// waiting for memory takes most of the time.
#[derive(Debug, Clone, Copy)]
#[repr(align(64))]
pub struct RimRow {
    /// Phases of its pixels, and of the first column of the next cell, rad; NaN where they are unknown.
    pub phase: [f32; CELL_PX + 1],
    /// The first of the cell's nodes.
    pub first: u32,
    /// For each pixel 0, or the number of its node among the cell's, from 1.
    pub of: [u8; CELL_PX],
    /// A bit for each pixel of the object.
    pub object: u8,
    /// A bit for each pixel that is the object's or has it [`BACKGROUND_PX`] to the left, to the right, above or below.
    /// [`CellLookup::mark_outlines`] sets it.
    near: u8,
}

impl RimRow {
    /// A row of pixels that are unknown, in a cell of these first node and object.
    pub fn new(first: u32, object: u8) -> Self {
        Self { phase: [f32::NAN; CELL_PX + 1], first, of: [0; CELL_PX], object, near: 0 }
    }

    /// The node that [`Self::of`] stands for; any number where it stands for none.
    #[inline(always)]
    pub fn node(&self, of: u8) -> u32 {
        self.first.wrapping_add(u32::from(of)).wrapping_sub(1)
    }

    /// Whether a pixel is the object's.
    #[inline(always)]
    pub fn is_object(&self, u: usize) -> bool {
        self.object >> (u % CELL_PX) & 1 != 0
    }

    /// Whether a pixel is the object's or has it [`BACKGROUND_PX`] to the left, to the right, above or below.
    #[inline(always)]
    pub fn is_near(&self, u: u32) -> bool {
        self.near >> (u % CELL_PX as u32) & 1 != 0
    }
}

/// The rows of a cell whose pixels differ in kind.
pub type RimRows = [RimRow; CELL_PX];

/// All cells of a view, with [`PAD_CELLS`] around.
#[derive(Debug, Default)]
pub struct CellLookup {
    stride: usize,
    rows: usize,
    /// The padded grid, row by row.
    cells: Vec<CellContent>,
    /// Cells that no node fills, though they show the object.
    rims: Vec<RimRows>,
}

impl CellLookup {
    /// Nothing but background, `width` times `height` pixels.
    pub fn new(width: usize, height: usize) -> Self {
        let (stride, rows) = (padded(width), padded(height));
        let cells = vec![CellContent::none(CellContent::FAR); stride * rows];
        // Rows of rims are large: to move them to more room, again and again, takes longer than to take it.
        let rims = Vec::with_capacity(cells.len() / 8);
        Self { stride, rows, cells, rims }
    }

    /// The place of a cell of the region of interest in the padded grid.
    #[inline(always)]
    fn place(&self, column: usize, row: usize) -> usize {
        (row + PAD_CELLS) * self.stride + column + PAD_CELLS
    }

    /// The cell at a place in the padded grid; beyond it nothing is seen.
    #[inline(always)]
    pub fn at(&self, place: u32) -> &CellContent {
        self.cells.get(place as usize).unwrap_or(&CellContent::UNSEEN)
    }

    /// The plane of a cell that a node fills, by its column and row.
    #[inline(always)]
    pub fn plane(&self, column: usize, row: usize) -> Plane {
        self.cells[self.place(column, row)].as_plane()
    }

    /// All cells of the padded grid.
    pub fn cells(&self) -> &[CellContent] {
        &self.cells
    }

    /// Whether a pixel is the object's or has it beside it. `place` is a cell; the pixel is counted from its first,
    /// and may be in the next column of cells.
    pub fn is_near(&self, place: u32, u: usize, v: usize) -> bool {
        let cell = self.at(place + (u / CELL_PX) as u32);
        match cell.kind() {
            Kind::Far => false,
            Kind::Near => cell.near() >> (v % CELL_PX * CELL_PX + u % CELL_PX) & 1 != 0,
            Kind::Rim(rim) => self.rims.get(rim).is_some_and(|rim| rim[v % CELL_PX].is_near(u as u32)),
            Kind::Node(_) => true,
        }
    }

    /// A row of the rim that a cell is, by [`CellLanes::node`].
    #[inline(always)]
    pub fn rim(&self, kind: u32, v: usize) -> Option<&RimRow> {
        self.rims.get(kind.wrapping_sub(CellContent::RIM) as usize).map(|rim| &rim[v.min(CELL_PX - 1)])
    }

    /// Sets a cell that a node fills.
    #[inline(always)]
    pub fn set(&mut self, column: usize, row: usize, cell: CellContent) {
        let place = self.place(column, row);
        self.cells[place] = cell;
    }

    /// Sets a cell whose pixels differ in kind.
    pub fn set_rim(&mut self, column: usize, row: usize, rim: RimRows) {
        self.set(column, row, CellContent::none(CellContent::RIM + self.rims.len() as u32));
        self.rims.push(rim);
    }

    /// The cell of column `u / CELL_PX` and row `v / CELL_PX`; beyond the grid there is nothing but background.
    #[inline(always)]
    fn of(&self, u: usize, v: usize) -> Kind {
        let (column, row) = (u / CELL_PX, v / CELL_PX);
        if column + PAD_CELLS >= self.stride || row + PAD_CELLS >= self.rows {
            return Kind::Far;
        }
        self.cells[self.place(column, row)].kind()
    }

    /// The node of a pixel.
    #[inline(always)]
    pub fn node(&self, u: usize, v: usize) -> Option<u32> {
        match self.of(u, v) {
            Kind::Far | Kind::Near => None,
            Kind::Rim(place) => {
                let row = &self.rims.get(place)?[v % CELL_PX];
                let of = row.of[u % CELL_PX];
                (of != 0).then(|| row.node(of))
            }
            Kind::Node(node) => Some(node),
        }
    }

    /// A bit for each pixel of the grid, 64 a word, row by row: whether the object is there, or [`BACKGROUND_PX`] to
    /// the left, to the right, above or below.
    #[inline(always)]
    fn near(&self, runs: &Runs) -> Vec<u64> {
        const REACH: usize = BACKGROUND_PX as usize;
        const { assert!(REACH <= PAD_PX) };
        let (words, height) = (words(self.stride), self.rows * CELL_PX);
        let mut object = vec![0; words * height];
        for v in 0..runs.height() {
            let row = &mut object[(v + PAD_PX) * words..][..words];
            for run in runs.row(v) {
                bit_rows::set(row, run.start() + PAD_PX..run.end() + PAD_PX);
            }
        }
        let mut near = vec![0; words * height];
        // Beyond these there is the object nowhere near.
        for v in REACH..height - REACH {
            let row = |v: usize| &object[v * words..][..words];
            let (above, own, below) = (row(v - REACH), row(v), row(v + REACH));
            let near = &mut near[v * words..][..words];
            for k in 0..words {
                near[k] = above[k] | below[k] | own[k] | own[k] << REACH | own[k] >> REACH;
            }
            for k in 1..words {
                near[k - 1] |= own[k] << (WORD - REACH);
                near[k] |= own[k - 1] >> (WORD - REACH);
            }
        }
        near
    }

    /// Marks the background around the object, when all cells that show it are set.
    #[inline(always)]
    pub fn mark_outlines(&mut self, runs: &Runs) {
        const REACH: usize = (BACKGROUND_PX as usize).div_ceil(CELL_PX);
        const { assert!(REACH <= PAD_CELLS) };
        let near = self.near(runs);
        let stride = self.stride;
        let near_of = |place: usize| {
            let (column, row) = (place % stride, place / stride);
            let (word, byte) = (column * CELL_PX / WORD, column % (WORD / CELL_PX));
            let first = row * CELL_PX * words(stride) + word;
            let rows = (0..CELL_PX).map(|v| near[first + v * words(stride)] >> (byte * CELL_PX) & 0xff);
            rows.rev().fold(0, |all, row| all << CELL_PX | row)
        };
        // A bit for each cell that shows the object, row by row, and none for as many rows beyond as is looked.
        let words = stride.div_ceil(WORD);
        let mut shown = vec![0u64; words * (self.rows + 2 * REACH)];
        for row in 0..runs.height().div_ceil(CELL_PX) {
            for column in super::patches::band(runs, row) {
                let at = self.place(column, row);
                match self.cells[at].kind() {
                    Kind::Far | Kind::Near => continue,
                    Kind::Rim(rim) => {
                        let rows = self.rims[rim].iter_mut().zip(near_of(at).to_le_bytes());
                        rows.for_each(|(row, near)| row.near = near);
                    }
                    Kind::Node(_) => {}
                }
                let column = column + PAD_CELLS;
                shown[(row + PAD_CELLS + REACH) * words + column / WORD] |= 1 << (column % WORD);
            }
        }
        for row in 0..self.rows {
            for k in 0..words {
                let at = (row + REACH) * words + k;
                let own = shown[at];
                let before = if k > 0 { shown[at - 1] } else { 0 };
                let after = if k + 1 < words { shown[at + 1] } else { 0 };
                let mut beside = 0;
                for step in 1..=REACH {
                    beside |= own << step | before >> (WORD - step) | own >> step | after << (WORD - step);
                    beside |= shown[at - step * words] | shown[at + step * words];
                }
                beside &= !own;
                while beside != 0 {
                    let other = row * stride + k * WORD + beside.trailing_zeros() as usize;
                    self.cells[other] = CellContent::beside(near_of(other));
                    beside &= beside - 1;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{CellContent, CellLookup, Kind, Plane as CellPlane, RimRow};
    use crate::base::image::Plane;
    use crate::kernels::pixel_runs::Runs;

    #[test]
    fn pixels_are_what_their_cells_say() {
        // Three by two cells of 20 x 14 px: a node, a rim of two nodes with a hole, nothing.
        let (w, h) = (20, 14);
        let mut object = Plane::filled(w, h, 0u8);
        (0..8).for_each(|v| object.row_mut(v)[..12].fill(1));
        let mut lookup = CellLookup::new(w, h);
        lookup.set(0, 0, CellContent::of_plane(5, CellPlane { phase: 0.0, steps: [0.0; 2] }));
        let mut rim = [RimRow::new(6, 0x0f); 8];
        for (v, row) in rim.iter_mut().enumerate() {
            row.of[..4].fill(1 + u8::from(v >= 4));
        }
        rim[1].of[0] = 0;
        lookup.set_rim(1, 0, rim);
        lookup.mark_outlines(&Runs::of(&object));
        for v in 0..40 {
            for u in 0..40 {
                let expected = match (u, v) {
                    (..8, ..8) => Some(5),
                    (8, 1) => None,
                    (8..12, ..8) => Some(6 + u32::from(v >= 4)),
                    _ => None,
                };
                assert_eq!(lookup.node(u, v), expected, "({u}, {v})");
            }
        }
        // The object with the places beside it; nothing is anywhere else. The padded grid has 9 x 8 cells.
        let is_object = |u: usize, v: usize| (24..36).contains(&u) && (24..32).contains(&v);
        for v in 0..64usize {
            for u in 0..72usize {
                let beside = [(10, 10), (0, 10), (20, 10), (10, 0), (10, 20)];
                let is_near = beside
                    .into_iter()
                    .any(|(a, b)| is_object((u + a).wrapping_sub(10), (v + b).wrapping_sub(10)));
                let place = (v / 8 * 9 + u / 8) as u32;
                assert_eq!(lookup.is_near(place, u % 8, v % 8), is_near, "({u}, {v})");
                if u % 8 == 0 && u > 0 {
                    assert_eq!(lookup.is_near(place - 1, 8, v % 8), is_near, "({u}, {v})");
                }
            }
        }
        let kind = |column: usize, row: usize| lookup.of(8 * column, 8 * row);
        assert_eq!([kind(0, 0), kind(1, 0)], [Kind::Node(5), Kind::Rim(0)]);
        assert_eq!([kind(2, 0), kind(0, 1), kind(2, 1)], [Kind::Near, Kind::Near, Kind::Far]);
    }
}
