//! Unwrapped and absolute phase of the default method: the anchored spanning forest.
//!
//! ```text
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

mod boxes;
mod costs;
mod forest;
mod segments;

use super::pair::Pair;
use super::runs::{Run, Runs};
use super::simd;
use crate::image::Plane;
use costs::UNITS;
use segments::Graph;
use std::f32::consts::TAU;

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
    /// The same for images of which a row is the mean of so many rows of the sensor.
    #[must_use]
    fn of_rows(self, sensor_rows: usize) -> Self {
        let rows = sensor_rows as u32;
        Self { small_tree_px: self.small_tree_px / rows, min_votes: self.min_votes / rows, ..self }
    }
}

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
    /// Where the absolute phase is known but for the order of its tree, which is not: rows, and stretches of them.
    pub open: Vec<(u32, Run)>,
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
    let Buffers { costs: rows, graph, turns } = buffers;
    let Input { period, misfit, anchor, runs } = *input;
    let wrapped = &*phase;
    let settings = &settings.of_rows(pair.sensor_rows);
    turns.reshape(wrapped.width(), wrapped.height(), 0);
    graph.begin(wrapped.width(), settings);
    let (sign, sensor_rows) = (pair.sign, pair.sensor_rows);
    let steps = costs::Input { wrapped, period, misfit, runs, sign, sensor_rows };
    let nodes = segments::Input { wrapped, anchor, markers: &pair.markers, runs };
    let bounds = costs::Bounds {
        largest: UNITS * settings.max_residual,
        doubtful: UNITS * settings.doubtful_residual,
        doubtful_stretch: UNITS * settings.doubtful_stretch,
    };
    simd::dispatch(
        #[inline(always)]
        || {
            costs::run(
                &steps,
                &bounds,
                rows,
                turns,
                #[inline(always)]
                |v, costs, turns| graph.add_row(v, &costs, turns, &nodes, settings),
            )
        },
    );
    graph.finish(settings);
    simd::dispatch(
        #[inline(always)]
        || {
            let open = write(phase, turns, graph, settings);
            Unwrapped { open, contradictions: graph.contradictions }
        },
    )
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

/// Writes the phases of all segments, those beside each other that belong together at once.
#[inline(always)]
fn write(
    phase: &mut Plane<f32>,
    turns: &Plane<i16>,
    graph: &mut Graph,
    settings: &Settings,
) -> Vec<(u32, Run)> {
    let mut open = Vec::new();
    let (mut node, mut last) = (0, None);
    for v in 0..graph.ends.len() {
        let end = graph.ends[v];
        while node < end {
            let own = place(graph, node, &mut last, settings);
            let mut columns = graph.segments[node].columns();
            node += 1;
            while node < end
                && graph.segments[node].columns().start == columns.end
                && place(graph, node, &mut last, settings) == own
            {
                columns.end = graph.segments[node].columns().end;
                node += 1;
            }
            let phases = phase.row_mut(v)[columns.clone()].iter_mut();
            for (phase, &turns) in phases.zip(&turns.row(v)[columns.clone()]) {
                *phase += TAU * (own.turns + i32::from(turns)) as f32;
            }
            if own.tree != 0 {
                open.push((v as u32, Run::new(columns.start, columns.end)));
            }
        }
    }
    open
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

    /// Unwraps a planted absolute phase (NaN: no surface) whose fringe 80 is the marker in `marker_rows`.
    fn run(truth: &Plane<f32>, marker_rows: std::ops::Range<usize>) -> Found {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/rig.toml");
        let calibration = Calibration::nominal(&Rig::load(&path).expect("the shipped rig"));
        let head = &calibration.heads[0];
        let mut pair = Pair::new(head, &head.cameras[0], &calibration).expect("a usable pair");
        pair.sign = 1.0;
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
        let refused_px = found.open.iter().map(|(_, run)| run.columns().len()).sum();
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
        fn a_smooth_surface_is_unwrapped_whole(tilt in -0.4f32..0.4, curve in -0.0005f32..0.0005) {
            let truth = surface(tilt, curve);
            let found = run(&truth, 0..H);
            for (found, truth) in found.phase.as_slice().iter().zip(truth.as_slice()) {
                prop_assert!((found - truth).abs() < 1e-2, "{found} {truth}");
            }
            prop_assert_eq!(found.refused_px, 0);
        }

        #[test]
        fn no_order_is_guessed_beyond_a_depth_step(step in 0.8f32..5.4, tilt in -0.1f32..0.1) {
            // The lower half lies `step` rad and two fringes nearer; only the upper half shows the marker.
            let mut truth = surface(tilt, 0.0);
            for v in 50..H {
                truth.row_mut(v).iter_mut().for_each(|x| *x += step + 2.0 * TAU);
            }
            let found = run(&truth, 0..45);
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

    #[test]
    fn trees_whose_markers_contradict_stay_apart() {
        // Two halves joined almost seamlessly modulo 2 pi, two fringes apart, each with its marker.
        let mut truth = surface(0.0, 0.0);
        for v in 45..H {
            truth.row_mut(v).iter_mut().for_each(|x| *x += 2.0 * TAU + 0.03);
        }
        let found = run(&truth, 0..H);
        assert!(found.contradictions > 0);
        let wrong =
            found.phase.as_slice().iter().zip(truth.as_slice()).filter(|(a, b)| (*a - *b).abs() > 1.0);
        assert!(wrong.count() < 3 * W, "only the seam may be wrong");
    }

    #[test]
    fn without_a_marker_everything_is_refused() {
        let found = run(&surface(0.1, 0.0), 0..0);
        assert!(found.phase.as_slice().iter().all(|x| x.is_nan()));
        assert_eq!(found.refused_px, W * H);
    }
}
