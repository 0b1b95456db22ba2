// SPDX-License-Identifier: MIT OR Apache-2.0
//! Directional clouds of one trigger to a merged cloud: all their points but those that one head sees at grazing
//! incidence and another one sees well (`docs/design/merging.md`, where the rule's invariants are numbered).
//!
//! Points are only left out, never moved. A point that is left out is at grazing incidence, and the one that stands
//! for it is not: what stands for a point is therefore never left out itself, so that one pass decides, in any order
//! of cameras and points, and a merged cloud that is merged again stays as it is.
//!
//! Few points graze (some six in a hundred of a body), so that these are what is looked around for. The cells within
//! reach of them are bits of a grid over them; of the many points that are seen well, only those in such a cell are
//! sorted into it.

mod grid;

use crate::data::Cloud;
use crate::formats::ply::{self, Header, Part};
use crate::geometry::Device;
use grid::Cells;
use rayon::prelude::*;
use std::io;
use std::path::Path;

/// Key of the comment of directional clouds that states from where they are seen and lit.
const SEEN_FROM: &str = "seen_from";

/// Key of the comment of merged clouds that states how many points of the directional ones they lack.
const GRAZING_REMOVED: &str = "grazing_removed";

/// From where a directional cloud is seen and lit, and by which head.
#[derive(Debug, Clone, PartialEq)]
pub struct Viewpoint {
    /// The name of the head.
    pub head: String,
    /// The camera's projection centre, world, m.
    pub camera_m: [f64; 3],
    /// The projector's projection centre, world, m.
    pub projector_m: [f64; 3],
}

impl Viewpoint {
    /// That of a camera and the projector of its head.
    pub fn new(head: &str, camera: &Device, projector: &Device) -> Self {
        let centre = |device: &Device| device.world_from_device.isometry().translation.vector.into();
        Self { head: head.to_owned(), camera_m: centre(camera), projector_m: centre(projector) }
    }

    /// As a cloud's file states it. Numbers come back as they were.
    pub fn comment(&self) -> String {
        let numbers = self.camera_m.iter().chain(&self.projector_m).map(f64::to_string);
        format!("{SEEN_FROM} {} {}", numbers.collect::<Vec<_>>().join(" "), self.head)
    }

    /// What the comments of a cloud's file state; `None` where they do not, as those of merged clouds and of earlier
    /// versions.
    pub fn of(comments: &[String]) -> Option<Self> {
        let stated =
            comments.iter().find_map(|comment| comment.strip_prefix(SEEN_FROM)?.strip_prefix(' '))?;
        let mut parts = stated.splitn(7, ' ');
        let mut number = || parts.next()?.parse().ok().filter(|x: &f64| x.is_finite());
        let camera_m = [number()?, number()?, number()?];
        let projector_m = [number()?, number()?, number()?];
        Some(Self { camera_m, projector_m, head: parts.next()?.to_owned() })
    }
}

/// The comment of a merged cloud that lacks `removed` points of its directional clouds.
pub fn removed_comment(removed: usize) -> String {
    format!("{GRAZING_REMOVED} {removed}")
}

/// Takes the comment of [`removed_comment`] off: the other comments, and the number.
pub fn split_removed(comments: &[String]) -> Option<(&[String], usize)> {
    let (last, others) = comments.split_last()?;
    let removed = last.strip_prefix(GRAZING_REMOVED)?.strip_prefix(' ')?;
    Some((others, removed.parse().ok()?))
}

/// When a point is left out.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rule {
    /// Incidence is grazing where the cosine of the angle between the normal and the direction to the camera, or that
    /// to the projector, is below this.
    pub grazing: f32,
    /// A point is seen well where both are at least this; above `grazing`.
    pub well: f32,
    /// The point that stands for another one is no further from it, m.
    pub reach_m: f32,
    /// The cosine between their normals is at least this: else they are two sides of a thin part, or of an edge.
    pub agree: f32,
}

