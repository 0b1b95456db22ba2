//! `fourdbody info`: describes recordings without checking them.

use super::{Exit, Failure};
use crate::reconstruct::FrameSource;
use crate::record::{RecordingReader, SessionReader};
use std::path::PathBuf;

/// Describe a session, a recording or a segment: who, when, which cameras, how many triggers.
#[derive(clap::Args)]
#[command(after_help = "Example:\n  fourdbody info /var/lib/fourdbody/sessions/walk-01")]
pub struct Args {
    /// A session, a recording of one node, or a single segment.
    path: PathBuf,
    /// Print one JSON object instead of text.
    #[arg(long)]
    json: bool,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<Exit, Failure> {
    let missing = if args.path.exists() { Exit::Corrupt } else { Exit::Usage };
    let session = SessionReader::open(&args.path).map_err(|error| Failure::new(missing, error))?;
    if args.json {
        let recordings: Vec<_> = session.recordings().iter().map(describe_json).collect();
        let triggers = session.triggers();
        println!(
            "{}",
            serde_json::json!({
                "path": args.path, "first_trigger": triggers.start, "end_trigger": triggers.end,
                "recordings": recordings,
            })
        );
    } else {
        for recording in session.recordings() {
            describe(recording);
        }
    }
    Ok(Exit::Done)
}

fn bytes(recording: &RecordingReader) -> u64 {
    let sizes = recording.segments.iter().filter_map(|segment| std::fs::metadata(&segment.path).ok());
    sizes.map(|metadata| metadata.len()).sum()
}

fn describe_json(recording: &RecordingReader) -> serde_json::Value {
    serde_json::json!({
        "path": recording.path,
        "header": recording.header,
        "segments": recording.segments.len(),
        "bytes": bytes(recording),
        "triggers": recording.triggers_end(),
        "clock_samples": recording.clock_samples.len(),
        "events": recording.events,
        "verdict": recording.verdict,
    })
}

fn describe(recording: &RecordingReader) {
    let header = &recording.header;
    println!("{}", recording.path.display());
    println!("  session     {} ({})", header.session, header.session_id);
    println!("  node        {}", header.node);
    for (label, value) in [("subject", &header.subject), ("note", &header.note)] {
        if let Some(value) = value {
            println!("  {label:<11} {value}");
        }
    }
    let triggers = recording.triggers_end();
    let seconds = triggers as f64 / header.trigger_rate_hz;
    println!("  triggers    {triggers} at {} Hz ({seconds:.2} s)", header.trigger_rate_hz);
    match &header.hsu {
        Some(hsu) => println!("  hsu         {} firmware {}", hsu.uid, hsu.firmware),
        None => println!("  hsu         none (imported)"),
    }
    println!("  software    {}", header.software);
    let mib = bytes(recording) as f64 / f64::from(1 << 20);
    println!("  segments    {} ({mib:.1} MiB)", recording.segments.len());
    for camera in &header.cameras {
        println!("  camera      {} {} x {} {}", camera.id, camera.width, camera.height, camera.device);
    }
    for event in &recording.events {
        println!("  event       {}: {}", event.kind, event.message);
    }
    match &recording.verdict {
        Some(verdict) => println!("  verdict     {verdict}"),
        None => {
            println!("  verdict     none: the recording was not finished, or this is not its last segment")
        }
    }
}
