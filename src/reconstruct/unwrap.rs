//! Unwrapped and absolute phase of the default method: the anchored spanning forest.
//!
//! The graph has a node per pixel of known wrapped phase and an edge per pair of neighbours. Edges are taken
//! in the order of their carrier residual: how far the wrapped step differs from the one that the local
//! period predicts (`2 pi / P` along the row, none along the column), averaged along the boundary that the
//! edge crosses, because on the edge of an arm single pixels always agree by chance. Each tree carries the
//! fringe order that its marker pixels vote for; a merge of two trees whose votes contradict is refused, and
//! so is a merge of two large trees across a doubtful edge. Trees without enough votes stay unresolved: the
//! fringe order is never guessed.

use super::pair::Pair;
use super::simd;
use crate::image::Plane;
use std::f32::consts::{PI, TAU};

/// Settings of the forest.
#[derive(Debug, Clone, Copy)]
pub struct Settings {
    /// Steps further than this from the prediction are never taken, rad.
    pub max_residual: f32,
    /// Above this averaged residual an edge only attaches small trees, rad.
    pub doubtful_residual: f32,
    /// The same for the residual averaged over a wider stretch, rad: where the outline of a limb crosses the
    /// fringes, the phases on both sides agree over a short stretch by chance.
    pub doubtful_stretch: f32,
    /// The largest tree that a doubtful edge attaches, px.
    pub small_tree_px: u32,
    /// Votes from which a tree's order counts as known.
    pub min_votes: u32,
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

/// What came of the forest.
#[derive(Debug)]
pub struct Unwrapped {
    /// Absolute phase, rad; NaN where it is unresolved.
    pub absolute: Plane<f32>,
    /// The trees without a known order.
    pub open: OpenTrees,
    /// Pixels in trees without a known order.
    pub refused_px: usize,
    /// Merges refused because the votes contradicted.
    pub contradictions: usize,
}

/// Pixels whose phase is known but for the order of the tree that they belong to.
#[derive(Debug)]
pub struct OpenTrees {
    /// Phase within the tree, rad; meaningless where `tree` is 0.
    pub relative: Plane<f32>,
    /// Tree of each pixel, 0 where there is none; the numbers have no order.
    pub tree: Plane<u32>,
}

impl OpenTrees {
    /// No trees.
    pub fn none(width: usize, height: usize) -> Self {
        Self { relative: Plane::filled(width, height, 0.0), tree: Plane::filled(width, height, 0) }
    }
}

/// Resolution of the edge order, rad.
const BUCKET_RAD: f32 = 1.0 / 256.0;

/// Edges below this residual need no order among themselves, rad: they are taken as they lie in memory.
const SURE_RAD: f32 = 0.02;

/// Unwraps `wrapped` (NaN: unknown) with the marker pixels as absolute anchors: `anchor` is the place of their marker
/// in [`Pair::markers`], from 1, and 0 elsewhere.
pub fn unwrap(
    wrapped: &Plane<f32>,
    period: &Plane<f32>,
    misfit: &Plane<f32>,
    anchor: &Plane<u8>,
    pair: &Pair,
    settings: &Settings,
) -> Unwrapped {
    let costs = Costs::new(wrapped, period, misfit, pair.sign);
    let edges = costs.sorted_edges(wrapped, period, settings);
    let mut forest = Forest::new(anchor, &pair.markers);
    let phase = wrapped.as_slice();
    let mut contradictions = 0;
    for edge in edges {
        let a = edge.pixel();
        let b = if edge.is_vertical() { a + wrapped.width() } else { a + 1 };
        contradictions += usize::from(!forest.merge(a, b, edge.turns(), edge.is_doubtful(), settings));
    }
    let mut refused_px = 0;
    let mut absolute = Plane::filled(wrapped.width(), wrapped.height(), f32::NAN);
    let mut open = OpenTrees::none(wrapped.width(), wrapped.height());
    for (i, out) in absolute.as_mut_slice().iter_mut().enumerate() {
        if phase[i].is_nan() {
            continue;
        }
        let (root, turns) = forest.find(i);
        match forest.order(root, settings.min_votes) {
            Some(order) => *out = phase[i] + TAU * (order + turns) as f32,
            None => {
                refused_px += 1;
                open.relative.as_mut_slice()[i] = phase[i] + TAU * turns as f32;
                open.tree.as_mut_slice()[i] = root as u32 + 1;
            }
        }
    }
    Unwrapped { absolute, open, refused_px, contradictions }
}

/// Costs of the edges to the right and down of each pixel; NaN: no edge.
struct Costs {
    right: Plane<f32>,
    down: Plane<f32>,
    right_stretch: Plane<f32>,
    down_stretch: Plane<f32>,
    carrier: f32,
}

/// A window that crosses a depth step does not hold a sine: what the misfit of the fringe model has above this
/// is added to the cost, 1 rad per unit. On smooth skin the misfit stays below it.
const GOOD_MISFIT: f32 = 0.2;

/// Half sizes (columns, rows) of the box in which the local mean step is taken.
const MEAN_STEP_BOX: (usize, usize) = (5, 3);

/// Half sizes (columns, rows) of the boxes in which residuals are averaged: along the boundary that steps to
/// the right and steps down cross.
const ALONG_RIGHT: (usize, usize) = (1, 3);
const ALONG_DOWN: (usize, usize) = (4, 1);

/// Half sizes (columns, rows) of the box that says whether phases agree over a longer stretch.
const STRETCH: (usize, usize) = (9, 10);

impl Costs {
    fn new(wrapped: &Plane<f32>, period: &Plane<f32>, misfit: &Plane<f32>, sign: f32) -> Self {
        let (w, h) = (wrapped.width(), wrapped.height());
        let mut right = Plane::filled(w, h, f32::NAN);
        let mut down = Plane::filled(w, h, f32::NAN);
        let carrier = sign * TAU;
        simd::dispatch(
            #[inline(always)]
            || {
                for v in 0..h {
                    let (row, p) = (wrapped.row(v), period.row(v));
                    let (steps, periods) = (row.windows(2), p.windows(2));
                    for ((out, x), p) in right.row_mut(v).iter_mut().zip(steps).zip(periods) {
                        *out = wrap(x[1] - x[0] - 2.0 * carrier / (p[0] + p[1]));
                    }
                    if v + 1 < h {
                        for ((out, a), b) in down.row_mut(v).iter_mut().zip(row).zip(wrapped.row(v + 1)) {
                            *out = wrap(b - a);
                        }
                    }
                }
            },
        );
        let (right, right_stretch) = cost(&right, ALONG_RIGHT);
        let (down, down_stretch) = cost(&down, ALONG_DOWN);
        let mut costs = Self { right, down, right_stretch, down_stretch, carrier };
        for plane in [&mut costs.right, &mut costs.down] {
            for (x, misfit) in plane.as_mut_slice().iter_mut().zip(misfit.as_slice()) {
                *x += (misfit - GOOD_MISFIT).max(0.0);
            }
        }
        costs
    }

