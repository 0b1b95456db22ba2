//! The graph's nodes and edges: segments of rows, and where they touch.
//!
//! A segment is as long as its pixels' steps are certain, but not longer than [`LONGEST_PX`]. Its phases are known
//! relative to its run of the object, whose steps have been rounded to the carrier's; so segments beside each other in a
//! run differ by no turns, and segments above each other by those that the pixels of their common border agree on.

use super::Settings;
use super::blocks::{Blocks, COLUMNS};
use super::costs::{NONE, Row, UNITS, doubtful, turns_in, units};
use super::forest::{Edge, Forest};
use crate::image::Plane;
use crate::reconstruct::bits::{self, WORD, bits_where};
use crate::reconstruct::round::whole;
use crate::reconstruct::runs::{Runs, each_not_0};
use crate::reconstruct::sample::chunk;

/// Longest segment, px; a multiple of it begins a new one.
const LONGEST_PX: usize = 16;

/// The columns of a word in which a segment begins whatever its costs: none goes on from word to word.
const MULTIPLES: u64 = u64::MAX / ((1 << LONGEST_PX) - 1);

/// Steps up to this cost do not end a segment, units.
const CERTAIN: u16 = (0.03 * UNITS) as u16;

/// Edges below this cost need no order among themselves, units: they are taken as they are found.
const SURE: u32 = (0.02 * UNITS) as u32;

/// Resolution of the order of the others, units.
const BUCKET: u32 = 4;

/// A border is doubtful where more than this share (numerator, denominator) of its pixel pairs are: surfaces that agree by
/// chance do so at a few.
const DOUBTFUL_SHARE: [u32; 2] = [3, 4];

/// Pixels of one row that are one node of the graph.
#[derive(Debug, Clone, Copy)]
pub(super) struct Segment {
    pub first: u16,
    pub end: u16,
    /// Turns of its first pixel within its run.
    pub turns: i16,
}

impl Segment {
    pub fn columns(self) -> std::ops::Range<usize> {
        usize::from(self.first)..usize::from(self.end)
    }
}

/// What the graph's stages look at of a row.
#[derive(Debug, Default)]
struct RowNodes {
    /// Where segments begin.
    starts: Vec<u64>,
    /// Which steps down are edges.
    edges: Vec<u64>,
    /// Codes of the steps down.
    down: Vec<u16>,
    /// Segment of each known pixel.
    node: Vec<u32>,
}

/// The graph while it grows from row to row, and what of it was put off.
#[derive(Debug, Default)]
pub(super) struct Graph {
    pub forest: Forest,
    /// All nodes, row by row.
    pub segments: Vec<Segment>,
    /// Where the nodes of each row end.
    pub ends: Vec<usize>,
    rows: [RowNodes; 2],
    /// Edges to be taken by rising cost, by bucket.
    later: Vec<Vec<Edge>>,
    /// Which pixels of a row lie in its runs.
    inside: Vec<u64>,
    /// Turns that each pixel has more than the one below it; the first is that of column -1.
    turns: Vec<i16>,
    /// Merges refused because the votes contradicted.
    pub contradictions: usize,
}

/// The planes that the graph is made of, and the marker's votes.
#[derive(Debug, Clone, Copy)]
pub(super) struct Input<'a> {
    pub wrapped: &'a Plane<f32>,
    pub runs: &'a Runs,
    pub votes: Votes<'a>,
}

/// The marker's pixels, which may be finer than those of the graph.
#[derive(Debug, Clone, Copy)]
pub(super) struct Votes<'a> {
    pub anchor: &'a Plane<u8>,
    pub markers: &'a [u32],
    pub phase: &'a Plane<f32>,
    pub runs: &'a Runs,
    /// What the graph is made of, if not of pixels.
    pub blocks: Option<&'a Blocks>,
}

impl Graph {
    pub fn begin(&mut self, width: usize, settings: &Settings) {
        debug_assert!(
            settings.max_residual < 2.0,
            "a sum of codes keeps the units of {LONGEST_PX} costs below 2 rad"
        );
        self.forest.clear();
        self.segments.clear();
        self.ends.clear();
        self.later.resize_with((UNITS * settings.max_residual) as usize / BUCKET as usize + 1, Vec::new);
        self.contradictions = 0;
        let words = width.div_ceil(WORD);
        for row in &mut self.rows {
            row.starts.resize(words, 0);
            row.edges.clear();
            row.edges.resize(words, 0);
            row.down.resize(words * WORD + LONGEST_PX, 0);
            row.node.resize(words * WORD + LONGEST_PX, 0);
        }
        self.inside.resize(words, 0);
        self.turns.resize(words * WORD + 1, 0);
    }

