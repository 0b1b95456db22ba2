// SPDX-License-Identifier: MIT OR Apache-2.0
//! The control channel of one camera: who controls it, what its commands do. No sockets, no threads:
//! a datagram, its sender and the time go in; the answer and what follows from it come out.

use super::gvcp::{self, ActionCommand, Command, Request, ResendRequest, Status};
use super::gvsp::Layout;
use super::registers::{Effect, Registers};
use super::settings::Settings;
use std::net::{Ipv4Addr, SocketAddrV4};
use std::time::{Duration, Instant};

/// Control channel privilege: exclusive access.
pub const EXCLUSIVE: u32 = 1;
/// Control channel privilege: control access.
pub const CONTROL: u32 = 2;

/// What the stream needs to know of the registers.
#[derive(Debug, Clone, PartialEq)]
pub struct StreamSettings {
    pub settings: Settings,
    /// How images are cut into packets.
    pub layout: Layout,
    /// Where packets go; frames are exposed, but not sent, while the stream is closed.
    pub destination: Option<SocketAddrV4>,
    pub packet_delay: Duration,
    /// The stream's packets must not be fragmented.
    pub do_not_fragment: bool,
}

/// What the device must do after a command.
#[derive(Debug, Clone, PartialEq)]
pub enum Action {
    Start(StreamSettings),
    /// Go on with these settings.
    Update(StreamSettings),
    Stop,
    SoftwareTrigger,
    /// The trigger of an action command.
    ActionTrigger {
        id: u16,
        time: Instant,
    },
    /// Send a test packet of this size (IP and UDP headers counted in).
    TestPacket {
        destination: SocketAddrV4,
        packet_size: u16,
        do_not_fragment: bool,
    },
    Resend(ResendRequest),
    /// Answer and send at this address from now on.
    Move(Ipv4Addr),
}

/// The answer to a datagram, and what follows from it.
#[derive(Debug, Default, PartialEq)]
pub struct Outcome {
    /// The acknowledge, if one is due.
    pub answer: Option<Vec<u8>>,
    /// What the device must do, in order.
    pub actions: Vec<Action>,
}

#[derive(Debug)]
struct Controller {
    address: SocketAddrV4,
    exclusive: bool,
    heard: Instant,
}

/// State of the control channel.
#[derive(Debug)]
pub struct Control {
    /// The registers; public to the device for values that only it knows.
    pub registers: Registers,
    controller: Option<Controller>,
    acquiring: bool,
    /// The last write of the controller and its answer: a command that is repeated with its request id,
    /// because the acknowledge got lost, is answered again and not executed again.
    last_write: Option<(Vec<u8>, Vec<u8>)>,
    /// Until then its controller is one that lives, wherever it is.
    held_until: Option<Instant>,
}

impl Control {
    /// A device that no client controls.
    pub fn new(registers: Registers) -> Self {
        Self { registers, controller: None, acquiring: false, last_write: None, held_until: None }
    }

    /// A device that another client controls until then.
    #[must_use]
    pub fn held(mut self, by: SocketAddrV4, until: Instant) -> Self {
        self.controller = Some(Controller { address: by, exclusive: false, heard: until });
        self.registers.privilege = CONTROL;
        self.registers.controller = Some(by);
        self.held_until = Some(until);
        self
    }

    /// The acquisition ended by itself (single or multi-frame).
    pub fn acquisition_ended(&mut self) {
        self.acquiring = false;
    }

    /// Whether an acquisition is running now.
    pub fn acquiring(&self) -> bool {
        self.acquiring
    }

    /// Handles one datagram that arrived at the control port.
    pub fn handle(&mut self, datagram: &[u8], from: SocketAddrV4, now: Instant) -> Outcome {
        let mut outcome = self.expire(now);
        self.registers.tick(self.acquiring, now);
        let request = match Request::decode(datagram) {
            Ok(request) => request,
            Err(malformed) => {
                outcome.answer = malformed.answer();
                return outcome;
            }
        };
        if let Some(controller) = self.controller.as_mut().filter(|c| c.address == from) {
            controller.heard = now;
            if let Some((_, answer)) = self.last_write.as_ref().filter(|(write, _)| write == datagram) {
                outcome.answer = Some(answer.clone());
                return outcome;
            }
        }
        let answer = self.execute(&request, from, now, &mut outcome.actions);
        // A discovery is answered whatever its flags are.
        outcome.answer = answer.filter(|_| request.ack || request.command == Command::Discovery);
        let write = matches!(request.command, Command::WriteRegisters(_) | Command::WriteMemory { .. });
        if self.is_controller(from) {
            let answer = outcome.answer.clone().filter(|_| write);
            self.last_write = answer.map(|answer| (datagram.to_vec(), answer));
        }
        outcome
    }

