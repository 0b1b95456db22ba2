// SPDX-License-Identifier: MIT OR Apache-2.0
//! What one acquisition PC needs: its cameras' addresses and settings, its serial device, its disk
//! (`node-X.toml`).

use super::api::{ApiConfig, read_api};
use super::rig::Rig;
use super::section::Section;
use super::{ConfigError, Problem, read_table};
use crate::base::ids::{CameraId, NodeId};
use serde::{Deserialize, Serialize};
use std::cell::RefCell;
use std::collections::BTreeSet;
use std::net::IpAddr;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// A GenICam feature's value as written in the configuration.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(untagged)]
pub enum FeatureValue {
    /// For booleans.
    Flag(bool),
    /// For integers.
    Integer(i64),
    /// For floats.
    Float(f64),
    /// For enumerations and texts.
    Text(String),
}

/// One feature to set, in the order given (selectors first).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
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
    /// Set in this order before every session and read back; a difference refuses the session.
    pub settings: Vec<FeatureSetting>,
}

/// How Aravis receives packets.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum SocketMode {
    /// A packet socket where the process may open one (CAP_NET_RAW), an ordinary UDP socket otherwise.
    Auto,
    /// An ordinary UDP socket.
    Standard,
}

/// What the loss of a device means for a session.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum OnLoss {
    /// The session goes on; what is missing becomes gap records.
    Continue,
    /// The train is stopped on all nodes, and the session ends.
    Abort,
}

/// What a full ring of frames means for a session.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum WhenFull {
    /// The newest whole frame set is dropped, with a gap record for each of its frames.
    #[default]
    DropFrameSet,
    /// The train is stopped on all nodes, and the session ends.
    Stop,
}

/// What the threads of the pixel path ask of the system (`[realtime]`); what it refuses is a warning.
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

/// The node.
#[derive(Debug, Clone, PartialEq)]
pub struct NodeConfig {
    /// Its name in the rig.
    pub node: NodeId,
    /// The rig.
    pub rig: Rig,
    /// The rig file's text, kept word for word in every recording.
    pub rig_text: String,
    /// How the control API is reached.
    pub api: ApiConfig,
    /// Serial device of the link to the HSU.
    pub hsu_device: PathBuf,
    /// Sessions are directories below this one.
    pub sessions_dir: PathBuf,
    /// Never fill the disk beyond this many free bytes.
    pub reserve_bytes: u64,
    /// A segment is closed at the first trigger after this many bytes.
    pub segment_bytes: u64,
    /// Frame buffers per camera.
    pub buffers_per_camera: usize,
    /// GVSP packet size (IP packet), bytes.
    pub packet_bytes: u32,
    /// How packets are received.
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
    /// Where a worker of this machine keeps its results (`[worker]`); its state is shown with the node's.
    pub worker_results: Option<PathBuf>,
    /// The cameras, in the rig's order.
    pub cameras: Vec<CameraConfig>,
}

impl NodeConfig {
    /// Reads and validates a node file and the rig that it names.
    pub fn load(path: &Path) -> Result<Self, ConfigError> {
        let table = read_table(path)?;
        let problems = RefCell::default();
        let config = read_node(Section::root(&table, &problems), path.parent().unwrap_or(Path::new(".")));
        let problems: Vec<Problem> = problems.into_inner();
        match config {
            Some(config) if problems.is_empty() => Ok(config),
            _ => Err(ConfigError { path: path.to_owned(), problems }),
        }
    }

    /// Whether frames must be those of the HSU's triggers: without a silence gate cameras may run by themselves.
    pub fn cameras_are_triggered(&self) -> bool {
        !self.silence_gate.is_zero()
    }
}

const FORMAT: u64 = 1;
const MIB: u64 = 1 << 20;

/// `[acquisition]`.
struct Acquisition {
    buffers_per_camera: usize,
    packet_bytes: u32,
    socket: SocketMode,
    silence_gate: Duration,
    when_full: WhenFull,
    on_camera_lost: OnLoss,
    on_link_lost: OnLoss,
    settings: Vec<FeatureSetting>,
}

