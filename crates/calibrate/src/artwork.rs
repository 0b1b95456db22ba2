// SPDX-License-Identifier: MIT OR Apache-2.0
//! The board's artwork: SVG in millimetres for print, a picture, and the list of its circles.
//!
//! Board y runs upwards, image rows run downwards: row 0 of the grid is at the bottom of both.

use super::board::Board;
use crate::base::image::Plane;
use crate::base::print::html;
use std::fmt::Write as _;

/// The board as an SVG to be printed at scale 1. Circles are as designed, or as measured where the board file has that.
pub fn svg(board: &Board) -> String {
    let [width, height] = board.size_m.map(|m| m * 1e3);
    let mut text = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}mm\" height=\"{height}mm\" viewBox=\"0 0 {width} {height}\">\n\
         <title>{}</title>\n<rect width=\"{width}\" height=\"{height}\" fill=\"white\"/>\n",
        html(&board.name)
    );
    for circle in board.circles() {
        let [x, y, _] = circle.centre_m;
        // Writing into a String cannot fail.
        let _ = writeln!(
            text,
            "<circle cx=\"{:.4}\" cy=\"{:.4}\" r=\"{:.4}\"/>",
            x * 1e3 + width / 2.0,
            height / 2.0 - y * 1e3,
            circle.radius_m * 1e3
        );
    }
    text + "</svg>\n"
}

/// `column,row,x_m,y_m,z_m,radius_m,large`, a line a circle.
pub fn csv(board: &Board) -> String {
    let mut text = "column,row,x_m,y_m,z_m,radius_m,large\n".to_owned();
    for c in board.circles() {
        let [x, y, z] = c.centre_m;
        let _ = writeln!(
            text,
            "{},{},{x:.6},{y:.6},{z:.6},{:.6},{}",
            c.column,
            c.row,
            c.radius_m,
            u8::from(c.large)
        );
    }
    text
}

/// A grey picture with smooth edges.
pub fn picture(board: &Board, pixels_per_metre: f64) -> Plane<u8> {
    let pixels = |m: f64| (m * pixels_per_metre).ceil().max(1.0) as usize;
    let (width, height) = (pixels(board.size_m[0]), pixels(board.size_m[1]));
    let mut picture = Plane::filled(width, height, 255u8);
    for circle in board.circles() {
        let u = (circle.centre_m[0] + board.size_m[0] / 2.0) * pixels_per_metre - 0.5;
        let v = (board.size_m[1] / 2.0 - circle.centre_m[1]) * pixels_per_metre - 0.5;
        let radius = circle.radius_m * pixels_per_metre;
        let range = |centre: f64, size: usize| {
            let low = (centre - radius - 1.0).floor().max(0.0) as usize;
            let high = (centre + radius + 2.0).ceil().max(0.0) as usize;
            low..high.min(size)
        };
        for row in range(v, height) {
            for column in range(u, width) {
                let distance = (column as f64 - u).hypot(row as f64 - v);
                // How much of the pixel lies outside the circle, to first order.
                let white = (distance - radius + 0.5).clamp(0.0, 1.0);
                picture.set(column, row, (255.0 * white).round() as u8);
            }
        }
    }
    picture
}

#[cfg(test)]
mod tests {
    use super::{csv, picture, svg};
    use crate::base::image::{Mono8, Plane};
    use crate::board::Board;
    use crate::lattice::identify;
    use crate::spots::find_spots;
    use std::path::Path;

    fn board() -> Board {
        Board::load(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config/board.toml"))
            .expect("the shipped board")
    }

    #[test]
    fn what_is_printed_is_recognized_circle_by_circle() {
        let board = board();
        let found = identify(&find_spots(Mono8::from(&picture(&board, 500.0))), &board).expect("a board");
        assert_eq!(found.len(), board.circles().len());
        for sighting in found {
            let [x, y, _] = board.circles()[sighting.circle].centre_m;
            let [u, v] = sighting.spot.ellipse.centre;
            let at = [(u + 0.5) / 500.0 - board.size_m[0] / 2.0, board.size_m[1] / 2.0 - (v + 0.5) / 500.0];
            assert!((at[0] - x).abs() < 1e-4 && (at[1] - y).abs() < 1e-4, "{at:?} {x} {y}");
        }
    }

    #[test]
    fn a_mirrored_board_is_named_as_such() {
        let board = board();
        let print = picture(&board, 500.0);
        let mut mirrored = Plane::filled(print.width(), print.height(), 0u8);
        for v in 0..print.height() {
            for u in 0..print.width() {
                mirrored.set(print.width() - 1 - u, v, print.at(u, v));
            }
        }
        let error = identify(&find_spots(Mono8::from(&mirrored)), &board).expect_err("mirrored");
        assert_eq!(error.kind, crate::Kind::Mirrored, "{error:?}");
    }

    #[test]
    fn every_circle_is_in_the_drawing_and_in_the_list() {
        let board = board();
        assert_eq!(svg(&board).matches("<circle").count(), board.circles().len());
        assert_eq!(csv(&board).lines().count(), board.circles().len() + 1);
    }
}
