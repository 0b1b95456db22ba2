// SPDX-License-Identifier: MIT OR Apache-2.0
//! The rig, described once: heads, channels, nodes, pattern, board and the nominal geometry (`rig.toml`).

use super::section::Section;
use super::{ConfigError, Problem, read_all, read_table};
use crate::base::ids::{CameraId, HeadId, NodeId};
use crate::geometry::pattern::{Marker, Pattern};
use crate::geometry::{Device, Fringes, Lens, Pose, look_at};
use nalgebra::{Point3, Vector3};
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use std::path::Path;

/// The colour channel that a head projects and that its cameras' filters pass.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Channel {
    /// Red, the light of an LED.
    R,
    /// Green, the light of a laser.
    G,
    /// Blue, the light of a laser.
    B,
}

/// One camera of a head.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RigCamera {
    pub id: CameraId,
    /// The acquisition PC that it is wired to.
    pub node: NodeId,
    /// Lens and pose by the drawing, before any calibration.
    pub device: Device,
}

/// One directional measurement head: a projector and its cameras.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Head {
    pub id: HeadId,
    pub channel: Channel,
    /// Exposure starts this long after the projector's frame sync, ns.
    pub delay_ns: u64,
    /// Length of the exposure window, ns.
    pub exposure_ns: u64,
    /// Nominal geometry of the projector.
    pub projector: Device,
    pub cameras: Vec<RigCamera>,
}

impl Head {
    /// An exposure must be shorter than this, us, so that it ends within the trigger period after its delay. With a
    /// longer one a camera ignores every second trigger.
    pub fn exposure_limit_us(&self, trigger_rate_hz: f64) -> f64 {
        exposure_limit_us(self.delay_ns as f64 / 1000.0, trigger_rate_hz)
    }
}

fn exposure_limit_us(delay_us: f64, trigger_rate_hz: f64) -> f64 {
    1e6 / trigger_rate_hz - delay_us
}

/// The calibration board: black circles in rows and columns on white; a few larger ones give the orientation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Board {
    /// Size of the board along its x axis, m.
    pub width_m: f64,
    /// Size of the board along its y axis, m.
    pub height_m: f64,
    /// Distance between neighbouring centres, m.
    pub pitch_m: f64,
    /// The number of circles along x.
    pub columns: usize,
    /// The number of circles along y.
    pub rows: usize,
    /// Radius of an ordinary circle, m.
    pub radius_m: f64,
    /// Radius of an orientation circle, m.
    pub large_radius_m: f64,
    /// `[column, row]` of the orientation circles.
    pub large: Vec<[usize; 2]>,
}

/// The rig as its file describes it: heads, volume, pattern and board.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Rig {
    /// Names the rig in recordings and calibrations.
    pub name: String,
    pub trigger_rate_hz: f64,
    /// Triggers before trigger 0 of every session, for cameras that need some to wake up; their frames are not
    /// recorded.
    pub warm_up_triggers: u32,
    /// Lower corner of the working volume, world, m.
    pub volume_min_m: [f64; 3],
    /// Upper corner of the working volume, world, m.
    pub volume_max_m: [f64; 3],
    pub pattern: Pattern,
    pub board: Board,
    /// In order around the volume: neighbours in this list (cyclic) are neighbours in space.
    pub heads: Vec<Head>,
}

impl Rig {
    /// Reads and validates a rig file.
    pub fn load(path: &Path) -> Result<Self, ConfigError> {
        let table = read_table(path)?;
        Self::from_table(&table).map_err(|problems| ConfigError { path: path.to_owned(), problems })
    }

    /// Validates a parsed rig file; on failure every problem found.
    pub fn from_table(table: &toml::Table) -> Result<Self, Vec<Problem>> {
        read_all(table, read_rig)
    }

    /// Loads a rig file, and checks that what it records can be reconstructed: recording itself needs no geometry.
    ///
    /// # Errors
    /// Those of [`Self::load`], or every camera in whose image the fringes would not lie as they must.
    pub fn check(path: &Path) -> Result<Self, ConfigError> {
        let rig = Self::load(path)?;
        let problems = rig.unusable_fringes();
        if problems.is_empty() { Ok(rig) } else { Err(ConfigError { path: path.to_owned(), problems }) }
    }

    fn unusable_fringes(&self) -> Vec<Problem> {
        let (min, max) = (Vector3::from(self.volume_min_m), Vector3::from(self.volume_max_m));
        let middle = Point3::from((min + max) / 2.0);
        let mut problems = Vec::new();
        for (h, head) in self.heads.iter().enumerate() {
            for (c, camera) in head.cameras.iter().enumerate() {
                let seen = Fringes::seen_by(&camera.device, &head.projector, &self.pattern, &middle);
                if let Err(unusable) = seen {
                    let key = format!("head[{h}].camera[{c}]");
                    problems.push(Problem { key, message: format!("{}: {unusable}", camera.id) });
                }
            }
        }
        problems
    }

