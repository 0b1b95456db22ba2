// SPDX-License-Identifier: MIT OR Apache-2.0
//! A new bench: from an empty node file to a verified session of four unlike cameras, by `fourdbody cameras setup` alone.

use crate::lab::{self, NodeProcess, assert_contains, fourdbody, host, options, rig_of, start, text_of};
use crate::matrix::judge;
use crate::profiles::tables;
use fourdbody::base::image::read_png_grey;
use fourdbody::camera::AravisCameras;
use fourdbody::config::NodeConfig;
use fourdbody::data::FrameSource;
use fourdbody::new_bench::{Given, Known, Operator, Options, set_up};
use fourdbody::record::SessionReader;
use fourdbody_simulator::gige::{Habits, Make, StampPoint, TestImages};
use fourdbody_simulator::images::ImageSource;
use fourdbody_simulator::laboratory::{Laboratory, LaboratoryOptions};
use serde_json::Value;
use std::path::Path;
use std::process::Output;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

/// Narrower sensors are not what any table allows.
const SIZE: (usize, usize) = (640, 400);

/// The first two heads of the shipped rig, all on one node.
fn rig() -> String {
    let text = rig_of(20.0, SIZE);
    let parts: Vec<&str> = text.split("\n[[head]]\n").collect();
    parts[..3].join("\n[[head]]\n")
}

/// Cameras of four makes on two heads, the last one with an address that nobody reaches, none with a name.
fn bench(dir: &Path, tables: &Path) -> Laboratory {
    let load = |name: &str| Make::load(&tables.join(format!("{name}.json"))).expect("a table");
    let makes = [
        ("h0_up", load("basler_aca1920_25gm").wired_to("Line1")),
        ("h0_low", load("flir_bfs_pge_88s6m").wired_to("Line2")),
        ("h1_up", load("avt_mako_g507b").wired_to("Line1")),
        ("h1_low", load("hikrobot").left_over("TriggerMode", "On")),
    ];
    let late =
        Habits { send_late: Duration::from_millis(27), stamp: StampPoint::LeaderSent, ..Habits::default() };
    let options = LaboratoryOptions {
        makes: makes
            .into_iter()
            .map(|(id, make)| (id.to_owned(), Arc::new(make.expect("its lines"))))
            .collect(),
        habits: [
            ("h0_low".to_owned(), late),
            ("h1_low".to_owned(), Habits { link_local: true, ..Habits::default() }),
        ]
        .into(),
        make_words: false,
        user_names: false,
        ..options(rig(), dir)
    };
    start(&options, SIZE)
}

fn setup(dir: &Path, laboratory: &Laboratory, more: &[&str]) -> Output {
    let at = |name: &str| dir.join(name).display().to_string();
    let (config, hsu, sessions) = (at("bench.toml"), at("hsu-a"), at("sessions"));
    let network = format!("{}/24", host(laboratory.cameras[0].address(), 0));
    let first = ["cameras", "setup", "--config", &config, "--hsu", &hsu, "--sessions", &sessions];
    fourdbody(&[&first, &["--network", &network][..], more].concat())
}

