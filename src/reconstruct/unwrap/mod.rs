//! Unwrapped and absolute phase of the default method: the anchored spanning forest.
//!
//! ```text
//! blocks     a few pixels side by side, which are one in the forest where rows are taken in pairs, and back to the pixels
//! boxes      sums over boxes of pixels
//! costs      how far each pixel's steps to the right and down are from what is expected
//! segments   nodes: stretches of a row whose steps are certain; edges: where they touch
//! forest     trees of nodes, with the votes of the marker
//! ```
//!
//! Edges are taken in the order of their carrier residual: how far the wrapped step differs from the one that the local
//! period predicts (`2 pi / P` along the row, none along the column), averaged along the boundary that the
//! edge crosses, because on the edge of an arm single pixels always agree by chance. Each tree carries the
//! fringe order that its marker pixels vote for; a merge of two trees whose votes contradict is refused, and
//! so is a merge of two large trees across a doubtful edge. Trees without enough votes stay unresolved: the
//! fringe order is never guessed.

mod blocks;
mod boxes;
mod costs;
mod forest;
mod segments;

use super::pair::Pair;
use super::runs::{Run, Runs};
use super::simd;
use crate::image::Plane;
use blocks::{Blocks, COLUMNS};
use costs::UNITS;
use segments::{Graph, Votes};
use std::f32::consts::TAU;
use std::ops::Range;

/// Settings of the forest.
#[derive(Debug, Clone, Copy)]
pub struct Settings {
    /// Steps further than this from the prediction are never taken, rad; less than 2, for what a code of a cost has room for.
    pub max_residual: f32,
    /// Above this averaged residual an edge only attaches small trees, rad.
    pub doubtful_residual: f32,
    /// The same for the residual averaged over a wider stretch, rad: where the outline of a limb crosses the
    /// fringes, the phases on both sides agree over a short stretch by chance.
    pub doubtful_stretch: f32,
    /// The largest tree that a doubtful edge attaches, px of the sensor.
    pub small_tree_px: u32,
    /// Votes from which a tree's order counts as known, of px of the sensor.
    pub min_votes: u32,
}

impl Settings {
    /// The same for images of which a pixel stands for so many columns, and is the mean of so many rows, of the sensor.
    #[must_use]
    fn of(self, sensor_columns: usize, sensor_rows: usize) -> Self {
        let (columns, rows) = (sensor_columns as u32, sensor_rows as u32);
        let rougher = if sensor_columns > 1 { BLOCKS_ROUGHER } else { 1.0 };
        Self {
            doubtful_residual: rougher * self.doubtful_residual,
            doubtful_stretch: rougher * self.doubtful_stretch,
            small_tree_px: self.small_tree_px / rows / columns,
            min_votes: self.min_votes / rows,
            ..self
        }
    }
}

/// How much larger residuals are between blocks than between pixels, whose windows have more in common.
const BLOCKS_ROUGHER: f32 = 2.0;

impl Default for Settings {
    fn default() -> Self {
        Self {
            max_residual: 1.5,
            doubtful_residual: 0.04,
            doubtful_stretch: 0.04,
            small_tree_px: 60,
            min_votes: 20,
        }
    }
}

/// What came of the forest, beside the phases.
#[derive(Debug)]
pub struct Unwrapped {
    /// Where the absolute phase is known but for the order of its tree, which is not: rows, and stretches of them, in which single pixels may
    /// have no phase at all.
    pub open: Vec<(u32, Run)>,
    /// Phases that lack an order.
    pub open_px: usize,
    /// Merges refused because the votes contradicted.
    pub contradictions: usize,
}

/// Takes away the phases that lack an order.
pub fn refuse(phase: &mut Plane<f32>, open: &[(u32, Run)]) {
    for (v, run) in open {
        phase.row_mut(*v as usize)[run.columns()].fill(f32::NAN);
    }
}

/// What the forest uses again from frame to frame.
#[derive(Debug, Default)]
pub struct Buffers {
    costs: costs::Buffers,
    graph: Graph,
    turns: Plane<i16>,
    blocks: Blocks,
}

/// What a frame's forest is made of.
#[derive(Debug, Clone, Copy)]
pub struct Input<'a> {
    /// Pm, px.
    pub period: &'a Plane<f32>,
    /// Misfit of the fringe model.
    pub misfit: &'a Plane<f32>,
    /// Places of the markers in [`Pair::markers`], from 1, on their cores; 0 elsewhere.
    pub anchor: &'a Plane<u8>,
    /// Every known phase lies in one of these.
    pub runs: &'a Runs,
}

