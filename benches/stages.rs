// SPDX-License-Identifier: MIT OR Apache-2.0
//! The stages of reconstruction, one by one, on a body, a board and a ball: `cargo bench --bench stages`.
//!
//! Stages share memory and hand over what they made, so they are not run alone: the whole pipeline runs, and its own clock
//! tells each stage's time to criterion. The light is rendered once and kept in `target/bench-stages`.

use criterion::{BenchmarkId, Criterion, criterion_group, criterion_main};
use fourdbody::base::image::{Mono8, Plane};
use fourdbody::config::Rig;
use fourdbody::data::Calibration;
use fourdbody::reconstruct::pipeline::{Method, Pipeline};
use fourdbody::reconstruct::triangulate::camera_projector::CameraProjector;
use fourdbody::reconstruct::triangulate::triangulator::Triangulator;
use fourdbody_simulator::cache::{CachedImages, Manifest};
use fourdbody_simulator::scenario::Scenario;
use fourdbody_simulator::sequence::{Changes, Run};
use std::collections::BTreeSet;
use std::path::Path;
use std::time::Duration;

/// Name of a scene, and its scenario.
const SCENES: [(&str, &str); 3] =
    [("body", "poses/arms_crossed.toml"), ("board", "turntable.toml"), ("ball", "sphere.toml")];

/// The first photograph of the first head's lower camera.
fn photograph(name: &str, scenario: &str) -> (CameraProjector, Plane<u8>) {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let scenario = Scenario::load(&root.join("config/scenarios").join(scenario)).expect("a valid scenario");
    let mut rig = Rig::load(&scenario.rig).expect("a valid rig");
    rig.heads.truncate(1);
    let dir = root.join("target/bench-stages").join(name);
    let changes = Changes { instants: Some(1), ..Changes::default() };
    Run::new(scenario, &rig, &changes).expect("fits").render(&dir, |_, _| {}).expect("rendered");
    let manifest = Manifest::load(&dir).expect("complete");
    let calibration = Calibration::load(&dir.join("calibration.json")).expect("valid");
    let (head, camera) = calibration.cameras().nth(1).expect("two cameras");
    let images = CachedImages::open(&dir, &manifest, &camera.id).expect("complete");
    let image = images.image(0).expect("an image");
    let image = Plane::from_vec(image.width(), image.height(), image.as_slice().to_vec()).expect("its size");
    (CameraProjector::new(head, camera, &calibration).expect("a usable pair"), image)
}

/// Time of one stage, or of all, over `count` runs.
fn time(pipeline: &Pipeline, image: &Plane<u8>, stage: Option<&str>, count: u64) -> Duration {
    let one = || {
        let stages = pipeline.run(Mono8::from(image)).stages;
        let wanted = stages.iter().filter(|(name, _)| stage.is_none_or(|stage| *name == stage));
        wanted.map(|(_, time)| *time).sum::<Duration>()
    };
    (0..count).map(|_| one()).sum()
}

fn stages(criterion: &mut Criterion) {
    for (name, scenario) in SCENES {
        let (pair, image) = photograph(name, scenario);
        for (suffix, method) in [("", Method::Joint), (" by the paper's method", Method::Paper)] {
            let pipeline = Pipeline::new(Triangulator::new(pair.clone()), method, false);
            let mut group = criterion.benchmark_group(format!("{name}{suffix}"));
            group
                .sample_size(10)
                .warm_up_time(Duration::from_millis(300))
                .measurement_time(Duration::from_secs(2));
            let found: BTreeSet<&str> =
                pipeline.run(Mono8::from(&image)).stages.iter().map(|(stage, _)| *stage).collect();
            for stage in found.into_iter().map(Some).chain([None]) {
                let id = BenchmarkId::from_parameter(stage.unwrap_or("all stages"));
                group.bench_function(id, |bencher| {
                    bencher.iter_custom(|count| time(&pipeline, &image, stage, count));
                });
            }
        }
    }
}

criterion_group!(benches, stages);
criterion_main!(benches);
