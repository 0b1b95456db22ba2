// SPDX-License-Identifier: MIT OR Apache-2.0
//! Cameras and interfaces whose subnets do not fit: a camera that this host cannot reach, two interfaces in one subnet.

use super::finding::{Check, Finding};
use crate::network::{Answer, Interface, shared_subnets};

/// The verdicts: on interfaces that share a subnet where one of `used` is among them, and on cameras that answered a
/// broadcast from a subnet that their interface is not in.
pub fn judge(all: &[Interface], used: &[Interface], answers: &[Answer]) -> Vec<Finding> {
    let is_used = |name: &str| {
        used.iter().any(|at| at.name == name) || answers.iter().any(|answer| answer.interface == name)
    };
    let mut findings = Vec::new();
    for (subnet, one, other) in shared_subnets(all) {
        if is_used(one) || is_used(other) {
            findings.push(Check::host(format!("subnet of {one}")).failed(
                format!(
                    "{one} and {other} are both in the subnet of {subnet}: packets leave by one of them alone"
                ),
                "a subnet of its own for each interface of cameras",
                format!("`ip address` on {one} or {other}, then `fourdbody cameras setup`"),
            ));
        }
    }
    for answer in answers {
        let Some(at) = all.iter().find(|at| at.name == answer.interface) else { continue };
        if !at.contains(answer.address) {
            let subnets: Vec<String> = at.subnets.iter().map(ToString::to_string).collect();
            findings.push(Check::device("a camera in a wrong subnet").warning(
                format!("{answer} answers on {}", at.name),
                format!("an address in {}", subnets.join(" or ")),
                "`fourdbody cameras setup` gives it one, which it keeps",
            ));
        }
    }
    findings
}

#[cfg(test)]
mod tests {
    use super::judge;
    use crate::doctor::finding::Grade;
    use crate::network::{Answer, Interface, Mac};

    fn interface(name: &str, subnet: &str) -> Interface {
        let subnets = vec![subnet.parse().expect("a network")];
        Interface { name: name.to_owned(), mtu: Some(9000), up: true, speed_mbit: None, subnets }
    }

    fn answer(address: [u8; 4], interface: &str) -> Answer {
        Answer {
            mac: Mac(7),
            address: address.into(),
            vendor: "Maker".to_owned(),
            model: "M1".to_owned(),
            serial: "42".to_owned(),
            user_name: String::new(),
            interface: interface.to_owned(),
        }
    }

    #[test]
    fn what_does_not_fit_is_named_and_what_has_no_cameras_is_not() {
        let all = [
            interface("cam0", "192.168.10.1/24"),
            interface("cam1", "192.168.10.2/24"),
            interface("lan", "10.0.0.5/8"),
            interface("vpn", "10.9.0.1/24"),
        ];
        let lines = |used: &[Interface], answers: &[Answer]| -> Vec<String> {
            judge(&all, used, answers).iter().map(ToString::to_string).collect()
        };
        assert!(lines(&all[..0], &[]).is_empty(), "no cameras are there");
        let shared = lines(&all[..1], &[]);
        assert!(shared.len() == 1 && shared[0].contains("cam0 and cam1"), "{shared:?}");
        let findings = judge(&all[2..3], &all[2..3], &[answer([169, 254, 1, 2], "lan")]);
        assert_eq!(findings.len(), 1, "{findings:?}");
        assert_eq!(findings[0].grade, Grade::Warning);
        assert!(findings[0].to_string().contains("cameras setup"), "{}", findings[0]);
        assert!(judge(&all[2..3], &[], &[answer([10, 0, 0, 9], "lan")]).is_empty());
    }
}
