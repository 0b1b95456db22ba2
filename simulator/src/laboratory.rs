// SPDX-License-Identifier: MIT OR Apache-2.0
//! The laboratory in one process: all cameras of a rig on loopback addresses, the HSU on ptys, and the
//! configuration files with which real nodes drive them.

use crate::disk::{DiskPlan, SimulatedDisk};
use crate::faults::{CameraFaults, FaultPlan, HsuFaults, TruthLog};
use crate::gige::{
    ActionFilter, CameraError, CameraOptions, ClockOptions, Described, Habits, Make, SimulatedCamera,
};
use crate::hsu::{HsuOptions, LtcSource, SimulatedHsu};
use crate::images::ImageSource;
use crossbeam_channel::unbounded;
use fourdbody::base::ids::{CameraId, NodeId};
use fourdbody::config::{Rig, SocketMode};
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::io;
use std::net::Ipv4Addr;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

/// The options of a laboratory: rig, addresses, cameras and faults.
#[derive(Debug, Clone)]
pub struct LaboratoryOptions {
    /// The rig file's text; it is copied beside the node files.
    pub rig_text: String,
    /// Where node files, the rig file and the links to the HSU's ptys go.
    pub run_dir: PathBuf,
    /// Where the nodes shall record.
    pub sessions_dir: PathBuf,
    /// Address of the first camera; the others follow.
    pub first_address: Ipv4Addr,
    /// Port of the first node's API; the others follow. 0: any free ports.
    pub first_port: u16,
    /// How much free disk the nodes keep, MiB.
    pub reserve_mib: u64,
    /// Size of the nodes' segments, MiB.
    pub segment_mib: u64,
    pub buffers_per_camera: usize,
    /// Block id of the first frame of every acquisition: 1, unless a test wants the ids to wrap early.
    pub first_block_id: u64,
    /// How the nodes receive packets.
    pub socket: SocketMode,
    /// Bytes of the cameras' packets, with all headers.
    pub packet_bytes: u32,
    /// What cameras do differently from others, by their names.
    pub habits: BTreeMap<String, Habits>,
    /// Makes that cameras are like, by the cameras' names; the others are the simulator's own.
    pub makes: BTreeMap<String, Arc<Make>>,
    /// Published descriptions that cameras are behind, by the cameras' names.
    pub described: BTreeMap<String, Arc<Described>>,
    /// Node files have what such cameras need, as a user writes it who knows them; else tests or commands must.
    pub make_words: bool,
    /// Faults of the cameras; what was injected is written to `faults.jsonl` in the run directory.
    pub faults: Option<FaultPlan>,
    /// Disks that misbehave, one for each node that it names; what they did is written to `faults.jsonl` as well. Needs
    /// FUSE, see [`SimulatedDisk::unavailable`]. What was recorded lies in `sessions_dir` all the same.
    pub disk: Option<DiskPlan>,
    /// The cameras' images go on from session to session instead of starting anew with each.
    pub carry_on: bool,
    /// Inputs of the HSU that swing by themselves: line and frequency in Hz.
    pub inputs: Vec<(u8, f64)>,
    /// The input that carries time code, in the nodes' files.
    pub time_code_input: Option<u8>,
    /// Time code that is played from the beginning.
    pub ltc: Option<LtcSource>,
    /// The cameras have their names in the rig as names of their own.
    pub user_names: bool,
    /// The nodes know each other.
    pub peers: bool,
    /// What the nodes take quick looks with.
    pub calibration: Option<PathBuf>,
    /// Cameras run for an open console while nothing is recorded.
    pub live_preview: bool,
    /// Keys of the nodes' `[trigger]` tables, in place of an HSU.
    pub trigger: Option<String>,
    /// What the network makes of action commands, by the cameras' names.
    pub action_fates: BTreeMap<String, ActionFilter>,
}

impl LaboratoryOptions {
    /// A laboratory below `run_dir`, with these rig and defaults for the rest.
    pub fn new(rig_text: String, run_dir: &Path) -> Self {
        Self {
            rig_text,
            run_dir: run_dir.to_owned(),
            sessions_dir: run_dir.join("sessions"),
            first_address: Ipv4Addr::new(127, 0, 7, 11),
            first_port: 7401,
            reserve_mib: 256,
            segment_mib: 16_384,
            buffers_per_camera: 32,
            first_block_id: 1,
            socket: SocketMode::Auto,
            packet_bytes: 9000,
            habits: BTreeMap::new(),
            makes: BTreeMap::new(),
            described: BTreeMap::new(),
            make_words: true,
            faults: None,
            disk: None,
            carry_on: false,
            inputs: Vec::new(),
            time_code_input: None,
            ltc: None,
            user_names: true,
            peers: true,
            calibration: None,
            live_preview: true,
            trigger: None,
            action_fates: BTreeMap::new(),
        }
    }
}

