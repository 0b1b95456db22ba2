// SPDX-License-Identifier: MIT OR Apache-2.0
//! One simulated camera: its sockets and its two threads (control, stream).

use super::actions::{ActionFate, ActionFilter, Actions};
use super::clock::{CameraClock, ClockOptions};
use super::control::{Action, Control, Outcome};
use super::described::Described;
use super::habits::Habits;
use super::inject::Injector;
use super::make::Make;
use super::network::Network;
use super::presence::Presence;
use super::registers::{Identity, Registers};
use super::rogue::Rogue;
use super::stream::{Order, Streamer};
use super::transmit::{History, Transmitter, refuse, resend};
use super::{CameraError, PacketFilter, Statistics, discovery, gvcp, gvsp, net};
use crate::faults::{CameraFaults, Resend};
use crate::images::ImageSource;
use crate::wire::TriggerEdge;
use crossbeam_channel::{Receiver, Sender, never, unbounded};
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed, Ordering::SeqCst};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Longest time the control thread sleeps: bounds how late a lost heartbeat or a stop is noticed.
const CONTROL_TICK: Duration = Duration::from_millis(50);
/// Asked of the system for the stream's socket; it may give less.
const SEND_BUFFER: i32 = 8 << 20;
/// An answer that takes this time or longer is announced by PENDING_ACK.
const PENDING: Duration = Duration::from_millis(100);
/// Longest datagram a controller may send.
const DATAGRAM: usize = 2048;

/// What a simulated camera is made of.
#[derive(Clone)]
pub struct CameraOptions {
    /// Serial number, at most 15 bytes; also the end of the name that Aravis gives the camera.
    pub serial: String,
    /// Model name, at most 31 bytes.
    pub model: String,
    /// Name given by the user, at most 15 bytes; may be empty.
    pub user_name: String,
    /// Its own loopback address, for instance 127.0.7.11; it listens on port 3956.
    pub address: Ipv4Addr,
    /// The light on the sensor; its size is the sensor's.
    pub images: Arc<dyn ImageSource>,
    /// The edges of the trigger input (`Line0`).
    pub triggers: Receiver<TriggerEdge>,
    pub clock: ClockOptions,
    /// Frames kept for resend requests: what the camera's memory holds.
    pub resend_frames: usize,
    /// Block id of the first frame of every acquisition: 1, unless a test wants the ids to wrap early.
    pub first_block_id: u64,
    /// First transmissions that get lost on the way, by block and packet id.
    pub lose: Option<PacketFilter>,
    /// What it does differently from others.
    pub habits: Habits,
    /// The make that it is like; else it is the simulator's own.
    pub make: Option<Arc<Make>>,
    /// The published description that it is behind, and its memory; else `make` decides.
    pub described: Option<Arc<Described>>,
    /// Faults to inject at triggers of the wire; none by default.
    pub faults: Option<CameraFaults>,
    /// What the network makes of action commands to it.
    pub action_fates: Option<ActionFilter>,
}

impl CameraOptions {
    /// A camera with these pixels at this address, with nothing on its trigger input.
    pub fn new(serial: &str, address: Ipv4Addr, images: Arc<dyn ImageSource>) -> Self {
        Self {
            serial: serial.to_owned(),
            model: "Sim23M".to_owned(),
            user_name: String::new(),
            address,
            images,
            triggers: never(),
            clock: ClockOptions::default(),
            resend_frames: 8,
            first_block_id: 1,
            lose: None,
            habits: Habits::default(),
            make: None,
            described: None,
            faults: None,
            action_fates: None,
        }
    }
}

/// A running camera; it stops when dropped.
#[derive(Debug)]
pub struct SimulatedCamera {
    address: Ipv4Addr,
    statistics: Arc<Statistics>,
    clock: Arc<CameraClock>,
    stop: Arc<AtomicBool>,
    orders: Sender<Order>,
    threads: Vec<JoinHandle<()>>,
}

