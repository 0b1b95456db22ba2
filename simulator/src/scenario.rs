// SPDX-License-Identifier: MIT OR Apache-2.0
//! A scenario: one TOML file that, with its seed, determines every simulated photon.
//!
//! Strict like the product's own files: unknown keys are refused, all problems are reported at once.

use crate::scene::mannequin;
use crate::scene::motion::Motion;
use crate::scene::paint::Paint;
use crate::scene::torso::{Section as BodySection, Torso};
use crate::scene::worn::Worn;
use fourdbody::config::{ConfigError, Problem, Section};
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use serde::Serialize;
use std::cell::RefCell;
use std::f64::consts::TAU;
use std::path::{Path, PathBuf};

/// What a run of the simulated world looks like.
#[derive(Debug, Clone, Serialize)]
pub struct Scenario {
    pub name: String,
    pub seed: u64,
    pub rig: PathBuf,
    pub instants: usize,
    /// Instants per second of the subject's time; the rig's trigger rate when absent.
    pub rate_hz: Option<f64>,
    /// What follows the last instant when the images are replayed.
    pub after_end: AfterEnd,
    /// What the projectors show, instant by instant, repeated.
    pub light: Vec<Light>,
    /// What stands in the volume.
    pub subject: Subject,
    /// What is painted on it.
    pub paint: Paint,
    /// How far the true geometry is from the rig's nominal one.
    pub geometry: Jitter,
    /// Everything between panel and pixel value.
    pub optics: Optics,
    /// Ground truth is written for instants 0, n, 2n...; 0: never.
    pub truth_every: usize,
}

/// What follows the last instant.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AfterEnd {
    /// Backwards to the first, and again: movement without a jump.
    PingPong,
    Wrap,
}

/// The image that the projectors show.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Light {
    Fringes,
    White,
    /// Nothing but the panel's black level.
    Dark,
}

/// What stands in the volume.
#[derive(Debug, Clone, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Subject {
    Mannequin {
        motion: Motion,
        /// Length of one repetition, s.
        period_s: f64,
        /// Where in the repetition instant 0 lies, 0 to 1.
        start: f64,
        /// Where it stands on the floor, m.
        position_m: [f64; 2],
        /// Which way it faces from world +x (head h0), towards +y.
        heading_deg: f64,
        /// How tall it stands, m: all of it is larger or smaller.
        height_m: f64,
        cell_mm: f64,
        /// Relative amplitude of the skin's texture.
        texture: f64,
        /// What it wears or holds.
        #[serde(skip_serializing_if = "Worn::is_nothing")]
        worn: Worn,
    },
    /// The rig's calibration board, or a blank plate.
    Flat {
        /// Size of a blank plate, m; absent: the rig's board with its circles.
        plate_m: Option<[f64; 2]>,
        /// Where it stands, one after the other, repeated.
        poses: Vec<FlatPose>,
        /// Instants that each pose lasts.
        hold: usize,
        /// Turns about the world's vertical axis from each pose on, where the pose has no turn of its own.
        rpm: f64,
        /// Albedo of the circles relative to the rest.
        black: f64,
        /// Albedo of the other side relative to the face's.
        back: f64,
    },
    /// A body without limbs, of known girths.
    Torso(Torso),
    Sphere {
        centre_m: [f64; 3],
        radius_m: f64,
    },
    Cylinder {
        /// Centre of the lower end, m.
        foot_m: [f64; 3],
        radius_m: f64,
        height_m: f64,
    },
    /// A mesh file, or a directory of them played one after the other.
    Mesh {
        /// OBJ or PLY, metres, z up.
        path: PathBuf,
        /// Instants that each file lasts.
        hold: usize,
    },
}

/// How a flat thing stands.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct FlatPose {
    pub centre_m: [f64; 3],
    /// Which way its face looks: from world +x towards +y.
    pub azimuth_deg: f64,
    /// How far its face is tilted upwards.
    pub tilt_deg: f64,
    /// Turned about its own normal.
    pub roll_deg: f64,
    /// Turns about the world's vertical axis from then on; absent: the subject's own.
    pub rpm: Option<f64>,
}

