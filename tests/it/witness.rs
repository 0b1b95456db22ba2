// SPDX-License-Identifier: MIT OR Apache-2.0
//! The light as a witness of the trigger (docs/design/reconstruction.md): balls that move, as all cameras see them by direct formula, and a
//! camera whose clouds are those of other triggers.

use crate::back_end::calibration;
use fourdbody::batch::run::{Format, Plan};
use fourdbody::batch::strangers;
use fourdbody::batch::summary::Summary;
use fourdbody::batch::witness::{
    Evidence, Sketch, Sketches, Strangers, evidence_on, strangers as find, suspects,
};
use fourdbody::data::{Calibration, Cloud};
use fourdbody::formats::ply;
use fourdbody::geometry::Device;
use nalgebra::{Point3, Vector3};
use serde_json::json;
use std::collections::BTreeMap;
use std::path::Path;

const RADIUS_M: f64 = 0.2;
const TRIGGERS: u64 = 8;

/// One point in a few pixels of a ball about this place.
fn ball(device: &Device, centre: Point3<f64>) -> Cloud {
    let mut cloud = Cloud::default();
    for (u, v) in
        (0..device.width).step_by(7).flat_map(|u| (0..device.height).step_by(7).map(move |v| (u, v)))
    {
        let Some(ray) = device.ray(u as f64, v as f64) else { continue };
        let to = centre - ray.origin;
        let along = to.dot(&ray.direction);
        let half = RADIUS_M * RADIUS_M - (to.norm_squared() - along * along);
        if half > 0.0 {
            let at = ray.at(along - half.sqrt());
            cloud.position_m.push(at.cast::<f32>().into());
            cloud.normal.push(((at - centre) / RADIUS_M).cast::<f32>().into());
            cloud.intensity.push(0.5);
            cloud.pixel.push([u as u16, v as u16]);
        }
    }
    cloud
}

/// Where the ball is at a trigger when it moves so far between two, m; it turns round.
fn place(trigger: u64, step_m: f64) -> Point3<f64> {
    let along = (trigger as f64 * 0.9).sin() * step_m / 0.9;
    Point3::new(0.02, -0.03, 1.0) + Vector3::new(0.8, 0.5, 0.33).normalize() * along
}

/// The clouds of all cameras: `shown` says what trigger a camera's frame shows.
fn clouds(
    calibration: &Calibration,
    step_m: f64,
    shown: &dyn Fn(usize, u64) -> u64,
) -> BTreeMap<u64, Vec<Cloud>> {
    let of = |trigger: u64| {
        let cameras = calibration.cameras().enumerate();
        cameras.map(|(i, (_, camera))| ball(&camera.device, place(shown(i, trigger), step_m))).collect()
    };
    (0..TRIGGERS).map(|trigger| (trigger, of(trigger))).collect()
}

fn said(calibration: &Calibration, clouds: &BTreeMap<u64, Vec<Cloud>>) -> BTreeMap<(u64, usize), Evidence> {
    let sketch = |(cloud, (_, camera)): (&Cloud, (_, &fourdbody::data::CalibratedCamera))| {
        (!cloud.is_empty()).then(|| Sketch::new(cloud, &camera.device))
    };
    let sketches =
        |clouds: &Vec<Cloud>| -> Sketches { clouds.iter().zip(calibration.cameras()).map(sketch).collect() };
    let sketches: BTreeMap<u64, Sketches> =
        clouds.iter().map(|(trigger, clouds)| (*trigger, sketches(clouds))).collect();
    let frames = clouds.keys().flat_map(|trigger| (0..8).map(move |camera| (*trigger, camera)));
    let of = |frame: (u64, usize)| Some((frame, evidence_on(calibration, &sketches, frame.0, frame.1)?));
    frames.filter_map(of).collect()
}

fn found(calibration: &Calibration, clouds: &BTreeMap<u64, Vec<Cloud>>) -> Strangers {
    find(calibration, &mut said(calibration, clouds))
}

