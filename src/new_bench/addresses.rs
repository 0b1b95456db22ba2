// SPDX-License-Identifier: MIT OR Apache-2.0
//! Addresses of cameras: which are in a wrong subnet, and which address each of those should have.

use crate::network::{Answer, ForceIp, Interface, Mac, Subnet, force_address, read_kept_address};
use crate::network::{KeptAddress, discover, keep_address};
use std::collections::BTreeSet;
use std::net::Ipv4Addr;
use std::time::Duration;

/// How long cameras are given to answer a broadcast.
pub const PATIENCE: Duration = Duration::from_millis(1000);

/// A camera that should have another address.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Move {
    pub mac: Mac,
    /// The interface on which it answers.
    pub interface: String,
    /// Its new address, with the length of its network's prefix.
    pub to: Subnet,
}

/// New addresses for all cameras of `found` whose own lie in no subnet of the interface on which they answered: the
/// first of that subnet that no camera of `everybody` has, out of `network` where one is wanted.
///
/// # Errors
/// Cameras for which there is no address.
pub fn moves(
    found: &[Answer],
    everybody: &[Answer],
    interfaces: &[Interface],
    network: Option<Subnet>,
) -> Result<Vec<Move>, Vec<String>> {
    let own = interfaces.iter().flat_map(|interface| interface.subnets.iter().map(|subnet| subnet.address));
    let mut taken: BTreeSet<Ipv4Addr> = own.chain(everybody.iter().map(|answer| answer.address)).collect();
    let (mut moves, mut problems) = (Vec::new(), Vec::new());
    for answer in found {
        let Some(interface) = interfaces.iter().find(|interface| interface.name == answer.interface) else {
            continue;
        };
        if interface.contains(answer.address) {
            continue;
        }
        let fits = |subnet: &&Subnet| network.is_none_or(|network| network.overlaps(subnet));
        let subnet = interface.subnets.iter().find(fits);
        let range =
            subnet.map(|subnet| network.filter(|network| network.bits > subnet.bits).unwrap_or(*subnet));
        let free = range.and_then(|range| range.hosts().find(|host| !taken.contains(host)));
        match subnet.zip(free) {
            Some((subnet, address)) => {
                taken.insert(address);
                let to = Subnet { address, bits: subnet.bits };
                moves.push(Move { mac: answer.mac, interface: interface.name.clone(), to });
            }
            None => problems.push(format!(
                "{answer} is in a wrong subnet, and {} has no free address for it: give the interface an address in a \
                 network of its own",
                interface.name
            )),
        }
    }
    if problems.is_empty() { Ok(moves) } else { Err(problems) }
}

/// Gives each camera its new address, and checks that it answers there.
///
/// # Errors
/// A sentence for each camera that does not have its new address.
pub fn carry_out(moves: &[Move], interfaces: &[Interface]) -> Result<(), Vec<String>> {
    let mut problems = Vec::new();
    for Move { mac, interface, to } in moves {
        let Some(at) = interfaces.iter().find(|known| known.name == *interface) else { continue };
        let force = ForceIp { mac: mac.0, address: to.address, mask: to.mask() };
        if let Err(error) = force_address(at, &force, PATIENCE) {
            problems.push(format!("the camera {mac} cannot be given {to} on {interface}: {error}"));
        }
    }
    // The camera's own answer is the proof: an acknowledge may be lost.
    let now = discover(interfaces, PATIENCE);
    for Move { mac, interface, to } in moves {
        let has = now.iter().find(|answer| answer.mac == *mac).map(|answer| answer.address);
        if has != Some(to.address) {
            let has = has.map_or_else(|| "does not answer".to_owned(), |has| format!("has {has}"));
            problems.push(format!(
                "the camera {mac} was given {} on {interface} and {has}: set its address with its vendor's program",
                to.address
            ));
        }
    }
    if problems.is_empty() { Ok(()) } else { Err(problems) }
}

/// Whether a camera has its present address again after a power cycle; a remark for the operator where that cannot be
/// read.
pub fn is_kept(answer: &Answer) -> Result<bool, String> {
    match read_kept_address(answer.address) {
        Ok(KeptAddress::Kept(kept)) => Ok(kept == answer.address),
        Ok(KeptAddress::Any) => Ok(false),
        Err(error) => Err(format!(
            "whether {answer} keeps its address cannot be read ({error}): look after its power was off"
        )),
    }
}

/// Makes a camera keep its present address after a power cycle.
///
/// # Errors
/// Why it does not, and what to do.
pub fn keep(answer: &Answer, interfaces: &[Interface]) -> Result<(), String> {
    let at = interfaces.iter().find(|interface| interface.name == answer.interface);
    let subnet = at.and_then(|at| at.subnets.iter().find(|subnet| subnet.contains(answer.address)));
    let bits = subnet.map_or(24, |subnet| subnet.bits);
    keep_address(Subnet { address: answer.address, bits }).map_err(|error| {
        format!("{answer} does not keep its address ({error}): set it with its vendor's program")
    })
}

#[cfg(test)]
mod tests {
    use super::moves;
    use crate::network::{Answer, Interface, Mac, Subnet};

    fn interface(name: &str, subnet: &str) -> Interface {
        let subnets = vec![subnet.parse::<Subnet>().expect("a network")];
        Interface { name: name.to_owned(), mtu: None, up: true, speed_mbit: None, subnets }
    }

    fn answer(last: u8, address: [u8; 4], interface: &str) -> Answer {
        Answer {
            mac: Mac(u64::from(last)),
            address: address.into(),
            vendor: String::new(),
            model: String::new(),
            serial: String::new(),
            user_name: String::new(),
            interface: interface.to_owned(),
        }
    }

    #[test]
    fn a_camera_in_a_wrong_subnet_gets_the_first_free_address_of_its_interface() {
        let interfaces = [interface("cam0", "192.168.10.1/24"), interface("cam1", "192.168.11.1/24")];
        let found = [
            answer(1, [192, 168, 10, 2], "cam0"),
            answer(2, [169, 254, 3, 3], "cam0"),
            answer(3, [192, 168, 10, 9], "cam1"),
        ];
        // One that is no part of this node has an address all the same.
        let everybody = [&found[..], &[answer(4, [192, 168, 10, 3], "cam0")]].concat();
        let to = |network: Option<&str>| {
            let network = network.map(|text| text.parse().expect("a network"));
            moves(&found, &everybody, &interfaces, network)
                .map(|moves| moves.iter().map(|m| (m.mac.0, m.to.to_string())).collect::<Vec<_>>())
        };
        let expected = vec![(2, "192.168.10.4/24".to_owned()), (3, "192.168.11.2/24".to_owned())];
        assert_eq!(to(None), Ok(expected));
        // One that is wanted within the subnet; none for the other interface.
        let problems = to(Some("192.168.10.64/28")).expect_err("not for cam1");
        assert!(problems.len() == 1 && problems[0].contains("cam1"), "{problems:?}");
        let full = [interface("cam0", "192.168.10.1/31")];
        assert!(moves(&found[1..2], &found, &full, None).is_err());
    }
}