impl FlatPose {
    /// Board coordinates (x to the right of its face's viewer's left, y up, z out of the face) to the world.
    pub fn world_from_board(&self) -> Isometry3<f64> {
        // Upright and facing +x: board x = world y, board y = world z, board z = world x.
        let upright = UnitQuaternion::from_euler_angles(TAU / 4.0, 0.0, TAU / 4.0);
        let turn =
            |axis: Vector3<f64>, degrees: f64| UnitQuaternion::from_scaled_axis(axis * degrees.to_radians());
        let rotation = turn(Vector3::z(), self.azimuth_deg)
            * upright
            * turn(-Vector3::x(), self.tilt_deg)
            * turn(Vector3::z(), self.roll_deg);
        Isometry3::from_parts(Translation3::from(Vector3::from(self.centre_m)), rotation)
    }
}

/// Standard deviations of the true geometry about the nominal one (cut at 2.5), and the true distortion.
#[derive(Debug, Clone, Serialize)]
pub struct Jitter {
    /// Of each coordinate of a device's position, mm.
    pub position_mm: f64,
    /// Of each of a device's three angles.
    pub angle_deg: f64,
    /// Of the focal length, as a share.
    pub focal: f64,
    /// Of each coordinate of the principal point, px.
    pub centre_px: f64,
    /// Mean `[k1, k2]` of the cameras.
    pub camera_distortion: [f64; 2],
    /// Mean `[k1, k2]` of the projectors.
    pub projector_distortion: [f64; 2],
    /// Of k1 and k2 about their means, as a share.
    pub distortion: f64,
    /// Standard deviation of the lens's tangential coefficients p1 and p2.
    pub tangential: f64,
    /// By how much each device has turned since it was calibrated, about an axis by lot: standard deviation of the
    /// angle.
    pub drift_deg: f64,
}

/// Everything between panel and pixel value; `docs/design/simulated-light.md` has the equations.
#[derive(Debug, Clone, Serialize)]
pub struct Optics {
    /// The subject's albedo in R, G, B.
    pub albedo: [f64; 3],
    /// Pixel value that the subject reaches in full light, face on, at `exposure_distance_m`.
    pub exposure_dn: f64,
    /// See `exposure_dn`: distance from the projector, m.
    pub exposure_distance_m: f64,
    /// Factors on the exposure of R, G, B.
    pub exposure_factor: [f64; 3],
    /// Share of full light that a black panel still lets through.
    pub black_level: f64,
    /// Exponent from panel value to light; absent: that of the rig's pattern, so that it is exactly undone.
    pub projector_gamma: Option<f64>,
    /// Gaussian blur of the projector besides its pixel's own square, panel px.
    pub projector_blur_px: f64,
    /// Where the projectors' images are sharpest, m; see `projector_defocus`.
    pub projector_focus_m: f64,
    /// Gaussian blur that each metre before or behind that adds, panel px.
    pub projector_defocus: f64,
    /// How far light spreads within the skin (standard deviation), mm.
    pub subsurface_mm: f64,
    /// Share of another channel's light that a camera's filter lets through.
    pub cross_talk: f64,
    /// Room light on everything, as a share of `exposure_dn`.
    pub ambient: f64,
    pub floor_albedo: f64,
    pub curtain_albedo: f64,
    /// Distance of the curtain from the world's vertical axis, m.
    pub curtain_radius_m: f64,
    /// Gaussian blur of the camera, px.
    pub camera_blur_px: f64,
    /// Where the lenses are sharpest, m; see `camera_defocus`.
    pub camera_focus_m: f64,
    /// Gaussian blur that each metre before or behind that adds, px.
    pub camera_defocus: f64,
    /// Loss of light in the sensor's corner.
    pub vignetting: f64,
    pub electrons_per_dn: f64,
    /// Standard deviation, in pixel values.
    pub read_noise_dn: f64,
    /// Standard deviation of the pixels' sensitivity, as a share.
    pub prnu: f64,
    pub offset_dn: f64,
    /// Rays along each side of a pixel where depth or albedo jumps.
    pub edge_samples: usize,
    /// Moments within one exposure; 1: nothing moves during an exposure.
    pub exposure_samples: usize,
}

