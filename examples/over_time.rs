// SPDX-License-Identifier: MIT OR Apache-2.0
//! How much the frame sets before and after could add to a frame: its pixels without a point that had one just before and
//! have one just after.
//!
//! `cargo run --example over_time -- OUT [TRIGGERS]`, where OUT is what `reconstruct` wrote (clouds as PLY).
//!
//! Of each frame but the first and the last: its points; pixels without one that both neighbours have, and those of them
//! whose points before and after lie within 10 mm of each other, so that what moves tells nothing else; and pixels that
//! only one of the neighbours has, which may also be what an outline has left or reached.

use fourdbody::formats::ply;
use std::collections::{BTreeSet, HashMap};
use std::error::Error;
use std::path::Path;

/// Distance of the points before and after within which they say the same, metres.
const SAME_M: f32 = 0.010;

type Points = HashMap<[u16; 2], [f32; 3]>;

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let out = arguments.next().ok_or("expected the folder that `reconstruct` wrote")?;
    let triggers = arguments.next().map_or(Ok(u64::MAX), |n| n.parse())?;
    let clouds = Path::new(&out).join("clouds");
    let mut frames = BTreeSet::new();
    for entry in clouds.read_dir()? {
        let name = entry?.file_name().to_string_lossy().into_owned();
        let Some((camera, index)) = name.strip_suffix(".ply").and_then(|name| name.rsplit_once('_')) else {
            continue;
        };
        let trigger: u64 = index.parse()?;
        if trigger < triggers {
            frames.insert((camera.to_owned(), trigger));
        }
    }
    let load = |(camera, trigger): &(String, u64)| -> Result<Points, Box<dyn Error>> {
        let (_, cloud) = ply::load(&clouds.join(format!("{camera}_{trigger:06}.ply")))?;
        Ok(cloud.pixel.into_iter().zip(cloud.position_m).collect())
    };
    let [mut points, mut both, mut same, mut one] = [0usize; 4];
    let mut window: Vec<(&(String, u64), Points)> = Vec::new();
    for frame in &frames {
        window.retain(|(before, _)| before.0 == frame.0);
        window.push((frame, load(frame)?));
        if window.len() > 3 {
            window.remove(0);
        }
        let [(first, before), (_, own), (last, after)] = &window[..] else { continue };
        if last.1 != first.1 + 2 {
            continue;
        }
        points += own.len();
        for (pixel, a) in before.iter().filter(|(pixel, _)| !own.contains_key(*pixel)) {
            let Some(b) = after.get(pixel) else {
                one += 1;
                continue;
            };
            both += 1;
            let square: f32 = a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum();
            same += usize::from(square < SAME_M * SAME_M);
        }
        one += after.keys().filter(|pixel| !own.contains_key(*pixel) && !before.contains_key(*pixel)).count();
    }
    let share = |n: usize| 100.0 * n as f64 / points.max(1) as f64;
    println!("points {points}");
    println!("missing, there before and after: {both}, {:.3} %", share(both));
    println!("of these within {SAME_M} m of each other: {same}, {:.3} %", share(same));
    println!("missing, there before or after only: {one}, {:.3} %", share(one));
    Ok(())
}
