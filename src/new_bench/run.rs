// SPDX-License-Identifier: MIT OR Apache-2.0
//! The steps of a new bench, in their order: who is there, addresses, packets, pulses, names, the rig's rate, pictures, the
//! node file.

use super::addresses;
use super::begun::{Begun, begin_file};
use super::found::Found;
use super::lines::{BenchCamera, Unit, find};
use super::node_file::{Entry, Given, with_cameras};
use super::outcome::{NamedCamera, Outcome, comment, picture};
use super::packets::{Burst, largest};
use super::pulses::Reception;
use super::roles::{Claim, Known, Look, Role, assign, by_heads, covered};
use super::who::{left_out, those_meant, who_answers};
use crate::base::ids::CameraId;
use crate::base::write_whole;
use crate::base::{Exit, Fault};
use crate::camera::{Camera, CameraBackend, Wishes};
use crate::config::{NodeConfig, PacketDelay};
use crate::hsu::{HsuTimeouts, HsuTiming, TriggerUnit};
use crate::network::{Answer, Interface, Subnet, interfaces, shared_subnets, without_link};
use std::collections::BTreeMap;
use std::io::Write as _;
use std::path::{Path, PathBuf};

/// At the rig's rate so many triggers follow the warm-up.
const TRIGGERS: u32 = 20;

/// Times that pulses may leave a camera's picture out, while lenses are covered.
const LOOKS: usize = 3;

/// What is to be set up.
#[derive(Debug, Clone)]
pub struct Options {
    /// The node file; it need not be there.
    pub path: PathBuf,
    /// What it says before its cameras.
    pub given: Given,
    /// Which camera is which.
    pub claims: Vec<Claim>,
    /// Cameras of a head that nothing else tells apart are named in the order of their serial numbers.
    pub in_order: bool,
    /// Only cameras with addresses in this network, and those in `claims`.
    pub network: Option<Subnet>,
}

/// Who stands at the bench.
pub trait Operator {
    /// Says what is going on.
    fn tell(&mut self, line: &str);
    /// Whether to do this.
    fn agrees(&mut self, question: &str) -> bool;
    /// Waits until somebody has done this; `false` where nobody is there.
    fn does(&mut self, what: &str) -> bool;
    /// Whether somebody is there.
    fn is_there(&self) -> bool;
}

pub(super) fn usage(message: impl ToString) -> Fault {
    Fault::new(Exit::Usage, message)
}

fn device(problems: &[String]) -> Fault {
    Fault::new(Exit::Device, problems.join("\n"))
}

/// Sets a bench up.
///
/// # Errors
/// What ends it before the file can be written. Later problems are in [`Outcome::problems`], and the file says what is known.
pub fn set_up(
    options: &Options,
    backend: &mut dyn CameraBackend,
    operator: &mut dyn Operator,
) -> Result<Outcome, Fault> {
    let begun = begin_file(options)?;
    let interfaces = interfaces();
    let wanted: Vec<(CameraId, usize)> = begun
        .rig
        .heads
        .iter()
        .enumerate()
        .flat_map(|(number, head)| head.cameras.iter().map(move |camera| (number, camera)))
        .filter(|(_, camera)| camera.node == begun.node)
        .map(|(number, camera)| (camera.id.clone(), number))
        .collect();
    let everybody = who_answers(&interfaces, operator);
    let answers = those_meant(options, &everybody);
    let outside = left_out(&answers, &everybody, &interfaces, options.network);
    outside.iter().for_each(|line| operator.tell(line));
    let listed = backend.list();
    let mut found: Vec<Found> = answers.iter().map(Found::of_network).collect();
    found.extend(listed.iter().filter_map(Found::of_bus));
    found.iter().for_each(|found| operator.tell(&format!("found {found}")));
    let roles = assign(&wanted, &found, &options.claims, &begun.in_file).map_err(|mut problems| {
        // Where one may be that is missing.
        problems.extend(outside.iter().cloned());
        let down = without_link(Path::new("/sys"));
        if found.len() < wanted.len() && !down.is_empty() {
            problems.push(format!("no link on {}: check cables and switches there", down.join(", ")));
        }
        device(&problems)
    })?;
    ask_before_pulses(options, &roles, &found, operator)?;
    no_shared_subnet(&roles, &found, &interfaces)?;

    let order = wanted.into_iter().map(|(id, _)| id).collect();
    let mut work = Work {
        begun,
        interfaces,
        order,
        roles,
        away: Vec::new(),
        found,
        told: outside,
        problems: Vec::new(),
    };
    work.addresses((&answers, &everybody), options.network, operator)?;
    work.measure(options, backend, operator)
}