impl Optics {
    /// Blur of the projected image at a distance from a projector of focal length `fx` px: focus and skin, panel px.
    pub fn projector_blur_at(&self, distance_m: f64, fx: f64) -> f64 {
        let defocus = self.projector_defocus * (distance_m - self.projector_focus_m);
        let skin = self.subsurface_mm / 1000.0 * fx / distance_m;
        (self.projector_blur_px.powi(2) + defocus * defocus + skin * skin).sqrt()
    }

    /// The least and the most of it in use, px.
    pub fn projector_blurs_px(&self) -> [f64; 2] {
        let changes = self.projector_defocus > 0.0 || self.subsurface_mm > 0.0;
        [self.projector_blur_px, if changes { f64::INFINITY } else { self.projector_blur_px }]
    }
}

const FORMAT: u64 = 1;
const MOST: u64 = 1_000_000;

impl Scenario {
    /// Reads and validates a scenario. Paths in it are relative to the file.
    pub fn load(path: &Path) -> Result<Self, ConfigError> {
        let fail = |problems| ConfigError { path: path.to_owned(), problems };
        let whole = |message: String| fail(vec![Problem { key: String::new(), message }]);
        let text = std::fs::read_to_string(path).map_err(|e| whole(format!("cannot be read: {e}")))?;
        let table = text.parse().map_err(|e: toml::de::Error| whole(format!("not valid TOML: {e}")))?;
        Self::from_table(&table, path.parent().unwrap_or(Path::new("."))).map_err(fail)
    }

    /// Validates a parsed scenario whose paths are relative to `directory`; on failure every problem found.
    pub fn from_table(table: &toml::Table, directory: &Path) -> Result<Self, Vec<Problem>> {
        let problems = RefCell::default();
        let scenario = read_scenario(Section::root(table, &problems), directory);
        let problems = problems.into_inner();
        if problems.is_empty() { Ok(scenario) } else { Err(problems) }
    }

    /// The light at an instant.
    pub fn light_at(&self, instant: usize) -> Light {
        self.light[instant % self.light.len()]
    }

    /// The instants with ground truth.
    pub fn has_truth(&self, instant: usize) -> bool {
        self.truth_every > 0 && instant.is_multiple_of(self.truth_every)
    }
}

fn read_scenario(root: Section<'_>, directory: &Path) -> Scenario {
    root.integer("format", FORMAT..=FORMAT);
    let seed = root.integer("seed", 0..=i64::MAX as u64);
    let scenario = Scenario {
        name: root.text("name"),
        seed,
        rig: directory.join(root.text("rig")),
        instants: root.integer("instants", 1..=MOST) as usize,
        rate_hz: root.has("rate_hz").then(|| root.number("rate_hz", 0.001..=1000.0)),
        after_end: root
            .choice_or_first("after_end", &[("ping_pong", AfterEnd::PingPong), ("wrap", AfterEnd::Wrap)]),
        light: read_light(&root),
        truth_every: root.integer_or("truth_every", 0..=MOST, 0) as usize,
        geometry: optional(&root, "geometry", read_jitter),
        paint: root.optional_section("paint").map_or(Paint::Nothing, |section| Paint::read(section, seed)),
        optics: optional(&root, "optics", read_optics),
        subject: root.section("subject").map_or_else(placeholder_subject, |s| read_subject(s, directory)),
    };
    root.finish();
    scenario
}

