// SPDX-License-Identifier: MIT OR Apache-2.0
//! The report's HTML: one file, nothing from anywhere else.

use super::{CameraReport, NodeReport, Report};
use crate::base::print::html as escape;
use crate::play::Sequence;
use crate::record::Status;
use crate::record::describe::{Sheet, Table};
use crate::telemetry::Grade;
use crate::telemetry::thresholds::{DURABLE_P99, WRITE_P99};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use rayon::prelude::*;
use std::fmt::Write;
use std::path::Path;

/// Script of the console that shows a cloud and turns it.
const CLOUD_VIEW: &str = include_str!("../../../../web/cloud-view.js");
const PLAYER: &str = include_str!("../../../../web/player.js");
const STYLE: &str =
    concat!(include_str!("../../../../web/report.css"), include_str!("../../../../web/player.css"));

/// Frame sets that are packed at a time, which bounds the memory.
const AT_ONCE: usize = 8;

/// End of the page, behind the frame sets where it plays them.
pub const END: &str = "</body></html>\n";

/// The frame sets that a page has, and how many points of each.
pub struct Playing {
    sequence: Sequence,
    points_each: usize,
}

impl Playing {
    /// Those of `result`, the directory of `fourdbody reconstruct`. Together they have at most `most_bytes` bytes of
    /// points before they are packed.
    pub fn open(result: &Path, most_bytes: u64) -> Result<Self, String> {
        let sequence = Sequence::open(result)?;
        let points_each = sequence.points_each(most_bytes);
        Ok(Self { sequence, points_each })
    }

    /// Writes a script element for each, `set-TRIGGER`, in the order of triggers: the first one can be shown while the
    /// page is still read. Its text is base64 of the packed points. `progress` is called with the frame sets
    /// that are done, and their number.
    pub fn write(&self, out: &mut impl std::io::Write, progress: impl Fn(u64, u64)) -> Result<(), String> {
        let triggers: Vec<u64> = self.sequence.triggers().collect();
        for (chunk, at_once) in triggers.chunks(AT_ONCE).enumerate() {
            let pack = |trigger: &u64| {
                let packed = self.sequence.packed(*trigger, self.points_each);
                packed.unwrap_or_else(|| Err(format!("trigger {trigger} has no cloud")))
            };
            let packed: Vec<Vec<u8>> = at_once.par_iter().map(pack).collect::<Result<_, _>>()?;
            for (i, (trigger, packed)) in at_once.iter().zip(&packed).enumerate() {
                let text = STANDARD.encode(packed);
                writeln!(
                    out,
                    "<script type=\"application/octet-stream\" id=\"set-{trigger}\">{text}</script>"
                )
                .map_err(|e| format!("the page cannot be written: {e}"))?;
                progress((chunk * AT_ONCE + i) as u64 + 1, triggers.len() as u64);
            }
        }
        Ok(())
    }
}

/// The page, up to [`END`]. With `playing` it has a player, and the frame sets follow behind it.
pub fn render(report: &Report, playing: Option<&Playing>) -> String {
    let mut page = String::new();
    let title = escape(&report.session);
    let (word, kind) = verdict(report);
    // Writing into a String cannot fail.
    let _ = write!(
        page,
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\
         <title>{title} - fourdbody</title><style>{STYLE}</style></head><body>\n\
         <h1>{title} <span class=\"{kind}\">{word}</span></h1>\n"
    );
    let seconds = report.triggers as f64 / report.trigger_rate_hz.max(1e-9);
    let of_session = [
        ("begun", format!("<time data-ns=\"{}\"></time>", report.created_ns)),
        ("subject", escape(report.subject.as_deref().unwrap_or("-"))),
        ("note", escape(report.note.as_deref().unwrap_or("-"))),
        ("triggers", format!("{} at {} Hz: {seconds:.2} s", report.triggers, report.trigger_rate_hz)),
    ];
    facts(&mut page, of_session.into_iter());
    match (playing, &report.cloud) {
        (Some(playing), _) => player(&mut page, report.trigger_rate_hz, playing),
        (None, Some((trigger, points))) => {
            let _ = writeln!(
                page,
                "<h2>Cloud of trigger {trigger}</h2><canvas id=\"cloud\" tabindex=\"0\" \
                 aria-label=\"point cloud; turn with the mouse or the arrow keys\"></canvas>"
            );
            let _ = writeln!(
                page,
                "<script type=\"application/octet-stream\" id=\"points\">{}</script>",
                STANDARD.encode(points)
            );
        }
        (None, None) => {}
    }
    if !report.amiss.is_empty() {
        let _ = write!(page, "<pre class=\"bad\">{}</pre>", escape(&report.amiss.join("\n")));
    }
    report.nodes.iter().for_each(|node| node_section(&mut page, report, node));
    for one in &report.unreadable {
        let _ = write!(
            page,
            "<section><h2>{} cannot be read</h2><pre class=\"bad\">{}</pre></section>",
            escape(&one.name()),
            escape(&one.to_string())
        );
    }
    let _ = writeln!(page, "<script>\n{DATES}</script>");
    if playing.is_none() && report.cloud.is_some() {
        let _ = writeln!(page, "<script>{}\n{SHOW}</script>", plain(CLOUD_VIEW));
    }
    page
}