    /// Adds row `v`, after row `v - 1`. `turns`: those of each pixel within its run.
    #[inline(always)]
    pub fn add_row(
        &mut self,
        v: usize,
        costs: &Row<'_>,
        turns: &Plane<i16>,
        input: &Input<'_>,
        settings: &Settings,
    ) {
        self.rows.swap(0, 1);
        self.inside.fill(0);
        for run in input.runs.row(v) {
            bits::set(&mut self.inside, run.columns());
        }
        let first = self.segments.len();
        self.cut(input.wrapped.row(v), turns.row(v), costs.right);
        self.ends.push(self.segments.len());
        self.forest.extend(&self.segments[first..]);
        self.find_edges(costs.down);
        self.vote(v, turns.row(v), &input.votes);
        // First to the row above, while the segments are small trees, which may be attached where it is doubtful.
        if let Some(above) = v.checked_sub(1) {
            self.compare(input, above, turns);
            self.join_below(settings);
        }
        self.join_beside(first, costs.right, settings);
    }

    /// Cuts a row into segments.
    #[inline(always)]
    fn cut(&mut self, wrapped: &[f32], turns: &[i16], right: &[u16]) {
        let Self { inside, segments, rows: [_, row], .. } = self;
        let words = inside.iter().zip(&mut row.starts).zip(right.as_chunks::<WORD>().0);
        for (k, ((&inside, starts), right)) in words.enumerate() {
            *starts = 0;
            if inside == 0 {
                continue;
            }
            // What goes on from one pixel to the next is certain and not doubtful.
            let ends = bits_where(
                #[inline(always)]
                |i| right[i] > CERTAIN,
            );
            let cuts = inside & (ends << 1 | MULTIPLES | !(inside << 1));
            // A pixel that another goes on to is known.
            let (mut known, mut rest) = (inside, cuts);
            let begin = k * WORD;
            let phases = &wrapped[begin..];
            while rest != 0 {
                let i = rest.trailing_zeros() as usize;
                known &= !(u64::from(phases[i].is_nan()) << i);
                rest &= rest - 1;
            }
            *starts = cuts & known;
            let (nodes, turns) = (&mut row.node[begin..][..WORD + LONGEST_PX], &turns[begin..]);
            each_stretch(
                *starts,
                known,
                #[inline(always)]
                |i, count| {
                    nodes[i..i + LONGEST_PX].fill(segments.len() as u32);
                    let first = (begin + i) as u16;
                    segments.push(Segment { first, end: first + count as u16, turns: turns[i] });
                },
            );
        }
    }

    /// Finds the edges down from a row.
    #[inline(always)]
    fn find_edges(&mut self, down: &[u16]) {
        let row = &mut self.rows[1];
        for (k, (&inside, edges)) in self.inside.iter().zip(&mut row.edges).enumerate() {
            if inside == 0 {
                *edges = 0;
                continue;
            }
            let down: &[u16; WORD] = chunk(down, k * WORD);
            row.down[k * WORD..][..WORD].copy_from_slice(down);
            *edges = inside
                & bits_where(
                    #[inline(always)]
                    |i| down[i] != NONE,
                );
        }
    }

    /// Counts the votes of the marker's pixels.
    #[inline(always)]
    fn vote(&mut self, v: usize, turns: &[i16], votes: &Votes<'_>) {
        let (anchor, phase) = (votes.anchor.row(v), votes.phase.row(v));
        let (node, forest) = (&self.rows[1].node, &mut self.forest);
        for run in votes.runs.row(v) {
            let start = run.start();
            each_not_0(&anchor[run.columns()], |i| {
                let u = start + i;
                if !phase[u].is_nan() {
                    // Places of markers count from 1. The wrapped phase of a marker's core is that of its ridge.
                    let order = votes.markers[usize::from(anchor[u]) - 1] as i32;
                    let (place, lead) = votes.blocks.map_or((u, 0), |x| (u / COLUMNS, x.lead(u, v)));
                    forest.vote(node[place], order - i32::from(turns[place]) - lead);
                }
            });
        }
    }

    /// Joins the segments from `first` on with those before them in the row.
    #[inline(always)]
    fn join_beside(&mut self, first: usize, right: &[u16], settings: &Settings) {
        let Self { forest, later, segments, contradictions, .. } = self;
        for (node, pair) in (first as u32..).zip(segments[first..].windows(2)) {
            let (before, own) = (pair[0], pair[1]);
            if before.end != own.first {
                continue;
            }
            let cost = right[usize::from(own.first) - 1];
            if cost != NONE {
                let cost = u32::from(cost);
                let edge = Edge { a: node, b: node + 1, turns: 0, doubtful: doubtful(cost) != 0 };
                *contradictions += usize::from(!take(forest, later, edge, [units(cost), 1], settings));
            }
        }
    }

