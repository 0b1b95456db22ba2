//! The graph's nodes and edges: segments of rows, and where they touch.
//!
//! A segment is as long as its pixels' steps are certain, but not longer than [`LONGEST_PX`]. Its phases are known
//! relative to its run of the object, whose steps have been rounded to the carrier's; so segments beside each other in a
//! run differ by no turns, and segments above each other by those that the pixels of their common border agree on.

use super::Settings;
use super::costs::{NONE, Row, UNITS, code, turns_in};
use super::forest::{Edge, Forest};
use crate::image::Plane;
use crate::reconstruct::round::whole;
use crate::reconstruct::runs::{Run, Runs, each_not_0};

/// Longest segment, px; a multiple of it begins a new one.
const LONGEST_PX: usize = 16;

/// Steps up to this cost do not end a segment, units.
const CERTAIN: u32 = (0.03 * UNITS) as u32;

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
    /// 1 where a segment begins.
    starts: Vec<u8>,
    /// Segment of each known pixel.
    node: Vec<u32>,
    /// Costs of the steps down.
    down: Vec<u32>,
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
    /// Edges to be taken by rising cost: their bucket, and themselves.
    later: Vec<(u16, Edge)>,
    sorted: Vec<Edge>,
    events: Vec<u8>,
    turns: Vec<i16>,
    sums: Vec<u32>,
    /// Where stretches of a border begin and end.
    places: Vec<u16>,
    /// Merges refused because the votes contradicted.
    pub contradictions: usize,
}

/// The planes that the graph is made of.
#[derive(Debug, Clone, Copy)]
pub(super) struct Input<'a> {
    pub wrapped: &'a Plane<f32>,
    pub anchor: &'a Plane<u8>,
    pub markers: &'a [u32],
    pub runs: &'a Runs,
}

impl Graph {
    pub fn begin(&mut self, width: usize) {
        self.forest.clear();
        self.segments.clear();
        self.ends.clear();
        self.later.clear();
        self.contradictions = 0;
        for row in &mut self.rows {
            row.starts.clear();
            row.starts.resize(width, 0);
            row.node.resize(width + LONGEST_PX, 0);
            row.down.clear();
            row.down.resize(width, NONE);
        }
        self.events.resize(width, 0);
        self.turns.resize(width, 0);
        self.sums.resize(width + 1, 0);
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
        if let Some(before) = v.checked_sub(2) {
            for run in input.runs.row(before) {
                self.rows[1].starts[run.columns()].fill(0);
                self.rows[1].down[run.columns()].fill(NONE);
            }
        }
        let first = self.segments.len();
        for run in input.runs.row(v) {
            self.cut(run, input.wrapped.row(v), turns.row(v), costs.right);
            self.rows[1].down[run.columns()].copy_from_slice(&costs.down[run.columns()]);
        }
        self.ends.push(self.segments.len());
        for segment in &self.segments[first..] {
            self.forest.push(u32::from(segment.end - segment.first));
        }
        self.vote(v, turns.row(v), input);
        // First to the row above, while the segments are small trees, which may be attached where it is doubtful.
        if let Some(above) = v.checked_sub(1) {
            let phases = [input.wrapped.row(above), input.wrapped.row(v)];
            let turns = [turns.row(above), turns.row(v)];
            for run in input.runs.row(above) {
                self.join_below(run, phases, turns, settings);
            }
        }
        self.join_beside(first, costs.right, settings);
    }

    /// Cuts a run into segments.
    #[inline(always)]
    fn cut(&mut self, run: &Run, wrapped: &[f32], turns: &[i16], right: &[u32]) {
        let (start, n) = (run.start(), run.columns().len());
        let phase = &wrapped[run.columns()][..n];
        let right = &right[run.columns()][..n];
        let events = &mut self.events[..n];
        let starts = &mut self.rows[1].starts[run.columns()][..n];
        // What may go on from one pixel to the next is certain and not doubtful: the last bit is 0.
        let ends = |right: u32| (right & 1 != 0) | (right > code(CERTAIN, true));
        events[0] = u8::from(!phase[0].is_nan());
        starts[0] = events[0];
        for i in 1..n {
            let (before, known) = (!phase[i - 1].is_nan(), !phase[i].is_nan());
            let begins = known & (ends(right[i - 1]) | ((start + i) % LONGEST_PX == 0));
            starts[i] = u8::from(begins);
            events[i] = u8::from(begins | (before != known));
        }
        let node = &mut self.rows[1].node;
        let mut open = None;
        each_not_0(events, |i| {
            if let Some(first) = open.take() {
                let turns = turns[usize::from(first)];
                self.segments.push(Segment { first, end: (start + i) as u16, turns });
            }
            if starts[i] != 0 {
                open = Some((start + i) as u16);
                node[start + i..start + i + LONGEST_PX].fill(self.segments.len() as u32);
            }
        });
        if let Some(first) = open {
            let turns = turns[usize::from(first)];
            self.segments.push(Segment { first, end: run.end() as u16, turns });
        }
    }