impl SimulatedCamera {
    /// Binds the camera's address and starts its threads.
    ///
    /// # Errors
    /// An option that does not fit the registers, or an address that cannot be bound.
    pub fn start(options: CameraOptions) -> Result<Self, CameraError> {
        let sensor = check(&options)?;
        let bind = |port| {
            let address = SocketAddrV4::new(options.address, port);
            UdpSocket::bind(address).map_err(|source| CameraError::Bind { address, source })
        };
        let control_socket = bind(gvcp::PORT)?;
        // A datagram that polling announced may yet be discarded by its checksum: reading must not wait for
        // the next one.
        control_socket.set_nonblocking(true).map_err(CameraError::Socket)?;
        net::stamp_arrivals(&control_socket).map_err(CameraError::Socket)?;
        let stream_socket = Arc::new(bind(0)?);
        if let Err(error) = net::set_send_buffer(&stream_socket, SEND_BUFFER) {
            tracing::warn!(%error, "cannot enlarge the stream's send buffer");
        }
        let clock = Arc::new(CameraClock::new(Instant::now(), options.clock));
        let clock_habit =
            options.make.as_ref().map_or(options.habits.clock, |m| m.clock(options.habits.clock));
        let habits = Habits { clock: clock_habit, ..options.habits };
        let identity = Identity {
            address: options.address,
            model: match &options.make {
                Some(make) => make.names().1.chars().filter(char::is_ascii_graphic).take(31).collect(),
                None => options.model.clone(),
            },
            serial: options.serial.clone(),
            user_name: options.user_name.clone(),
        };
        let source_port = stream_socket.local_addr().map_or(0, |a| a.port());
        let power_on = {
            let (clock, make) = (Arc::clone(&clock), options.make.clone());
            let described = options.described.clone();
            let network = match habits.link_local {
                true => Network::link_local(options.address),
                false => Network::new(options.address),
            };
            let [_, _, c, d] = options.address.octets();
            let other = SocketAddrV4::new(Ipv4Addr::new(127, 253, c, d), gvcp::PORT);
            move || {
                let (identity, clock) = (identity.clone(), Arc::clone(&clock));
                let mut registers = match &make {
                    Some(make) => {
                        let network = network.power_on();
                        Registers::of_make(identity, sensor, clock, habits, Arc::clone(make), &network)
                    }
                    None => Registers::new(identity, sensor, clock, habits).behind(described.clone()),
                };
                registers.source_port = source_port;
                let control = Control::new(registers);
                match habits.held_ms {
                    0 => control,
                    ms => control.held(other, Instant::now() + Duration::from_millis(ms)),
                }
            }
        };
        let statistics = Arc::new(Statistics::default());
        let presence = Arc::new(Presence::default());
        let rogue = match &options.faults {
            Some(faults) if faults.plan.needs_stranger() => {
                Some(Rogue::new(options.address, Arc::clone(&statistics)).map_err(CameraError::Socket)?)
            }
            _ => None,
        };
        let history = Arc::new(History::new(options.resend_frames));
        let running = Arc::new(AtomicU64::new(0));
        let stop = Arc::new(AtomicBool::new(false));
        let (orders, received) = unbounded();
        let transmitter = Transmitter::new(
            Arc::clone(&options.images),
            Arc::clone(&stream_socket),
            Arc::clone(&history),
            Arc::clone(&statistics),
            options.lose.clone(),
        );
        let streamer = Streamer {
            orders: received,
            triggers: options.triggers.clone(),
            clock: Arc::clone(&clock),
            transmitter,
            socket: Arc::clone(&stream_socket),
            history: Arc::clone(&history),
            statistics: Arc::clone(&statistics),
            running: Arc::clone(&running),
            first_block_id: options.first_block_id,
            habits,
            injector: options.faults.clone().map(Injector::new),
            presence: Arc::clone(&presence),
            rogue,
            absence: None,
            sense_from: None,
            last_sent: None,
        };
        let controller = Controller {
            control: power_on(),
            power_on: Box::new(power_on),
            presence,
            boots: 0,
            socket: control_socket,
            broadcasts: discovery::sockets(),
            stream_socket,
            images: options.images,
            history,
            statistics: Arc::clone(&statistics),
            orders: orders.clone(),
            running,
            actions: Actions::new(options.action_fates),
            acquisitions: 0,
            answer_late: Duration::from_millis(habits.answer_late_ms),
            test_packets_late: Duration::from_millis(habits.test_packet_late_ms),
            address: options.address,
            late: options.faults.as_ref().map_or(Duration::ZERO, |faults| faults.plan.late),
            stop: Arc::clone(&stop),
        };
        let spawn = |part: &str, work: Box<dyn FnOnce() + Send>| {
            let name = format!("{part}-{}", options.serial);
            std::thread::Builder::new().name(name).spawn(work).map_err(CameraError::Thread)
        };
        // Built step by step, so that a camera that fails half-way stops what it started.
        let address = options.address;
        let mut camera =
            SimulatedCamera { address, statistics, clock, stop, orders, threads: Vec::with_capacity(2) };
        camera.threads.push(spawn("gvsp", Box::new(move || streamer.run()))?);
        camera.threads.push(spawn("gvcp", Box::new(move || controller.run()))?);
        Ok(camera)
    }

    /// The address at which it answers.
    pub fn address(&self) -> Ipv4Addr {
        self.address
    }

    /// The counters of the camera: frames, packets and resends.
    pub fn statistics(&self) -> &Statistics {
        &self.statistics
    }

    /// Its clock, as ground truth for whoever estimates it.
    pub fn clock(&self) -> &CameraClock {
        &self.clock
    }
}

