// SPDX-License-Identifier: MIT OR Apache-2.0
//! The calibration board: black circles on white, in rows and columns, with the centres that a coordinate
//! measuring machine found (`board.toml`).
//!
//! Board axes: x along columns, y along rows, z out of the printed face; metres. A few larger circles code the
//! orientation: any choice is good that no rotation or mirror image maps to itself (checked when loading).

use crate::config::{ConfigError, Problem, Section, read_table};
use nalgebra::Point3;
use sha2::{Digest, Sha256};
use std::cell::RefCell;
use std::path::Path;

/// One circle of the board, as the board file has it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Circle {
    /// Column in the grid, from 0.
    pub column: usize,
    /// Row in the grid, from 0.
    pub row: usize,
    /// Its centre as measured, board frame, m.
    pub centre_m: [f64; 3],
    /// Its radius as measured, m.
    pub radius_m: f64,
    /// Whether it is one of the larger circles, whose arrangement codes the orientation.
    pub large: bool,
}

/// The calibration board. `load` makes it from a board file, whose arrangement of larger circles is then unambiguous;
/// whoever calibrates, validates or draws owns it, and nothing changes it.
#[derive(Debug, Clone, PartialEq)]
pub struct Board {
    /// Its name in the board file; calibrations state it.
    pub name: String,
    /// Outer size (x, y), m.
    pub size_m: [f64; 2],
    pub columns: usize,
    pub rows: usize,
    circles: Vec<Circle>,
}

const FORMAT: u64 = 1;
/// Most columns, and most rows, of circles: it bounds the memory that a wrong file can take.
const MOST: u64 = 200;

impl Board {
    /// Reads and validates a board file.
    pub fn load(path: &Path) -> Result<Self, ConfigError> {
        let table = read_table(path)?;
        let problems = RefCell::default();
        let board = read_board(Section::root(&table, &problems));
        let problems: Vec<Problem> = problems.into_inner();
        if problems.is_empty() { Ok(board) } else { Err(ConfigError { path: path.to_owned(), problems }) }
    }

    /// All circles, row after row.
    pub fn circles(&self) -> &[Circle] {
        &self.circles
    }

    /// The circle at a place of the grid.
    pub fn circle(&self, column: usize, row: usize) -> Option<&Circle> {
        (column < self.columns).then(|| self.circles.get(row * self.columns + column)).flatten()
    }

    /// The corners of its outer edge, board frame, m.
    pub fn corners(&self) -> [Point3<f64>; 4] {
        let [x, y] = self.size_m.map(|s| s / 2.0);
        [[-x, -y], [x, -y], [x, y], [-x, y]].map(|[x, y]| Point3::new(x, y, 0.0))
    }

    /// SHA-256 of all circles: two boards of one name may have been measured differently.
    pub fn sha256(&self) -> String {
        let mut hash = Sha256::new();
        for circle in &self.circles {
            let numbers = circle.centre_m.iter().chain([&circle.radius_m]);
            numbers.for_each(|x| hash.update(x.to_le_bytes()));
            hash.update([u8::from(circle.large)]);
        }
        hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
    }

    /// The circle's number in [`Self::circles`].
    pub fn number(&self, column: usize, row: usize) -> usize {
        row * self.columns + column
    }
}

fn read_board(root: Section<'_>) -> Board {
    root.integer("format", FORMAT..=FORMAT);
    let name = root.text("name");
    let size_m = root.vector::<2>("size_m");
    let columns = root.integer("columns", 3..=MOST) as usize;
    let rows = root.integer("rows", 3..=MOST) as usize;
    let pitch = root.number("pitch_m", 1e-3..=1.0);
    let radius = root.number("radius_m", 1e-4..=0.5);
    let large_radius = root.number("large_radius_m", 1e-4..=0.5);
    let large: Vec<[usize; 2]> = read_places(&root, "large", columns, rows);
    let middle = |n: usize| (n as f64 - 1.0) / 2.0;
    let mut circles: Vec<Circle> = (0..rows * columns)
        .map(|number| {
            let (column, row) = (number % columns.max(1), number / columns.max(1));
            let large = large.contains(&[column, row]);
            let centre_m =
                [pitch * (column as f64 - middle(columns)), pitch * (row as f64 - middle(rows)), 0.0];
            Circle { column, row, centre_m, radius_m: if large { large_radius } else { radius }, large }
        })
        .collect();
    read_measured(&root, columns, &mut circles);
    if !(large_radius >= 1.25 * radius) {
        root.problem(
            "large_radius_m",
            format!("expected at least 1.25 times radius_m ({radius}), found {large_radius}: sizes would be confused"),
        );
    }
    if !(2.0 * large_radius < 0.8 * pitch) {
        root.problem(
            "large_radius_m",
            format!("circles of radius {large_radius} nearly touch at a pitch of {pitch}"),
        );
    }
    if !is_unambiguous(&large, columns, rows) {
        root.problem("large", "the larger circles look the same from another side; expected an arrangement without any symmetry");
    }
    root.finish();
    Board { name, size_m, columns, rows, circles }
}

fn read_places(root: &Section<'_>, key: &'static str, columns: usize, rows: usize) -> Vec<[usize; 2]> {
    let mut places = Vec::new();
    for (i, entry) in root.list(key).iter().enumerate() {
        let numbers: Option<Vec<usize>> = entry
            .as_array()
            .map(|a| a.iter().filter_map(|n| n.as_integer().and_then(|n| usize::try_from(n).ok())).collect());
        match numbers.as_deref() {
            Some(&[column, row]) if column < columns && row < rows => places.push([column, row]),
            _ => root.problem(
                &format!("{key}[{i}]"),
                format!("expected [column, row] below [{columns}, {rows}], found {entry}"),
            ),
        }
    }
    places
}

