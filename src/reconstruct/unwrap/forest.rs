//! Union-find whose links carry whole turns, and whose roots carry the marker's votes.

use super::Settings;
use super::segments::Segment;

/// Trees of nodes.
#[derive(Debug, Default)]
pub(super) struct Forest {
    links: Vec<Link>,
    /// Of the roots.
    trees: Vec<Tree>,
}

/// A node's way to its root.
#[derive(Debug, Clone, Copy)]
struct Link {
    parent: u32,
    /// Turns of the node relative to its parent.
    turns: i32,
}

/// What a root knows of its tree.
#[derive(Debug, Clone, Copy)]
struct Tree {
    /// Its pixels.
    size: u32,
    /// Order that the votes give the root, and how many they are.
    order: i32,
    votes: u32,
}

/// What joins two nodes.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Edge {
    pub a: u32,
    pub b: u32,
    /// Whole turns that `b` has more than `a`.
    pub turns: i16,
    /// Whether it may only attach small trees.
    pub doubtful: bool,
}

impl Forest {
    pub fn clear(&mut self) {
        self.links.clear();
        self.trees.clear();
    }

    /// Adds a tree of one node for each segment.
    #[inline(always)]
    pub fn extend(&mut self, segments: &[Segment]) {
        let first = self.links.len() as u32;
        self.links.extend((first..first + segments.len() as u32).map(
            #[inline(always)]
            |parent| Link { parent, turns: 0 },
        ));
        self.trees.extend(segments.iter().map(
            #[inline(always)]
            |segment| Tree { size: u32::from(segment.end - segment.first), order: 0, votes: 0 },
        ));
    }

    /// A vote for the order of a node that has not been joined yet.
    pub fn vote(&mut self, node: u32, order: i32) {
        let tree = &mut self.trees[node as usize];
        if tree.votes == 0 {
            tree.order = order;
        }
        if tree.order == order {
            tree.votes += 1;
        } else {
            tree.votes -= 1;
        }
    }

    /// Root of a node, and the node's turns relative to it.
    #[inline(always)]
    pub fn find(&mut self, node: u32) -> (u32, i32) {
        let link = self.links[node as usize];
        let parent = self.links[link.parent as usize];
        if parent.parent == link.parent {
            // The root, or a child of it.
            return (link.parent, link.turns + parent.turns);
        }
        self.find_far(node)
    }

    fn find_far(&mut self, node: u32) -> (u32, i32) {
        let (mut root, mut turns) = (node, 0);
        loop {
            let link = self.links[root as usize];
            if link.parent == root {
                break;
            }
            turns += link.turns;
            root = link.parent;
        }
        // Second pass: every node on the way points at the root.
        let (mut at, mut rest) = (node, turns);
        while at != root {
            let link = self.links[at as usize];
            if link.parent == root {
                break;
            }
            self.links[at as usize] = Link { parent: root, turns: rest };
            rest -= link.turns;
            at = link.parent;
        }
        (root, turns)
    }

    /// The order of a root whose tree has enough votes.
    pub fn order(&self, root: u32, min_votes: u32) -> Option<i32> {
        let tree = self.trees[root as usize];
        (tree.votes >= min_votes).then_some(tree.order)
    }

    /// Merges the trees of an edge. False when the votes of two trees of known order contradict.
    #[inline(always)]
    pub fn merge(&mut self, edge: Edge, settings: &Settings) -> bool {
        // Segments beside each other are most often children of one root already.
        if self.links[edge.a as usize].parent == self.links[edge.b as usize].parent {
            return true;
        }
        let (mut root, turns_a) = self.find(edge.a);
        let (mut other, turns_b) = self.find(edge.b);
        if root == other {
            return true;
        }
        let (mut tree, mut small) = (self.trees[root as usize], self.trees[other as usize]);
        if edge.doubtful && tree.size.min(small.size) > settings.small_tree_px {
            return true;
        }
        // Turns of `other` relative to `root`.
        let mut shift = turns_a + i32::from(edge.turns) - turns_b;
        if tree.size < small.size {
            (root, other, shift) = (other, root, -shift);
            std::mem::swap(&mut tree, &mut small);
        }
        // Most have no votes.
        if small.votes == 0 {
            self.trees[root as usize].size = tree.size + small.size;
            self.links[other as usize] = Link { parent: root, turns: shift };
            return true;
        }
        // The order that the other tree's votes give this root.
        let order_other = small.order - shift;
        if tree.votes > 0 && tree.order != order_other {
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
        self.trees[root as usize] = tree;
        self.links[other as usize] = Link { parent: root, turns: shift };
        true
    }
}