/// Unwraps the wrapped phase Wm, rad (NaN: unknown), in place: every known phase becomes the absolute one, with the marker's pixels as
/// anchors, or one that lacks the order of its tree.
pub fn unwrap(
    phase: &mut Plane<f32>,
    input: &Input<'_>,
    pair: &Pair,
    settings: &Settings,
    buffers: &mut Buffers,
) -> Unwrapped {
    let Buffers { costs: rows, graph, turns, blocks } = buffers;
    let Input { period, misfit, anchor, runs } = *input;
    let (sign, sensor_rows, markers) = (pair.sign, pair.sensor_rows, &pair.markers[..]);
    if sensor_rows == 1 {
        let wrapped = &*phase;
        let steps = costs::Input { wrapped, period, misfit, runs, sign, sensor_columns: 1, sensor_rows };
        let votes = Votes { anchor, markers, phase, runs, blocks: None };
        let settings = &settings.of(1, 1);
        grow(&steps, votes, settings, rows, graph, turns);
        let row_of = |v: usize| Pixels { turns: turns.row(v) };
        return simd::dispatch(
            #[inline(always)]
            || write(phase, row_of, graph, settings),
        );
    }
    blocks.take(phase, input, sign);
    let Blocks { wrapped, period, misfit, runs: in_blocks, .. } = &*blocks;
    let sensor_columns = COLUMNS;
    let steps = costs::Input { wrapped, period, misfit, runs: in_blocks, sign, sensor_columns, sensor_rows };
    let votes = Votes { anchor, markers, phase, runs, blocks: Some(blocks) };
    let settings = &settings.of(COLUMNS, sensor_rows);
    grow(&steps, votes, settings, rows, graph, turns);
    let row_of = |v: usize| blocks.row(v, turns.row(v), sign);
    simd::dispatch(
        #[inline(always)]
        || write(phase, row_of, graph, settings),
    )
}

/// Grows the forest. `turns` receives how many whole turns make each phase continue those before it in its run.
fn grow(
    steps: &costs::Input<'_>,
    votes: Votes<'_>,
    settings: &Settings,
    rows: &mut costs::Buffers,
    graph: &mut Graph,
    turns: &mut Plane<i16>,
) {
    let (wrapped, runs) = (steps.wrapped, steps.runs);
    turns.reshape(wrapped.width(), wrapped.height(), 0);
    graph.begin(wrapped.width(), settings);
    let nodes = segments::Input { wrapped, runs, votes };
    let bounds = costs::Bounds {
        largest: UNITS * settings.max_residual,
        doubtful: UNITS * settings.doubtful_residual,
        doubtful_stretch: UNITS * settings.doubtful_stretch,
    };
    simd::dispatch(
        #[inline(always)]
        || {
            costs::run(
                steps,
                &bounds,
                rows,
                turns,
                #[inline(always)]
                |v, costs, turns| graph.add_row(v, &costs, turns, &nodes, settings),
            )
        },
    );
    graph.finish(settings);
}

/// Where the phases of a segment go.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Place {
    /// Whole turns of the segment.
    turns: i32,
    /// 0 where they are those of the absolute phase, else the number of the open tree.
    tree: u32,
}

/// Where the phases of a node's segment go. `last`: the tree of the node before, most often the same, and where its root's go.
#[inline(always)]
fn place(graph: &mut Graph, node: usize, last: &mut Option<(u32, Place)>, settings: &Settings) -> Place {
    let (root, turns) = graph.forest.find(node as u32);
    let base = match *last {
        Some((tree, base)) if tree == root => base,
        _ => match graph.forest.order(root, settings.min_votes) {
            Some(order) => Place { turns: order, tree: 0 },
            // From where the tree begins: trees beside each other must not seem to continue each other.
            None => Place { turns: -i32::from(graph.segments[root as usize].turns), tree: root + 1 },
        },
    };
    *last = Some((root, base));
    Place { turns: base.turns + turns, tree: base.tree }
}

/// A row's turns, and how they are written to its phases. What the forest is made of is a block, though it may be a pixel.
trait Write {
    /// Pixels of a block.
    const COLUMNS: usize;

    /// Adds the turns of some blocks, and `base`, to the pixels of a row.
    fn add(&self, phase: &mut [f32], blocks: Range<usize>, base: i32);

    /// Gives the last pixels of the block before `block` to that, if they go better with it than with their own; `bases` are those of
    /// both. The pixels of the one before have their turns. Returns how many did.
    fn part(&self, phase: &mut [f32], block: usize, bases: [i32; 2]) -> usize;
}

/// A row of pixels.
#[derive(Debug, Clone, Copy)]
struct Pixels<'a> {
    turns: &'a [i16],
}