impl SimulatedCamera {
    /// Takes the power away: it answers nothing more, and its address is free.
    pub fn switch_off(&mut self) {
        self.stop.store(true, Relaxed);
        let _ = self.orders.send(Order::Quit);
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
    }
}

impl Drop for SimulatedCamera {
    fn drop(&mut self) {
        self.switch_off();
    }
}

/// Checks what the registers must hold; gives the sensor's (columns, rows).
fn check(options: &CameraOptions) -> Result<(u32, u32), CameraError> {
    let (width, height) = options.images.size();
    let sensor = u32::try_from(width).ok().zip(u32::try_from(height).ok());
    let sensor = sensor.filter(|(w, h)| (16..=16_384).contains(w) && (1..=16_384).contains(h));
    let sensor = sensor.ok_or(CameraError::Size { width, height })?;
    let texts = [
        ("serial", &options.serial, 15),
        ("model", &options.model, 31),
        ("user name", &options.user_name, 15),
    ];
    for (field, text, limit) in texts {
        if text.len() > limit || text.contains('\0') {
            return Err(CameraError::Text { field, text: text.clone(), limit });
        }
    }
    Ok(sensor)
}

/// State of the control thread.
struct Controller {
    control: Control,
    /// What it is after power-on.
    power_on: Box<dyn Fn() -> Control + Send>,
    presence: Arc<Presence>,
    /// The number of power-ons that this thread has seen.
    boots: u64,
    socket: UdpSocket,
    broadcasts: Vec<UdpSocket>,
    stream_socket: Arc<UdpSocket>,
    images: Arc<dyn ImageSource>,
    history: Arc<History>,
    statistics: Arc<Statistics>,
    orders: Sender<Order>,
    running: Arc<AtomicU64>,
    /// Which action commands reach it, and which triggers they are.
    actions: Actions,
    acquisitions: u64,
    /// How late test packets go out.
    test_packets_late: Duration,
    /// How late writes are answered.
    answer_late: Duration,
    /// Where its sockets are bound.
    address: Ipv4Addr,
    /// How late answers are to resend requests that shall be answered late.
    late: Duration,
    stop: Arc<AtomicBool>,
}

impl Controller {
    fn run(mut self) {
        let mut ready = Vec::new();
        let mut buffer = [0; DATAGRAM];
        while !self.stop.load(Relaxed) {
            ready.clear();
            let sockets: Vec<&UdpSocket> = std::iter::once(&self.socket).chain(&self.broadcasts).collect();
            if let Err(error) = net::poll_readable(&sockets, CONTROL_TICK, &mut ready) {
                tracing::error!(%error, "the control channel cannot wait for packets; the camera stops answering");
                return;
            }
            self.look_at_presence();
            let lost = self.control.expire(Instant::now());
            self.carry_out(lost, None);
            for index in ready.drain(..) {
                match index.checked_sub(1) {
                    None => self.serve(&mut buffer),
                    Some(broadcast) => self.serve_broadcast(broadcast, &mut buffer),
                }
            }
        }
    }

    /// What the streaming thread has injected meanwhile.
    fn look_at_presence(&mut self) {
        let boots = self.presence.boots();
        if boots != self.boots {
            self.boots = boots;
            self.control = (self.power_on)();
            let network = self.control.registers.network();
            let (address, away) = (network.now.0, network.away);
            if !away && address != self.address {
                self.move_to(address);
            }
        }
        if let Some(usurper) = self.presence.take_usurper() {
            let outcome = self.control.hand_over(usurper, Instant::now());
            self.carry_out(outcome, None);
        }
    }

    fn serve(&mut self, buffer: &mut [u8]) {
        let Ok((length, from, mut arrived)) = net::receive(&self.socket, buffer) else { return };
        // In another subnet, nothing that is meant for one camera finds it.
        if self.presence.is_dark() || self.control.registers.network().away {
            return;
        }
        let Some(datagram) = buffer.get(..length) else { return };
        if self.control.acquiring() && self.running.load(SeqCst) == 0 {
            self.control.acquisition_ended();
        }
        let ignored = self.statistics.triggers_ignored_now.load(Relaxed);
        self.control.registers.nonsense = self.presence.talks_nonsense();
        self.control.registers.no_master = self.presence.has_no_master();
        self.control.registers.triggers_ignored = u32::try_from(ignored).unwrap_or(u32::MAX);
        let arrivals = match self.actions.fate(datagram) {
            ActionFate::Arrives => 1,
            ActionFate::Lost => 0,
            ActionFate::Twice => 2,
            ActionFate::Late(late) => {
                arrived += late;
                1
            }
        };
        // A real camera acts when the packet arrives, not when a thread of a busy host gets to run.
        let now = if gvcp::is_action(datagram) { arrived } else { Instant::now() };
        for _ in 0..arrivals {
            let outcome = self.control.handle(datagram, from, now);
            self.carry_out(outcome, Some(from));
        }
    }