    /// The edges by rising cost; ties in the order of the pixels.
    fn sorted_edges(&self, wrapped: &Plane<f32>, period: &Plane<f32>, settings: &Settings) -> Vec<Edge> {
        // The cast takes what is negative to 0.
        let bucket = |cost: f32| ((cost - SURE_RAD) / BUCKET_RAD) as usize;
        let buckets = bucket(settings.max_residual) + 1;
        let mut start = vec![0u32; buckets + 1];
        let (right, down) = (self.right.as_slice(), self.down.as_slice());
        for &cost in right.iter().chain(down) {
            if cost <= settings.max_residual {
                start[bucket(cost) + 1] += 1;
            }
        }
        for i in 0..buckets {
            start[i + 1] += start[i];
        }
        let stretches = [self.right_stretch.as_slice(), self.down_stretch.as_slice()];
        let (phase, period) = (wrapped.as_slice(), period.as_slice());
        let mut edges = vec![Edge(0); start[buckets] as usize];
        for pixel in 0..right.len() {
            for (cost, stretch, vertical) in
                [(right[pixel], stretches[0][pixel], false), (down[pixel], stretches[1][pixel], true)]
            {
                if cost <= settings.max_residual {
                    // The step that the period predicts to the next in the row; none down the column.
                    let (next, expected) = if vertical {
                        (pixel + wrapped.width(), 0.0)
                    } else {
                        (pixel + 1, 2.0 * self.carrier / (period[pixel] + period[pixel + 1]))
                    };
                    let turns = nearest((expected - (phase[next] - phase[pixel])) / TAU);
                    let doubtful = cost > settings.doubtful_residual || stretch > settings.doubtful_stretch;
                    let place = &mut start[bucket(cost)];
                    edges[*place as usize] = Edge::new(pixel, vertical, doubtful, turns);
                    *place += 1;
                }
            }
        }
        edges
    }
}

/// An edge in one word: everything that a merge must know, so that it looks nowhere else.
#[derive(Clone, Copy)]
struct Edge(u32);

impl Edge {
    /// From `pixel` to the right or down, over `turns` whole turns: -1, 0 or 1, because phases are wrapped.
    fn new(pixel: usize, vertical: bool, doubtful: bool, turns: i32) -> Self {
        Self((pixel as u32) << 4 | ((turns + 1) as u32) << 2 | u32::from(doubtful) << 1 | u32::from(vertical))
    }

