// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody calibration import`: a calibration of another program, put into one of ours.

use super::failure::{Failure, number_in, print};
use crate::base::Exit;
use crate::calibrate::foreign::{device_mut, import};
use crate::config::Rig;
use crate::data::Calibration;
use std::path::PathBuf;

/// Make a calibration of another program's: of OpenCV, MATLAB, Anipose, or a rendered scene.
///
/// Volume, pattern and the place of the first device are those of the rig file, or of the calibration that --base names.
/// Points of the first device must become those of the next by R x + T, as cv2.stereoCalibrate has it; the projector is
/// a camera that looks backwards. Run it twice, the second time with --base, where two files have a device in common.
#[derive(clap::Args)]
#[command(after_help = "\
Files: YAML, XML or JSON of cv2.FileStorage; NPZ of numpy.savez; in MATLAB
  fid = fopen('stereo.json', 'w'); fprintf(fid, '%s', jsonencode(toStruct(stereoParams))); fclose(fid);
TOML of Anipose, FreeMoCap or Caliscope; and the rig of a rendered scene, JSON. Files that complement each other are
given together.

Examples:
  fourdbody calibration import --rig bench.toml --from stereo.yml --unit-mm 1 --out calibration.json
  fourdbody calibration import --rig bench.toml --from intrinsics.yml extrinsics.yml --devices left,right \\
      --unit-mm 25 --out calibration.json")]
pub struct Import {
    /// The other program's file, or files.
    #[arg(long, value_name = "FILE", required = true, num_args = 1..)]
    from: Vec<PathBuf>,
    /// The rig file: names, sizes, volume, pattern, and where the first device is.
    #[arg(long, value_name = "FILE", required_unless_present = "base", conflicts_with = "base")]
    rig: Option<PathBuf>,
    /// A calibration, in place of the rig file.
    #[arg(long, value_name = "FILE")]
    base: Option<PathBuf>,
    /// What the file's devices are, in its order: cameras of the rig, or a head for its projector. [default: the head's
    /// cameras in the rig's order, then its projector]
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    devices: Vec<String>,
    /// The file's unit of length, mm: 1, 1000 for metres, 25 for squares of 25 mm. Some files state it.
    #[arg(long, value_name = "MM")]
    #[arg(value_parser = number_in(1e-6..=1e6, "millimetres above 0"))]
    unit_mm: Option<f64>,
    /// The calibration file to write.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Print the devices as JSON.
    #[arg(long)]
    json: bool,
}

impl Import {
    pub fn run(&self) -> Result<Exit, Failure> {
        let base = match (&self.rig, &self.base) {
            (Some(rig), _) => Calibration::nominal(&Rig::load(rig)?),
            (_, Some(base)) => Calibration::load(base).map_err(Failure::usage)?,
            _ => return Err(Failure::usage("expected --rig or --base, found none")),
        };
        let (mut calibration, foreign, names) =
            import(&self.from, base, &self.devices, self.unit_mm).map_err(Failure::usage)?;
        calibration.save(&self.out).map_err(Failure::failed)?;
        let mut first = None;
        let mut lines = Vec::new();
        for (device, name) in foreign.devices.iter().zip(&names) {
            let Some(here) = device_mut(&mut calibration, name) else { continue };
            let from_first_mm = 1e3 * (here.centre() - *first.get_or_insert(here.centre())).norm();
            lines.push((name, device.name.as_str(), here.lens.fx, from_first_mm));
        }
        let value = lines.iter().map(|(name, from, fx, mm)| {
            serde_json::json!({ "device": name, "from": from, "fx_px": fx, "from_first_mm": mm })
        });
        let value = serde_json::json!({ "out": self.out, "devices": value.collect::<Vec<_>>() });
        print(self.json, &value, || {
            for (name, from, fx, mm) in &lines {
                println!("{name:<12} of {from}: fx {fx:.1} px, {mm:.1} mm from the first");
            }
            println!("{}: written; nothing has been compared with photographs", self.out.display());
        });
        Ok(Exit::Done)
    }
}
