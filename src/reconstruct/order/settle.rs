//! Which fringe order each piece has: every piece of every view is weighed against all that is settled.
//!
//! Pieces that a marker crosses are settled first. Then, round by round, every open piece collects for each order that
//! puts it into the volume: what the other cameras say about its places (see [`super::witness`]), and how well it
//! continues settled pieces of its own view. The best order is taken when it has enough evidence and leads the second by
//! a margin; else the piece waits for others to be settled. At last every settled piece is tried against all others, the
//! most doubtful first: one that is contradicted takes the order that is not, if there is one, or is refused.

use super::graph::Graph;
use super::grow::NONE;
use super::jury::{Jury, Known, Weights};
use super::lookout::{LANES, Lookout};
use super::looks::{Looks, PieceLooks, Place};
use super::pieces::Pieces;
use super::split;
use super::volume;
use super::witness::Witness;
use crate::reconstruct::rays::Sightline;
use crate::reconstruct::simd;
use crate::reconstruct::triangulate::Triangulator;
use std::collections::BTreeMap;
use std::f32::consts::TAU;
use std::ops::{Range, RangeInclusive};

/// Marker pixels from which a piece counts as crossed by the marker.
pub const MIN_VOTES: u32 = 20;

/// Share of a piece's marker pixels that must agree.
const MIN_VOTE_SHARE: f32 = 0.8;

/// The smallest piece that is settled by evidence other than the marker, px.
const MIN_PIECE_PX: u32 = 120;

/// Places of a piece that are tried, where a row of the image is one of the sensor. In pairs of rows, where a part of another surface is
/// joined to a piece more often, twice as many: parts are sought where a few of them agree at another order.
const SAMPLES: usize = 48;

/// So many of them, from all over the piece, say whether an order is worth the rest: one of fifty is, of a piece that no marker crosses.
const FIRST_SAMPLES: usize = 16;

/// Places of a node smaller than this are on outlines, px.
const MIN_SAMPLE_NODE_PX: u32 = 24;

/// Evidence that an order needs.
const MIN_EVIDENCE: f32 = 0.5;

/// Lead over the second order that it needs. In the first rounds, more.
const MIN_MARGIN: [f32; 2] = [1.0, 0.5];

/// Places from which a camera's word counts in full.
const FULL_WITNESS: f32 = 8.0;

/// Fewest places that a camera must judge.
const MIN_WITNESS: u32 = 3;

/// A border counts in full when so many pixel pairs agree.
const FULL_CONTACT_PAIRS: f32 = 60.0;

/// Marker pixels that count as one camera.
const FULL_VOTES: f32 = 60.0;

/// A settled piece is contested when the other cameras' word falls below.
const CONTESTED: f32 = -0.3;

/// Smaller pieces are not parted, px.
const MIN_PARTED_PX: u32 = 600;

/// Sampled places that must agree at an order for a part of it to be sought.
const MIN_PARTED_AGREE: u32 = 4;

/// Orders that a piece is parted by, at most.
const MAX_PARTS: usize = 5;

/// A view that is so many times darker than another one cannot tell it what is background: the mask ends where a fringe is a few
/// DN above black.
const DIM: f32 = 4.0;

/// What other heads alone say for an order, without the marker, is believed where they contradict it once in so many places, at most. A limb
/// that lies where the trunk is has their word in most places, and is contradicted in the others.
const LONE: u32 = 8;

/// Rounds of settling and parting, at most.
const MAX_ROUNDS: usize = 2;

/// Why a piece has no order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refusal {
    /// Nothing tells its order, or too little.
    NoEvidence,
    /// What tells its order contradicts itself.
    Contradicted,
}

/// What is known of a piece.
#[derive(Debug, Clone, Copy)]
pub struct State {
    /// Its order, or why there is none.
    pub order: Result<i32, Refusal>,
    /// How far the evidence for the order leads that for any other; 1 is the full word of one camera.
    pub margin: f32,
}

