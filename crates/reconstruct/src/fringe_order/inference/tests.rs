// SPDX-License-Identifier: MIT OR Apache-2.0
//! Message passing against all labellings of small graphs.

use super::{Graph, NEVER, STEP, in_steps};
use crate::fringe_order::links::Link;
use proptest::prelude::{Strategy, prop_assert, proptest};

/// Labels that a patch of these graphs may have.
const FEW: usize = 4;

/// Patches with costs (of [`FEW`] labels), and links between them.
type Small = (Vec<[i16; FEW]>, Vec<Link>);

fn graph((costs, links): &Small) -> Graph {
    let mut graph = Graph::new(costs.len(), FEW, links.clone());
    for (i, few) in costs.iter().enumerate() {
        let unary = graph.unary_mut(i);
        unary.fill(NEVER);
        // Least ones are 0.
        let least = few.iter().copied().min().unwrap_or(0);
        unary.iter_mut().zip(few).for_each(|(cost, few)| *cost = few - least);
    }
    graph
}

fn energy(graph: &Graph, labels: &[usize]) -> i32 {
    let own: i32 = labels.iter().enumerate().map(|(i, &label)| i32::from(graph.unary(i)[label])).sum();
    let broken = |link: &&Link| labels[link.b as usize] as i32 - labels[link.a as usize] as i32 != link.turns;
    own + graph.links.iter().filter(broken).map(|link| i32::from(in_steps(link.weight))).sum::<i32>()
}

/// The least energy of all labellings, with this label of this patch where one is named.
fn least(graph: &Graph, with: Option<(usize, usize)>) -> i32 {
    let n = graph.label.len();
    let labels = |code: usize| (0..n).map(move |i| code / FEW.pow(i as u32) % FEW).collect::<Vec<_>>();
    let all = (0..FEW.pow(n as u32)).map(labels);
    let fits = |labels: &Vec<usize>| with.is_none_or(|(i, label)| labels[i] == label);
    all.filter(fits).map(|labels| energy(graph, &labels)).min().unwrap_or(i32::MAX)
}

fn found(graph: &Graph) -> i32 {
    energy(graph, &graph.label.iter().map(|&label| label as usize).collect::<Vec<_>>())
}

fn costs(n: usize) -> impl Strategy<Value = Vec<[i16; FEW]>> {
    proptest::collection::vec(proptest::array::uniform4(0i16..1500), n)
}

fn link(a: usize, b: usize) -> impl Strategy<Value = Link> {
    (-2i32..=2, 0.2f32..6.0).prop_map(move |(turns, weight)| Link { a: a as u32, b: b as u32, turns, weight })
}

fn chain() -> impl Strategy<Value = Small> {
    (2usize..6).prop_flat_map(|n| (costs(n), (1..n).map(|b| link(b - 1, b)).collect::<Vec<_>>()))
}

/// Two rows of three patches.
fn grid() -> impl Strategy<Value = Small> {
    let sides = [(0, 1), (1, 2), (3, 4), (4, 5), (0, 3), (1, 4), (2, 5)];
    (costs(6), Vec::from(sides.map(|(a, b)| link(a, b))))
}

proptest! {
    /// On a chain nothing is lost but the rounding of costs: label and margin are the best there are.
    #[test]
    fn a_chain_is_solved(small in chain()) {
        let mut graph = graph(&small);
        graph.infer(2);
        let best = least(&graph, None);
        let rounding = 2 * small.0.len() as i32;
        prop_assert!(found(&graph) <= best + rounding, "{} of {best}", found(&graph));
        for i in 0..small.0.len() {
            let others = (0..FEW).filter(|&label| label as i32 != graph.label[i]);
            let other = others.map(|label| least(&graph, Some((i, label)))).min().unwrap_or(0);
            let exact = STEP * (other - least(&graph, Some((i, graph.label[i] as usize)))) as f32;
            let off = (graph.margin[i] - exact).abs();
            prop_assert!(off <= STEP * rounding as f32, "margin of {i}: {} of {exact}", graph.margin[i]);
        }
    }
}

/// Labels are not bounded by what fits into a few vectors, and links may lead as far as there are labels.
#[test]
fn two_hundred_labels_are_told_apart() {
    for (labels, turns) in [(200, 150), (200, -190), (37, 36), (16, 15), (1, 0)] {
        let link = Link { a: 0, b: 1, turns, weight: 4.0 };
        let mut graph = Graph::new(2, labels, vec![link]);
        let best = if turns < 0 { labels as i32 - 1 } else { 0 };
        for (i, label) in [(0, best), (1, best + turns)] {
            let unary = graph.unary_mut(i);
            unary.fill(NEVER);
            unary[..labels].fill(100);
            unary[label as usize] = 0;
        }
        graph.infer(2);
        assert_eq!(graph.label, [best, best + turns], "{labels} labels, {turns} turns");
    }
}

/// With loops the best is found nearly always, and where a margin is wide, its label is the best one's.
#[test]
fn loops_cost_little() {
    use proptest::strategy::ValueTree;
    let mut runner = proptest::test_runner::TestRunner::deterministic();
    let (mut best_found, mut wide, mut wide_and_wrong) = (0, 0, 0);
    for _ in 0..300 {
        let small = grid().new_tree(&mut runner).expect("a graph").current();
        let mut graph = graph(&small);
        graph.infer(2);
        let best = least(&graph, None);
        best_found += usize::from(found(&graph) <= best + 12);
        for i in (0..6).filter(|&i| graph.margin[i] >= 2.0) {
            wide += 1;
            wide_and_wrong += usize::from(least(&graph, Some((i, graph.label[i] as usize))) > best + 12);
        }
    }
    println!("of 300: {best_found} best; of {wide} wide margins {wide_and_wrong} wrong");
    assert!(best_found >= 270, "the best of {best_found} graphs of 300");
    assert!(wide > 300 && wide_and_wrong * 100 <= wide, "{wide_and_wrong} of {wide} wide margins are wrong");
}