    /// All cameras with their heads, in the rig's order.
    pub fn cameras(&self) -> impl Iterator<Item = (&Head, &RigCamera)> {
        self.heads.iter().flat_map(|head| head.cameras.iter().map(move |camera| (head, camera)))
    }

    /// The cameras of one node, in the rig's order.
    pub fn cameras_of<'a>(&'a self, node: &'a NodeId) -> impl Iterator<Item = (&'a Head, &'a RigCamera)> {
        self.cameras().filter(move |(_, camera)| camera.node == *node)
    }

    /// The nodes, sorted by name.
    pub fn nodes(&self) -> BTreeSet<NodeId> {
        self.cameras().map(|(_, camera)| camera.node.clone()).collect()
    }
}

/// The only version of rig files so far.
const FORMAT: u64 = 1;

fn read_rig(root: Section<'_>) -> Option<Rig> {
    root.integer("format", FORMAT..=FORMAT);
    let name = root.text("name");
    let trigger_rate_hz = root.number("trigger_rate_hz", 0.1..=1000.0);
    let warm_up_triggers = root.integer_or("warm_up_triggers", 0..=1000, 8) as u32;
    let (volume_min_m, volume_max_m) = root.section("volume").map_or(([0.0; 3], [0.0; 3]), read_volume);
    let pattern = root.section("pattern").map(read_pattern);
    let board = root.section("board").map(read_board);
    let heads: Vec<Head> = root.sections("head").into_iter().map(|s| read_head(s, trigger_rate_hz)).collect();
    check_unique(&root, &heads);
    check_channels(&root, &heads);
    if let Some(pattern) = &pattern {
        check_marker_on_panel(&root, pattern, &heads);
    }
    root.finish();
    let (pattern, board) = (pattern?, board?);
    Some(Rig { name, trigger_rate_hz, warm_up_triggers, volume_min_m, volume_max_m, pattern, board, heads })
}

fn read_volume(section: Section<'_>) -> ([f64; 3], [f64; 3]) {
    let (min, max) = (section.vector("min_m"), section.vector("max_m"));
    if section.has("min_m") && section.has("max_m") && !min.iter().zip(&max).all(|(a, b)| a < b) {
        section
            .problem("max_m", format!("expected each coordinate above that of min_m {min:?}, found {max:?}"));
    }
    section.finish();
    (min, max)
}

fn read_pattern(section: Section<'_>) -> Pattern {
    let strength = section.number("marker_strength", 0.05..=1.0);
    let marker = section.choice(
        "marker",
        &[
            ("zero_mean", Marker::ZeroMean { amplitude: strength }),
            ("darkened", Marker::Darkened { depth: strength }),
            ("none", Marker::ZeroMean { amplitude: 0.0 }),
        ],
    );
    let pattern = Pattern {
        period_px: section.number("period_px", 4.0..=64.0),
        marker_index: section.integer("marker_index", 0..=10_000) as u32,
        marker_every: section.integer_or("marker_every", 0..=10_000, 0) as u32,
        marker,
        marker_period_px: section.number("marker_period_px", 2.0..=64.0),
        low: section.number_or("low", 0.0..=1.0, 0.0),
        high: section.number_or("high", 0.0..=1.0, 1.0),
        gamma: section.number_or("gamma", 0.2..=5.0, 1.0),
    };
    if pattern.high <= pattern.low && section.problem_free() {
        section.problem("high", format!("expected more than low ({}), found {}", pattern.low, pattern.high));
    }
    section.finish();
    pattern
}

fn read_board(section: Section<'_>) -> Board {
    let mut board = Board {
        width_m: section.number("width_m", 0.01..=10.0),
        height_m: section.number("height_m", 0.01..=10.0),
        pitch_m: section.number("pitch_m", 0.001..=1.0),
        columns: section.integer("columns", 2..=1000) as usize,
        rows: section.integer("rows", 2..=1000) as usize,
        radius_m: section.number("radius_m", 0.0005..=0.5),
        large_radius_m: section.number("large_radius_m", 0.0005..=0.5),
        large: Vec::new(),
    };
    board.large = section.each("large", "[column, row] of a circle on the board", |value| {
        let [column, row] = value.as_array()?.as_slice() else { return None };
        let pair = [column, row].map(|x| x.as_integer().and_then(|x| usize::try_from(x).ok()));
        let pair = [pair[0]?, pair[1]?];
        (pair[0] < board.columns && pair[1] < board.rows).then_some(pair)
    });
    if board.large_radius_m * 2.0 > board.pitch_m && section.problem_free() {
        section.problem("large_radius_m", "circles of this radius overlap at this pitch");
    }
    section.finish();
    board
}

