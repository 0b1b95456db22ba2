// SPDX-License-Identifier: MIT OR Apache-2.0
//! Cameras and HSU: whether each is there, is free, and answers as a session needs it.

use super::finding::{Check, Finding, Grade};
use super::load::Load;
use crate::base::ids::CameraId;
use crate::base::time::monotonic_ns;
use crate::camera::{Camera, CameraBackend, CameraError, CameraIdentity, PacketTest, SetUp, Wishes};
use crate::config::{ActionConfig, CameraConfig, NodeConfig};
use crate::hsu::{HsuError, HsuTimeouts, TriggerUnit};
use std::ffi::CString;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::FileTypeExt;
use std::path::{Path, PathBuf};

/// Number of clock readings of each device, of which the shortest round trip is judged.
const CLOCK_READINGS: usize = 8;

/// What was tried on an opened camera.
#[derive(Debug)]
pub struct OpenedCamera {
    pub identity: CameraIdentity,
    pub set_up: Result<SetUp, CameraError>,
    /// The largest packet that arrives; `None` where the camera sends no test packets.
    pub packet_bytes: Result<Option<PacketTest>, CameraError>,
    /// The shortest round trip of a clock reading, ns, or why the camera has no clock that can be read.
    pub clock: Result<Result<u64, String>, CameraError>,
}

/// Facts about one camera of the node file.
#[derive(Debug)]
pub struct CameraFacts {
    pub id: CameraId,
    /// Address or Aravis id, as configured.
    pub address: String,
    pub opened: Result<OpenedCamera, CameraError>,
}

impl CameraFacts {
    /// Opens the camera, tries it, and releases it. Its settings stay as the node file has them.
    pub fn gather(camera: &CameraConfig, config: &NodeConfig, backend: &mut dyn CameraBackend) -> Self {
        let wishes = Wishes::of(config, camera);
        Self {
            id: camera.id.clone(),
            address: camera.address.clone(),
            opened: backend.open(&camera.address).map(|mut opened| OpenedCamera {
                identity: opened.identity().clone(),
                set_up: opened.set_up(&wishes),
                packet_bytes: opened.test_packet_size(config.packet_bytes),
                clock: read_clock(opened.as_mut()),
            }),
        }
    }
}

fn read_clock(camera: &mut dyn Camera) -> Result<Result<u64, String>, CameraError> {
    let mut shortest = u64::MAX;
    for _ in 0..CLOCK_READINGS {
        match camera.sample_clock()? {
            Some(reading) => {
                shortest = shortest.min(reading.host_after_ns.saturating_sub(reading.host_before_ns));
            }
            None => return Ok(Err(camera.why_no_clock().unwrap_or("it has none").to_owned())),
        }
    }
    Ok(Ok(shortest))
}

/// The verdicts on one camera.
pub fn judge_camera(facts: &CameraFacts, load: &Load) -> Vec<Finding> {
    let check = |what: &str| Check::device(format!("camera {}{what}", facts.id));
    let opened = match &facts.opened {
        Ok(opened) => opened,
        Err(error) => return vec![failed_by(check(""), error, format!("a camera at {}", facts.address))],
    };
    let CameraIdentity { vendor, model, serial } = &opened.identity;
    let name = format!("{vendor} {model}, serial number {serial}, at {}, under our control", facts.address);
    let expected = "every setting of the node file to be taken, and frames as a session records them";
    let settings = match &opened.set_up {
        Ok(SetUp { contract, remarks, .. }) => {
            let (width, height) = contract.size;
            let remarks: String = remarks.iter().map(|remark| format!("; {remark}")).collect();
            check(": settings")
                .ok(format!("taken and read back, {width} x {height} {}{remarks}", contract.pixel.name()))
        }
        Err(CameraError::SetUp { problems }) => {
            check(": settings").failed(problems.join("; "), expected, "correct the node file as named")
        }
        Err(error) => failed_by(check(": settings"), error, expected),
    };
    let packets = judge_packets(check(": packet size"), &opened.packet_bytes, load);
    vec![check("").ok(name), settings, packets, judge_clock(check(": clock"), &opened.clock, load)]
}

