//! Verticality Vm, border distance Bm and quality Qm (paper, 4.1, Equations 1 to 4, Figure 8).
//!
//! Equation 3 of the paper repeats Equation 2 by mistake. Its text says that the quotient of the horizontal
//! over the vertical gradient measures verticality; `Vm = gH / (gH + gV)` grows with that quotient, lies in
//! 0..1 and needs no guard against division by zero.

use super::period::runs;
use crate::image::{Mono8, Plane};

/// Equation 4's weights and exponents, as printed: Bm, Am, Vm, Sm.
const WEIGHTS: [f32; 4] = [1.0, 5.0, 3.0, 1.0];
const EXPONENTS: [i32; 4] = [1, 2, 1, 1];

/// Half side of the box that blurs Om to Bm, px.
const BORDER_PX: usize = 12;

/// Vm: Equations 1 and 2 with the window w = round(Pm); 0 where the period is unknown. Sums are taken from
/// running sums of absolute differences along rows and columns; windows end at the image's borders.
pub fn verticality(image: Mono8<'_>, period: &Plane<f32>) -> Plane<f32> {
    let (w, h) = (image.width(), image.height());
    let mut out = Plane::filled(w, h, 0f32);
    // down[v][u]: sum of |I(v', u) - I(v' - 1, u)| over 1 <= v' <= v.
    let mut down = Plane::filled(w, h, 0u32);
    for v in 1..h {
        for u in 0..w {
            let step = image.row(v)[u].abs_diff(image.row(v - 1)[u]);
            down.set(u, v, down.at(u, v - 1) + u32::from(step));
        }
    }
    let mut right = vec![0u32; w];
    for v in 0..h {
        let row = image.row(v);
        for u in 1..w {
            right[u] = right[u - 1] + u32::from(row[u].abs_diff(row[u - 1]));
        }
        for u in 0..w {
            let window = period.at(u, v).round() as usize;
            if window == 0 {
                continue;
            }
            let horizontal = right[(u + window).min(w - 1)] - right[u.saturating_sub(window)];
            let vertical = down.at(u, (v + window).min(h - 1)) - down.at(u, v.saturating_sub(window));
            out.set(u, v, horizontal as f32 / (horizontal + vertical).max(1) as f32);
        }
    }
    out
}

/// Bm: Om blurred by a box of 25 x 25 px and stretched, 0 at a straight border and 1 well inside.
pub fn border(mask: &Plane<u8>) -> Plane<f32> {
    let (w, h) = (mask.width(), mask.height());
    let mut out = Plane::filled(w, h, 0f32);
    let mut columns = vec![0u32; w];
    let mut prefix = vec![0u32; w + 1];
    let area = (2 * BORDER_PX + 1).pow(2) as f32;
    for v in 0..h {
        columns.fill(0);
        for row in v.saturating_sub(BORDER_PX)..(v + BORDER_PX + 1).min(h) {
            for (sum, &x) in columns.iter_mut().zip(mask.row(row)) {
                *sum += u32::from(x);
            }
        }
        for (i, &x) in columns.iter().enumerate() {
            prefix[i + 1] = prefix[i] + x;
        }
        for run in runs(mask.row(v)) {
            for u in run {
                let sum = prefix[(u + BORDER_PX + 1).min(w)] - prefix[u.saturating_sub(BORDER_PX)];
                out.set(u, v, (2.0 * sum as f32 / area - 1.0).clamp(0.0, 1.0));
            }
        }
    }
    out
}

/// Am scaled by its 95th percentile on the mask, at most 1.
pub fn normalized_amplitude(amplitude: &Plane<u8>, mask: &Plane<u8>) -> Plane<f32> {
    let mut counts = [0usize; 256];
    for (&a, &m) in amplitude.as_slice().iter().zip(mask.as_slice()) {
        counts[usize::from(a)] += usize::from(m);
    }
    let total: usize = counts.iter().sum();
    let mut seen = 0;
    let percentile = counts.iter().position(|&n| {
        seen += n;
        seen * 20 >= total * 19
    });
    let scale = 1.0 / percentile.unwrap_or(0).max(1) as f32;
    let data = amplitude.as_slice().iter().map(|&a| (f32::from(a) * scale).min(1.0)).collect();
    Plane::from_vec(amplitude.width(), amplitude.height(), data).unwrap_or_else(|| Plane::filled(0, 0, 0.0))
}

/// Qm: Equation 4, from Bm, Am, Vm and Sm, each 0 to 1.
pub fn quality(maps: [&Plane<f32>; 4]) -> Plane<f32> {
    let total: f32 = WEIGHTS.iter().sum();
    let mut out = Plane::filled(maps[0].width(), maps[0].height(), 0f32);
    for (i, out) in out.as_mut_slice().iter_mut().enumerate() {
        let sum: f32 = (0..4).map(|k| WEIGHTS[k] * maps[k].as_slice()[i].powi(EXPONENTS[k])).sum();
        *out = sum / total;
    }
    out
}

#[cfg(test)]
mod tests {
    use super::{border, quality, verticality};
    use crate::image::{Mono8, Plane};

    #[test]
    fn upright_fringes_are_vertical_and_lying_ones_are_not() {
        let mut upright = Plane::filled(60, 60, 0u8);
        let mut lying = upright.clone();
        for v in 0..60 {
            for u in 0..60 {
                let wave = |x: usize| (100.0 + 80.0 * (std::f32::consts::TAU * x as f32 / 10.0).cos()) as u8;
                upright.set(u, v, wave(u));
                lying.set(u, v, wave(v));
            }
        }
        let period = Plane::filled(60, 60, 10.0f32);
        assert!(verticality(Mono8::from(&upright), &period).at(30, 30) > 0.99);
        assert!(verticality(Mono8::from(&lying), &period).at(30, 30) < 0.01);
    }

    #[test]
    fn the_border_map_grows_inwards_and_the_weights_are_those_printed() {
        let mut mask = Plane::filled(100, 100, 0u8);
        for v in 20..80 {
            mask.row_mut(v)[20..80].fill(1);
        }
        let map = border(&mask);
        assert!(map.at(20, 50) < 0.1 && map.at(50, 50) == 1.0 && map.at(10, 50) == 0.0);
        let one = |x: f32| Plane::filled(1, 1, x);
        let found = quality([&one(0.5), &one(0.5), &one(0.5), &one(0.5)]).at(0, 0);
        assert!((found - (0.5 + 5.0 * 0.25 + 3.0 * 0.5 + 0.5) / 10.0).abs() < 1e-6, "{found}");
    }
}
