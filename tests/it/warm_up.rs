// SPDX-License-Identifier: MIT OR Apache-2.0
//! A camera that is not heard in the warm-up: who captures knows at trigger 0, not at the end.

use crate::lab::{assert_contains, fourdbody, options, small_rig, start_laboratory, start_nodes, text_of};
use fourdbody_simulator::gige::Habits;
use fourdbody_simulator::laboratory::LaboratoryOptions;

/// On node a, where a lost camera ends a session, one camera sleeps for ever.
#[test]
fn a_camera_that_sleeps_through_the_warm_up_is_named_at_once_and_ends_the_session_where_losses_do() {
    const TRIGGERS: u64 = 400;
    let dir = tempfile::tempdir().expect("a temporary directory");
    let asleep = Habits { late_triggers: u32::MAX, ..Habits::default() };
    let options = LaboratoryOptions {
        habits: [("h0_up".to_owned(), asleep)].into(),
        ..options(small_rig(40.0), dir.path())
    };
    let laboratory = start_laboratory(&options);
    let file = &laboratory.nodes[0].path;
    let text = std::fs::read_to_string(file).expect("a node file");
    let aborts = text.replace("[acquisition]\n", "[acquisition]\non_camera_lost = \"abort\"\n");
    std::fs::write(file, aborts).expect("writable");
    let mut nodes = start_nodes(&laboratory);
    let triggers = TRIGGERS.to_string();
    let captured =
        fourdbody(&["capture", "--nodes", &laboratory.urls(), "--triggers", &triggers, "--name", "asleep"]);
    let text = text_of(&captured);
    assert_eq!(captured.status.code(), Some(3), "{text}");
    let named = "camera h0_up: the warm-up is over, and which triggers its frames are of is not known";
    assert_contains(&text, &[named, "no frame has come from it", "warm_up_triggers", "ended early"]);
    let status = nodes[0].wait_idle();
    let session = status.session.expect("the last session");
    assert!(session.triggers < TRIGGERS / 2, "{}", session.triggers);
    assert_eq!(session.notices.len(), 1, "{:?}", session.notices);
    let shown = fourdbody(&["status", "--nodes", &laboratory.urls()]);
    assert_contains(&text_of(&shown), &[named]);
}