/// Cameras of one head that only their order tells apart: somebody must be there, or have said so.
fn ask_before_pulses(
    options: &Options,
    roles: &[Role],
    found: &[Found],
    operator: &dyn Operator,
) -> Result<(), Fault> {
    let open: Vec<&Role> = roles.iter().filter(|role| role.known == Known::InOrder).collect();
    let several = open.iter().any(|role| open.iter().filter(|other| other.head == role.head).count() > 1);
    if !several || options.in_order || operator.is_there() {
        return Ok(());
    }
    let ids: Vec<&str> = open.iter().map(|role| role.id.as_str()).collect();
    let cameras: Vec<String> = open.iter().map(|role| found[role.camera].to_string()).collect();
    Err(usage(format!(
        "which of these is which of {} cannot be known: {}\nsay --camera ID=SERIAL for each, or --in-order for the order of \
         their serial numbers, or run it on a terminal and cover lenses",
        ids.join(", "),
        cameras.join("; ")
    )))
}

/// Two interfaces in the subnet of a camera: this host sends by one of them, whichever the camera hangs on.
fn no_shared_subnet(roles: &[Role], found: &[Found], interfaces: &[Interface]) -> Result<(), Fault> {
    let used = |name: &str| roles.iter().any(|role| found[role.camera].interface.as_deref() == Some(name));
    let shared = shared_subnets(interfaces).into_iter().filter(|(_, one, other)| used(one) || used(other));
    let problems: Vec<String> = shared
        .map(|(subnet, one, other)| {
            format!(
                "{one} and {other} are both in the subnet of {subnet}, and packets for a camera leave by one of them alone: \
                 give each port a subnet of its own (`ip address`), then set up again"
            )
        })
        .collect();
    match problems.is_empty() {
        true => Ok(()),
        false => Err(Fault::new(Exit::Failure, problems.join("\n"))),
    }
}

struct Work {
    begun: Begun,
    interfaces: Vec<Interface>,
    /// The cameras of this node, in the rig's order.
    order: Vec<CameraId>,
    /// Those that can be measured.
    roles: Vec<Role>,
    /// Those that are held, or whose packets do not arrive: they have names and addresses, and nothing else is known.
    away: Vec<Role>,
    found: Vec<Found>,
    told: Vec<String>,
    problems: Vec<String>,
}

impl Work {
    /// Gives cameras in wrong subnets addresses, and has all keep theirs.
    fn addresses(
        &mut self,
        (answers, everybody): (&[Answer], &[Answer]),
        network: Option<Subnet>,
        operator: &mut dyn Operator,
    ) -> Result<(), Fault> {
        let ours: Vec<Answer> =
            self.roles.iter().filter_map(|role| answers.get(role.camera)).cloned().collect();
        let moves = addresses::moves(&ours, everybody, &self.interfaces, network)
            .map_err(|problems| device(&problems))?;
        for next in &moves {
            let question = format!(
                "the camera {} is in a wrong subnet: give it {} on {}?",
                next.mac, next.to, next.interface
            );
            if !operator.agrees(&question) {
                return Err(usage(format!(
                    "{question} say --yes, or set its address with its vendor's program"
                )));
            }
        }
        if !moves.is_empty() {
            addresses::carry_out(&moves, &self.interfaces).map_err(|problems| device(&problems))?;
        }
        for mut answer in ours {
            if let Some(next) = moves.iter().find(|next| next.mac == answer.mac) {
                answer.address = next.to.address;
                let found = self.found.iter_mut().filter(|found| found.mac == Some(next.mac));
                found.for_each(|found| found.place = next.to.address.to_string());
                operator.tell(&format!("{answer} has its new address"));
            }
            match addresses::is_kept(&answer) {
                Ok(true) => {}
                Ok(false)
                    if operator.agrees(&format!("{answer} does not keep its address: have it do so?")) =>
                {
                    match addresses::keep(&answer, &self.interfaces) {
                        Ok(()) => operator.tell(&format!("{answer} keeps its address")),
                        Err(told) => self.told.push(told),
                    }
                }
                Ok(false) => self.told.push(format!("{answer} has another address when its power was off")),
                Err(told) => self.told.push(told),
            }
        }
        Ok(())
    }

