// SPDX-License-Identifier: MIT OR Apache-2.0
//! Addresses of a camera: the one that it has, those that it keeps, and how it came to them.

use super::map::Id;
use std::net::Ipv4Addr;
use std::sync::{Arc, Mutex, PoisonError};

/// A camera's address, subnet mask and gateway.
pub type Addresses = (Ipv4Addr, Ipv4Addr, Ipv4Addr);

/// Bit of the configuration register: the camera has a persistent address.
const PERSISTENT: u32 = 1;
/// Configuration register: link-local address; cannot be switched off.
const LINK_LOCAL: u32 = 4;
/// What it can be: persistent, DHCP, link-local.
const OPTIONS: u32 = 7;

/// What is kept without power.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Kept {
    configuration: u32,
    addresses: Addresses,
}

/// The network registers of a camera that can be moved.
#[derive(Debug, Clone)]
pub struct Network {
    /// What it has at the moment.
    pub now: Addresses,
    /// It has a link-local address, where only broadcasts reach it.
    pub away: bool,
    kept: Arc<Mutex<Kept>>,
}

impl Network {
    /// Of a camera at this address, which it keeps.
    pub fn new(address: Ipv4Addr) -> Self {
        let addresses = (address, Ipv4Addr::from_bits(0xff00_0000), Ipv4Addr::UNSPECIFIED);
        let kept = Kept { configuration: PERSISTENT | LINK_LOCAL, addresses };
        Self { now: addresses, away: false, kept: Arc::new(Mutex::new(kept)) }
    }

    /// The addresses of a camera that was never given one.
    pub fn link_local(address: Ipv4Addr) -> Self {
        let [_, _, c, d] = address.octets();
        let network = Self::new(address);
        network.change(|kept| kept.configuration = LINK_LOCAL);
        let now = (Ipv4Addr::new(169, 254, c, d), Ipv4Addr::new(255, 255, 0, 0), Ipv4Addr::UNSPECIFIED);
        Self { now, away: true, ..network }
    }

    /// After power-on: the address that it keeps, or a link-local one.
    #[must_use]
    pub fn power_on(&self) -> Self {
        let kept = *self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        if kept.configuration & PERSISTENT != 0 {
            return Self { now: kept.addresses, away: false, kept: Arc::clone(&self.kept) };
        }
        Self { kept: Arc::clone(&self.kept), ..Self::link_local(kept.addresses.0) }
    }

    fn change(&self, change: impl FnOnce(&mut Kept)) {
        change(&mut self.kept.lock().unwrap_or_else(PoisonError::into_inner));
    }

    /// What a register of it holds.
    pub fn word(&self, id: Id) -> Option<u32> {
        let kept = *self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        Some(match id {
            Id::IpOptions => OPTIONS,
            Id::IpConfiguration => kept.configuration,
            Id::IpAddress => self.now.0.to_bits(),
            Id::SubnetMask => self.now.1.to_bits(),
            Id::Gateway => self.now.2.to_bits(),
            Id::PersistentAddress => kept.addresses.0.to_bits(),
            Id::PersistentMask => kept.addresses.1.to_bits(),
            Id::PersistentGateway => kept.addresses.2.to_bits(),
            _ => return None,
        })
    }

    /// Writes a register of it; false where it is none that can be written.
    pub fn write(&self, id: Id, data: &[u8]) -> bool {
        let Some(value) = data.first_chunk::<4>().copied().map(u32::from_be_bytes) else { return false };
        let address = Ipv4Addr::from_bits(value);
        match id {
            Id::IpConfiguration => self.change(|kept| kept.configuration = value & OPTIONS | LINK_LOCAL),
            Id::PersistentAddress => self.change(|kept| kept.addresses.0 = address),
            Id::PersistentMask => self.change(|kept| kept.addresses.1 = address),
            Id::PersistentGateway => self.change(|kept| kept.addresses.2 = address),
            _ => return false,
        }
        true
    }
}

#[cfg(test)]
mod tests {
    use super::{Id, Network};
    use std::net::Ipv4Addr;

    #[test]
    fn what_is_kept_counts_after_power_on() {
        let (first, kept) = (Ipv4Addr::new(127, 0, 7, 11), Ipv4Addr::new(127, 0, 7, 99));
        let network = Network::new(first);
        assert!(network.write(Id::PersistentAddress, &kept.octets()));
        assert!(!network.write(Id::IpAddress, &kept.octets()), "not its own to choose");
        assert_eq!(network.word(Id::IpAddress), Some(first.to_bits()));
        assert_eq!(network.power_on().now.0, kept);
        assert!(network.write(Id::IpConfiguration, &[0, 0, 0, 0]));
        assert_eq!(network.word(Id::IpConfiguration), Some(4), "link-local cannot be switched off");
        let away = network.power_on();
        assert_eq!((away.now.0, away.away), (Ipv4Addr::new(169, 254, 7, 99), true));
        let new = Network::link_local(first);
        assert_eq!((new.now.0, new.away), (Ipv4Addr::new(169, 254, 7, 11), true));
        assert!(new.write(Id::IpConfiguration, &[0, 0, 0, 1]));
        assert_eq!((new.power_on().now.0, new.power_on().away), (first, false));
    }
}