    /// Finds how many turns the pixels of row `above` have more than those below them.
    #[inline(always)]
    fn compare(&mut self, input: &Input<'_>, above: usize, turns: &Plane<i16>) {
        for run in input.runs.row(above) {
            let (part, n) = (run.columns(), run.columns().len());
            let [phase_above, phase_below] =
                [above, above + 1].map(|v| &input.wrapped.row(v)[part.clone()][..n]);
            let [turns_above, turns_below] = [above, above + 1].map(|v| &turns.row(v)[part.clone()][..n]);
            let turns = &mut self.turns[1 + run.start()..][..n];
            for i in 0..n {
                let more = whole(turns_in(phase_above[i] - phase_below[i])) as i16;
                turns[i] = more.wrapping_add(turns_above[i]).wrapping_sub(turns_below[i]);
            }
        }
    }

    /// Joins the segments of the row above with those below them.
    #[inline(always)]
    fn join_below(&mut self, settings: &Settings) {
        let Self { forest, later, rows: [above, below], turns, contradictions, .. } = self;
        for (k, (&edges, starts)) in
            above.edges.iter().zip(above.starts.iter().zip(&below.starts)).enumerate()
        {
            if edges == 0 {
                continue;
            }
            let begin = k * WORD;
            let turns: &[i16; WORD + 1] = chunk(turns, begin);
            let turned = bits_where(
                #[inline(always)]
                |i| turns[i] != turns[i + 1],
            );
            let starts = edges & (starts.0 | starts.1 | turned | !(edges << 1));
            let down: &[u16; WORD + LONGEST_PX] = chunk(&above.down, begin);
            let nodes: [&[u32; WORD]; 2] = [chunk(&above.node, begin), chunk(&below.node, begin)];
            each_stretch(
                starts,
                edges,
                #[inline(always)]
                |i, count| {
                    let (sum, count) = (sum(chunk(down, i), count), count as u32);
                    let doubtful = DOUBTFUL_SHARE[1] * doubtful(sum) > DOUBTFUL_SHARE[0] * count;
                    let edge = Edge { a: nodes[0][i], b: nodes[1][i], turns: turns[i + 1], doubtful };
                    *contradictions += usize::from(!take(forest, later, edge, [units(sum), count], settings));
                },
            );
        }
    }

    /// Takes all other edges by rising cost; ties as they were found.
    pub fn finish(&mut self, settings: &Settings) {
        for edges in &mut self.later {
            for edge in edges.drain(..) {
                self.contradictions += usize::from(!self.forest.merge(edge, settings));
            }
        }
    }
}

/// Takes a sure edge, puts another off. Its cost is the mean of those of some steps, of which there are their sum and how many
/// they are. False when votes contradict.
#[inline(always)]
fn take(
    forest: &mut Forest,
    later: &mut [Vec<Edge>],
    edge: Edge,
    [sum, count]: [u32; 2],
    settings: &Settings,
) -> bool {
    if sum < (SURE + 1) * count {
        return forest.merge(edge, settings);
    }
    later[((sum / count - SURE) / BUCKET) as usize].push(edge);
    true
}

/// Calls `each` with the first place and the length of every stretch of a word: each of `starts` begins one, which ends before
/// the next, or where `inside` does.
#[inline(always)]
fn each_stretch(starts: u64, inside: u64, mut each: impl FnMut(usize, usize)) {
    let (mut rest, on) = (starts, inside & !starts);
    while rest != 0 {
        let first = rest.trailing_zeros() as usize % WORD;
        each(first, 1 + (on >> first >> 1).trailing_ones() as usize);
        rest &= rest - 1;
    }
}

/// The sum of the first codes of some, as many as a stretch may have.
#[inline(always)]
fn sum(codes: &[u16; LONGEST_PX], count: usize) -> u32 {
    /// As many that are kept, and as many that are not: each stretch's begin so many before the middle.
    const KEPT: [u16; 2 * LONGEST_PX] = {
        let mut kept = [0; 2 * LONGEST_PX];
        let mut i = 0;
        while i < LONGEST_PX {
            kept[i] = u16::MAX;
            i += 1;
        }
        kept
    };
    let kept: &[u16; LONGEST_PX] = chunk(&KEPT, LONGEST_PX - count);
    let mut sum = 0;
    for i in 0..LONGEST_PX {
        sum += u32::from(codes[i] & kept[i]);
    }
    sum
}
