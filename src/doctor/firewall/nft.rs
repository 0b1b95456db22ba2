// SPDX-License-Identifier: MIT OR Apache-2.0
//! Rules as `nft -j list ruleset` prints them (libnftables-json(5)).

use super::chains::{Chain, Chains, Condition, Rule, Verdict};
use crate::network::Subnet;
use serde_json::{Value, json};

/// Reads what the program printed.
///
/// # Errors
/// It is something else.
pub fn read(text: &str) -> Result<Chains, String> {
    let all: Value = serde_json::from_str(text).map_err(|e| format!("no JSON: {e}"))?;
    let list = all["nftables"].as_array().ok_or("no list of rules")?;
    let mut chains = Chains::default();
    // IPv4 packets pass through these families.
    let of_ip =
        |item: &Value| ["ip", "inet", "netdev"].contains(&item["family"].as_str().unwrap_or_default());
    let text = |item: &Value, key: &str| item[key].as_str().unwrap_or_default().to_owned();
    let name =
        |item: &Value, chain: &str| format!("{} {} {chain}", text(item, "family"), text(item, "table"));
    for item in list.iter().map(|item| &item["chain"]).filter(|item| of_ip(item)) {
        let hooks = ["input", "prerouting", "ingress"];
        let chain = Chain {
            is_input: hooks.contains(&text(item, "hook").as_str()) && text(item, "type") != "nat",
            drops: item["policy"] == "drop",
            rules: Vec::new(),
        };
        chains.0.insert(name(item, &text(item, "name")), chain);
    }
    for item in list.iter().map(|item| &item["rule"]).filter(|item| of_ip(item)) {
        let empty = Vec::new();
        let parts = item["expr"].as_array().unwrap_or(&empty);
        let mut conditions = Vec::new();
        for part in parts {
            let Some((kind, inner)) = part.as_object().and_then(|part| part.iter().next()) else { continue };
            let of = |target: &Value| name(item, target["target"].as_str().unwrap_or_default());
            let mut decided = Vec::new();
            match kind.as_str() {
                "match" => conditions.push(condition(inner)),
                "limit" | "xt" => conditions.push(Condition::Unknown),
                "vmap" => match inner["data"]["set"].as_array() {
                    Some(pairs) => decided.extend(pairs.iter().filter_map(|pair| {
                        let when = json!({ "op": "==", "left": inner["key"], "right": pair[0] });
                        let (kind, target) = pair[1].as_object()?.iter().next()?;
                        Some((Some(condition(&when)), verdict(kind, || of(target))?))
                    })),
                    // A map of a name, which may hold anything.
                    None => decided.push((Some(Condition::Unknown), Verdict::Drop)),
                },
                // Counters, logs and marks decide nothing.
                kind => decided.extend(verdict(kind, || of(inner)).map(|verdict| (None, verdict))),
            }
            if decided.is_empty() {
                continue;
            }
            let Some(chain) = chains.0.get_mut(&name(item, &text(item, "chain"))) else { break };
            for (when, verdict) in decided {
                let conditions = conditions.iter().cloned().chain(when).collect();
                chain.rules.push(Rule { conditions, verdict });
            }
            // What follows a map is for what it does not have; what follows a verdict, for nothing.
            if kind != "vmap" {
                break;
            }
        }
    }
    Ok(chains)
}

/// What a statement decides, where it does.
fn verdict(kind: &str, target: impl Fn() -> String) -> Option<Verdict> {
    match kind {
        "accept" => Some(Verdict::Accept),
        "drop" | "reject" => Some(Verdict::Drop),
        "return" => Some(Verdict::Return),
        "jump" => Some(Verdict::Jump(target())),
        "goto" => Some(Verdict::Goto(target())),
        _ => None,
    }
}

/// Single values of what stands on the right: one, or a set of them.
fn values(right: &Value) -> Vec<&Value> {
    match right.get("set").or(Some(right)) {
        Some(Value::Array(list)) => list.iter().collect(),
        Some(one) => vec![one],
        None => Vec::new(),
    }
}

fn condition(of: &Value) -> Condition {
    let (left, right) = (&of["left"], values(&of["right"]));
    let texts = || right.iter().map(|value| value.as_str().map(str::to_owned)).collect::<Option<Vec<_>>>();
    let meta = left["meta"]["key"].as_str().unwrap_or_default();
    let (protocol, field) = (
        left["payload"]["protocol"].as_str().unwrap_or_default(),
        left["payload"]["field"].as_str().unwrap_or_default(),
    );
    let is_udp = |value: &&Value| value.as_str() == Some("udp") || value.as_u64() == Some(17);
    let found = match (meta, protocol, field) {
        ("iifname" | "iif", ..) => texts().map(Condition::Interface),
        ("l4proto", ..) | (_, "ip", "protocol") => Some(Condition::Udp(right.iter().any(is_udp))),
        ("nfproto", ..) => Some(Condition::Udp(right.iter().any(|value| value.as_str() == Some("ipv4")))),
        (_, "ip", "saddr") => {
            right.iter().map(|value| network(value)).collect::<Option<Vec<_>>>().map(Condition::From)
        }
        (_, "udp" | "th", "dport") => {
            right.iter().map(|value| ports(value)).collect::<Option<Vec<_>>>().map(Condition::ToPorts)
        }
        (_, "tcp" | "icmp" | "icmpv6" | "ip6" | "sctp" | "dccp", _) => Some(Condition::Udp(false)),
        _ if left["ct"]["key"] == "state" => {
            texts().map(|states| Condition::New(states.iter().any(|state| state == "new")))
        }
        _ => None,
    };
    let found = found.unwrap_or(Condition::Unknown);
    match of["op"].as_str() {
        Some("!=") => Condition::Not(Box::new(found)),
        Some("==" | "in") | None => found,
        _ => Condition::Unknown,
    }
}