/// A view with its pieces.
#[derive(Debug)]
pub struct Scene<'a> {
    /// Places to points.
    pub triangulator: &'a Triangulator,
    /// Where the other cameras see its places.
    pub lookout: Lookout<'a>,
    /// The view as a witness.
    pub witness: Witness,
    /// The borders of its nodes.
    pub graph: Graph,
    /// Line of sight of each node's pixel.
    pub lines: Vec<Sightline>,
    /// Its pieces.
    pub pieces: Pieces,
    /// What is known of each.
    pub states: Vec<State>,
    /// Pixels of each piece.
    pub px: Vec<u32>,
    /// Whole turns that make each node's phases absolute where its piece is settled, or [`NONE`].
    pub settled: Vec<i32>,
    /// Whether it is its head's only camera.
    pub lone: bool,
    /// Mean light of its nodes, DN.
    pub light_dn: f32,
}

/// What is found out once for each piece, and who is asked.
#[derive(Debug)]
struct Cache {
    /// The cameras as each view asks them for evidence.
    juries: Vec<Jury>,
    /// What is settled, and what was before it was noted last.
    known: Known,
    before: Known,
    /// The nodes that are tried, by view and piece.
    samples: BTreeMap<(usize, usize), Vec<u32>>,
    /// What was heard of each order, by view, piece and order.
    heard: BTreeMap<(usize, usize, i32), Heard>,
    /// How often what is settled, or the pieces, have changed: whoever is heard again in between says the same.
    changes: u32,
    /// Orders worth a look, by view and piece.
    worth: BTreeMap<(usize, usize), Worth>,
    /// What the cameras have at the nodes of pieces that might be parted.
    asked: PieceLooks,
}

/// What a camera's words for a place count in the sum for all places of a piece, a byte each.
const EVIDENCE: Weights = Weights { agrees: 1, before: 1 << 8, behind: 1 << 16, past: 1 << 24 };

