// SPDX-License-Identifier: MIT OR Apache-2.0
//! `calibrate --report`: one HTML page without anything outside of it. Plots are SVG written by hand: points and lines
//! are all they need.

use super::advice::{CELLS, advice, coverage};
use super::bundle::Observation;
use super::run::{Outcome, with_first_device};
use crate::base::print::html;
use crate::data::CalibratedHead;
use crate::geometry::Device;
use nalgebra::Point3;
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// Factor by which residual vectors are drawn longer than they are.
const MAGNIFIED: f64 = 400.0;
/// Most phases that are drawn per projector: more would only make the page larger.
const MOST_PHASES: usize = 4000;
/// Colours of positions of the board; they repeat after ten.
pub(super) const COLOURS: [&str; 10] = [
    "#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd", "#8c564b", "#e377c2", "#7f7f7f", "#bcbd22",
    "#17becf",
];
const STYLE: &str = "body{font:14px sans-serif;max-width:1100px;margin:2em auto;color:#222}table{border-collapse:collapse}\
    td,th{border:1px solid #bbb;padding:2px 8px;text-align:right}th{background:#eee}td:first-child{text-align:left}\
    svg{background:#fff;border:1px solid #bbb;margin:4px;max-width:100%}.bad{background:#fbb}figure{display:inline-block;margin:0}";

/// Writes `index.html` to a directory; gives its path.
pub fn write(outcome: &Outcome, directory: &Path) -> std::io::Result<PathBuf> {
    std::fs::create_dir_all(directory)?;
    let path = directory.join("index.html");
    std::fs::write(&path, page(outcome))?;
    Ok(path)
}

/// The report of a calibration as one HTML page.
pub fn page(outcome: &Outcome) -> String {
    let calibration = &outcome.calibration;
    let mut out = format!(
        "<!DOCTYPE html><html lang=\"en\"><meta charset=\"utf-8\"><title>Calibration of {rig}</title><style>{STYLE}</style>\
         <h1>Calibration of {rig}</h1><p>{}; {} positions of the board.</p>",
        html(&calibration.origin),
        outcome.positions.len(),
        rig = html(&calibration.rig)
    );
    list(&mut out, "What to do better", "Nothing: all is as it should be.", advice(outcome).into_iter());
    list(
        &mut out,
        "What was left out, or looked wrong",
        "Nothing.",
        outcome.findings.iter().map(ToString::to_string),
    );
    summary(&mut out, outcome);
    for (head, first) in with_first_device(&calibration.heads) {
        let _ = write!(out, "<h2>Head {}</h2>", html(head.id.as_str()));
        for (device, camera) in (first..).zip(&head.cameras) {
            camera_plot(&mut out, outcome, device, camera.id.as_str(), &camera.device);
        }
        projector_plot(&mut out, outcome, first + head.cameras.len(), &head.projector);
        positions_table(&mut out, outcome, first, head);
    }
    volume_plot(&mut out, outcome);
    uncertainties(&mut out, outcome);
    out.push_str("</html>\n");
    out
}

fn list(out: &mut String, title: &str, none: &str, items: impl Iterator<Item = String>) {
    let items: String = items.map(|item| format!("<li>{}</li>", html(&item))).collect();
    let body = if items.is_empty() { format!("<p>{none}</p>") } else { format!("<ul>{items}</ul>") };
    let _ = write!(out, "<h2>{title}</h2>{body}");
}

/// A table with a line of headings.
fn table<'a>(
    out: &mut String,
    headings: impl IntoIterator<Item = &'a str>,
    rows: impl Iterator<Item = Vec<String>>,
) {
    let cells = |tag: &str, texts: &mut dyn Iterator<Item = &str>| -> String {
        let cells: String = texts.map(|text| format!("<{tag}>{text}</{tag}>")).collect();
        format!("<tr>{cells}</tr>")
    };
    out.push_str("<table>");
    out.push_str(&cells("th", &mut headings.into_iter()));
    rows.for_each(|row| out.push_str(&cells("td", &mut row.iter().map(String::as_str))));
    out.push_str("</table>");
}

fn summary(out: &mut String, outcome: &Outcome) {
    let Some(quality) = &outcome.calibration.quality else { return };
    out.push_str("<h2>How well it fits</h2>");
    let cameras = quality.cameras.iter().map(|c| {
        let rms = format!("{:.4}", c.circles_rms_px);
        vec![html(c.camera.as_str()), c.positions.to_string(), c.circles.to_string(), rms]
    });
    table(out, ["camera", "positions", "circles", "rms px"], cameras);
    out.push_str("<p></p>");
    let projectors = quality.projector_rms_px.iter().map(|(head, rms)| {
        let response = quality.responses.iter().find(|(id, _)| id == head).map(|(_, r)| r);
        let gamma = response.map_or("?".to_owned(), |r| format!("{:.3} &plusmn; {:.3}", r.gamma, r.sigma));
        let harmonics = response.map_or("?".to_owned(), |r| {
            format!("{:.2} %, {:.2} %", 100.0 * r.second_harmonic, 100.0 * r.third_harmonic)
        });
        vec![html(head.as_str()), format!("{rms:.4}"), gamma, harmonics]
    });
    table(out, ["projector of", "rms panel px", "gamma", "2nd, 3rd harmonic"], projectors);
    if !quality.links.is_empty() {
        out.push_str("<p></p>");
        let links = quality.links.iter().map(|link| {
            let [a, b] = link.heads;
            vec![format!("{a} and {b}"), link.positions.to_string(), format!("{:.3}", link.rms_mm)]
        });
        table(out, ["heads", "common positions", "rms mm"], links);
    }
    let around = quality
        .loop_error_mm
        .map_or("no closed loop of heads".to_owned(), |mm| format!("around all heads: {mm:.3} mm"));
    let _ = write!(out, "<p>Loop error: {around}.</p>");
}