    /// Counts the votes of the marker's pixels.
    #[inline(always)]
    fn vote(&mut self, v: usize, turns: &[i16], input: &Input<'_>) {
        let (anchor, wrapped) = (input.anchor.row(v), input.wrapped.row(v));
        let (node, forest) = (&self.rows[1].node, &mut self.forest);
        for run in input.runs.row(v) {
            let start = run.start();
            each_not_0(&anchor[run.columns()], |i| {
                let u = start + i;
                if !wrapped[u].is_nan() {
                    // Places of markers count from 1. The wrapped phase of a marker's core is that of its ridge.
                    let order = input.markers[usize::from(anchor[u]) - 1] as i32;
                    forest.vote(node[u], order - i32::from(turns[u]));
                }
            });
        }
    }

    /// Joins the segments from `first` on with those before them in the row.
    #[inline(always)]
    fn join_beside(&mut self, first: usize, right: &[u32], settings: &Settings) {
        for node in first + 1..self.segments.len() {
            let (before, own) = (self.segments[node - 1], self.segments[node]);
            let cost = right[usize::from(before.end) - 1];
            if before.end == own.first && cost != NONE {
                let edge = Edge { a: node as u32 - 1, b: node as u32, turns: 0, doubtful: cost & 1 != 0 };
                self.take(edge, cost >> 8, settings);
            }
        }
    }

    /// Joins the segments of a run of the row above with those below them.
    #[inline(always)]
    fn join_below(&mut self, run: &Run, phases: [&[f32]; 2], turns: [&[i16]; 2], settings: &Settings) {
        let (start, n) = (run.start(), run.columns().len());
        let part = run.columns();
        let [above, below] = phases.map(|row| &row[part.clone()][..n]);
        let [turns_above, turns_below] = turns.map(|row| &row[part.clone()][..n]);
        let down = &self.rows[0].down[part.clone()][..n];
        let (turns, events, sums) = (&mut self.turns[..n], &mut self.events[..n], &mut self.sums[..n + 1]);
        for i in 0..n {
            let more = whole(turns_in(above[i] - below[i])) as i16;
            turns[i] = more.wrapping_add(turns_above[i]).wrapping_sub(turns_below[i]);
        }
        let starts = [0, 1].map(|k: usize| &self.rows[k].starts[part.clone()][..n]);
        let is_edge = |i: usize| down[i] != NONE;
        events[0] = u8::from(is_edge(0));
        for i in 1..n {
            let changes = (starts[0][i] | starts[1][i] != 0) | (turns[i] != turns[i - 1]);
            events[i] = u8::from((is_edge(i) & changes) | (is_edge(i) != is_edge(i - 1)));
        }
        let mut sum = 0u32;
        for (out, &cost) in sums[1..].iter_mut().zip(down) {
            sum = sum.wrapping_add(if cost == NONE { 0 } else { cost });
            *out = sum;
        }
        // The stretches lie between these places; where one ends, the next may begin.
        let mut places = std::mem::take(&mut self.places);
        places.clear();
        each_not_0(events, |i| places.push(i as u16));
        places.push(n as u16);
        for ends in places.windows(2) {
            let (from, to) = (usize::from(ends[0]), usize::from(ends[1]));
            if self.rows[0].down[start + from] == NONE {
                continue;
            }
            let sum = self.sums[to].wrapping_sub(self.sums[from]);
            let (count, doubtful) = ((to - from) as u32, sum & 0xff);
            let edge = Edge {
                a: self.rows[0].node[start + from],
                b: self.rows[1].node[start + from],
                turns: self.turns[from],
                doubtful: DOUBTFUL_SHARE[1] * doubtful > DOUBTFUL_SHARE[0] * count,
            };
            self.take(edge, (sum >> 8) / count, settings);
        }
        self.places = places;
    }

    /// Takes a sure edge, puts another off.
    #[inline(always)]
    fn take(&mut self, edge: Edge, cost: u32, settings: &Settings) {
        if cost <= SURE {
            self.contradictions += usize::from(!self.forest.merge(edge, settings));
        } else {
            self.later.push(((cost.saturating_sub(SURE) / BUCKET) as u16, edge));
        }
    }

    /// Takes all other edges by rising cost; ties as they were found.
    pub fn finish(&mut self, settings: &Settings) {
        let buckets = self.later.iter().map(|(bucket, _)| usize::from(*bucket) + 1).max().unwrap_or(0);
        let mut start = vec![0usize; buckets + 1];
        for (bucket, _) in &self.later {
            start[usize::from(*bucket) + 1] += 1;
        }
        for i in 0..buckets {
            start[i + 1] += start[i];
        }
        self.sorted.clear();
        self.sorted.resize(self.later.len(), Edge::default());
        for (bucket, edge) in &self.later {
            let place = &mut start[usize::from(*bucket)];
            self.sorted[*place] = *edge;
            *place += 1;
        }
        for edge in &self.sorted {
            self.contradictions += usize::from(!self.forest.merge(*edge, settings));
        }
    }
}
