// SPDX-License-Identifier: MIT OR Apache-2.0
//! What one acquisition PC needs: its cameras' addresses and settings, its serial device, its disk
//! (`node-X.toml`).

use super::api::{ApiConfig, read_api};
use super::rig::{Head, Rig, RigCamera};
use super::section::Section;
use super::trigger::{TriggerSource, read_trigger};
use super::words::{CameraWords, read_settings, word_of};
use super::{ConfigError, parse_table, read_all, read_table};
use crate::base::ids::{CameraId, NodeId};
use crate::base::regular;
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use std::fmt;
use std::net::IpAddr;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// A GenICam feature's value as written in the configuration.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(untagged)]
pub enum FeatureValue {
    /// The value of a boolean feature.
    Flag(bool),
    /// The value of an integer feature.
    Integer(i64),
    /// The value of a float feature.
    Float(f64),
    /// The value of an enumeration or a text.
    Text(String),
}

impl fmt::Display for FeatureValue {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Flag(value) => value.fmt(f),
            Self::Integer(value) => value.fmt(f),
            Self::Float(value) => value.fmt(f),
            Self::Text(value) => f.write_str(value),
        }
    }
}

/// One feature to set, in the order given (selectors first).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct FeatureSetting {
    /// SFNC name, for instance `TriggerMode`.
    pub feature: String,
    /// The value to set and to find when reading back.
    pub value: FeatureValue,
}

impl FeatureSetting {
    /// Selectors may be set several times, each time for the features behind them.
    pub fn is_selector(&self) -> bool {
        self.feature.ends_with("Selector")
    }
}

/// One camera of the node.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CameraConfig {
    /// Its name in the rig.
    pub id: CameraId,
    /// Aravis device id or IP address.
    pub address: String,
    /// Its settings by the node file's own words; those of `[[camera]]` stand before those of `[acquisition]`.
    pub words: CameraWords,
    /// Raw settings, the common ones first: set in this order after those by words, and read back.
    pub settings: Vec<FeatureSetting>,
}

/// Which kind of socket Aravis receives packets by.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum SocketMode {
    /// A packet socket where the process may open one (CAP_NET_RAW), an ordinary UDP socket otherwise.
    Auto,
    /// An ordinary UDP socket, in any case.
    Standard,
}

/// What the loss of a device means for a session.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum OnLoss {
    /// The session goes on; what is missing becomes gap records.
    Continue,
    /// The train is stopped on all nodes, and the session ends.
    Abort,
}

/// What a full ring of frames means for a session.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum WhenFull {
    /// The newest whole frame set is dropped, with a gap record for each of its frames.
    #[default]
    DropFrameSet,
    /// The train is stopped on all nodes, and the session ends.
    Stop,
}

/// What the threads of the pixel path request of the system (`[realtime]`); a refusal is a warning.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Realtime {
    /// Priority under SCHED_FIFO, 1 to 99; 0: an ordinary thread.
    pub priority: u8,
    /// The cores to run on; none: all.
    pub cpus: Vec<usize>,
    /// Whether frame memory is locked.
    pub lock_memory: bool,
}

impl Default for Realtime {
    fn default() -> Self {
        Self { priority: 0, cpus: Vec::new(), lock_memory: true }
    }
}

/// Quick looks at what was recorded (`[quick_look]`).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct QuickLookConfig {
    /// The calibration to reconstruct with.
    pub calibration: PathBuf,
    /// Frame sets of each session, spread over it.
    pub frame_sets: usize,
}

/// The configuration of a node: what its file states, and the rig that the file names.
#[derive(Debug, Clone, PartialEq)]
pub struct NodeConfig {
    /// Its name in the rig.
    pub node: NodeId,
    pub rig: Rig,
    /// The rig file's text, kept word for word in every recording.
    pub rig_text: String,
    /// How the control API is reached.
    pub api: ApiConfig,
    pub trigger: TriggerSource,
    /// Sessions are directories below this one.
    pub sessions_dir: PathBuf,
    /// Never fill the disk beyond this many free bytes.
    pub reserve_bytes: u64,
    /// A segment is closed at the first trigger after this many bytes.
    pub segment_bytes: u64,
    pub buffers_per_camera: usize,
    /// GVSP packet size (IP packet), bytes.
    pub packet_bytes: u32,
    pub socket: SocketMode,
    /// Before arming no camera may send for this long; zero lets free-running cameras pass.
    pub silence_gate: Duration,
    /// When frames come faster than the disk takes them.
    pub when_full: WhenFull,
    /// When a camera stops answering.
    pub on_camera_lost: OnLoss,
    /// When the link to the HSU breaks during a train.
    pub on_link_lost: OnLoss,
    /// Priority, cores and locked memory.
    pub realtime: Realtime,
    /// Clouds of a few frame sets of every session, for the console.
    pub quick_look: Option<QuickLookConfig>,
    /// Whether the console begins with moving pictures while nothing is recorded (`[console] live_preview`).
    pub live_preview: bool,
    /// Where a worker of this machine keeps its results (`[worker]`); its state is shown with the node's.
    pub worker_results: Option<PathBuf>,
    /// The cameras, in the rig's order.
    pub cameras: Vec<CameraConfig>,
}

