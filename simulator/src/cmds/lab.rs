// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody-sim lab`: the whole laboratory with its nodes in one command, and the faults that an operator may meet.

use super::failure;
use super::run::EndSignals;
use crate::cache::{CachedImages, Manifest};
use crate::disk::{DiskPlan, SimulatedDisk};
use crate::images::ImageSource;
use crate::laboratory::{Laboratory, LaboratoryOptions, NodeFile};
use crate::sequence::{Changes, Run};
use fourdbody::base::ids::CameraId;
use fourdbody::base::{Exit, Fault};
use fourdbody::cmds::Failure;
use fourdbody::control::client::NodeClient;
use std::io::BufRead;
use std::net::Ipv4Addr;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

/// Run a laboratory to try: cameras, HSU, two nodes, a calibration and a body that walks. Open the address that it prints.
///
/// All cameras of a rig and the HSU are simulated; the nodes are those of `fourdbody node`, started here. The cameras run
/// while the console is open, so that it shows the body; Record starts a session. What is typed here unplugs a camera, kills a node, fills a disk or cuts the line to the HSU.
#[derive(clap::Args)]
#[command(after_help = "Example:\n  fourdbody-sim lab --dir target/lab")]
pub struct Args {
    /// Where configuration, recordings and rendered frames go.
    #[arg(long, value_name = "DIR", default_value = "fourdbody-lab")]
    pub dir: PathBuf,
    /// A directory that `fourdbody-sim render` wrote, in place of the walking body.
    #[arg(long, value_name = "DIR")]
    pub frames: Option<PathBuf>,
    /// How many triggers a second.
    #[arg(long, value_name = "HZ", default_value_t = 10.0)]
    pub rate_hz: f64,
    /// Address of the first camera; the others follow.
    #[arg(long, default_value = "127.0.7.11")]
    pub first_address: Ipv4Addr,
    /// Port of the first node's API; the others follow. 0: any free ports.
    #[arg(long, default_value_t = 7401)]
    pub first_port: u16,
    /// The program of the nodes, in place of the `fourdbody` beside this program.
    #[arg(long, value_name = "FILE")]
    pub program: Option<PathBuf>,
    /// Let the cameras stand still until somebody records, although the console is open.
    #[arg(long)]
    pub no_preview: bool,
}

const RIG: &str = include_str!("../../../config/rig.toml");
const SCENARIO: &str = include_str!("../../../config/scenarios/lab.toml");

/// Time in which a node must answer, and cameras must be ready.
const PATIENCE: Duration = Duration::from_secs(60);

const HELP: &str = "\
type, then Enter:
  camera NAME   unplug a camera, and plug it in again
  node NAME     kill a node, and start it again
  line NAME     cut a node's line to the HSU, and mend it
  disk NAME     fill the disk of a node, and empty it (as root, with FUSE)
  power         switch the HSU off and on
  quit          end everything (as Ctrl-C does)";

pub fn run(args: &Args) -> Result<Exit, Failure> {
    let signals = EndSignals::block();
    let dir = std::path::absolute(&args.dir).map_err(Failure::failed)?;
    std::fs::create_dir_all(&dir).map_err(Failure::failed)?;
    let frames = match &args.frames {
        Some(frames) => frames.clone(),
        None => rendered(&dir)?,
    };
    let mut lab = Lab::start(args, &dir, &frames)?;
    let lines = lines_of_standard_input();
    let ended = |patience| signals.wait(Some(patience));
    let Some(url) = lab.console(ended)? else { return Ok(Exit::Done) };
    println!("the console: {url}\n{HELP}");
    open_browser(&url);
    while !ended(Duration::from_millis(200)) {
        for line in lines.try_iter() {
            if line.trim() == "quit" {
                return Ok(Exit::Done);
            }
            match lab.obey(&line) {
                Ok(done) => println!("{done}"),
                Err(reason) => println!("{reason}\n{HELP}"),
            }
        }
        lab.tell_ended_nodes();
    }
    Ok(Exit::Done)
}

/// The frames of the walking body below a directory; they are rendered at the first time.
fn rendered(dir: &Path) -> Result<PathBuf, Failure> {
    let (scenario, frames) = (dir.join("scenario.toml"), dir.join("frames"));
    std::fs::write(dir.join("rig.toml"), RIG).map_err(Failure::failed)?;
    std::fs::write(&scenario, SCENARIO.replace("\"../rig.toml\"", "\"rig.toml\""))
        .map_err(Failure::failed)?;
    let run = Run::load(&scenario, &Changes::default()).map_err(failure)?;
    let mut told = Instant::now();
    run.render(&frames, |done, total| {
        if told.elapsed() > Duration::from_secs(2) || done == total {
            told = Instant::now();
            eprintln!("light: frame {done} of {total}, kept for the next time");
        }
    })
    .map_err(failure)?;
    Ok(frames)
}

