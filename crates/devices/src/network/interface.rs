// SPDX-License-Identifier: MIT OR Apache-2.0
//! Network interfaces of this host: their subnets, largest packets and speeds.

use std::collections::BTreeMap;
use std::fmt;
use std::net::Ipv4Addr;
use std::path::Path;
use std::str::FromStr;

/// An address with the length of its network's prefix.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Subnet {
    /// Address of an interface, or of the network itself.
    pub address: Ipv4Addr,
    /// Length of the network's prefix in bits, 0 to 32.
    pub bits: u8,
}

impl Subnet {
    /// The network mask: ones in the prefix.
    pub fn mask(&self) -> Ipv4Addr {
        Ipv4Addr::from_bits(u32::MAX.checked_shl(32 - u32::from(self.bits)).unwrap_or(0))
    }

    /// Whether an address lies in it.
    pub fn contains(&self, address: Ipv4Addr) -> bool {
        let mask = self.mask().to_bits();
        self.address.to_bits() & mask == address.to_bits() & mask
    }

    /// Whether the two have addresses in common.
    pub fn overlaps(&self, other: &Self) -> bool {
        self.contains(other.address) || other.contains(self.address)
    }

    /// The host addresses of the network, in order, without the network's own and the broadcast address.
    pub fn hosts(&self) -> impl Iterator<Item = Ipv4Addr> + use<> {
        let mask = self.mask().to_bits();
        let (first, last) = (self.address.to_bits() & mask, self.address.to_bits() | !mask);
        (first.saturating_add(1)..last).map(Ipv4Addr::from_bits)
    }

    /// The broadcast address of the network.
    pub fn broadcast(&self) -> Ipv4Addr {
        Ipv4Addr::from_bits(self.address.to_bits() | !self.mask().to_bits())
    }
}

impl fmt::Display for Subnet {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.address, self.bits)
    }
}

impl FromStr for Subnet {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let expected = || format!("expected a network as 192.168.10.0/24, found {text:?}");
        let (address, bits) = text.split_once('/').ok_or_else(expected)?;
        let bits = bits.parse().ok().filter(|bits| *bits <= 32).ok_or_else(expected)?;
        Ok(Self { address: address.parse().map_err(|_| expected())?, bits })
    }
}

/// A network interface as the system describes it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Interface {
    /// Name of the interface, as `eth0`.
    pub name: String,
    /// Largest IP packet that it sends, bytes.
    pub mtu: Option<u32>,
    /// Whether the interface has a link. The loopback's state "unknown" counts as one.
    pub up: bool,
    /// Speed in Mbit/s, where the driver reports it.
    pub speed_mbit: Option<u64>,
    /// The interface's addresses with their subnets.
    pub subnets: Vec<Subnet>,
}

impl Interface {
    /// Describes an interface from `/sys/class/net`.
    pub fn describe(name: &str, subnets: Vec<Subnet>) -> Self {
        let read = |file: &str| {
            let path = Path::new("/sys/class/net").join(name).join(file);
            std::fs::read_to_string(path).ok().map(|text| text.trim().to_owned())
        };
        Self {
            name: name.to_owned(),
            mtu: read("mtu").and_then(|text| text.parse().ok()),
            up: read("operstate").is_some_and(|state| state == "up" || state == "unknown"),
            // The driver gives -1 where it does not know the speed.
            speed_mbit: read("speed").and_then(|text| text.parse().ok()).filter(|&speed| speed > 0),
            subnets,
        }
    }

    /// Whether an address lies in one of its subnets.
    pub fn contains(&self, address: Ipv4Addr) -> bool {
        self.subnets.iter().any(|subnet| subnet.contains(address))
    }
}

/// All interfaces that have an IPv4 address and are switched on, by their names.
pub fn interfaces() -> Vec<Interface> {
    addresses().into_iter().map(|(name, subnets)| Interface::describe(&name, subnets)).collect()
}

/// Names of interfaces without a link, from the directory `sys` (`/sys`): an unplugged cable, a switch without power,
/// or an interface that is down. Such an interface often has no addresses and routes, so that it shows nowhere else.
pub fn without_link(sys: &Path) -> Vec<String> {
    let state = |path: &Path| std::fs::read_to_string(path.join("operstate")).unwrap_or_default();
    let entries = std::fs::read_dir(sys.join("class/net")).into_iter().flatten().flatten();
    let mut names: Vec<String> = entries
        .filter(|entry| ["down", "lowerlayerdown"].contains(&state(&entry.path()).trim()))
        .map(|entry| entry.file_name().to_string_lossy().into_owned())
        .collect();
    names.sort();
    names
}