impl NodeConfig {
    /// Reads and validates a node file and the rig that it names.
    pub fn load(path: &Path) -> Result<Self, ConfigError> {
        Self::of(&read_table(path)?, path)
    }

    /// As [`Self::load`], of a text that is to become the file at `path`.
    pub fn from_text(text: &str, path: &Path) -> Result<Self, ConfigError> {
        Self::of(&parse_table(text, path)?, path)
    }

    fn of(table: &toml::Table, path: &Path) -> Result<Self, ConfigError> {
        let base = path.parent().unwrap_or(Path::new("."));
        read_all(table, |root| read_node(root, base))
            .map_err(|problems| ConfigError { path: path.to_owned(), problems })
    }

    /// Whether frames must be those of the HSU's triggers: without a silence gate cameras may run by themselves.
    pub fn cameras_are_triggered(&self) -> bool {
        !self.silence_gate.is_zero()
    }
}

/// The only version of node files so far.
const FORMAT: u64 = 1;
const MIB: u64 = 1 << 20;

/// The values of `[acquisition]`, which all cameras share.
struct Acquisition {
    buffers_per_camera: usize,
    packet_bytes: u32,
    socket: SocketMode,
    silence_gate: Duration,
    when_full: WhenFull,
    on_camera_lost: OnLoss,
    on_link_lost: OnLoss,
    words: CameraWords,
    settings: Vec<FeatureSetting>,
}

fn read_acquisition(section: Section<'_>) -> Acquisition {
    const ON_LOSS: [(&str, OnLoss); 2] = [("continue", OnLoss::Continue), ("abort", OnLoss::Abort)];
    let words = CameraWords::read(&section);
    let acquisition = Acquisition {
        buffers_per_camera: section.integer_or("buffers_per_camera", 16..=4096, 64) as usize,
        packet_bytes: section.integer_or("packet_bytes", 576..=65_000, 9000) as u32,
        socket: section
            .choice_or_first("socket", &[("auto", SocketMode::Auto), ("standard", SocketMode::Standard)]),
        silence_gate: Duration::from_millis(section.integer_or("silence_gate_ms", 0..=60_000, 250)),
        when_full: section.choice_or_first(
            "when_full",
            &[("drop_frame_set", WhenFull::DropFrameSet), ("stop", WhenFull::Stop)],
        ),
        on_camera_lost: section.choice_or_first("on_camera_lost", &ON_LOSS),
        on_link_lost: section.choice_or_first("on_link_lost", &ON_LOSS),
        settings: read_settings(&section, &words, None),
        words,
    };
    section.finish();
    acquisition
}