/// Test packets come by the way of frames, through the firewall to a UDP socket: where none arrives, the firewall's own
/// tools list the rules, which no other program can follow as surely.
fn judge_packets(check: Check, tested: &Result<Option<PacketTest>, CameraError>, load: &Load) -> Finding {
    let wanted = load.packet_bytes;
    let expected = format!("packets of {wanted} bytes to arrive (acquisition.packet_bytes)");
    match tested {
        Ok(Some(test)) if test.arrived == wanted => {
            check.ok(format!("a test packet of {wanted} bytes arrived"))
        }
        // The camera's own limit, not the network's.
        Ok(Some(PacketTest { arrived, camera_takes: Some(takes) })) if arrived == takes => check.failed(
            format!("the camera sends packets of {takes} bytes at most, and those arrive"),
            expected,
            format!("set acquisition.packet_bytes = {takes}"),
        ),
        Ok(Some(PacketTest { arrived, .. })) => check.failed(
            format!("the largest packet that arrives has {arrived} bytes"),
            expected,
            "raise the MTU on this host's interface and on every switch between, or lower the setting",
        ),
        Ok(None) => check.ok("cannot be tested: the camera sends no test packets"),
        Err(CameraError::NoTestPackets { patience_ms }) => check.failed(
            format!("no test packet of the camera arrives, of whatever size, within {patience_ms} ms"),
            expected,
            "list the firewall's rules with `sudo nft list ruleset` and `sudo iptables -S`, and allow UDP from the \
             cameras' subnet (GVCP: source port 3956; GVSP: any port); check that the camera has a route to this host",
        ),
        Err(error) => failed_by(check, error, expected),
    }
}

fn judge_clock(check: Check, clock: &Result<Result<u64, String>, CameraError>, load: &Load) -> Finding {
    let limit_ns = load.half_period_ns();
    let expected = format!("a clock that can be read within {} (half a period)", duration(limit_ns));
    match clock {
        Ok(Ok(round_trip_ns)) => check.graded(
            if *round_trip_ns <= limit_ns { Grade::Ok } else { Grade::Warning },
            format!("read within {}", duration(*round_trip_ns)),
            expected,
            "look for load on this host or on the network",
        ),
        Ok(Err(why)) => check.warning(
            format!("cannot be read: {why}"),
            expected,
            "frames will be matched by block ids and arrival alone: prefer a camera with a clock",
        ),
        Err(error) => failed_by(check, error, expected),
    }
}

/// A failure in an error's own words: what was found, and after the semicolon what to do.
fn failed_by(check: Check, error: &CameraError, expected: impl Into<String>) -> Finding {
    let text = error.to_string();
    let (found, advice) = text.split_once("; ").unwrap_or((&text, "check its power and cable"));
    check.failed(found, expected, advice)
}

fn duration(ns: u64) -> String {
    match ns {
        0..1_000_000 => format!("{} us", ns / 1000),
        _ => format!("{:.1} ms", ns as f64 / 1e6),
    }
}

/// The verdict in place of those on cameras, where this binary cannot drive any.
pub fn cameras_not_examined() -> Finding {
    Check::device("cameras").warning(
        "not examined: this binary was built without the feature `aravis`",
        "a binary that can drive cameras",
        "build it with default features",
    )
}

/// The answers of an HSU to the doctor's greeting.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GreetedHsu {
    /// Product, serial number and firmware, in one line.
    pub identity: String,
    /// The protocol version that both sides agreed on.
    pub protocol: u8,
    /// The state that the unit reports, for instance `idle`.
    pub state: String,
    /// The shortest round trip of a clock reading, ns; `None` when no reading was answered.
    pub round_trip_ns: Option<u64>,
    /// Messages of the unit whose checksum or form was wrong.
    pub bad_frames: u32,
}

/// Facts about the HSU of the node file.
#[derive(Debug)]
pub struct HsuFacts {
    /// The serial device, as configured.
    pub device: PathBuf,
    /// Whether it can be a serial port; the reason if not.
    pub device_file: Result<(), String>,
    /// The unit's answers, or why it gave none; `None` when it was not greeted.
    pub greeted: Option<Result<GreetedHsu, String>>,
}

impl HsuFacts {
    /// Looks at the device, greets the unit and reads its clock. A greeting disarms what this node has armed: not to be
    /// done while a node runs.
    pub fn gather(config: &NodeConfig) -> Self {
        let device = config.trigger.device();
        let device_file = look_at_device(&device);
        let greeted = device_file.is_ok().then(|| greet(config).map_err(|e| e.to_string()));
        Self { device, device_file, greeted }
    }
}

fn look_at_device(device: &Path) -> Result<(), String> {
    let kind = std::fs::metadata(device).map_err(|e| e.to_string())?.file_type();
    if !kind.is_char_device() {
        return Err("not a serial device".to_owned());
    }
    let path = CString::new(device.as_os_str().as_bytes()).map_err(|e| e.to_string())?;
    // SAFETY: the string lives during the call.
    match unsafe { libc::access(path.as_ptr(), libc::R_OK | libc::W_OK) } {
        0 => Ok(()),
        _ => Err(std::io::Error::last_os_error().to_string()),
    }
}

