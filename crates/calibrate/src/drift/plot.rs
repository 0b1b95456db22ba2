// SPDX-License-Identifier: MIT OR Apache-2.0
//! The plot of a history of checks, SVG: how far each device has moved what it sees, over time.

use super::history::{Checked, Verdict};
use crate::base::print::html;
use crate::base::time::day;
use crate::report::COLOURS;
use std::collections::BTreeMap;
use std::fmt::{Display, Write};

/// The picture and the frame in it, px.
const SIZE: [f64; 2] = [1000.0, 440.0];
const LEFT: f64 = 64.0;
const TOP: f64 = 40.0;
const RIGHT: f64 = 760.0;
const BOTTOM: f64 = 390.0;
/// The plot's height over the limit, where no device has moved further.
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
    for (number, device) in plot.devices.iter().enumerate() {
        plot.device(&mut out, history, device);
        let last = history.iter().rev().find_map(|one| moved(one, device)).unwrap_or(0.0);
        let (colour, dashes) = plot.style(device);
        let y = TOP + 12.0 + 22.0 * number as f64;
        let line = format!("M{} {}h24", RIGHT + 20.0, y - 4.0);
        path(&mut out, &line, format_args!(" stroke=\"{colour}\" stroke-width=\"2\"{dashes}"));
        text(&mut out, [RIGHT + 52.0, y], "", format_args!("{}: {last:.3}", html(device)));
    }
    out.push_str("</svg>\n");
    out
}

/// A path with these attributes. Writing into a String cannot fail.
fn path(out: &mut String, data: &str, attributes: impl Display) {
    let _ = write!(out, "<path d=\"{data}\"{attributes}/>");
}

/// A text at (x, y), px, with these attributes.
fn text(out: &mut String, [x, y]: [f64; 2], attributes: impl Display, content: impl Display) {
    let _ = write!(out, "<text x=\"{}\" y=\"{}\"{attributes}>{content}</text>", tenths(x), tenths(y));
}

/// A coordinate, px, to a tenth.
fn tenths(px: f64) -> f64 {
    (px * 10.0).round() / 10.0
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

    /// Colour and dashes of a device's line: each camera has a colour, and projectors have the same colours, dashed.
    fn style(&self, device: &str) -> (&'static str, &'static str) {
        let kind = |name: &str| name.split(' ').next().unwrap_or_default().to_owned();
        let alike = self.devices.iter().filter(|name| kind(name) == kind(device));
        let place = alike.take_while(|name| **name != device).count();
        let dashes = if kind(device) == "camera" { "" } else { " stroke-dasharray=\"6 4\"" };
        (COLOURS[place % COLOURS.len()], dashes)
    }

    fn axes(&self, out: &mut String, history: &[Checked]) {
        path(out, &format!("M{LEFT} {TOP}V{BOTTOM}H{RIGHT}"), " fill=\"none\" stroke=\"#222\"");
        for fifth in 0..=5 {
            let mm = self.most_mm * f64::from(fifth) / 5.0;
            let at = [LEFT - 8.0, self.y(mm) + 4.0];
            text(out, at, " text-anchor=\"end\"", format_args!("{mm:.2}"));
        }
        for (ns, x, anchor) in [(self.from_ns, LEFT, "start"), (self.to_ns, RIGHT, "end")] {
            let attributes = format_args!(" text-anchor=\"{anchor}\"");
            text(out, [x, BOTTOM + 34.0], attributes, format_args!("{} UTC", day(ns)));
        }
        if let Some(last) = history.last() {
            let y = self.y(last.most_mm);
            path(out, &format!("M{LEFT} {y:.1}H{RIGHT}"), " stroke=\"#b00\" stroke-dasharray=\"2 3\"");
            let content = format_args!("{} mm: calibrate again", last.most_mm);
            text(out, [LEFT + 6.0, y - 5.0], " fill=\"#b00\"", content);
        }
        for one in history.iter().filter(|one| one.verdict == Verdict::NotKnown) {
            let at = [self.x(one.recorded_ns), BOTTOM + 16.0];
            text(out, at, " text-anchor=\"middle\" fill=\"#777\"", "?");
        }
    }

    /// Marks the sessions from which on another calibration was checked.
    fn calibrations(&self, out: &mut String, history: &[Checked]) {
        for pair in history.windows(2).filter(|pair| pair[0].calibration_sha256 != pair[1].calibration_sha256)
        {
            let x = self.x(pair[1].recorded_ns);
            let short: String = pair[1].calibration_sha256.chars().take(8).collect();
            path(out, &format!("M{x:.1} {TOP}V{BOTTOM}"), " stroke=\"#999\"");
            let attributes = " text-anchor=\"middle\" fill=\"#555\" font-size=\"11\"";
            text(out, [x, TOP - 3.0], attributes, html(&short));
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
            let style = format_args!(" fill=\"none\" stroke=\"{colour}\" stroke-width=\"1.5\"{dashes}");
            path(out, line, style);
        }
    }
}
