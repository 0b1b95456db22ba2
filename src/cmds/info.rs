// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody info`: describes recordings without checking them.

use super::failure::Failure;
use crate::base::Exit;
use crate::base::histogram::Latency;
use crate::base::ids::one_line;
use crate::base::time::utc_day;
use crate::record::describe::{self, CameraDescription, ClockDescription};
use crate::record::{RecordingReader, Unreadable, WriteStatistics, open_each};
use std::collections::BTreeMap;
use std::path::PathBuf;

/// Lines about what is missing that are printed; JSON has all.
const MAX_LINES: usize = 20;

/// Describe a session, a recording or a segment: who, when, which cameras, how many triggers, what is missing.
#[derive(clap::Args)]
#[command(after_help = "\
Works on interrupted and damaged recordings too, and says what is missing. Checksums are not computed: see
`fourdbody verify`. Clocks are fitted again from the recorded exchanges: offset is the device's clock minus the
host's, skew how much faster it runs, residual the median distance of the last exchanges from the fit, and
open what round trips leave uncertain.

Exit code 0: described; 2: there is no recording; 4: a recording, or all of it, cannot be read.

Examples:
  fourdbody info /var/lib/fourdbody/sessions/walk-01
  fourdbody info --json /var/lib/fourdbody/sessions/walk-01/node-a")]
