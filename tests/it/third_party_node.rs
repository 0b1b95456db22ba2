//! Our node records from a camera that others made: Aravis' own `arv-fake-gv-camera-0.8`.
//!
//! It has no hardware trigger: it runs freely at 25 Hz, and the HSU at the same rate. The node must explain its
//! frames by their times alone, refuse those before and after the train, and account for the rest.

use crate::lab::{NodeProcess, fourdbody, text_of};
use fourdbody_simulator::hsu::{HsuOptions, SimulatedHsu};
use std::process::{Child, Command, Stdio};

struct FakeCamera(Child);

impl Drop for FakeCamera {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// The shipped rig cut down to one head with one camera of 512 x 512 at 25 Hz.
fn rig() -> String {
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("config/rig.toml");
    let mut rig: toml::Table =
        std::fs::read_to_string(path).expect("in the repository").parse().expect("valid TOML");
    rig.insert("trigger_rate_hz".to_owned(), 25.0.into());
    let heads = rig["head"].as_array_mut().expect("heads");
    heads.truncate(1);
    let cameras = heads[0]["camera"].as_array_mut().expect("cameras");
    cameras.truncate(1);
    for side in ["width", "height"] {
        cameras[0].as_table_mut().expect("a table").insert(side.to_owned(), 512.into());
    }
    toml::to_string(&rig).expect("serializes")
}

const TRIGGERS: u64 = 20;

/// Frames of a session, all of whose triggers have an outcome.
fn capture(url: &str, name: &str) -> u64 {
    let triggers = TRIGGERS.to_string();
    let captured = fourdbody(&["capture", "--nodes", url, "--triggers", &triggers, "--name", name, "--json"]);
    let text = text_of(&captured);
    assert!(matches!(captured.status.code(), Some(0 | 3)), "{text}");
    let json: serde_json::Value = serde_json::from_slice(&captured.stdout).expect("JSON");
    let camera = &json["nodes"][0]["session"]["cameras"][0];
    let (frames, gaps) = (camera["frames"].as_u64().expect("frames"), camera["gaps"].as_u64().expect("gaps"));
    assert_eq!(frames + gaps, TRIGGERS, "{text}");
    frames
}

#[test]
fn our_node_records_from_aravis_own_fake_camera() {
    const PROGRAM: &str = "arv-fake-gv-camera-0.8";
    let started = Command::new(PROGRAM)
        .args(["-i", "127.0.0.1", "-s", "FOURDBODY"])
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn();
    let Ok(child) = started else {
        println!("skipped: {PROGRAM} is not installed (Debian package aravis-tools)");
        return;
    };
    let _camera = FakeCamera(child);
    let dir = tempfile::tempdir().expect("a temporary directory");
    let hsu =
        SimulatedHsu::start(HsuOptions { links: vec![dir.path().join("hsu-a")], ..HsuOptions::default() })
            .expect("a pty");
    std::fs::write(dir.path().join("rig.toml"), rig()).expect("writable");
    let port =
        std::net::TcpListener::bind("127.0.0.1:0").and_then(|l| l.local_addr()).expect("a free port").port();
    let node = format!(
        "format = 1\nnode = \"a\"\nrig = \"rig.toml\"\n[api]\nlisten = \"127.0.0.1:{port}\"\n\
         [hsu]\ndevice = \"{}\"\n[storage]\nsessions_dir = \"sessions\"\nreserve_mib = 1\n\
         [acquisition]\nbuffers_per_camera = 32\npacket_bytes = 1400\nsocket = \"standard\"\nsilence_gate_ms = 0\nsettings = [\n\
         [\"PixelFormat\", \"Mono8\"], [\"Width\", 512], [\"Height\", 512], [\"TriggerMode\", \"Off\"],\n\
         [\"ExposureTimeAbs\", 10000.0]]\n[[camera]]\nid = \"h0_up\"\naddress = \"127.0.0.1\"\n",
        hsu.link(0).display()
    );
    let file = dir.path().join("node.toml");
    std::fs::write(&file, node).expect("writable");
    let mut node = NodeProcess::start(&file, port);
    node.wait_ready();
    let url = node.client.url().to_owned();
    // Its timer and the HSU's stand to each other as they happen to: about half a period apart, no frame can be said to be of
    // one trigger rather than the next, and all are given up. The next session has them elsewhere.
    let mut sessions = (0..5).map(|i| format!("fake-{i}")).map(|name| (capture(&url, &name), name));
    let (frames, name) = sessions
        .find(|(frames, _)| *frames >= TRIGGERS * 3 / 4)
        .expect("one of five sessions with three quarters of the frames");
    let session = dir.path().join("sessions").join(name);
    let verified = fourdbody(&["verify", &session.display().to_string()]);
    assert!(matches!(verified.status.code(), Some(0 | 3)), "{}", text_of(&verified));

    use fourdbody::reconstruct::{Frame, FrameSource};
    let reader = fourdbody::record::SessionReader::open(&session).expect("readable");
    let mut images = 0;
    for trigger in reader.triggers() {
        let id = fourdbody::ids::TriggerIndex(trigger);
        if let Frame::Owned(image) = reader.frame(&"h0_up".into(), id).expect("intact") {
            assert_eq!((image.width(), image.height()), (512, 512));
            assert!(image.as_slice().iter().any(|&pixel| pixel != image.as_slice()[0]), "a test pattern");
            images += 1;
        }
    }
    assert_eq!(images, frames);
}