fn greet(config: &NodeConfig) -> Result<GreetedHsu, HsuError> {
    let hsu = TriggerUnit::of(config).connect(&config.node, &HsuTimeouts::default())?;
    let readings = (0..CLOCK_READINGS).filter_map(|_| hsu.query_clock().ok());
    let round_trip_ns = readings.map(|r| monotonic_ns(r.received).saturating_sub(monotonic_ns(r.sent))).min();
    Ok(GreetedHsu {
        identity: hsu.identity_text(),
        protocol: hsu.welcome().agreed,
        state: hsu.status()?.state.to_string(),
        round_trip_ns,
        bad_frames: hsu.bad_frames(),
    })
}

/// The verdict on action commands in place of an HSU. Whether cameras obey them is checked when a session is prepared.
pub fn judge_actions(action: ActionConfig, cameras: usize) -> Finding {
    let what = format!(
        "action commands to {cameras} cameras, no HSU: no projector is triggered, so the scene must stand still"
    );
    let check = Check::device("triggers");
    match action.ptp {
        true => check.ok(format!("{what}; scheduled on the clock that PTP gives the cameras")),
        false => check.warning(
            format!("{what}; cameras act when the packet reaches them, so exposures of a trigger differ by network \
                delay"),
            "actions that are scheduled (trigger.ptp = true)",
            "use cameras with PTP, or an HSU, for a scene that moves",
        ),
    }
}

