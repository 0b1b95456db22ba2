// SPDX-License-Identifier: MIT OR Apache-2.0
//! The cameras that answer on the network, and which of them belong to the bench.

use super::addresses::PATIENCE;
use super::found::Found;
use super::options::{Operator, Options};
use crate::network::{Answer, Interface, Subnet, discover};

/// All cameras that answer a broadcast on these interfaces.
pub fn who_answers(interfaces: &[Interface], operator: &mut dyn Operator) -> Vec<Answer> {
    let names: Vec<String> = interfaces
        .iter()
        .map(|at| {
            let subnets: Vec<String> = at.subnets.iter().map(ToString::to_string).collect();
            format!("{} ({})", at.name, subnets.join(", "))
        })
        .collect();
    operator.tell(&format!("discovery on {}", names.join(", ")));
    discover(interfaces, PATIENCE)
}

/// The cameras in the network of the option --network, and those named by --camera.
pub fn those_meant(options: &Options, everybody: &[Answer]) -> Vec<Answer> {
    let is_meant = |answer: &&Answer| {
        let found = Found::of_network(answer);
        options.network.is_none_or(|network| network.contains(answer.address))
            || options.claims.iter().any(|claim| found.is_known_as(&claim.who))
    };
    everybody.iter().filter(is_meant).cloned().collect()
}

/// Remarks on cameras that neither option includes and this host cannot reach: one of them may belong to this bench.
pub fn left_out(
    meant: &[Answer],
    everybody: &[Answer],
    interfaces: &[Interface],
    network: Option<Subnet>,
) -> Vec<String> {
    let Some(network) = network else { return Vec::new() };
    let is_reached = |answer: &Answer| {
        interfaces.iter().any(|at| at.name == answer.interface && at.contains(answer.address))
    };
    everybody
        .iter()
        .filter(|answer| !meant.contains(answer) && !is_reached(answer))
        .map(|answer| {
            format!(
                "{answer} answers on {}, in a wrong subnet and outside --network {network}: where it belongs to this \
                 bench, give --camera ID={}",
                answer.interface, answer.mac
            )
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::left_out;
    use crate::network::{Answer, Interface, Mac};

    #[test]
    fn a_camera_out_of_reach_and_outside_the_options_is_named() {
        let subnets = vec!["192.168.10.1/24".parse().expect("a network")];
        let at = Interface { name: "cam0".to_owned(), mtu: None, up: true, speed_mbit: None, subnets };
        let answer = |last, address: [u8; 4]| Answer {
            mac: Mac(last),
            address: address.into(),
            vendor: String::new(),
            model: String::new(),
            serial: format!("S{last}"),
            user_name: String::new(),
            interface: "cam0".to_owned(),
        };
        // One of the bench, one of another bench on the same wire, one without an address of its own.
        let all = [answer(1, [192, 168, 10, 2]), answer(2, [192, 168, 10, 200]), answer(3, [169, 254, 1, 1])];
        let network = "192.168.10.0/28".parse().expect("a network");
        let notes = left_out(&all[..1], &all, std::slice::from_ref(&at), Some(network));
        assert_eq!(notes.len(), 1, "{notes:?}");
        assert!(notes[0].contains("S3 at 169.254.1.1") && notes[0].contains("--camera"), "{notes:?}");
        assert!(left_out(&all[..1], &all, &[at], None).is_empty());
    }
}
