// SPDX-License-Identifier: MIT OR Apache-2.0
//! Writes `rig.toml` with the geometry that was simulated.

use fourdbody::config::{Board, Rig};
use fourdbody::geometry::Device;
use fourdbody::geometry::pattern::{Marker, Pattern};
use nalgebra::Vector3;
use std::fmt::Write;

/// The rig as a file that [`Rig::load`] reads back. Devices keep their full pose; a lens whose focal lengths
/// differ along u and v gets their mean.
pub fn to_toml(rig: &Rig) -> String {
    let mut text = String::new();
    // Writing to a String cannot fail.
    let _ = write_rig(&mut text, rig);
    text
}

fn write_rig(text: &mut String, rig: &Rig) -> std::fmt::Result {
    writeln!(text, "# World: metres, right-handed, z up, origin on the floor below the volume's centre.")?;
    writeln!(text, "format = 1\nname = {:?}\ntrigger_rate_hz = {:?}", rig.name, rig.trigger_rate_hz)?;
    writeln!(text, "\n[volume]\nmin_m = {:?}\nmax_m = {:?}", rig.volume_min_m, rig.volume_max_m)?;
    write_pattern(text, &rig.pattern)?;
    write_board(text, &rig.board)?;
    for head in &rig.heads {
        writeln!(text, "\n[[head]]\nid = {:?}\nchannel = \"{:?}\"", head.id.as_str(), head.channel)?;
        writeln!(text, "delay_us = {:?}", head.delay_ns as f64 / 1000.0)?;
        writeln!(text, "exposure_us = {:?}", head.exposure_ns as f64 / 1000.0)?;
        writeln!(text, "\n[head.projector]")?;
        write_device(text, &head.projector)?;
        for camera in &head.cameras {
            writeln!(
                text,
                "\n[[head.camera]]\nid = {:?}\nnode = {:?}",
                camera.id.as_str(),
                camera.node.as_str()
            )?;
            write_device(text, &camera.device)?;
        }
    }
    Ok(())
}

fn write_pattern(text: &mut String, pattern: &Pattern) -> std::fmt::Result {
    let (marker, strength) = match pattern.marker {
        Marker::Darkened { depth } => ("darkened", depth),
        Marker::ZeroMean { amplitude } => ("zero_mean", amplitude),
    };
    writeln!(
        text,
        "\n[pattern]\nperiod_px = {:?}\nmarker_index = {}",
        pattern.period_px, pattern.marker_index
    )?;
    if pattern.marker_every > 0 {
        writeln!(text, "marker_every = {}", pattern.marker_every)?;
    }
    writeln!(text, "marker = \"{marker}\"\nmarker_strength = {strength:?}")?;
    writeln!(text, "marker_period_px = {:?}\nlow = {:?}", pattern.marker_period_px, pattern.low)?;
    writeln!(text, "high = {:?}\ngamma = {:?}", pattern.high, pattern.gamma)
}

fn write_board(text: &mut String, board: &Board) -> std::fmt::Result {
    writeln!(text, "\n[board]\nwidth_m = {:?}\nheight_m = {:?}", board.width_m, board.height_m)?;
    writeln!(text, "pitch_m = {:?}\ncolumns = {}\nrows = {}", board.pitch_m, board.columns, board.rows)?;
    writeln!(text, "radius_m = {:?}\nlarge_radius_m = {:?}", board.radius_m, board.large_radius_m)?;
    writeln!(text, "large = {:?}", board.large)
}

fn write_device(text: &mut String, device: &Device) -> std::fmt::Result {
    let lens = &device.lens;
    // Nanometres and nanodegrees: whole numbers of a drawing stay whole.
    let tidy = |x: f64| (x * 1e9).round() / 1e9 + 0.0;
    let (position, target, roll_deg) = aim(device);
    let (position, target, roll_deg) = (position.map(tidy), target.map(tidy), tidy(roll_deg));
    writeln!(text, "width = {}\nheight = {}", device.width, device.height)?;
    writeln!(text, "focal_px = {:?}", (lens.fx + lens.fy) / 2.0)?;
    writeln!(text, "centre_px = [{:?}, {:?}]", lens.cx, lens.cy)?;
    if lens.distortion != [0.0; 5] {
        writeln!(text, "distortion = {:?}", lens.distortion)?;
    }
    writeln!(text, "position_m = {position:?}\nlook_at_m = {target:?}\nroll_deg = {roll_deg:?}")
}

/// Position, a point on the optical axis near the world's vertical axis, and the roll about the axis: what
/// [`fourdbody::geometry::look_at`] takes.
pub fn aim(device: &Device) -> ([f64; 3], [f64; 3], f64) {
    let pose = device.world_from_device.isometry();
    let (position, forward) = (pose.translation.vector, pose.rotation * Vector3::z());
    let flat = forward.x * forward.x + forward.y * forward.y;
    let nearest = -(position.x * forward.x + position.y * forward.y) / flat;
    let distance = if (0.1..100.0).contains(&nearest) { nearest } else { 1.0 };
    let right = forward.cross(&Vector3::z()).normalize();
    let down = forward.cross(&right);
    let u = pose.rotation * Vector3::x();
    let roll = u.dot(&down).atan2(u.dot(&right)).to_degrees();
    (position.into(), (position + forward * distance).into(), roll)
}

#[cfg(test)]
mod tests {
    use super::to_toml;
    use crate::scenario::Scenario;
    use crate::true_rig::true_calibration;
    use fourdbody::config::Rig;
    use std::path::Path;

    #[test]
    fn a_written_rig_reads_back_with_the_same_geometry() {
        let config = Path::new(env!("CARGO_MANIFEST_DIR")).join("../config");
        let scenario = Scenario::load(&config.join("scenarios/demo.toml")).expect("valid");
        let mut rig = Rig::load(&scenario.rig).expect("valid");
        let truth = true_calibration(&rig, &scenario.geometry, 3);
        for (head, real) in rig.heads.iter_mut().zip(&truth.heads) {
            head.projector.world_from_device = real.projector.world_from_device;
            for (camera, real) in head.cameras.iter_mut().zip(&real.cameras) {
                camera.device.world_from_device = real.device.world_from_device;
            }
        }
        let back = Rig::from_table(&to_toml(&rig).parse().expect("TOML")).expect("valid");
        assert_eq!(back.pattern, rig.pattern);
        assert_eq!(back.board, rig.board);
        for ((_, a), (_, b)) in rig.cameras().zip(back.cameras()) {
            assert_eq!((&a.id, &a.node, a.device.lens), (&b.id, &b.node, b.device.lens));
            let off = a.device.world_from_device.isometry().to_matrix()
                - b.device.world_from_device.isometry().to_matrix();
            assert!(off.abs().max() < 1e-8, "{off}");
        }
    }
}