    fn entry(&self, role: &Role) -> Entry {
        Entry {
            id: role.id.clone(),
            address: self.found[role.camera].place.clone(),
            trigger_line: None,
            packet_delay: None,
            told: None,
        }
    }

    /// With what was measured.
    fn measured(&self, role: &Role, bench: &BenchCamera) -> Entry {
        Entry {
            trigger_line: bench.wired.as_ref().and_then(|wired| wired.line.clone()),
            // Of one that could not be set up it is not known whether it has that.
            packet_delay: bench.wishes.words.packet_delay.filter(|_| bench.wired.is_some()),
            ..self.entry(role)
        }
    }

    /// A camera that cannot be measured.
    fn unmeasured(&self, role: &Role) -> Entry {
        let told = format!("{}, not measured", comment(&self.found[role.camera], role.known, None));
        Entry { told: Some(told), ..self.entry(role) }
    }

    /// Where a camera stands in the rig.
    fn place(&self, id: &CameraId) -> usize {
        self.order.iter().position(|known| known == id).unwrap_or(usize::MAX)
    }

    /// The file as it is known now.
    fn text(&self, entries: &[Entry], packet_bytes: Option<u32>) -> Result<String, Fault> {
        let away = self.away.iter().map(|role| self.unmeasured(role));
        let mut entries: Vec<Entry> = entries.iter().cloned().chain(away).collect();
        entries.sort_by_key(|entry| self.place(&entry.id));
        with_cameras(&self.begun.text, &entries, packet_bytes).map_err(usage)
    }

    /// Opens a camera and tries its packets.
    fn reach(
        &self,
        role: &Role,
        backend: &mut dyn CameraBackend,
    ) -> Result<(Box<dyn Camera>, Option<u32>), String> {
        let found = &self.found[role.camera];
        let at = self.interfaces.iter().find(|at| found.interface.as_deref() == Some(at.name.as_str()));
        let mut camera =
            backend.open(&found.place).map_err(|error| format!("camera {} ({found}): {error}", role.id))?;
        let size = largest(camera.as_mut(), at.and_then(|at| at.mtu))
            .map_err(|error| format!("camera {} ({found}): its packets cannot be tried: {error}", role.id))?;
        Ok((camera, size))
    }

