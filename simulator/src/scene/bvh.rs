// SPDX-License-Identifier: MIT OR Apache-2.0
//! A bounding volume hierarchy over triangles: binned surface-area splits (Wald 2007), one flat array.
//!
//! Nodes lie in depth-first order, so the left child of node n is n + 1. Built in parallel, with the same
//! result for any number of threads.

use super::mesh::Mesh;
use std::cell::RefCell;

/// A ray for many tests: single precision finds the triangle, the caller refines the point.
#[derive(Debug, Clone, Copy)]
pub struct FastRay {
    pub origin: [f32; 3],
    /// Where to; any length, which is the unit of the distances.
    pub direction: [f32; 3],
    inverse: [f32; 3],
}

impl FastRay {
    /// A ray from its origin in this direction.
    pub fn new(origin: [f32; 3], direction: [f32; 3]) -> Self {
        // A zero component gives an infinite inverse; the tiny number keeps 0 * infinity out of the slabs.
        let inverse = direction.map(|d| 1.0 / if d.abs() < 1e-20 { 1e-20 } else { d });
        Self { origin, direction, inverse }
    }
}

/// A triangle that a ray meets.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TriangleHit {
    /// Number of the triangle in the mesh.
    pub triangle: u32,
    /// Distance in lengths of the ray's direction.
    pub distance: f32,
    /// Weights of the second and third vertex.
    pub weights: [f32; 2],
}

#[derive(Debug, Clone, Copy)]
struct Node {
    low: [f32; 3],
    /// Leaf: first triangle. Inner: number of the right child.
    link: u32,
    high: [f32; 3],
    /// Triangles of a leaf; 0 for inner nodes.
    count: u32,
}

#[derive(Debug, Clone, Copy)]
struct Corner {
    first: [f32; 3],
    edge1: [f32; 3],
    edge2: [f32; 3],
    number: u32,
    /// How far beyond its three edges a hit still counts, as weights of the opposite vertices.
    margin: [f32; 3],
}

impl Corner {
    fn new([a, b, c]: [[f32; 3]; 3], number: u32) -> Self {
        /// Single precision places a ray to a fraction of this, m; without it rays slip between triangles.
        const SLIP_M: f32 = 1.5e-6;
        let minus = |p: [f32; 3], q: [f32; 3]| -> [f32; 3] { std::array::from_fn(|axis| p[axis] - q[axis]) };
        let (edge1, edge2, opposite) = (minus(b, a), minus(c, a), minus(c, b));
        let normal = cross(&edge1, &edge2);
        let double_area = dot(&normal, &normal).sqrt();
        // Twice the area over an edge is the height of the vertex opposite.
        let margin = |edge: &[f32; 3]| (SLIP_M * dot(edge, edge).sqrt() / double_area).min(1.0);
        let margin = [margin(&opposite), margin(&edge2), margin(&edge1)];
        let margin = if double_area > 0.0 { margin } else { [0.0; 3] };
        Self { first: a, edge1, edge2, number, margin }
    }
}

/// The hierarchy, with its own copy of the triangles in its order.
#[derive(Debug, Clone)]
pub struct Bvh {
    nodes: Vec<Node>,
    triangles: Vec<Corner>,
}

const LEAF: usize = 4;
const BINS: usize = 12;
/// Beyond this depth splits halve the count, so that no input makes the tree deeper than the walk's stack.
const BALANCED_BELOW: usize = 32;
const STACK: usize = 72;

thread_local! {
    /// Nodes yet to visit: kept, because clearing it for each ray would cost as much as a short walk.
    static PENDING: RefCell<[(u32, f32); STACK]> = const { RefCell::new([(0, 0.0); STACK]) };
}

const PARALLEL_ABOVE: usize = 4096;

#[derive(Clone, Copy)]
struct Item {
    low: [f32; 3],
    high: [f32; 3],
    number: u32,
}

impl Item {
    fn centre(&self, axis: usize) -> f32 {
        0.5 * (self.low[axis] + self.high[axis])
    }
}

#[derive(Clone, Copy)]
struct Bounds([f32; 3], [f32; 3]);