/// What is typed, line by line. The thread ends with the input.
fn lines_of_standard_input() -> Receiver<String> {
    let (sender, lines) = channel();
    std::thread::spawn(move || {
        for line in std::io::stdin().lock().lines().map_while(Result::ok) {
            if sender.send(line).is_err() {
                return;
            }
        }
    });
    lines
}

/// Opens the address where there is a desktop.
fn open_browser(url: &str) {
    if ["DISPLAY", "WAYLAND_DISPLAY"].iter().any(|name| std::env::var_os(name).is_some()) {
        let quiet = || Stdio::null();
        // Without the program or a browser the user opens it.
        let _ = Command::new("xdg-open").arg(url).stdin(quiet()).stdout(quiet()).stderr(quiet()).spawn();
    }
}

/// A node's process, which is killed with this.
struct Node {
    file: NodeFile,
    child: Option<Child>,
}

impl Node {
    fn start(&mut self, program: &Path) -> Result<(), Failure> {
        let log =
            std::fs::File::options().create(true).append(true).open(self.log()).map_err(Failure::failed)?;
        let child = Command::new(program)
            .args([Path::new("node"), Path::new("--config"), &self.file.path])
            .stdin(Stdio::null())
            .stderr(log)
            .spawn();
        let child = child.map_err(|e| Failure::failed(format!("{}: {e}", program.display())))?;
        self.child = Some(child);
        Ok(())
    }

    fn kill(&mut self) -> bool {
        self.child.take().is_some_and(|mut child| child.kill().and_then(|()| child.wait()).is_ok())
    }

    fn log(&self) -> PathBuf {
        self.file.path.with_extension("log")
    }

    fn client(&self) -> NodeClient {
        NodeClient::new(&format!("http://127.0.0.1:{}", self.file.port))
    }
}

impl Drop for Node {
    fn drop(&mut self) {
        let Some(child) = &mut self.child else { return };
        // SAFETY: the call gets two numbers; the process was not waited for, so that its number is still its own.
        unsafe { libc::kill(child.id().cast_signed(), libc::SIGTERM) };
        let _ = child.wait();
    }
}

/// The laboratory and its nodes, which end before it.
pub struct Lab {
    nodes: Vec<Node>,
    laboratory: Laboratory,
    program: PathBuf,
    unplugged: Vec<CameraId>,
    cut: Vec<usize>,
    filled: Vec<usize>,
}

impl Lab {
    /// Starts cameras, HSU and nodes below a directory; the cameras show these rendered frames.
    ///
    /// # Errors
    /// Frames or rig are not what `fourdbody-sim render` writes, an address is taken, or a program does not start.
    pub fn start(args: &Args, dir: &Path, frames: &Path) -> Result<Self, Failure> {
        let rig = std::fs::read_to_string(frames.join("rig.toml")).map_err(Failure::failed)?;
        let mut table: toml::Table = rig.parse().map_err(Failure::failed)?;
        table.insert("trigger_rate_hz".to_owned(), args.rate_hz.into());
        let mut options =
            LaboratoryOptions::new(toml::to_string(&table).map_err(Failure::failed)?, &dir.join("run"));
        options.sessions_dir = dir.join("sessions");
        (options.first_address, options.first_port) = (args.first_address, args.first_port);
        options.segment_mib = 1024;
        options.live_preview = !args.no_preview;
        options.calibration = Some(frames.join("calibration.json"));
        let sound = DiskPlan { fallocate: true, ..DiskPlan::default() };
        options.disk = SimulatedDisk::unavailable().is_none().then_some(sound);
        let manifest = Manifest::load(frames).map_err(Failure::failed)?;
        let mut images: Vec<Arc<dyn ImageSource>> = Vec::new();
        let rig = fourdbody::config::Rig::load(&frames.join("rig.toml"))?;
        for (_, camera) in rig.cameras() {
            images
                .push(Arc::new(CachedImages::open(frames, &manifest, &camera.id).map_err(Failure::failed)?));
        }
        let laboratory = Laboratory::start(&options, |_| images.remove(0)).map_err(Failure::failed)?;
        let beside = std::env::current_exe().map_err(Failure::failed)?.with_file_name("fourdbody");
        let program = args.program.clone().unwrap_or(beside);
        let nodes = laboratory.nodes.iter().map(|file| Node { file: file.clone(), child: None }).collect();
        let (unplugged, cut, filled) = (Vec::new(), Vec::new(), Vec::new());
        let mut lab = Self { nodes, laboratory, program, unplugged, cut, filled };
        for node in &mut lab.nodes {
            node.start(&lab.program)?;
        }
        Ok(lab)
    }