/// Takes some 15 s: pulses are slow.
#[test]
fn an_empty_node_file_becomes_a_verified_session_of_four_unlike_cameras() {
    let Some(tables) = tables() else { return };
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = bench(dir.path(), &tables);
    let file = dir.path().join("bench.toml");
    std::fs::write(&file, "").expect("writable");
    // Nobody is there to be asked: what is to be said is told, and nothing is changed.
    let [.., net, own] = laboratory.cameras[3].address().octets();
    let last = &format!("--camera=h1_low=02:00:7f:00:{net:02x}:{own:02x}");
    let asked = setup(dir.path(), &laboratory, &[last]);
    assert_eq!(asked.status.code(), Some(2), "{}", text_of(&asked));
    assert_contains(&text_of(&asked), &["h0_up", "--in-order"]);
    let asked = setup(dir.path(), &laboratory, &[last, "--in-order"]);
    assert_eq!(asked.status.code(), Some(2), "{}", text_of(&asked));
    assert_contains(&text_of(&asked), &["wrong subnet", "--yes"]);
    assert_eq!(std::fs::read_to_string(&file).expect("readable"), "");

    let port =
        std::net::TcpListener::bind("127.0.0.1:0").expect("a port").local_addr().expect("its number").port();
    let listen = format!("--listen=127.0.0.1:{port}");
    let done = setup(dir.path(), &laboratory, &[last, "--in-order", "--yes", "--json", &listen]);
    assert_eq!(done.status.code(), Some(0), "{}", text_of(&done));
    let text = std::fs::read_to_string(&file).expect("readable");
    println!("{}\n{text}", text_of(&done));
    let outcome: Value = serde_json::from_slice(&done.stdout).expect("JSON");
    let of = |key: &str| -> Vec<Value> {
        outcome["cameras"].as_array().expect("cameras").iter().map(|camera| camera[key].clone()).collect()
    };
    assert_eq!(of("id"), ["h0_up", "h0_low", "h1_up", "h1_low"]);
    assert_eq!(of("trigger_line"), ["Line1", "Line2", "Line1", "Line0"]);
    assert_eq!(of("head"), [0, 0, 1, 1]);
    assert_eq!(of("named"), ["in_order", "in_order", "by_pulse", "said"]);
    let delays = |key: &str| of(key).iter().map(|us| us.as_f64().unwrap_or(f64::NAN)).collect::<Vec<f64>>();
    let (stamps, arrivals) = (delays("stamp_us"), delays("arrival_us"));
    // The one that stamps its leader, 27 ms after the exposure, is told from the others.
    assert!(stamps[1] > 20_000.0 && arrivals[1] > 20_000.0, "{stamps:?} {arrivals:?}");
    assert!(stamps[0] < 20_000.0, "{stamps:?}");
    for picture in of("picture") {
        let image = read_png_grey(Path::new(picture.as_str().expect("a path"))).expect("a picture");
        assert_eq!((image.width(), image.height()), SIZE);
    }
    assert_eq!(outcome["cameras"][3]["device"]["place"], format!("127.0.{net}.1"), "its new address");

    let mut node = NodeProcess::start(&file, port);
    node.wait_ready();
    let url = format!("http://127.0.0.1:{port}");
    let captured = fourdbody(&["capture", "--nodes", &url, "--triggers", "16", "--name", "first"]);
    assert!(matches!(captured.status.code(), Some(0 | 3)), "{}", text_of(&captured));
    node.wait_idle();
    let session = dir.path().join("sessions/first");
    let verified = fourdbody(&["verify", &session.display().to_string()]);
    assert_eq!(verified.status.code(), captured.status.code(), "{}", text_of(&verified));
    let reader = SessionReader::open(&session).expect("readable");
    assert_eq!(reader.cameras().len(), 4);
    for (number, camera) in (1..).zip(reader.cameras()) {
        let (wrong, gaps) = judge(&reader, camera, number, SIZE);
        assert_eq!(wrong, None, "{camera}");
        // A thread of the simulator stamps the leader as it sends it: on a busy host that is so late now and then that nothing
        // shows whose trigger it was.
        let stamps_leader = camera.as_str() == "h0_low";
        let unknown = gaps.iter().filter(|gap| gap.contains("identity_mismatch")).count();
        assert!(gaps.len() == unknown && unknown <= 2 * usize::from(stamps_leader), "{camera}: {gaps:?}");
    }
    drop(laboratory);
}

/// Test images behind a lens that can be covered.
struct Lens {
    images: TestImages,
    dark: Vec<u8>,
    covered: AtomicBool,
}

impl ImageSource for Lens {
    fn size(&self) -> (usize, usize) {
        self.images.size()
    }

    fn pixels(&self, instant: i64) -> &[u8] {
        match self.covered.load(Ordering::Relaxed) {
            true => &self.dark,
            false => self.images.pixels(instant),
        }
    }
}

/// Somebody who covers lenses: those of the names that he is asked for are the other way round than serial numbers.
struct Hands {
    lenses: Vec<Arc<Lens>>,
    asked: Vec<String>,
}

impl Operator for Hands {
    fn tell(&mut self, line: &str) {
        println!("{line}");
    }

    fn agrees(&mut self, _: &str) -> bool {
        false
    }

    fn does(&mut self, what: &str) -> bool {
        self.asked.push(what.to_owned());
        let second = usize::from(what.ends_with("h0_up"));
        // The first time he covers none.
        for (number, lens) in self.lenses.iter().enumerate() {
            lens.covered.store(number == second && self.asked.len() > 1, Ordering::Relaxed);
        }
        // Who is asked for ever leaves.
        self.asked.len() < 6
    }

    fn is_there(&self) -> bool {
        true
    }
}

