// SPDX-License-Identifier: MIT OR Apache-2.0
//! Rules as `iptables-save` prints them: the table `filter`.

use super::chains::{Chain, Chains, Condition, Rule, Verdict};
use crate::network::Subnet;

/// Reads what the program printed.
///
/// # Errors
/// It is something else.
pub fn read(text: &str) -> Result<Chains, String> {
    let mut chains = Chains::default();
    let mut in_filter = false;
    for line in text.lines().map(str::trim) {
        if let Some(table) = line.strip_prefix('*') {
            in_filter = table == "filter";
        } else if let Some(chain) = line.strip_prefix(':').filter(|_| in_filter) {
            let mut words = chain.split_whitespace();
            let (name, policy) = (words.next().unwrap_or_default(), words.next().unwrap_or_default());
            let chain = Chain { is_input: name == "INPUT", drops: policy == "DROP", rules: Vec::new() };
            chains.0.insert(name.to_owned(), chain);
        } else if let Some(rule) = line.strip_prefix("-A ").filter(|_| in_filter) {
            let mut words = rule.split_whitespace();
            let name = words.next().unwrap_or_default();
            let chain = chains.0.get_mut(name).ok_or_else(|| format!("a rule of no chain: {line}"))?;
            chain.rules.extend(read_rule(&words.collect::<Vec<_>>()));
        }
    }
    Ok(chains)
}

/// A rule that decides nothing is none.
fn read_rule(words: &[&str]) -> Option<Rule> {
    let (mut conditions, mut verdict, mut negated) = (Vec::new(), None, false);
    let mut words = words.iter().copied();
    while let Some(word) = words.next() {
        if word == "!" {
            negated = true;
            continue;
        }
        let condition = match word {
            "-j" | "-g" => {
                verdict = match (words.next()?, word) {
                    ("ACCEPT", _) => Some(Verdict::Accept),
                    ("DROP" | "REJECT", _) => Some(Verdict::Drop),
                    ("RETURN", _) => Some(Verdict::Return),
                    ("LOG" | "NFLOG" | "MARK" | "CONNMARK" | "TRACE" | "AUDIT", _) => return None,
                    (other, "-g") => Some(Verdict::Goto(other.to_owned())),
                    (other, _) => Some(Verdict::Jump(other.to_owned())),
                };
                // What follows belongs to the target.
                break;
            }
            "-m" => {
                words.next();
                continue;
            }
            "-i" => Condition::Interface(vec![words.next()?.to_owned()]),
            "-p" => Condition::Udp(["udp", "17", "all"].contains(&words.next()?)),
            "-s" => match network(words.next()?) {
                Some(network) => Condition::From(vec![network]),
                None => Condition::Unknown,
            },
            "--dport" | "--dports" => ports(words.next()?).map_or(Condition::Unknown, Condition::ToPorts),
            "--ctstate" | "--state" => Condition::New(words.next()?.split(',').any(|state| state == "NEW")),
            "--comment" => {
                // Quoted, perhaps of several words.
                let first = words.next()?;
                if first.starts_with('"') && (first.len() == 1 || !first.ends_with('"')) {
                    words.find(|word| word.ends_with('"'));
                }
                continue;
            }
            _ if word.starts_with('-') => Condition::Unknown,
            // The value of something that is not known here.
            _ => continue,
        };
        conditions.push(if negated { Condition::Not(Box::new(condition)) } else { condition });
        negated = false;
    }
    Some(Rule { conditions, verdict: verdict? })
}

fn network(text: &str) -> Option<Subnet> {
    if text.contains('/') { text.parse().ok() } else { format!("{text}/32").parse().ok() }
}

fn ports(text: &str) -> Option<Vec<(u16, u16)>> {
    let range = |text: &str| {
        let (from, to) = text.split_once(':').unwrap_or((text, text));
        Some((from.parse().ok()?, to.parse().ok()?))
    };
    text.split(',').map(range).collect()
}

#[cfg(test)]
mod tests {
    use super::read;
    use crate::doctor::firewall::chains::{Fate, Packet};

    const UFW: &str = "*nat\n:INPUT ACCEPT [0:0]\nCOMMIT\n*filter\n:INPUT DROP [1:2]\n:FORWARD DROP [0:0]\n:own - [0:0]\n\
        -A INPUT -i lo -j ACCEPT\n-A INPUT -m conntrack --ctstate RELATED,ESTABLISHED -j ACCEPT\n\
        -A INPUT -p tcp -m tcp --dport 22 -j ACCEPT\n-A INPUT -j LOG --log-prefix \"[all] \"\n-A INPUT -j own\n\
        -A own -i cam+ -p udp -m comment --comment \"the cameras\" -j ACCEPT\n-A own ! -s 10.0.0.0/8 -j DROP\nCOMMIT\n";

    fn fate(text: &str, interface: &str, from: [u8; 4]) -> Fate {
        read(text).expect("rules").follow(&Packet { interface, from: from.into() })
    }

    #[test]
    fn a_packet_goes_from_rule_to_rule() {
        assert_eq!(fate(UFW, "lo", [127, 0, 0, 2]), Fate::Accepted);
        assert_eq!(fate(UFW, "cam1", [192, 168, 10, 2]), Fate::Accepted);
        assert_eq!(fate(UFW, "eth0", [192, 168, 10, 2]), Fate::Dropped("rule 2 of chain own".to_owned()));
        assert_eq!(fate(UFW, "eth0", [10, 0, 0, 2]), Fate::Dropped("policy of chain INPUT".to_owned()));
        assert_eq!(fate("", "eth0", [10, 0, 0, 2]), Fate::Accepted);
        let odd = "*filter\n:INPUT DROP [0:0]\n-A INPUT -m owner --uid-owner 5 -j ACCEPT\nCOMMIT\n";
        assert!(matches!(fate(odd, "eth0", [10, 0, 0, 2]), Fate::Unknown(_)));
        assert!(read("*filter\n-A none -j DROP\n").is_err());
    }
}