/// `measured = [[column, row, x, y, z, radius], ...]`: what the measuring machine found, in metres.
fn read_measured(root: &Section<'_>, columns: usize, circles: &mut [Circle]) {
    if !root.has("measured") {
        return;
    }
    for (i, entry) in root.list("measured").iter().enumerate() {
        let number = |v: &toml::Value| v.as_float().or_else(|| v.as_integer().map(|n| n as f64));
        let numbers: Vec<f64> = entry.as_array().into_iter().flatten().filter_map(number).collect();
        let place = match numbers.as_slice() {
            &[column, row, x, y, z, radius]
                if column >= 0.0 && row >= 0.0 && radius > 0.0 && numbers.iter().all(|n| n.is_finite()) =>
            {
                (column < columns as f64)
                    .then(|| (row as usize * columns + column as usize, [x, y, z], radius))
            }
            _ => None,
        };
        match place.and_then(|(number, centre, radius)| Some((circles.get_mut(number)?, centre, radius))) {
            Some((circle, centre_m, radius_m)) => (circle.centre_m, circle.radius_m) = (centre_m, radius_m),
            None => root.problem(
                &format!("measured[{i}]"),
                format!("expected [column, row, x, y, z, radius] of a circle of the grid, in metres, found {entry}"),
            ),
        }
    }
}

/// The eight ways to look at a grid: rotations by quarter turns about the origin, then their mirror images.
pub(super) fn orientations(places: &[[i64; 2]]) -> Vec<Vec<[i64; 2]>> {
    (0..8).map(|turn| places.iter().map(|&place| turned(place, turn)).collect()).collect()
}

/// A place after `turn % 4` quarter turns, mirrored first from 4 on.
pub(super) fn turned([x, y]: [i64; 2], turn: usize) -> [i64; 2] {
    let x = if turn >= 4 { -x } else { x };
    match turn % 4 {
        0 => [x, y],
        1 => [-y, x],
        2 => [-x, -y],
        _ => [y, -x],
    }
}

fn is_unambiguous(large: &[[usize; 2]], columns: usize, rows: usize) -> bool {
    if large.len() < 3 || large.len() * 3 > columns * rows {
        return false;
    }
    let places: Vec<[i64; 2]> = large.iter().map(|&[c, r]| [c as i64, r as i64]).collect();
    let normalized = |places: &[[i64; 2]]| {
        let low = |axis: usize| places.iter().map(|p| p[axis]).min().unwrap_or(0);
        let (x, y) = (low(0), low(1));
        let mut moved: Vec<[i64; 2]> = places.iter().map(|p| [p[0] - x, p[1] - y]).collect();
        moved.sort_unstable();
        moved
    };
    let all: Vec<_> = orientations(&places).iter().map(|p| normalized(p)).collect();
    (1..8).all(|turn| all[turn] != all[0])
}

#[cfg(test)]
mod tests {
    use super::{Board, read_board};
    use crate::config::Section;
    use std::cell::RefCell;

    fn parse(text: &str) -> Result<Board, Vec<String>> {
        let table: toml::Table = text.parse().expect("TOML");
        let problems = RefCell::default();
        let board = read_board(Section::root(&table, &problems));
        let problems: Vec<String> = problems.into_inner().iter().map(ToString::to_string).collect();
        if problems.is_empty() { Ok(board) } else { Err(problems) }
    }

    const GOOD: &str = "format = 1\nname = \"b\"\nsize_m = [1.5, 2.0]\ncolumns = 14\nrows = 19\npitch_m = 0.1\n\
        radius_m = 0.015\nlarge_radius_m = 0.024\nlarge = [[4, 13], [5, 13], [4, 16], [7, 13], [10, 4]]\n";

    #[test]
    fn measured_centres_replace_the_grid() {
        let board =
            parse(&format!("{GOOD}measured = [[4, 13, -0.2501, 0.4002, 0.0003, 0.0241]]\n")).expect("good");
        let circle = board.circle(4, 13).expect("in the grid");
        assert_eq!(
            (circle.centre_m, circle.radius_m, circle.large),
            ([-0.2501, 0.4002, 0.0003], 0.0241, true)
        );
        assert_eq!(board.circle(0, 0).expect("in the grid").centre_m, [-0.65, -0.9, 0.0]);
        assert_eq!(board.circle(14, 0), None);
    }

    #[test]
    fn a_symmetric_code_is_refused() {
        for code in [
            "[[4, 4], [5, 5], [6, 6]]",
            "[[4, 4], [5, 4], [4, 5], [5, 5]]",
            "[[0, 0], [1, 0], [0, 1]]",
            "[[3, 3]]",
        ] {
            let text = GOOD.replace("[[4, 13], [5, 13], [4, 16], [7, 13], [10, 4]]", code);
            let problems = parse(&text).expect_err(code);
            assert!(problems.iter().any(|p| p.contains("large")), "{code}: {problems:?}");
        }
    }

    #[test]
    fn all_problems_come_at_once() {
        let text =
            GOOD.replace("large_radius_m = 0.024", "large_radius_m = 0.016").replace("[10, 4]", "[40, 4]");
        let problems =
            parse(&format!("{text}measured = [[1, 2, 3]]\nhole = 3\n")).expect_err("four problems");
        assert!(problems.len() >= 4, "{problems:?}");
    }
}
