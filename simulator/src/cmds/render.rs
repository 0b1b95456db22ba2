// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody-sim render`: a scenario to frames and ground truth.

use super::failure;
use crate::sequence::{Changes, Run};
use fourdbody::base::Exit;
use fourdbody::cmds::Failure;
use fourdbody::geometry::pattern::Marker;
use std::io::{IsTerminal, Write};
use std::path::PathBuf;
use std::time::{Duration, Instant};

/// Render a scenario: frames of all cameras, true geometry, ground truth. Does nothing when the directory
/// holds exactly this already.
#[derive(clap::Args)]
#[command(
    after_help = "Example:\n  fourdbody-sim render --scenario config/scenarios/demo.toml --out target/demo/frames"
)]
pub struct Args {
    /// The scenario file to render, TOML.
    #[arg(long)]
    scenario: PathBuf,
    /// The directory in which the frames are written.
    #[arg(long)]
    out: PathBuf,
    /// A mesh (OBJ, PLY) or a directory of them in place of the scenario's subject.
    #[arg(long)]
    mesh: Option<PathBuf>,
    /// Another number of instants than the scenario's.
    #[arg(long)]
    instants: Option<usize>,
    /// Another marker than the rig's, equally bright elsewhere: `darkened=DEPTH` or `zero_mean=AMPLITUDE`.
    #[arg(long, value_name = "KIND=STRENGTH", value_parser = parse_marker)]
    marker: Option<Marker>,
    /// Divide the resolution of cameras and panels by this, for tests.
    #[arg(long, default_value_t = 1)]
    size_divisor: usize,
    /// Print one JSON object instead of text.
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> Result<Exit, Failure> {
    let changes = Changes {
        mesh: args.mesh.clone(),
        instants: args.instants,
        marker: args.marker,
        size_divisor: args.size_divisor,
    };
    let run = Run::load(&args.scenario, &changes).map_err(failure)?;
    let began = Instant::now();
    let mut shown = began;
    let terminal = std::io::stderr().is_terminal();
    let rendered = run
        .render(&args.out, |done, total| {
            if terminal && (done == total || shown.elapsed() > Duration::from_millis(200)) {
                shown = Instant::now();
                eprint!("\rframe {done} of {total}");
                let _ = std::io::stderr().flush();
            }
        })
        .map_err(failure)?;
    if terminal && rendered {
        eprintln!();
    }
    let (instants, cameras) = (run.scenario.instants, run.rig.cameras().count());
    let seconds = began.elapsed().as_secs_f64();
    if args.json {
        let summary = serde_json::json!({
            "out": args.out, "rendered": rendered, "instants": instants, "cameras": cameras, "duration_s": seconds,
        });
        println!("{summary}");
    } else if rendered {
        println!("{}: {instants} instants of {cameras} cameras in {seconds:.1} s", args.out.display());
    } else {
        println!("{}: up to date, {instants} instants of {cameras} cameras", args.out.display());
    }
    Ok(Exit::Done)
}

fn parse_marker(text: &str) -> Result<Marker, String> {
    let parsed = text.split_once('=').and_then(|(kind, strength)| {
        let strength = strength.parse().ok().filter(|x| (0.05..=1.0).contains(x))?;
        match kind {
            "darkened" => Some(Marker::Darkened { depth: strength }),
            "zero_mean" => Some(Marker::ZeroMean { amplitude: strength }),
            _ => None,
        }
    });
    parsed.ok_or_else(|| {
        format!("expected darkened=DEPTH or zero_mean=AMPLITUDE, 0.05 to 1, for instance darkened=0.8, found {text:?}")
    })
}

#[cfg(test)]
mod tests {
    use super::parse_marker;
    use fourdbody::geometry::pattern::Marker;

    #[test]
    fn markers_have_a_kind_and_a_strength() {
        assert_eq!(parse_marker("darkened=0.8"), Ok(Marker::Darkened { depth: 0.8 }));
        assert_eq!(parse_marker("zero_mean=0.3"), Ok(Marker::ZeroMean { amplitude: 0.3 }));
        for bad in ["", "darkened", "dark=0.5", "darkened=2", "zero_mean=nan"] {
            assert!(parse_marker(bad).is_err(), "{bad}");
        }
    }
}