fn read_node(root: Section<'_>, base: &Path) -> Option<NodeConfig> {
    root.integer("format", FORMAT..=FORMAT);
    let node = NodeId(root.name("node"));
    let rig_path = base.join(root.text("rig"));
    let trigger = read_trigger(&root);
    let storage = root.section("storage").map(|section| {
        let values = (
            base.join(section.text("sessions_dir")),
            section.integer_or("reserve_mib", 0..=1 << 30, 1024) * MIB,
            section.integer_or("segment_mib", 1..=1 << 20, 16_384) * MIB,
        );
        section.finish();
        values
    });
    // The log lies beside the sessions, unless configured otherwise.
    let audit = storage.as_ref().map(|(sessions_dir, ..)| sessions_dir.join("audit.jsonl"));
    let api = root.section("api").map(|section| read_api(section, base, audit));
    let acquisition = root.section("acquisition").map(read_acquisition);
    let realtime = root.optional_section("realtime").map_or_else(Realtime::default, read_realtime);
    let quick_look = root.optional_section("quick_look").map(|section| {
        let config = QuickLookConfig {
            calibration: base.join(section.text("calibration")),
            frame_sets: section.integer_or("frame_sets", 1..=9, 3) as usize,
        };
        section.finish();
        config
    });
    let live_preview = root.optional_section("console").is_none_or(|section| {
        let live_preview = section.flag_or("live_preview", true);
        section.finish();
        live_preview
    });
    let worker_results = root.optional_section("worker").map(|section| {
        let results = base.join(section.text("results"));
        section.finish();
        results
    });
    let cameras: Vec<CameraConfig> =
        root.sections("camera").into_iter().map(|s| read_camera(s, acquisition.as_ref())).collect();
    let rig = match Rig::load(&rig_path) {
        Ok(rig) => Some(rig),
        Err(error) => {
            error.problems.iter().for_each(|p| root.problem("rig", format!("{}: {p}", rig_path.display())));
            None
        }
    };
    let rig_text = regular::read_text(&rig_path, regular::TEXT_BYTES).unwrap_or_default();
    if let Some(rig) = &rig {
        check_against_rig(&root, rig, &node, &cameras);
        if let Some(trigger) = &trigger {
            trigger.check(&root, rig, &cameras);
        }
    }
    root.finish();
    let (sessions_dir, reserve_bytes, segment_bytes) = storage?;
    let acquisition = acquisition?;
    let rig = rig?;
    let place = |id: &CameraId| rig.cameras().position(|(_, camera)| camera.id == *id);
    let mut cameras = cameras;
    cameras.sort_by_key(|camera| place(&camera.id));
    Some(NodeConfig {
        node,
        rig_text,
        api: api?,
        trigger: trigger?,
        sessions_dir,
        reserve_bytes,
        segment_bytes,
        buffers_per_camera: acquisition.buffers_per_camera,
        packet_bytes: acquisition.packet_bytes,
        socket: acquisition.socket,
        silence_gate: acquisition.silence_gate,
        when_full: acquisition.when_full,
        on_camera_lost: acquisition.on_camera_lost,
        on_link_lost: acquisition.on_link_lost,
        realtime,
        quick_look,
        live_preview,
        worker_results,
        cameras,
        rig,
    })
}

fn read_realtime(section: Section<'_>) -> Realtime {
    let cpus = section.each("cpus", "a core's number from 0", |value| {
        usize::try_from(value.as_integer()?).ok().filter(|cpu| *cpu < 1024)
    });
    let priority = section.integer_or("priority", 0..=99, 0);
    let lock_memory = section.flag_or("lock_memory", true);
    section.finish();
    Realtime { priority: u8::try_from(priority).unwrap_or(0), cpus, lock_memory }
}

fn read_camera(section: Section<'_>, common: Option<&Acquisition>) -> CameraConfig {
    let id = CameraId(section.name("id"));
    let address = section.text("address");
    let own = CameraWords::read(&section);
    let mut settings = read_settings(&section, &own, common.map(|common| &common.words));
    let mut words = own;
    if let Some(common) = common {
        // What `[[camera]]` states replaces what is stated for all cameras.
        let unsaid =
            |setting: &&FeatureSetting| word_of(&setting.feature).is_none_or(|word| !section.has(word));
        settings = common.settings.iter().filter(unsaid).cloned().chain(settings).collect();
        words = words.or(&common.words);
    }
    section.finish();
    CameraConfig { id, address, words, settings }
}

fn check_against_rig(root: &Section<'_>, rig: &Rig, node: &NodeId, cameras: &[CameraConfig]) {
    if !rig.nodes().contains(node) {
        let nodes: Vec<String> = rig.nodes().iter().map(ToString::to_string).collect();
        root.problem("node", format!("{node} is not in the rig, expected one of: {}", nodes.join(", ")));
    }
    let (mut ids, mut addresses) = (BTreeSet::new(), BTreeSet::new());
    for (i, camera) in cameras.iter().enumerate() {
        if !ids.insert(&camera.id) {
            root.problem(&format!("camera[{i}].id"), format!("{} is listed twice", camera.id));
        }
        if !addresses.insert(&camera.address) {
            root.problem(&format!("camera[{i}].address"), format!("{} is used twice", camera.address));
        }
        let known = rig.cameras().find(|(_, known)| known.id == camera.id);
        if known.is_none_or(|(_, known)| known.node != *node) {
            let message = format!("{} is not a camera of node {node} in the rig", camera.id);
            root.problem(&format!("camera[{i}].id"), message);
        }
        if let Some((head, RigCamera { device, .. })) = known {
            for (word, stated, of_rig) in
                [("width", camera.words.width, device.width), ("height", camera.words.height, device.height)]
            {
                if let Some(stated) = stated.filter(|stated| usize::try_from(*stated) != Ok(of_rig)) {
                    let message =
                        format!("is {stated} for {}, expected the {of_rig} of the rig file", camera.id);
                    root.problem(&format!("camera[{i}].{word}"), message);
                }
            }
            check_exposure(root, rig, head, i, camera);
        }
        if camera.address.starts_with(|c: char| c.is_ascii_digit())
            && camera.address.parse::<IpAddr>().is_err()
        {
            let message =
                format!("expected an IP address or an Aravis device id, found {:?}", camera.address);
            root.problem(&format!("camera[{i}].address"), message);
        }
    }
    for (_, camera) in rig.cameras_of(node).filter(|(_, camera)| !ids.contains(&camera.id)) {
        root.problem("camera", format!("{} of node {node} in the rig is missing", camera.id));
    }
}