fn read_head(section: Section<'_>, trigger_rate_hz: f64) -> Head {
    let id = HeadId(section.name("id"));
    let channel = section.choice("channel", &[("R", Channel::R), ("G", Channel::G), ("B", Channel::B)]);
    let delay_us = section.number_or("delay_us", 0.0..=1e6, 0.0);
    let exposure_us = section.number("exposure_us", 1.0..=1e6);
    if trigger_rate_hz > 0.0 && exposure_us >= exposure_limit_us(delay_us, trigger_rate_hz) {
        section.problem(
            "exposure_us",
            format!(
                "delay and exposure together take {} us, expected less than the trigger period of {:.1} us \
                 ({trigger_rate_hz} Hz)",
                delay_us + exposure_us,
                1e6 / trigger_rate_hz
            ),
        );
    }
    let projector = section.section("projector").map_or_else(placeholder_device, |s| read_device(s, None));
    let cameras = section.sections("camera").into_iter().map(read_camera).collect();
    section.finish();
    let ns = |us: f64| (us * 1000.0).round() as u64;
    Head { id, channel, delay_ns: ns(delay_us), exposure_ns: ns(exposure_us), projector, cameras }
}

fn read_camera(section: Section<'_>) -> RigCamera {
    let mut names = (CameraId(String::new()), NodeId(String::new()));
    let device = read_device(section, Some(&mut names));
    RigCamera { id: names.0, node: names.1, device }
}

fn placeholder_device() -> Device {
    let lens = Lens { fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0, distortion: [0.0; 5] };
    Device { width: 0, height: 0, lens, world_from_device: Pose::new(nalgebra::Isometry3::identity()) }
}

/// Reads a device table; with `names`, also the `id` and `node` of a camera.
fn read_device(section: Section<'_>, names: Option<&mut (CameraId, NodeId)>) -> Device {
    if let Some((id, node)) = names {
        *id = CameraId(section.name("id"));
        *node = NodeId(section.name("node"));
    }
    let width = section.integer("width", 16..=16_384) as usize;
    let height = section.integer("height", 16..=16_384) as usize;
    let focal_px = section.number("focal_px", 10.0..=1e6);
    let centre = [(width as f64 - 1.0) / 2.0, (height as f64 - 1.0) / 2.0];
    let [cx, cy] = section.vector_or("centre_px", centre);
    let distortion = section.vector_or("distortion", [0.0; 5]);
    let position = section.vector("position_m");
    let target = section.vector("look_at_m");
    let roll_deg = section.number_or("roll_deg", -360.0..=360.0, 90.0);
    let pose = look_at(position, target, roll_deg).unwrap_or_else(|| {
        if section.has("position_m") && section.has("look_at_m") {
            section.problem(
                "look_at_m",
                format!("cannot aim from {position:?} at {target:?}: same place or vertical"),
            );
        }
        Pose::new(nalgebra::Isometry3::identity())
    });
    section.finish();
    let lens = Lens { fx: focal_px, fy: focal_px, cx, cy, distortion };
    Device { width, height, lens, world_from_device: pose }
}

fn check_unique(root: &Section<'_>, heads: &[Head]) {
    let (mut head_ids, mut camera_ids) = (BTreeSet::new(), BTreeSet::new());
    for (h, head) in heads.iter().enumerate() {
        if !head_ids.insert(&head.id) {
            root.problem(&format!("head[{h}].id"), format!("{} is used twice, expected unique ids", head.id));
        }
        for (c, camera) in head.cameras.iter().enumerate() {
            if !camera_ids.insert(&camera.id) {
                let key = format!("head[{h}].camera[{c}].id");
                root.problem(&key, format!("{} is used twice, expected unique ids", camera.id));
            }
        }
    }
}

/// Neighbouring heads light each other's object: they must not share a channel (paper, section 3).
fn check_channels(root: &Section<'_>, heads: &[Head]) {
    for (h, head) in heads.iter().enumerate() {
        let next = (h + 1) % heads.len();
        // With two heads the only pair would be named twice.
        let seen = heads.len() == 2 && h == 1;
        if next != h && !seen && head.channel == heads[next].channel {
            root.problem(
                &format!("head[{next}].channel"),
                format!(
                    "heads {} and {} are neighbours and both project {:?}, expected different channels",
                    head.id, heads[next].id, head.channel
                ),
            );
        }
    }
}