    fn pixel(self) -> usize {
        (self.0 >> 4) as usize
    }

    fn turns(self) -> i32 {
        (self.0 >> 2 & 3) as i32 - 1
    }

    fn is_doubtful(self) -> bool {
        self.0 & 2 != 0
    }

    fn is_vertical(self) -> bool {
        self.0 & 1 != 0
    }
}

/// How far each step is from the local mean step, averaged along the boundary: the larger of that mean and of
/// the edge's own. Second, the mean over a wider stretch.
fn cost(step: &Plane<f32>, along: (usize, usize)) -> (Plane<f32>, Plane<f32>) {
    let mean = box_mean(&packed(step), MEAN_STEP_BOX);
    let mut own = step.clone();
    simd::dispatch(
        #[inline(always)]
        || {
            for (x, mean) in own.as_mut_slice().iter_mut().zip(mean.as_slice()) {
                *x = wrap(*x - mean).abs();
            }
        },
    );
    let values = packed(&own);
    let averaged = box_mean(&values, along);
    let stretch = box_mean(&values, STRETCH);
    simd::dispatch(
        #[inline(always)]
        || {
            for (x, averaged) in own.as_mut_slice().iter_mut().zip(averaged.as_slice()) {
                // NaN stays: there is no edge.
                *x = if *x < *averaged { *averaged } else { *x };
            }
        },
    );
    (own, stretch)
}

/// Bits of a packed sum that count its values: boxes have fewer than 512 pixels.
const COUNT_BITS: u32 = 9;

/// A whole number of thousandths (1024ths) and a count of one in the same word; 0 for NaN. Sums of them are sums of both, and
/// what is added and taken off again cancels exactly. A box of [`STRETCH`] with pi in every pixel is below 2^31.
fn packed(values: &Plane<f32>) -> Plane<i32> {
    let mut out = Plane::filled(values.width(), values.height(), 0i32);
    simd::dispatch(
        #[inline(always)]
        || {
            for (out, &x) in out.as_mut_slice().iter_mut().zip(values.as_slice()) {
                let whole = (nearest(x * 1024.0) << COUNT_BITS) | 1;
                *out = if x.is_nan() { 0 } else { whole };
            }
        },
    );
    out
}

/// Mean of the packed values in a box of +-`half` (columns, rows); 0 where there are none.
fn box_mean(values: &Plane<i32>, half: (usize, usize)) -> Plane<f32> {
    let (w, h) = (values.width(), values.height());
    let mut out = Plane::filled(w, h, 0f32);
    // Sums over the rows of the box, kept up to date as the box moves down.
    let mut sums = vec![0i32; w];
    // Running sums along the row with `half` columns of nothing before, and of the last sum behind.
    let mut running = vec![0i32; w + 2 * half.0 + 1];
    simd::dispatch(
        #[inline(always)]
        || {
            for v in 0..half.1.min(h) {
                add(&mut sums, values.row(v));
            }
            for v in 0..h {
                if v + half.1 < h {
                    add(&mut sums, values.row(v + half.1));
                }
                if v > half.1 {
                    take(&mut sums, values.row(v - half.1 - 1));
                }
                let mut sum = 0i32;
                for (running, x) in running[half.0 + 1..].iter_mut().zip(&sums) {
                    sum = sum.wrapping_add(*x);
                    *running = sum;
                }
                running[half.0 + 1 + w..].fill(sum);
                let ends = running.iter().zip(&running[2 * half.0 + 1..]);
                for (out, (before, last)) in out.row_mut(v).iter_mut().zip(ends) {
                    let packed = last.wrapping_sub(*before);
                    let count = packed & ((1 << COUNT_BITS) - 1);
                    *out = (packed >> COUNT_BITS) as f32 / (1024 * count.max(1)) as f32;
                }
            }
        },
    );
    out
}

#[inline(always)]
fn add(sums: &mut [i32], row: &[i32]) {
    sums.iter_mut().zip(row).for_each(|(sum, x)| *sum = sum.wrapping_add(*x));
}

#[inline(always)]
fn take(sums: &mut [i32], row: &[i32]) {
    sums.iter_mut().zip(row).for_each(|(sum, x)| *sum = sum.wrapping_sub(*x));
}

/// To the nearest whole number, halves away from zero; 0 for NaN. What `f32::round` does is a call into the C library
/// on processors that may lack SSE 4.1.
#[inline(always)]
fn nearest(x: f32) -> i32 {
    (x + 0.5f32.copysign(x)) as i32
}

/// To (-pi, pi].
#[inline(always)]
fn wrap(x: f32) -> f32 {
    let y = x - nearest(x / TAU) as f32 * TAU;
    if y <= -PI { y + TAU } else { y }
}

/// Union-find whose links carry whole turns, and whose roots carry the marker's votes.
struct Forest {
    links: Vec<Link>,
    /// Of the roots.
    trees: Vec<Tree>,
}

/// A pixel's way to its root.
#[derive(Clone, Copy)]
struct Link {
    parent: u32,
    /// Turns of the pixel relative to its parent.
    turns: i32,
}

/// What a root knows of its tree.
#[derive(Clone, Copy)]
struct Tree {
    size: u32,
    /// Order that the votes give the root, and how many they are.
    order: i32,
    votes: u32,
}

impl Forest {
    /// Every pixel by itself. An anchor is the place of its marker in `markers`, from 1; the wrapped phase of a
    /// marker's core is that of its ridge.
    fn new(anchor: &Plane<u8>, markers: &[u32]) -> Self {
        let order = |anchor: u8| anchor.checked_sub(1).map_or(0, |place| markers[usize::from(place)] as i32);
        let tree = |&anchor: &u8| Tree { size: 1, order: order(anchor), votes: u32::from(anchor != 0) };
        let pixels = 0..anchor.as_slice().len() as u32;
        Self {
            links: pixels.map(|parent| Link { parent, turns: 0 }).collect(),
            trees: anchor.as_slice().iter().map(tree).collect(),
        }
    }