/// Features whose value is an exposure in microseconds.
const EXPOSURES_US: [&str; 2] = ["ExposureTime", "ExposureTimeAbs"];

/// An exposure, by word or as a raw setting, must end within the trigger period.
fn check_exposure(root: &Section<'_>, rig: &Rig, head: &Head, i: usize, camera: &CameraConfig) {
    let limit_us = head.exposure_limit_us(rig.trigger_rate_hz);
    let own = root.list("camera").get(i).and_then(toml::Value::as_table);
    let stated = |key: &str| own.is_some_and(|table| table.contains_key(key));
    let listed = |feature: &str| {
        let settings = own.and_then(|table| table.get("settings")).and_then(toml::Value::as_array);
        settings.is_some_and(|list| {
            list.iter().any(|pair| pair.get(0).and_then(|name| name.as_str()) == Some(feature))
        })
    };
    let in_place = |own: bool, key: &str| match own {
        true => format!("camera[{i}].{key}"),
        false => format!("acquisition.{key}"),
    };
    let word = camera.words.exposure_us.map(|us| (in_place(stated("exposure_us"), "exposure_us"), us));
    let raw = camera.settings.iter().filter(|setting| EXPOSURES_US.contains(&setting.feature.as_str()));
    let raw = raw.filter_map(|setting| {
        let us = match setting.value {
            FeatureValue::Float(us) => us,
            FeatureValue::Integer(us) => us as f64,
            FeatureValue::Flag(_) | FeatureValue::Text(_) => return None,
        };
        Some((in_place(listed(&setting.feature), "settings"), us))
    });
    for (key, us) in word.into_iter().chain(raw).filter(|(_, us)| *us >= limit_us) {
        let message = format!(
            "an exposure of {us} us for {}, expected less than {limit_us:.1} us: behind the delay of head \
             {} it must end within \
             the trigger period of {:.1} us ({} Hz), or the camera takes every second trigger only",
            camera.id,
            head.id,
            1e6 / rig.trigger_rate_hz,
            rig.trigger_rate_hz
        );
        root.problem(&key, message);
    }
}

#[cfg(test)]
mod tests {
    use super::{Acquisition, CameraConfig, NodeConfig, read_acquisition, read_camera};
    use crate::config::section::Section;
    use crate::config::{CameraWords, Edge, PacketDelay};
    use std::cell::RefCell;
    use std::path::Path;

    /// A camera beside the common words, and the key paths of all problems.
    fn read(common: &str, own: &str) -> (CameraConfig, Vec<String>) {
        let [common, own] = [common, own].map(|text| text.parse::<toml::Table>().expect("TOML"));
        let problems = RefCell::default();
        let common: Acquisition = read_acquisition(Section::root(&common, &problems));
        let camera = read_camera(Section::root(&own, &problems), Some(&common));
        (camera, problems.into_inner().into_iter().map(|problem| problem.key).collect())
    }

    const OWN: &str = "id = \"h0_up\"\naddress = \"10.0.0.2\"\n";