impl Bounds {
    const EMPTY: Self = Self([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);

    fn add(&mut self, low: &[f32; 3], high: &[f32; 3]) {
        for axis in 0..3 {
            self.0[axis] = self.0[axis].min(low[axis]);
            self.1[axis] = self.1[axis].max(high[axis]);
        }
    }

    fn half_area(&self) -> f32 {
        let [x, y, z] = std::array::from_fn(|axis| (self.1[axis] - self.0[axis]).max(0.0));
        x * y + y * z + z * x
    }
}

impl Bvh {
    /// Builds the hierarchy of a mesh. Triangles with a corner that is not finite are left out.
    pub fn build(mesh: &Mesh) -> Self {
        let mut items: Vec<Item> = (0..mesh.triangles.len())
            .filter_map(|t| {
                let corners = mesh.corners(t);
                let mut bounds = Bounds::EMPTY;
                corners.iter().for_each(|corner| bounds.add(corner, corner));
                let finite = corners.iter().flatten().all(|x| x.is_finite());
                finite.then_some(Item { low: bounds.0, high: bounds.1, number: t as u32 })
            })
            .collect();
        let nodes = if items.is_empty() { Vec::new() } else { build(&mut items, 0, 0) };
        let triangles = items.iter().map(|item| Corner::new(mesh.corners(item.number as usize), item.number));
        Self { triangles: triangles.collect(), nodes }
    }

    /// The nearest triangle that the ray meets between the distances given, from either side.
    pub fn nearest(&self, ray: &FastRay, from: f32, to: f32) -> Option<TriangleHit> {
        let mut best = None;
        let mut limit = to;
        self.walk(ray, from, &mut limit, |triangle, limit| {
            if let Some(hit) = intersect(triangle, ray, from, *limit) {
                *limit = hit.distance;
                best = Some(hit);
            }
            false
        });
        best
    }

    /// Whether any triangle lies on the ray between the distances given.
    pub fn any(&self, ray: &FastRay, from: f32, to: f32) -> bool {
        let mut limit = to;
        self.walk(ray, from, &mut limit, |triangle, limit| intersect(triangle, ray, from, *limit).is_some())
    }

    /// Balls (centre, radius) that together hold all triangles.
    pub fn balls(&self) -> impl Iterator<Item = ([f32; 3], f32)> {
        self.nodes.iter().filter(|node| node.count > 0).map(|node| {
            let centre = std::array::from_fn(|axis| 0.5 * (node.low[axis] + node.high[axis]));
            let half: [f32; 3] = std::array::from_fn(|axis| 0.5 * (node.high[axis] - node.low[axis]));
            (centre, dot(&half, &half).sqrt())
        })
    }

    /// Visits the triangles of all leaves that the ray crosses, near ones first, until `visit` ends it.
    fn walk(
        &self,
        ray: &FastRay,
        from: f32,
        limit: &mut f32,
        visit: impl FnMut(&Corner, &mut f32) -> bool,
    ) -> bool {
        match self.nodes.first().and_then(|root| enters(root, ray, from, *limit)) {
            Some(entry) => {
                PENDING.with_borrow_mut(|stack| self.walk_from(entry, stack, ray, from, limit, visit))
            }
            None => false,
        }
    }