    /// Opens the cameras, finds their lines, names them, and writes the file.
    fn measure(
        mut self,
        options: &Options,
        backend: &mut dyn CameraBackend,
        operator: &mut dyn Operator,
    ) -> Result<Outcome, Fault> {
        let path = &options.path;
        let entries: Vec<Entry> = self.roles.iter().map(|role| self.entry(role)).collect();
        let read = |text: &str| NodeConfig::from_text(text, path).map_err(usage);
        read(&self.text(&entries, None)?)?;
        let (mut opened, mut sizes) = (Vec::new(), Vec::new());
        for role in std::mem::take(&mut self.roles) {
            match self.reach(&role, backend) {
                Ok((camera, size)) => {
                    opened.push(camera);
                    sizes.push(size);
                    self.roles.push(role);
                }
                // The others are measured all the same.
                Err(problem) => {
                    operator.tell(&problem);
                    self.problems.push(problem);
                    self.away.push(role);
                }
            }
        }
        let packet_bytes = sizes.iter().flatten().min().copied();
        if self.roles.is_empty() {
            return self.finish(path, packet_bytes, &mut [], Ok(Vec::new()));
        }
        let entries: Vec<Entry> = self.roles.iter().map(|role| self.entry(role)).collect();
        let config = read(&self.text(&entries, packet_bytes)?)?;
        let delays = self.packet_delays(&config);
        let mut cameras = Vec::new();
        for (((camera, role), delay), largest) in opened.into_iter().zip(&self.roles).zip(delays).zip(sizes) {
            let Some(known) = config.cameras.iter().find(|known| known.id == role.id) else { continue };
            let mut wishes = Wishes::of(&config, known);
            if wishes.words.packet_delay.is_none() && !wishes.left_to_settings("packet_delay_us") {
                wishes.words.packet_delay = delay;
            }
            let found = self.found[role.camera].clone();
            let (wired, problems, told) = (None, Vec::new(), Vec::new());
            cameras.push(BenchCamera { found, camera, wishes, largest, wired, problems, told });
        }
        let hsu = TriggerUnit::of(&config).connect(&config.node, &HsuTimeouts::default());
        match hsu {
            Ok(hsu) => {
                let unit = Unit {
                    hsu: &hsu,
                    node: &config.node,
                    heads: config.rig.heads.len(),
                    reception: Reception { packet_bytes: config.packet_bytes, socket: config.socket },
                };
                let pulsed = find(&unit, &mut cameras, |line| operator.tell(line))
                    .map_err(|error| error.to_string())
                    .and_then(|()| self.names(options, &unit, &mut cameras, operator));
                let frames = match pulsed {
                    Ok(()) => self.at_rate(path, &unit, packet_bytes, &mut cameras),
                    Err(error) => Err(error),
                };
                self.finish(path, packet_bytes, &mut cameras, frames)
            }
            Err(error) => self.finish(path, packet_bytes, &mut cameras, Err(error.to_string())),
        }
    }

    /// The packet delay that each camera's link needs, and what its link does not carry.
    fn packet_delays(&mut self, config: &NodeConfig) -> Vec<Option<PacketDelay>> {
        let interface = |role: &Role| self.found[role.camera].interface.clone();
        let mut shared: BTreeMap<String, usize> = BTreeMap::new();
        for name in self.roles.iter().chain(&self.away).filter_map(interface) {
            *shared.entry(name).or_default() += 1;
        }
        let burst = |role: &Role| {
            let name = interface(role)?;
            let size = config.rig.cameras().find(|(_, known)| known.id == role.id)?.1;
            let burst = Burst {
                cameras: shared[&name],
                frame_bytes: size.device.width * size.device.height,
                packet_bytes: config.packet_bytes,
                period_ns: (1e9 / config.rig.trigger_rate_hz) as u64,
            };
            let speed = self.interfaces.iter().find(|at| at.name == name)?.speed_mbit;
            Some((name, burst, speed))
        };
        let bursts: Vec<_> = self.roles.iter().map(burst).collect();
        for (name, cameras) in &shared {
            let Some((_, burst, Some(speed))) = bursts.iter().flatten().find(|(at, ..)| at == name) else {
                continue;
            };
            if burst.bits_per_s() > *speed as f64 * 1e6 {
                self.problems.push(format!(
                    "{name} carries {speed} Mbit/s, and its {cameras} cameras need {:.0}: use faster ports, or more of them",
                    burst.bits_per_s() / 1e6
                ));
            }
        }
        bursts.into_iter().map(|found| found.and_then(|(_, burst, speed)| burst.delay(speed))).collect()
    }

