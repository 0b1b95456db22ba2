// SPDX-License-Identifier: MIT OR Apache-2.0
//! Two node processes, eight simulated cameras and the simulated HSU: whole sessions over real protocols.

use crate::lab::{capture_whole, fourdbody, laboratory, start_nodes, text_of};
use fourdbody::base::ids::TriggerIndex;
use fourdbody::data::{Frame, FrameSource};
use fourdbody::record::SessionReader;
use fourdbody_simulator::gige::TestImages;

#[test]
fn a_session_of_both_nodes_is_complete_and_every_frame_is_its_own() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = laboratory(dir.path(), 20.0);
    let mut nodes = start_nodes(&laboratory);
    for name in ["first", "second"] {
        let captured = capture_whole(&laboratory, name, 24, &[]);
        assert_eq!(captured.status.code(), Some(0), "{}", text_of(&captured));
        nodes.iter_mut().for_each(|node| drop(node.wait_idle()));

        let session = dir.path().join("sessions").join(name);
        let verified = fourdbody(&["verify", &session.display().to_string()]);
        assert_eq!(verified.status.code(), Some(0), "{}", text_of(&verified));

        let reader = SessionReader::open(&session).expect("readable");
        assert_eq!(reader.cameras().len(), 8);
        assert_eq!(reader.triggers(), 0..24);
        for (number, camera) in (1..).zip(reader.cameras()) {
            for trigger in 0..24 {
                let frame = reader.frame(camera, TriggerIndex(trigger)).expect("intact");
                let Frame::Owned(image) = frame else { panic!("{camera} {trigger}: {frame:?}") };
                let stamp = TestImages::identify(image.as_slice(), image.width()).expect("a test image");
                assert_eq!((stamp.camera, stamp.instant), (number, trigger as u32), "{camera} {trigger}");
            }
        }
    }
}