impl Write for Pixels<'_> {
    const COLUMNS: usize = 1;

    #[inline(always)]
    fn add(&self, phase: &mut [f32], blocks: Range<usize>, base: i32) {
        for (phase, &turns) in phase[blocks.clone()].iter_mut().zip(&self.turns[blocks]) {
            *phase += TAU * (base + i32::from(turns)) as f32;
        }
    }

    #[inline(always)]
    fn part(&self, _: &mut [f32], _: usize, _: [i32; 2]) -> usize {
        0
    }
}

/// Writes the phases of all segments, those beside each other that belong together at once.
#[inline(always)]
fn write<R: Write>(
    phase: &mut Plane<f32>,
    row_of: impl Fn(usize) -> R,
    graph: &mut Graph,
    settings: &Settings,
) -> Unwrapped {
    let (mut open, mut open_px) = (Vec::new(), 0);
    let (mut node, mut last) = (0, None);
    for v in 0..graph.ends.len() {
        let (row, end) = (row_of(v), graph.ends[v]);
        let to = phase.row_mut(v);
        let width = to.len();
        // What was written last: its place, and the block behind it.
        let mut before: Option<(Place, usize)> = None;
        while node < end {
            let own = place(graph, node, &mut last, settings);
            let first = node;
            let mut blocks = graph.segments[node].columns();
            node += 1;
            while node < end
                && graph.segments[node].columns().start == blocks.end
                && place(graph, node, &mut last, settings) == own
            {
                blocks.end = graph.segments[node].columns().end;
                node += 1;
            }
            let mut begin = R::COLUMNS * blocks.start;
            if let Some((before, end)) = before
                && end == blocks.start
            {
                let taken = row.part(to, blocks.start, [before.turns, own.turns]);
                begin -= taken;
                // They are no longer of the open tree that is before.
                if before.tree != 0
                    && let Some((_, run)) = open.last_mut()
                {
                    *run = Run::new(Run::start(run), begin);
                    open_px -= taken;
                }
            }
            row.add(to, blocks.clone(), own.turns);
            for segment in &graph.segments[first + 1..node] {
                row.part(to, segment.columns().start, [own.turns; 2]);
            }
            if own.tree != 0 {
                let columns = begin..(R::COLUMNS * blocks.end).min(width);
                open_px += to[columns.clone()].iter().filter(|phase| !phase.is_nan()).count();
                open.push((v as u32, Run::new(columns.start, columns.end)));
            }
            before = Some((own, blocks.end));
        }
    }
    Unwrapped { open, open_px, contradictions: graph.contradictions }
}

#[cfg(test)]
mod tests {
    use super::{Buffers, Input, Settings, refuse, unwrap};
    use crate::calibrate::Calibration;
    use crate::config::Rig;
    use crate::image::Plane;
    use crate::reconstruct::pair::Pair;
    use crate::reconstruct::runs::Runs;
    use proptest::prelude::{ProptestConfig, prop_assert, prop_assert_eq, proptest};
    use std::f32::consts::TAU;
    use std::path::Path;

    const W: usize = 140;
    const H: usize = 90;
    const PERIOD: f32 = 11.0;

    /// What was found of a planted phase.
    struct Found {
        /// NaN where it was refused.
        phase: Plane<f32>,
        refused_px: usize,
        contradictions: usize,
    }

    /// Unwraps a planted absolute phase (NaN: no surface) whose fringe 80 is the marker in `marker_rows`. A row is the mean of so many
    /// of the sensor.
    fn run(truth: &Plane<f32>, marker_rows: std::ops::Range<usize>, sensor_rows: usize) -> Found {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/rig.toml");
        let calibration = Calibration::nominal(&Rig::load(&path).expect("the shipped rig"));
        let head = &calibration.heads[0];
        let mut pair = Pair::new(head, &head.cameras[0], &calibration).expect("a usable pair");
        (pair.sign, pair.sensor_rows) = (1.0, sensor_rows);
        let map = |f: &dyn Fn(f32) -> f32| {
            Plane::from_vec(W, H, truth.as_slice().iter().map(|&x| f(x)).collect()).expect("same size")
        };
        let mut phase = map(&|x| x - TAU * (x / TAU).round());
        let mut anchor = Plane::filled(W, H, 0u8);
        for v in marker_rows {
            for u in 0..W {
                anchor.set(u, v, u8::from((truth.at(u, v) - 80.0 * TAU).abs() < 1.5));
            }
        }
        let (period, misfit) = (map(&|_| PERIOD), map(&|_| 0.0));
        let known = truth.as_slice().iter().map(|x| u8::from(!x.is_nan())).collect();
        let runs = Runs::of(&Plane::from_vec(W, H, known).expect("same size"));
        let input = Input { period: &period, misfit: &misfit, anchor: &anchor, runs: &runs };
        let found = unwrap(&mut phase, &input, &pair, &Settings::default(), &mut Buffers::default());
        refuse(&mut phase, &found.open);
        let refused_px = found.open_px;
        Found { phase, refused_px, contradictions: found.contradictions }
    }

