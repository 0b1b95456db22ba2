// SPDX-License-Identifier: MIT OR Apache-2.0
//! Sessions with cameras that are like those of other makes: descriptions and firmware from tables of real ones.

use crate::lab::{capture_whole, options, small_rig, start_laboratory, start_nodes, text_of};
use crate::session_faults::check_frames;
use fourdbody_simulator::gige::Make;
use fourdbody_simulator::laboratory::{Laboratory, LaboratoryOptions};
use std::path::{Path, PathBuf};
use std::process::Output;
use std::sync::Arc;

/// The table of a camera; `None`, with a printed reason, where there are none.
fn table(name: &str) -> Option<PathBuf> {
    let places = ["../shared/data/cameras", "../../shared/data/cameras"];
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let found =
        places.iter().map(|place| root.join(place).join(format!("{name}.json"))).find(|file| file.is_file());
    if found.is_none() {
        println!("skipped: no table of {name} in {}", places[0]);
    }
    found
}

/// The cameras of the shipped rig, in its order.
const CAMERAS: [&str; 8] = ["h0_up", "h0_low", "h1_up", "h1_low", "h2_up", "h2_low", "h3_up", "h3_low"];

fn capture(laboratory: &Laboratory, triggers: u64, name: &str) -> Output {
    capture_whole(laboratory, name, triggers, &[])
}

/// Eight makes in one session, each set as its own list says.
#[test]
fn cameras_of_eight_makes_record_a_session() {
    let makes = [
        "basler_aca1920_25gm",
        "basler_a2a2600_20gmbas",
        "avt_gt1930",
        "flir_bfs_pge_88s6m",
        "pgr_gs3_pge_23s6c",
        "hikrobot",
        "svs_evo4050",
        "tis_dmk_33gx174",
    ];
    let Some(files) = makes.iter().map(|name| table(name)).collect::<Option<Vec<_>>>() else { return };
    let dir = tempfile::tempdir().expect("a temporary directory");
    let like = |file: &PathBuf| Arc::new(Make::load(file).expect("a table"));
    let options = LaboratoryOptions {
        makes: CAMERAS.iter().zip(&files).map(|(camera, file)| ((*camera).to_owned(), like(file))).collect(),
        ..options(small_rig(20.0), dir.path())
    };
    let laboratory = start_laboratory(&options);
    let mut nodes = start_nodes(&laboratory);
    let captured = capture(&laboratory, 20, "makes");
    assert_eq!(captured.status.code(), Some(0), "{}", text_of(&captured));
    nodes.iter_mut().for_each(|node| drop(node.wait_idle()));
    let gaps = check_frames(&dir.path().join("sessions/makes"));
    assert!(gaps.iter().all(Vec::is_empty), "{gaps:?}");
}