#[test]
fn a_frame_of_another_trigger_is_known_by_what_moves_and_no_other_is() {
    let calibration = calibration();
    let judged = |step_mm: f64, shown: &dyn Fn(usize, u64) -> u64| {
        let found = found(&calibration, &clouds(&calibration, step_mm / 1e3, shown));
        found.into_iter().map(|((trigger, camera), shown)| (camera, trigger, shown)).collect::<Vec<_>>()
    };
    let nothing: Vec<(usize, u64, u64)> = Vec::new();
    for step_mm in [0.0, 1.0, 3.0, 8.0, 20.0] {
        assert_eq!(judged(step_mm, &|_, trigger| trigger), nothing, "honest, {step_mm} mm a trigger");
    }
    let one = |camera: usize, trigger: u64| if (camera, trigger) == (5, 4) { 3 } else { trigger };
    assert_eq!(judged(0.0, &one), nothing, "of what stands still nothing is known");
    assert_eq!(judged(1.0, &one), nothing, "nor of what hardly moves");
    assert_eq!(judged(8.0, &one), [(5, 4, 3)]);
    let by_two = |camera: usize, trigger: u64| if (camera, trigger) == (2, 3) { 5 } else { trigger };
    assert_eq!(judged(8.0, &by_two), [(2, 3, 5)]);
    // For a while, and for good: each frame of which its trigger can be known.
    let run = |camera: usize, trigger: u64| {
        if camera == 7 && (2..6).contains(&trigger) { trigger - 1 } else { trigger }
    };
    let found = judged(8.0, &run);
    assert!(
        found.len() >= 3 && found.iter().all(|(c, t, s)| *c == 7 && (2..6).contains(t) && s + 1 == *t),
        "{found:?}"
    );
    let for_good =
        |camera: usize, trigger: u64| if camera == 0 { trigger.saturating_sub(1) } else { trigger };
    let found = judged(8.0, &for_good);
    assert!(found.len() >= 4 && found.iter().all(|(c, t, s)| *c == 0 && s + 1 == *t), "{found:?}");
    // Both cameras of a head agree with each other: nobody knows who is wrong.
    let head = |camera: usize, trigger: u64| if camera < 2 && trigger == 4 { 3 } else { trigger };
    assert_eq!(judged(8.0, &head), nothing);
}

#[test]
fn a_view_that_is_covered_is_no_frame_of_another_trigger() {
    let calibration = calibration();
    let mut clouds = clouds(&calibration, 8e-3, &|_, trigger| trigger);
    // A hand before one camera, at one trigger: nothing that any other camera sees at any trigger.
    let device = calibration.cameras().nth(3).expect("eight cameras").1.device.clone();
    let centre = device.centre();
    let hand = centre + (Point3::new(0.0, 0.0, 1.0) - centre) * 0.75;
    clouds.get_mut(&4).expect("a trigger")[3] = ball(&device, hand);
    assert_eq!(found(&calibration, &clouds), Strangers::new());
    // Nor are those of two cameras alone, one of which is wrong: it is named, and nothing is refused.
    let mut two: BTreeMap<u64, Vec<Cloud>> =
        self::clouds(&calibration, 8e-3, &|c, t| if (c, t) == (1, 4) { 3 } else { t });
    two.values_mut().flat_map(|clouds| &mut clouds[2..]).for_each(|cloud| *cloud = Cloud::default());
    let mut said = said(&calibration, &two);
    assert_eq!(find(&calibration, &mut said), Strangers::new());
    let suspects: Vec<(u64, usize)> = suspects(&calibration, &said).into_keys().collect();
    assert!(suspects.contains(&(4, 1)), "{suspects:?}");
}

