//! `fourdbody info`: describes recordings without checking them.

use super::{Exit, Failure};
use crate::reconstruct::FrameSource;
use crate::record::{ClockSample, Latency, NodeEvent, RecordingReader, SegmentReader, SessionReader};
use std::collections::BTreeMap;
use std::path::PathBuf;

/// Events of one kind that are printed one by one; more are counted.
const MAX_EVENTS: usize = 5;

/// Describe a session, a recording or a segment: who, when, which cameras, how many triggers, what is missing.
#[derive(clap::Args)]
#[command(after_help = "\
Nothing is checked here: see `fourdbody verify`.

Example:
  fourdbody info /var/lib/fourdbody/sessions/walk-01")]
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

fn segment_bytes(segment: &SegmentReader) -> u64 {
    std::fs::metadata(&segment.path).map_or(0, |metadata| metadata.len())
}

fn bytes(recording: &RecordingReader) -> u64 {
    recording.segments.iter().map(segment_bytes).sum()
}

/// From the first to the last trigger, seconds: by the HSU's table where there is one.
fn duration_s(recording: &RecordingReader) -> f64 {
    let rows = recording.triggers.first_key_value().zip(recording.triggers.last_key_value());
    let by_table = rows.map(|((_, first), (_, last))| last.hsu_time_ns.saturating_sub(first.hsu_time_ns));
    by_table.filter(|ns| *ns > 0).map_or_else(
        || recording.triggers_end().saturating_sub(1) as f64 / recording.header.trigger_rate_hz,
        |ns| ns as f64 / 1e9,
    )
}

/// How many samples there are of each device; the HSU's have no camera.
fn samples(samples: &[ClockSample]) -> BTreeMap<&str, u64> {
    let mut counts = BTreeMap::new();
    for sample in samples {
        *counts.entry(sample.camera.as_ref().map_or("hsu", |camera| camera.as_str())).or_default() += 1;
    }
    counts
}

fn by_kind(events: &[NodeEvent]) -> BTreeMap<&str, Vec<&NodeEvent>> {
    let mut kinds: BTreeMap<&str, Vec<&NodeEvent>> = BTreeMap::new();
    events.iter().for_each(|event| kinds.entry(event.kind.as_str()).or_default().push(event));
    kinds
}

fn describe_json(recording: &RecordingReader) -> serde_json::Value {
    let segments = recording.segments.iter().map(|segment| {
        serde_json::json!({
            "number": segment.number, "path": segment.path, "bytes": segment_bytes(segment),
            "first_trigger": segment.first_trigger, "end_trigger": segment.end_trigger, "closed": segment.is_closed(),
        })
    });
    let kinds: BTreeMap<&str, usize> =
        by_kind(&recording.events).into_iter().map(|(kind, events)| (kind, events.len())).collect();
    serde_json::json!({
        "path": recording.path,
        "header": recording.header,
        "segments": segments.len(),
        "segment_files": segments.collect::<Vec<_>>(),
        "bytes": bytes(recording),
        "triggers": recording.triggers_end(),
        "duration_s": duration_s(recording),
        "cameras": recording.counted(),
        "trigger_table_rows": recording.triggers.len(),
        "clock_samples": recording.clock_samples.len(),
        "clock_samples_by_device": samples(&recording.clock_samples),
        "event_counts": kinds,
        "events": recording.events,
        "verdict": recording.verdict,
        "write_statistics": recording.statistics,
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
    println!("  triggers    {triggers} at {} Hz ({:.2} s)", header.trigger_rate_hz, duration_s(recording));
    match &header.hsu {
        Some(hsu) => println!("  hsu         {} firmware {}", hsu.uid, hsu.firmware),
        None => println!("  hsu         none (imported)"),
    }
    println!("  software    {}", header.software);
    describe_segments(recording);
    for (camera, counted) in header.cameras.iter().zip(recording.counted()) {
        let frames = counted.frames;
        print!(
            "  camera      {} {} x {} {}: {frames} frames",
            camera.id, camera.width, camera.height, camera.device
        );
        for (cause, count) in &counted.gaps {
            print!(", {count} {cause}");
        }
        println!();
    }
    println!("  table       {} rows", recording.triggers.len());
    let samples: Vec<String> =
        samples(&recording.clock_samples).iter().map(|(device, count)| format!("{device} {count}")).collect();
    let samples = if samples.is_empty() { "none".to_owned() } else { samples.join(", ") };
    println!("  clocks      samples: {samples}");
    for (kind, events) in by_kind(&recording.events) {
        for event in events.iter().take(MAX_EVENTS) {
            let camera = event.camera.as_ref().map(|camera| format!(" {camera}")).unwrap_or_default();
            println!("  event       {kind}{camera}: {}", event.message);
        }
        if events.len() > MAX_EVENTS {
            println!("  event       {kind}: {} more", events.len() - MAX_EVENTS);
        }
    }
    if let Some(statistics) = &recording.statistics {
        let ms =
            |latency: &Latency| [latency.p50_us, latency.p99_us, latency.max_us].map(|us| us as f64 / 1e3);
        for (what, latency) in [("in the file", &statistics.written), ("durable", &statistics.durable)] {
            let [p50, p99, most] = ms(latency);
            println!(
                "  written     {what} after {p50:.1} ms (median), {p99:.1} ms (p99), {most:.1} ms at most"
            );
        }
    }
    match &recording.verdict {
        Some(verdict) => println!("  verdict     {verdict}"),
        None => {
            println!("  verdict     none: the recording was not finished, or this is not its last segment");
        }
    }
}

fn describe_segments(recording: &RecordingReader) {
    let mib = |bytes: u64| bytes as f64 / f64::from(1 << 20);
    println!("  segments    {} ({:.1} MiB)", recording.segments.len(), mib(bytes(recording)));
    for segment in &recording.segments {
        let end = segment.end_trigger.unwrap_or_else(|| recording.triggers_end());
        let name = segment.path.file_name().unwrap_or_default().to_string_lossy();
        let range = match end.checked_sub(1) {
            Some(last) if last >= segment.first_trigger => {
                format!("triggers {} to {last}", segment.first_trigger)
            }
            _ => "no triggers".to_owned(),
        };
        let state = if segment.is_closed() { "" } else { ", not closed" };
        println!("    {name}  {:.1} MiB, {range}{state}", mib(segment_bytes(segment)));
    }
}