/// Why the laboratory cannot be set up.
#[derive(Debug, thiserror::Error)]
pub enum LaboratoryError {
    /// The rig file is wrong.
    #[error("the rig file has problems: {0}")]
    Rig(String),
    /// A file, link or pty could not be made.
    #[error("{what}: {source}")]
    Io { what: String, source: io::Error },
    /// A camera did not start.
    #[error("camera {id}: {source}")]
    Camera {
        /// Its name in the rig.
        id: CameraId,
        source: CameraError,
    },
}

/// One node's configuration, ready to be used.
#[derive(Debug, Clone)]
pub struct NodeFile {
    pub node: NodeId,
    pub path: PathBuf,
    /// The port of its API.
    pub port: u16,
}

/// Cameras and HSU, running until dropped.
pub struct Laboratory {
    pub rig: Rig,
    pub cameras: Vec<SimulatedCamera>,
    setups: Vec<CameraOptions>,
    /// With one link per node, in the order of the nodes' names.
    pub hsu: SimulatedHsu,
    /// One per node, in the order of their names.
    pub nodes: Vec<NodeFile>,
    /// Of the nodes that have one, in the same order.
    pub disks: Vec<SimulatedDisk>,
}

impl Laboratory {
    /// Starts everything; `images` gives each camera its light.
    pub fn start(
        options: &LaboratoryOptions,
        mut images: impl FnMut(&CameraId) -> Arc<dyn ImageSource>,
    ) -> Result<Self, LaboratoryError> {
        let io_error = |what: &Path| {
            let what = what.display().to_string();
            move |source| LaboratoryError::Io { what, source }
        };
        let table = options.rig_text.parse().map_err(|e| LaboratoryError::Rig(format!("not TOML: {e}")))?;
        let rig = Rig::from_table(&table).map_err(|problems| {
            LaboratoryError::Rig(problems.iter().map(ToString::to_string).collect::<Vec<_>>().join("; "))
        })?;
        std::fs::create_dir_all(&options.run_dir).map_err(io_error(&options.run_dir))?;
        let rig_path = options.run_dir.join("rig.toml");
        std::fs::write(&rig_path, &options.rig_text).map_err(io_error(&rig_path))?;

        let (mut cameras, mut setups) = (Vec::new(), Vec::new());
        let truth = open_truth(options)?;
        let plan = options.faults.as_ref().map(|plan| Arc::new(plan.clone()));
        let faults = plan.zip(truth.clone());
        let mut wires = Vec::new();
        for (number, (head, camera)) in (0u32..).zip(rig.cameras()) {
            let address = camera_address(options, number);
            let (wire, triggers) = unbounded();
            let mut setup = CameraOptions::new(&format!("SIM{number:04}"), address, images(&camera.id));
            if options.user_names {
                setup.user_name = camera.id.to_string();
            }
            setup.triggers = triggers;
            setup.first_block_id = options.first_block_id;
            setup.habits = options.habits.get(camera.id.as_str()).copied().unwrap_or_default();
            setup.action_fates = options.action_fates.get(camera.id.as_str()).cloned();
            setup.make = options.makes.get(camera.id.as_str()).cloned();
            setup.described = options.described.get(camera.id.as_str()).cloned();
            if setup.make.is_some() || setup.described.is_some() {
                setup.habits.nominal = Some(Duration::from_nanos(head.exposure_ns));
            }
            // Every clock of its own, as in the laboratory.
            setup.clock = ClockOptions {
                offset_ns: 1_000_000_000 * (1 + u64::from(number)),
                drift_ppm: f64::from(number) * 10.0 - 35.0,
            };
            setup.faults = faults.as_ref().map(|(plan, truth)| CameraFaults {
                plan: Arc::clone(plan),
                camera: camera.id.to_string(),
                truth: Arc::clone(truth),
            });
            if setup.faults.is_some() {
                // Refused is what the plan refuses: a camera's memory must hold what is requested late.
                setup.resend_frames = FAULTY_RESEND_FRAMES;
            }
            setups.push(setup.clone());
            let started = SimulatedCamera::start(setup);
            cameras
                .push(started.map_err(|source| LaboratoryError::Camera { id: camera.id.clone(), source })?);
            let place = rig.heads.iter().position(|other| other.id == head.id);
            wires.extend(place.map(|place| (place, wire)));
        }
        let disks = mount_disks(options, &rig, truth)?;
        let nodes = write_node_files(options, &rig)?;
        let links = nodes.iter().map(|node| hsu_link(options, &node.node)).collect();
        let mut setup = HsuOptions {
            links,
            cameras: wires,
            carry_on: options.carry_on,
            inputs: options.inputs.clone(),
            ltc: options.ltc,
            ..HsuOptions::default()
        };
        if let Some((plan, truth)) = faults.filter(|(plan, _)| !plan.hsu.is_empty()) {
            setup.line = Some(plan.hsu.line);
            let nodes = nodes.iter().map(|node| node.node.to_string()).collect();
            setup.faults = Some(HsuFaults { plan, nodes, truth });
        }
        let hsu = SimulatedHsu::start(setup)
            .map_err(|source| LaboratoryError::Io { what: "the HSU's ptys".to_owned(), source })?;
        Ok(Self { rig, cameras, setups, hsu, nodes, disks })
    }