    /// Ends the control of a controller that has been silent for too long; stops its stream.
    pub fn expire(&mut self, now: Instant) -> Outcome {
        let timeout = Duration::from_millis(u64::from(self.registers.heartbeat_ms));
        let mut outcome = Outcome::default();
        if self.held_until.is_some_and(|until| now >= until) {
            self.held_until = None;
            self.release(&mut outcome.actions);
        }
        if self.held_until.is_some() {
            return outcome;
        }
        if self.controller.as_ref().is_some_and(|c| now.saturating_duration_since(c.heard) > timeout) {
            self.release(&mut outcome.actions);
        }
        outcome
    }

    /// Gives control to another client, as a switch-over would; the stream stops.
    pub fn hand_over(&mut self, to: SocketAddrV4, now: Instant) -> Outcome {
        let mut outcome = Outcome::default();
        self.release(&mut outcome.actions);
        self.controller = Some(Controller { address: to, exclusive: false, heard: now });
        self.registers.privilege = CONTROL;
        self.registers.controller = Some(to);
        outcome
    }

    fn release(&mut self, actions: &mut Vec<Action>) {
        self.controller = None;
        self.last_write = None;
        self.registers.privilege = 0;
        self.registers.controller = None;
        self.registers.host_port = 0;
        self.acquiring = false;
        actions.push(Action::Stop);
    }

    fn is_controller(&self, from: SocketAddrV4) -> bool {
        self.controller.as_ref().is_some_and(|c| c.address == from)
    }

    /// Exclusive access keeps others from reading; control access does not.
    fn may_read(&self, from: SocketAddrV4) -> bool {
        self.controller.as_ref().is_none_or(|c| !c.exclusive || c.address == from)
    }

    fn execute(
        &mut self,
        request: &Request,
        from: SocketAddrV4,
        now: Instant,
        actions: &mut Vec<Action>,
    ) -> Option<Vec<u8>> {
        let id = request.id;
        match &request.command {
            Command::ForceIp(force) => {
                if !self.registers.can_move() {
                    return Some(gvcp::force_ip_ack(id, Status::NotImplemented));
                }
                // For another device, or for one that a client controls: it is ignored without an answer.
                if force.mac != self.registers.mac() || self.controller.is_some() {
                    return None;
                }
                self.registers.move_to(force);
                actions.push(Action::Move(force.address));
                Some(gvcp::force_ip_ack(id, Status::Success))
            }
            Command::Action(action) => self.act(id, *action, now, actions),
            Command::Discovery => Some(gvcp::discovery_ack(id, &self.registers.discovery())),
            Command::ReadRegisters(addresses) => {
                let (status, values) = self.read_registers(addresses, from);
                Some(gvcp::read_registers_ack(id, status, &values))
            }
            Command::ReadMemory { address, count } => {
                let data = if self.may_read(from) {
                    self.registers.read(*address, *count)
                } else {
                    Err(Status::AccessDenied)
                };
                Some(gvcp::read_memory_ack(id, data.as_deref().map(|d| (*address, d)).map_err(|s| *s)))
            }
            Command::WriteRegisters(pairs) => {
                let mut written = 0u16;
                let mut status = Status::Success;
                for (address, value) in pairs {
                    if let Err(failed) = self.write(*address, &value.to_be_bytes(), from, now, actions) {
                        status = failed;
                        break;
                    }
                    written += 1;
                }
                Some(gvcp::write_registers_ack(id, status, written))
            }
            Command::WriteMemory { address, data } => {
                let (status, written) = self.write_memory(*address, data, from, now, actions);
                Some(gvcp::write_memory_ack(id, status, written))
            }
            Command::PacketResend(resend) => {
                // Stream receivers ask from their own port, so the address alone must be known.
                let controller = self.controller.as_ref().is_some_and(|c| c.address.ip() == from.ip());
                if resend.channel == 0 && (controller || *from.ip() == self.registers.destination) {
                    actions.push(Action::Resend(*resend));
                }
                None
            }
        }
    }

    /// An action of others, or without a controller, is not for this device: not a word.
    fn act(
        &self,
        id: u16,
        action: ActionCommand,
        now: Instant,
        actions: &mut Vec<Action>,
    ) -> Option<Vec<u8>> {
        let [device_key, group_key, group_mask] = self.registers.action_keys;
        let meant = device_key == action.device_key
            && group_key == action.group_key
            && group_mask & action.group_mask != 0;
        if !meant || self.controller.is_none() {
            return None;
        }
        let (status, time) = match action.at_ns.map(|ns| self.registers.common_instant(ns)) {
            None => (Status::Success, now),
            Some(None) => return Some(gvcp::action_ack(id, Status::NoReferenceTime)),
            Some(Some(time)) if time > now => (Status::Success, time),
            Some(Some(_)) => (Status::ActionLate, now),
        };
        actions.push(Action::ActionTrigger { id, time });
        Some(gvcp::action_ack(id, status))
    }

