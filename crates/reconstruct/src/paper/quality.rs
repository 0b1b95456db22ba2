// SPDX-License-Identifier: MIT OR Apache-2.0
//! Verticality Vm, border map Bm and quality Qm (paper, Equations 1 to 4, Figure 8).

use super::planes::box_sum;
use crate::base::image::{Mono8, Plane};

/// Half side of the box that blurs Om to Bm, px.
const BORDER_PX: usize = 12;

/// Vm: Equations 1 and 2 with the window w = Pm; 0 where Pm is unknown. Windows end at the image's borders.
///
/// Equation 3 of the paper repeats Equation 2 by mistake. Its text has the quotient of the horizontal over the vertical
/// gradient, q. It is normalized as q / (1 + q), which needs no guard where there is no vertical gradient.
pub fn verticality(image: Mono8<'_>, period: &Plane<f32>) -> Plane<f32> {
    let (width, height) = (image.width(), image.height());
    let light = |r: usize, c: usize| f32::from(image.row(r)[c]);
    Plane::from_fn(width, height, |c, r| {
        let w = period.at(c, r).round() as usize;
        let rows = r.saturating_sub(w)..(r + w).min(height - 1);
        let columns = c.saturating_sub(w)..(c + w).min(width - 1);
        let vertical: f32 = rows.map(|i| (light(i + 1, c) - light(i, c)).abs()).sum();
        let horizontal: f32 = columns.map(|j| (light(r, j + 1) - light(r, j)).abs()).sum();
        horizontal / (horizontal + vertical).max(1.0)
    })
}

/// Bm: Om blurred by a box, stretched so that it is 0 on a straight border and 1 well inside.
pub fn border(object: &Plane<f32>) -> Plane<f32> {
    let blurred = box_sum(object, BORDER_PX, BORDER_PX);
    let area = (2 * BORDER_PX + 1).pow(2) as f32;
    Plane::from_fn(object.width(), object.height(), |u, v| {
        object.at(u, v) * (2.0 * blurred.at(u, v) / area - 1.0).clamp(0.0, 1.0)
    })
}

/// Qm: Equation 4 with its printed weights (1, 5, 3, 1) and exponents (1, 2, 1, 1), from Bm, Am in DN, Vm and Sm.
///
/// Am is normalized by its 95th percentile on the object, at most 1: a few bright places must not set the scale.
pub fn quality(object: &Plane<f32>, maps: [&Plane<f32>; 4]) -> Plane<f32> {
    let pixels = maps[1].as_slice().iter().zip(object.as_slice());
    let mut amplitudes: Vec<f32> = pixels.filter(|(_, object)| **object > 0.0).map(|(a, _)| *a).collect();
    amplitudes.sort_unstable_by(f32::total_cmp);
    let percentile = amplitudes.get(amplitudes.len() * 19 / 20).map_or(1.0, |a| a.max(1.0));
    Plane::from_fn(object.width(), object.height(), |u, v| {
        let [b, a, vertical, s] = maps.map(|map| map.at(u, v));
        let a = (a / percentile).min(1.0);
        (b + 5.0 * a * a + 3.0 * vertical + s) / (1.0 + 5.0 + 3.0 + 1.0)
    })
}

#[cfg(test)]
mod tests {
    use super::{border, quality, verticality};
    use crate::base::image::{Mono8, Plane};
    use crate::paper::period;

    fn wave(x: usize) -> u8 {
        (100.0 + 80.0 * (std::f32::consts::TAU * x as f32 / 10.0).cos()) as u8
    }

    #[test]
    fn upright_fringes_are_vertical_and_lying_ones_are_not() {
        let (upright, lying) =
            (Plane::from_fn(60, 60, |u, _| wave(u)), Plane::from_fn(60, 60, |_, v| wave(v)));
        let period = Plane::filled(60, 60, 10.0);
        assert!(verticality(Mono8::from(&upright), &period).at(30, 30) > 0.99);
        assert!(verticality(Mono8::from(&lying), &period).at(30, 30) < 0.01);
        assert_eq!(verticality(Mono8::from(&upright), &Plane::filled(60, 60, 0.0)).at(30, 30), 0.0);
    }

    #[test]
    fn the_weights_are_those_printed() {
        // The second pixel has the amplitude that is 1.
        let [b, a, v, s] =
            [0.3, 50.0, 0.7, 0.9].map(|x| Plane::from_fn(2, 1, |u, _| if u == 0 { x } else { 2.0 * x }));
        let found = quality(&Plane::filled(2, 1, 1.0), [&b, &a, &v, &s]).at(0, 0);
        assert!((found - (0.3 + 5.0 * 0.25 + 3.0 * 0.7 + 0.9) / 10.0).abs() < 1e-6, "{found}");
    }

    #[test]
    fn quality_falls_at_the_border_and_where_fringes_are_faint() {
        let image = Plane::from_fn(200, 100, |u, v| if v < 50 { wave(u) } else { 75 + wave(u) / 4 });
        let object = Plane::from_fn(200, 100, |u, _| if (20..180).contains(&u) { 1.0 } else { 0.0 });
        let (period, amplitude) = period::measure(Mono8::from(&image), &object, 10.0);
        let (vertical, border) = (verticality(Mono8::from(&image), &period), border(&object));
        let found = quality(&object, [&border, &amplitude, &vertical, &period::stability(&period, 10.0)]);
        assert!(border.at(20, 25) < 0.1 && border.at(100, 25) == 1.0 && border.at(10, 25) == 0.0);
        let (inside, at_border, faint) = (found.at(100, 25), found.at(21, 25), found.at(100, 75));
        assert!(
            inside > 0.9 && at_border < inside - 0.05 && faint < inside - 0.3,
            "{inside} {at_border} {faint}"
        );
    }
}