    /// Unplugs a camera: no packet comes from it any more.
    pub fn unplug(&mut self, camera: usize) {
        self.cameras[camera].switch_off();
    }

    /// Plugs a camera in again: power-on settings, block ids and clock from the beginning.
    pub fn plug(&mut self, camera: usize) -> Result<(), CameraError> {
        let setup = self.setups[camera].clone();
        // Triggers that came while no node was connected.
        setup.triggers.try_iter().for_each(drop);
        self.cameras[camera] = SimulatedCamera::start(setup)?;
        Ok(())
    }

    /// The nodes' URLs, separated by commas, as `fourdbody capture --nodes` takes them.
    pub fn urls(&self) -> String {
        let urls: Vec<String> =
            self.nodes.iter().map(|node| format!("http://127.0.0.1:{}", node.port)).collect();
        urls.join(",")
    }
}

/// Frames that cameras with injected faults keep for resend requests.
const FAULTY_RESEND_FRAMES: usize = 256;
/// Where what was injected is written down, in the run directory.
pub const TRUTH_FILE: &str = "faults.jsonl";

fn open_truth(options: &LaboratoryOptions) -> Result<Option<Arc<TruthLog>>, LaboratoryError> {
    if options.faults.is_none() && options.disk.is_none() {
        return Ok(None);
    }
    let path = options.run_dir.join(TRUTH_FILE);
    let what = path.display().to_string();
    let truth = TruthLog::create(&path).map_err(|source| LaboratoryError::Io { what, source })?;
    Ok(Some(Arc::new(truth)))
}

fn mount_disks(
    options: &LaboratoryOptions,
    rig: &Rig,
    truth: Option<Arc<TruthLog>>,
) -> Result<Vec<SimulatedDisk>, LaboratoryError> {
    let mut disks = Vec::new();
    let nodes = rig.nodes();
    for (plan, node) in options.disk.iter().flat_map(|plan| nodes.iter().map(move |node| (plan, node))) {
        if plan.concerns(node.as_str()) {
            let at = disk_dir(options, node);
            let what = format!("a simulated disk at {}", at.display());
            let mounted =
                SimulatedDisk::mount(plan, node.as_str(), &options.sessions_dir, &at, truth.clone());
            disks.push(mounted.map_err(|source| LaboratoryError::Io { what, source })?);
        }
    }
    Ok(disks)
}

/// Where the disk of a node is mounted.
fn disk_dir(options: &LaboratoryOptions, node: &NodeId) -> PathBuf {
    options.run_dir.join(format!("disk-{node}"))
}

/// The directory in which a node records its sessions.
fn sessions_dir(options: &LaboratoryOptions, node: &NodeId) -> PathBuf {
    match &options.disk {
        Some(plan) if plan.concerns(node.as_str()) => disk_dir(options, node),
        _ => options.sessions_dir.clone(),
    }
}

fn camera_address(options: &LaboratoryOptions, number: u32) -> Ipv4Addr {
    Ipv4Addr::from_bits(options.first_address.to_bits().wrapping_add(number))
}

