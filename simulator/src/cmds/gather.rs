// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody-sim gather`: figures of several reports in one flat file, beside the paper's.

use super::summarize::{machine, read};
use fourdbody::base::Exit;
use fourdbody::cmds::Failure;
use serde_json::{Map, Value};
use std::path::{Path, PathBuf};

/// Gather figures from JSON reports into one flat object, and print them as a table.
///
/// A figure is KEY=FILE:POINTER, or KEY=FILE:POINTER=PAPER with the paper's value to print beside it; POINTER is an RFC
/// 6901 pointer to a number, such as /rms_mm or /heads/0/1/rms_mm.
#[derive(clap::Args)]
#[command(
    after_help = "Example:\n  fourdbody-sim gather --scenario config/scenarios/board.toml --commit HASH --out summary.json \\\n      --figure plane_rms_mm_0rpm=plane-0.json:/rms_mm=0.17 --figure spacing_cloud_mm=spacing.json:/spacing_cloud_mm=1.5"
)]
pub struct Args {
    /// The scenario, for its seed.
    #[arg(long)]
    scenario: PathBuf,
    /// Full hash of the commit.
    #[arg(long)]
    commit: String,
    /// A figure and where it is.
    #[arg(long = "figure", value_name = "KEY=FILE:POINTER[=PAPER]", required = true)]
    figures: Vec<String>,
    /// The JSON file to write, with all figures.
    #[arg(long)]
    out: PathBuf,
}

/// Where a figure comes from.
#[derive(Debug, PartialEq)]
struct Figure<'a> {
    key: &'a str,
    file: &'a Path,
    pointer: &'a str,
    paper: Option<&'a str>,
}

pub fn run(args: &Args) -> Result<Exit, Failure> {
    let scenario = crate::scenario::Scenario::load(&args.scenario)?;
    let mut summary = Map::new();
    println!("{:<28} {:>10} {:>10}", "", "measured", "paper");
    for text in &args.figures {
        let figure = parse(text).ok_or_else(|| {
            let expected = "expected KEY=FILE:POINTER or KEY=FILE:POINTER=PAPER";
            Failure::new(Exit::Usage, format!("--figure {text}: {expected}"))
        })?;
        let report = read(figure.file)?;
        let number = report.pointer(figure.pointer).and_then(Value::as_f64).ok_or_else(|| {
            let (file, pointer) = (figure.file.display(), figure.pointer);
            Failure::new(Exit::Failure, format!("{file}: expected a number at {pointer}, found none"))
        })?;
        println!("{:<28} {number:>10.4} {:>10}", figure.key, figure.paper.unwrap_or(""));
        summary.insert(figure.key.to_owned(), number.into());
    }
    summary.insert("commit".to_owned(), args.commit.clone().into());
    summary.insert("machine".to_owned(), machine().into());
    summary.insert("seed".to_owned(), scenario.seed.into());
    std::fs::write(&args.out, format!("{:#}\n", Value::Object(summary)))
        .map_err(|e| Failure::new(Exit::Failure, format!("{}: {e}", args.out.display())))?;
    Ok(Exit::Done)
}

fn parse(text: &str) -> Option<Figure<'_>> {
    let (key, rest) = text.split_once('=')?;
    let (file, rest) = rest.split_once(":/")?;
    let start = text.len() - rest.len() - 1;
    let (pointer, paper) = match text[start..].split_once('=') {
        Some((pointer, paper)) => (pointer, Some(paper)),
        None => (&text[start..], None),
    };
    (!key.is_empty() && !file.is_empty()).then(|| Figure { key, file: Path::new(file), pointer, paper })
}

#[cfg(test)]
mod tests {
    use super::{Figure, parse};
    use std::path::Path;

    #[test]
    fn figures_name_their_place() {
        let file = Path::new("out/plane.json");
        let plain = Figure { key: "a_mm", file, pointer: "/rms_mm", paper: None };
        assert_eq!(parse("a_mm=out/plane.json:/rms_mm"), Some(plain));
        let both = Figure { key: "a_mm", file, pointer: "/heads/0/1", paper: Some("0.17") };
        assert_eq!(parse("a_mm=out/plane.json:/heads/0/1=0.17"), Some(both));
        for bad in ["a_mm", "a_mm=plane.json", "=plane.json:/x", "a=:/x"] {
            assert_eq!(parse(bad), None, "{bad}");
        }
    }
}