/// Residuals of a device that are counted, with their observations.
fn residuals(outcome: &Outcome, device: usize) -> impl Iterator<Item = (&Observation, [f64; 2], bool)> {
    let all = &outcome.together.all;
    let three = outcome.together.observations.iter().zip(&all.residuals).zip(&all.outliers);
    three.filter(move |((o, _), _)| o.device == device).map(|((o, r), out)| (o, *r, *out))
}

/// The image with all circles and their residuals, over how often each part was covered.
fn camera_plot(out: &mut String, outcome: &Outcome, device: usize, name: &str, camera: &Device) {
    let (w, h) = (camera.width as f64, camera.height as f64);
    let _ = write!(
        out,
        "<figure><figcaption>{}: circles of all positions (a colour each), residuals {MAGNIFIED:.0} times as long; grey: covered</figcaption>\
         <svg width=\"520\" viewBox=\"0 0 {w} {h}\">",
        html(name)
    );
    let cells = coverage(outcome, device, (camera.width, camera.height));
    let (cw, ch) = (w / CELLS[0] as f64, h / CELLS[1] as f64);
    for (i, n) in cells.iter().enumerate().filter(|(_, n)| **n > 0) {
        let shade = 250 - (n * 2).min(50);
        let (x, y) = ((i % CELLS[0]) as f64 * cw, (i / CELLS[0]) as f64 * ch);
        let _ = write!(
            out,
            "<rect x=\"{x:.0}\" y=\"{y:.0}\" width=\"{cw:.0}\" height=\"{ch:.0}\" fill=\"rgb({shade},{shade},{shade})\"/>"
        );
    }
    let radius = w / 640.0;
    for (o, [ru, rv], outlier) in residuals(outcome, device) {
        let [u, v] = o.measured;
        let colour = if outlier { "#000" } else { COLOURS[o.board % COLOURS.len()] };
        let _ = write!(out, "<circle cx=\"{u:.0}\" cy=\"{v:.0}\" r=\"{radius:.1}\" fill=\"{colour}\"/>");
        if ru.is_finite() && rv.is_finite() {
            let (x, y) = (u + MAGNIFIED * ru, v + MAGNIFIED * rv);
            let _ = write!(
                out,
                "<path d=\"M{u:.0} {v:.0}L{x:.0} {y:.0}\" stroke=\"{colour}\" stroke-width=\"{radius:.1}\"/>"
            );
        }
    }
    out.push_str("</svg></figure>");
}

/// Phase residuals over the panel's columns.
fn projector_plot(out: &mut String, outcome: &Outcome, device: usize, projector: &Device) {
    const HEIGHT: f64 = 200.0;
    let all: Vec<_> = residuals(outcome, device).collect();
    let mut sizes: Vec<f64> = all.iter().map(|(_, [r, _], _)| r.abs()).filter(|r| r.is_finite()).collect();
    sizes.sort_by(f64::total_cmp);
    let reach = sizes.get(sizes.len() * 98 / 100).copied().unwrap_or(0.1).max(0.01) * 1.5;
    let width = projector.width as f64;
    let _ = write!(
        out,
        "<figure><figcaption>projector: phase residual over the panel's columns, edges at &plusmn; {reach:.3} panel px</figcaption>\
         <svg width=\"1060\" height=\"{HEIGHT}\" viewBox=\"0 0 {width} {HEIGHT}\" preserveAspectRatio=\"none\">\
         <path d=\"M0 {0}L{width} {0}\" stroke=\"#999\"/>",
        HEIGHT / 2.0
    );
    let every = all.len().div_ceil(MOST_PHASES).max(1);
    for (o, [r, _], _) in all.iter().step_by(every).filter(|(_, [r, _], _)| r.abs() <= reach) {
        let y = HEIGHT / 2.0 * (1.0 - r / reach);
        let colour = COLOURS[o.board % COLOURS.len()];
        let _ =
            write!(out, "<circle cx=\"{:.0}\" cy=\"{y:.1}\" r=\"1.2\" fill=\"{colour}\"/>", o.measured[0]);
    }
    out.push_str("</svg></figure>");
}

