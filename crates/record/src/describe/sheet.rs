// SPDX-License-Identifier: MIT OR Apache-2.0
//! A recording as people read it: facts, what is missing, and tables. `fourdbody info` prints it, the report of a
//! session shows it; JSON has the same from the functions of [`super`].

use super::{
    CameraDescription, actions, cameras, clocks, duration_s, events, measured_rate_hz, missing, ptp,
};
use super::{segments, time_code};
use crate::base::ids::one_line;
use crate::base::time::day;
use crate::reader::RecordingReader;
use crate::statistics::Latency;

/// What is known of a recording without checking it.
#[derive(Debug, Clone, Default)]
pub struct Sheet {
    /// Names and values, each one line.
    pub facts: Vec<(&'static str, String)>,
    /// What is missing or wrong, a line each; empty for a good recording.
    pub missing: Vec<String>,
    pub tables: Vec<Table>,
}

/// Rows with as many cells as the head has, each one line.
#[derive(Debug, Clone)]
pub struct Table {
    pub title: &'static str,
    pub head: &'static [&'static str],
    pub rows: Vec<Vec<String>>,
}

impl Sheet {
    pub fn of(recording: &RecordingReader) -> Self {
        let cameras = cameras(recording);
        let mut sheet = Self { missing: missing(recording), ..Self::default() };
        sheet.session(recording);
        sheet.triggers(recording);
        sheet.verdict(recording);
        sheet.cameras(&cameras);
        sheet.segments(recording);
        sheet.clocks(recording);
        sheet.action_commands(recording);
        sheet.events(recording);
        sheet.disk(recording);
        sheet
    }

    fn fact(&mut self, name: &'static str, value: impl std::fmt::Display) {
        self.facts.push((name, one_line(value)));
    }

