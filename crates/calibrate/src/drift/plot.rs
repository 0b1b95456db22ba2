// SPDX-License-Identifier: MIT OR Apache-2.0
//! The plot of a history of checks, SVG: how far each device has moved what it sees, over time.

use super::history::{Checked, Verdict};
use crate::base::time::day;
use crate::report::{COLOURS, escape};
use std::collections::BTreeMap;
use std::fmt::Write;

/// The picture and the frame in it, px.
const SIZE: [f64; 2] = [1000.0, 440.0];
const LEFT: f64 = 64.0;
const TOP: f64 = 40.0;
const RIGHT: f64 = 760.0;
const BOTTOM: f64 = 390.0;
/// What may be reached lies so high, where nothing is higher.
const ROOM: f64 = 1.5;

/// The plot; sessions in the order of their recording.
pub(super) fn svg(history: &[Checked]) -> String {
    let plot = Plot::of(history);
    let mut out = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {} {}\" font-family=\"sans-serif\" font-size=\"13\" \
         role=\"img\"><title>How far each device has moved what it sees since its calibration</title>\
         <rect width=\"100%\" height=\"100%\" fill=\"#fff\"/>\
         <text x=\"{LEFT}\" y=\"22\" font-size=\"15\">Moved at the body since the calibration, mm; {} sessions</text>",
        SIZE[0],
        SIZE[1],
        history.len()
    );
    plot.axes(&mut out, history);
    plot.calibrations(&mut out, history);
    // Writing into a String cannot fail.
    for (number, (device, name)) in plot.devices.iter().map(|name| (*name, escape(name))).enumerate() {
        plot.device(&mut out, history, device);
        let last = history.iter().rev().find_map(|one| moved(one, device)).unwrap_or(0.0);
        let (colour, dashes) = plot.style(device);
        let y = TOP + 12.0 + 22.0 * number as f64;
        let _ = write!(
            out,
            "<path d=\"M{} {}h24\" stroke=\"{colour}\" stroke-width=\"2\"{dashes}/><text x=\"{}\" y=\"{y}\">{name}: {last:.3}</text>",
            RIGHT + 20.0,
            y - 4.0,
            RIGHT + 52.0
        );
    }
    out.push_str("</svg>\n");
    out
}

fn moved(one: &Checked, device: &str) -> Option<f64> {
    one.devices.iter().find(|turn| turn.device == device).map(|turn| turn.at_body_mm)
}

struct Plot<'a> {
    /// In the order of the calibrations.
    devices: Vec<&'a str>,
    /// First and last session, ns.
    from_ns: u64,
    to_ns: u64,
    most_mm: f64,
}

impl<'a> Plot<'a> {
    fn of(history: &'a [Checked]) -> Self {
        let mut devices: Vec<&str> = Vec::new();
        for turn in history.iter().flat_map(|one| &one.devices) {
            if !devices.contains(&turn.device.as_str()) {
                devices.push(&turn.device);
            }
        }
        let high = history.iter().flat_map(|one| {
            let moved = one.devices.iter().map(|turn| turn.at_body_mm * 1.05);
            moved.chain(std::iter::once(one.most_mm * ROOM))
        });
        Self {
            devices,
            from_ns: history.first().map_or(0, |one| one.recorded_ns),
            to_ns: history.last().map_or(0, |one| one.recorded_ns),
            most_mm: high.filter(|mm| mm.is_finite()).fold(1e-3, f64::max),
        }
    }

    fn x(&self, ns: u64) -> f64 {
        let span = self.to_ns - self.from_ns;
        let share = if span == 0 { 0.5 } else { (ns - self.from_ns) as f64 / span as f64 };
        LEFT + share * (RIGHT - LEFT)
    }

    fn y(&self, mm: f64) -> f64 {
        BOTTOM - (mm / self.most_mm).min(1.0) * (BOTTOM - TOP)
    }

