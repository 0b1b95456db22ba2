// SPDX-License-Identifier: MIT OR Apache-2.0
//! The steps of a new bench, in their order: discovery, addresses, packets, pulses, names, the rig's rate, pictures,
//! the node file.

use super::addresses;
use super::begun::{Begun, begin_file};
use super::found::Found;
use super::lines::{BenchCamera, Unit, find};
use super::node_file::{Entry, with_cameras};
use super::options::{Operator, Options};
use super::outcome::{NamedCamera, Outcome, comment};
use super::packets::{Burst, largest};
use super::roles::{Known, Look, Role, assign, by_heads, covered};
use super::who::{left_out, those_meant, who_answers};
use crate::base::ids::CameraId;
use crate::base::{Fault, write_whole};
use crate::camera::{CameraBackend, Wishes};
use crate::config::{NodeConfig, PacketDelay};
use crate::hsu::{HsuTimeouts, HsuTiming, TriggerUnit};
use crate::network::{Answer, Interface, interfaces, shared_subnets, without_link};
use std::collections::BTreeMap;
use std::io::Write as _;
use std::path::Path;

/// Number of triggers after the warm-up, when frames are counted at the rig's rate.
const TRIGGERS: u32 = 20;

/// How many times pulses are repeated because a camera sent no picture, while lenses are covered.
const LOOKS: usize = 3;

/// Sets a bench up: leads the operator through all steps and writes the node file.
///
/// # Errors
/// A problem before the file can be written. Later ones are in [`Outcome::problems`], and the file has what is known.
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
        // A missing camera may be one of these.
        problems.extend(outside.iter().cloned());
        let down = without_link(Path::new("/sys"));
        if found.len() < wanted.len() && !down.is_empty() {
            problems.push(format!("no link on {}: check cables and switches there", down.join(", ")));
        }
        Fault::device(problems.join("\n"))
    })?;
    ask_before_pulses(options, &roles, &found, operator)?;
    no_shared_subnet(&roles, &found, &interfaces)?;

    let mut work = Work {
        options,
        begun,
        interfaces,
        order: wanted.into_iter().map(|(id, _)| id).collect(),
        packet_bytes: None,
        cameras: Vec::new(),
        away: roles,
        found,
        notes: outside,
        problems: Vec::new(),
    };
    work.addresses(&answers, &everybody, operator)?;
    work.measure(backend, operator)
}

/// Cameras of one head that only their serial numbers distinguish need an operator, or the option `in_order`.
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
    Err(Fault::usage(format!(
        "which of these is which of {} cannot be known: {}\ngive --camera ID=SERIAL for each, or --in-order for the \
         order of their serial numbers, or run it on a terminal and cover lenses",
        ids.join(", "),
        cameras.join("; ")
    )))
}

/// Refuses two interfaces in the subnet of a camera: this host sends by one of them alone, whichever the camera is on.
fn no_shared_subnet(roles: &[Role], found: &[Found], interfaces: &[Interface]) -> Result<(), Fault> {
    let used = |name: &str| roles.iter().any(|role| found[role.camera].interface.as_deref() == Some(name));
    let shared = shared_subnets(interfaces).into_iter().filter(|(_, one, other)| used(one) || used(other));
    let problems: Vec<String> = shared
        .map(|(subnet, one, other)| {
            format!(
                "{one} and {other} are both in the subnet of {subnet}, and packets for a camera leave by one of them \
                 alone: give each port a subnet of its own (`ip address`), then set up again"
            )
        })
        .collect();
    match problems.is_empty() {
        true => Ok(()),
        false => Err(Fault::failed(problems.join("\n"))),
    }
}

/// A bench that is being set up. [`set_up`] makes it once every camera has a role; it ends with the node file.
struct Work<'a> {
    options: &'a Options,
    begun: Begun,
    interfaces: Vec<Interface>,
    /// The cameras of this node, in the rig's order.
    order: Vec<CameraId>,
    /// The packet size of the file, bytes: the largest that arrives from every camera.
    packet_bytes: Option<u32>,
    /// Cameras that are open, and have been or will be measured.
    cameras: Vec<BenchCamera>,
    /// Cameras that are not open: another program has them, or their packets do not arrive. Of these only name and
    /// address are known.
    away: Vec<Role>,
    found: Vec<Found>,
    notes: Vec<String>,
    problems: Vec<String>,
}