    /// Binds another address; where that is not this host's, the camera stays where it is.
    fn move_to(&mut self, address: Ipv4Addr) {
        let bind = |port| UdpSocket::bind(SocketAddrV4::new(address, port));
        let moved = bind(gvcp::PORT).and_then(|control| {
            control.set_nonblocking(true)?;
            net::stamp_arrivals(&control)?;
            let stream = bind(0)?;
            net::replace(&self.stream_socket, &stream)?;
            self.control.registers.source_port = stream.local_addr()?.port();
            self.socket = control;
            self.address = address;
            Ok(())
        });
        if let Err(error) = moved {
            tracing::warn!(%address, %error, "a camera cannot move there");
        }
    }

    /// A broadcast can ask who is there, or give an address; the answer comes from the camera's own address.
    fn serve_broadcast(&mut self, index: usize, buffer: &mut [u8]) {
        let Some(socket) = self.broadcasts.get(index) else { return };
        let Ok((length, SocketAddr::V4(from))) = socket.recv_from(buffer) else { return };
        let Some(datagram) = buffer.get(..length).filter(|_| !self.presence.is_dark()) else { return };
        if self.control.registers.can_move() && discovery::forces_ip(datagram, from) {
            let outcome = self.control.handle(datagram, from, Instant::now());
            return self.carry_out(outcome, Some(from));
        }
        if let Some(answer) = discovery::answer(datagram, from, &self.control.registers) {
            let _ = self.socket.send_to(&answer, from);
        }
    }

    fn resend(&self, request: &gvcp::ResendRequest) {
        match self.history.policy(request.block_id) {
            Resend::Answered => {
                resend(request, &self.history, &*self.images, &self.stream_socket, &self.statistics);
            }
            Resend::Refused => refuse(request, &self.stream_socket, &self.statistics),
            Resend::Ignored => {}
            Resend::Late => {
                let (history, images) = (Arc::clone(&self.history), Arc::clone(&self.images));
                let (socket, statistics) = (Arc::clone(&self.stream_socket), Arc::clone(&self.statistics));
                let (request, late) = (*request, self.late);
                let answer = move || {
                    std::thread::sleep(late);
                    resend(&request, &history, &*images, &socket, &statistics);
                };
                // The control channel must go on meanwhile; a few threads that sleep cost nothing.
                let _ = std::thread::Builder::new().name("late-resend".to_owned()).spawn(answer);
            }
        }
    }

    fn carry_out(&mut self, outcome: Outcome, from: Option<SocketAddrV4>) {
        for action in outcome.actions {
            match action {
                Action::ActionTrigger { id, time } => {
                    let _ = self.orders.send(Order::Action(self.actions.edge(id, time)));
                }
                Action::Start(settings) => {
                    self.actions.begin();
                    self.acquisitions += 1;
                    self.running.store(self.acquisitions, SeqCst);
                    let _ = self.orders.send(Order::Start(self.acquisitions, Instant::now(), settings));
                }
                Action::Update(settings) => {
                    let _ = self.orders.send(Order::Update(settings));
                }
                Action::Stop => {
                    self.running.store(0, SeqCst);
                    let _ = self.orders.send(Order::Stop);
                }
                Action::SoftwareTrigger => {
                    let _ = self.orders.send(Order::SoftwareTrigger(Instant::now()));
                }
                Action::TestPacket { destination, packet_size, do_not_fragment } => {
                    // Too long a packet must vanish, as it would on the wire: that is the test.
                    let _ = net::set_do_not_fragment(&self.stream_socket, do_not_fragment);
                    let (socket, late) = (Arc::clone(&self.stream_socket), self.test_packets_late);
                    let send = move || {
                        std::thread::sleep(late);
                        drop(socket.send_to(&gvsp::test_packet(packet_size), destination));
                    };
                    match late.is_zero() {
                        true => send(),
                        false => drop(std::thread::Builder::new().name("late-test".to_owned()).spawn(send)),
                    }
                }
                Action::Move(address) if address != self.address => self.move_to(address),
                Action::Move(_) => {}
                Action::Resend(request) => {
                    self.resend(&request);
                }
            }
        }
        if let (Some(answer), Some(from)) = (outcome.answer, from) {
            if let Some(id) = gvcp::answers_write(&answer).filter(|_| !self.answer_late.is_zero()) {
                if self.answer_late >= PENDING {
                    let ms = u16::try_from(self.answer_late.as_millis()).unwrap_or(u16::MAX);
                    let _ = self.socket.send_to(&gvcp::pending_ack(id, ms), from);
                }
                std::thread::sleep(self.answer_late);
            }
            let _ = self.socket.send_to(&answer, from);
        }
    }
}

#[cfg(test)]
mod tests;