/// A module of the console as a plain script: without imports and exports.
fn plain(module: &str) -> String {
    let lines = module.lines().filter(|line| !line.starts_with("import "));
    lines.collect::<Vec<_>>().join("\n").replace("export class", "class")
}

/// Adds the player of the frame sets. Its script runs as soon as it is read, before the frame sets are.
fn player(page: &mut String, trigger_rate_hz: f64, playing: &Playing) {
    let described = playing.sequence.described(trigger_rate_hz, playing.points_each);
    // Numbers and plain texts: this cannot fail.
    let described = serde_json::to_string(&described).unwrap_or_default();
    let _ = write!(
        page,
        "<section id=\"player\" data-described=\"{}\"><h2>The body</h2></section>\n<script>{}\n{}\n{PLAY}</script>\n",
        escape(&described),
        plain(CLOUD_VIEW),
        plain(PLAYER)
    );
}

/// Script that shows dates in the reader's own time zone.
const DATES: &str = r#"
for (const time of document.querySelectorAll("time")) time.textContent = new Date(Number(time.dataset.ns) / 1e6).toLocaleString([], { timeZoneName: "short" });
"#;

/// Script that shows the one cloud of a page without a player.
const SHOW: &str = r#"
const bytes = Uint8Array.from(atob(document.getElementById("points").textContent), (c) => c.charCodeAt(0));
const canvas = document.getElementById("cloud");
canvas.dataset.points = String(new CloudView(canvas).show([bytes.buffer]));
"#;

const PLAY: &str = r#"
const root = document.getElementById("player");
const player = new Player(root, new PageSource(JSON.parse(root.dataset.described)));
"#;

/// The verdict on the session in a word, and its class of colour.
fn verdict(report: &Report) -> (&'static str, &'static str) {
    let of_node = |node: &NodeReport| Some(node.verdict.as_ref()?.status);
    let statuses: Option<Vec<Status>> = report.nodes.iter().map(of_node).collect();
    match statuses.and_then(|statuses| statuses.into_iter().max()) {
        _ if !report.unreadable.is_empty() => ("not whole", "bad"),
        None => ("unfinished", "bad"),
        Some(worst) => {
            let kind = match worst {
                Status::Complete => "good",
                Status::Unconfirmed | Status::Incomplete => "fair",
                Status::Aborted => "bad",
            };
            (worst.word(), kind)
        }
    }
}

fn node_section(page: &mut String, report: &Report, node: &NodeReport) {
    let _ = write!(page, "<section><h2>Node {}</h2>", escape(&node.node));
    facts(page, node.sheet.facts.iter().map(|(name, value)| (*name, escape(value))));
    if !node.sheet.missing.is_empty() {
        let _ = write!(page, "<pre class=\"bad\">{}</pre>", escape(&node.sheet.missing.join("\n")));
    }
    page.push_str("<h3>Frames over the session</h3>");
    node.cameras.iter().for_each(|camera| timeline(page, report.triggers, camera));
    page.push_str("<h3>Light</h3><div class=\"cameras\">");
    node.cameras.iter().for_each(|camera| camera_box(page, camera));
    page.push_str("</div>");
    node.sheet.tables.iter().for_each(|sheet| table(page, node, sheet));
    let _ = writeln!(page, "<p class=\"soft\">{}</p></section>", escape(&node.path.display().to_string()));
}