fn check_marker_on_panel(root: &Section<'_>, pattern: &Pattern, heads: &[Head]) {
    let widest = heads.iter().map(|head| head.projector.width).max().unwrap_or(0);
    let ridge = f64::from(pattern.marker_index) * pattern.period_px;
    if pattern.has_marker() && widest > 0 && ridge > widest as f64 {
        let message = format!("the marker's ridge lies at column {ridge}, expected at most {widest}");
        root.problem("pattern.marker_index", message);
    }
}

#[cfg(test)]
mod tests {
    use super::Rig;
    use std::path::Path;

    fn shipped() -> String {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config/rig.toml");
        std::fs::read_to_string(path).expect("config/rig.toml is in the repository")
    }

    fn problems(text: &str) -> Vec<String> {
        let table = text.parse().expect("valid TOML");
        let found = Rig::from_table(&table).expect_err("mistakes must be found");
        found.iter().map(ToString::to_string).collect()
    }

    #[test]
    fn the_shipped_rig_is_the_papers() {
        let rig = Rig::from_table(&shipped().parse().expect("TOML")).expect("valid");
        assert_eq!(rig.heads.len(), 4);
        assert_eq!(rig.cameras().count(), 8);
        assert_eq!(rig.nodes().len(), 2);
        assert!(rig.cameras().all(|(_, c)| (c.device.width, c.device.height) == (1920, 1200)));
    }

    /// The problems of the fringes of the shipped rig, changed; by camera.
    fn fringes(change: impl Fn(String) -> String) -> Vec<String> {
        let rig = Rig::from_table(&change(shipped()).parse().expect("TOML")).expect("a rig to record with");
        rig.unusable_fringes().iter().map(ToString::to_string).collect()
    }

    /// Of camera and projector either may lie, of one head or of all; and both, so that fringes run along the baseline.
    #[test]
    fn fringes_that_cannot_be_reconstructed_are_named_by_camera() {
        assert_eq!(fringes(|text| text), [""; 0]);
        let lying = |text: &str, which: &[usize]| {
            let mut parts = text.split("roll_deg = 90.0");
            let mut turned = parts.next().unwrap_or_default().to_owned();
            for (place, part) in parts.enumerate() {
                let roll = if which.contains(&place) { "roll_deg = 0.0" } else { "roll_deg = 90.0" };
                turned += &format!("{roll}{part}");
            }
            turned
        };
        // Of each head the projector comes first, then its two cameras.
        for (which, named) in [
            (vec![1], vec!["head[0].camera[0]: h0_up"]),
            (vec![11], vec!["head[3].camera[1]: h3_low"]),
            (vec![3], vec!["head[1].camera[0]: h1_up", "head[1].camera[1]: h1_low"]),
        ] {
            let found = fringes(|text| lying(&text, &which));
            assert_eq!(found.len(), named.len(), "{found:#?}");
            for (line, camera) in found.iter().zip(named) {
                assert!(line.starts_with(camera) && line.contains("along the image columns"), "{line}");
                assert!(line.contains("roll_deg"), "{line}");
            }
        }
        let found = fringes(|text| text.replace("roll_deg = 90.0", "roll_deg = 0.0"));
        assert_eq!(found.len(), 8);
        assert!(
            found.iter().all(|line| line.contains("along the line from camera to projector")),
            "{found:#?}"
        );
        for (from, to, text) in [
            ("focal_px = 2048.0", "focal_px = 341.0", "of 4 to 40 px in the image"),
            ("\nperiod_px = 8.0", "\nperiod_px = 64.0", "of 4 to 40 px in the image"),
            ("marker_period_px = 8.0", "marker_period_px = 64.0", ""),
        ] {
            let found =
                fringes(|text| text.replace(from, to).replace("marker_index = 80", "marker_index = 9"));
            let right = |line: &String| line.contains(text) && line.contains("a period of 4 to 40 px");
            assert!(found.iter().all(right), "{found:#?}");
            assert_eq!(found.len(), if text.is_empty() { 0 } else { 8 }, "{found:#?}");
        }
    }

    #[test]
    fn all_mistakes_are_reported_at_once_with_key_paths() {
        let text = shipped()
            .replacen("id = \"h0_low\"", "id = \"h0_up\"", 1)
            .replacen("channel = \"G\"", "channel = \"R\"", 1)
            .replacen("exposure_us = 1000.0", "exposure_us = 9000.0", 1)
            .replacen("marker_period_px = 8.0", "marker_perod_px = 8.0", 1)
            .replacen("focal_px = 2048.0", "focal_px = \"2048\"", 1);
        let found = problems(&text);
        for key in [
            "head[0].camera[1].id",
            "head[1].channel",
            "head[0].exposure_us",
            "pattern.marker_perod_px",
            "pattern.marker_period_px",
            "head[0].camera[0].focal_px",
        ] {
            assert!(found.iter().any(|p| p.starts_with(key)), "{key} missing in {found:#?}");
        }
    }
}