    /// The address of the first node once all nodes answer. `ended` waits for a time, and returns whether the laboratory is
    /// to end: then there is no address.
    ///
    /// # Errors
    /// A node does not answer within a minute.
    pub fn console(&self, ended: impl Fn(Duration) -> bool) -> Result<Option<String>, Failure> {
        let deadline = Instant::now() + PATIENCE;
        let wait = |fault: Fault, log: &Path| match Instant::now() > deadline {
            true => {
                Err(Failure::failed(format!("the laboratory is not ready: {fault}; see {}", log.display())))
            }
            false => Ok(ended(Duration::from_millis(200))),
        };
        for node in &self.nodes {
            while let Err(fault) = node.client().status() {
                if wait(fault, &node.log())? {
                    return Ok(None);
                }
            }
        }
        let first = &self.nodes[0];
        Ok(Some(first.client().url().to_owned()))
    }

    /// Does what was typed; what happened, in a sentence.
    ///
    /// # Errors
    /// The words are none of those that the help names, or it cannot be done.
    pub fn obey(&mut self, line: &str) -> Result<String, String> {
        let words: Vec<&str> = line.split_whitespace().collect();
        match words[..] {
            ["camera", name] => self.camera(name),
            ["node", name] => self.node(name),
            ["line", name] => {
                let i = self.number_of(name)?;
                let plugged = toggle(&mut self.cut, i);
                self.laboratory.hsu.set_plugged(i, plugged);
                Ok(format!(
                    "the line of node {name} to the HSU is {}",
                    if plugged { "mended" } else { "cut" }
                ))
            }
            ["disk", name] => {
                let i = self.number_of(name)?;
                let Some(disk) = self.laboratory.disks.get(i) else {
                    return Err(SimulatedDisk::unavailable().unwrap_or_default());
                };
                let emptied = toggle(&mut self.filled, i);
                if emptied {
                    disk.repair()
                } else {
                    disk.fill()
                }
                Ok(format!("the disk of node {name} is {}", if emptied { "empty" } else { "full" }))
            }
            ["power"] => {
                self.laboratory.hsu.power_cycle();
                Ok("the HSU was switched off and on".to_owned())
            }
            [] => Ok(String::new()),
            _ => Err(format!("expected one of these, found {line:?}")),
        }
    }

    fn camera(&mut self, name: &str) -> Result<String, String> {
        let ids: Vec<CameraId> = self.laboratory.rig.cameras().map(|(_, camera)| camera.id.clone()).collect();
        let Some(i) = ids.iter().position(|id| id.as_str() == name) else {
            let names: Vec<&str> = ids.iter().map(CameraId::as_str).collect();
            return Err(format!("expected a camera of {}, found {name}", names.join(", ")));
        };
        if toggle(&mut self.unplugged, ids[i].clone()) {
            self.laboratory.plug(i).map_err(|e| e.to_string())?;
            return Ok(format!("camera {name} is plugged in"));
        }
        self.laboratory.unplug(i);
        Ok(format!("camera {name} is unplugged"))
    }

    fn node(&mut self, name: &str) -> Result<String, String> {
        let i = self.number_of(name)?;
        if self.nodes[i].kill() {
            return Ok(format!("node {name} was killed"));
        }
        self.nodes[i].start(&self.program).map_err(|failure| failure.message)?;
        Ok(format!("node {name} is started"))
    }

    fn number_of(&self, name: &str) -> Result<usize, String> {
        let names = || self.nodes.iter().map(|node| node.file.node.as_str());
        names().position(|node| node == name).ok_or_else(|| {
            format!("expected a node of {}, found {name}", names().collect::<Vec<_>>().join(", "))
        })
    }

    /// Prints which nodes have ended by themselves.
    fn tell_ended_nodes(&mut self) {
        for node in &mut self.nodes {
            let ended = node.child.as_mut().and_then(|child| child.try_wait().ok().flatten());
            if let Some(status) = ended {
                node.child = None;
                println!("node {} has ended: {status}; see {}", node.file.node, node.log().display());
            }
        }
    }
}

/// Takes a thing out of a list where it is in it (true), else puts it there.
fn toggle<T: PartialEq>(list: &mut Vec<T>, thing: T) -> bool {
    match list.iter().position(|x| *x == thing) {
        Some(i) => {
            list.remove(i);
            true
        }
        None => {
            list.push(thing);
            false
        }
    }
}
