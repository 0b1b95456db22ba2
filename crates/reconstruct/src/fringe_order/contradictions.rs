// SPDX-License-Identifier: MIT OR Apache-2.0
//! Places where cameras contradict each other though their devices do not: a pattern on the surface that looks like
//! fringes, or light that is not the projector's.
//!
//! A shirt with stripes as wide as fringes shifts the phase that each camera measures, by other amounts in each. Its
//! fringe orders may be right, and its points are millimetres off. Devices that have moved make differences that change
//! slowly over the image ([`super::drift`]); these differences change from place to place.

use super::patches::Patches;

/// The side of a neighbourhood, cells: 64 px, some fringes wide.
const SIDE: usize = 8;

/// The differences that a neighbourhood needs before they refuse it.
const LEAST: usize = 8;

/// Whether each patch lies in a neighbourhood whose differences `rests` have a median beyond `most_rad`: patch, and how
/// far another camera's phase is off the plane of that camera's differences there, rad.
pub fn refused(patches: &Patches, rests: &[(u32, f32)], most_rad: f32) -> Vec<bool> {
    let columns = patches.columns.div_ceil(SIDE);
    let neighbourhood = |i: usize| {
        let cell = patches.all[i].cell as usize;
        cell / patches.columns / SIDE * columns + cell % patches.columns / SIDE
    };
    let rows = (patches.grid.len() / patches.columns.max(1)).div_ceil(SIDE);
    let mut sizes = vec![Vec::new(); columns * rows];
    for &(patch, rest) in rests {
        sizes[neighbourhood(patch as usize)].push(rest.abs());
    }
    let contradict = |sizes: &mut Vec<f32>| {
        let middle = sizes.len() / 2;
        sizes.len() >= LEAST && *sizes.select_nth_unstable_by(middle, f32::total_cmp).1 > most_rad
    };
    let refused: Vec<bool> = sizes.iter_mut().map(contradict).collect();
    (0..patches.all.len()).map(|i| refused[neighbourhood(i)]).collect()
}

#[cfg(test)]
mod tests {
    use super::{LEAST, SIDE, refused};
    use crate::base::image::Plane;
    use crate::fringe_order::patches::{Patches, Surface};
    use crate::kernels::pixel_runs::Runs;
    use std::f32::consts::TAU;

    /// A plane of 24 x 8 cells: three neighbourhoods beside each other.
    fn patches() -> Patches {
        let (w, h) = (24 * 8, 8 * 8);
        let mut phase = Plane::filled(w, h, 0f32);
        for v in 0..h {
            for (u, phase) in phase.row_mut(v).iter_mut().enumerate() {
                let at = u as f32 * TAU / 10.0;
                *phase = at - TAU * (at / TAU).round();
            }
        }
        let (runs, period) = (Runs::of(&Plane::filled(w, h, 1)), Plane::filled(w, h, 10.0));
        Patches::cut(&mut Surface { phase: &mut phase, period: &period, object: &runs, sign: 1.0 })
    }

    #[test]
    fn a_neighbourhood_is_refused_where_most_of_its_places_contradict() {
        let patches = patches();
        let number = |i: u32| patches.all[i as usize].cell as usize % patches.columns / SIDE;
        let all = 0..patches.all.len() as u32;
        // The first agrees but for outliers, the second is a pattern that looks like fringes, the third has few places.
        let mut few = 0;
        let rests: Vec<(u32, f32)> = all
            .filter_map(|i| match number(i) {
                0 => Some((i, if i % 3 == 0 { 2.0 } else { -0.05 })),
                1 => Some((i, if i % 3 == 0 { 0.05 } else { -0.9 })),
                _ => {
                    few += 1;
                    (few < LEAST).then_some((i, 0.9))
                }
            })
            .collect();
        let refused = refused(&patches, &rests, 0.4);
        for (i, refused) in refused.into_iter().enumerate() {
            assert_eq!(refused, number(i as u32) == 1, "patch {i}");
        }
    }
}