/// Reads a table that may be absent: every key in it has a default.
fn optional<T>(root: &Section<'_>, key: &'static str, read: impl Fn(Section<'_>) -> T) -> T {
    match root.optional_section(key) {
        Some(section) => read(section),
        None => {
            let (empty, none) = (toml::Table::new(), RefCell::default());
            read(Section::root(&empty, &none))
        }
    }
}

fn read_light(root: &Section<'_>) -> Vec<Light> {
    let words = root.list("light");
    let light = words.iter().enumerate().filter_map(|(i, word)| match word.as_str() {
        Some("fringes") => Some(Light::Fringes),
        Some("white") => Some(Light::White),
        Some("dark") => Some(Light::Dark),
        _ => {
            let expected = "expected one of \"fringes\", \"white\", \"dark\"";
            root.problem(&format!("light[{i}]"), format!("{expected}, found {word}"));
            None
        }
    });
    let light: Vec<Light> = light.collect();
    if light.is_empty() { vec![Light::Fringes] } else { light }
}

fn placeholder_subject() -> Subject {
    Subject::Sphere { centre_m: [0.0; 3], radius_m: 1.0 }
}

#[derive(Clone, Copy)]
enum Kind {
    Mannequin,
    Board,
    Plane,
    Sphere,
    Cylinder,
    Torso,
    Mesh,
}

fn read_subject(section: Section<'_>, directory: &Path) -> Subject {
    let kinds = [
        ("mannequin", Kind::Mannequin),
        ("board", Kind::Board),
        ("plane", Kind::Plane),
        ("sphere", Kind::Sphere),
        ("cylinder", Kind::Cylinder),
        ("torso", Kind::Torso),
        ("mesh", Kind::Mesh),
    ];
    let subject = match section.choice("kind", &kinds) {
        Kind::Mannequin => Subject::Mannequin {
            motion: section.choice("motion", &Motion::NAMES),
            period_s: section.number_or("period_s", 0.05..=1000.0, 2.0),
            start: section.number_or("start", 0.0..=1.0, 0.0),
            position_m: section.vector_or("position_m", [0.0; 2]),
            heading_deg: section.number_or("heading_deg", -360.0..=360.0, 0.0),
            height_m: section.number_or("height_m", 0.5..=2.3, mannequin::HEIGHT_M),
            cell_mm: section.number_or("cell_mm", 1.0..=50.0, 6.0),
            texture: section.number_or("texture", 0.0..=0.5, 0.04),
            worn: section.choice_or_first("worn", &Worn::NAMES),
        },
        Kind::Board => read_flat(&section, None),
        Kind::Plane => read_flat(&section, Some(section.vector_or("size_m", [1.5, 2.0]))),
        Kind::Sphere => Subject::Sphere {
            centre_m: section.vector("centre_m"),
            radius_m: section.number("radius_m", 0.001..=5.0),
        },
        Kind::Cylinder => Subject::Cylinder {
            foot_m: section.vector("foot_m"),
            radius_m: section.number("radius_m", 0.001..=5.0),
            height_m: section.number("height_m", 0.001..=5.0),
        },
        Kind::Torso => read_torso(&section),
        Kind::Mesh => Subject::Mesh {
            path: directory.join(section.text("path")),
            hold: section.integer_or("hold", 1..=MOST, 1) as usize,
        },
    };
    section.finish();
    subject
}

fn read_flat(section: &Section<'_>, plate_m: Option<[f64; 2]>) -> Subject {
    let poses = section.sections("pose").into_iter().map(|pose| {
        let flat = FlatPose {
            centre_m: pose.vector("centre_m"),
            azimuth_deg: pose.number_or("azimuth_deg", -360.0..=360.0, 0.0),
            tilt_deg: pose.number_or("tilt_deg", -90.0..=90.0, 0.0),
            roll_deg: pose.number_or("roll_deg", -360.0..=360.0, 0.0),
            rpm: pose.has("rpm").then(|| pose.number("rpm", -1000.0..=1000.0)),
        };
        pose.finish();
        flat
    });
    Subject::Flat {
        plate_m,
        poses: poses.collect(),
        hold: section.integer_or("hold", 1..=MOST, 1) as usize,
        rpm: section.number_or("rpm", -1000.0..=1000.0, 0.0),
        black: if plate_m.is_some() { 1.0 } else { section.number_or("black", 0.0..=1.0, 0.047) },
        back: section.number_or("back", 0.0..=1.0, 0.05),
    }
}

fn read_torso(section: &Section<'_>) -> Subject {
    let sections = section.sections("section").into_iter().map(|part| {
        let read = BodySection {
            name: part.has("name").then(|| part.text("name")),
            height_m: part.number("height_m", 0.1..=2.5),
            half_depth_m: part.number("half_depth_m", 0.01..=1.0),
            half_width_m: part.number("half_width_m", 0.01..=1.0),
            exponent: part.number_or("exponent", 1.5..=6.0, 2.0),
            furrow: part.number_or("furrow", 0.0..=0.3, 0.0),
        };
        part.finish();
        read
    });
    let sections: Vec<BodySection> = sections.collect();
    let grow = sections.windows(2).all(|pair| pair[0].height_m < pair[1].height_m);
    if sections.len() < 2 || !grow {
        let found: Vec<f64> = sections.iter().map(|s| s.height_m).collect();
        section.problem(
            "section",
            format!("expected two or more, each higher than the one before, found {found:?} m"),
        );
    }
    Subject::Torso(Torso {
        sections,
        position_m: section.vector_or("position_m", [0.0; 2]),
        heading_deg: section.number_or("heading_deg", -360.0..=360.0, 0.0),
    })
}

fn read_jitter(section: Section<'_>) -> Jitter {
    let jitter = Jitter {
        position_mm: section.number_or("position_mm", 0.0..=100.0, 8.0),
        angle_deg: section.number_or("angle_deg", 0.0..=10.0, 0.5),
        focal: section.number_or("focal", 0.0..=0.1, 0.004),
        centre_px: section.number_or("centre_px", 0.0..=100.0, 6.0),
        camera_distortion: section.vector_or("camera_distortion", [-0.095, 0.075]),
        projector_distortion: section.vector_or("projector_distortion", [-0.035, 0.02]),
        distortion: section.number_or("distortion", 0.0..=0.5, 0.04),
        tangential: section.number_or("tangential", 0.0..=0.01, 2e-4),
        drift_deg: section.number_or("drift_deg", 0.0..=1.0, 0.0),
    };
    section.finish();
    jitter
}

fn read_optics(section: Section<'_>) -> Optics {
    let share = |key, default| section.number_or(key, 0.0..=1.0, default);
    let optics = Optics {
        albedo: section.vector_or("albedo", [0.62, 0.44, 0.36]),
        exposure_dn: section.number_or("exposure_dn", 1.0..=10_000.0, 200.0),
        exposure_distance_m: section.number_or("exposure_distance_m", 0.1..=20.0, 2.2),
        exposure_factor: section.vector_or("exposure_factor", [1.0; 3]),
        black_level: share("black_level", 0.004),
        projector_gamma: section.has("projector_gamma").then(|| section.number("projector_gamma", 0.2..=5.0)),
        projector_blur_px: section.number_or("projector_blur_px", 0.0..=5.0, 0.55),
        projector_focus_m: section.number_or("projector_focus_m", 0.1..=20.0, 2.2),
        projector_defocus: section.number_or("projector_defocus", 0.0..=20.0, 0.0),
        subsurface_mm: section.number_or("subsurface_mm", 0.0..=10.0, 0.0),
        cross_talk: share("cross_talk", 0.0),
        ambient: share("ambient", 0.0),
        floor_albedo: share("floor_albedo", 0.04),
        curtain_albedo: share("curtain_albedo", 0.02),
        curtain_radius_m: section.number_or("curtain_radius_m", 2.6..=50.0, 4.0),
        camera_blur_px: section.number_or("camera_blur_px", 0.0..=5.0, 0.6),
        camera_focus_m: section.number_or("camera_focus_m", 0.1..=20.0, 2.2),
        camera_defocus: section.number_or("camera_defocus", 0.0..=20.0, 0.0),
        vignetting: share("vignetting", 0.15),
        electrons_per_dn: section.number_or("electrons_per_dn", 0.01..=1e9, 100.0),
        read_noise_dn: section.number_or("read_noise_dn", 0.0..=100.0, 0.4),
        prnu: section.number_or("prnu", 0.0..=0.2, 0.004),
        offset_dn: section.number_or("offset_dn", 0.0..=255.0, 1.5),
        edge_samples: section.integer_or("edge_samples", 1..=16, 3) as usize,
        exposure_samples: section.integer_or("exposure_samples", 1..=64, 1) as usize,
    };
    for (key, values) in [("albedo", optics.albedo), ("exposure_factor", optics.exposure_factor)] {
        if !values.iter().all(|x| (0.001..=100.0).contains(x)) {
            section.problem(key, format!("expected three numbers from 0.001 to 100, found {values:?}"));
        }
    }
    section.finish();
    optics
}

#[cfg(test)]
mod tests {
    use super::{FlatPose, Scenario, Subject};
    use nalgebra::{Point3, Vector3};
    use std::path::Path;

    fn shipped(name: &str) -> std::path::PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/scenarios").join(name)
    }

    #[test]
    fn shipped_scenarios_are_valid() {
        for name in ["demo.toml", "board.toml", "sphere.toml", "plane.toml", "turntable.toml", "torso.toml"] {
            let scenario = Scenario::load(&shipped(name)).unwrap_or_else(|e| panic!("{e}"));
            assert!(scenario.rig.exists(), "{name}: {}", scenario.rig.display());
        }
        for battery in ["poses", "held_out", "bodies"] {
            let poses =
                shipped(battery).read_dir().expect("a directory").map(|pose| pose.expect("an entry").path());
            let poses: Vec<Scenario> =
                poses.map(|pose| Scenario::load(&pose).unwrap_or_else(|e| panic!("{e}"))).collect();
            // The issue asks for a hundred camera frames and more: eight cameras each.
            assert!(8 * poses.iter().map(|pose| pose.instants).sum::<usize>() >= 100);
            assert!(poses.iter().all(|pose| pose.rig.exists() && pose.truth_every == 1));
        }
        let demo = Scenario::load(&shipped("demo.toml")).expect("valid");
        assert_eq!(demo.instants, 24);
        assert!(matches!(demo.subject, Subject::Mannequin { .. }));
    }

    #[test]
    fn all_mistakes_are_reported_at_once_with_key_paths() {
        let text = "format = 1\nname = \"x\"\nseed = -1\nrig = \"r\"\ninstants = 0\nlight = [\"fringes\", \"blue\"]\n\
                    [subject]\nkind = \"mannequin\"\nmotion = \"dance\"\n[optics]\nvignetting = 2\nblur = 1\n";
        let table = text.parse().expect("TOML");
        let found = Scenario::from_table(&table, Path::new(".")).expect_err("mistakes");
        let found: Vec<String> = found.iter().map(ToString::to_string).collect();
        for key in ["seed", "instants", "light[1]", "subject.motion", "optics.vignetting", "optics.blur"] {
            assert!(found.iter().any(|p| p.starts_with(key)), "{key} missing in {found:#?}");
        }
    }

    #[test]
    fn a_board_faces_its_azimuth() {
        let pose =
            FlatPose { centre_m: [0.6, 0.0, 1.0], azimuth_deg: 0.0, tilt_deg: 0.0, roll_deg: 0.0, rpm: None };
        let world = pose.world_from_board();
        assert!((world * Vector3::x() - Vector3::y()).norm() < 1e-12);
        assert!((world * Vector3::y() - Vector3::z()).norm() < 1e-12);
        assert!((world * Point3::new(0.0, 0.0, 1.0) - Point3::new(1.6, 0.0, 1.0)).norm() < 1e-12);
        let left = FlatPose { azimuth_deg: 90.0, ..pose }.world_from_board() * Vector3::z();
        assert!((left - Vector3::y()).norm() < 1e-12);
        let up = FlatPose { tilt_deg: 30.0, ..pose }.world_from_board() * Vector3::z();
        assert!((up.z - 0.5).abs() < 1e-12 && up.x > 0.0, "{up}");
    }
}
