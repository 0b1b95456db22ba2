// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody-sim convert-rig`: the rig of an independent renderer (JSON) as our `rig.toml` and
//! `calibration.json`.

use crate::rig_file::{aim, to_toml};
use fourdbody::base::Exit;
use fourdbody::base::ids::{CameraId, HeadId, NodeId};
use fourdbody::calibrate::foreign::scene::SceneRig;
use fourdbody::cmds::Failure;
use fourdbody::config::{Board, Head, Rig, RigCamera};
use fourdbody::data::{CalibratedCamera, CalibratedHead, Calibration, PanelRows};
use fourdbody::geometry::pattern::{Marker, Pattern};
use fourdbody::geometry::{Device, Lens, look_at};
use serde::Deserialize;
use std::path::{Path, PathBuf};

/// The renderer counts rows of the panel from the upper edge of the first one, not from its middle (measured: its
/// dashes lie 0.50 rows before those of `Pattern::light`).
const ROWS: PanelRows = PanelRows { excess: [-0.5, 0.0, 0.0], rms_px: 0.0 };

/// Turn a scene rig (JSON: `x_device = R x_world + t`) into `rig.toml` (nominal: rounded as a drawing would
/// be) and `calibration.json` (exact).
#[derive(clap::Args)]
#[command(after_help = "Example:\n  fourdbody-sim convert-rig --scene-rig rig.json --out target/scene")]
pub struct Args {
    /// The rig of the scene generator, JSON.
    #[arg(long)]
    scene_rig: PathBuf,
    /// Where `rig.toml` and `calibration.json` go.
    #[arg(long)]
    out: PathBuf,
}

#[derive(Deserialize)]
struct Scene {
    pattern: ScenePattern,
    #[serde(flatten)]
    rig: SceneRig,
}

#[derive(Deserialize)]
struct ScenePattern {
    period_px: f64,
    marker_index: u32,
    marker_depth: f64,
    marker_period_px: f64,
    marker_type: String,
    low: f64,
    high: f64,
    gamma: f64,
}

pub fn run(args: &Args) -> Result<Exit, Failure> {
    let failed =
        |path: &Path, what: String| Failure::new(Exit::Failure, format!("{}: {what}", path.display()));
    let bytes = std::fs::read(&args.scene_rig).map_err(|e| failed(&args.scene_rig, e.to_string()))?;
    let (rig, calibration) =
        convert(&bytes).map_err(|e| failed(&args.scene_rig, format!("{e}; expected a scene rig as JSON")))?;
    std::fs::create_dir_all(&args.out).map_err(|e| failed(&args.out, e.to_string()))?;
    let path = args.out.join("rig.toml");
    std::fs::write(&path, to_toml(&rig)).map_err(|e| failed(&path, e.to_string()))?;
    let path = args.out.join("calibration.json");
    calibration.save(&path).map_err(|e| Failure::new(Exit::Failure, e))?;
    println!("{}: rig.toml and calibration.json of {} cameras", args.out.display(), rig.cameras().count());
    Ok(Exit::Done)
}

/// The nominal rig and the exact calibration of a JSON rig.
fn convert(bytes: &[u8]) -> Result<(Rig, Calibration), String> {
    let scene: Scene = serde_json::from_slice(bytes).map_err(|e| e.to_string())?;
    let pattern = pattern(&scene.pattern)?;
    let mut heads = Vec::new();
    let mut exact = Vec::new();
    for head in &scene.rig.heads {
        let id = HeadId(head.name());
        let node = NodeId::from(if head.id < 2 { "a" } else { "b" });
        let mut cameras = Vec::new();
        let mut calibrated = Vec::new();
        for camera in &head.cameras {
            let (id, device) = (CameraId(camera.name.clone()), camera.device.device()?);
            cameras.push(RigCamera { id: id.clone(), node: node.clone(), device: drawn(&device)? });
            calibrated.push(CalibratedCamera { id, device });
        }
        let projector = head.projector.device()?;
        let (channel, delay_ns, exposure_ns) = (head.channel, 200_000, 1_000_000);
        let nominal = drawn(&projector)?;
        heads.push(Head { id: id.clone(), channel, delay_ns, exposure_ns, projector: nominal, cameras });
        exact.push(CalibratedHead { id, channel, projector, rows: Some(ROWS), cameras: calibrated });
    }
    let rig = Rig {
        name: "scene".to_owned(),
        trigger_rate_hz: 120.0,
        warm_up_triggers: 8,
        volume_min_m: [-0.75, -0.75, 0.0],
        volume_max_m: [0.75, 0.75, 2.0],
        pattern,
        board: board(),
        heads,
    };
    let calibration = Calibration::new(&rig, "true geometry of the scene".to_owned(), exact);
    Ok((rig, calibration))
}

