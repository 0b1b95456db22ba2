// SPDX-License-Identifier: MIT OR Apache-2.0
//! The scenario's subject as a scene at any time.

use super::mannequin::{HEIGHT_M, Mannequin};
use super::torso::Girth;
use super::{Cylinder, MeshSolid, Rectangle, Scene, Solid, Sphere, mesh_file};
use crate::scenario::{FlatPose, Subject};
use fourdbody::config::Board;
use nalgebra::{Isometry3, Point3, UnitQuaternion, Vector3};
use std::f64::consts::TAU;
use std::path::PathBuf;

/// A subject with what is needed to show it.
pub struct Stage {
    subject: Subject,
    board: Board,
    rate_hz: f64,
    files: Vec<PathBuf>,
}

impl Stage {
    /// Prepares a subject; an error when its mesh files cannot be listed.
    pub fn new(subject: &Subject, board: &Board, rate_hz: f64) -> std::io::Result<Self> {
        let files = match subject {
            Subject::Mesh { path, .. } => mesh_file::sequence(path)?,
            _ => Vec::new(),
        };
        Ok(Self { subject: subject.clone(), board: board.clone(), rate_hz, files })
    }

    /// The mesh files it plays, in order.
    pub fn files(&self) -> &[PathBuf] {
        &self.files
    }

    /// The scene `offset_s` after an instant (negative: before it).
    pub fn scene(&self, instant: usize, offset_s: f64) -> Result<Scene, mesh_file::MeshError> {
        let time_s = instant as f64 / self.rate_hz + offset_s;
        Ok(Scene::of(match &self.subject {
            Subject::Mannequin {
                motion,
                period_s,
                start,
                position_m,
                heading_deg,
                height_m,
                cell_mm,
                texture,
                worn,
            } => {
                let cycles = start + time_s / period_s;
                let heading = heading_deg.to_radians();
                let body = Mannequin::with(*worn, *motion, cycles, *position_m, heading);
                let mut mesh = body.mesh(cell_mm / 1000.0, *texture);
                mesh.scale(*position_m, height_m / HEIGHT_M);
                Solid::Mesh(MeshSolid::new(mesh))
            }
            Subject::Flat { plate_m, black, back, .. } => {
                let world_from_board = self.flat_pose(instant, offset_s).unwrap_or_else(Isometry3::identity);
                Solid::Rectangle(match plate_m {
                    None => Rectangle::board(&self.board, *black, *back, world_from_board),
                    Some(size) => {
                        let half_m = size.map(|s| s / 2.0);
                        Rectangle { world_from_board, half_m, back: *back, circles: None }
                    }
                })
            }
            Subject::Sphere { centre_m, radius_m } => {
                Solid::Sphere(Sphere { centre: Point3::from(*centre_m), radius: *radius_m })
            }
            Subject::Cylinder { foot_m, radius_m, height_m } => Solid::Cylinder(Cylinder {
                foot: Point3::from(*foot_m),
                radius: *radius_m,
                height: *height_m,
            }),
            Subject::Torso(torso) => Solid::Mesh(MeshSolid::new(torso.mesh())),
            Subject::Mesh { hold, .. } => {
                let file = &self.files[instant / hold % self.files.len()];
                Solid::Mesh(MeshSolid::new(mesh_file::read(file)?))
            }
        }))
    }

    /// The pose of a flat subject (board coordinates to world); `None` for other subjects.
    pub fn flat_pose(&self, instant: usize, offset_s: f64) -> Option<Isometry3<f64>> {
        let Subject::Flat { hold, .. } = &self.subject else { return None };
        let (pose, rpm) = self.flat_place(instant)?;
        let since_s = (instant % hold) as f64 / self.rate_hz + offset_s;
        let angle = rpm / 60.0 * TAU * since_s;
        Some(UnitQuaternion::from_axis_angle(&Vector3::z_axis(), angle) * pose.world_from_board())
    }

    /// Where a flat subject stands at an instant, and how fast it turns.
    fn flat_place(&self, instant: usize) -> Option<(&FlatPose, f64)> {
        let Subject::Flat { poses, hold, rpm, .. } = &self.subject else { return None };
        let pose = poses.get(instant / hold % poses.len().max(1))?;
        Some((pose, pose.rpm.unwrap_or(*rpm)))
    }

    /// Whether nothing moves during an exposure at this instant.
    pub fn is_still_at(&self, instant: usize) -> bool {
        match &self.subject {
            Subject::Mannequin { .. } => false,
            Subject::Flat { .. } => self.flat_place(instant).is_none_or(|(_, rpm)| rpm == 0.0),
            Subject::Sphere { .. } | Subject::Cylinder { .. } | Subject::Torso(_) | Subject::Mesh { .. } => {
                true
            }
        }
    }

    /// The girths that are known.
    pub fn girths(&self) -> Vec<Girth> {
        if let Subject::Torso(torso) = &self.subject { torso.girths() } else { Vec::new() }
    }

    /// Whether the scene is the same at every instant and moment.
    pub fn is_still(&self) -> bool {
        match &self.subject {
            Subject::Sphere { .. } | Subject::Cylinder { .. } | Subject::Torso(_) => true,
            Subject::Mesh { .. } => self.files.len() == 1,
            Subject::Flat { poses, .. } => poses.len() == 1 && self.is_still_at(0),
            Subject::Mannequin { .. } => false,
        }
    }
}
