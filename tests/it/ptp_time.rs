// SPDX-License-Identifier: MIT OR Apache-2.0
//! Triggers of an HSU on the clock that PTP gives the cameras: by cameras that PTP kept, and by no others.

use crate::lab::{self, assert_contains, fourdbody, text_of};
use fourdbody_simulator::gige::Habits;
use fourdbody_simulator::laboratory::LaboratoryOptions;
use std::collections::BTreeMap;

/// The rig's heads expose so long after the trigger, ns, and stamps are of the begin of the exposure.
const DELAY_NS: i64 = 200_000;

#[test]
fn triggers_have_the_ptp_time_that_witnesses_give_them() {
    let dir = tempfile::tempdir().expect("a directory");
    // PTP is on in all cameras but one, and never sets the clock of another.
    let (off, listens) = ("h0_low", "h2_up");
    let habits = [(listens.to_owned(), Habits { ptp_listens: true, ..Habits::default() })].into();
    let options = lab::options(lab::small_rig(40.0), dir.path());
    let laboratory = lab::start_laboratory(&LaboratoryOptions { habits, ..options });
    for (_, camera) in laboratory.rig.cameras().filter(|(_, camera)| camera.id.as_str() != off) {
        let node = laboratory.nodes.iter().find(|node| node.node == camera.node).expect("its node");
        lab::say(&node.path, camera.id.as_str(), "settings = [[\"PtpEnable\", true]]");
    }
    let _nodes = lab::start_nodes(&laboratory);
    let captured = lab::capture_whole(&laboratory, "ptp", 120, &[]);
    assert!(captured.status.success(), "{}", text_of(&captured));
    let (session, out) = (dir.path().join("sessions/ptp"), dir.path().join("table"));
    let (session, table) = (session.display().to_string(), out.join("timing.csv"));
    let out = out.display().to_string();
    let exported = fourdbody(&["export", &session, "--to", "csv", "--out", &out]);
    // The simulator's grandmaster hands out the time of day, and not TAI.
    assert_contains(&text_of(&exported), &["PTP time by h", "6 cameras agree", "the PTP clock counts UTC"]);

    let table = std::fs::read_to_string(table).expect("a table");
    let mut lines = table.lines().map(|line| line.split(',').collect::<Vec<_>>());
    let header = lines.next().expect("a header");
    let column = |name: &str| header.iter().position(|other| *other == name).expect("a column");
    let number = |row: &Vec<&str>, name: &str| row[column(name)].parse::<i64>().expect("a number");
    let mut triggers: BTreeMap<i64, Vec<Vec<&str>>> = BTreeMap::new();
    for row in lines {
        assert_eq!(row.len(), header.len());
        assert_eq!(row[column("time_code")], "", "there is no time code");
        triggers.entry(number(&row, "trigger")).or_default().push(row);
    }
    assert_eq!(triggers.len(), 120);
    for (trigger, rows) in &triggers {
        let (ptp_ns, open_ns) = (number(&rows[0], "ptp_time_ns"), number(&rows[0], "ptp_open_ns"));
        assert!((1..5_000_000).contains(&open_ns), "{open_ns}");
        let witness = rows[0][column("ptp_camera")];
        assert!(witness != off && witness != listens, "{witness}");
        // Every camera that has the clock agrees with the truth, whoever is asked.
        for row in rows.iter().filter(|row| ![off, listens].contains(&row[1])) {
            assert_eq!(number(row, "ptp_time_ns"), ptp_ns, "all rows of a trigger have the same");
            assert_eq!(row[column("ptp_scale")], "UTC");
            let truth_ns = number(row, "camera_time_ns") - DELAY_NS;
            let off_ns = (ptp_ns - truth_ns).abs();
            assert!(off_ns <= open_ns, "trigger {trigger}: {off_ns} ns off, and {open_ns} ns are open");
        }
    }
}