impl Work<'_> {
    /// Gives cameras in wrong subnets addresses, and has all keep theirs.
    fn addresses(
        &mut self,
        answers: &[Answer],
        everybody: &[Answer],
        operator: &mut dyn Operator,
    ) -> Result<(), Fault> {
        let ours: Vec<Answer> =
            self.away.iter().filter_map(|role| answers.get(role.camera)).cloned().collect();
        let moves = addresses::moves(&ours, everybody, &self.interfaces, self.options.network)
            .map_err(|problems| Fault::device(problems.join("\n")))?;
        for next in &moves {
            let question = format!(
                "the camera {} is in a wrong subnet: give it {} on {}?",
                next.mac, next.to, next.interface
            );
            if !operator.agrees(&question) {
                return Err(Fault::usage(format!(
                    "{question} agree with --yes, or set its address with its vendor's program"
                )));
            }
        }
        if !moves.is_empty() {
            addresses::carry_out(&moves, &self.interfaces)
                .map_err(|problems| Fault::device(problems.join("\n")))?;
        }
        for mut answer in ours {
            if let Some(next) = moves.iter().find(|next| next.mac == answer.mac) {
                answer.address = next.to.address;
                let found = self.found.iter_mut().filter(|found| found.mac == Some(next.mac));
                found.for_each(|found| found.place = next.to.address.to_string());
                operator.tell(&format!("{answer} has its new address"));
            }
            let note = match addresses::is_kept(&answer) {
                Ok(true) => continue,
                Ok(false)
                    if operator.agrees(&format!("{answer} does not keep its address: have it do so?")) =>
                {
                    let Err(note) = addresses::keep(&answer, &self.interfaces) else {
                        operator.tell(&format!("{answer} keeps its address"));
                        continue;
                    };
                    note
                }
                Ok(false) => format!("{answer} has another address when its power was off"),
                Err(note) => note,
            };
            self.notes.push(note);
        }
        Ok(())
    }

    /// Where a camera stands in the rig.
    fn place(&self, id: &CameraId) -> usize {
        self.order.iter().position(|known| known == id).unwrap_or(usize::MAX)
    }

    /// A camera's entry in the file; without a `bench` it was not measured.
    fn entry(&self, role: &Role, bench: Option<&BenchCamera>) -> Entry {
        let found = &self.found[role.camera];
        let wired = bench.and_then(|bench| bench.wired.as_ref());
        let comment = comment(found, role.known, wired.map(|wired| wired.delays));
        Entry {
            id: role.id.clone(),
            address: found.place.clone(),
            trigger_line: wired.and_then(|wired| wired.line.clone()),
            // Whether a camera that could not be set up has a packet delay is not known.
            packet_delay: bench.filter(|_| wired.is_some()).and_then(|bench| bench.wishes.words.packet_delay),
            comment: if bench.is_some() { comment } else { format!("{comment}, not measured") },
        }
    }

    /// The file's text with all that is known at this step.
    fn text(&self) -> Result<String, Fault> {
        let measured = self.cameras.iter().map(|bench| self.entry(&bench.role, Some(bench)));
        let away = self.away.iter().map(|role| self.entry(role, None));
        let mut entries: Vec<Entry> = measured.chain(away).collect();
        entries.sort_by_key(|entry| self.place(&entry.id));
        with_cameras(&self.begun.text, &entries, self.packet_bytes).map_err(Fault::usage)
    }

    /// The node's configuration by that text.
    fn config(&self) -> Result<NodeConfig, Fault> {
        NodeConfig::from_text(&self.text()?, &self.options.path).map_err(Fault::usage)
    }

    /// Opens a camera and tries its packets.
    fn open(
        &self,
        role: &Role,
        config: &NodeConfig,
        backend: &mut dyn CameraBackend,
    ) -> Result<BenchCamera, String> {
        let found = self.found[role.camera].clone();
        let at = self.interfaces.iter().find(|at| found.interface.as_deref() == Some(at.name.as_str()));
        let of = |problem: String| format!("camera {} ({found}): {problem}", role.id);
        let known = config.cameras.iter().find(|known| known.id == role.id);
        let known = known.ok_or_else(|| of("it is not in the node file".to_owned()))?;
        let mut camera = backend.open(&found.place).map_err(|error| of(error.to_string()))?;
        let largest = largest(camera.as_mut(), at.and_then(|at| at.mtu))
            .map_err(|error| of(format!("its packets cannot be tried: {error}")))?;
        let wishes = Wishes::of(config, known);
        Ok(BenchCamera::new(role.clone(), found, camera, wishes, largest))
    }

    /// Opens the cameras, finds their lines, names them, and writes the file.
    fn measure(
        mut self,
        backend: &mut dyn CameraBackend,
        operator: &mut dyn Operator,
    ) -> Result<Outcome, Fault> {
        let config = self.config()?;
        for role in std::mem::take(&mut self.away) {
            match self.open(&role, &config, backend) {
                Ok(bench) => self.cameras.push(bench),
                // The others are measured all the same.
                Err(problem) => {
                    operator.tell(&problem);
                    self.problems.push(problem);
                    self.away.push(role);
                }
            }
        }
        self.packet_bytes = self.cameras.iter().filter_map(|bench| bench.largest).min();
        if !self.cameras.is_empty() {
            let config = self.config()?;
            let delays = self.packet_delays(&config);
            for (bench, delay) in self.cameras.iter_mut().zip(delays) {
                bench.configure(&config);
                if bench.wishes.words.packet_delay.is_none()
                    && !bench.wishes.left_to_settings("packet_delay_us")
                {
                    bench.wishes.words.packet_delay = delay;
                }
            }
            if let Err(problem) = self.pulses(&config, operator) {
                self.problems.push(problem);
            }
        }
        self.finish()
    }

    /// Finds out by pulses of the HSU which trigger line and which head each camera is wired to, and how it keeps the
    /// rig's rate.
    fn pulses(&mut self, config: &NodeConfig, operator: &mut dyn Operator) -> Result<(), String> {
        let hsu = TriggerUnit::of(config)
            .connect(&config.node, &HsuTimeouts::default())
            .map_err(|error| error.to_string())?;
        let unit = Unit { hsu: &hsu, config };
        find(&unit, &mut self.cameras, |line| operator.tell(line)).map_err(|error| error.to_string())?;
        self.names(&unit, operator)?;
        self.at_rate(&unit)
    }

    /// The packet delay that each camera's link needs; a link that is too slow for its cameras is a problem.
    fn packet_delays(&mut self, config: &NodeConfig) -> Vec<Option<PacketDelay>> {
        let interface = |role: &Role| self.found[role.camera].interface.clone();
        let open = self.cameras.iter().map(|bench| &bench.role);
        let mut shared: BTreeMap<String, usize> = BTreeMap::new();
        for name in open.clone().chain(&self.away).filter_map(interface) {
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
        let bursts: Vec<_> = open.map(burst).collect();
        for (name, cameras) in &shared {
            let Some((_, burst, Some(speed))) = bursts.iter().flatten().find(|(at, ..)| at == name) else {
                continue;
            };
            if burst.bits_per_s() > *speed as f64 * 1e6 {
                self.problems.push(format!(
                    "{name} carries {speed} Mbit/s, and its {cameras} cameras need {:.0}: use faster ports, or more \
                     of them",
                    burst.bits_per_s() / 1e6
                ));
            }
        }
        bursts.into_iter().map(|found| found.and_then(|(_, burst, speed)| burst.delay(speed))).collect()
    }

    /// Puts cameras on the heads whose pulses they answered, and has lenses covered where two cameras of one head
    /// cannot be distinguished otherwise.
    fn names(&mut self, unit: &Unit<'_>, operator: &mut dyn Operator) -> Result<(), String> {
        let head = |bench: &BenchCamera| bench.wired.as_ref().map(|wired| wired.delays.head);
        let open = self.cameras.iter().map(|bench| (bench.role.clone(), head(bench)));
        // A camera that is not open may have any name that is left.
        let mut all: Vec<_> = open.chain(self.away.iter().map(|role| (role.clone(), None))).collect();
        all.sort_by_key(|(role, _)| self.place(&role.id));
        let (roles, heads): (Vec<Role>, Vec<Option<usize>>) = all.into_iter().unzip();
        match by_heads(&roles, &heads) {
            Ok(roles) => {
                let open = self.cameras.iter_mut().map(|bench| &mut bench.role);
                for role in open.chain(&mut self.away) {
                    let new = roles.iter().find(|new| new.camera == role.camera);
                    new.into_iter().for_each(|new| role.clone_from(new));
                }
                let order = &self.order;
                let place = |role: &Role| order.iter().position(|known| *known == role.id);
                self.cameras.sort_by_key(|bench| place(&bench.role));
            }
            Err(problems) => self.problems.extend(problems),
        }
        for place in 0..self.cameras.len() {
            let head = self.cameras[place].role.head;
            let open = |role: &Role| role.known == Known::InOrder && role.head == head;
            let which: Vec<usize> =
                (0..self.cameras.len()).filter(|i| open(&self.cameras[*i].role)).collect();
            match which.as_slice() {
                _ if !which.contains(&place) => continue,
                // Either of the two may be the one that is not open.
                [_] if self.away.iter().any(open) => continue,
                [_] if self.cameras[place].wired.is_some() => {
                    self.cameras[place].role.known = Known::ByPulse;
                    continue;
                }
                _ => {}
            }
            // A camera that answers no pulse shows no picture; its problems state why.
            let dumb = which.iter().any(|place| self.cameras[*place].wired.is_none());
            if dumb || self.options.in_order || !operator.is_there() {
                continue;
            }
            let at = self.cover(place, &which, unit, operator)?;
            if at != place {
                let other = self.cameras[at].role.id.clone();
                self.cameras[at].role.id = std::mem::replace(&mut self.cameras[place].role.id, other);
                self.cameras.swap(place, at);
            }
            self.cameras[place].role.known = Known::Covered;
        }
        Ok(())
    }

    /// Has the operator cover a lens, and finds which of several cameras it belongs to.
    fn cover(
        &mut self,
        place: usize,
        which: &[usize],
        unit: &Unit<'_>,
        operator: &mut dyn Operator,
    ) -> Result<usize, String> {
        let id = self.cameras[place].role.id.clone();
        let mut brightest = vec![0.0; which.len()];
        let (mut looks, mut has_begun) = (LOOKS, false);
        while looks > 0 {
            let seen = unit.look(&mut self.cameras, which).map_err(|error| error.to_string())?;
            match covered(&mut brightest, &seen) {
                Look::Covered(found) if has_begun => return Ok(which[found]),
                Look::NoPicture(place) => {
                    let found = &self.cameras[which[place]].found;
                    operator.tell(&format!("{found} sent no picture at the pulses; they are repeated"));
                    looks -= 1;
                    continue;
                }
                _ if has_begun => {
                    operator.tell("no picture became dark: cover the lens wholly, with the light on");
                }
                _ => {}
            }
            has_begun = true;
            if !operator.does(&format!("cover the lens of {id}")) {
                return Err(format!("{id} was not shown"));
            }
        }
        Err(format!(
            "{id} cannot be distinguished from its neighbour: {LOOKS} times a camera sent no picture at the pulses"
        ))
    }

    /// Counts frames of each camera at the rig's rate, set up as a node will do it with the file that is written.
    fn at_rate(&mut self, unit: &Unit<'_>) -> Result<(), String> {
        let config = self.config().map_err(|fault| fault.message)?;
        self.cameras.iter_mut().for_each(|bench| bench.configure(&config));
        let count = config.rig.warm_up_triggers + TRIGGERS;
        unit.at_the_rigs_rate(&HsuTiming::from_rig(&config.rig), count, &mut self.cameras)
            .map_err(|error| error.to_string())?;
        for bench in &mut self.cameras {
            if let Some((frames, _)) = bench.frames_at_rate
                && frames < TRIGGERS as usize
            {
                bench.problems.push(format!(
                    "{frames} frames at {count} triggers of {} Hz, expected {TRIGGERS} or more: exposure and readout \
                     may take longer than a period, or overlap is off",
                    config.rig.trigger_rate_hz
                ));
            }
        }
        Ok(())
    }

    /// Writes the pictures and the node file.
    fn finish(mut self) -> Result<Outcome, Fault> {
        let path = &self.options.path;
        let mut named = Vec::new();
        for bench in &self.cameras {
            let of = |text: &str| format!("camera {}: {text}", bench.role.id);
            self.problems.extend(bench.problems.iter().map(|problem| of(problem)));
            self.notes.extend(bench.notes.iter().map(|note| of(note)));
            let mut camera = NamedCamera::of(&bench.role, bench.found.clone(), Some(bench));
            match bench.write_picture(path) {
                Ok(picture) => camera.picture = picture,
                Err(problem) => self.notes.push(of(&problem)),
            }
            if bench.role.known == Known::InOrder {
                self.notes.push(of("its name is that of the order of serial numbers: look at its picture"));
            }
            named.push(camera);
        }
        named.extend(
            self.away.iter().map(|role| NamedCamera::of(role, self.found[role.camera].clone(), None)),
        );
        named.sort_by_key(|camera| self.place(&camera.id));
        self.config()?;
        let text = self.text()?;
        write_whole(path, |file| file.write_all(text.as_bytes()))
            .map_err(|e| Fault::at(path, format!("cannot be written: {e}")))?;
        Ok(Outcome { file: path.to_owned(), cameras: named, problems: self.problems, notes: self.notes })
    }
}