    /// Puts cameras on the heads whose pulses they answered, and tells those of one head apart.
    fn names(
        &mut self,
        options: &Options,
        unit: &Unit<'_>,
        cameras: &mut Vec<BenchCamera>,
        operator: &mut dyn Operator,
    ) -> Result<(), String> {
        let heads: Vec<Option<usize>> =
            cameras.iter().map(|bench| bench.wired.as_ref().map(|wired| wired.delays.head)).collect();
        let before: Vec<usize> = self.roles.iter().map(|role| role.camera).collect();
        // One that is away may have any name that is left.
        let away: Vec<usize> = self.away.iter().map(|role| role.camera).collect();
        let here = self.roles.iter().cloned().zip(heads);
        let mut all: Vec<_> = here.chain(self.away.iter().map(|role| (role.clone(), None))).collect();
        all.sort_by_key(|(role, _)| self.place(&role.id));
        let (roles, heads): (Vec<Role>, Vec<Option<usize>>) = all.into_iter().unzip();
        match by_heads(&roles, &heads) {
            Ok(roles) => {
                (self.away, self.roles) = roles.into_iter().partition(|role| away.contains(&role.camera));
            }
            Err(problems) => self.problems.extend(problems),
        }
        // Cameras stand in the order of their roles.
        let order: Vec<usize> = self
            .roles
            .iter()
            .filter_map(|role| before.iter().position(|camera| *camera == role.camera))
            .collect();
        reorder(cameras, &order);
        for place in 0..self.roles.len() {
            let head = self.roles[place].head;
            let open = |role: &Role| role.known == Known::InOrder && role.head == head;
            let which: Vec<usize> = (0..self.roles.len()).filter(|i| open(&self.roles[*i])).collect();
            match which.as_slice() {
                _ if !which.contains(&place) => continue,
                // Nobody knows which of the two is away.
                [_] if self.away.iter().any(open) => continue,
                [_] if cameras[place].wired.is_some() => {
                    self.roles[place].known = Known::ByPulse;
                    continue;
                }
                _ => {}
            }
            // A camera that answers no pulse shows no picture; what is wrong with it stands in its problems.
            let dumb = which.iter().any(|place| cameras[*place].wired.is_none());
            if dumb || options.in_order || !operator.is_there() {
                continue;
            }
            let at = self.cover(place, &which, unit, cameras, operator)?;
            self.roles[place].known = Known::Covered;
            if at != place {
                let (one, other) = (self.roles[place].camera, self.roles[at].camera);
                (self.roles[place].camera, self.roles[at].camera) = (other, one);
                cameras.swap(place, at);
            }
        }
        Ok(())
    }

    /// Which of several cameras is the one whose lens somebody covers.
    fn cover(
        &self,
        place: usize,
        which: &[usize],
        unit: &Unit<'_>,
        cameras: &mut [BenchCamera],
        operator: &mut dyn Operator,
    ) -> Result<usize, String> {
        let id = &self.roles[place].id;
        let text = |error: super::pulses::TrainError| error.to_string();
        let mut brightest = vec![0.0; which.len()];
        let mut looks = LOOKS;
        let mut asked = false;
        while looks > 0 {
            match covered(&mut brightest, &unit.look(cameras, which).map_err(text)?) {
                Look::Covered(found) if asked => return Ok(which[found]),
                Look::NoPicture(place) => {
                    let found = &cameras[which[place]].found;
                    operator.tell(&format!("{found} sent no picture at the pulses; they are repeated"));
                    looks -= 1;
                    continue;
                }
                _ if asked => {
                    operator.tell("no picture became dark: cover the lens wholly, with the light on");
                }
                _ => {}
            }
            asked = true;
            if !operator.does(&format!("cover the lens of {id}")) {
                return Err(format!("{id} was not shown"));
            }
        }
        Err(format!(
            "{id} cannot be told from its neighbour: {LOOKS} times a camera sent no picture at the pulses"
        ))
    }