    /// A tilted, gently curved surface that shows the marker near column 60.
    fn surface(tilt: f32, curve: f32) -> Plane<f32> {
        let mut truth = Plane::filled(W, H, f32::NAN);
        for v in 0..H {
            for u in 0..W {
                let (x, y) = (u as f32 - 60.0, v as f32 - 45.0);
                truth.set(u, v, 80.0 * TAU + TAU * x / PERIOD + tilt * y + curve * (x * x + y * y));
            }
        }
        truth
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]
        #[test]
        fn a_smooth_surface_is_unwrapped_whole(
            tilt in -0.4f32..0.4,
            curve in -0.0005f32..0.0005,
            sensor_rows in 1usize..=2,
        ) {
            let truth = surface(tilt, curve);
            let found = run(&truth, 0..H, sensor_rows);
            for (found, truth) in found.phase.as_slice().iter().zip(truth.as_slice()) {
                prop_assert!((found - truth).abs() < 1e-2, "{found} {truth}");
            }
            prop_assert_eq!(found.refused_px, 0);
        }

        #[test]
        fn no_order_is_guessed_beyond_a_depth_step(
            step in 0.8f32..5.4,
            tilt in -0.1f32..0.1,
            sensor_rows in 1usize..=2,
        ) {
            // The lower half lies `step` rad and two fringes nearer; only the upper half shows the marker.
            let mut truth = surface(tilt, 0.0);
            for v in 50..H {
                truth.row_mut(v).iter_mut().for_each(|x| *x += step + 2.0 * TAU);
            }
            let found = run(&truth, 0..45, sensor_rows);
            for v in 0..H {
                for u in 0..W {
                    let (found, truth) = (found.phase.at(u, v), truth.at(u, v));
                    prop_assert!(found.is_nan() || (found - truth).abs() < 1e-2, "({u}, {v})");
                    // Rows just before the step may go with it.
                    prop_assert!(found.is_nan() || v < 50, "({u}, {v})");
                    prop_assert!(!found.is_nan() || v >= 44, "({u}, {v})");
                }
            }
            prop_assert!(found.refused_px >= (H - 50) * W);
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]
        #[test]
        fn no_order_is_guessed_beside_a_depth_step(step in 0.8f32..5.4, at in 80usize..100, sensor_rows in 1usize..=2) {
            // The right part lies `step` rad and two fringes nearer; only the left one shows the marker.
            let mut truth = surface(0.0, 0.0);
            for v in 0..H {
                truth.row_mut(v)[at..].iter_mut().for_each(|x| *x += step + 2.0 * TAU);
            }
            let found = run(&truth, 0..H, sensor_rows);
            let pixels = || found.phase.as_slice().iter().zip(truth.as_slice()).enumerate();
            for (i, (found, truth)) in pixels() {
                let u = i % W;
                prop_assert!(found.is_nan() || (found - truth).abs() < 1e-2, "column {u}: {found} {truth}");
                // Columns just before the step may go with it.
                prop_assert!(if u < at { u + 10 > at || !found.is_nan() } else { found.is_nan() }, "column {u}");
            }
            prop_assert_eq!(found.refused_px, pixels().filter(|(_, (found, _))| found.is_nan()).count());
        }
    }

    #[test]
    fn trees_whose_markers_contradict_stay_apart() {
        // Two halves joined almost seamlessly modulo 2 pi, two fringes apart, each with its marker.
        let mut truth = surface(0.0, 0.0);
        for v in 45..H {
            truth.row_mut(v).iter_mut().for_each(|x| *x += 2.0 * TAU + 0.03);
        }
        for sensor_rows in 1..=2 {
            let found = run(&truth, 0..H, sensor_rows);
            assert!(found.contradictions > 0);
            let pixels = found.phase.as_slice().iter().zip(truth.as_slice());
            let wrong = pixels.filter(|(found, truth)| (*found - *truth).abs() > 1.0);
            assert!(wrong.count() < 3 * W, "only the seam may be wrong");
        }
    }

    #[test]
    fn without_a_marker_everything_is_refused() {
        for sensor_rows in 1..=2 {
            let found = run(&surface(0.1, 0.0), 0..0, sensor_rows);
            assert!(found.phase.as_slice().iter().all(|x| x.is_nan()));
            assert_eq!(found.refused_px, W * H);
        }
    }
}