impl Default for Rule {
    fn default() -> Self {
        Self { grazing: 0.4, well: 0.6, reach_m: 0.002, agree: 0.7 }
    }
}

/// A directional cloud, and from where it is seen. One of which that is not known keeps all its points, and these stand
/// for no others.
#[derive(Debug, Clone, Copy)]
pub struct View<'a> {
    /// Its camera's number in merged clouds.
    pub camera: u8,
    /// The directional cloud, in the world frame, m.
    pub cloud: &'a Cloud,
    /// From where it is seen and lit; `None` where that is not known.
    pub from: Option<&'a Viewpoint>,
}

/// What a merged cloud lacks.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct LeftOut {
    /// For each cloud, whether each of its points is left out; empty where none is.
    pub points: Vec<Vec<bool>>,
    /// How many points of all clouds are left out.
    pub removed: usize,
    /// Whether it is known of any cloud from where it is seen: else there was nothing to decide.
    pub decided: bool,
}

impl LeftOut {
    /// The comment of the merged cloud; none where there was nothing to decide.
    pub fn comment(&self) -> Option<String> {
        self.decided.then(|| removed_comment(self.removed))
    }
}

/// The points that a merged cloud of these lacks, on the current rayon pool.
pub fn left_out(views: &[View<'_>], rule: Rule) -> LeftOut {
    let sights: Vec<Sight> =
        (0..views.len()).into_par_iter().map(|number| Sight::of(views, number, rule)).collect();
    let mut found = LeftOut {
        points: vec![Vec::new(); views.len()],
        removed: 0,
        decided: views.iter().any(|view| view.from.is_some()),
    };
    let grazing = views.iter().zip(&sights).flat_map(|(view, sight)| sight.grazing(view.cloud));
    let Some(cells) = Cells::around(grazing, f64::from(rule.reach_m)) else { return found };
    let seen_well = SeenWell::sort(&cells, views, &sights);
    let decide = |(view, sight): (&View<'_>, &Sight)| {
        let cloud = view.cloud;
        let mut out = vec![false; cloud.len()];
        let mut removed = 0;
        for &i in &sight.grazing {
            let (place, normal) = (cloud.position_m[i as usize], cloud.normal[i as usize]);
            if seen_well.stands_for(&cells, Candidate { place, normal, head: sight.head }, rule) {
                out[i as usize] = true;
                removed += 1;
            }
        }
        (if removed > 0 { out } else { Vec::new() }, removed)
    };
    let decided: Vec<(Vec<bool>, usize)> = views.par_iter().zip(&sights).map(decide).collect();
    found.removed = decided.iter().map(|(_, removed)| removed).sum();
    found.points = decided.into_iter().map(|(points, _)| points).collect();
    found
}

/// The merged cloud of directional ones, in this order.
pub fn merged(views: &[View<'_>], left_out: &LeftOut) -> Cloud {
    let mut merged = Cloud::default();
    for (view, out) in views.iter().zip(&left_out.points) {
        if out.is_empty() {
            merged.merge(view.cloud, view.camera);
        } else {
            let kept: Vec<usize> = (0..view.cloud.len()).filter(|&i| !out[i]).collect();
            merged.merge(&view.cloud.pick(&kept), view.camera);
        }
    }
    if merged.sigma_m.len() != merged.len() {
        // Not all of them have it.
        merged.sigma_m.clear();
    }
    merged
}

/// Writes the merged cloud with `comments` and what it lacks, without putting it together first; the number of its
/// points.
pub fn save(
    path: &Path,
    views: &[View<'_>],
    left_out: &LeftOut,
    mut comments: Vec<String>,
) -> io::Result<usize> {
    comments.extend(left_out.comment());
    let parts = views.iter().zip(&left_out.points);
    let parts = parts.map(|(view, left_out)| Part { camera: view.camera, cloud: view.cloud, left_out });
    let parts: Vec<Part<'_>> = parts.collect();
    ply::save_merged(path, &parts, &comments)?;
    Ok(parts.iter().map(Part::points).sum())
}

/// Whether this is the header of what [`save`] writes with `comments` of clouds that have `points` points together;
/// `decided` as in [`LeftOut`].
pub fn is_finished(header: &Header, comments: &[String], points: usize, decided: bool) -> bool {
    let stated = if decided { split_removed(&header.comments) } else { Some((&header.comments[..], 0)) };
    stated.is_some_and(|(own, removed)| own == comments && header.points.checked_add(removed) == Some(points))
}

/// How a point is seen.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Incidence {
    Neither,
    Grazing,
    Well,
}

/// How the points of a cloud are seen.
#[derive(Default)]
struct Sight {
    /// The first cloud of the same head.
    head: usize,
    /// Each point; empty where from is not known.
    incidence: Vec<Incidence>,
    /// Places of the points at grazing incidence.
    grazing: Vec<u32>,
}

impl Sight {
    fn of(views: &[View<'_>], number: usize, rule: Rule) -> Self {
        let view = &views[number];
        let Some(from) = view.from else { return Self::default() };
        let same_head = |other: &View<'_>| other.from.is_some_and(|other| other.head == from.head);
        let head = views.iter().position(same_head).unwrap_or(number);
        let (camera, projector) = (from.camera_m.map(|x| x as f32), from.projector_m.map(|x| x as f32));
        let points = view.cloud.position_m.iter().zip(&view.cloud.normal);
        let incidence: Vec<Incidence> =
            points.map(|(place, normal)| rule.incidence([camera, projector], *place, *normal)).collect();
        let grazing = (0u32..).zip(&incidence).filter(|(_, incidence)| **incidence == Incidence::Grazing);
        Self { head, grazing: grazing.map(|(i, _)| i).collect(), incidence }
    }

    fn grazing<'a>(&'a self, cloud: &'a Cloud) -> impl Iterator<Item = [f64; 3]> + Clone + 'a {
        self.grazing.iter().map(|&i| cloud.position_m[i as usize].map(f64::from))
    }
}

impl Rule {
    /// How a point is seen from its camera and lit by its projector. What is not a number, or further than 1e19 m
    /// away, is seen neither well nor grazing. Squares are compared, with their signs: roots and quotients are dearer
    /// than all the rest.
    #[inline]
    fn incidence(&self, from: [[f32; 3]; 2], place: [f32; 3], normal: [f32; 3]) -> Incidence {
        let (mut well, mut grazing, mut finite) = (true, false, true);
        for centre in from {
            let ray = [centre[0] - place[0], centre[1] - place[1], centre[2] - place[2]];
            let (along, square) = (dot(ray, normal), dot(ray, ray));
            let along = along * along.abs();
            well &= along >= self.well * self.well * square;
            grazing |= along < self.grazing * self.grazing * square;
            finite &= square < f32::INFINITY;
        }
        let seen = if grazing { Incidence::Grazing } else { Incidence::Neither };
        let seen = if well { Incidence::Well } else { seen };
        if finite { seen } else { Incidence::Neither }
    }
}

fn dot(a: [f32; 3], b: [f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// A point that another may stand for, or that may stand for another.
#[derive(Clone, Copy, Default)]
struct Candidate {
    place: [f32; 3],
    normal: [f32; 3],
    /// The head's number, as in [`Sight::head`].
    head: usize,
}

/// The points that are seen well and lie in a marked cell, by cell.
struct SeenWell {
    /// Where each marked cell begins in `points`, and the end.
    starts: Vec<u32>,
    points: Vec<Candidate>,
}

impl SeenWell {
    fn sort(cells: &Cells, views: &[View<'_>], sights: &[Sight]) -> Self {
        let find = |(view, sight): (&View<'_>, &Sight)| {
            let (head, cloud) = (sight.head, view.cloud);
            let mut found: Vec<(u32, Candidate)> = Vec::new();
            let well = |(_, incidence): &(usize, &Incidence)| **incidence == Incidence::Well;
            for (i, _) in sight.incidence.iter().enumerate().filter(well) {
                let place = cloud.position_m[i];
                if let Some(cell) = cells.number(cells.of(place)) {
                    found.push((cell as u32, Candidate { place, normal: cloud.normal[i], head }));
                }
            }
            found
        };
        let found: Vec<Vec<(u32, Candidate)>> = views.par_iter().zip(sights).map(find).collect();
        // Counted, then put in place.
        let mut starts = vec![0u32; cells.count + 1];
        found.iter().flatten().for_each(|(cell, _)| starts[*cell as usize + 1] += 1);
        for cell in 0..cells.count {
            starts[cell + 1] += starts[cell];
        }
        let mut next = starts.clone();
        let mut points = vec![Candidate::default(); found.iter().map(Vec::len).sum()];
        for (cell, candidate) in found.into_iter().flatten() {
            let place = &mut next[cell as usize];
            points[*place as usize] = candidate;
            *place += 1;
        }
        Self { starts, points }
    }

    /// Whether another head's point stands for this one.
    fn stands_for(&self, cells: &Cells, point: Candidate, rule: Rule) -> bool {
        let reach_2 = rule.reach_m * rule.reach_m;
        let stands = |other: &Candidate| {
            let apart = [0, 1, 2].map(|axis| other.place[axis] - point.place[axis]);
            other.head != point.head
                && dot(apart, apart) <= reach_2
                && dot(other.normal, point.normal) >= rule.agree
        };
        cells.any_within_reach(point.place.map(f64::from), |cell| {
            let Some(cell) = cells.number(cell) else { return false };
            self.points[self.starts[cell] as usize..self.starts[cell + 1] as usize].iter().any(stands)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::{
        Incidence, LeftOut, Rule, View, Viewpoint, dot, left_out, merged, removed_comment, split_removed,
    };
    use crate::data::Cloud;
    use crate::formats::ply;
    use proptest::prelude::{
        ProptestConfig, Strategy, any, prop_assert, prop_assert_eq, prop_assume, proptest,
    };

    /// A camera with its projector beside it.
    fn at(head: &str, [x, y, z]: [f64; 3]) -> Viewpoint {
        Viewpoint { head: head.to_owned(), camera_m: [x, y, z], projector_m: [x, y + 0.1, z] }
    }

    /// So many points, one like the other but for their numbers.
    fn any_cloud(points: usize, sigma: bool) -> Cloud {
        let x = |i: usize| i as f32 * 0.25 - 3.0;
        Cloud {
            position_m: (0..points).map(|i| [x(i), -x(i), x(i) + 0.5]).collect(),
            normal: (0..points).map(|i| [0.0, (i % 2) as f32, 1.0 - (i % 2) as f32]).collect(),
            intensity: (0..points).map(|i| i as f32 / points as f32).collect(),
            pixel: (0..points).map(|i| [i as u16, 1199]).collect(),
            camera: Vec::new(),
            sigma_m: if sigma { (0..points).map(|i| i as f32 * 1e-6).collect() } else { Vec::new() },
        }
    }

    /// A lattice of points, 1 mm apart, on the plane z = `z`, shifted along x.
    fn plane(shift: f32, z: f32, normal: [f32; 3]) -> Cloud {
        let mut cloud = Cloud::default();
        for v in 0..40u16 {
            for u in 0..40u16 {
                cloud.position_m.push([f32::from(u) * 1e-3 + shift, f32::from(v) * 1e-3, z]);
                cloud.normal.push(normal);
                cloud.intensity.push(f32::from(u) / 40.0);
                cloud.pixel.push([u, v]);
            }
        }
        cloud
    }

    fn decide(clouds: &[(&Cloud, &Viewpoint)]) -> LeftOut {
        let views = clouds.iter().map(|&(cloud, from)| View { camera: 0, cloud, from: Some(from) });
        left_out(&views.collect::<Vec<_>>(), Rule::default())
    }

    /// From straight above the plane, and from 80 degrees beside that.
    fn above() -> Viewpoint {
        at("h0", [0.0, 0.0, 2.0])
    }

    fn beside() -> Viewpoint {
        at("h1", [2.0, 0.0, 0.35])
    }

    #[test]
    fn what_grazes_goes_where_another_head_sees_it_well_and_only_there() {
        let up = [0.0, 0.0, 1.0];
        let (well, grazing) = (plane(0.0, 0.0, up), plane(0.0305, 0.0003, up));
        let found = decide(&[(&well, &above()), (&grazing, &beside())]);
        assert!(found.points[0].is_empty() && found.decided);
        // The last point of a row that is seen well lies at 39 mm: it stands for what is no further than 2 mm from it.
        for (pixel, out) in grazing.pixel.iter().zip(&found.points[1]) {
            assert_eq!(*out, pixel[0] <= 10, "{pixel:?}");
        }
        assert_eq!(found.removed, 40 * 11);
        let views = [(3, &well), (5, &grazing)].map(|(camera, cloud)| View { camera, cloud, from: None });
        let cloud = merged(&views, &found);
        assert_eq!(cloud.len(), 2 * 1600 - found.removed);
        assert_eq!(cloud.of_camera(3), well);
        let kept: Vec<usize> = (0..1600).filter(|&i| !found.points[1][i]).collect();
        assert_eq!(cloud.of_camera(5), grazing.pick(&kept));
    }

    #[test]
    fn what_two_heads_see_equally_is_kept_of_both() {
        let up = [0.0, 0.0, 1.0];
        let (a, b) = (plane(0.0, 0.0, up), plane(0.0003, 0.0003, up));
        for place in [[0.0, 0.0, 2.0], [1.0, 0.0, 2.0], [2.0, 0.0, 0.35]] {
            assert_eq!(decide(&[(&a, &at("h0", place)), (&b, &at("h1", place))]).removed, 0, "{place:?}");
        }
        // Neither grazing nor well.
        let between = at("h2", [1.7, 0.0, 1.0]);
        assert_eq!(decide(&[(&a, &between), (&b, &beside())]).removed, 0);
        assert_eq!(decide(&[(&a, &between), (&b, &above())]).removed, 0);
    }

    #[test]
    fn the_back_of_a_thin_hand_does_not_stand_for_its_palm() {
        let (palm, back) = (plane(0.0, 0.0, [0.0, 0.0, 1.0]), plane(0.0, -0.001, [0.0, 0.0, -1.0]));
        let below = at("h2", [0.0, 0.0, -2.0]);
        assert_eq!(decide(&[(&palm, &beside()), (&back, &below)]).removed, 0);
        // A normal 46 degrees away is another side of an edge, too; one 44 degrees away is not.
        for (degrees, removed) in [(46f32, 0), (44.0, 1600)] {
            let (sine, cosine) = degrees.to_radians().sin_cos();
            let other = plane(0.0, 0.0, [-sine, 0.0, cosine]);
            assert_eq!(decide(&[(&palm, &beside()), (&other, &above())]).removed, removed);
        }
    }

    #[test]
    fn a_head_does_not_stand_for_itself_and_its_projector_counts() {
        let up = [0.0, 0.0, 1.0];
        let (a, b) = (plane(0.0, 0.0, up), plane(0.0, 0.0, up));
        let same = Viewpoint { head: "h0".to_owned(), ..beside() };
        assert_eq!(decide(&[(&a, &above()), (&b, &same)]).removed, 0);
        // Seen from above, lit from beside: grazing, and it stands for nothing.
        let lit_beside = Viewpoint { projector_m: beside().projector_m, ..at("h1", [0.0, 0.0, 2.0]) };
        let found = decide(&[(&a, &above()), (&b, &lit_beside)]);
        assert_eq!((found.points[0].len(), found.removed), (0, 1600));
        assert_eq!(decide(&[(&a, &beside()), (&b, &lit_beside)]).removed, 0);
        // From where is not known: it neither goes nor stands for others.
        for (first, second) in [(Some(above()), None), (None, Some(beside())), (None, None)] {
            let views = [(&a, &first), (&b, &second)];
            let views = views.map(|(cloud, from)| View { camera: 0, cloud, from: from.as_ref() });
            let found = left_out(&views, Rule::default());
            assert_eq!((found.removed, found.decided), (0, first.is_some() || second.is_some()));
        }
    }

    #[test]
    fn points_far_away_or_nowhere_change_nothing_else() {
        let up = [0.0, 0.0, 1.0];
        let (well, mut grazing) = (plane(0.0, 0.0, up), plane(0.0, 0.0, up));
        grazing.position_m[7] = [1e6, -1e6, 1e6];
        grazing.position_m[8] = [f32::NAN; 3];
        grazing.position_m[9] = [f32::INFINITY, 0.0, 0.0];
        grazing.position_m[10] = [3e38, -3e38, 3e38];
        grazing.normal[11] = [f32::NAN; 3];
        let found = decide(&[(&well, &above()), (&grazing, &beside())]);
        let kept: Vec<usize> = (0..1600).filter(|&i| !found.points[1][i]).collect();
        assert_eq!(kept, [7, 8, 9, 10, 11]);
        let empty = Cloud::default();
        assert_eq!(decide(&[(&empty, &above()), (&empty, &beside())]).removed, 0);
        assert_eq!(left_out(&[], Rule::default()), LeftOut::default());
    }

    /// Points that are crowded, with normals that are anything.
    fn crowd() -> impl Strategy<Value = Cloud> {
        let number = -1.0f32..1.0;
        let point = (proptest::array::uniform3(0.0f32..0.012), proptest::array::uniform3(number));
        proptest::collection::vec(point, 0..120).prop_map(|points| {
            let mut cloud = Cloud::default();
            for (i, (position, n)) in (0u16..).zip(points) {
                let length = dot(n, n).sqrt().max(1e-3);
                cloud.position_m.push(position);
                cloud.normal.push(n.map(|x| x / length));
                cloud.intensity.push(0.5);
                cloud.pixel.push([i, 0]);
            }
            cloud
        })
    }

    /// Whether the points of cloud `a` are left out, by looking at all pairs of points.
    fn by_all_pairs(clouds: &[(&Cloud, &Viewpoint)], a: usize) -> Vec<bool> {
        let seen = |(cloud, from): &(&Cloud, &Viewpoint), i: usize| {
            let from = [from.camera_m, from.projector_m].map(|centre| centre.map(|x| x as f32));
            Rule::default().incidence(from, cloud.position_m[i], cloud.normal[i])
        };
        let (cloud, from) = clouds[a];
        let rule = Rule::default();
        let stands = |i: usize, other: &(&Cloud, &Viewpoint), k: usize| {
            let apart: [f32; 3] =
                std::array::from_fn(|axis| other.0.position_m[k][axis] - cloud.position_m[i][axis]);
            dot(apart, apart) <= rule.reach_m * rule.reach_m
                && dot(other.0.normal[k], cloud.normal[i]) >= rule.agree
                && seen(other, k) == Incidence::Well
        };
        let others: Vec<_> = clouds.iter().filter(|other| other.1.head != from.head).collect();
        let out = |i: usize| {
            seen(&clouds[a], i) == Incidence::Grazing
                && others.iter().any(|other| (0..other.0.len()).any(|k| stands(i, other, k)))
        };
        (0..cloud.len()).map(out).collect()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(200))]
        #[test]
        fn the_rule_holds_for_all_pairs_in_any_order_and_once_is_enough(
            crowds in proptest::collection::vec((crowd(), 0usize..3, proptest::array::uniform3(-2.0f64..2.0)), 1..5),
            turn in 0usize..5,
        ) {
            let heads = ["h0", "h1", "h2"];
            let from: Vec<Viewpoint> = crowds.iter().map(|(_, head, place)| at(heads[*head], *place)).collect();
            let clouds: Vec<(&Cloud, &Viewpoint)> = crowds.iter().map(|(cloud, _, _)| cloud).zip(&from).collect();
            let found = decide(&clouds);
            let mut kept = Vec::new();
            for (i, (cloud, _)) in clouds.iter().enumerate() {
                let expected = by_all_pairs(&clouds, i);
                let out = |k: usize| found.points[i].get(k).copied().unwrap_or(false);
                prop_assert!((0..cloud.len()).all(|k| out(k) == expected[k]));
                kept.push(cloud.pick(&(0..cloud.len()).filter(|&k| !out(k)).collect::<Vec<_>>()));
            }
            let all: usize = clouds.iter().map(|(cloud, _)| cloud.len()).sum();
            prop_assert_eq!(kept.iter().map(Cloud::len).sum::<usize>() + found.removed, all);
            // What is kept is kept again: whoever stands for a point is there.
            let again: Vec<(&Cloud, &Viewpoint)> = kept.iter().zip(&from).collect();
            prop_assert_eq!(decide(&again).removed, 0);
            // The cameras in another order.
            let mut turned = clouds.clone();
            turned.rotate_left(turn % clouds.len());
            let mut points = decide(&turned).points;
            points.rotate_right(turn % clouds.len());
            prop_assert_eq!(points, found.points);
        }

        #[test]
        fn viewpoints_and_numbers_come_back_as_they_were(
            numbers in proptest::array::uniform6(any::<f64>()), head in "[ -~]{0,12}", removed in any::<usize>(),
        ) {
            prop_assume!(numbers.iter().all(|x| x.is_finite()));
            let [a, b, c, d, e, f] = numbers;
            let from = Viewpoint { head, camera_m: [a, b, c], projector_m: [d, e, f] };
            let comments = ["camera x".to_owned(), from.comment(), removed_comment(removed)];
            prop_assert_eq!(Viewpoint::of(&comments), Some(from));
            prop_assert_eq!(split_removed(&comments), Some((&comments[..2], removed)));
            prop_assert_eq!(split_removed(&comments[..2]), None);
        }
    }

    #[test]
    fn a_damaged_statement_is_none() {
        for text in
            ["seen_from", "seen_from 1 2 3 h0", "seen_from 1 2 3 4 5 x h0", "seen_from 1 2 3 4 5 inf h0", ""]
        {
            assert_eq!(Viewpoint::of(&[text.to_owned()]), None, "{text}");
        }
        assert_eq!(split_removed(&[]), None);
        assert_eq!(split_removed(&["grazing_removed -1".to_owned()]), None);
    }

    #[test]
    fn merged_parts_are_written_as_the_merged_cloud_is() {
        for (sizes, sigma, every) in [
            ([3, 5000, 0, 7], true, 3),
            ([0, 0, 0, 0], true, 2),
            ([1, 0, 2, 9], false, 2),
            ([4, 1, 9, 2], true, 1),
        ] {
            let clouds = sizes.map(|points| any_cloud(points, sigma));
            // Some points of the second and of the last are left out; where `every` is 1, all of them.
            let out = |i: usize| {
                if i % 2 == 1 { (0..sizes[i]).map(|k| k % every == 0).collect() } else { Vec::new() }
            };
            let left_out: [Vec<bool>; 4] = std::array::from_fn(out);
            let views = (2..).zip(&clouds).map(|(camera, cloud)| View { camera, cloud, from: None });
            let views: Vec<View<'_>> = views.collect();
            let all = LeftOut { points: left_out.to_vec(), ..LeftOut::default() };
            let merged = merged(&views, &all);
            let parts = (2..).zip(&clouds).zip(&left_out);
            let parts: Vec<ply::Part<'_>> =
                parts.map(|((camera, cloud), left_out)| ply::Part { camera, cloud, left_out }).collect();
            let (mut whole, mut streamed) = (Vec::new(), Vec::new());
            ply::write(&mut whole, &merged, &[]).expect("memory");
            ply::write_merged(&mut streamed, &parts, &[]).expect("memory");
            assert!(whole == streamed, "{sizes:?}");
        }
    }
}