    /// Frames of each camera at the rig's rate, set up as a node will do it with the file that is written.
    fn at_rate(
        &mut self,
        path: &Path,
        unit: &Unit<'_>,
        packet_bytes: Option<u32>,
        cameras: &mut [BenchCamera],
    ) -> Result<Vec<Option<(usize, u32)>>, String> {
        let pairs = self.roles.iter().zip(cameras.iter());
        let entries: Vec<Entry> = pairs.map(|(role, bench)| self.measured(role, bench)).collect();
        let text = self.text(&entries, packet_bytes).map_err(|fault| fault.message)?;
        let config = NodeConfig::from_text(&text, path).map_err(|error| error.to_string())?;
        for (role, bench) in self.roles.iter().zip(cameras.iter_mut()) {
            if let Some(known) = config.cameras.iter().find(|known| known.id == role.id) {
                bench.wishes = Wishes::of(&config, known);
            }
        }
        let count = config.rig.warm_up_triggers + TRIGGERS;
        let timing = HsuTiming::from_rig(&config.rig);
        let frames = unit.at_the_rigs_rate(&timing, count, cameras).map_err(|error| error.to_string())?;
        for (bench, frames) in cameras.iter_mut().zip(&frames) {
            if let Some(frames) = frames
                && *frames < TRIGGERS as usize
            {
                bench.problems.push(format!(
                    "{frames} frames at {count} triggers of {} Hz, expected {TRIGGERS} or more: exposure and readout may take \
                     longer than a period, or overlap is off",
                    config.rig.trigger_rate_hz
                ));
            }
        }
        Ok(frames.into_iter().map(|frames| Some((frames?, count))).collect())
    }

    /// Writes pictures and file.
    fn finish(
        mut self,
        path: &Path,
        packet_bytes: Option<u32>,
        cameras: &mut [BenchCamera],
        frames: Result<Vec<Option<(usize, u32)>>, String>,
    ) -> Result<Outcome, Fault> {
        let frames = frames.unwrap_or_else(|error| {
            self.problems.push(error);
            vec![None; cameras.len()]
        });
        let (mut entries, mut named) = (Vec::new(), Vec::new());
        for (place, (role, bench)) in self.roles.iter().zip(cameras.iter_mut()).enumerate() {
            let wired = bench.wired.as_ref();
            let delays = wired.map(|wired| wired.delays);
            let picture =
                wired.and_then(|wired| picture(path, role, wired.contract.size, &wired.picture).transpose());
            let picture = match picture.transpose() {
                Ok(picture) => picture,
                Err(problem) => {
                    bench.told.push(problem);
                    None
                }
            };
            let told = Some(comment(&bench.found, role.known, delays));
            entries.push(Entry { told, ..self.measured(role, bench) });
            named.push(NamedCamera {
                id: role.id.clone(),
                device: bench.found.clone(),
                named: role.known,
                trigger_line: wired.and_then(|wired| wired.line.clone()),
                head: delays.map(|delays| delays.head),
                stamp_us: delays.and_then(|delays| delays.stamp_us),
                arrival_us: delays.map(|delays| delays.arrival_us),
                largest_packet_bytes: bench.largest,
                frames_at_rate: frames.get(place).copied().flatten(),
                picture,
            });
            let of = |text: &String| format!("camera {}: {text}", role.id);
            self.problems.extend(bench.problems.iter().map(of));
            self.told.extend(bench.told.iter().map(of));
            if role.known == Known::InOrder {
                let text = "its name is that of the order of serial numbers: look at its picture".to_owned();
                self.told.push(of(&text));
            }
        }
        named.extend(self.away.iter().map(|role| NamedCamera {
            id: role.id.clone(),
            device: self.found[role.camera].clone(),
            named: role.known,
            trigger_line: None,
            head: None,
            stamp_us: None,
            arrival_us: None,
            largest_packet_bytes: None,
            frames_at_rate: None,
            picture: None,
        }));
        named.sort_by_key(|camera| self.place(&camera.id));
        let text = self.text(&entries, packet_bytes)?;
        NodeConfig::from_text(&text, path).map_err(usage)?;
        write_whole(path, |file| file.write_all(text.as_bytes()))
            .map_err(|e| Fault::new(Exit::Failure, format!("{}: cannot be written: {e}", path.display())))?;
        Ok(Outcome { file: path.to_owned(), cameras: named, problems: self.problems, told: self.told })
    }
}

/// Puts cameras into another order: `order` has the old place of each.
fn reorder(cameras: &mut Vec<BenchCamera>, order: &[usize]) {
    if order.len() != cameras.len() {
        return;
    }
    let mut all: Vec<Option<BenchCamera>> = cameras.drain(..).map(Some).collect();
    cameras.extend(order.iter().filter_map(|place| all[*place].take()));
}