/// A bar of the whole session with a mark for every run of gaps.
fn timeline(page: &mut String, triggers: u64, camera: &CameraReport) {
    let id = escape(camera.described.header.id.as_str());
    let total = triggers.max(1) as f64;
    let _ = write!(
        page,
        "<div class=\"line\"><span>{id}</span><svg viewBox=\"0 0 1000 12\" preserveAspectRatio=\"none\" role=\"img\" \
         aria-label=\"{} frames, {} gaps\"><rect class=\"there\" width=\"1000\" height=\"12\"/>",
        camera.described.frames,
        camera.gaps.iter().map(|run| run.triggers.end - run.triggers.start).sum::<u64>()
    );
    for run in &camera.gaps {
        let (from, count) = (run.triggers.start as f64, (run.triggers.end - run.triggers.start) as f64);
        let _ = write!(
            page,
            "<rect class=\"gap\" x=\"{:.3}\" width=\"{:.3}\" height=\"12\"><title>{} to {}: {}</title></rect>",
            1000.0 * from / total,
            (1000.0 * count / total).max(1.0),
            run.triggers.start,
            run.triggers.end - 1,
            run.cause
        );
    }
    let _ = write!(page, "</svg><span>{}</span></div>", camera.described.frames);
}

fn camera_box(page: &mut String, camera: &CameraReport) {
    let id = escape(camera.described.header.id.as_str());
    page.push_str("<figure>");
    if let Some(png) = &camera.picture {
        let _ =
            write!(page, "<img alt=\"camera {id}\" src=\"data:image/png;base64,{}\">", STANDARD.encode(png));
    }
    let _ = write!(page, "<figcaption><b>{id}</b>");
    let exposure =
        camera.described.header.settings.iter().find(|setting| setting.feature.starts_with("ExposureTime"));
    if let Some(setting) = exposure {
        let value = serde_json::to_value(&setting.value).unwrap_or_default();
        let _ = write!(page, "<br>exposure {value} us");
    }
    let worst =
        |grade: fn(&crate::preview::Light) -> Grade| camera.light.iter().map(|(_, light)| grade(light)).max();
    let mean = |value: fn(&crate::preview::Light) -> f64| {
        camera.light.iter().map(|(_, light)| value(light)).sum::<f64>() / camera.light.len().max(1) as f64
    };
    if let Some(grade) = worst(|light| light.grades().modulation) {
        let _ = write!(
            page,
            "<br><span class=\"{}\">modulation {:.0} DN</span>",
            class(grade),
            mean(|l| l.modulation_dn)
        );
    }
    if let Some(grade) = worst(|light| light.grades().saturated) {
        let share = mean(|light| 100.0 * light.saturated);
        let _ = write!(page, "<br><span class=\"{}\">overexposed {share:.2} %</span>", class(grade));
    }
    if let Some(exposure) = &camera.exposure {
        let _ = write!(page, "<br>right exposure: {exposure}");
    }
    if !camera.points.is_empty() {
        let counts: Vec<u64> = camera.points.iter().map(|(_, points)| *points).collect();
        let (low, high) = (counts.iter().min().unwrap_or(&0), counts.iter().max().unwrap_or(&0));
        let _ = write!(page, "<br>{low} to {high} points a frame{}", sparkline(&counts, *high));
    }
    page.push_str("</figcaption></figure>");
}

/// A curve of points over the session, 100 x 20 units.
fn sparkline(counts: &[u64], most: u64) -> String {
    let last = counts.len().saturating_sub(1).max(1) as f64;
    let at = |(i, count): (usize, &u64)| {
        format!("{:.1},{:.1}", 100.0 * i as f64 / last, 19.0 - 18.0 * *count as f64 / most.max(1) as f64)
    };
    let places: Vec<String> = counts.iter().enumerate().map(at).collect();
    format!(
        "<svg class=\"spark\" viewBox=\"0 0 100 20\" preserveAspectRatio=\"none\"><polyline points=\"{}\"/></svg>",
        places.join(" ")
    )
}