/// Names of interfaces that are switched on, with their IPv4 addresses.
fn addresses() -> BTreeMap<String, Vec<Subnet>> {
    let mut list: *mut libc::ifaddrs = std::ptr::null_mut();
    // SAFETY: `list` is a valid place for a pointer.
    if unsafe { libc::getifaddrs(&raw mut list) } != 0 {
        return BTreeMap::new();
    }
    let mut found: BTreeMap<String, Vec<Subnet>> = BTreeMap::new();
    let mut next = list;
    while !next.is_null() {
        // SAFETY: an entry of the list that getifaddrs has made; it lives until the list is freed below.
        let entry = unsafe { &*next };
        next = entry.ifa_next;
        let up = entry.ifa_flags & libc::IFF_UP as u32 != 0;
        let bits = |place: *const libc::sockaddr| {
            // SAFETY: null, or an address that lives as long as the entry; its family gives its length.
            let family = unsafe { place.as_ref() }?.sa_family;
            if i32::from(family) != libc::AF_INET {
                return None;
            }
            // SAFETY: of this family it is a sockaddr_in.
            let address = unsafe { place.cast::<libc::sockaddr_in>().read_unaligned() };
            Some(u32::from_be(address.sin_addr.s_addr))
        };
        let (Some(address), Some(mask)) = (bits(entry.ifa_addr), bits(entry.ifa_netmask)) else { continue };
        // SAFETY: a text that ends with a zero and lives as long as the entry.
        let name = unsafe { std::ffi::CStr::from_ptr(entry.ifa_name) }.to_string_lossy().into_owned();
        let subnet = Subnet { address: Ipv4Addr::from_bits(address), bits: mask.leading_ones() as u8 };
        if up {
            found.entry(name).or_default().push(subnet);
        }
    }
    // SAFETY: made by getifaddrs above, and freed once.
    unsafe { libc::freeifaddrs(list) };
    found
}

/// Pairs of interfaces in one subnet: the system sends through one of them, even where a camera is connected to the
/// other.
pub fn shared_subnets(interfaces: &[Interface]) -> Vec<(Subnet, &str, &str)> {
    let mut pairs = Vec::new();
    for (i, one) in interfaces.iter().enumerate() {
        for other in &interfaces[i + 1..] {
            let both = one.subnets.iter().find(|own| other.subnets.iter().any(|its| own.overlaps(its)));
            pairs.extend(both.map(|subnet| (*subnet, one.name.as_str(), other.name.as_str())));
        }
    }
    pairs
}

#[cfg(test)]
mod tests {
    use super::{Interface, Subnet, interfaces, shared_subnets, without_link};

    fn subnet(text: &str) -> Subnet {
        text.parse().expect("a network")
    }

    #[test]
    fn a_subnet_knows_its_addresses() {
        let subnet = subnet("192.168.10.1/30");
        let hosts: Vec<String> = subnet.hosts().map(|host| host.to_string()).collect();
        assert_eq!(hosts, ["192.168.10.1", "192.168.10.2"]);
        assert_eq!(subnet.broadcast().to_string(), "192.168.10.3");
        assert!(subnet.contains([192, 168, 10, 2].into()) && !subnet.contains([192, 168, 10, 4].into()));
        for wrong in ["192.168.10.1", "192.168.10.1/33", "a/24", "/"] {
            assert!(wrong.parse::<Subnet>().is_err(), "{wrong}");
        }
        assert_eq!("0.0.0.0/0".parse::<Subnet>().map(|all| all.mask().to_bits()), Ok(0));
    }

    #[test]
    fn two_interfaces_in_one_subnet_are_named() {
        let interface = |name: &str, subnets: &[&str]| Interface {
            name: name.to_owned(),
            mtu: Some(9000),
            up: true,
            speed_mbit: None,
            subnets: subnets.iter().map(|text| subnet(text)).collect(),
        };
        let apart = [interface("a", &["10.0.0.1/24"]), interface("b", &["10.0.1.1/24"])];
        assert_eq!(shared_subnets(&apart), []);
        let within = [interface("a", &["10.0.0.1/16"]), interface("b", &["10.1.0.1/24", "10.0.1.1/24"])];
        assert_eq!(shared_subnets(&within), [(subnet("10.0.0.1/16"), "a", "b")]);
        let link_local = [interface("a", &["169.254.1.1/16"]), interface("b", &["169.254.9.9/16"])];
        assert_eq!(shared_subnets(&link_local).len(), 1);
    }

    #[test]
    fn interfaces_without_a_link_are_named() {
        let sys = tempfile::tempdir().expect("a temporary directory");
        for (name, state) in [("cam1", "down"), ("cam0", "lowerlayerdown"), ("lo", "unknown"), ("eth0", "up")]
        {
            let dir = sys.path().join("class/net").join(name);
            std::fs::create_dir_all(&dir).expect("a directory");
            std::fs::write(dir.join("operstate"), format!("{state}\n")).expect("writable");
        }
        assert_eq!(without_link(sys.path()), ["cam0", "cam1"]);
        assert!(without_link(&sys.path().join("none")).is_empty());
    }

    #[test]
    fn the_loopback_is_among_the_interfaces() {
        let found = interfaces();
        let loopback = found.iter().find(|interface| interface.name == "lo");
        assert!(loopback.is_some_and(|lo| lo.contains([127, 0, 0, 1].into()) && lo.up), "{found:?}");
    }
}