pub struct Args {
    /// A session, a recording of one node, or a single segment.
    path: PathBuf,
    /// Print one JSON object instead of text.
    #[arg(long)]
    json: bool,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<Exit, Failure> {
    let (recordings, unreadable) = open_each(&args.path)?;
    if recordings.is_empty() {
        let reasons: Vec<&str> = unreadable.iter().map(|one| one.reason.as_str()).collect();
        return Err(Failure::new(Exit::Corrupt, reasons.join("\n")));
    }
    if args.json {
        println!("{}", session_json(args, &recordings, &unreadable));
    } else {
        print_session(&recordings);
        recordings.iter().for_each(print_recording);
        for one in &unreadable {
            println!("{}\n  NOT READABLE  {}", one_line(one.path.display()), one_line(&one.reason));
        }
    }
    Ok(if unreadable.is_empty() { Exit::Done } else { Exit::Corrupt })
}

fn session_json(args: &Args, recordings: &[RecordingReader], unreadable: &[Unreadable]) -> serde_json::Value {
    let first = recordings.iter().filter_map(|r| r.segments.first()).map(|s| s.first_trigger).min();
    let end = recordings.iter().map(RecordingReader::triggers_end).max().unwrap_or(0);
    serde_json::json!({
        "path": args.path, "first_trigger": first.unwrap_or(0).min(end), "end_trigger": end,
        "recordings": recordings.iter().map(recording_json).collect::<Vec<_>>(),
        "unreadable": unreadable,
    })
}

fn recording_json(recording: &RecordingReader) -> serde_json::Value {
    let events = describe::events(recording);
    let counts: BTreeMap<&str, u64> = events.iter().map(|kind| (kind.kind.as_str(), kind.count)).collect();
    serde_json::json!({
        "path": recording.path,
        "header": recording.header,
        "segments": recording.segments.len(),
        "segment_files": describe::segments(recording),
        "bytes": bytes(recording),
        "triggers": recording.triggers_end(),
        "duration_s": describe::duration_s(recording),
        "measured_rate_hz": describe::measured_rate_hz(recording),
        "cameras": describe::cameras(recording),
        "trigger_table_rows": recording.triggers.len(),
        "time_code": describe::time_code(recording),
        "clock_samples": recording.clock_samples.len(),
        "clocks": describe::clocks(recording),
        "actions": describe::actions(recording),
        "ptp": describe::ptp(recording),
        "event_counts": counts,
        "event_kinds": events,
        "events": recording.events,
        "verdict": recording.verdict,
        "write_statistics": recording.statistics,
        "missing": describe::missing(recording),
    })
}

fn bytes(recording: &RecordingReader) -> u64 {
    recording.segments.iter().map(|segment| segment.length() as u64).sum()
}

fn mib(bytes: u64) -> f64 {
    bytes as f64 / f64::from(1 << 20)
}

/// A line for several nodes together.
fn print_session(recordings: &[RecordingReader]) {
    let [first, _, ..] = recordings else { return };
    let nodes: Vec<&str> = recordings.iter().map(|recording| recording.header.node.as_str()).collect();
    let cameras: usize = recordings.iter().map(|recording| recording.header.cameras.len()).sum();
    let one = recordings.iter().all(|recording| recording.header.session_id == first.header.session_id);
    let session = &first.header.session;
    if one {
        println!("session {session} of nodes {}: {cameras} cameras", nodes.join(" and "));
    } else {
        println!("NOT ONE SESSION: the recordings of nodes {} have different ids", nodes.join(" and "));
    }
}

fn print_recording(recording: &RecordingReader) {
    let header = &recording.header;
    println!("{}", one_line(recording.path.display()));
    println!("  session     {} ({})", header.session, header.session_id);
    println!("  node        {}", header.node);
    for (label, value) in [("subject", &header.subject), ("note", &header.note)] {
        if let Some(value) = value {
            println!("  {label:<11} {value}");
        }
    }
    println!("  recorded    {} by {}", utc(header.created_ns), header.software);
    match &header.hsu {
        Some(hsu) => {
            println!("  hsu         {} firmware {} protocol {}", hsu.uid, hsu.firmware, hsu.protocol)
        }
        None => println!("  hsu         none (imported)"),
    }
    print_triggers(recording);
    match &recording.verdict {
        Some(verdict) => {
            println!("  verdict     {}", verdict.to_string().lines().next().unwrap_or_default());
            verdict.advice.0.iter().for_each(|line| println!("  advice      {line}"));
        }
        None => {
            println!("  verdict     none: the recording was not finished, or this is not its last segment")
        }
    }
    print_missing(recording);
    print_segments(recording);
    print_cameras(&describe::cameras(recording));
    print_clocks(&describe::clocks(recording));
    print_actions(recording);
    print_events(recording);
    match &recording.statistics {
        Some(statistics) => print_statistics(statistics),
        None => println!("  disk        not known: the recording was not finished, or not by a node"),
    }
}

fn print_triggers(recording: &RecordingReader) {
    let (triggers, asked) = (recording.triggers_end(), recording.header.trigger_rate_hz);
    let expected =
        recording.header.expected_triggers.map_or("until stop".to_owned(), |n| format!("{n} asked for"));
    let emitted = recording.verdict.as_ref().and_then(|verdict| verdict.triggers_emitted);
    let emitted = emitted.map_or("not known".to_owned(), |n| n.to_string());
    println!(
        "  triggers    {triggers} at {asked} Hz ({:.2} s); {expected}, the HSU's count is {emitted}",
        describe::duration_s(recording)
    );
    let rate = describe::measured_rate_hz(recording);
    let rate = rate.map_or(String::new(), |hz| format!(", {hz:.4} Hz by the HSU's clock"));
    println!("  table       {} rows{rate}", recording.triggers.len());
    if let Some(time_code) = describe::time_code(recording) {
        println!("  time code   {}", one_line(time_code));
    }
}

fn print_missing(recording: &RecordingReader) {
    let missing = describe::missing(recording);
    for line in missing.iter().take(MAX_LINES) {
        println!("  MISSING     {}", one_line(line));
    }
    if missing.len() > MAX_LINES {
        println!("  MISSING     ... and {} lines more", missing.len() - MAX_LINES);
    }
    if !missing.is_empty() {
        println!("  to do       `fourdbody verify` says what is damaged, `fourdbody recover` saves the rest");
    }
}

fn print_segments(recording: &RecordingReader) {
    println!("  segments    {} ({:.1} MiB)", recording.segments.len(), mib(bytes(recording)));
    for segment in describe::segments(recording) {
        let end = segment.end_trigger.or(segment.frames_end).filter(|end| *end > segment.first_trigger);
        let range = end.map_or("no frames".to_owned(), |end| {
            format!("triggers {} to {}", segment.first_trigger, end - 1)
        });
        let name = one_line(segment.path.file_name().unwrap_or_default().to_string_lossy());
        let state = one_line(segment.broken.as_deref().unwrap_or("closed"));
        println!("    {name}  {:>9.1} MiB  {range}  {state}", mib(segment.bytes));
    }
}

fn print_cameras(cameras: &[CameraDescription]) {
    println!(
        "  cameras     {:<12} {:>11} {:>9} {:>7} {:>7}  {:<12} device",
        "", "size", "frames", "gaps", "absent", "sent as"
    );
    for camera in cameras {
        let header = &camera.header;
        let size = format!("{} x {}", header.width, header.height);
        let gaps: u64 = camera.gaps.values().sum();
        let format = if header.pixel_format.is_empty() { "-" } else { &header.pixel_format };
        let format = one_line(format);
        println!(
            "    {:<21} {size:>11} {:>9} {gaps:>7} {:>7}  {format:<12} {}",
            header.id.as_str(),
            camera.frames,
            camera.absent,
            header.device
        );
        for (cause, count) in &camera.gaps {
            let first = camera.first_gaps.get(cause).copied().unwrap_or_default();
            println!("      gap         {count} {cause}, the first at trigger {first}");
        }
    }
    let settings = |camera: &CameraDescription| -> String {
        let settings = camera.header.settings.iter();
        one_line(settings.map(|s| format!("{} {}", s.feature, s.value)).collect::<Vec<_>>().join(", "))
    };
    let all: Vec<String> = cameras.iter().map(settings).collect();
    match all.first() {
        Some(first) if all.iter().all(|one| one == first) => {
            let first = if first.is_empty() { "none recorded" } else { first };
            println!("  settings    all cameras: {first}");
        }
        _ => {
            for (camera, settings) in cameras.iter().zip(&all) {
                println!("  settings    {}: {settings}", camera.header.id);
            }
        }
    }
}

fn print_clocks(clocks: &[ClockDescription]) {
    if clocks.is_empty() {
        println!("  clocks      no exchanges recorded");
        return;
    }
    println!(
        "  clocks      {:<10} {:>7} {:>8} {:>6} {:>22} {:>11} {:>12} {:>10}",
        "", "samples", "left out", "resets", "offset s", "skew ppm", "residual us", "open us"
    );
    let shown = |number: Option<f64>, digits: usize| {
        number.map_or("-".to_owned(), |number| format!("{number:.digits$}"))
    };
    let us = |ns: Option<u64>| shown(ns.map(|ns| ns as f64 / 1e3), 1);
    for clock in clocks {
        let device = clock.camera.as_ref().map_or("hsu", |camera| camera.as_str());
        println!(
            "    {device:<19} {:>7} {:>8} {:>6} {:>22} {:>11} {:>12} {:>10}",
            clock.samples,
            clock.left_out,
            clock.resets,
            shown(clock.offset_ns.map(|ns| ns as f64 / 1e9), 6),
            shown(clock.skew_ppm, 3),
            us(clock.residual_ns),
            us(clock.uncertainty_ns)
        );
    }
}

/// What became of each camera's action commands, and its PTP statuses.
fn print_actions(recording: &RecordingReader) {
    let (actions, ptp) = (describe::actions(recording), describe::ptp(recording));
    if !actions.is_empty() {
        println!("  actions     commands to each camera, those of the warm-up among them");
    }
    for action in actions {
        println!("    {:<21} {}", action.camera.as_str(), action.commands);
    }
    if !ptp.is_empty() {
        println!("  PTP status  and how often it is recorded: at the beginning, at each change, at the end");
    }
    for camera in ptp {
        let said = camera.statuses.iter().map(|(status, count)| format!("{status} {count}"));
        let said = one_line(said.collect::<Vec<_>>().join(", "));
        let scale = camera.scale.map_or_else(String::new, |scale| format!("; its clock counts {scale}"));
        println!("    {:<21} {said}{scale}", camera.camera.as_str());
    }
}

fn print_events(recording: &RecordingReader) {
    let kinds = describe::events(recording);
    println!("  events      {}", recording.events.len());
    for kind in kinds {
        let trigger =
            kind.first_trigger.map_or(String::new(), |trigger| format!(", first at trigger {trigger}"));
        println!(
            "    {:<21} {}{trigger}: {}",
            one_line(&kind.kind),
            kind.count,
            one_line(&kind.first_message)
        );
    }
}

fn print_statistics(statistics: &WriteStatistics) {
    let access = statistics.access.map_or("not recorded how".to_owned(), |access| access.to_string());
    println!("  disk        reached {access}");
    for (what, latency) in [("in the file", &statistics.written), ("durable", &statistics.durable)] {
        let Latency { p50_us, p99_us, max_us } = *latency;
        let [p50, p99, most] = [p50_us, p99_us, max_us].map(|us| us as f64 / 1e3);
        println!("    {what:<12}  {p50:.1} ms (median), {p99:.1} ms (p99), {most:.1} ms at most");
    }
    println!(
        "    frame blocks  {} held by the writer at most; {} frames copied",
        statistics.blocks_high_water, statistics.copied_frames
    );
}

/// A host time as people write it, to the second.
fn utc(ns: u64) -> String {
    let second = ns / 1_000_000_000 % 86_400;
    let (hour, minute) = (second / 3600, second / 60 % 60);
    format!("{} {hour:02}:{minute:02}:{:02} UTC", utc_day(ns), second % 60)
}

#[cfg(test)]
mod tests {
    use super::utc;

    #[test]
    fn host_times_are_dates() {
        for (seconds, date) in [
            (0, "1970-01-01 00:00:00 UTC"),
            (951_782_400, "2000-02-29 00:00:00 UTC"),
            (1_790_000_000, "2026-09-21 14:13:20 UTC"),
            (1_798_761_599, "2026-12-31 23:59:59 UTC"),
        ] {
            assert_eq!(utc(seconds * 1_000_000_000), date);
        }
    }
}