fn read_acquisition(section: Section<'_>) -> Acquisition {
    const ON_LOSS: [(&str, OnLoss); 2] = [("continue", OnLoss::Continue), ("abort", OnLoss::Abort)];
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
        settings: read_settings(&section),
    };
    section.finish();
    acquisition
}

fn read_node(root: Section<'_>, base: &Path) -> Option<NodeConfig> {
    root.integer("format", FORMAT..=FORMAT);
    let node = NodeId(root.name("node"));
    let rig_path = base.join(root.text("rig"));
    let hsu_device = root.section("hsu").map(|section| {
        let device = PathBuf::from(section.text("device"));
        section.finish();
        device
    });
    let storage = root.section("storage").map(|section| {
        let values = (
            base.join(section.text("sessions_dir")),
            section.integer_or("reserve_mib", 0..=1 << 30, 1024) * MIB,
            section.integer_or("segment_mib", 1..=1 << 20, 16_384) * MIB,
        );
        section.finish();
        values
    });
    // Beside what it is about, unless configured otherwise.
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
    let worker_results = root.optional_section("worker").map(|section| {
        let results = base.join(section.text("results"));
        section.finish();
        results
    });
    let common = acquisition.as_ref().map_or(&[][..], |acquisition| &acquisition.settings);
    let cameras: Vec<CameraConfig> =
        root.sections("camera").into_iter().map(|s| read_camera(s, common)).collect();
    let rig = match Rig::load(&rig_path) {
        Ok(rig) => Some(rig),
        Err(error) => {
            error.problems.iter().for_each(|p| root.problem("rig", format!("{}: {p}", rig_path.display())));
            None
        }
    };
    let rig_text = std::fs::read_to_string(&rig_path).unwrap_or_default();
    if let Some(rig) = &rig {
        check_against_rig(&root, rig, &node, &cameras);
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
        hsu_device: hsu_device?,
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
        worker_results,
        cameras,
        rig,
    })
}

fn read_realtime(section: Section<'_>) -> Realtime {
    let mut cpus = Vec::new();
    for (i, value) in section.list("cpus").iter().enumerate() {
        match value.as_integer().and_then(|cpu| usize::try_from(cpu).ok()).filter(|cpu| *cpu < 1024) {
            Some(cpu) => cpus.push(cpu),
            None => section
                .problem(&format!("cpus[{i}]"), format!("expected a core's number from 0, found {value}")),
        }
    }
    let priority = section.integer_or("priority", 0..=99, 0);
    let lock_memory = section.flag_or("lock_memory", true);
    section.finish();
    Realtime { priority: u8::try_from(priority).unwrap_or(0), cpus, lock_memory }
}

fn read_camera(section: Section<'_>, common: &[FeatureSetting]) -> CameraConfig {
    let id = CameraId(section.name("id"));
    let address = section.text("address");
    let own = read_settings(&section);
    let settings = with_common(own, common, &section);
    section.finish();
    CameraConfig { id, address, settings }
}

/// A camera's own list, whole and in its order, stands where the first of the common settings stood that it names; the
/// others that it names are left out. Where it names none, it comes last.
fn with_common(
    own: Vec<FeatureSetting>,
    common: &[FeatureSetting],
    section: &Section<'_>,
) -> Vec<FeatureSetting> {
    let names = |setting: &FeatureSetting| own.iter().any(|mine| mine.feature == setting.feature);
    // Which of several is meant cannot be told without their selectors.
    let mut said = BTreeSet::new();
    for setting in common.iter().filter(|setting| names(setting) && !setting.is_selector()) {
        let feature = &setting.feature;
        let times = |list: &[FeatureSetting]| list.iter().filter(|other| other.feature == *feature).count();
        if times(common) > 1 && times(&own) < times(common) && said.insert(feature) {
            section.problem(
                "settings",
                format!(
                    "the common list sets {feature} {} times, this one {}: which of them is meant? Expected it as often, each \
                     time behind its selector",
                    times(common),
                    times(&own)
                ),
            );
        }
    }
    let place = common.iter().position(names).unwrap_or(common.len());
    let after = common[place..].iter().filter(|setting| !names(setting)).cloned().collect::<Vec<_>>();
    common[..place].iter().cloned().chain(own).chain(after).collect()
}

