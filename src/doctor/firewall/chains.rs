// SPDX-License-Identifier: MIT OR Apache-2.0
//! Chains of rules, and what becomes of a camera's packet in them: it goes from rule to rule until one decides.

use crate::network::Subnet;
use std::collections::BTreeMap;
use std::net::Ipv4Addr;

/// The first packet of a camera: UDP, to a port that the kernel has chosen, of no connection that is known.
#[derive(Debug, Clone, Copy)]
pub struct Packet<'a> {
    /// The interface by which it comes.
    pub interface: &'a str,
    /// Whose it is.
    pub from: Ipv4Addr,
}

/// Ports that the kernel chooses of (`net.ipv4.ip_local_port_range`).
const CHOSEN: (u16, u16) = (32_768, 60_999);
/// Chains that call each other are followed so deep.
const DEPTH: usize = 32;

/// Whether a condition holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Holds {
    /// It does.
    Yes,
    /// It does not.
    No,
    /// It depends on what is not known here.
    Perhaps,
}

impl Holds {
    fn of(holds: bool) -> Self {
        if holds { Self::Yes } else { Self::No }
    }

    /// The opposite.
    pub fn not(self) -> Self {
        match self {
            Self::Yes => Self::No,
            Self::No => Self::Yes,
            Self::Perhaps => Self::Perhaps,
        }
    }
}

/// What a rule asks of a packet.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Condition {
    /// It comes by one of these interfaces; `*` or `+` at the end stands for anything.
    Interface(Vec<String>),
    /// It is UDP.
    Udp(bool),
    /// It comes from one of these networks.
    From(Vec<Subnet>),
    /// It goes to one of these ports.
    ToPorts(Vec<(u16, u16)>),
    /// It belongs to no connection that is known.
    New(bool),
    /// Nobody can say.
    Unknown,
    /// The opposite.
    Not(Box<Condition>),
}

impl Condition {
    fn holds(&self, packet: &Packet<'_>) -> Holds {
        match self {
            Self::Interface(names) => {
                Holds::of(names.iter().any(|name| match name.strip_suffix(['*', '+']) {
                    Some(start) => packet.interface.starts_with(start),
                    None => name == packet.interface,
                }))
            }
            Self::Udp(udp) | Self::New(udp) => Holds::of(*udp),
            Self::From(networks) => Holds::of(networks.iter().any(|network| network.contains(packet.from))),
            Self::ToPorts(ranges) => {
                let (first, last) = CHOSEN;
                if ranges.iter().any(|(from, to)| *from <= first && last <= *to) {
                    Holds::Yes
                } else if ranges.iter().all(|(from, to)| *to < first || last < *from) {
                    Holds::No
                } else {
                    Holds::Perhaps
                }
            }
            Self::Unknown => Holds::Perhaps,
            Self::Not(condition) => condition.holds(packet).not(),
        }
    }
}

/// What a rule does.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Verdict {
    /// The packet goes on to the next chain of the hook.
    Accept,
    /// It is gone.
    Drop,
    /// Another chain, and back.
    Jump(String),
    /// Another chain, and not back.
    Goto(String),
    /// Back to the chain that called.
    Return,
}

/// One rule.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Rule {
    /// All must hold.
    pub conditions: Vec<Condition>,
    /// What it does then.
    pub verdict: Verdict,
}

/// One chain.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Chain {
    /// Whether packets for this host come here by themselves.
    pub is_input: bool,
    /// Whether it drops what no rule decides.
    pub drops: bool,
    /// Its rules.
    pub rules: Vec<Rule>,
}

/// All chains, by their names.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Chains(pub BTreeMap<String, Chain>);

/// What becomes of a packet.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Fate {
    /// It arrives.
    Accepted,
    /// It is dropped: by what.
    Dropped(String),
    /// That depends on a rule of this chain.
    Unknown(String),
}

/// How a chain ends.
enum End {
    Decided(Fate),
    Through,
}

impl Chains {
    /// What becomes of a packet: every chain of the input must let it pass.
    pub fn follow(&self, packet: &Packet<'_>) -> Fate {
        let mut fate = Fate::Accepted;
        for (name, chain) in self.0.iter().filter(|(_, chain)| chain.is_input) {
            let here = match self.chain(name, packet, 0) {
                End::Decided(fate) => fate,
                End::Through if chain.drops => Fate::Dropped(format!("policy of chain {name}")),
                End::Through => Fate::Accepted,
            };
            match here {
                Fate::Dropped(_) => return here,
                Fate::Unknown(_) => fate = here,
                Fate::Accepted => {}
            }
        }
        fate
    }

    /// The chain of the input behind which the packet is dropped: a rule at its head lets the packet pass.
    pub fn dropping(&self, packet: &Packet<'_>) -> Option<&str> {
        let drops = |(name, chain): &(&String, &Chain)| match self.chain(name, packet, 0) {
            End::Decided(fate) => matches!(fate, Fate::Dropped(_)),
            End::Through => chain.drops,
        };
        let mut input = self.0.iter().filter(|(_, chain)| chain.is_input);
        input.find(drops).map(|(name, _)| name.as_str())
    }

    fn chain(&self, name: &str, packet: &Packet<'_>, depth: usize) -> End {
        let unknown = || End::Decided(Fate::Unknown(format!("chain {name}")));
        let Some(chain) = self.0.get(name).filter(|_| depth < DEPTH) else { return unknown() };
        for (number, rule) in (1..).zip(&chain.rules) {
            let all = rule.conditions.iter().map(|condition| condition.holds(packet));
            let holds = all.fold(Holds::Yes, |so_far, next| match (so_far, next) {
                (Holds::No, _) | (_, Holds::No) => Holds::No,
                (Holds::Perhaps, _) | (_, Holds::Perhaps) => Holds::Perhaps,
                _ => Holds::Yes,
            });
            match holds {
                Holds::No => continue,
                Holds::Perhaps => {
                    // What a policy would do anyway needs no look at the rule.
                    if rule.verdict == Verdict::Accept
                        && !chain.drops
                        && self.rest_accepts(chain, number, packet)
                    {
                        continue;
                    }
                    return unknown();
                }
                Holds::Yes => {}
            }
            match &rule.verdict {
                Verdict::Accept => return End::Decided(Fate::Accepted),
                Verdict::Drop => {
                    return End::Decided(Fate::Dropped(format!("rule {number} of chain {name}")));
                }
                Verdict::Return => return End::Through,
                Verdict::Goto(to) => return self.chain(to, packet, depth + 1),
                Verdict::Jump(to) => match self.chain(to, packet, depth + 1) {
                    End::Through => {}
                    decided => return decided,
                },
            }
        }
        End::Through
    }

    /// Whether no rule from `number` on can drop the packet.
    fn rest_accepts(&self, chain: &Chain, number: usize, packet: &Packet<'_>) -> bool {
        let can = |rule: &Rule| rule.conditions.iter().all(|condition| condition.holds(packet) != Holds::No);
        chain.rules[number..].iter().filter(|rule| can(rule)).all(|rule| rule.verdict == Verdict::Accept)
    }
}