fn hsu_link(options: &LaboratoryOptions, node: &NodeId) -> PathBuf {
    options.run_dir.join(format!("hsu-{node}"))
}

fn write_node_files(options: &LaboratoryOptions, rig: &Rig) -> Result<Vec<NodeFile>, LaboratoryError> {
    let mut files = Vec::new();
    for (number, node) in (0u16..).zip(rig.nodes()) {
        let path = options.run_dir.join(format!("node-{node}.toml"));
        let port_error = |source| LaboratoryError::Io { what: "a free port".to_owned(), source };
        let port = match options.first_port {
            0 => free_port().map_err(port_error)?,
            first => first.wrapping_add(number),
        };
        files.push(NodeFile { node, path, port });
    }
    for file in &files {
        let text = node_text(options, rig, file, &files);
        std::fs::write(&file.path, text)
            .map_err(|source| LaboratoryError::Io { what: file.path.display().to_string(), source })?;
    }
    Ok(files)
}

/// A port that was free a moment ago, and that no other laboratory of this process was given.
fn free_port() -> io::Result<u16> {
    static GIVEN: Mutex<BTreeSet<u16>> = Mutex::new(BTreeSet::new());
    loop {
        let port = std::net::TcpListener::bind("127.0.0.1:0")?.local_addr()?.port();
        if GIVEN.lock().unwrap_or_else(PoisonError::into_inner).insert(port) {
            return Ok(port);
        }
    }
}

fn node_text(options: &LaboratoryOptions, rig: &Rig, file: &NodeFile, all: &[NodeFile]) -> String {
    let NodeFile { node, port, .. } = file;
    let quoted = |path: &Path| format!("{:?}", path.display().to_string());
    let absolute = |path: &Path| std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    let mut text = format!(
        "# Written by the simulator: node {node} of the simulated laboratory.\n\
         format = 1\nnode = \"{node}\"\nrig = \"rig.toml\"\n\n\
         [api]\nlisten = \"127.0.0.1:{port}\"\naudit = {}\n\n\
         {}\n\
         [storage]\nsessions_dir = {}\nreserve_mib = {}\nsegment_mib = {}\n\n\
         [acquisition]\nbuffers_per_camera = {}\npacket_bytes = {}\nsocket = \"{}\"\n",
        // Not on a disk that may be simulated, and not in the other node's file.
        quoted(&absolute(&options.run_dir.join(format!("audit-{node}.jsonl")))),
        match &options.trigger {
            Some(trigger) => format!("[trigger]\n{trigger}\n"),
            None => {
                let input = options
                    .time_code_input
                    .map_or_else(String::new, |line| format!("time_code_input = {line}\n"));
                format!("[hsu]\ndevice = {}\n{input}", quoted(&absolute(&hsu_link(options, node))))
            }
        },
        quoted(&absolute(&sessions_dir(options, node))),
        options.reserve_mib,
        options.segment_mib,
        options.buffers_per_camera,
        options.packet_bytes,
        match options.socket {
            SocketMode::Auto => "auto",
            SocketMode::Standard => "standard",
        },
    );
    // Writing into a String cannot fail.
    for peer in all.iter().filter(|peer| options.peers && peer.node != *node) {
        let NodeFile { node, port, .. } = peer;
        let _ = write!(text, "\n[[api.peers]]\nname = \"{node}\"\nurl = \"http://127.0.0.1:{port}\"\n");
    }
    if !options.live_preview {
        text.push_str("\n[console]\nlive_preview = false\n");
    }
    if let Some(calibration) = &options.calibration {
        let _ = write!(text, "\n[quick_look]\ncalibration = {}\n", quoted(&absolute(calibration)));
    }
    for (number, (_, camera)) in (0u32..).zip(rig.cameras()) {
        if camera.node != *node {
            continue;
        }
        let words = match options.makes.get(camera.id.as_str()) {
            None if options.trigger.is_some() || options.described.contains_key(camera.id.as_str()) => {
                String::new()
            }
            None => OWN_WORDS.to_owned(),
            Some(make) if options.make_words => make.session_words(),
            Some(_) => String::new(),
        };
        let _ = write!(
            text,
            "\n[[camera]]\nid = \"{}\"\naddress = \"{}\"\n{words}",
            camera.id,
            camera_address(options, number)
        );
    }
    text
}

/// The entries of a node file for the simulator's own cameras; the exposure is the rig's.
const OWN_WORDS: &str = "trigger_line = \"Line0\"\n";
