// SPDX-License-Identifier: MIT OR Apache-2.0
//! The exposure that is advised for the shared scene's photographs, made darker and brighter by known factors. Skipped, with
//! a printed reason, where the data are not at hand. It costs a second.

use crate::shared_scene::scene;
use fourdbody::base::image::{Mono8, Plane, read_png_grey};
use fourdbody::preview::{Exposure, Peaks};

/// Every fourth row, as previews and reports look at a frame, times `factor`; what is above 255 is cut.
fn advised(image: &Plane<u8>, factor: f64) -> Exposure {
    let mut peaks = Peaks::default();
    let rows = Mono8::from(image);
    for v in (0..rows.height()).step_by(4) {
        let row: Vec<u8> =
            rows.row(v).iter().map(|x| (f64::from(*x) * factor).round().min(255.0) as u8).collect();
        peaks.add(row.len(), &row);
    }
    peaks.exposure().expect("there is a body")
}

/// `body_arms_raised` and `stripes` are reported only: nothing was chosen with them.
#[test]
fn the_advice_leads_from_any_light_to_the_same_exposure() {
    let Some(scene) = scene() else { return };
    for set in ["squat", "throw", "tattoo", "body_arms_raised", "stripes"] {
        let mut worst: [f64; 2] = [0.0; 2];
        for head in 0..4 {
            for camera in ["up", "low"] {
                let path = scene.join(format!("{set}/h{head}_{camera}/000000.png"));
                let image = read_png_grey(&path).expect("an image");
                let right = advised(&image, 1.0);
                for factor in [0.08, 0.2, 1.6, 2.2] {
                    let found = advised(&image, factor);
                    let off = found.ev + factor.log2() - right.ev;
                    println!(
                        "{set} h{head}_{camera} x {factor}: {found} (x 1: {right}), {off:+.2} EV from it"
                    );
                    let cut = usize::from(found.saturated > 0.0);
                    worst[cut] = worst[cut].max(off.abs());
                    // Whoever obeys is brought nearer, whatever was cut.
                    assert!(
                        factor < 1.0 || found.ev < right.ev - 0.4,
                        "{set} h{head}_{camera} x {factor}: {found}"
                    );
                }
            }
        }
        println!("{set}: worst {:.2} EV, where something is saturated {:.2} EV", worst[0], worst[1]);
        assert!(worst[0] < 0.3 && worst[1] < 0.4, "{set}: {worst:?}");
    }
}