/// Files of a run as it leaves them, a summary with them.
fn write(out: &Path, calibration: &Calibration, all: &BTreeMap<u64, Vec<Cloud>>) -> Summary {
    for folder in ["clouds", "merged"] {
        std::fs::create_dir_all(out.join(folder)).expect("writable");
    }
    let names: Vec<String> = calibration.cameras().map(|(_, camera)| camera.id.to_string()).collect();
    let numbers: Vec<String> = names.iter().enumerate().map(|(i, name)| format!("{i}={name}")).collect();
    let mut triggers = Vec::new();
    for (trigger, clouds) in all {
        let mut merged = Cloud::default();
        let mut frames = Vec::new();
        for ((number, name), cloud) in (0u8..).zip(&names).zip(clouds) {
            let path = out.join(format!("clouds/{name}_{trigger:06}.ply"));
            ply::save(&path, cloud, &[format!("trigger {trigger}"), format!("camera {name}")])
                .expect("writable");
            merged.merge(cloud, number);
            frames.push(
                json!({ "camera": name, "outcome": "cloud", "points": cloud.len(), "unresolved_px": 0 }),
            );
        }
        let comments = [format!("trigger {trigger}"), format!("cameras {}", numbers.join(" "))];
        ply::save(&out.join(format!("merged/{trigger:06}.ply")), &merged, &comments).expect("writable");
        triggers.push(json!({ "trigger": trigger, "merged_points": merged.len(), "frames": frames }));
    }
    let count = 8 * all.len();
    let summary = json!({
        "session": { "id": "1", "cameras": [] }, "algorithm": 1, "parameters": "p", "method": "joint", "frames": count, "clouds": count,
        "refused": 0, "gaps": 0, "damaged": 0, "merged_points": 0, "triggers": triggers
    });
    serde_json::from_value(summary).expect("a summary")
}

#[test]
fn a_frame_of_another_trigger_is_refused_in_files_and_summary_whatever_the_threads_and_as_often_as_it_is_looked_for()
 {
    let calibration = calibration();
    let shown = |camera: usize, trigger: u64| if (camera, trigger) == (5, 4) { 3 } else { trigger };
    let all = clouds(&calibration, 8e-3, &shown);
    let bytes = |out: &Path| {
        let read = |folder: &str| out.join(folder).read_dir().expect("a directory");
        let files =
            ["clouds", "merged"].into_iter().flat_map(read).map(|entry| entry.expect("an entry").path());
        let read = |path: std::path::PathBuf| (path.clone(), std::fs::read(&path).expect("readable"));
        files
            .map(read)
            .map(|(path, bytes)| (path.strip_prefix(out).expect("below").to_owned(), bytes))
            .collect()
    };
    let mut of_threads: Vec<(BTreeMap<_, Vec<u8>>, Summary)> = Vec::new();
    for threads in [1, 3] {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let mut summary = write(dir.path(), &calibration, &all);
        let plan = Plan { out: dir.path().to_owned(), formats: vec![Format::Ply], ..Plan::default() };
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
        let judge = |summary: &mut Summary| {
            pool.install(|| strangers::refuse(&plan, &calibration, summary, |_, _| ()))
        };
        judge(&mut summary).expect("readable");
        let before = (bytes(dir.path()), summary.clone());
        judge(&mut summary).expect("readable");
        assert!(before == (bytes(dir.path()), summary.clone()), "once more nothing changes");
        of_threads.push((before.0, summary));
    }
    assert!(of_threads[0] == of_threads[1]);
    let (files, summary) = &of_threads[0];
    assert_eq!((summary.clouds, summary.refused), (8 * all.len() - 1, 1));
    let camera = calibration.cameras().nth(5).expect("eight cameras").1.id.clone();
    let refused: Vec<_> = summary
        .triggers
        .iter()
        .flat_map(|one| one.frames.iter().map(move |frame| (one.trigger, frame)))
        .collect();
    let refused: Vec<_> = refused.into_iter().filter(|(_, frame)| frame.outcome == "refused").collect();
    let [(4, frame)] = refused[..] else { panic!("{refused:?}") };
    let reason = frame.reason.as_ref().expect("a reason");
    assert!(
        frame.camera == camera && frame.points == 0 && reason.starts_with("it shows trigger 3, not 4"),
        "{frame:?}"
    );
    // As a refused frame leaves it: no point, and the reason; the merged cloud is that of the others.
    let text = |name: String| String::from_utf8_lossy(&files[Path::new(&name)]).into_owned();
    let file = text(format!("clouds/{camera}_000004.ply"));
    assert!(
        file.contains("element vertex 0") && file.contains(&format!("comment refused {reason}")),
        "{file}"
    );
    let points: usize =
        all[&4].iter().enumerate().filter(|(i, _)| *i != 5).map(|(_, cloud)| cloud.len()).sum();
    assert_eq!(summary.triggers[4].merged_points, Some(points));
    assert!(text("merged/000004.ply".to_owned()).contains(&format!("element vertex {points}")));
}
