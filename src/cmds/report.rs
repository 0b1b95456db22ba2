// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody report`: a session on one page.

use super::failure::{Failure, tell_amiss};
use super::progress::Progress;
use crate::base::Exit;
use crate::preview::Exposure;
use crate::report::{END, Playing, Report, gather, render};
use std::collections::BTreeMap;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

/// Write a page about a session: verdict, gaps over time, light per camera, latencies, points, a turning cloud.
///
/// The page is one HTML file that needs no network. Checksums are not computed: see `fourdbody verify`. With --play it
/// has all frame sets of --clouds and plays them.
#[derive(clap::Args)]
#[command(after_help = "\
Exit code 0: the page has all of it; 2: there is no recording; 3: files of --clouds are missing, and the page names
them; 4: a recording, or all of it, cannot be read, and the page states so, or a file of --clouds is of something
else.

Example:
  fourdbody report sessions/walk-01 --clouds clouds/walk-01 --out walk-01.html
  fourdbody report sessions/walk-01 --clouds clouds/walk-01 --play --out walk-01.html")]
pub struct Args {
    /// A session, a recording of one node, or a single segment.
    session: PathBuf,
    /// What `fourdbody reconstruct` made of it: adds points per frame and a cloud.
    #[arg(long, value_name = "DIR")]
    clouds: Option<PathBuf>,
    /// The HTML file to write.
    #[arg(long, value_name = "HTML")]
    out: PathBuf,
    /// Play all frame sets instead of showing one cloud.
    #[arg(long, requires = "clouds")]
    play: bool,
    /// Points of all played frame sets together, MiB before they are packed; fewer of each where there are many.
    #[arg(long, value_name = "MIB", default_value_t = 512, requires = "play")]
    #[arg(value_parser = clap::value_parser!(u64).range(1..=4096))]
    play_mib: u64,
    /// Print what was written as JSON: {"page": PATH, "bytes": N, "exposure": {CAMERA: {"ev": N, "saturated": N}},
    /// "unreadable": [...]}.
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> Result<Exit, Failure> {
    let report = gather(&args.session, args.clouds.as_deref())?;
    let playing = match &args.clouds {
        Some(clouds) if args.play => {
            Some(Playing::open(clouds, args.play_mib << 20).map_err(Failure::corrupt)?)
        }
        _ => None,
    };
    let page = render(&report, playing.as_ref());
    let bytes = write(&args.out, &page, playing.as_ref()).map_err(|e| Failure::at(&args.out, e))?;
    if args.json {
        let unreadable: Vec<String> = report.unreadable.iter().map(ToString::to_string).collect();
        let exposure: BTreeMap<String, Option<Exposure>> = exposures(&report).collect();
        let written = serde_json::json!({
            "page": args.out, "bytes": bytes, "exposure": exposure, "unreadable": unreadable,
        });
        println!("{written}");
    } else {
        for (camera, exposure) in exposures(&report) {
            let right = exposure.map_or("no fringes to tell by".to_owned(), |exposure| exposure.to_string());
            println!("{camera}: right exposure: {right}");
        }
        println!("{}: {} KiB, opens in any browser", args.out.display(), bytes / 1024);
    }
    report.unreadable.iter().for_each(|one| eprintln!("NOT READABLE  {one}"));
    let is_amiss = tell_amiss(&report.amiss);
    Ok(match (report.unreadable.is_empty(), is_amiss) {
        (false, _) => Exit::Corrupt,
        (true, true) => Exit::DataLoss,
        (true, false) => Exit::Done,
    })
}

/// Writes the page; its size, bytes. A page that is begun and not finished is removed.
fn write(path: &Path, page: &str, playing: Option<&Playing>) -> Result<u64, String> {
    let written = || {
        let file = std::fs::File::create(path).map_err(|e| e.to_string())?;
        let mut out = BufWriter::new(file);
        out.write_all(page.as_bytes()).map_err(|e| e.to_string())?;
        if let Some(playing) = playing {
            let progress = Progress::of("frame sets", "sets");
            playing.write(&mut out, |done, of| progress.at(done, of))?;
        }
        out.write_all(END.as_bytes()).map_err(|e| e.to_string())?;
        let file = out.into_inner().map_err(|e| e.to_string())?;
        Ok(file.metadata().map_err(|e| e.to_string())?.len())
    };
    written().inspect_err(|_| drop(std::fs::remove_file(path)))
}

/// By camera, what exposure would be right.
fn exposures(report: &Report) -> impl Iterator<Item = (String, Option<Exposure>)> {
    let cameras = report.nodes.iter().flat_map(|node| &node.cameras);
    cameras.map(|camera| (camera.described.header.id.to_string(), camera.exposure))
}
