// SPDX-License-Identifier: MIT OR Apache-2.0
//! What commands have in common: number arguments, results as JSON or text, and failures.

pub use crate::base::Fault as Failure;

use crate::base::ids::one_line;
use crate::data::LostPart;
use serde_json::json;
use std::fmt;
use std::io::ErrorKind;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};

/// The failure to read a file: a path without one is a mistake of usage, one that cannot be read is corrupt data.
pub(super) fn unreadable(path: &Path, error: impl fmt::Display) -> Failure {
    let there = std::fs::metadata(path).map_err(|e| e.kind());
    let absent = matches!(there, Err(ErrorKind::NotFound | ErrorKind::NotADirectory));
    if absent { Failure::usage(error) } else { Failure::corrupt(error) }
}

/// The failure to use the directory of a reconstruction: one that has clouds and is not as `reconstruct` leaves it is
/// damaged. What is there instead is named.
pub(super) fn unusable_clouds(directory: &Path, error: impl fmt::Display) -> Failure {
    let some = ["phases", "clouds", "merged"].iter().any(|folder| directory.join(folder).is_dir());
    if some { Failure::corrupt(error) } else { no_reconstruction(directory, error) }
}

/// A path that a reconstruction was expected at.
pub(super) fn no_reconstruction(path: &Path, error: impl fmt::Display) -> Failure {
    let shown = path.display();
    let expected = "expected what `fourdbody reconstruct` wrote";
    if !path.exists() {
        let message =
            format!("{shown}: {expected}, found nothing of this name; is the path right from here?");
        return Failure::usage(message);
    }
    if !is_session(path) {
        return Failure::usage(error);
    }
    Failure::usage(format!(
        "{shown}: {expected}, found a session, which has frames and no points yet; reconstruct it first: `fourdbody \
         reconstruct {shown} --calibration FILE --out DIR`, then use DIR. Its frames and times: `fourdbody export \
         {shown} --to png,csv --out DIR`"
    ))
}

/// Whether recordings lie here, by the names alone.
fn is_session(directory: &Path) -> bool {
    let names = std::fs::read_dir(directory).into_iter().flatten().flatten().map(|entry| entry.file_name());
    names.into_iter().any(|name| {
        let name = name.to_string_lossy();
        name.starts_with("node-") || (name.starts_with("segment-") && name.ends_with(".mcap"))
    })
}

/// A parser of numbers within a range, for clap; `expected` describes them where an argument is refused.
pub(super) fn number_in(
    range: RangeInclusive<f64>,
    expected: &'static str,
) -> impl Fn(&str) -> Result<f64, String> + Clone + Send + Sync + 'static {
    move |text| {
        let number = text.parse().ok().filter(|number| range.contains(number));
        number.ok_or_else(|| format!("expected {expected}, found {text:?}"))
    }
}

/// Prints a command's result: as one JSON value (`--json`), or as text for people.
pub(super) fn print(json: bool, value: &serde_json::Value, text: impl FnOnce()) {
    match json {
        true => println!("{value}"),
        false => text(),
    }
}

/// Prints which files a command has written: a line each, or JSON.
pub(super) fn print_files(files: &[PathBuf], json: bool) {
    print(json, &json!({ "files": files }), || {
        files.iter().for_each(|path| println!("{}", one_line(path.display())));
    });
}

/// Prints which parts of a session cannot be read; returns whether there are any.
pub(super) fn tell_lost(lost: &[LostPart]) -> bool {
    lost.iter().for_each(|part| eprintln!("NOT READABLE  {part}"));
    !lost.is_empty()
}

/// Prints what of a result is missing or left out; returns whether there is anything.
pub(super) fn tell_amiss(amiss: &[String]) -> bool {
    amiss.iter().for_each(|sentence| eprintln!("{sentence}"));
    !amiss.is_empty()
}

/// Prints that the times of a sequence are made up, where a result does not state when its triggers were.
pub(super) fn tell_made_up_times(rate_hz: f64) {
    eprintln!(
        "MADE UP  times: the result does not state when its triggers were; they are by index at {rate_hz} Hz \
         (--rate-hz), from 1970 on"
    );
}