    fn walk_from(
        &self,
        entry: f32,
        stack: &mut [(u32, f32); STACK],
        ray: &FastRay,
        from: f32,
        limit: &mut f32,
        mut visit: impl FnMut(&Corner, &mut f32) -> bool,
    ) -> bool {
        let mut depth = 0;
        let mut current = (0u32, entry);
        loop {
            let node = &self.nodes[current.0 as usize];
            if current.1 <= *limit {
                if node.count > 0 {
                    let first = node.link as usize;
                    for triangle in &self.triangles[first..first + node.count as usize] {
                        if visit(triangle, limit) {
                            return true;
                        }
                    }
                } else {
                    let (left, right) = (current.0 + 1, node.link);
                    let at_left = enters(&self.nodes[left as usize], ray, from, *limit);
                    let at_right = enters(&self.nodes[right as usize], ray, from, *limit);
                    match (at_left, at_right) {
                        (Some(a), Some(b)) => {
                            let (near, far) =
                                if a <= b { ((left, a), (right, b)) } else { ((right, b), (left, a)) };
                            stack[depth] = far;
                            depth += 1;
                            current = near;
                            continue;
                        }
                        (Some(a), None) => {
                            current = (left, a);
                            continue;
                        }
                        (None, Some(b)) => {
                            current = (right, b);
                            continue;
                        }
                        (None, None) => {}
                    }
                }
            }
            if depth == 0 {
                return false;
            }
            depth -= 1;
            current = stack[depth];
        }
    }
}

/// Where the ray enters the node's box, if it does within the distances.
#[inline]
fn enters(node: &Node, ray: &FastRay, from: f32, to: f32) -> Option<f32> {
    let (mut near, mut far) = (from, to);
    for axis in 0..3 {
        let a = (node.low[axis] - ray.origin[axis]) * ray.inverse[axis];
        let b = (node.high[axis] - ray.origin[axis]) * ray.inverse[axis];
        // Plain comparisons are one instruction each; f32::min and max would also look for NaN, which
        // cannot arise here.
        let (first, last) = if a < b { (a, b) } else { (b, a) };
        // Rounding must not lose a box that the ray grazes (Ize 2013).
        let last = last * 1.000_000_4;
        near = if first > near { first } else { near };
        far = if last < far { last } else { far };
    }
    (near <= far).then_some(near)
}

/// Möller and Trumbore 1997, with a margin at the edges so that no ray slips between two triangles.
#[inline]
fn intersect(triangle: &Corner, ray: &FastRay, from: f32, to: f32) -> Option<TriangleHit> {
    let p = cross(&ray.direction, &triangle.edge2);
    let determinant = dot(&triangle.edge1, &p);
    let inverse = 1.0 / determinant;
    let s: [f32; 3] = std::array::from_fn(|axis| ray.origin[axis] - triangle.first[axis]);
    let u = dot(&s, &p) * inverse;
    let q = cross(&s, &triangle.edge1);
    let v = dot(&ray.direction, &q) * inverse;
    let distance = dot(&triangle.edge2, &q) * inverse;
    // Written so that NaN from a zero determinant fails.
    let [at_first, at_second, at_third] = triangle.margin;
    let inside = u >= -at_second && v >= -at_third && u + v <= 1.0 + at_first;
    let hit = inside && distance > from && distance < to;
    hit.then_some(TriangleHit { triangle: triangle.number, distance, weights: [u, v] })
}

#[inline]
fn dot(a: &[f32; 3], b: &[f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[inline]
fn cross(a: &[f32; 3], b: &[f32; 3]) -> [f32; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// The subtree of `items`, which are triangles `first..` of the final order; reorders them.
fn build(items: &mut [Item], first: usize, depth: usize) -> Vec<Node> {
    let mut bounds = Bounds::EMPTY;
    items.iter().for_each(|item| bounds.add(&item.low, &item.high));
    let node = |link, count| Node { low: bounds.0, high: bounds.1, link, count };
    let Some(middle) = (items.len() > LEAF).then(|| split(items, depth)) else {
        return vec![node(first as u32, items.len() as u32)];
    };
    let parallel = items.len() > PARALLEL_ABOVE;
    let (a, b) = items.split_at_mut(middle);
    let (left, right) = if parallel {
        rayon::join(|| build(a, first, depth + 1), || build(b, first + middle, depth + 1))
    } else {
        (build(a, first, depth + 1), build(b, first + middle, depth + 1))
    };
    let mut nodes = Vec::with_capacity(1 + left.len() + right.len());
    nodes.push(node(1 + left.len() as u32, 0));
    append(&mut nodes, &left);
    append(&mut nodes, &right);
    nodes
}

fn append(nodes: &mut Vec<Node>, subtree: &[Node]) {
    let shift = nodes.len() as u32;
    let moved =
        |node: &Node| Node { link: if node.count == 0 { node.link + shift } else { node.link }, ..*node };
    nodes.extend(subtree.iter().map(moved));
}

/// Reorders the items and returns where the right child begins: at the cheapest of the bins' borders along the
/// longest axis of the centres, or in the middle where there is none.
fn split(items: &mut [Item], depth: usize) -> usize {
    let mut centres = Bounds::EMPTY;
    for item in items.iter() {
        let centre = std::array::from_fn(|axis| item.centre(axis));
        centres.add(&centre, &centre);
    }
    let extent: [f32; 3] = std::array::from_fn(|axis| centres.1[axis] - centres.0[axis]);
    let axis = (0..3).fold(0, |best, axis| if extent[axis] > extent[best] { axis } else { best });
    if depth < BALANCED_BELOW && extent[axis] > 0.0 {
        let scale = BINS as f32 / extent[axis];
        let bin_of = |item: &Item| (((item.centre(axis) - centres.0[axis]) * scale) as usize).min(BINS - 1);
        if let Some(border) = cheapest_border(items, bin_of) {
            return partition(items, |item| bin_of(item) < border);
        }
    }
    let middle = items.len() / 2;
    items.select_nth_unstable_by(middle, |a, b| {
        a.centre(axis).total_cmp(&b.centre(axis)).then(a.number.cmp(&b.number))
    });
    middle
}

fn cheapest_border(items: &[Item], bin_of: impl Fn(&Item) -> usize) -> Option<usize> {
    let mut bins = [(Bounds::EMPTY, 0usize); BINS];
    for item in items {
        let bin = &mut bins[bin_of(item)];
        bin.0.add(&item.low, &item.high);
        bin.1 += 1;
    }
    let mut right_cost = [0f32; BINS];
    let (mut bounds, mut count) = (Bounds::EMPTY, 0);
    for border in (1..BINS).rev() {
        bounds.add(&bins[border].0.0, &bins[border].0.1);
        count += bins[border].1;
        right_cost[border] = if count == 0 { f32::INFINITY } else { bounds.half_area() * count as f32 };
    }
    let (mut bounds, mut count) = (Bounds::EMPTY, 0);
    let mut best = (f32::INFINITY, None);
    for border in 1..BINS {
        bounds.add(&bins[border - 1].0.0, &bins[border - 1].0.1);
        count += bins[border - 1].1;
        if count == 0 {
            continue;
        }
        let cost = bounds.half_area() * count as f32 + right_cost[border];
        if cost < best.0 {
            best = (cost, Some(border));
        }
    }
    best.1
}

/// Moves the items that satisfy `first` to the front and counts them.
fn partition(items: &mut [Item], first: impl Fn(&Item) -> bool) -> usize {
    let mut end = 0;
    for i in 0..items.len() {
        if first(&items[i]) {
            items.swap(i, end);
            end += 1;
        }
    }
    end
}

#[cfg(test)]
mod tests {
    use super::{Bvh, FastRay, intersect};
    use crate::random::Stream;
    use crate::scene::mesh::Mesh;
    use proptest::prelude::{ProptestConfig, prop_assert_eq, proptest};

    fn soup(seed: u64, count: usize) -> Mesh {
        let mut random = Stream::new(seed, "soup");
        let mut mesh = Mesh::default();
        for t in 0..count as u32 {
            let centre: [f64; 3] = std::array::from_fn(|_| random.uniform());
            for _ in 0..3 {
                mesh.positions.push(centre.map(|c| (c + 0.2 * (random.uniform() - 0.5)) as f32));
            }
            mesh.triangles.push([3 * t, 3 * t + 1, 3 * t + 2]);
        }
        mesh
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(40))]
        #[test]
        fn it_finds_what_testing_every_triangle_finds(seed in 0u64..1_000_000, count in 0usize..300) {
            let bvh = Bvh::build(&soup(seed, count));
            prop_assert_eq!(bvh.triangles.len(), count);
            let mut random = Stream::new(seed, "rays");
            for _ in 0..50 {
                let origin = std::array::from_fn(|_| (3.0 * random.uniform() - 1.0) as f32);
                let target: [f32; 3] = std::array::from_fn(|_| random.uniform() as f32);
                let ray = FastRay::new(origin, std::array::from_fn(|axis| target[axis] - origin[axis]));
                let every = bvh.triangles.iter().filter_map(|t| intersect(t, &ray, 0.0, 10.0));
                let nearest = every.map(|hit| hit.distance).min_by(f32::total_cmp);
                prop_assert_eq!(bvh.nearest(&ray, 0.0, 10.0).map(|hit| hit.distance), nearest);
                prop_assert_eq!(bvh.any(&ray, 0.0, 10.0), nearest.is_some());
            }
        }
    }

    #[test]
    fn axis_aligned_rays_hit_axis_aligned_triangles() {
        let mesh = Mesh {
            positions: vec![[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [0.0, 1.0, 1.0]],
            triangles: vec![[0, 1, 2]],
            ..Mesh::default()
        };
        let bvh = Bvh::build(&mesh);
        let hit = bvh.nearest(&FastRay::new([0.25, 0.25, 0.0], [0.0, 0.0, 1.0]), 0.0, 10.0);
        assert_eq!(hit.map(|hit| hit.distance), Some(1.0));
        assert!(!bvh.any(&FastRay::new([0.75, 0.75, 0.0], [0.0, 0.0, 1.0]), 0.0, 10.0));
    }
}