/// Names and values, which are HTML.
fn facts<'a>(page: &mut String, facts: impl Iterator<Item = (&'a str, String)>) {
    page.push_str("<dl class=\"facts\">");
    for (name, value) in facts {
        let _ = write!(page, "<dt>{name}</dt><dd>{value}</dd>");
    }
    page.push_str("</dl>\n");
}

/// A table of the sheet; the 99th percentiles of the disk's latencies are graded.
fn table(page: &mut String, node: &NodeReport, table: &Table) {
    let grades = node.statistics.filter(|_| table.title == Sheet::DISK).map(|statistics| {
        let latencies = [(statistics.written, WRITE_P99), (statistics.durable, DURABLE_P99)];
        latencies.map(|(latency, threshold)| class(threshold.grade(latency.p99_us as f64 / 1e3)))
    });
    let _ = write!(page, "<h3>{}</h3><table><tr>", table.title);
    for name in table.head {
        let _ = write!(page, "<th>{name}</th>");
    }
    for (number, row) in table.rows.iter().enumerate() {
        page.push_str("</tr><tr>");
        for (column, cell) in row.iter().enumerate() {
            let grade = grades.and_then(|grades| grades.get(number).copied()).filter(|_| column == 2);
            let _ = write!(page, "<td class=\"{}\">{}</td>", grade.unwrap_or_default(), escape(cell));
        }
    }
    page.push_str("</tr></table>");
}

fn class(grade: Grade) -> &'static str {
    match grade {
        Grade::Good => "good",
        Grade::Fair => "fair",
        Grade::Bad => "bad",
    }
}

#[cfg(test)]
mod tests {
    use super::render;
    use crate::record::describe::Sheet;
    use crate::record::{Advice, Status, Verdict};
    use crate::report::{NodeReport, Report};

    fn report(nodes: Vec<NodeReport>) -> Report {
        Report {
            session: "walk".to_owned(),
            created_ns: 0,
            subject: None,
            note: None,
            trigger_rate_hz: 120.0,
            triggers: 24,
            nodes,
            unreadable: Vec::new(),
            amiss: Vec::new(),
            cloud: None,
        }
    }

    /// A node whose recording has this status; `None`: it was not finished.
    fn node(status: Option<Status>) -> NodeReport {
        let verdict = |status| Verdict {
            status,
            triggers: 24,
            triggers_expected: Some(24),
            triggers_emitted: Some(24),
            cameras: Vec::new(),
            untimed: 0,
            refused: 0,
            unconfirmed: 0,
            changed: Vec::new(),
            not_simultaneous: Vec::new(),
            aborted: None,
            advice: Advice::default(),
        };
        NodeReport {
            node: "a".to_owned(),
            path: "/walk/node-a".into(),
            verdict: status.map(verdict),
            statistics: None,
            sheet: Sheet::default(),
            cameras: Vec::new(),
        }
    }

    #[test]
    fn a_session_is_as_good_as_its_worst_node() {
        use Status::{Aborted, Complete, Incomplete, Unconfirmed};
        for (nodes, heading) in [
            (vec![Some(Complete), Some(Complete)], "\"good\">complete"),
            (vec![Some(Complete), Some(Unconfirmed)], "\"fair\">unconfirmed"),
            (vec![Some(Incomplete), Some(Unconfirmed)], "\"fair\">incomplete"),
            (vec![Some(Aborted), Some(Complete)], "\"bad\">aborted"),
            (vec![None, Some(Complete)], "\"bad\">unfinished"),
            (vec![], "\"bad\">unfinished"),
        ] {
            let page = render(&report(nodes.iter().copied().map(node).collect()), None);
            assert!(page.contains(&format!("<span class={heading}</span></h1>")), "{nodes:?}");
        }
    }

    #[test]
    fn what_people_wrote_is_text_and_never_a_script() {
        let report = Report {
            subject: Some("<script>alert(1)</script>".to_owned()),
            note: Some("\"><img src=x onerror='alert(2)'>".to_owned()),
            ..report(Vec::new())
        };
        let page = render(&report, None);
        assert!(!page.contains("<script>alert") && !page.contains("<img src=x"), "{page}");
        assert!(page.contains("&lt;script&gt;alert(1)"));
        assert!(page.contains("24 at 120 Hz: 0.20 s"));
        for outside in ["http://", "https://", "src=\"/", "href="] {
            assert!(!page.contains(outside), "the page needs {outside}");
        }
    }
}
