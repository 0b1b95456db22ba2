// SPDX-License-Identifier: MIT OR Apache-2.0
//! The reverse-path filter: a strict one drops what a camera sends when its address is reached by another interface.

use super::finding::{Check, Finding};
use crate::network::{Interface, shared_subnets};
use std::path::Path;

/// The kernel's value of a strict filter; 0 is off and 2 is loose.
const STRICT: u32 = 1;

/// The filter of an interface that cameras send to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Filter {
    pub interface: Interface,
    /// The kernel's value in force for it; `None` where it cannot be read.
    pub value: Option<u32>,
}

/// Reads the filters of these interfaces below `proc`, which is `/proc`.
pub fn gather(proc: &Path, interfaces: &[Interface]) -> Vec<Filter> {
    let read = |name: &str| -> Option<u32> {
        let path = proc.join("sys/net/ipv4/conf").join(name).join("rp_filter");
        std::fs::read_to_string(path).ok()?.trim().parse().ok()
    };
    // The larger of the two values is in force (Documentation/networking/ip-sysctl.rst).
    let value = |name: &str| Some(read(name)?.max(read("all")?));
    interfaces.iter().map(|at| Filter { interface: at.clone(), value: value(&at.name) }).collect()
}

/// The verdicts, with all interfaces of this host beside them.
pub fn judge(filters: &[Filter], all: &[Interface]) -> Vec<Finding> {
    let shared = shared_subnets(all);
    let judge = |Filter { interface: Interface { name, .. }, value }: &Filter| {
        let check = Check::host(format!("reverse-path filter of {name}"));
        let pairs = shared.iter().flat_map(|(_, one, other)| [(one, other), (other, one)]);
        let other = pairs.filter(|(one, _)| *one == name).map(|(_, other)| other).next();
        match (value, other) {
            (Some(STRICT), Some(other)) => check.failed(
                format!("strict, and {other} is in the same subnet: packets of cameras there are dropped"),
                "a subnet of its own for each interface, or a loose filter (2)",
                format!(
                    "give {name} a subnet of its own, or `sysctl net.ipv4.conf.{name}.rp_filter=2` and \
                    `...conf.all...`"
                ),
            ),
            (Some(STRICT), None) => check.ok(
                "strict: packets of cameras in the interface's own subnet arrive, those of others do not",
            ),
            (Some(_), _) => check.ok("off or loose"),
            (None, _) => check.warning(
                "cannot be read",
                format!("/proc/sys/net/ipv4/conf/{name}/rp_filter"),
                "mount /proc; a strict filter drops the packets of cameras in other subnets",
            ),
        }
    };
    filters.iter().map(judge).collect()
}

#[cfg(test)]
mod tests {
    use super::{gather, judge};
    use crate::doctor::finding::Grade;
    use crate::network::Interface;
    use std::path::Path;

    fn interface(name: &str, subnet: &str) -> Interface {
        let subnets = vec![subnet.parse().expect("a network")];
        Interface { name: name.to_owned(), mtu: Some(9000), up: true, speed_mbit: None, subnets }
    }

    fn write(proc: &Path, name: &str, value: &str) {
        let dir = proc.join("sys/net/ipv4/conf").join(name);
        std::fs::create_dir_all(&dir).expect("a directory");
        std::fs::write(dir.join("rp_filter"), value).expect("writable");
    }

    #[test]
    fn a_strict_filter_fails_where_two_interfaces_share_a_subnet() {
        use Grade::{Failed, Ok, Warning};
        let proc = tempfile::tempdir().expect("a temporary directory");
        let apart = [interface("cam0", "10.0.0.1/24"), interface("cam1", "10.0.1.1/24")];
        let together = [interface("cam0", "10.0.0.1/24"), interface("cam1", "10.0.0.2/24")];
        let grades = |of: &[Interface]| -> Vec<Grade> {
            judge(&gather(proc.path(), of), of).iter().map(|finding| finding.grade).collect()
        };
        assert_eq!(grades(&apart), [Warning, Warning], "nothing to be read");
        for (all, own, expected) in
            [("0\n", "0\n", Ok), ("0\n", "1\n", Failed), ("1\n", "0\n", Failed), ("2\n", "1\n", Ok)]
        {
            write(proc.path(), "all", all);
            write(proc.path(), "cam0", own);
            write(proc.path(), "cam1", own);
            assert_eq!(grades(&together), [expected; 2], "all {all:?}, own {own:?}");
            assert_eq!(grades(&apart), [Ok; 2]);
        }
        let text = judge(&gather(proc.path(), &together), &together)[0].to_string();
        assert!(text.contains("reverse-path filter of cam0"), "{text}");
    }
}
