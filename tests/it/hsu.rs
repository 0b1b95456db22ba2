// SPDX-License-Identifier: MIT OR Apache-2.0
//! The node's HSU link against the simulated unit: real `serialport`, real ptys, the firmware's state machine.
//!
//! Counts and order are asserted, never times. The tests run one after another (see [`alone`]), because one of
//! them counts the process's threads and open ptys.

use crossbeam_channel::{Receiver, unbounded};
use fourdbody::base::ids::{NodeId, SessionName};
use fourdbody::config::Rig;
use fourdbody::hsu::link::Patience;
use fourdbody::hsu::{
    ArmRequest, EndReason, Hsu, HsuError, HsuEvent, HsuTimeouts, HsuTiming, LinkLoss, Refusal, SessionId,
    State, TriggerFlags, session_id,
};
use fourdbody_simulator::hsu::{HsuClock, HsuOptions, LineFaults, SimulatedHsu};
use fourdbody_simulator::wire::TriggerEdge;
use std::path::Path;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};
use tempfile::TempDir;

/// Long enough for any machine; only reached when something is broken.
const FAR: Duration = Duration::from_secs(20);

fn alone() -> MutexGuard<'static, ()> {
    static ONE: Mutex<()> = Mutex::new(());
    ONE.lock().unwrap_or_else(PoisonError::into_inner)
}

struct Bench {
    hsu: SimulatedHsu,
    wires: Vec<Receiver<TriggerEdge>>,
    _dir: TempDir,
}

/// A unit with two links and a camera on each of the rig's four heads.
fn bench_with(line: Option<LineFaults>) -> Bench {
    let dir = TempDir::new().expect("a temporary directory");
    let links = vec![dir.path().join("hsu-a"), dir.path().join("hsu-b")];
    let (cameras, wires) = (0..4)
        .map(|head| {
            let (sender, receiver) = unbounded();
            ((head, sender), receiver)
        })
        .unzip();
    let clock = HsuClock { offset_ns: 5_000_000_000, drift_ppm: 30.0 };
    let options = HsuOptions { links, cameras, clock, line, ..HsuOptions::default() };
    Bench { hsu: SimulatedHsu::start(options).expect("ptys"), wires, _dir: dir }
}

fn bench() -> Bench {
    bench_with(None)
}

fn node(name: &str) -> NodeId {
    NodeId::from(name)
}

/// A process that another test is just starting holds the lock of every open line until its program runs.
fn connect(path: &Path, role: &str) -> Hsu {
    for _ in 0..50 {
        match Hsu::connect(path, &node(role), &HsuTimeouts::default()) {
            Err(e) if e.to_string().contains("exclusive lock") => {
                std::thread::sleep(Duration::from_millis(100))
            }
            link => return link.expect("a unit that answers"),
        }
    }
    panic!("{} stays locked", path.display());
}

fn rig_timing() -> HsuTiming {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/rig.toml");
    HsuTiming::from_rig(&Rig::load(&path).expect("the shipped rig"))
}

/// As the rig, but 1000 triggers a second: for tests of behaviour, not of pace.
fn quick_timing() -> HsuTiming {
    let mut timing = rig_timing();
    timing.period_ns = 1_000_000;
    for (number, head) in (0u64..).zip(&mut timing.heads) {
        (head.delay_ns, head.exposure_ns) = (50_000 * number, 200_000);
    }
    timing
}

fn request(name: &str, triggers: Option<u64>) -> ArmRequest {
    let session = session_id(&SessionName::parse(name).expect("a plain name"));
    ArmRequest { session, triggers, warm_up: 5, nodes: vec![node("a"), node("b")] }
}

fn both_armed(bench: &Bench, timing: &HsuTiming, request: &ArmRequest) -> [Hsu; 2] {
    let hsus = [connect(bench.hsu.link(0), "a"), connect(bench.hsu.link(1), "b")];
    for hsu in &hsus {
        hsu.configure(timing).expect("configured");
        hsu.arm(request).expect("armed");
    }
    let status = hsus[0].wait_armed(request.session, FAR).expect("both have armed");
    assert_eq!((status.state, status.armed_links), (State::Armed, 0b11));
    hsus
}