fn pattern(scene: &ScenePattern) -> Result<Pattern, String> {
    if scene.marker_type != "cos" {
        return Err(format!("marker_type is {:?}, expected \"cos\"", scene.marker_type));
    }
    Ok(Pattern {
        period_px: scene.period_px,
        marker_index: scene.marker_index,
        marker_every: 0,
        marker: Marker::Darkened { depth: scene.marker_depth },
        marker_period_px: scene.marker_period_px,
        low: scene.low,
        high: scene.high,
        gamma: scene.gamma,
    })
}

/// The scene's board, which is also the one of the rig file that we ship.
fn board() -> Board {
    Board {
        width_m: 1.5,
        height_m: 2.0,
        pitch_m: 0.1,
        columns: 14,
        rows: 19,
        radius_m: 0.015,
        large_radius_m: 0.024,
        large: vec![[4, 13], [5, 13], [4, 16], [7, 13], [10, 4]],
    }
}

/// The device as a drawing has it: no distortion, centred, everything rounded. What calibration starts from.
fn drawn(device: &Device) -> Result<Device, String> {
    let (position, target, roll_deg) = aim(device);
    let rounded = |x: f64, step: f64| (x / step).round() * step;
    let position_m = position.map(|x| rounded(x, 0.05));
    let target_m = target.map(|x| rounded(x, 0.05));
    let pose =
        look_at(position_m, target_m, rounded(roll_deg, 5.0)).ok_or("a device looks straight up or down")?;
    let focal = rounded((device.lens.fx + device.lens.fy) / 2.0, 10.0);
    let (cx, cy) = ((device.width as f64 - 1.0) / 2.0, (device.height as f64 - 1.0) / 2.0);
    let lens = Lens { fx: focal, fy: focal, cx, cy, distortion: [0.0; 5] };
    Ok(Device { lens, world_from_device: pose, ..device.clone() })
}

#[cfg(test)]
mod tests {
    use super::convert;
    use crate::rig_file::to_toml;
    use fourdbody::config::Rig;
    use nalgebra::Point3;

    const DEVICE: &str = r#""width": 1920, "height": 1200, "fx": 2040.0, "fy": 2041.0, "cx": 960.0, "cy": 600.0,
        "dist": [-0.095, 0.075, 0.0001, -0.0002, 0.0],
        "R": [[0.0, 0.0, -1.0], [0.0, -1.0, 0.0], [-1.0, 0.0, 0.0]], "t": [1.05, 0.0, 2.4]"#;

    #[test]
    fn poses_are_turned_around_and_the_marker_is_ours() {
        let text = format!(
            r#"{{"pattern": {{"period_px": 8.0, "marker_index": 80, "marker_depth": 0.8, "marker_period_px": 8.0,
            "marker_type": "cos", "low": 0.0, "high": 1.0, "gamma": 1.0}},
            "heads": [{{"id": 2, "channel": "R", "projector": {{{DEVICE}}}, "cameras": [{{"name": "h2_up", {DEVICE}}}]}}]}}"#
        );
        let (rig, calibration) = convert(text.as_bytes()).expect("valid");
        let (_, camera) = calibration.cameras().next().expect("one camera");
        assert!((camera.device.centre() - Point3::new(2.4, 0.0, 1.05)).norm() < 1e-12);
        let nominal = Rig::from_table(&to_toml(&rig).parse().expect("TOML")).expect("a valid rig");
        let (_, drawn) = nominal.cameras().next().expect("one camera");
        assert_eq!(drawn.node.as_str(), "b");
        let point = Point3::new(0.1, 0.2, 1.3);
        let (a, b) =
            (camera.device.project(&point).expect("seen"), drawn.device.project(&point).expect("seen"));
        assert!((a[0] - b[0]).hypot(a[1] - b[1]) < 40.0, "{a:?} {b:?}");
    }
}
