// SPDX-License-Identifier: MIT OR Apache-2.0
//! Firewalls that would drop what cameras send: rules of nft or iptables, followed for a packet of each camera.
//!
//! A packet socket hears packets before the firewall does; discovery, test packets and UDP sockets hear them after it.

mod chains;
mod iptables;
mod nft;

use super::load::Load;
use super::{Check, Finding};
use crate::config::SocketMode;
use chains::{Chains, Fate, Packet};
use std::io::ErrorKind;
use std::net::Ipv4Addr;
use std::process::Command;

/// What is known of the rules.
#[derive(Debug, Clone, PartialEq)]
pub enum Rules {
    /// Read.
    Read(Chains),
    /// Neither tool is installed.
    NoTool,
    /// They cannot be read: why.
    Refused(String),
}

/// Reads what a tool printed.
type Reader = fn(&str) -> Result<Chains, String>;

/// Reads the rules by `nft`, or by `iptables-save` where that is not there.
pub fn gather() -> Rules {
    let tools: [(&str, &[&str], Reader); 2] =
        [("nft", &["-j", "list", "ruleset"], nft::read), ("iptables-save", &[], iptables::read)];
    for (tool, arguments, read) in tools {
        // A node's user often has no sbin on its path.
        let places = ["", "/usr/sbin/", "/sbin/"].map(|place| format!("{place}{tool}"));
        for program in places {
            match Command::new(&program).args(arguments).output() {
                Err(error) if error.kind() == ErrorKind::NotFound => {}
                Err(error) => return Rules::Refused(format!("{program}: {error}")),
                Ok(output) if !output.status.success() => {
                    let why = String::from_utf8_lossy(&output.stderr);
                    let why = why.lines().next().unwrap_or("it failed").trim();
                    return Rules::Refused(format!("{tool}: {why}"));
                }
                Ok(output) => {
                    return match read(&String::from_utf8_lossy(&output.stdout)) {
                        Ok(chains) => Rules::Read(chains),
                        Err(error) => Rules::Refused(format!("{tool}: {error}")),
                    };
                }
            }
        }
    }
    Rules::NoTool
}

/// The verdict on each interface, by the addresses of its cameras.
pub fn judge(
    rules: &Rules,
    cameras: &[(String, Vec<Ipv4Addr>)],
    load: &Load,
    packet_socket: bool,
) -> Vec<Finding> {
    let expected = "packets of cameras (UDP) to be accepted";
    let chains = match rules {
        Rules::Read(chains) => chains,
        Rules::NoTool => {
            let found = "not examined: neither nft nor iptables-save is installed";
            let advice = "without them there is hardly a firewall; install nftables to look";
            return vec![Check::host("firewall").warning(found, expected, advice)];
        }
        Rules::Refused(why) => {
            let advice = "run `sudo fourdbody doctor` once to look";
            return vec![Check::host("firewall").warning(format!("not examined ({why})"), expected, advice)];
        }
    };
    let by_packet_socket = packet_socket && load.socket == SocketMode::Auto;
    let judge = |(interface, addresses): &(String, Vec<Ipv4Addr>)| {
        let check = Check::host(format!("firewall on {interface}"));
        let packets = || addresses.iter().map(|from| Packet { interface, from: *from });
        let fates: Vec<Fate> = packets().map(|packet| chains.follow(&packet)).collect();
        let dropped = fates.iter().find_map(|fate| match fate {
            Fate::Dropped(by) => Some(by),
            _ => None,
        });
        let chain = packets().find_map(|packet| chains.dropping(&packet));
        let advice = chain.map_or_else(String::new, |chain| letting_pass(chain, interface));
        match dropped {
            Some(by) if by_packet_socket => check.warning(
                format!("drops packets of cameras ({by}); the packet socket hears them before that, discovery does not"),
                expected,
                advice,
            ),
            Some(by) => check.failed(format!("drops packets of cameras ({by})"), expected, advice),
            None => match fates.iter().find_map(|fate| match fate {
                Fate::Unknown(by) => Some(by),
                _ => None,
            }) {
                Some(by) => check.warning(format!("a rule could not be followed ({by})"), expected, "look at it"),
                None => check.ok("accepts packets of cameras"),
            },
        }
    };
    cameras.iter().map(judge).collect()
}

/// The rule at the head of a chain that lets the packets of cameras pass.
fn letting_pass(chain: &str, interface: &str) -> String {
    // By nft a chain has its family and table before it, by iptables-save its name alone.
    let rule = match chain.split(' ').next() {
        // A chain of a device alone sees no other interface.
        Some("netdev") => format!("nft insert rule {chain} udp sport 1-65535 accept"),
        Some(family) if family != chain => {
            format!("nft insert rule {chain} iifname {interface} udp sport 1-65535 accept")
        }
        _ => format!("iptables -I {chain} -i {interface} -p udp -j ACCEPT"),
    };
    format!("`{rule}`, and the same where your firewall keeps its rules")
}

#[cfg(test)]
mod tests {
    use super::{Rules, iptables, judge, nft};
    use crate::doctor::Grade;
    use crate::doctor::load::Load;

    #[test]
    fn what_drops_packets_fails_unless_a_packet_socket_hears_them() {
        let text = r#"{"nftables":[{"chain":{"family":"inet","table":"f","name":"in","hook":"input","prio":0,"policy":"drop"}}]}"#;
        let rules = Rules::Read(nft::read(text).expect("JSON"));
        let cameras = [("cam0".to_owned(), vec![[10, 0, 0, 2].into()])];
        let grade =
            |rules: &Rules, packet_socket| judge(rules, &cameras, &Load::reference(), packet_socket)[0].grade;
        assert_eq!((grade(&rules, true), grade(&rules, false)), (Grade::Warning, Grade::Failed));
        // What is advised names what is there.
        let advice = |rules: &Rules| judge(rules, &cameras, &Load::reference(), false)[0].advice.clone();
        assert!(
            advice(&rules).starts_with("`nft insert rule inet f in iifname cam0 udp"),
            "{}",
            advice(&rules)
        );
        let text =
            "*filter\n:INPUT ACCEPT [0:0]\n:own - [0:0]\n-A INPUT -j own\n-A own -p udp -j DROP\nCOMMIT\n";
        let rules = Rules::Read(iptables::read(text).expect("rules"));
        assert!(
            advice(&rules).starts_with("`iptables -I INPUT -i cam0 -p udp -j ACCEPT`"),
            "{}",
            advice(&rules)
        );
        let text = r#"{"nftables":[{"chain":{"family":"netdev","table":"t","name":"c","hook":"ingress","dev":"cam0","prio":0,"policy":"drop"}}]}"#;
        let rules = Rules::Read(nft::read(text).expect("JSON"));
        assert!(advice(&rules).starts_with("`nft insert rule netdev t c udp sport"), "{}", advice(&rules));
        let empty = Rules::Read(nft::read(r#"{"nftables":[]}"#).expect("JSON"));
        assert_eq!(grade(&empty, false), Grade::Ok);
        for rules in [Rules::NoTool, Rules::Refused("nft: Operation not permitted".to_owned())] {
            let findings = judge(&rules, &cameras, &Load::reference(), true);
            assert_eq!(findings[0].grade, Grade::Warning);
            assert!(findings[0].found.contains("not examined"), "{}", findings[0]);
        }
    }
}