    /// Adds a table, unless it has no rows.
    fn table<const N: usize>(
        &mut self,
        title: &'static str,
        head: &'static [&'static str; N],
        rows: impl Iterator<Item = [String; N]>,
    ) {
        let rows: Vec<Vec<String>> = rows.map(|row| row.iter().map(one_line).collect()).collect();
        if !rows.is_empty() {
            self.tables.push(Table { title, head, rows });
        }
    }

    fn session(&mut self, recording: &RecordingReader) {
        let header = &recording.header;
        self.fact("session", format_args!("{} ({})", header.session, header.session_id));
        self.fact("node", &header.node);
        header.subject.iter().for_each(|subject| self.fact("subject", subject));
        header.note.iter().for_each(|note| self.fact("note", note));
        let (day, second) = (day(header.created_ns), header.created_ns / 1_000_000_000 % 86_400);
        let (hour, minute, second) = (second / 3600, second / 60 % 60, second % 60);
        let software = &header.software;
        self.fact("recorded", format_args!("{day} {hour:02}:{minute:02}:{second:02} UTC by {software}"));
        match &header.hsu {
            Some(hsu) => self
                .fact("hsu", format_args!("{} firmware {} protocol {}", hsu.uid, hsu.firmware, hsu.protocol)),
            None => self.fact("hsu", "none (imported)"),
        }
    }

    fn triggers(&mut self, recording: &RecordingReader) {
        let (triggers, rate) = (recording.triggers_end(), recording.header.trigger_rate_hz);
        let expected = recording.header.expected_triggers;
        let expected = expected.map_or("until stop".to_owned(), |n| format!("{n} requested"));
        let emitted = recording.verdict.as_ref().and_then(|verdict| verdict.triggers_emitted);
        let emitted = emitted.map_or("not known".to_owned(), |n| n.to_string());
        let seconds = duration_s(recording);
        self.fact(
            "triggers",
            format_args!(
                "{triggers} at {rate} Hz ({seconds:.2} s); {expected}, the HSU's count is {emitted}"
            ),
        );
        let measured = measured_rate_hz(recording);
        let measured = measured.map_or(String::new(), |hz| format!(", {hz:.4} Hz by the HSU's clock"));
        self.fact("table", format_args!("{} rows{measured}", recording.triggers.len()));
        if let Some(time_code) = time_code(recording) {
            self.fact("time code", time_code);
        }
    }

    fn verdict(&mut self, recording: &RecordingReader) {
        let Some(verdict) = &recording.verdict else {
            return self
                .fact("verdict", "none: the recording was not finished, or this is not its last segment");
        };
        self.fact("verdict", verdict.to_string().lines().next().unwrap_or_default());
        verdict.advice.0.iter().for_each(|line| self.fact("advice", line));
    }

    fn cameras(&mut self, cameras: &[CameraDescription]) {
        for camera in cameras {
            for (cause, count) in &camera.gaps {
                let first = camera.first_gaps.get(cause).copied().unwrap_or_default();
                let id = &camera.header.id;
                self.fact("gap", format_args!("{id}: {count} {cause}, the first at trigger {first}"));
            }
        }
        let settings = |camera: &CameraDescription| {
            let settings = camera.header.settings.iter().map(|s| format!("{} {}", s.feature, s.value));
            settings.collect::<Vec<_>>().join(", ")
        };
        let all: Vec<String> = cameras.iter().map(settings).collect();
        match all.first() {
            Some(first) if all.iter().all(|one| one == first) => {
                let first = if first.is_empty() { "none recorded" } else { first };
                self.fact("settings", format_args!("all cameras: {first}"));
            }
            _ => {
                for (camera, settings) in cameras.iter().zip(&all) {
                    self.fact("settings", format_args!("{}: {settings}", camera.header.id));
                }
            }
        }
        let row = |camera: &CameraDescription| {
            let header = &camera.header;
            let format = if header.pixel_format.is_empty() { "-" } else { &header.pixel_format };
            [
                header.id.to_string(),
                format!("{} x {}", header.width, header.height),
                camera.frames.to_string(),
                camera.gaps.values().sum::<u64>().to_string(),
                camera.absent.to_string(),
                format.to_owned(),
                header.device.clone(),
            ]
        };
        let head = &["camera", "size", "frames", "gaps", "absent", "sent as", "device"];
        self.table("cameras", head, cameras.iter().map(row));
    }

    fn segments(&mut self, recording: &RecordingReader) {
        let segments = segments(recording);
        let mib = |bytes: u64| format!("{:.1}", bytes as f64 / f64::from(1 << 20));
        let all = segments.iter().map(|segment| segment.bytes).sum();
        self.fact("segments", format_args!("{} ({} MiB)", segments.len(), mib(all)));
        let rows = segments.into_iter().map(|segment| {
            let end = segment.end_trigger.or(segment.frames_end).filter(|end| *end > segment.first_trigger);
            let first = segment.first_trigger;
            let range = end.map_or("no frames".to_owned(), |end| format!("{first} to {}", end - 1));
            let name = segment.path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            [name, mib(segment.bytes), range, segment.broken.unwrap_or_else(|| "closed".to_owned())]
        });
        self.table("segments", &["file", "MiB", "triggers", "state"], rows);
    }

    fn clocks(&mut self, recording: &RecordingReader) {
        let clocks = clocks(recording);
        if clocks.is_empty() {
            self.fact("clocks", "no exchanges recorded");
        }
        let shown = |number: Option<f64>, digits: usize| {
            number.map_or("-".to_owned(), |number| format!("{number:.digits$}"))
        };
        let us = |ns: Option<u64>| shown(ns.map(|ns| ns as f64 / 1e3), 1);
        let rows = clocks.iter().map(|clock| {
            [
                clock.camera.as_ref().map_or("hsu".to_owned(), ToString::to_string),
                clock.samples.to_string(),
                clock.left_out.to_string(),
                clock.resets.to_string(),
                shown(clock.offset_ns.map(|ns| ns as f64 / 1e9), 6),
                shown(clock.skew_ppm, 3),
                us(clock.residual_ns),
                us(clock.uncertainty_ns),
            ]
        });
        let head =
            &["clock", "samples", "left out", "resets", "offset s", "skew ppm", "residual us", "open us"];
        self.table("clocks", head, rows);
    }

    fn action_commands(&mut self, recording: &RecordingReader) {
        let rows = actions(recording).into_iter();
        let rows = rows.map(|action| [action.camera.to_string(), action.commands.to_string()]);
        self.table("action commands", &["camera", "commands, the warm-up's included"], rows);
        let rows = ptp(recording).into_iter().map(|camera| {
            let statuses = camera.statuses.iter().map(|(status, count)| format!("{status} {count}"));
            let scale = camera.scale.map_or("-".to_owned(), |scale| scale.to_string());
            [camera.camera.to_string(), statuses.collect::<Vec<_>>().join(", "), scale]
        });
        self.table("PTP", &["camera", "statuses, and how often each is recorded", "its clock counts"], rows);
    }

    fn events(&mut self, recording: &RecordingReader) {
        let rows = events(recording).into_iter().map(|kind| {
            let trigger = kind.first_trigger.map_or("-".to_owned(), |trigger| trigger.to_string());
            [kind.kind, kind.count.to_string(), trigger, kind.first_message]
        });
        self.table("events", &["kind", "count", "first at trigger", "first"], rows);
    }

    fn disk(&mut self, recording: &RecordingReader) {
        let Some(statistics) = &recording.statistics else {
            return self.fact("disk", "not known: the recording was not finished, or not by a node");
        };
        let access = statistics.access.map_or("not recorded how".to_owned(), |access| access.to_string());
        let (held, copied) = (statistics.blocks_high_water, statistics.copied_frames);
        self.fact(
            "disk",
            format_args!("reached {access}; the writer held {held} frame blocks at most, {copied} copied"),
        );
        let row = |name: &str, Latency { p50_us, p99_us, max_us }: Latency| {
            let [p50, p99, most] = [p50_us, p99_us, max_us].map(|us| format!("{:.1}", us as f64 / 1e3));
            [name.to_owned(), p50, p99, most]
        };
        let rows = [row("in the file", statistics.written), row("durable", statistics.durable)];
        let head = &["from arrival until", "half of the frames, ms", "99 of 100, ms", "longest, ms"];
        self.table(Self::DISK, head, rows.into_iter());
    }

    /// Title of the table of latencies: until frames are in the file, and until they are durable.
    pub const DISK: &'static str = "latency of the disk";
}