fn read_settings(section: &Section<'_>) -> Vec<FeatureSetting> {
    let mut settings = Vec::new();
    for (i, entry) in section.list("settings").iter().enumerate() {
        let pair = entry.as_array().map(Vec::as_slice);
        let value = match pair {
            Some([toml::Value::String(_), toml::Value::Boolean(b)]) => Some(FeatureValue::Flag(*b)),
            Some([toml::Value::String(_), toml::Value::Integer(i)]) => Some(FeatureValue::Integer(*i)),
            Some([toml::Value::String(_), toml::Value::Float(x)]) => Some(FeatureValue::Float(*x)),
            Some([toml::Value::String(_), toml::Value::String(t)]) => Some(FeatureValue::Text(t.clone())),
            _ => None,
        };
        match (pair, value) {
            (Some([toml::Value::String(feature), _]), Some(value)) => {
                settings.push(FeatureSetting { feature: feature.clone(), value });
            }
            _ => section.problem(
                &format!("settings[{i}]"),
                format!("expected [\"FeatureName\", value], found {entry}"),
            ),
        }
    }
    settings
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
        if !rig.cameras_of(node).any(|(_, known)| known.id == camera.id) {
            let message = format!("{} is not a camera of node {node} in the rig", camera.id);
            root.problem(&format!("camera[{i}].id"), message);
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

#[cfg(test)]
mod tests {
    use super::{FeatureSetting, FeatureValue, with_common};
    use crate::config::section::Section;
    use std::cell::RefCell;

    fn list(text: &str) -> Vec<FeatureSetting> {
        let pair = |pair: &str| {
            let (feature, value) = pair.split_once('=').expect("feature=value");
            FeatureSetting { feature: feature.to_owned(), value: FeatureValue::Text(value.to_owned()) }
        };
        text.split_whitespace().map(pair).collect()
    }

    /// The list that a camera gets, and the problems with it.
    fn merged(common: &str, own: &str) -> (String, usize) {
        let (table, problems) = (toml::Table::new(), RefCell::default());
        let all = with_common(list(own), &list(common), &Section::root(&table, &problems));
        let words: Vec<String> = all.iter().map(|s| format!("{}={}", s.feature, s.value)).collect();
        (words.join(" "), problems.into_inner().len())
    }

    #[test]
    fn a_list_of_its_own_keeps_its_order_and_its_selectors() {
        let common = "Width=1920 TriggerSelector=FrameStart TriggerMode=On TriggerSource=Line0 Gain=0";
        let basler =
            "TriggerSelector=AcquisitionStart TriggerMode=Off TriggerSelector=FrameStart TriggerMode=On";
        for (own, expected) in [
            ("", common.to_owned()),
            (basler, format!("Width=1920 {basler} TriggerSource=Line0 Gain=0")),
            ("TriggerSource=Line1", common.replace("Line0", "Line1")),
            ("Black=1", format!("{common} Black=1")),
            ("Gain=3 Width=640", common.replace("Width=1920", "Gain=3 Width=640").replace(" Gain=0", "")),
        ] {
            assert_eq!(merged(common, own), (expected, 0), "{own}");
        }
        assert_eq!(merged("", basler), (basler.to_owned(), 0));
        // Which of the two modes is meant?
        assert_eq!(merged(basler, "TriggerMode=Off").1, 1);
        assert_eq!(merged(basler, basler), (basler.to_owned(), 0));
    }
}