/// The verdicts on the HSU.
pub fn judge_hsu(facts: &HsuFacts, load: &Load) -> Vec<Finding> {
    let device = facts.device.display();
    let check = Check::device("HSU device");
    let file = match &facts.device_file {
        Ok(()) => check.ok(format!("{device}")),
        Err(error) => check.failed(
            format!("{device}: {error}"),
            "a serial device that may be read and written (hsu.device)",
            "check the cable and the udev link; the node's user must be in the group dialout",
        ),
    };
    let check = Check::device("HSU");
    let greeted = match &facts.greeted {
        None => return vec![file],
        Some(Err(error)) => {
            let advice = "check that hsu.device is the HSU's, its power and its cable";
            return vec![file, check.failed(error, format!("a fourdbody-hsu on {device}"), advice)];
        }
        Some(Ok(greeted)) => greeted,
    };
    let name = format!("{}, protocol {}, {}", greeted.identity, greeted.protocol, greeted.state);
    let mut findings = vec![file, check.ok(name)];
    let check = Check::device("HSU clock");
    let limit_ns = load.half_period_ns();
    let expected = format!("a reading within {} (half a period)", duration(limit_ns));
    findings.push(match greeted.round_trip_ns {
        Some(ns) => check.graded(
            if ns <= limit_ns { Grade::Ok } else { Grade::Warning },
            format!("read within {}", duration(ns)),
            expected,
            "set the USB converter's latency timer to 1 ms (/sys/bus/usb-serial/devices/*/latency_timer)",
        ),
        None => check.failed("no reading was answered", expected, "check the serial cable"),
    });
    if greeted.bad_frames > 0 {
        let found = format!("{} broken frames", greeted.bad_frames);
        findings.push(Check::device("HSU line").warning(found, "none", "check the cable and its shield"));
    }
    findings
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::{FrameContract, State};
    use crate::config::Pixel;

    fn camera() -> CameraFacts {
        CameraFacts {
            id: CameraId::from("h0_up"),
            address: "192.168.10.2".to_owned(),
            opened: Ok(OpenedCamera {
                identity: CameraIdentity::default(),
                set_up: Ok(SetUp {
                    contract: FrameContract {
                        pixel: Pixel::Mono8,
                        size: (1920, 1200),
                        place: (0, 0),
                        offset: (0, 0),
                        chunk_room: 0,
                    },
                    settings: Vec::new(),
                    remarks: Vec::new(),
                    watched: State::new(),
                }),
                packet_bytes: Ok(Some(PacketTest { arrived: 9000, camera_takes: None })),
                clock: Ok(Ok(200_000)),
            }),
        }
    }

    fn grades(facts: &CameraFacts) -> Vec<Grade> {
        judge_camera(facts, &Load::reference()).iter().map(|f| f.grade).collect()
    }

    fn opened(change: impl FnOnce(&mut OpenedCamera)) -> Vec<Grade> {
        let mut facts = camera();
        change(facts.opened.as_mut().expect("opened"));
        grades(&facts)
    }

    #[test]
    fn a_camera_is_judged_by_what_a_session_needs() {
        use Grade::{Failed, Ok as Good, Warning};
        let link = || CameraError::Link { doing: "reading its clock", detail: "Timeout".to_owned() };
        assert_eq!(grades(&camera()), [Good; 4]);
        let problems = vec!["PixelFormat is Mono16".to_owned()];
        assert_eq!(opened(|c| c.set_up = Err(CameraError::SetUp { problems })), [Good, Failed, Good, Good]);
        let test = |arrived, camera_takes| Ok(Some(PacketTest { arrived, camera_takes }));
        assert_eq!(opened(|c| c.packet_bytes = test(1500, None)), [Good, Good, Failed, Good]);
        // USB cameras have neither packets nor, some, a clock.
        assert_eq!(opened(|c| c.packet_bytes = Ok(None)), [Good; 4]);
        assert_eq!(opened(|c| c.clock = Ok(Err("stands still".to_owned()))), [Good, Good, Good, Warning]);
        assert_eq!(opened(|c| c.clock = Err(link())), [Good, Good, Good, Failed]);
        assert_eq!(opened(|c| c.clock = Ok(Ok(5_000_000))), [Good, Good, Good, Warning]);
    }

    #[test]
    fn a_camera_that_sends_no_larger_packets_is_no_matter_of_the_network() {
        let advice = |arrived, camera_takes| {
            let mut facts = camera();
            facts.opened.as_mut().expect("opened").packet_bytes =
                Ok(Some(PacketTest { arrived, camera_takes }));
            judge_camera(&facts, &Load::reference())[2].advice.clone()
        };
        assert_eq!(advice(1444, Some(1444)), "set acquisition.packet_bytes = 1444");
        assert!(advice(1444, None).contains("MTU") && advice(1444, Some(8000)).contains("MTU"));
    }

    #[test]
    fn where_no_packet_arrives_the_firewalls_own_tools_are_named() {
        let mut facts = camera();
        facts.opened.as_mut().expect("opened").packet_bytes =
            Err(CameraError::NoTestPackets { patience_ms: 400 });
        let finding = &judge_camera(&facts, &Load::reference())[2];
        assert_eq!(finding.grade, Grade::Failed);
        for part in ["nft list ruleset", "iptables -S", "UDP from the cameras' subnet"] {
            assert!(finding.advice.contains(part), "{part:?} missing in {finding}");
        }
    }

    #[test]
    fn who_has_a_camera_is_named() {
        let holder = Some("192.168.10.9:50123".to_owned());
        let error = CameraError::Owned { address: "192.168.10.2".to_owned(), holder };
        let findings = judge_camera(&CameraFacts { opened: Err(error), ..camera() }, &Load::reference());
        let line = findings[0].to_string();
        assert!(line.starts_with("failed   camera h0_up: "), "{line}");
        assert!(line.contains("on 192.168.10.9:50123") && line.contains("close that program"), "{line}");
    }

    #[test]
    fn action_commands_say_what_they_cannot_do() {
        let keys = |ptp| ActionConfig { device_key: 1, group_key: 1, group_mask: 1, ptp };
        assert_eq!(judge_actions(keys(true), 4).grade, Grade::Ok);
        assert_eq!(judge_actions(keys(false), 4).grade, Grade::Warning);
        assert!(judge_actions(keys(true), 4).found.contains("no projector is triggered"));
    }

    #[test]
    fn an_hsu_is_judged_by_device_identity_and_round_trip() {
        use Grade::{Failed, Ok as Good, Warning};
        let greeted = GreetedHsu {
            identity: "fourdbody-hsu 1 firmware 1.0.0".to_owned(),
            protocol: 1,
            state: "idle".to_owned(),
            round_trip_ns: Some(400_000),
            bad_frames: 0,
        };
        let judge = |device_file: Result<(), String>, greeted: Option<Result<GreetedHsu, String>>| {
            let facts = HsuFacts { device: "/dev/ttyUSB0".into(), device_file, greeted };
            judge_hsu(&facts, &Load::reference()).iter().map(|f| f.grade).collect::<Vec<_>>()
        };
        assert_eq!(judge(Err("No such file".to_owned()), None), [Failed]);
        assert_eq!(judge(Ok(()), Some(Err("silence".to_owned()))), [Good, Failed]);
        assert_eq!(judge(Ok(()), Some(Ok(greeted.clone()))), [Good; 3]);
        let slow = GreetedHsu { round_trip_ns: Some(16_000_000), bad_frames: 2, ..greeted.clone() };
        assert_eq!(judge(Ok(()), Some(Ok(slow))), [Good, Good, Warning, Warning]);
        let mute = GreetedHsu { round_trip_ns: None, ..greeted };
        assert_eq!(judge(Ok(()), Some(Ok(mute))), [Good, Good, Failed]);
    }
}