/// One head of two cameras: one is held by another program, and what is known of both is written.
#[test]
fn a_camera_that_is_held_ends_nothing_for_the_others() {
    use fourdbody::camera::CameraBackend;
    let dir = tempfile::tempdir().expect("a temporary directory");
    let text = rig_of(20.0, lab::SIZE);
    let one_head = text.split("\n[[head]]\n").take(2).collect::<Vec<_>>().join("\n[[head]]\n");
    let laboratory = lab::start_laboratory(&options(one_head, dir.path()));
    let places: Vec<String> = laboratory.cameras.iter().map(|camera| camera.address().to_string()).collect();
    let held = AravisCameras.open(&places[0]).expect("the other program opens it first");
    let file = dir.path().join("bench.toml");
    std::fs::write(&file, "").expect("writable");
    let done = setup(dir.path(), &laboratory, &["--json"]);
    assert_eq!(done.status.code(), Some(5), "{}", text_of(&done));
    assert_contains(
        &text_of(&done),
        &["camera h0_up", "controlled by another program on 127.", "1 problems"],
    );
    let outcome: Value = serde_json::from_slice(&done.stdout).expect("JSON");
    let of = |place: usize, key: &str| outcome["cameras"][place][key].clone();
    assert_eq!((of(0, "id"), of(1, "id")), ("h0_up".into(), "h0_low".into()), "in the rig's order");
    assert_eq!((of(0, "trigger_line"), of(1, "trigger_line")), (Value::Null, "Line0".into()));
    let config = NodeConfig::load(&file).expect("a whole file");
    let addresses: Vec<&str> = config.cameras.iter().map(|camera| camera.address.as_str()).collect();
    assert_eq!(addresses, places);
    assert_eq!(config.cameras[1].words.trigger_line.as_deref(), Some("Line0"));
    assert_contains(&std::fs::read_to_string(&file).expect("readable"), &["not measured"]);
    // When it is free, the same command does the rest.
    drop(held);
    let done = setup(dir.path(), &laboratory, &[]);
    assert_eq!(done.status.code(), Some(0), "{}", text_of(&done));
    let text = std::fs::read_to_string(&file).expect("readable");
    assert!(!text.contains("not measured"), "{text}");
    drop(laboratory);
}

/// This test takes some ten seconds.
#[test]
fn two_cameras_of_a_head_are_told_apart_by_a_covered_lens() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let text = rig_of(20.0, lab::SIZE);
    let one_head = text.split("\n[[head]]\n").take(2).collect::<Vec<_>>().join("\n[[head]]\n");
    let options = LaboratoryOptions { user_names: false, ..options(one_head, dir.path()) };
    let mut lenses = Vec::new();
    let (width, height) = lab::SIZE;
    let laboratory = Laboratory::start(&options, |_| {
        let images = TestImages::new(width, height, 1, TestImages::DISTINCT);
        let lens = Arc::new(Lens { images, dark: vec![2; width * height], covered: AtomicBool::new(false) });
        lenses.push(Arc::clone(&lens));
        lens as _
    })
    .expect("the laboratory starts");
    let file = dir.path().join("bench.toml");
    let given = Given {
        hsu: Some(laboratory.hsu.link(0).to_owned()),
        sessions: Some("sessions".into()),
        ..Given::default()
    };
    let network = Some(format!("{}/24", host(options.first_address, 0)).parse().expect("a network"));
    let setup = Options { path: file.clone(), given, claims: Vec::new(), in_order: false, network };
    let mut hands = Hands { lenses, asked: Vec::new() };
    let outcome = set_up(&setup, &mut AravisCameras, &mut hands).expect("set up");
    assert_eq!(outcome.problems, [""; 0]);
    let named: Vec<(&str, &str)> =
        outcome.cameras.iter().map(|camera| (camera.id.as_str(), camera.device.place.as_str())).collect();
    let [upper, lower] = [12, 11].map(|number| host(options.first_address, number).to_string());
    assert_eq!(named, [("h0_up", upper.as_str()), ("h0_low", lower.as_str())]);
    let known: Vec<Known> = outcome.cameras.iter().map(|camera| camera.named).collect();
    assert_eq!(known, [Known::Covered, Known::ByPulse], "the last one needs no cover");
    assert_eq!(hands.asked, ["cover the lens of h0_up"; 2], "asked again while none is dark");
    let config = NodeConfig::load(&file).expect("a whole file");
    assert_eq!(config.cameras[0].words.trigger_line.as_deref(), Some("Line0"));
}