/// All events up to the end of the train.
fn until_done(hsu: &Hsu) -> (Vec<i64>, u64, EndReason, Vec<HsuEvent>) {
    let (mut numbers, mut others) = (Vec::new(), Vec::new());
    let deadline = Instant::now() + FAR;
    loop {
        match hsu.events().recv_deadline(deadline).expect("the train ends") {
            HsuEvent::Trigger { trigger, .. } => {
                assert_eq!(trigger.flags.contains(TriggerFlags::WARM_UP), trigger.number < 0);
                numbers.push(trigger.number);
            }
            HsuEvent::Done { emitted, reason, .. } => return (numbers, emitted, reason, others),
            HsuEvent::Heartbeat(_) => {}
            other => others.push(other),
        }
    }
}

#[track_caller]
fn refusal<T: std::fmt::Debug>(result: Result<T, HsuError>) -> Refusal {
    match result {
        Err(HsuError::Refused { refusal, .. }) => refusal,
        other => panic!("expected a refusal, found {other:?}"),
    }
}

#[test]
fn handshake_tells_who_the_unit_is() {
    let _alone = alone();
    let bench = bench();
    let hsus = [connect(bench.hsu.link(0), "a"), connect(bench.hsu.link(1), "b")];
    for (hsu, link) in hsus.iter().zip(["A", "B"]) {
        assert_eq!(hsu.identity().unique_id, *b"SIMULATED-000001");
        assert_eq!(hsu.welcome().link.to_string(), link);
        assert_eq!(hsu.status().expect("a status").state, State::Idle);
    }
    hsus[0].configure(&rig_timing()).expect("configured");
}

/// The paper's rate: both nodes and all cameras see the same triggers in the same order, and exactly N.
#[test]
fn exactly_n_triggers_reach_both_links_and_all_cameras() {
    let _alone = alone();
    let bench = bench();
    let request = request("walk-01", Some(120));
    let hsus = both_armed(&bench, &rig_timing(), &request);
    hsus[1].start(request.session).expect("started");
    let expected: Vec<i64> = (-5..120).collect();
    for hsu in &hsus {
        let (numbers, emitted, reason, others) = until_done(hsu);
        assert_eq!(numbers, expected);
        assert_eq!((emitted, reason, others), (120, EndReason::Completed, vec![]));
    }
    assert_eq!(bench.hsu.fired(), 125);
    for (head, wire) in bench.wires.iter().enumerate() {
        let edges: Vec<TriggerEdge> = wire.try_iter().collect();
        assert_eq!(edges.iter().map(|e| e.instant).collect::<Vec<_>>(), expected, "camera on head {head}");
        assert!(edges.iter().all(|e| e.width_ns == 1_000_000));
        assert!(edges.is_sorted_by_key(|e| e.time));
        // Never two edges closer than a camera can follow (7/8 of a period, less rounding).
        let gaps = edges.windows(2).map(|pair| pair[1].time - pair[0].time);
        assert!(gaps.min().is_some_and(|gap| gap >= Duration::from_micros(7250)));
    }
    assert_eq!(bench.hsu.lost_edges(), 0);
    let records = hsus[0].query_triggers(request.session, -5, 125).expect("the unit remembers");
    assert_eq!(records.iter().map(|r| r.number).collect::<Vec<_>>(), expected);
    assert!(records.is_sorted_by_key(|r| r.time_ns));
    assert!(records.last().is_some_and(|r| r.flags.contains(TriggerFlags::LAST)));
}