    /// Root of a pixel, and the pixel's turns relative to it.
    fn find(&mut self, pixel: usize) -> (usize, i32) {
        let (mut root, mut turns) = (pixel, 0);
        loop {
            let link = self.links[root];
            if link.parent as usize == root {
                break;
            }
            turns += link.turns;
            root = link.parent as usize;
        }
        // Second pass: every pixel on the way points at the root.
        let (mut at, mut rest) = (pixel, turns);
        while at != root {
            let link = self.links[at];
            if link.parent as usize == root {
                break;
            }
            self.links[at] = Link { parent: root as u32, turns: rest };
            rest -= link.turns;
            at = link.parent as usize;
        }
        (root, turns)
    }

    fn order(&self, root: usize, min_votes: u32) -> Option<i32> {
        let tree = self.trees[root];
        (tree.votes >= min_votes).then_some(tree.order)
    }

    /// Merges the trees of `a` and `b`, where `b` has `turns` more whole turns than `a`. False when the votes
    /// of two trees of known order contradict.
    fn merge(&mut self, a: usize, b: usize, turns: i32, doubtful: bool, settings: &Settings) -> bool {
        let (mut root, turns_a) = self.find(a);
        let (mut other, turns_b) = self.find(b);
        if root == other {
            return true;
        }
        let (mut tree, mut small) = (self.trees[root], self.trees[other]);
        if doubtful && tree.size.min(small.size) > settings.small_tree_px {
            return true;
        }
        // Turns of `other` relative to `root`.
        let mut shift = turns_a + turns - turns_b;
        if tree.size < small.size {
            (root, other, shift) = (other, root, -shift);
            std::mem::swap(&mut tree, &mut small);
        }
        // The order that the other tree's votes give this root.
        let order_other = small.order - shift;
        if tree.votes > 0 && small.votes > 0 && tree.order != order_other {
            if tree.votes.min(small.votes) >= settings.min_votes {
                return false;
            }
            if small.votes > tree.votes {
                tree.order = order_other;
            }
            tree.votes = tree.votes.abs_diff(small.votes);
        } else {
            if tree.votes == 0 {
                tree.order = order_other;
            }
            tree.votes += small.votes;
        }
        tree.size += small.size;
        self.trees[root] = tree;
        self.links[other] = Link { parent: root as u32, turns: shift };
        true
    }
}

#[cfg(test)]
mod tests {
    use super::{Settings, Unwrapped, unwrap, wrap};
    use crate::calibrate::Calibration;
    use crate::config::Rig;
    use crate::image::Plane;
    use crate::reconstruct::pair::Pair;
    use proptest::prelude::{ProptestConfig, prop_assert, prop_assert_eq, proptest};
    use std::f32::consts::TAU;
    use std::path::Path;