impl Cache {
    fn new(scenes: &[Scene<'_>]) -> Self {
        const { assert!(2 * SAMPLES <= u8::MAX as usize) };
        let mut cache = Self {
            juries: (0..scenes.len()).map(|view| Jury::new(scenes, view, |_| EVIDENCE)).collect(),
            known: Known::default(),
            before: Known::default(),
            samples: BTreeMap::new(),
            heard: BTreeMap::new(),
            changes: 0,
            worth: BTreeMap::new(),
            asked: PieceLooks::new(),
        };
        cache.update(scenes);
        cache
    }

    /// Takes note of what is settled now.
    fn update(&mut self, scenes: &[Scene<'_>]) {
        std::mem::swap(&mut self.known, &mut self.before);
        self.known.update(scenes.iter().map(|scene| &scene.settled[..]));
        self.changes += u32::from(self.known != self.before);
    }

    /// Forgets a piece whose nodes have changed. Others have other neighbours, too.
    fn forget(&mut self, view: usize, piece: usize) {
        self.changes += 1;
        self.heard.retain(|x, _| (x.0, x.1) != (view, piece));
        self.samples.remove(&(view, piece));
        self.worth.remove(&(view, piece));
        self.asked.retain(|x, _| (x.0, x.1) != (view, piece));
    }
}

/// Orders that put a piece into the volume, and what the cameras have at the [`FIRST_SAMPLES`] at each of them: to look at all of these
/// together takes less time.
#[derive(Debug, Default)]
struct Worth {
    orders: Option<RangeInclusive<i32>>,
    first: Looks,
}

impl Worth {
    /// Where what is had at an order stands in `first`, with so many places at each.
    fn places(&self, order: i32, each: usize) -> Option<Range<usize>> {
        let orders = self.orders.as_ref().filter(|orders| orders.contains(&order))?;
        let at = (order - orders.start()) as usize * each;
        Some(at..at + each)
    }
}

/// What was heard of one order of a piece.
#[derive(Debug)]
struct Heard {
    /// Where [`Worth`] has the first places, if it was there when the order was asked for first.
    first: Option<Range<usize>>,
    /// What the cameras have at the other places that were looked at.
    looks: Looks,
    /// The evidence that came of it last, and after how many [changes](Cache::changes).
    last: Option<(u32, Evidence)>,
}

/// Evidence for one order of a piece.
#[derive(Debug, Clone, Copy, Default)]
struct Evidence {
    order: i32,
    /// The other cameras' word.
    cameras: f32,
    /// Places on which another camera agrees.
    agree: u32,
    /// Places at which another camera contradicts.
    against: u32,
    /// Everything together.
    all: f32,
    /// Whether it may be believed at all.
    credible: bool,
}

/// How many nodes all views have together.
pub fn all_nodes(scenes: &[Scene<'_>]) -> u32 {
    scenes.iter().map(|scene| scene.graph.len() as u32).sum()
}

/// Settles all pieces of all views.
pub fn settle(scenes: &mut [Scene<'_>]) {
    for scene in scenes.iter_mut() {
        for piece in 0..scene.states.len() {
            scene.set(piece, by_marker(&scene.pieces.votes[piece]));
        }
    }
    let mut cache = Cache::new(scenes);
    for _ in 0..MAX_ROUNDS {
        spread(scenes, &mut cache);
        let moved = verify(scenes, &mut cache);
        let parted = part(scenes, &mut cache);
        if !moved && !parted {
            break;
        }
    }
    spread(scenes, &mut cache);
    verify(scenes, &mut cache);
}

/// Parts pieces that agree with the other cameras at different orders in different places. Whether there were any.
fn part(scenes: &mut [Scene<'_>], cache: &mut Cache) -> bool {
    let mut parted = false;
    for view in 0..scenes.len() {
        for piece in 0..scenes[view].states.len() {
            if scenes[view].px[piece] < MIN_PARTED_PX {
                continue;
            }
            if let Ok(order) = scenes[view].states[piece].order {
                let own = evidence(scenes, view, piece, order, cache);
                if own.against * 8 < own.agree {
                    continue;
                }
            }
            let mut all = weigh(scenes, view, piece, cache);
            all.retain(|x| x.agree >= MIN_PARTED_AGREE);
            all.sort_by_key(|x| (std::cmp::Reverse(x.agree), x.order));
            let orders: Vec<i32> = all.iter().take(MAX_PARTS).map(|x| x.order).collect();
            if orders.len() < 2 {
                continue;
            }
            let Some(parts) = split::parts(scenes, (view, piece), &orders, &cache.known, &mut cache.asked)
            else {
                continue;
            };
            let scene = &mut scenes[view];
            let first = scene.states.len();
            scene.pieces.part(piece, parts, &scene.witness.cells);
            scene.px = scene.pieces.px(&scene.witness.cells, scene.triangulator.pair().sensor_rows);
            scene.states.resize(scene.px.len(), State { order: Err(Refusal::NoEvidence), margin: 0.0 });
            for new in std::iter::once(piece).chain(first..scene.px.len()) {
                scene.set(new, by_marker(&scene.pieces.votes[new]));
            }
            cache.forget(view, piece);
            cache.update(scenes);
            parted = true;
        }
    }
    parted
}

/// What the marker alone says of a piece.
fn by_marker(votes: &BTreeMap<i32, u32>) -> State {
    let all: u32 = votes.values().sum();
    match votes.iter().max_by_key(|x| (x.1, x.0)) {
        Some((&order, &most)) if most >= MIN_VOTES && most as f32 >= MIN_VOTE_SHARE * all as f32 => {
            State { order: Ok(order), margin: most as f32 / FULL_VOTES }
        }
        _ => State { order: Err(Refusal::NoEvidence), margin: 0.0 },
    }
}

/// Settles open pieces round by round.
fn spread(scenes: &mut [Scene<'_>], cache: &mut Cache) {
    let mut strictness = 0;
    while strictness < MIN_MARGIN.len() {
        let mut found = Vec::new();
        for view in 0..scenes.len() {
            for piece in 0..scenes[view].states.len() {
                let open = scenes[view].states[piece].order == Err(Refusal::NoEvidence);
                if !open || scenes[view].px[piece] < MIN_PIECE_PX {
                    continue;
                }
                let all = weigh(scenes, view, piece, cache);
                if let Some((best, margin)) = leader(&all).filter(|x| x.1 >= MIN_MARGIN[strictness]) {
                    found.push((view, piece, best.order, margin));
                }
            }
        }
        if found.is_empty() {
            strictness += 1;
        } else {
            strictness = 0;
        }
        for (view, piece, order, margin) in found {
            scenes[view].set(piece, State { order: Ok(order), margin });
        }
        cache.update(scenes);
    }
}

/// The credible order of most evidence, if that is enough, and its lead.
fn leader(all: &[Evidence]) -> Option<(Evidence, f32)> {
    let credible = all.iter().filter(|x| x.credible);
    let best = *credible.max_by(|a, b| a.all.total_cmp(&b.all).then(b.order.cmp(&a.order)))?;
    let second = all.iter().filter(|x| x.order != best.order).map(|x| x.all).fold(0.0, f32::max);
    (best.all >= MIN_EVIDENCE).then_some((best, best.all - second))
}

/// Tries every settled piece against all others, the most doubtful first. Whether anything changed.
fn verify(scenes: &mut [Scene<'_>], cache: &mut Cache) -> bool {
    let mut tried: Vec<Vec<bool>> = scenes.iter().map(|x| vec![false; x.states.len()]).collect();
    let mut changed = false;
    loop {
        let mut worst: Option<(f32, usize, usize, i32)> = None;
        for (view, scene) in scenes.iter().enumerate() {
            for (piece, state) in scene.states.iter().enumerate() {
                let Ok(order) = state.order else { continue };
                if tried[view][piece] {
                    continue;
                }
                let evidence = evidence(scenes, view, piece, order, cache);
                let contested = evidence.cameras < CONTESTED || evidence.against > evidence.agree;
                if (contested || !evidence.credible) && worst.is_none_or(|x| evidence.all < x.0) {
                    worst = Some((evidence.all, view, piece, order));
                }
            }
        }
        let Some((own, view, piece, order)) = worst else { return changed };
        tried[view][piece] = true;
        let all = weigh(scenes, view, piece, cache);
        let state = match leader(&all) {
            Some((best, margin)) if best.order != order && margin >= MIN_MARGIN[1] && best.agree > 0 => {
                State { order: Ok(best.order), margin }
            }
            Some((best, margin)) if best.order == order && margin >= MIN_MARGIN[1] && own >= MIN_EVIDENCE => {
                State { order: Ok(order), margin }
            }
            _ => State { order: Err(Refusal::Contradicted), margin: 0.0 },
        };
        if state.order != Ok(order) {
            changed = true;
        }
        scenes[view].set(piece, state);
        cache.update(scenes);
    }
}

/// Evidence for every order of a piece that is worth a look.
fn weigh(scenes: &[Scene<'_>], view: usize, piece: usize, cache: &mut Cache) -> Vec<Evidence> {
    let Cache { samples, worth, .. } = &mut *cache;
    let worth_a_look = || {
        let samples = samples.entry((view, piece)).or_insert_with(|| self::samples(&scenes[view], piece));
        let (orders, mut first) = (orders(&scenes[view], samples), Looks::default());
        if let Some(orders) = orders.clone() {
            look(&mut first, scenes, view, &samples[..samples.len().min(FIRST_SAMPLES)], orders);
        }
        Worth { orders, first }
    };
    let orders = worth.entry((view, piece)).or_insert_with(worth_a_look).orders.clone();
    orders.into_iter().flatten().map(|order| evidence(scenes, view, piece, order, cache)).collect()
}

/// Looks at nodes of a view, at each of some orders of their pieces.
fn look(looks: &mut Looks, scenes: &[Scene<'_>], view: usize, nodes: &[u32], orders: RangeInclusive<i32>) {
    let places: Vec<Place<'_>> = nodes.iter().map(|&node| scenes[view].at(node)).collect();
    looks.add(scenes, view, &places, orders);
}

/// Orders that put a piece of which these nodes are tried into the volume.
fn orders(scene: &Scene<'_>, samples: &[u32]) -> Option<RangeInclusive<i32>> {
    // Half as many tell.
    let some = samples.iter().take(FIRST_SAMPLES).step_by(2);
    volume::orders_of(scene.triangulator.pair(), some.map(|&node| scene.place(node)))
}

/// The nodes of a piece that are tried, evenly; the [`FIRST_SAMPLES`] are even, too.
fn samples(scene: &Scene<'_>, piece: usize) -> Vec<u32> {
    let nodes = &scene.pieces.nodes[piece];
    let size = |node: &&u32| scene.witness.cells.nodes[**node as usize].size;
    let large: Vec<u32> = nodes.iter().filter(|x| size(x) >= MIN_SAMPLE_NODE_PX).copied().collect();
    let places = SAMPLES * scene.triangulator.pair().sensor_rows.min(2);
    let step = large.len().div_ceil(places).max(1);
    let all: Vec<u32> = large.into_iter().step_by(step).collect();
    let step = all.len().div_ceil(FIRST_SAMPLES).max(1);
    let (first, rest): (Vec<_>, Vec<_>) = all.into_iter().enumerate().partition(|x| x.0 % step == 0);
    first.into_iter().chain(rest).map(|x| x.1).collect()
}

impl Scene<'_> {
    /// Frame pixel of a node and its phase in its piece, rad.
    pub fn place(&self, node: u32) -> (usize, usize, f32) {
        let roi = self.witness.roi;
        let pixel = self.witness.cells.nodes[node as usize].pixel as usize;
        (roi.u + pixel % roi.width, roi.v + pixel / roi.width, self.phase(node))
    }

    /// Line of sight of a node's pixel, with its phase in its piece.
    pub fn at(&self, node: u32) -> Place<'_> {
        (&self.lines[node as usize], self.phase(node) / TAU)
    }

    /// Phase of a node's pixel in its piece, rad.
    pub fn phase(&self, node: u32) -> f32 {
        self.witness.cells.nodes[node as usize].phase + TAU * self.pieces.turns[node as usize] as f32
    }

    /// Whole turns that make a node's phases absolute, where its piece is settled.
    pub fn turns_of(&self, node: u32) -> Option<i32> {
        Some(self.settled[node as usize]).filter(|turns| *turns != NONE)
    }

    /// Whether it is so much darker than another view that what it takes for background may be the object's dark parts.
    pub fn is_dim_beside(&self, other: &Self) -> bool {
        self.light_dn * DIM < other.light_dn
    }

    /// States what is known of a piece.
    fn set(&mut self, piece: usize, state: State) {
        self.states[piece] = state;
        for &node in &self.pieces.nodes[piece] {
            let turns = self.pieces.turns[node as usize];
            self.settled[node as usize] = state.order.map_or(NONE, |order| order + turns);
        }
    }
}

/// Evidence for an order of a piece. Where nobody agrees at the first places, and nothing else is for it, these are all that are looked
/// at.
fn evidence(scenes: &[Scene<'_>], view: usize, piece: usize, order: i32, cache: &mut Cache) -> Evidence {
    let Cache { juries, known, samples, worth, heard, changes, .. } = cache;
    let samples = samples.entry((view, piece)).or_insert_with(|| self::samples(&scenes[view], piece));
    let (first, rest) = samples.split_at(samples.len().min(FIRST_SAMPLES));
    let worth = worth.get(&(view, piece));
    let heard = heard.entry((view, piece, order)).or_insert_with(|| {
        let (place, mut looks) = (worth.and_then(|worth| worth.places(order, first.len())), Looks::default());
        if place.is_none() {
            look(&mut looks, scenes, view, first, order..=order);
        }
        Heard { first: place, looks, last: None }
    });
    if let Some((_, evidence)) = heard.last.filter(|last| last.0 == *changes) {
        return evidence;
    }
    let Heard { first: place, looks, last } = heard;
    let at_first = worth.map(|worth| &worth.first).zip(place.clone());
    let looked = looks.len() + place.as_ref().map_or(0, Range::len);
    let hear = |looks: &Looks| {
        let looks = at_first.clone().into_iter().chain([(looks, 0..looks.len())]);
        hear(scenes, view, piece, order, looks, &juries[view], known)
    };
    let mut found = hear(looks);
    let is_worth_more = found.agree > 0 || found.all > found.cameras;
    if looked < samples.len() && is_worth_more {
        look(looks, scenes, view, rest, order..=order);
        found = hear(looks);
    }
    *last = Some((*changes, found));
    found
}

/// Evidence for an order of a piece, at whose places the cameras have these `looks`.
fn hear<'a>(
    scenes: &[Scene<'_>],
    view: usize,
    piece: usize,
    order: i32,
    looks: impl Iterator<Item = (&'a Looks, Range<usize>)> + Clone,
    jury: &Jury,
    known: &Known,
) -> Evidence {
    let mut found = Evidence { order, ..Evidence::default() };
    let counts =
        (0..scenes.len().div_ceil(LANES)).flat_map(|block| counts(block, looks.clone(), jury, known));
    for (scene, counts) in scenes.iter().zip(counts) {
        let [agree, before, behind, past] = counts.to_le_bytes().map(u32::from);
        // The head's other camera stands beside this one and sees most of the same; for the others to be hidden is
        // common, and what faces away from their projector is dark for them.
        let partner = scene.witness.head == scenes[view].witness.head;
        let (behind_weight, past_weight) = if partner { (0.5, 1.0) } else { (0.0, 0.5) };
        let seen = agree + before + past + if partner { behind } else { 0 };
        if seen < MIN_WITNESS {
            continue;
        }
        let word = agree as f32 - before as f32 - past_weight * past as f32 - behind_weight * behind as f32;
        found.cameras += word / seen as f32 * (seen as f32 / FULL_WITNESS).min(1.0);
        found.agree += agree;
        found.against += seen - agree;
    }
    let scene = &scenes[view];
    let votes = scene.pieces.votes[piece].get(&order).copied().unwrap_or(0);
    found.all = found.cameras + (votes as f32 / FULL_VOTES).min(2.0);
    found.credible = !scene.lone || votes >= MIN_VOTES || found.against * LONE <= found.agree;
    for (other, contact) in &scene.pieces.contacts[piece] {
        let Ok(settled) = scene.states[*other as usize].order else { continue };
        // What was parted continues each other by definition.
        if scene.pieces.origin[*other as usize] == scene.pieces.origin[piece] {
            continue;
        }
        for &(turns, good) in &contact.good {
            // The other's phases plus `turns` continue this piece's.
            if settled - turns == order {
                found.all += good as f32 / contact.all as f32 * (good as f32 / FULL_CONTACT_PAIRS).min(1.0);
            }
        }
    }
    found
}

/// What the cameras of a block say of places that were looked at, for each camera the [`EVIDENCE`].
fn counts<'a>(
    block: usize,
    looks: impl Iterator<Item = (&'a Looks, Range<usize>)>,
    jury: &Jury,
    known: &Known,
) -> [u32; LANES] {
    simd::dispatch(
        #[inline(always)]
        || {
            let mut sum = [0; LANES];
            for (looks, places) in looks {
                for place in places {
                    if let Some(seen) = looks.at(place) {
                        let words = jury.hear(block, &seen[block], known);
                        for i in 0..LANES {
                            sum[i] += words[i];
                        }
                    }
                }
            }
            sum
        },
    )
}