    #[test]
    fn a_cameras_own_words_stand_above_the_common_ones() {
        let common = "trigger_line = \"Line0\"\nexposure_us = 1000\noverlap = false\npacket_delay_us = \"auto\"\n\
                      left_to_settings = [\"gain_db\"]\nsettings = [[\"LineSelector\", \"Line0\"], [\"GainRaw\", 3]]";
        let own = format!(
            "{OWN}trigger_line = \"Line1\"\ntrigger_edge = \"falling\"\ngain_db = 6\nsettings = [[\"LineSelector\", \"Line1\"]]"
        );
        let (camera, problems) = read(common, &own);
        assert_eq!(problems, [""; 0]);
        assert_eq!(
            camera.words,
            CameraWords {
                trigger_line: Some("Line1".to_owned()),
                trigger_edge: Some(Edge::Falling),
                exposure_us: Some(1000.0),
                gain_db: Some(6.0),
                overlap: Some(false),
                packet_delay: Some(PacketDelay::Auto),
                ..CameraWords::default()
            }
        );
        // Common settings come first; one that a word of the camera itself replaces is left out.
        let settings: Vec<String> =
            camera.settings.iter().map(|s| format!("{} {}", s.feature, s.value)).collect();
        assert_eq!(settings, ["LineSelector Line0", "LineSelector Line1"]);
    }

    /// The shipped node file, changed, beside the shipped rig of 120 Hz, whose heads delay by 200 us: its problems.
    fn problems(change: impl Fn(&str) -> String) -> Vec<String> {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config/node-a.toml");
        let text = change(&std::fs::read_to_string(&path).expect("config/node-a.toml is in the repository"));
        let problems =
            NodeConfig::from_text(&text, &path).err().map(|error| error.problems).unwrap_or_default();
        problems.iter().map(ToString::to_string).collect()
    }

    #[test]
    fn an_exposure_beyond_the_trigger_period_is_refused_wherever_it_stands() {
        const COMMON: &str = "[acquisition]\n";
        const OWN: &str = "id = \"h0_low\"\n";
        const LEFT: &str =
            "left_to_settings = [\"exposure_us\"]\nsettings = [[\"ExposureTimeAbs\", 17000.0]]\n";
        assert_eq!(problems(str::to_owned), [""; 0]);
        let stated = |place: &str, words: &str| {
            problems(|text| {
                let others = text.lines().filter(|line| place != COMMON || !line.starts_with("exposure_us"));
                let text: String = others.map(|line| format!("{line}\n")).collect();
                text.replace(place, &format!("{place}{words}"))
            })
        };
        assert_eq!(stated(COMMON, "exposure_us = 8133.0\n"), [""; 0]);
        for (place, words, keys) in [
            (COMMON, "exposure_us = 8134.0\n", vec!["acquisition.exposure_us"; 4]),
            (OWN, "exposure_us = 17000\n", vec!["camera[1].exposure_us"]),
            (OWN, LEFT, vec!["camera[1].settings"]),
            (COMMON, LEFT, vec!["acquisition.settings"; 4]),
        ] {
            let found = stated(place, words);
            assert_eq!(found.len(), keys.len(), "{found:#?}");
            for (line, key) in found.iter().zip(keys) {
                assert!(line.starts_with(key) && line.contains("every second trigger"), "{line}");
            }
        }
    }

    #[test]
    fn raw_settings_name_a_words_feature_where_the_word_is_left_to_them() {
        let left = "left_to_settings = [\"trigger_edge\"]\n";
        let list = "settings = [[\"TriggerActivation\", \"None\"]]";
        let (camera, problems) = read("", &format!("{OWN}{left}{list}"));
        assert_eq!((camera.settings.len(), problems), (1, Vec::new()));
        // Left for all cameras, and by none.
        assert_eq!(read(left, &format!("{OWN}{list}")).1, [""; 0]);
        assert_eq!(read("", &format!("{OWN}{list}")).1, ["settings[0]"]);
        // A camera that states the word itself does not leave it to a list.
        let (camera, problems) = read(&format!("{left}{list}"), &format!("{OWN}trigger_edge = \"falling\""));
        assert_eq!(problems, [""; 0]);
        assert!(camera.settings.is_empty() && camera.words.left_to_settings.is_empty(), "{camera:?}");
    }

    #[test]
    fn words_that_are_wrong_or_there_twice_are_problems_with_key_paths() {
        let own = format!(
            "{OWN}trigger_edge = \"up\"\nexposure_us = -1\npixel = \"rgb8\"\npacket_delay_us = \"soon\"\n\
             left_to_settings = [\"colour\", \"gain_db\"]\ngain_db = 0\nexposure = 5\n\
             settings = [[\"Gain\", 0.0], [\"X\"], [\"TriggerMode\", \"On\"]]"
        );
        let (_, problems) = read("", &own);
        assert_eq!(
            problems,
            [
                "trigger_edge",
                "exposure_us",
                "pixel",
                "packet_delay_us",
                "left_to_settings[0]",
                "left_to_settings[1]",
                "settings[0]",
                "settings[1]",
                "settings[2]",
                "exposure"
            ]
        );
    }
}