    fn read_registers(&self, addresses: &[u32], from: SocketAddrV4) -> (Status, Vec<u32>) {
        if !self.may_read(from) {
            return (Status::AccessDenied, Vec::new());
        }
        let mut values = Vec::with_capacity(addresses.len());
        for address in addresses {
            match self.registers.read(*address, 4).map(<[u8; 4]>::try_from) {
                Ok(Ok(bytes)) => values.push(u32::from_be_bytes(bytes)),
                Ok(Err(_)) => return (Status::InvalidAddress, values),
                Err(status) => return (status, values),
            }
        }
        (Status::Success, values)
    }

    fn write_memory(
        &mut self,
        address: u32,
        data: &[u8],
        from: SocketAddrV4,
        now: Instant,
        actions: &mut Vec<Action>,
    ) -> (Status, u16) {
        let mut written = 0usize;
        while written < data.len() {
            let offset = u32::try_from(written).unwrap_or(u32::MAX);
            let Some(at) = address.checked_add(offset) else {
                return (Status::InvalidAddress, (written & 0xffff) as u16);
            };
            match self.write(at, &data[written..], from, now, actions) {
                Ok(length) => written += length,
                Err(status) => return (status, (written & 0xffff) as u16),
            }
        }
        (Status::Success, (written & 0xffff) as u16)
    }

    /// Writes one register, whatever it sets off; returns how many bytes it took.
    fn write(
        &mut self,
        address: u32,
        data: &[u8],
        from: SocketAddrV4,
        now: Instant,
        actions: &mut Vec<Action>,
    ) -> Result<usize, Status> {
        let taking_control = address == super::map::Id::Privilege.address() && self.controller.is_none();
        if !taking_control && !self.is_controller(from) {
            return Err(Status::AccessDenied);
        }
        let (length, effect) = self.registers.write(address, data, self.acquiring, now)?;
        self.registers.note();
        match effect {
            None => {}
            Some(Effect::Privilege(value)) => self.write_privilege(value, from, now, actions)?,
            Some(Effect::Start) if !self.acquiring => {
                actions.push(Action::Start(self.stream_settings()?));
                self.acquiring = true;
                self.registers.triggers_ignored = 0;
            }
            Some(Effect::Stop) => {
                self.acquiring = false;
                actions.push(Action::Stop);
            }
            Some(Effect::SoftwareTrigger) if self.acquiring => actions.push(Action::SoftwareTrigger),
            Some(Effect::Stream) if self.acquiring => actions.push(Action::Update(self.stream_settings()?)),
            Some(Effect::TestPacket) => {
                let destination = self.registers.stream_destination().ok_or(Status::AccessDenied)?;
                let (packet_size, do_not_fragment) =
                    (self.registers.packet_size, self.registers.do_not_fragment);
                actions.push(Action::TestPacket { destination, packet_size, do_not_fragment });
            }
            Some(Effect::Start | Effect::SoftwareTrigger | Effect::Stream) => {}
        }
        Ok(length)
    }

    fn write_privilege(
        &mut self,
        value: u32,
        from: SocketAddrV4,
        now: Instant,
        actions: &mut Vec<Action>,
    ) -> Result<(), Status> {
        match value {
            0 if self.controller.is_some() => self.release(actions),
            0 => {}
            CONTROL | EXCLUSIVE | 3 => {
                let exclusive = value & EXCLUSIVE != 0;
                self.controller = Some(Controller { address: from, exclusive, heard: now });
                self.registers.privilege = value;
                self.registers.controller = Some(from);
            }
            // Switchover and its key are not implemented, and the capability register has no bit for them.
            _ => return Err(Status::InvalidParameter),
        }
        Ok(())
    }

    fn stream_settings(&self) -> Result<StreamSettings, Status> {
        let registers = &self.registers;
        let (width, height) = (registers.settings.width, registers.settings.height);
        let layout = Layout::new(width, height, registers.packet_size, registers.ids)
            .map(|layout| layout.with(registers.form()));
        Ok(StreamSettings {
            settings: registers.settings.clone(),
            layout: layout.ok_or(Status::InvalidParameter)?,
            destination: registers.stream_destination(),
            packet_delay: Duration::from_nanos(u64::from(registers.packet_delay)),
            do_not_fragment: registers.do_not_fragment,
        })
    }
}

#[cfg(test)]
mod tests;