fn network(value: &Value) -> Option<Subnet> {
    let (address, bits) = match value.as_str() {
        Some(address) => (address, 32),
        None => (value["prefix"]["addr"].as_str()?, value["prefix"]["len"].as_u64()?),
    };
    format!("{address}/{bits}").parse().ok()
}

fn ports(value: &Value) -> Option<(u16, u16)> {
    let port = |value: &Value| u16::try_from(value.as_u64()?).ok();
    match value.get("range").and_then(Value::as_array).map(Vec::as_slice) {
        Some([from, to]) => Some((port(from)?, port(to)?)),
        _ => Some((port(value)?, port(value)?)),
    }
}

#[cfg(test)]
mod tests {
    use super::read;
    use crate::doctor::firewall::chains::{Fate, Packet};
    use serde_json::{Value, json};

    fn ruleset(policy: &str, rules: &[Value]) -> String {
        let chain = |name: &str, hook: Value| {
            json!({"chain": {"family": "inet", "table": "filter", "name": name, "type": "filter", "hook": hook,
                             "prio": 0, "policy": policy}})
        };
        let rule = |expr: &Value| json!({"rule": {"family": "inet", "table": "filter", "chain": "input", "expr": expr}});
        let cams = json!({"rule": {"family": "inet", "table": "filter", "chain": "cams", "expr": [
            {"match": {"op": "==", "left": {"payload": {"protocol": "ip", "field": "saddr"}},
                       "right": {"prefix": {"addr": "192.168.0.0", "len": 16}}}}, {"accept": null}]}});
        let mut list = vec![json!({"metainfo": {"version": "1.0.6"}}), chain("input", json!("input"))];
        list.extend([chain("cams", Value::Null), cams]);
        list.extend(rules.iter().map(rule));
        json!({ "nftables": list }).to_string()
    }

    fn fate(text: &str, interface: &str) -> Fate {
        read(text).expect("rules").follow(&Packet { interface, from: [192, 168, 10, 2].into() })
    }

    fn on(name: &str) -> Value {
        json!({"match": {"op": "==", "left": {"meta": {"key": "iifname"}}, "right": name}})
    }

    #[test]
    fn a_packet_goes_from_rule_to_rule() {
        let known = json!({"match": {"op": "in", "left": {"ct": {"key": "state"}}, "right": ["established", "related"]}});
        let ssh = json!({"match": {"op": "==", "left": {"payload": {"protocol": "tcp", "field": "dport"}}, "right": 22}});
        let high = json!({"match": {"op": "==", "left": {"payload": {"protocol": "udp", "field": "dport"}},
                                    "right": {"range": [1024, 65535]}}});
        let rules = [
            json!([known, {"accept": null}]),
            json!([ssh, {"counter": {"packets": 0, "bytes": 0}}, {"accept": null}]),
            json!([on("cam*"), {"jump": {"target": "cams"}}]),
            json!([on("lab0"), high, {"accept": null}]),
        ];
        let text = ruleset("drop", &rules);
        assert_eq!(fate(&text, "cam3"), Fate::Accepted);
        assert_eq!(fate(&text, "lab0"), Fate::Accepted);
        assert_eq!(fate(&text, "eth0"), Fate::Dropped("policy of chain inet filter input".to_owned()));
        assert_eq!(fate(&ruleset("accept", &rules), "eth0"), Fate::Accepted);
        let dropping = ruleset("accept", &[json!([on("cam0"), {"drop": null}])]);
        assert_eq!(fate(&dropping, "cam0"), Fate::Dropped("rule 1 of chain inet filter input".to_owned()));
        assert_eq!(fate(&dropping, "cam1"), Fate::Accepted);
    }

    #[test]
    fn maps_decide_by_their_pairs() {
        let map = |key: Value, pairs: Value| json!([{"vmap": {"key": key, "data": {"set": pairs}}}]);
        let states = map(
            json!({"ct": {"key": "state"}}),
            json!([["invalid", {"drop": null}], ["established", {"accept": null}], ["related", {"accept": null}]]),
        );
        let names = map(
            json!({"meta": {"key": "iifname"}}),
            json!([["lo", {"accept": null}], ["cam0", {"accept": null}]]),
        );
        let text = ruleset("drop", &[states, names]);
        assert_eq!(fate(&text, "cam0"), Fate::Accepted);
        assert_eq!(fate(&text, "cam1"), Fate::Dropped("policy of chain inet filter input".to_owned()));
        let named = json!([{"vmap": {"key": {"meta": {"key": "iifname"}}, "data": "@zones"}}]);
        assert!(matches!(fate(&ruleset("drop", &[named]), "cam0"), Fate::Unknown(_)));
    }

    #[test]
    fn what_cannot_be_followed_is_said_and_no_text_panics() {
        let odd = json!([{"match": {"op": "==", "left": {"meta": {"key": "skuid"}}, "right": 5}}, {"accept": null}]);
        assert!(matches!(fate(&ruleset("drop", std::slice::from_ref(&odd)), "eth0"), Fate::Unknown(_)));
        assert_eq!(fate(&ruleset("accept", &[odd]), "eth0"), Fate::Accepted, "whatever the rule says");
        assert!(read("[]").is_err() && read("{").is_err());
        assert!(
            read(r#"{"nftables":[{"rule":{"family":"ip","expr":[{"match":{}},{"jump":{}},3]}}]}"#).is_ok()
        );
    }
}
