// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody cameras setup`: leads through a new bench, and writes the node file's cameras.

use super::connect::backend;
use super::failure::Failure;
use crate::base::Exit;
use crate::base::ids::{CameraId, printable};
use crate::network::Subnet;
use crate::new_bench::{Claim, Given, NamedCamera, Operator, Options, Outcome};
use std::io::{IsTerminal, Write};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};

/// Set a new bench up: find its cameras, give them addresses and names, find their trigger lines, and write the node
/// file.
#[derive(clap::Args)]
#[command(after_help = "\
What it does, in this order: sends a discovery broadcast on every interface; gives cameras in wrong subnets an address,
which they keep; tries the largest packet; has the HSU emit pulses and tries line after line of each camera until the
pulse gives a frame; puts each camera on the head whose pulse it answered; takes frames at the rig's rate; writes a
picture of each beside the node file, and the file's cameras. What else stands in the file stays. The file need not be
there: then it is begun from the options. No node may run meanwhile.

On a terminal it asks questions. Without one, --yes agrees to new addresses, and --camera or --in-order tell which
camera is which.

Exit code 0: the bench can be used; 1: two interfaces of this computer share a subnet; 2: usage or configuration; 5: a
device failed or a camera cannot be used as it is: the problems are printed, and what is known is written.

Examples:
  fourdbody cameras setup --config /etc/fourdbody/node.toml
  fourdbody cameras setup --config node-a.toml --node a --rig rig.toml --hsu /dev/ttyUSB0 --yes \\
      --camera h0_up=40012345 --camera h0_low=00:30:53:01:02:03 --in-order")]
pub struct SetupArgs {
    /// The node file; begun if it is not there.
    #[arg(long, value_name = "FILE")]
    config: PathBuf,
    /// This computer's name in the rig.
    #[arg(long, value_name = "NAME")]
    node: Option<String>,
    /// The rig file, relative to the node file.
    #[arg(long, value_name = "FILE")]
    rig: Option<PathBuf>,
    /// The HSU's serial device, for instance /dev/ttyUSB0.
    #[arg(long, value_name = "DEVICE")]
    hsu: Option<PathBuf>,
    /// The directory in which sessions are recorded.
    #[arg(long, value_name = "DIR")]
    sessions: Option<PathBuf>,
    /// Where the node's API listens.
    #[arg(long, value_name = "ADDRESS:PORT")]
    listen: Option<SocketAddr>,
    /// Which camera is which: its name in the rig, and its serial number, address, MAC or user-defined name.
    #[arg(long = "camera", value_name = "ID=WHO", value_parser = claim)]
    cameras: Vec<Claim>,
    /// Name cameras of one head in the order of their serial numbers, where nothing else tells them apart.
    #[arg(long)]
    in_order: bool,
    /// Only cameras with addresses in this network, and those named by --camera.
    #[arg(long, value_name = "ADDRESS/BITS")]
    network: Option<Subnet>,
    /// Agree to every question without asking it.
    #[arg(long)]
    yes: bool,
    /// Print JSON instead of text.
    #[arg(long)]
    json: bool,
}

fn claim(text: &str) -> Result<Claim, String> {
    let (id, who) = text.split_once('=').ok_or_else(|| format!("expected ID=WHO, found {text:?}"))?;
    if id.is_empty() || who.is_empty() {
        return Err(format!("expected ID=WHO, found {text:?}"));
    }
    Ok(Claim { id: CameraId(id.to_owned()), who: who.to_owned() })
}

/// The person at the bench, on the terminal or by the options.
struct Person {
    terminal: bool,
    yes: bool,
}

impl Person {
    /// The answer to a question; `None` without a terminal, or at the end of its input.
    fn ask(&self, question: &str) -> Option<String> {
        if !self.terminal {
            return None;
        }
        eprint!("{} ", printable(question));
        std::io::stderr().flush().ok()?;
        let answer = std::io::stdin().lines().next()?.ok()?;
        Some(answer.trim().to_lowercase())
    }
}

impl Operator for Person {
    fn tell(&mut self, line: &str) {
        eprintln!("{}", printable(line));
    }

    fn agrees(&mut self, question: &str) -> bool {
        self.yes || self.ask(&format!("{question} [y/N]")).is_some_and(|answer| answer.starts_with('y'))
    }

    fn does(&mut self, what: &str) -> bool {
        self.ask(&format!("{what}, then press Enter (q: leave it):")).is_some_and(|answer| answer != "q")
    }

    fn is_there(&self) -> bool {
        self.terminal
    }
}

/// A path as the service sees it, wherever that runs.
fn absolute(path: &Path) -> PathBuf {
    std::path::absolute(path).unwrap_or_else(|_| path.to_owned())
}

pub fn setup(args: &SetupArgs) -> Result<Exit, Failure> {
    let mut backend = backend()?;
    let options = Options {
        path: args.config.clone(),
        given: Given {
            node: args.node.clone(),
            rig: args.rig.clone(),
            hsu: args.hsu.as_deref().map(absolute),
            sessions: args.sessions.as_deref().map(absolute),
            listen: args.listen,
        },
        claims: args.cameras.clone(),
        in_order: args.in_order,
        network: args.network,
    };
    let terminal = std::io::stdin().is_terminal() && std::io::stderr().is_terminal();
    let mut person = Person { terminal, yes: args.yes };
    let outcome = crate::new_bench::set_up(&options, backend.as_mut(), &mut person)?;
    match args.json {
        true => println!("{}", serde_json::to_string_pretty(&outcome).unwrap_or_default()),
        false => print(&outcome),
    }
    let problems: Vec<String> =
        outcome.problems.iter().flat_map(|problem| problem.lines()).map(printable).collect();
    match outcome.problems.is_empty() {
        true => Ok(Exit::Done),
        false => Err(Failure::device(format!(
            "{} problems; solve them, or write the settings that they name into {}, and set up again:\n{}",
            outcome.problems.len(),
            outcome.file.display(),
            problems.join("\n")
        ))),
    }
}

fn print(outcome: &Outcome) {
    println!(
        "{:<10} {:<16} {:<14} {:<12} {:>9} {:>10} {:>10}  picture",
        "camera", "address", "serial", "line", "stamp", "packet", "frames"
    );
    for camera in &outcome.cameras {
        let NamedCamera { id, device, trigger_line, stamp_us, arrival_us, frames_at_rate, .. } = camera;
        let ms = |us: &Option<f64>| us.map_or_else(|| "-".to_owned(), |us| format!("{:.1} ms", us / 1000.0));
        let frames =
            frames_at_rate.map_or_else(|| "-".to_owned(), |(frames, of)| format!("{frames} of {of}"));
        let picture =
            camera.picture.as_ref().map_or_else(|| "-".to_owned(), |path| path.display().to_string());
        println!(
            "{:<10} {:<16} {:<14} {:<12} {:>9} {:>10} {frames:>10}  {picture}",
            id.as_str(),
            printable(&device.place),
            printable(&device.serial),
            printable(trigger_line.as_deref().unwrap_or("-")),
            ms(stamp_us),
            ms(arrival_us),
        );
    }
    outcome.notes.iter().for_each(|line| println!("note: {}", printable(line)));
    println!("written: {}; next: fourdbody doctor --config {0}", outcome.file.display());
}