    /// A camera has a colour, the projectors the same ones with dashes.
    fn style(&self, device: &str) -> (&'static str, &'static str) {
        let kind = |name: &str| name.split(' ').next().unwrap_or_default().to_owned();
        let alike = self.devices.iter().filter(|name| kind(name) == kind(device));
        let place = alike.take_while(|name| **name != device).count();
        let dashes = if kind(device) == "camera" { "" } else { " stroke-dasharray=\"6 4\"" };
        (COLOURS[place % COLOURS.len()], dashes)
    }

    fn axes(&self, out: &mut String, history: &[Checked]) {
        let _ = write!(out, "<path d=\"M{LEFT} {TOP}V{BOTTOM}H{RIGHT}\" fill=\"none\" stroke=\"#222\"/>");
        for fifth in 0..=5 {
            let mm = self.most_mm * f64::from(fifth) / 5.0;
            let y = self.y(mm);
            let _ = write!(
                out,
                "<text x=\"{}\" y=\"{:.1}\" text-anchor=\"end\">{mm:.2}</text>",
                LEFT - 8.0,
                y + 4.0
            );
        }
        for (ns, anchor) in [(self.from_ns, "start"), (self.to_ns, "end")] {
            let x = if anchor == "start" { LEFT } else { RIGHT };
            let day = day(ns);
            let _ = write!(
                out,
                "<text x=\"{x}\" y=\"{}\" text-anchor=\"{anchor}\">{day} UTC</text>",
                BOTTOM + 34.0
            );
        }
        if let Some(last) = history.last() {
            let y = self.y(last.most_mm);
            let _ = write!(
                out,
                "<path d=\"M{LEFT} {y:.1}H{RIGHT}\" stroke=\"#b00\" stroke-dasharray=\"2 3\"/>\
                 <text x=\"{}\" y=\"{:.1}\" fill=\"#b00\">{} mm: calibrate again</text>",
                LEFT + 6.0,
                y - 5.0,
                last.most_mm
            );
        }
        for one in history.iter().filter(|one| one.verdict == Verdict::NotKnown) {
            let x = self.x(one.recorded_ns);
            let _ = write!(
                out,
                "<text x=\"{x:.1}\" y=\"{}\" text-anchor=\"middle\" fill=\"#777\">?</text>",
                BOTTOM + 16.0
            );
        }
    }

    /// Where another calibration begins.
    fn calibrations(&self, out: &mut String, history: &[Checked]) {
        for pair in history.windows(2).filter(|pair| pair[0].calibration_sha256 != pair[1].calibration_sha256)
        {
            let x = self.x(pair[1].recorded_ns);
            let short: String = pair[1].calibration_sha256.chars().take(8).collect();
            let _ = write!(
                out,
                "<path d=\"M{x:.1} {TOP}V{BOTTOM}\" stroke=\"#999\"/>\
                 <text x=\"{x:.1}\" y=\"{}\" text-anchor=\"middle\" fill=\"#555\" font-size=\"11\">{}</text>",
                TOP - 3.0,
                escape(&short)
            );
        }
    }

    /// A line for each calibration, with a point for each session.
    fn device(&self, out: &mut String, history: &[Checked], device: &str) {
        let (colour, dashes) = self.style(device);
        let mut lines: BTreeMap<&str, String> = BTreeMap::new();
        for one in history {
            let Some(mm) = moved(one, device) else { continue };
            let (x, y) = (self.x(one.recorded_ns), self.y(mm));
            let line = lines.entry(&one.calibration_sha256).or_default();
            let _ = write!(line, "{}{x:.1} {y:.1}", if line.is_empty() { 'M' } else { 'L' });
            let _ = write!(out, "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"2.5\" fill=\"{colour}\"/>");
        }
        for line in lines.values() {
            let _ = write!(
                out,
                "<path d=\"{line}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"1.5\"{dashes}/>"
            );
        }
    }
}