/// RMS by position and device; far worse than the device's others is marked.
fn positions_table(out: &mut String, outcome: &Outcome, first: usize, head: &CalibratedHead) {
    let projector = first + head.cameras.len();
    let boards = outcome.together.all.model.boards.len();
    let rms = |device: usize, board: Option<usize>| {
        let mine =
            residuals(outcome, device).filter(|(o, _, out)| !out && board.is_none_or(|b| o.board == b));
        let (sum, n) = mine.fold((0.0, 0.0), |(sum, n), (o, [u, v], _)| {
            if o.columns_only { (sum + u * u, n + 1.0) } else { (sum + u * u + v * v, n + 2.0) }
        });
        (n > 0.0).then(|| f64::sqrt(sum / n))
    };
    out.push_str("<table><tr><th>board</th>");
    head.cameras.iter().for_each(|c| {
        let _ = write!(out, "<th>{} px</th>", html(c.id.as_str()));
    });
    out.push_str("<th>projector panel px</th></tr>");
    let usual: Vec<Option<f64>> = (first..=projector).map(|device| rms(device, None)).collect();
    for board in 0..boards {
        let row: Vec<Option<f64>> = (first..=projector).map(|device| rms(device, Some(board))).collect();
        if row.iter().all(Option::is_none) {
            continue;
        }
        let _ = write!(
            out,
            "<tr><td><span style=\"color:{}\">&#9632;</span> {}</td>",
            COLOURS[board % COLOURS.len()],
            board + 1
        );
        for (value, usual) in row.iter().zip(&usual) {
            let class = match (value, usual) {
                (Some(value), Some(usual)) if *value > 2.0 * usual => " class=\"bad\"",
                _ => "",
            };
            let text = value.map_or("-".to_owned(), |value| format!("{value:.4}"));
            let _ = write!(out, "<td{class}>{text}</td>");
        }
        out.push_str("</tr>");
    }
    out.push_str("</table>");
}

/// The board's positions and the cameras, from above and from the side.
fn volume_plot(out: &mut String, outcome: &Outcome) {
    let calibration = &outcome.calibration;
    let Some(quality) = &calibration.quality else { return };
    let [x, y] = outcome.board_size_m.map(|s| s / 2.0);
    let outline = [[-x, -y], [x, -y], [x, y], [-x, y]].map(|[x, y]| Point3::new(x, y, 0.0));
    let _ = write!(
        out,
        "<h2>Coverage of the volume</h2><p>Board {}; dashed: the rig's volume; filled: valid for at least one head.</p>",
        html(&quality.board)
    );
    for (title, axes) in
        [("from above: x to the right, y up", [0, 1]), ("from the side: x to the right, z up", [0, 2])]
    {
        let _ = write!(
            out,
            "<figure><figcaption>{title}</figcaption><svg width=\"520\" viewBox=\"-3 -3 6 6\"><g transform=\"scale(1 -1) translate(0 {})\" fill=\"none\" stroke-width=\"0.01\">",
            if axes[1] == 2 { -1.0 } else { 0.0 }
        );
        let mut box_of = |min: [f64; 3], max: [f64; 3], style: &str| {
            let [a, b] = axes;
            let _ = write!(
                out,
                "<rect x=\"{:.3}\" y=\"{:.3}\" width=\"{:.3}\" height=\"{:.3}\" {style}/>",
                min[a],
                min[b],
                max[a] - min[a],
                max[b] - min[b]
            );
        };
        if let Some(valid) = &calibration.valid {
            box_of(valid.any.min_m, valid.any.max_m, "fill=\"#eef\"");
        }
        box_of(
            calibration.volume_min_m,
            calibration.volume_max_m,
            "stroke=\"#888\" stroke-dasharray=\"0.05\"",
        );
        for (i, board) in outcome.together.all.model.boards.iter().enumerate() {
            let points: String = outline
                .iter()
                .map(|corner| board * corner)
                .map(|p| format!("{:.3},{:.3} ", p[axes[0]], p[axes[1]]))
                .collect();
            let _ = write!(out, "<polygon points=\"{points}\" stroke=\"{}\"/>", COLOURS[i % COLOURS.len()]);
        }
        for (_, camera) in calibration.cameras() {
            let p = camera.device.centre();
            let _ = write!(
                out,
                "<circle cx=\"{:.3}\" cy=\"{:.3}\" r=\"0.03\" fill=\"#000\"/>",
                p[axes[0]], p[axes[1]]
            );
        }
        out.push_str("</g></svg></figure>");
    }
}

fn uncertainties(out: &mut String, outcome: &Outcome) {
    let Some(quality) = &outcome.calibration.quality else { return };
    let names = super::bundle::DEVICE_PARAMETER_NAMES;
    out.push_str("<h2>Standard deviations</h2><p>Lens: px; turns: mrad; shifts: mm; 0: held. Poses are relative to the first camera.</p>");
    let rows = quality.uncertainties.iter().map(|device| {
        let sigma = |(i, name): (usize, &&str)| {
            let sigma = device.sigma.get(*name).copied().unwrap_or(0.0);
            match i {
                4..=8 => format!("{sigma:.1e}"),
                9.. => format!("{:.3}", sigma * 1e3),
                _ => format!("{sigma:.3}"),
            }
        };
        std::iter::once(html(&device.device)).chain(names.iter().enumerate().map(sigma)).collect()
    });
    table(out, std::iter::once("device").chain(names), rows);
}