#[test]
fn nothing_starts_unless_both_links_agree() {
    let _alone = alone();
    let bench = bench();
    let [a, b] = [connect(bench.hsu.link(0), "a"), connect(bench.hsu.link(1), "b")];
    let walk = request("walk-02", Some(10));
    assert_eq!(refusal(a.arm(&walk)), Refusal::NotConfigured);
    a.configure(&quick_timing()).expect("configured");
    assert!(matches!(refusal(b.arm(&walk)), Refusal::TimingDiffers { .. }), "b has configured nothing");
    b.configure(&quick_timing()).expect("configured");
    a.arm(&walk).expect("armed");
    assert_eq!(refusal(a.start(walk.session)), Refusal::NotAllArmed { armed_links: 0b01, expected: 2 });
    assert!(matches!(b.wait_armed(walk.session, Duration::ZERO), Err(HsuError::Late { .. })));
    let other = request("another", Some(10));
    assert!(matches!(refusal(b.arm(&other)), Refusal::SessionDiffers { .. }));
    let longer = ArmRequest { triggers: Some(11), ..walk.clone() };
    assert_eq!(refusal(b.arm(&longer)), Refusal::ArmDiffers { unit: 10, host: 11 });
    let mut slower = quick_timing();
    slower.period_ns *= 2;
    assert_eq!(refusal(b.configure(&slower)), Refusal::Busy(State::Arming));
    assert_eq!(bench.hsu.fired(), 0, "no refused request may fire anything");
    b.arm(&walk).expect("armed");
    assert!(matches!(refusal(b.start(other.session)), Refusal::SessionDiffers { .. }));
    b.start(walk.session).expect("started");
    assert_eq!(until_done(&a).1, 10);
    assert_eq!(refusal(a.arm(&walk)), Refusal::SessionSpent { emitted: 10 });
    assert_eq!(bench.hsu.fired(), 15);
}

#[test]
fn two_plugs_in_one_node_do_not_pass_for_two_nodes() {
    let _alone = alone();
    let bench = bench();
    let hsus = [connect(bench.hsu.link(0), "a"), connect(bench.hsu.link(1), "a")];
    let request = request("swapped", Some(10));
    for hsu in &hsus {
        hsu.configure(&quick_timing()).expect("configured");
        hsu.arm(&request).expect("armed");
    }
    assert!(matches!(refusal(hsus[0].start(request.session)), Refusal::NotAllArmed { .. }));
    assert_eq!(bench.hsu.fired(), 0);
}

#[test]
fn stop_and_disarm_end_a_train_on_both_links() {
    let _alone = alone();
    let bench = bench();
    for (name, reason) in [("free-1", EndReason::Stopped), ("free-2", EndReason::Aborted)] {
        let request = request(name, None);
        let hsus = both_armed(&bench, &quick_timing(), &request);
        let before = bench.hsu.fired();
        hsus[0].start(request.session).expect("started");
        while bench.hsu.fired() < before + 50 {
            std::thread::sleep(Duration::from_millis(1));
        }
        match reason {
            EndReason::Stopped => hsus[1].stop(request.session),
            _ => hsus[1].disarm(request.session),
        }
        .expect("ended");
        let [first, second] = hsus.each_ref().map(until_done);
        assert_eq!(first, second, "both nodes hear the same");
        assert_eq!(first.2, reason);
        assert_eq!(first.0.len() as u64, first.1 + 5);
    }
}

#[test]
fn a_silent_unit_gives_the_no_answer_error() {
    let _alone = alone();
    let bench = bench();
    bench.hsu.set_unresponsive(true);
    let patience = Patience { answer: Duration::from_millis(20), attempts: 3 };
    let timeouts = HsuTimeouts { patience, ..HsuTimeouts::default() };
    let error = Hsu::connect(bench.hsu.link(0), &node("a"), &timeouts).expect_err("nobody answers");
    assert!(matches!(error, HsuError::NoAnswer { attempts: 3, .. }), "{error}");
    assert!(error.to_string().contains("check its power"), "{error}");
    bench.hsu.set_unresponsive(false);
    connect(bench.hsu.link(0), "a").status().expect("the same device answers later");
    let missing = Hsu::connect(&bench.hsu.link(0).with_file_name("nothing"), &node("a"), &timeouts);
    assert!(matches!(missing, Err(HsuError::Open { .. })));
}