    const W: usize = 140;
    const H: usize = 90;
    const PERIOD: f32 = 11.0;

    /// Unwraps a planted absolute phase (NaN: no surface) whose fringe 80 is the marker in `marker_rows`.
    fn run(truth: &Plane<f32>, marker_rows: std::ops::Range<usize>) -> Unwrapped {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/rig.toml");
        let calibration = Calibration::nominal(&Rig::load(&path).expect("the shipped rig"));
        let head = &calibration.heads[0];
        let mut pair = Pair::new(head, &head.cameras[0], &calibration).expect("a usable pair");
        pair.sign = 1.0;
        let map = |f: &dyn Fn(f32) -> f32| {
            Plane::from_vec(W, H, truth.as_slice().iter().map(|&x| f(x)).collect()).expect("same size")
        };
        let wrapped = map(&|x| wrap(x));
        let mut anchor = Plane::filled(W, H, 0u8);
        for v in marker_rows {
            for u in 0..W {
                anchor.set(u, v, u8::from((truth.at(u, v) - 80.0 * TAU).abs() < 1.5));
            }
        }
        let (period, misfit) = (map(&|_| PERIOD), map(&|_| 0.0));
        unwrap(&wrapped, &period, &misfit, &anchor, &pair, &Settings::default())
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
            for (found, truth) in found.absolute.as_slice().iter().zip(truth.as_slice()) {
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
                    let (found, truth) = (found.absolute.at(u, v), truth.at(u, v));
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
            found.absolute.as_slice().iter().zip(truth.as_slice()).filter(|(a, b)| (*a - *b).abs() > 1.0);
        assert!(wrong.count() < 3 * W, "only the seam may be wrong");
    }

    #[test]
    fn without_a_marker_everything_is_refused() {
        let found = run(&surface(0.1, 0.0), 0..0);
        assert!(found.absolute.as_slice().iter().all(|x| x.is_nan()));
        assert_eq!(found.refused_px, W * H);
        assert!(found.open.tree.as_slice().iter().all(|&tree| tree != 0));
    }
}