/// What the host notices by itself while nobody asks anything.
#[test]
fn a_unit_that_hangs_or_restarts_is_noticed() {
    let _alone = alone();
    let bench = bench();
    let patience = Patience { answer: Duration::from_millis(50), attempts: 2 };
    let timeouts = HsuTimeouts { patience, heartbeat: Duration::from_millis(50) };
    let hsu = Hsu::connect(bench.hsu.link(0), &node("a"), &timeouts).expect("connected");
    let next = || {
        let deadline = Instant::now() + FAR;
        loop {
            match hsu.events().recv_deadline(deadline).expect("an event") {
                HsuEvent::Heartbeat(_) => {}
                other => return other,
            }
        }
    };
    bench.hsu.set_unresponsive(true);
    assert_eq!(next(), HsuEvent::LinkLost(LinkLoss::Silent));
    bench.hsu.set_unresponsive(false);
    assert_eq!(next(), HsuEvent::LinkBack);
    bench.hsu.power_cycle();
    assert_eq!(next(), HsuEvent::LinkLost(LinkLoss::Restarted));
    assert_eq!(refusal(hsu.status()), Refusal::HelloFirst);
    drop(hsu);
    let again = connect(bench.hsu.link(0), "a");
    assert_eq!(again.status().expect("a status").state, State::Idle);
}

#[test]
fn a_host_that_comes_back_during_a_train_can_fetch_what_it_missed() {
    let _alone = alone();
    let bench = bench();
    let request = request("crash", Some(200));
    let [a, b] = both_armed(&bench, &quick_timing(), &request);
    a.start(request.session).expect("started");
    drop(a);
    let (numbers, emitted, ..) = until_done(&b);
    assert_eq!((numbers.len(), emitted), (205, 200), "the train goes on for the other node");
    let back = connect(bench.hsu.link(0), "a");
    let status = back.status().expect("a status");
    assert_eq!((status.session, status.emitted, status.end), (request.session, 200, EndReason::Completed));
    let records = back.query_triggers(request.session, -5, 205).expect("the unit remembers");
    assert_eq!(records.len(), 205);
}

/// One bit in about 125 bytes is wrong: commands are repeated, lost telemetry is fetched again.
#[test]
fn noise_on_the_line_costs_nothing() {
    let _alone = alone();
    let bench = bench_with(Some(LineFaults { flips_per_million: 1000, seed: 3, ..LineFaults::default() }));
    let patience = Patience { answer: Duration::from_millis(100), attempts: 20 };
    let timeouts = HsuTimeouts { patience, ..HsuTimeouts::default() };
    let connect = |link, role| Hsu::connect(bench.hsu.link(link), &node(role), &timeouts).expect("connected");
    let hsus = [connect(0, "a"), connect(1, "b")];
    let request = request("noise", Some(300));
    let mut timing = quick_timing();
    timing.period_ns = 5_000_000;
    for hsu in &hsus {
        hsu.configure(&timing).expect("configured");
        hsu.arm(&request).expect("armed");
    }
    hsus[0].start(request.session).expect("started");
    for hsu in &hsus {
        let (numbers, emitted, _, others) = until_done(hsu);
        assert_eq!((emitted, others), (300, vec![]));
        assert_eq!(numbers, (-5..300).collect::<Vec<_>>());
    }
    assert!(hsus.iter().any(|hsu| hsu.bad_frames() > 0), "the noise must have hit something");
}

#[test]
fn clock_samples_grow_between_their_instants() {
    let _alone = alone();
    let bench = bench();
    let hsu = connect(bench.hsu.link(1), "b");
    let samples: Vec<_> = (0..20).map(|_| hsu.query_clock().expect("an answer")).collect();
    for pair in samples.windows(2) {
        let hsu_ns = pair[1].time_ns.checked_sub(pair[0].time_ns).expect("the clock does not run backwards");
        let least = pair[1].sent.saturating_duration_since(pair[0].received).as_nanos() as f64;
        let most = (pair[1].received - pair[0].sent).as_nanos() as f64;
        assert!((least * 0.999..=most * 1.001 + 1.0).contains(&(hsu_ns as f64)));
    }
}

fn own_threads_and_ptys() -> (usize, usize) {
    let entries = |dir: &str| std::fs::read_dir(dir).expect("Linux").flatten().collect::<Vec<_>>();
    let is_ours = |comm: String| comm.starts_with("hsu-") || comm.starts_with("sim-hsu");
    let threads = entries("/proc/self/task")
        .iter()
        .filter_map(|task| std::fs::read_to_string(task.path().join("comm")).ok())
        .filter(|comm| is_ours(comm.clone()))
        .count();
    let ptys = entries("/proc/self/fd")
        .iter()
        .filter_map(|fd| std::fs::read_link(fd.path()).ok())
        .filter(|target| target.starts_with("/dev/pts") || target.ends_with("ptmx"))
        .count();
    (threads, ptys)
}

/// Whether this is a process that runs the named test only. If not, one is started, and must succeed: other tests
/// of this program have HSUs, too.
fn in_a_process_of_its_own(test: &str) -> bool {
    const MARK: &str = "FOURDBODY_TEST_OF_ITS_OWN";
    if std::env::var_os(MARK).is_some() {
        return true;
    }
    let program = std::env::current_exe().expect("this program");
    let output = std::process::Command::new(program).args(["--exact", test]).env(MARK, "1").output();
    let output = output.expect("this program starts");
    let said = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success() && said.contains("1 passed"), "{said}");
    false
}

#[test]
fn two_hundred_sessions_in_a_row_leak_nothing() {
    if !in_a_process_of_its_own("hsu::two_hundred_sessions_in_a_row_leak_nothing") {
        return;
    }
    let outside = own_threads_and_ptys();
    let bench = bench();
    let mut used = None;
    for number in 0..200u64 {
        let request = request(&format!("series-{number}"), Some(number % 7 + 1));
        let hsus = both_armed(&bench, &quick_timing(), &request);
        hsus[(number % 2) as usize].start(request.session).expect("started");
        for hsu in &hsus {
            let (numbers, emitted, reason, others) = until_done(hsu);
            assert_eq!((emitted, reason, others), (number % 7 + 1, EndReason::Completed, vec![]));
            assert_eq!(numbers.len() as u64, emitted + 5);
        }
        let now = own_threads_and_ptys();
        assert_eq!(*used.get_or_insert(now), now, "after session {number}");
    }
    for wire in &bench.wires {
        assert_eq!(wire.try_iter().count() as u64, bench.hsu.fired());
    }
    drop(bench);
    assert_eq!(own_threads_and_ptys(), outside);
}

#[test]
fn session_ids_are_the_same_on_every_node() {
    let name = SessionName::parse("walk-01").expect("a plain name");
    // printf walk-01 | sha256sum | head -c 32
    let expected =
        [0x69, 0xb5, 0x93, 0x42, 0xb1, 0x0d, 0xc1, 0x96, 0xac, 0x3b, 0xac, 0x0a, 0xde, 0x39, 0x4a, 0x56];
    assert_eq!(session_id(&name), SessionId(expected));
}

/// A measurement, not a test: how evenly the simulated unit fires on this machine.
#[test]
#[ignore = "half a minute, prints figures and judges none: cargo test --release --test it hsu::pace -- --ignored --nocapture"]
fn pace_at_120_hz() {
    let _alone = alone();
    let bench = bench();
    let request = request("pace", Some(3600));
    let hsus = both_armed(&bench, &rig_timing(), &request);
    hsus[0].start(request.session).expect("started");
    let (mut times, mut done) = (Vec::new(), false);
    while !done {
        match hsus[0].events().recv_timeout(FAR).expect("the train ends") {
            HsuEvent::Trigger { trigger, .. } => times.push(trigger.time_ns),
            HsuEvent::Done { .. } => done = true,
            _ => {}
        }
    }
    let mut off_us: Vec<f64> =
        times.windows(2).map(|pair| ((pair[1] - pair[0]) as f64 - 8_333_333.0).abs() / 1e3).collect();
    off_us.sort_by(f64::total_cmp);
    let share = |part: f64| off_us[(part * (off_us.len() - 1) as f64) as usize];
    println!("triggers {} of 3605, late {}", times.len(), bench.hsu.late());
    println!("period error us: p50 {:.1} p99 {:.1} max {:.1}", share(0.5), share(0.99), share(1.0));
    let samples: Vec<_> = (0..200).filter_map(|_| hsus[1].query_clock().ok()).collect();
    let mut way_us: Vec<f64> = samples.iter().map(|s| (s.received - s.sent).as_secs_f64() * 1e6).collect();
    way_us.sort_by(f64::total_cmp);
    println!("clock query there and back us: best {:.0} median {:.0}", way_us[0], way_us[way_us.len() / 2]);
}
